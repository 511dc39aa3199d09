"""What the ego will do: along its path, by its unattacked profile until it is disturbed, then by its driver's model.

The profile comes from the unattacked run that was forked at the trigger (ALGORITHM, "Ego forecast"); in an attempt it
is shifted by the ego's present offset while the ego still follows it.
"""

from __future__ import annotations

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.drivers.scenes import Scenes
from sumo_adv.situation import NO_ARRIVAL

ON_PROFILE_DISTANCE, ON_PROFILE_SPEED = 1.0, 0.6  # m, m/s: closer than this the ego still follows its profile
HELD_ACCELERATION = 0.5  # s: a disturbed ego keeps its acceleration so long, then its speed
LOOK = np.arange(0.0, 9.0)  # s: where planners are told the ego's predicted path
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
    """Seconds until egos (n,) are at stations ``conflict_s`` (n, k); negative once past, ``NO_ARRIVAL`` if not
    foreseen."""
    found = np.full(conflict_s.shape, NO_ARRIVAL)
    if not np.isfinite(conflict_s).any():
        return found
    way, _ = stations(scenes, now, s, v, a, ARRIVAL_LOOK)
    rows = np.arange(len(s))
    for k, at in enumerate(conflict_s.T):
        reached = way >= at[:, None]
        i = np.clip(np.argmax(reached, axis=1), 1, len(ARRIVAL_LOOK) - 1)
        before, after = way[rows, i - 1], way[rows, i]
        w = np.clip((at - before) / np.maximum(after - before, 1e-6), 0.0, 1.0)
        time = ARRIVAL_LOOK[i - 1] + w * (ARRIVAL_LOOK[i] - ARRIVAL_LOOK[i - 1])
        left = at - s
        found[:, k] = np.where(left <= 0, left / np.maximum(v, 3.0), np.where(reached[:, -1], time, NO_ARRIVAL))
    return found
