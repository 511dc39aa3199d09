"""The diagnosis of an attempt: closest approach, which vehicle was early, the ego's reaction, limits reached."""

from __future__ import annotations

import math

import numpy as np

from sumo_adv.datatypes import Diagnosis, Floats, Limits, Track
from sumo_adv.episode.task import AttemptResult
from sumo_adv.geometry import Frame, Path, wrap
from sumo_adv.simulation.recording import tracks_of

TOGETHER = 2.0  # m: centres of two tracks at a smaller distance are at the same place
BRAKES = 1.5  # m/s2: stronger braking is a reaction
REACHED = 0.97  # share of a limit that counts as reached
REACH = 25.0  # m along the ego's path within which its next position is searched


def diagnose(
    result: AttemptResult, ego: str, bv: str, ego_path: Path, limits: Limits, step_length: float
) -> Diagnosis | None:
    """The diagnosis of an attempt; None if one of the two left at once."""
    tracks = {t.id: t for t in tracks_of(result.snapshots, result.sizes, {}, step_length, (ego, bv))}
    if ego not in tracks or bv not in tracks:
        return None
    first, last = result.start, min(tracks[ego].time[-1], tracks[bv].time[-1])
    a, b = tracks[ego].between(first, last), tracks[bv].between(first, last)
    count = min(len(a.time), len(b.time))
    if count < 2:
        return None
    i = int(np.argmin(np.hypot(a.x[:count] - b.x[:count], a.y[:count] - b.y[:count])))
    braking = np.flatnonzero(a.acceleration < -BRAKES)
    return Diagnosis(
        time=round(float(a.time[i]) - first, 2), ego_frame=_seen(a, b, i), bv_frame=_seen(b, a, i),
        ego_speed=round(float(a.speed[i]), 2), bv_speed=round(float(b.speed[i]), 2), early=_early(a, b),
        ego_reaction=round(float(a.time[braking[0]]) - first, 2) if len(braking) else None,
        ego_braking=round(max(0.0, -float(a.acceleration.min())), 2), ego_shift=_shift(a, ego_path),
        bound=_bound(b, limits, step_length),
    )  # fmt: skip


def _seen(one: Track, other: Track, i: int) -> tuple[float, float]:
    frame = Frame(float(one.x[i]), float(one.y[i]), float(one.heading[i]))
    x, y, _ = frame.to_local(float(other.x[i]), float(other.y[i]), 0.0)
    return round(x, 2), round(y, 2)


def _early(ego: Track, bv: Track) -> float | None:
    """Seconds by which the BV was before the ego at a place where both have been; None without such a place.

    With several such pairs of states, the pair with the smallest difference in time counts.
    """
    apart = np.hypot(ego.x[:, None] - bv.x[None, :], ego.y[:, None] - bv.y[None, :])
    i, j = np.nonzero(apart < TOGETHER)
    if not len(i):
        return None
    between = ego.time[i] - bv.time[j]
    return round(float(between[np.argmin(np.abs(between))]), 2)


def _shift(ego: Track, path: Path) -> float:
    """The largest change of the ego's offset from its path [m]."""
    station, offsets = 0.0, []
    for x, y in zip(ego.x.tolist(), ego.y.tolist(), strict=True):
        station, offset = path.project(x, y, near=station, reach=REACH)
        offsets.append(offset)
    return round(float(np.max(np.abs(np.array(offsets) - offsets[0]))), 2)


def _bound(bv: Track, limits: Limits, dt: float) -> tuple[str, ...]:
    """Limits that the BV's motion reached. The first step is left out, because SUMO drove it."""
    if len(bv.time) < 4:
        return ()
    a = bv.acceleration[1:]
    turn: Floats = wrap(np.diff(bv.heading)) / dt
    most = {
        "braking": -float(a.min()) / limits.braking, "acceleration": float(a.max()) / limits.acceleration,
        "lateral": float(np.abs(turn * bv.speed[1:]).max()) / limits.lateral,
        "jerk": float(np.abs(np.diff(a)).max()) / dt / limits.jerk,
    }  # fmt: skip
    return tuple(name for name, share in most.items() if math.isfinite(share) and share >= REACHED)
