"""Decide what a collision says about the ego, as a level.

========== ==============================================================================================
level      meaning; every level requires a feasible adversary that does not run into the ego's back
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
(:mod:`sumo_adv.metrics.reference.counterfactual`) repeats the adversary's motion and is made for every collision. The
check in the loop (``episode/references.py``) lets the adversary plan again. It is made whenever a level is claimed.
"""

from __future__ import annotations

import numpy as np

from sumo_adv.datatypes import Bools, Level, Track, Verdict
from sumo_adv.geometry import stations, wrap_below_pi
from sumo_adv.metrics.boxes import row_of
from sumo_adv.metrics.contact import SAME_DIRECTION
from sumo_adv.metrics.reference import COMPETENT
from sumo_adv.metrics.reference.cc_human import CcHuman
from sumo_adv.metrics.reference.view import EgoPaths
from sumo_adv.metrics.severity import SERIOUS_DELTA_V_M_S

STATIONARY_SPEED_M_S, STATIONARY_FOR_S = 0.5, 1.0  # before the contact
SERIOUS_RISK = 0.1  # -, risk of a serious injury of a pedestrian or cyclist
BLOCKING_EGO_BRAKING_M_S2 = 3.0  # an ego that blocks the junction could have stopped before it with this braking
JUNCTION_PREFIX = ":"  # of SUMO's internal lanes


def level_of(verdict: Verdict) -> Level:
    """Return the highest level that a verdict reaches."""
    if not verdict.counts:
        return Level.NONE
    if not verdict.collided:
        return Level.CRITICAL if verdict.critical else Level.NONE
    p = verdict.preventability
    if p is None or p.inconclusive or verdict.ego_stationary or verdict.ego_blocking or not {*COMPETENT} & {*p.by}:
        return Level.COLLISION
    if CcHuman.name not in p.by:
        return Level.VALID
    return Level.SERIOUS if verdict.humanlike and _hard(verdict) else Level.STRICT


def _hard(verdict: Verdict) -> bool:
    """Return whether the collision is hard enough for the level ``serious``."""
    if verdict.impact_speed is not None:
        return (verdict.injury_risk or 0.0) >= SERIOUS_RISK - 1e-9
    return (verdict.delta_v or 0.0) >= SERIOUS_DELTA_V_M_S


def stationary(ego: Track, contact_time: float) -> bool:
    """Return whether the ego stood throughout the last second before the contact."""
    last = ego.between(contact_time - STATIONARY_FOR_S, contact_time)
    return bool(len(last.time)) and bool((np.abs(last.speed) < STATIONARY_SPEED_M_S).all())


def blocking(ego: Track, contact_time: float) -> bool:
    """Return whether the ego stands in a junction before which it could have stopped.

    The check needs SUMO's lane ids; without them the result is False.
    """
    until = ego.between(-np.inf, contact_time)
    if not until.lane or abs(until.speed[-1]) >= STATIONARY_SPEED_M_S or not until.lane[-1].startswith(JUNCTION_PREFIX):
        return False
    outside_it = [k for k, lane in enumerate(until.lane) if lane and not lane.startswith(JUNCTION_PREFIX)]
    if not outside_it:
        return False
    entry = outside_it[-1]
    way = stations(until.x, until.y)
    room = way[entry] - way[: entry + 1]
    return bool((room >= until.speed[: entry + 1] ** 2 / (2 * BLOCKING_EGO_BRAKING_M_S2)).any())


def ahead_in_lane(ego: Track, adversary: Track, lane_half_width: float) -> Bools:
    """Find the steps in which the adversary is ahead of the ego in the ego's lane and goes the same way.

    Args:
        ego: The ego's track.
        adversary: The adversary's track, n steps.
        lane_half_width: Half the width of the ego's lane [m].

    Returns:
        A flag for each of the adversary's steps ``(n,)``.
    """
    common = np.clip(np.searchsorted(ego.time, adversary.time - 5e-4), 0, len(ego.time) - 1)
    if len(ego.time) < 2:
        return np.zeros(len(adversary.time), bool)
    paths = EgoPaths(row_of(ego))
    station, left, heading = (v[0] for v in paths.locate(adversary.x[None], adversary.y[None]))
    ahead = station > paths.station[0, common]
    return np.asarray(
        ahead & (np.abs(left) < lane_half_width) & (np.abs(wrap_below_pi(adversary.heading - heading)) < SAME_DIRECTION)
    )
