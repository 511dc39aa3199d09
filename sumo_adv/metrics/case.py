"""The part of a recording that is judged: the ego, the adversary with its further plan, and the vehicles near them.

If a log moved the adversary up to the take-over, the log's noise must not count against the adversary. Recorded speeds
and headings fluctuate from state to state. At 0.1 s, a fluctuation of 1 m/s is an acceleration of 10 m/s2, which would
show in the adversary's first step. Therefore the speeds and headings of the last half second before the take-over are
replaced by a straight line through them. The adversary begins with the smoothed state, and the gates judge it from
there. Positions stay as recorded.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sumo_adv.datatypes import Limits, Track
from sumo_adv.metrics.avoidance import OnRoad
from sumo_adv.metrics.boxes import height_as
from sumo_adv.metrics.gates import CLOCK_SLACK_S, GATES, kinematic_gates
from sumo_adv.metrics.reference.sight import SightLimits

SMOOTHED_S = 0.5  # before the take-over; the shortest manoeuvre in a log, a tap on the brake, lasts longer
FEWEST_SMOOTHED_STATES = 4  # a line through fewer states does not show their noise


def smoothed(track: Track, time: float, limits: Limits) -> Track:
    """Smooth the speeds, headings and accelerations of a track in the ``SMOOTHED_S`` up to a time.

    The acceleration of the next step is computed from the smoothed speed.

    Args:
        track: The track.
        time: The end of the smoothed stretch [s].
        limits: The smoothed acceleration is kept within these.

    Returns:
        The smoothed track; the same track if fewer than ``FEWEST_SMOOTHED_STATES`` states lie in the stretch.
    """
    k = np.flatnonzero((track.time >= time - SMOOTHED_S - CLOCK_SLACK_S) & (track.time <= time + CLOCK_SLACK_S))
    if len(k) < FEWEST_SMOOTHED_STATES:
        return track
    speed, heading, acceleration = track.speed.copy(), track.heading.copy(), track.acceleration.copy()
    since = track.time[k] - track.time[k[-1]]
    slope, last = np.polyfit(since, speed[k], 1)
    slope = float(np.clip(slope, -limits.braking, limits.acceleration))
    speed[k] = np.maximum(last + slope * since, 0.0)
    turn, final = np.polyfit(since, np.unwrap(heading[k]), 1)
    heading[k] = final + turn * since
    acceleration[k] = slope if speed[k[-1]] > 0.0 else 0.0
    after = int(k[-1]) + 1
    if after < len(track.time):
        acceleration[after] = (speed[after] - speed[k[-1]]) / (track.time[after] - track.time[k[-1]])
    return replace(track, speed=speed, heading=heading, acceleration=acceleration)


def log_breaches(track: Track, time: float, limits: Limits) -> tuple[str, ...]:
    """Return the kinematic gates that the log itself breaks.

    Args:
        track: The adversary's track.
        time: When the log stops moving the vehicle [s]. The step after it counts, because it depends on the last state.
        limits: The limits of the motion.

    Returns:
        Names of gates, in the order of ``GATES``.
    """
    if len(track.time) < FEWEST_SMOOTHED_STATES:
        return ()
    broken = kinematic_gates(track.boxes(), track.acceleration, track.time, limits)
    until = int(np.searchsorted(track.time, time + CLOCK_SLACK_S)) + 1
    return tuple(name for name in GATES if name in broken and broken[name][2:until].any())


THIRD_PARTY_DISTANCE_M = 60.0  # between centres; vehicles that stay farther away are no third parties
FEWEST_STATES = 4  # a vehicle with fewer states has no motion to judge


@dataclass(frozen=True, slots=True)
class Case:
    """What a verdict is based on: recorded tracks on one grid, and the road around them.

    Attributes:
        ego: The ego's track.
        adversary: The track of the vehicle that collides with the ego; past a contact it continues as planned.
        others: The vehicles near the ego, including the supports.
        start: When the attack begins [s].
        log_gates: The gates that the log of the adversary breaks before the attack; empty if no log moved it.
        supports: The other adversaries; the gates judge their motion, too.
        on_road: Returns which points are drivable; None if all are.
        lane_half_width: Half the width of the ego's lane [m].
        unattacked: The ego's motion without the attack, if known.
        sight: How far the ego sees along its way; None without a limit.
    """

    ego: Track
    adversary: Track
    others: tuple[Track, ...]
    start: float
    log_gates: tuple[str, ...] = ()
    supports: tuple[Track, ...] = ()
    on_road: OnRoad | None = None
    lane_half_width: float = 1.6
    unattacked: Track | None = None
    sight: SightLimits | None = None

    @property
    def begin(self) -> float:
        """The first time at which both tracks have a state [s]."""
        return max(float(self.ego.time[0]), float(self.adversary.time[0]))


def make_case(
    tracks: Sequence[Track], ego: str, adversaries: Sequence[str], start: float, beyond: Mapping[str, Track], *,
    logged: Limits | None = None, on_road: OnRoad | None = None, lane_half_width: float = 1.6,
    unattacked: Track | None = None, sight: SightLimits | None = None,
) -> Case | None:  # fmt: skip
    """Make the case of one attempt.

    Args:
        tracks: The recorded motions on one grid. They begin some steps before ``start``.
        ego: The ego's id.
        adversaries: The adversaries' ids, the collider's first.
        start: When the attack begins [s].
        beyond: The adversaries' planned motions from the last recorded step on, by id.
        logged: The vehicles' limits, if a log moved them up to ``start``. The log's noise is then smoothed, because the
            gates judge what the adversaries add.
        on_road: Returns which points are drivable.
        lane_half_width: Half the width of the ego's lane [m].
        unattacked: The ego's motion without the attack, if known.
        sight: How far the ego sees along its way; None without a limit.

    Returns:
        The case; None if the ego or the collider has no state after ``start``.
    """
    named = {t.id: t for t in tracks}
    ego_track, adversary_track = named.get(ego), named.get(adversaries[0])
    if ego_track is None or adversary_track is None:
        return None
    ego_track, adversary_track = unbroken(ego_track, start), unbroken(adversary_track, start)
    if any(not len(t.time) or t.time[-1] <= start for t in (ego_track, adversary_track)):
        return None
    others = tuple(
        t for n, t in named.items()
        if n not in (ego, *adversaries) and len(t.time) >= FEWEST_STATES
        and closest(ego_track, t, start) < THIRD_PARTY_DISTANCE_M
    )  # fmt: skip
    breaches = () if logged is None else log_breaches(adversary_track, start, logged)
    helpers = [unbroken(named[n], start) for n in adversaries[1:] if n in named]
    driven = [t if logged is None else smoothed(t, start, logged) for t in (adversary_track, *helpers) if len(t.time)]
    adversary_track, *helpers = (joined(t, beyond[t.id]) if t.id in beyond else t for t in driven)
    return Case(
        ego_track, adversary_track, (*others, *helpers), start, breaches, tuple(helpers), on_road, lane_half_width,
        unattacked, sight,
    )  # fmt: skip


def unbroken(track: Track, time: float) -> Track:
    """Return the stretch of a track around a time in which no step is missing.

    Recorded vehicles may be out of view at times.

    Args:
        track: The track.
        time: The time [s].
    """
    step = float(np.diff(track.time).min()) if len(track.time) > 1 else 0.0
    breaks = np.flatnonzero(np.diff(track.time) > 1.5 * step)
    if not len(breaks):
        return track
    ends, begins = track.time[breaks], track.time[breaks + 1]
    before, after = begins[begins <= time + 5e-4], ends[ends >= time - 5e-4]
    return track.between(before[-1] if len(before) else -math.inf, after[0] if len(after) else math.inf)


def closest(ego: Track, other: Track, time: float) -> float:
    """Return the minimum distance of the centres [m] at common times from ``time`` [s] on; inf if there are none."""
    common, i, j = np.intersect1d(np.round(ego.time, 3), np.round(other.time, 3), return_indices=True)
    i, j = i[common >= time - 1e-6], j[common >= time - 1e-6]
    return float(np.min(np.hypot(ego.x[i] - other.x[j], ego.y[i] - other.y[j]))) if len(i) else math.inf


def joined(track: Track, more: Track) -> Track:
    """Append one track to another; lane ids are dropped."""
    names = ("time", "x", "y", "heading", "speed", "acceleration")
    time, x, y, heading, speed, acceleration = (np.concatenate([getattr(t, n) for t in (track, more)]) for n in names)
    z = height_as(track, lambda z: np.concatenate([z, np.broadcast_to(more.z, more.x.shape)]))
    return Track(track.id, track.role, time, x, y, heading, speed, acceleration, track.length, track.width, z=z)
