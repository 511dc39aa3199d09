"""Whether any vehicle of a recording could reach the ego: straight at it, as fast as its limits let it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from sumo_adv.datatypes import Role, Track
from sumo_adv.situation import fastest_of

EVERY = 0.5  # s between the moments at which it may set out


class Reach(NamedTuple):
    """The vehicle that comes nearest, the metres that it is short by (0 or less: it reaches the ego), and when [s]."""

    vehicle: str
    short: float
    time: float


def nearest_reach(tracks: Mapping[str, Track], ego: str, time: float, acceleration: float) -> Reach | None:
    """Which vehicle comes nearest to the ego's unattacked motion from ``time`` [s] on; None without any.

    It sets out from its own motion, heads straight for where the ego will be with ``acceleration`` [m/s2], and touches
    it where their centres are half of both lengths apart: less than any road lets it need.
    """
    me = tracks[ego].between(time, math.inf)
    best: Reach | None = None
    for name, track in tracks.items():
        own = track.between(time, math.inf)
        if name == ego or track.role is Role.OBSTACLE or len(own.time) < 1:
            continue
        steps = np.unique(np.searchsorted(own.time, np.arange(own.time[0], own.time[-1] + 1e-6, EVERY)))
        starts = steps[steps < len(own.time)]
        left = me.time[None, :] - own.time[starts][:, None]
        v = own.speed[starts][:, None]
        top = np.array([[fastest_of(float(each))] for each in v[:, 0]])
        rises = np.minimum(left, (top - v) / acceleration)
        reached = v * left + acceleration * rises * (left - rises / 2)
        away = np.hypot(me.x[None, :] - own.x[starts][:, None], me.y[None, :] - own.y[starts][:, None])
        short = np.where(left > 0.0, away - (me.length + own.length) / 2 - reached, math.inf)
        k = int(np.argmin(short))
        least = float(short.flat[k])
        if math.isfinite(least) and (best is None or least < best.short):
            best = Reach(name, least, float(me.time[k % len(me.time)]))
    return best


def why_nobody(tracks: Mapping[str, Track], ego: str, time: float, acceleration: float) -> str:
    """Why no vehicle of a recording can attack, in words."""
    nearest = nearest_reach(tracks, ego, time, acceleration)
    if nearest is None:
        return "no other vehicle is there"
    if nearest.short <= 0.0:
        return "no vehicle near is on a way that meets the ego's path in time"
    return (
        f"no vehicle can reach the ego: '{nearest.vehicle}' comes nearest, and is {nearest.short:.1f} m short at "
        f"{nearest.time:.1f} s though it speeds up by {acceleration:g} m/s2 all the time"
    )
