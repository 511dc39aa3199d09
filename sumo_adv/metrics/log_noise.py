"""The take-over of a vehicle that a log moves: the log's noise is the log's, not the adversary's.

Recorded speeds and headings tremble from state to state. At 0.1 s a tremble of 1 m/s is an acceleration of 10 m/s2, and
the first step of an adversary would carry it. So the states of the last half second before the take-over are replaced
by a straight line through their speeds and headings. The adversary begins with the smoothed state, and the gates judge
it from there. Positions stay as recorded.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sumo_adv.datatypes import Limits, Track
from sumo_adv.metrics.gates import CLOCK_SLACK, GATES, kinematic_gates

SPAN = (
    0.5  # s before the take-over that are smoothed: the shortest manoeuvre in a log, a tap on the brake, lasts longer
)
FEWEST = 4  # states: a line through fewer says nothing of their noise


def smoothed(track: Track, time: float, limits: Limits) -> Track:
    """The track with smooth speeds, headings and accelerations in the ``SPAN`` up to ``time`` [s], and with the
    acceleration of the next step counted from the smoothed speed.

    The acceleration is kept within the limits. A track of fewer than ``FEWEST`` states there stays as it is.
    """
    k = np.flatnonzero((track.time >= time - SPAN - CLOCK_SLACK) & (track.time <= time + CLOCK_SLACK))
    if len(k) < FEWEST:
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
    if len(track.time) < FEWEST:
        return ()
    broken = kinematic_gates(track.boxes(), track.acceleration, track.time, limits)
    until = int(np.searchsorted(track.time, time + CLOCK_SLACK)) + 1
    return tuple(name for name in GATES if name in broken and broken[name][2:until].any())
