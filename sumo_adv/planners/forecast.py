"""The forecast of the ego's motion that planners get: its path for the next 8 s and its arrivals at conflicts.

An ego near its unattacked profile is expected to follow it, shifted by its present distance from it. Any other ego is
expected to keep its acceleration for a moment and then its speed. The profile is the ego's motion in the baseline run.
"""

from __future__ import annotations

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.drivers.sumo_rules import Scenes
from sumo_adv.situation import NO_ARRIVAL

ON_PROFILE_DISTANCE, ON_PROFILE_SPEED = 1.0, 0.6  # m, m/s: an ego nearer than this still follows its profile
HELD_ACCELERATION = 0.5  # s: a disturbed ego keeps its acceleration for this time, then its speed
LOOK = np.arange(0.0, 9.0)  # s: times of the predicted path in a planner's observation
ARRIVAL_LOOK = np.arange(0.0, 16.1, 0.5)  # s


def stations(scenes: Scenes, now: float, s: Floats, v: Floats, a: Floats, look: Floats) -> tuple[Floats, Floats]:
    """Stations and speeds (n, k), ``look`` (k,) seconds from ``now``, of egos at ``s`` with ``v``, ``a`` (n,)."""
    (ps, pv), (fs, fv) = scenes.profile_now(now), scenes.profile(now + look)
    held = np.minimum(look, HELD_ACCELERATION)
    speed = np.maximum(v[:, None] + a[:, None] * held, 0.0)
    free = s[:, None] + (v[:, None] + speed) / 2 * held + speed * (look - held)
    on = ((np.abs(s - ps) < ON_PROFILE_DISTANCE) & (np.abs(v - pv) < ON_PROFILE_SPEED))[:, None]
    return np.where(on, fs + (s - ps)[:, None], free), np.where(on, fv, speed)


def arrivals(scenes: Scenes, now: float, s: Floats, v: Floats, a: Floats, conflict_s: Floats) -> Floats:
    """Seconds until egos (n,) are at stations ``conflict_s`` (n, k).

    Negative once past, ``NO_ARRIVAL`` if the ego does not get there within the forecast.
    """
    times = np.full(conflict_s.shape, NO_ARRIVAL)
    if not np.isfinite(conflict_s).any():
        return times
    way, _ = stations(scenes, now, s, v, a, ARRIVAL_LOOK)
    rows = np.arange(len(s))
    for k, at in enumerate(conflict_s.T):
        reached = way >= at[:, None]
        i = np.clip(np.argmax(reached, axis=1), 1, len(ARRIVAL_LOOK) - 1)
        before, after = way[rows, i - 1], way[rows, i]
        w = np.clip((at - before) / np.maximum(after - before, 1e-6), 0.0, 1.0)
        time = ARRIVAL_LOOK[i - 1] + w * (ARRIVAL_LOOK[i] - ARRIVAL_LOOK[i - 1])
        left = at - s
        times[:, k] = np.where(left <= 0, left / np.maximum(v, 3.0), np.where(reached[:, -1], time, NO_ARRIVAL))
    return times
