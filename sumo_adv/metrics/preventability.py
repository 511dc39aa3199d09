"""Find the reference drivers that avoid a collision, by the kinematic check, which repeats the adversary's motion.

:mod:`sumo_adv.metrics.reference.counterfactual` makes the check itself, for many encounters at once.
"""

from __future__ import annotations

import numpy as np

from sumo_adv.datatypes import Floats, Preventability, Track
from sumo_adv.geometry import wrap_below_pi
from sumo_adv.metrics.boxes import on_grid, row_of
from sumo_adv.metrics.case import Case
from sumo_adv.metrics.contact import SAME_DIRECTION
from sumo_adv.metrics.reference import REFERENCE_DRIVERS, SAME_DIRECTION_ONLY
from sumo_adv.metrics.reference.counterfactual import Encounters, driver_outcomes
from sumo_adv.road_users import RoadUser, road_user

SAME_WAY_M = 3.0  # an ego farther beside its unattacked way goes another way
PLANNED_S = 0.3  # a track must continue this long after the contact to count as planned
AVOIDS, COLLIDES, NOT_APPLICABLE = "avoids", "collides", "not_applicable"


def preventability(
    case: Case, contact_time: float, *, driver: str | None = None, until_avoided: bool = False
) -> Preventability:
    """Return which reference drivers avoid a collision.

    Args:
        case: The recorded attempt. The adversary continues past the contact as it had planned. The ego's way continues
            as in ``case.unattacked``, or straight.
        contact_time: When the ego and the adversary touch [s].
        driver: The reference driver that drove the ego. It counts as one that has not avoided the collision.
        until_avoided: Run only the drivers that ``counterfactual.driver_outcomes`` needs to find whether one avoids the
            collision.
    """
    given = encounter_of(case, contact_time)
    ruled = has_rule(case.ego, case.adversary, contact_time)
    applicable = [name for name in REFERENCE_DRIVERS if ruled or name not in SAME_DIRECTION_ONLY]
    found = driver_outcomes(given, applicable, case.on_road, until_avoided=until_avoided)
    in_words, alarms = {}, {}
    for name in REFERENCE_DRIVERS:
        if name in SAME_DIRECTION_ONLY and not ruled:
            in_words[name] = NOT_APPLICABLE
        elif name in found:
            in_words[name] = AVOIDS if bool(found[name].avoids[0]) and name != driver else COLLIDES
            alarm = case.begin + float(found[name].alarm[0])
            if np.isfinite(alarm) and alarm < contact_time:
                alarms[name] = round(alarm, 3)
    why = None
    if float(case.adversary.time[-1]) < contact_time + PLANNED_S:
        why = "no_plan"
    elif bool(found["unchanged"].avoids[0]):
        why = "unchanged_ego_misses"
    elif not alarms:
        why = "no_hazard"
    return Preventability(in_words, alarms, why)


def encounter_of(case: Case, moment: float) -> Encounters:
    """Return the encounter on the common grid of both tracks.

    Args:
        case: The recorded attempt.
        moment: The ego's track ends with the step that contains this time [s].
    """
    ego, begin = case.ego, case.begin
    dt = float(np.diff(ego.time).min()) if len(ego.time) > 1 else 0.1
    ego_until, foe = ego.between(begin, moment + dt), case.adversary.between(begin, np.inf)
    start = int(np.searchsorted(ego_until.time, case.start - 5e-4))
    grid = begin + dt * np.arange(max(len(ego_until.time), 2))
    third = on_grid([t for t in case.others if len(t.time)], np.round(grid, 6)) if case.others else None
    onward = None if case.unattacked is None else onward_of(ego_until, case.unattacked)[None]
    return Encounters(
        row_of(ego_until), row_of(foe), np.array([start]), np.array([len(ego_until.time) - 1]), dt, third,
        case.lane_half_width, onward, sight=None if case.sight is None else case.sight.along(ego_until)[None],
    )  # fmt: skip


def onward_of(ego: Track, unattacked: Track) -> Floats:
    """Return the continuation of the ego's way past its last state.

    The ego continues on its unattacked way, with its present offset from it.

    Args:
        ego: The ego's track.
        unattacked: Its motion without the attack.

    Returns:
        The points ``(P, 2)`` [m]. There are none if the unattacked way is another one: more than ``SAME_WAY_M`` m away,
        or with another direction.
    """
    x, y, heading = float(ego.x[-1]), float(ego.y[-1]), float(ego.heading[-1])
    moved = np.concatenate([[True], np.hypot(np.diff(unattacked.x), np.diff(unattacked.y)) > 0.01])
    px, py, ph = unattacked.x[moved], unattacked.y[moved], unattacked.heading[moved]
    nearest = int(np.argmin(np.hypot(px - x, py - y)))
    left = (y - py[nearest]) * np.cos(ph[nearest]) - (x - px[nearest]) * np.sin(ph[nearest])
    if abs(left) > SAME_WAY_M or abs(float(wrap_below_pi(np.asarray(ph[nearest] - heading)))) > SAME_DIRECTION:
        return np.empty((0, 2))
    px, py = px - left * np.sin(ph), py + left * np.cos(ph)
    ahead = (px - x) * np.cos(heading) + (py - y) * np.sin(heading) > 1.0
    ahead &= np.arange(len(px)) > nearest
    return np.stack([px[ahead], py[ahead]], axis=-1)


def has_rule(ego: Track, adversary: Track, contact_time: float) -> bool:
    """Return whether the drivers for one direction have a rule for the adversary.

    They have one if the adversary goes the ego's way and is no pedestrian. Their sources cover vehicles that lead or
    cut in.
    """
    pedestrian = road_user(adversary) is RoadUser.PEDESTRIAN
    return not pedestrian and same_direction(ego, adversary, contact_time)


def same_direction(ego: Track, adversary: Track, contact_time: float) -> bool:
    """Return whether the adversary has gone the ego's way over the last second before the contact.

    It then leads, cuts in or cuts out.
    """
    e, a = (t.between(contact_time - 1.0, contact_time) for t in (ego, adversary))
    if not len(e.time) or not len(a.time):
        return False
    count = min(len(e.time), len(a.time))
    return bool((np.abs(wrap_below_pi(a.heading[-count:] - e.heading[-count:])) < SAME_DIRECTION).all())
