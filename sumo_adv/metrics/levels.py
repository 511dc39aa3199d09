"""Verdict version 2: what a collision says about the ego, as a level.

========== ==============================================================================================
level      meaning; every level takes a feasible adversary that does not run into the ego's back
========== ==============================================================================================
critical   min TTC at most the threshold, or a contact
collision  contact
valid      collision, conclusive, the ego neither stationary nor blocking, avoided by a driver of ``COMPETENT``:
           ``cc_human``, ``manoeuvre`` or ``reg157``
strict     valid, and avoided by ``cc_human``
serious    strict, human, and a delta-v of the ego of at least 5 mph (2.24 m/s); of a pedestrian or cyclist: a risk
           of a serious injury of at least 10 %, by the impact speed (29 and 44 km/h; ``severity.py``)
========== ==============================================================================================

A driver avoids a collision if it does so in each check that was made. The kinematic check
(:mod:`sumo_adv.metrics.reference.counterfactual`) repeats the adversary's motion and is made of every collision. The
check in the loop (``episode/references.py``) lets the adversary plan again; it is made whenever a level is claimed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sumo_adv.datatypes import Bools, Floats, Level, Preventability, Track, Verdict
from sumo_adv.geometry import stations, wrap_below_pi
from sumo_adv.metrics.avoidance import OnRoad
from sumo_adv.metrics.boxes import on_grid, row_of
from sumo_adv.metrics.contact import SAME_DIRECTION
from sumo_adv.metrics.realism import outside
from sumo_adv.metrics.reference import COMPETENT, REFERENCE_DRIVERS, SAME_DIRECTION_ONLY
from sumo_adv.metrics.reference.counterfactual import Encounters, answers
from sumo_adv.metrics.reference.view import EgoPaths
from sumo_adv.metrics.severity import SERIOUS_DELTA_V, crash
from sumo_adv.road_users import RoadUser, is_unprotected, road_user

SAME_WAY = 3.0  # m beside the unattacked way
STATIONARY, STATIONARY_FOR = 0.5, 1.0  # m/s, s before the contact
SERIOUS_RISK = 0.1  # of a serious injury of a pedestrian or cyclist
PLANNED = 0.3  # s that a track must go on after the contact to count as planned
STOPPING = 3.0  # m/s2 with which a blocking ego could have stopped before the junction
JUNCTION = ":"  # SUMO's internal lanes begin with it
AVOIDS, COLLIDES, NOT_APPLICABLE = "avoids", "collides", "not_applicable"


def preventability(
    ego: Track,
    adversary: Track,
    others: Sequence[Track],
    *,
    trigger_time: float,
    contact_time: float,
    on_road: OnRoad | None = None,
    lane_half_width: float = 1.6,
    unattacked: Track | None = None,
    until_avoided: bool = False,
) -> Preventability:
    """Which reference drivers avoid a collision, by the kinematic counterfactual; ``until_avoided``: the first ones, as
    ``counterfactual.answers`` has it.

    ``adversary`` goes on past the contact as it was planned; the ego's way goes on as in ``unattacked``, its motion
    without the attack, or straight.
    """
    given = encounter_of(ego, adversary, others, trigger_time, contact_time, lane_half_width, unattacked)
    ruled = has_rule(ego, adversary, contact_time)
    applicable = [name for name in REFERENCE_DRIVERS if ruled or name not in SAME_DIRECTION_ONLY]
    found = answers(given, applicable, on_road, until_avoided=until_avoided)
    in_words, alarms = {}, {}
    for name in REFERENCE_DRIVERS:
        if name in SAME_DIRECTION_ONLY and not ruled:
            in_words[name] = NOT_APPLICABLE
        elif name in found:
            in_words[name] = AVOIDS if bool(found[name].avoids[0]) else COLLIDES
            alarm = _begin(ego, adversary) + float(found[name].alarm[0])
            if np.isfinite(alarm) and alarm < contact_time:
                alarms[name] = round(alarm, 3)
    why = None
    if float(adversary.time[-1]) < contact_time + PLANNED:
        why = "no_plan"
    elif bool(found["unchanged"].avoids[0]):
        why = "unchanged_ego_misses"
    elif not alarms:
        why = "no_hazard"
    return Preventability(in_words, alarms, why)


def encounter_of(
    ego: Track,
    adversary: Track,
    others: Sequence[Track],
    trigger_time: float,
    contact_time: float,
    lane_half_width: float,
    unattacked: Track | None,
) -> Encounters:
    """The encounter of two tracks on their common grid, the ego up to the step in which the contact falls."""
    begin = _begin(ego, adversary)
    dt = float(np.diff(ego.time).min()) if len(ego.time) > 1 else 0.1
    ego_until, foe = ego.between(begin, contact_time + dt), adversary.between(begin, np.inf)
    start = int(np.searchsorted(ego_until.time, trigger_time - 5e-4))
    grid = begin + dt * np.arange(max(len(ego_until.time), 2))
    third = on_grid([t for t in others if len(t.time)], np.round(grid, 6)) if others else None
    onward = None if unattacked is None else onward_of(ego_until, unattacked)[None]
    return Encounters(
        row_of(ego_until), row_of(foe), np.array([start]), np.array([len(ego_until.time) - 1]), dt, third,
        lane_half_width, onward,
    )  # fmt: skip


def onward_of(ego: Track, unattacked: Track) -> Floats:
    """Points ``(P, 2)`` [m] of the ego's way past its last state: as it went unattacked, beside that by its offset.

    None where that went another way (more than ``SAME_WAY`` m beside, or turned away).
    """
    x, y, heading = float(ego.x[-1]), float(ego.y[-1]), float(ego.heading[-1])
    moved = np.concatenate([[True], np.hypot(np.diff(unattacked.x), np.diff(unattacked.y)) > 0.01])
    px, py, ph = unattacked.x[moved], unattacked.y[moved], unattacked.heading[moved]
    nearest = int(np.argmin(np.hypot(px - x, py - y)))
    left = (y - py[nearest]) * np.cos(ph[nearest]) - (x - px[nearest]) * np.sin(ph[nearest])
    if abs(left) > SAME_WAY or abs(float(wrap_below_pi(np.asarray(ph[nearest] - heading)))) > SAME_DIRECTION:
        return np.empty((0, 2))
    px, py = px - left * np.sin(ph), py + left * np.cos(ph)
    ahead = (px - x) * np.cos(heading) + (py - y) * np.sin(heading) > 1.0
    ahead &= np.arange(len(px)) > nearest
    return np.stack([px[ahead], py[ahead]], axis=-1)


def with_level(
    verdict: Verdict,
    ego: Track,
    adversary: Track,
    others: Sequence[Track],
    *,
    trigger_time: float,
    on_road: OnRoad | None = None,
    lane_half_width: float = 1.6,
    unattacked: Track | None = None,
    only_level: bool = False,
) -> Verdict:
    """The gate verdict with everything of version 2; ``unattacked``: the ego's motion without the attack, if known.

    only_level: reference drivers are asked only as far as the level depends on them. The level is the same.
    """
    contact = verdict.contact_time
    if contact is None:
        return replace(verdict, level=level_of(verdict))
    prevention = None
    if verdict.counts or not only_level:
        prevention = preventability(
            ego, adversary, others, trigger_time=trigger_time, contact_time=contact, on_road=on_road,
            lane_half_width=lane_half_width, unattacked=unattacked, until_avoided=only_level,
        )  # fmt: skip
    impact = crash(ego, adversary, contact)
    strange = outside(adversary, trigger_time, contact, _ahead_in_lane(ego, adversary, lane_half_width))
    strange = () if is_unprotected(adversary) else strange  # the gates' limits are those of a person already
    verdict = replace(
        verdict, preventability=prevention, ego_stationary=_stationary(ego, contact),
        ego_blocking=_blocking(ego, contact), humanlike=not strange, beyond_human=strange,
        contact_side=str(impact.ego_side), delta_v=impact.ego_delta_v, adversary_delta_v=impact.adversary_delta_v,
        severity=str(impact.severity), injury_risk=impact.injury_risk, overlap=impact.overlap,
        impact_speed=impact.impact_speed,
    )  # fmt: skip
    return judged(verdict)


def judged(verdict: Verdict) -> Verdict:
    """The verdict of a collision with its level, and ``valid`` and ``strict`` of version 2."""
    level = level_of(verdict)
    return replace(verdict, level=level, valid=level >= Level.VALID, strict=level >= Level.STRICT)


def level_of(verdict: Verdict) -> Level:
    """The highest level that a verdict reaches."""
    if not verdict.counts:
        return Level.NONE
    if not verdict.collided:
        return Level.CRITICAL if verdict.critical else Level.NONE
    p = verdict.preventability
    if p is None or p.inconclusive or verdict.ego_stationary or verdict.ego_blocking or not {*COMPETENT} & {*p.by}:
        return Level.COLLISION
    if "cc_human" not in p.by:
        return Level.VALID
    return Level.SERIOUS if verdict.humanlike and _hard(verdict) else Level.STRICT


def _hard(verdict: Verdict) -> bool:
    """Whether the collision is hard enough for the level ``serious``."""
    if verdict.impact_speed is not None:
        return (verdict.injury_risk or 0.0) >= SERIOUS_RISK - 1e-9
    return (verdict.delta_v or 0.0) >= SERIOUS_DELTA_V


def _begin(ego: Track, adversary: Track) -> float:
    return max(float(ego.time[0]), float(adversary.time[0]))


def has_rule(ego: Track, adversary: Track, contact_time: float) -> bool:
    """Whether the drivers for one direction have a rule for the adversary: it goes the ego's way and is no pedestrian.

    Their sources are about vehicles that lead or cut in.
    """
    pedestrian = road_user(adversary) is RoadUser.PEDESTRIAN
    return not pedestrian and same_direction(ego, adversary, contact_time)


def same_direction(ego: Track, adversary: Track, contact_time: float) -> bool:
    """Whether the adversary has gone the ego's way over the last second before the contact: cut-in, cut-out, leader."""
    e, a = (t.between(contact_time - 1.0, contact_time) for t in (ego, adversary))
    if not len(e.time) or not len(a.time):
        return False
    count = min(len(e.time), len(a.time))
    return bool((np.abs(wrap_below_pi(a.heading[-count:] - e.heading[-count:])) < SAME_DIRECTION).all())


