"""The judged part of a recording: the ego, the adversary with its further plan, and the vehicles near.

Where a log moved the adversary up to the take-over, the log's noise is the log's, not the adversary's. Recorded speeds
and headings tremble from state to state. At 0.1 s a tremble of 1 m/s is an acceleration of 10 m/s2, and the first step
of an adversary would carry it. So the states of the last half second before the take-over are replaced by a straight
line through their speeds and headings. The adversary begins with the smoothed state, and the gates judge it from there.
Positions stay as recorded.
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

SMOOTHED_S = 0.5  # before the take-over: the shortest manoeuvre in a log, a brake tap, lasts longer
FEWEST_SMOOTHED_STATES = 4  # a line through fewer says nothing of their noise


def smoothed(track: Track, time: float, limits: Limits) -> Track:
    """The track with smooth speeds, headings and accelerations in the ``SMOOTHED_S`` up to ``time`` [s], and with the
    acceleration of the next step counted from the smoothed speed.

    The acceleration is kept within the limits. A track of fewer states there stays as it is.
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
    """The names of the kinematic gates that the log itself breaks up to ``time`` [s], or in the step after it because
    of its last state."""
    if len(track.time) < FEWEST_SMOOTHED_STATES:
        return ()
    broken = kinematic_gates(track.boxes(), track.acceleration, track.time, limits)
    until = int(np.searchsorted(track.time, time + CLOCK_SLACK_S)) + 1
    return tuple(name for name in GATES if name in broken and broken[name][2:until].any())


THIRD_PARTY_DISTANCE_M = 60.0  # between centres: vehicles that never come that near are no third party
FEWEST_STATES = 4  # a vehicle that is there for fewer has no motion to judge


@dataclass(frozen=True, slots=True)
class Case:
    """What a verdict is based on: recorded tracks on one grid, and the road around them.

    Attributes:
        ego: The ego's track.
        adversary: The collider's track; it goes on past a contact as it was planned.
        others: The vehicles near, the supports among them.
        start: When the attack begins [s].
        log_gates: The gates that the log of the adversary breaks before the attack; empty if no log moved it.
        supports: The other adversaries; their motion is judged by the gates, too.
        on_road: Tells which points are drivable; None = everywhere.
        lane_half_width: Half the width of the ego's lane [m].
        unattacked: The ego's motion without the attack, if known.
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

    @property
    def begin(self) -> float:
        """When both tracks are there [s]."""
        return max(float(self.ego.time[0]), float(self.adversary.time[0]))


def make_case(
    tracks: Sequence[Track], ego: str, adversaries: Sequence[str], start: float, beyond: Mapping[str, Track], *,
    logged: Limits | None = None, on_road: OnRoad | None = None, lane_half_width: float = 1.6,
    unattacked: Track | None = None,
) -> Case | None:  # fmt: skip
    """Return the case of one attempt; None if the ego or the collider is gone before it moved.

    Args:
        tracks: The recorded motions on one grid, which begin some steps before ``start``.
        ego: The ego's id.
        adversaries: Their ids, the collider's first.
        start: When the attack begins [s].
        beyond: The adversaries' planned motions from the last recorded step on, by id.
        logged: The vehicles' limits, if a log moved them up to ``start``. The noise there is smoothed, because the
            gates judge what the adversaries add.
        on_road: Tells which points are drivable.
        lane_half_width: Half the width of the ego's lane [m].
        unattacked: The ego's motion without the attack, if known.
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
        unattacked,
    )  # fmt: skip


def unbroken(track: Track, time: float) -> Track:
    """The stretch of a track around ``time`` [s] in which no step is left out (recorded vehicles may be unseen)."""
    step = float(np.diff(track.time).min()) if len(track.time) > 1 else 0.0
    breaks = np.flatnonzero(np.diff(track.time) > 1.5 * step)
    if not len(breaks):
        return track
    ends, begins = track.time[breaks], track.time[breaks + 1]
    before, after = begins[begins <= time + 5e-4], ends[ends >= time - 5e-4]
    return track.between(before[-1] if len(before) else -math.inf, after[0] if len(after) else math.inf)


def closest(ego: Track, other: Track, time: float) -> float:
    """Least distance of the centres [m] at common times from ``time`` on; inf if there are none."""
    common, i, j = np.intersect1d(np.round(ego.time, 3), np.round(other.time, 3), return_indices=True)
    i, j = i[common >= time - 1e-6], j[common >= time - 1e-6]
    return float(np.min(np.hypot(ego.x[i] - other.x[j], ego.y[i] - other.y[j]))) if len(i) else math.inf


def joined(track: Track, more: Track) -> Track:
    """One track after the other; lane ids are dropped."""
    names = ("time", "x", "y", "heading", "speed", "acceleration")
    time, x, y, heading, speed, acceleration = (np.concatenate([getattr(t, n) for t in (track, more)]) for n in names)
    z = height_as(track, lambda z: np.concatenate([z, np.broadcast_to(more.z, more.x.shape)]))
    return Track(track.id, track.role, time, x, y, heading, speed, acceleration, track.length, track.width, z=z)