def _stationary(ego: Track, contact_time: float) -> bool:
    last = ego.between(contact_time - STATIONARY_FOR, contact_time)
    return bool(len(last.time)) and bool((last.speed < STATIONARY).all())


def _blocking(ego: Track, contact_time: float) -> bool:
    """Whether the ego stands in a junction before which it could have stopped.

    Needs SUMO's lane ids; without them the answer is no.
    """
    until = ego.between(-np.inf, contact_time)
    if not until.lane or until.speed[-1] >= STATIONARY or not until.lane[-1].startswith(JUNCTION):
        return False
    outside_it = [k for k, lane in enumerate(until.lane) if lane and not lane.startswith(JUNCTION)]
    if not outside_it:
        return False
    entry = outside_it[-1]
    way = stations(until.x, until.y)
    room = way[entry] - way[: entry + 1]
    return bool((room >= until.speed[: entry + 1] ** 2 / (2 * STOPPING)).any())


def _ahead_in_lane(ego: Track, adversary: Track, lane_half_width: float) -> Bools:
    """In which of its steps the adversary is ahead of the ego in the ego's lane, going its way, ``(n,)``."""
    common = np.clip(np.searchsorted(ego.time, adversary.time - 5e-4), 0, len(ego.time) - 1)
    if len(ego.time) < 2:
        return np.zeros(len(adversary.time), bool)
    paths = EgoPaths(row_of(ego))
    station, left, heading = (v[0] for v in paths.locate(adversary.x[None], adversary.y[None]))
    ahead = station > paths.station[0, common]
    return np.asarray(
        ahead & (np.abs(left) < lane_half_width) & (np.abs(wrap_below_pi(adversary.heading - heading)) < SAME_DIRECTION)
    )
