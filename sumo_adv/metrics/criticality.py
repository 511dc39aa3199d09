"""How close it was: TTC, PET, DRAC and their kin, on arrays.  ``inf`` = never.

Everything broadcasts: ego ``(time,)`` against vehicles ``(n, time)`` gives ``(n, time)``.  SI units throughout.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Boxes, Floats, Track
from sumo_adv.geometry import LAYER_HEIGHT_M, same_layer, wrap_below_pi
from sumo_adv.metrics.boxes import corners, flat, gap, half, height_as, on_grid, overlaps, pick

AVAILABLE_BRAKING_M_S2 = 8.0  # the braking of a car on a dry road
PET_SUBSTEP_COUNT = 51  # parts of a step in which PET is refined
MIN_MOVE_PER_STEP_M = 0.01  # below it a vehicle stands, and no slope can be told


def ttc(a: Boxes, b: Boxes) -> Floats:
    """Two-dimensional time to collision [s] of boxes at constant velocity and heading; 0 touching, inf never.

    Exact: with fixed headings the boxes overlap at t where on each of the four separating axes |p + u t| <= R, an
    interval in t; TTC is the start of the four intervals' intersection with t >= 0. Where roads have heights, these are
    a fifth axis: each vehicle goes on up or down as steeply as it does now.
    """
    ca, sa, cb, sb = np.cos(a.heading), np.sin(a.heading), np.cos(b.heading), np.sin(b.heading)
    dx, dy = b.x - a.x, b.y - a.y
    ux, uy = b.speed * cb - a.speed * ca, b.speed * sb - a.speed * sa
    c, s = np.abs(ca * cb + sa * sb), np.abs(sa * cb - ca * sb)
    (la, wa), (lb, wb) = half(a), half(b)
    enter: Floats = np.zeros(())
    leave: Floats = np.asarray(np.inf)
    axes = (
        (ca, sa, la + lb * c + wb * s),
        (-sa, ca, wa + lb * s + wb * c),
        (cb, sb, lb + la * c + wa * s),
        (-sb, cb, wb + la * s + wa * c),
    )
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for nx, ny, reach in axes:
            p, u = dx * nx + dy * ny, ux * nx + uy * ny
            still = np.abs(u) < 1e-12
            inside = np.abs(p) <= reach
            middle, width = -p / u, reach / np.abs(u)
            enter = np.maximum(enter, np.where(still, np.where(inside, 0.0, np.inf), middle - width))
            leave = np.minimum(leave, np.where(still, np.inf, middle + width))
        if not flat(a, b):
            p, u = np.asarray(b.z - a.z), climb(b) * b.speed - climb(a) * a.speed
            still, level = np.abs(u) < 1e-12, same_layer(p, 0.0)
            middle, width = -p / u, LAYER_HEIGHT_M / np.abs(u)
            enter = np.maximum(enter, np.where(still, np.where(level, 0.0, np.inf), middle - width))
            leave = np.minimum(leave, np.where(still, np.inf, middle + width))
    return np.where(enter <= leave, enter, np.inf)


def climb(b: Boxes) -> Floats:
    """How steeply the road rises under boxes ``(..., steps)`` that move, metres a metre; 0 where they stand."""
    if not isinstance(b.z, np.ndarray) or not b.z.ndim or b.z.shape[-1] < 2 or b.x.shape != b.z.shape:
        return np.zeros(())
    moved = np.hypot(np.gradient(b.x, axis=-1), np.gradient(b.y, axis=-1))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(moved > MIN_MOVE_PER_STEP_M, np.gradient(b.z, axis=-1) / moved, 0.0)


def drac(ego: Boxes, other: Boxes, times: Floats | None = None) -> Floats:
    """Deceleration rate to avoid the crash [m/s2]: closing speed along the ego's heading / (2 TTC); 0 if no conflict.

    For car following this is the textbook (v_e - v_l)^2 / (2 gap) (Cooper and Ferguson 1976); across headings it is
    what the ego needs to lose its closing speed before the moment of contact.  inf where the boxes touch.
    ``times``: TTC already computed.
    """
    times = ttc(ego, other) if times is None else times
    closing = np.maximum(ego.speed - other.speed * np.cos(other.heading - ego.heading), 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        rate = np.where(closing > 0, closing / (2 * times), 0.0)
    return np.where(np.isfinite(times), rate, 0.0)


def required_lateral(ego: Boxes, other: Boxes, times: Floats | None = None) -> Floats:
    """Lateral acceleration [m/s2] with which the ego just clears the other's box by the TTC (nearer side); 0 if none.

    a = 2 D / TTC^2, D the lateral shift out of the other's extent across the ego's heading at the moment of contact
    (Jansson 2005).  inf where the boxes touch.
    """
    times = ttc(ego, other) if times is None else times
    ahead = np.where(np.isfinite(times), times, 0.0)
    ce, se = np.cos(ego.heading), np.sin(ego.heading)
    turn = other.heading - ego.heading
    x = other.x - ego.x + ahead * (other.speed * np.cos(other.heading) - ego.speed * ce)
    y = other.y - ego.y + ahead * (other.speed * np.sin(other.heading) - ego.speed * se)
    (_, we), (lo, wo) = half(ego), half(other)
    shift = we + lo * np.abs(np.sin(turn)) + wo * np.abs(np.cos(turn)) - np.abs(y * ce - x * se)
    with np.errstate(divide="ignore", invalid="ignore"):
        rate = np.where(shift > 0, 2 * shift / (times * times), 0.0)
    return np.where(np.isfinite(times), rate, 0.0)


def headway(ego: Boxes, other: Boxes) -> Floats:
    """Time headway [s]: gap to what of a box lies in the ego's straight path ahead, over its speed; inf if none."""
    ce, se = np.cos(ego.heading), np.sin(ego.heading)
    dx, dy = other.x - ego.x, other.y - ego.y
    le, we = half(ego)
    corner = corners(other)
    x, y = corner[..., 0] - np.expand_dims(ego.x, -1), corner[..., 1] - np.expand_dims(ego.y, -1)
    ce, se = np.expand_dims(ce, -1), np.expand_dims(se, -1)
    ahead, left = x * ce + y * se, y * ce - x * se
    edge = np.expand_dims(np.broadcast_to(we, np.shape(dx)), -1)
    places = [np.where(np.abs(left) <= edge, ahead, np.inf)]  # corners within the path, and where sides enter it
    onward, further = np.roll(ahead, -1, axis=-1), np.roll(left, -1, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        for side in (-edge, edge):
            part = (side - left) / (further - left)
            places.append(np.where((part >= 0) & (part <= 1), ahead + part * (onward - ahead), np.inf))
        nearest = np.min(np.concatenate(places, axis=-1), axis=-1)
        centre_ahead = dx * ce[..., 0] + dy * se[..., 0] > 0
        time = np.maximum(nearest - le, 0.0) / ego.speed
    ahead_of_it = centre_ahead & np.isfinite(nearest) & (np.asarray(ego.speed) > 0)
    if not flat(ego, other):
        ahead_of_it = ahead_of_it & same_layer(other.z, ego.z + climb(ego) * np.hypot(dx, dy))
    return np.where(ahead_of_it, time, np.inf)


def btn(ego: Boxes, other: Boxes, times: Floats | None = None) -> Floats:
    """Brake threat number: :func:`drac` over ``AVAILABLE_BRAKING_M_S2``; >= 1: braking alone is too late."""
    return drac(ego, other, times) / AVAILABLE_BRAKING_M_S2


def exposure(times: Floats, threshold: float, dt: float) -> tuple[Floats, Floats]:
    """TET [s] and TIT [s2] over the last axis (Minderhoud and Bovy 2001).

    TET: time spent with TTC <= threshold; TIT: integral of (threshold - TTC) over that time.
    """
    below = times <= threshold
    deficit = np.where(below, threshold - np.where(below, times, 0.0), 0.0)
    return below.sum(axis=-1) * dt, deficit.sum(axis=-1) * dt


@dataclass(frozen=True, slots=True)
class Encroachment:
    """PET and where: ``pet`` [s] (0 = collision, inf = the swept areas never meet), ``point`` (x, y) [m] or None."""

    pet: float
    point: tuple[float, float] | None
    first: str | None  # "a" | "b": was there first


def pet(a: Track, b: Track) -> Encroachment:
    """Post-encroachment time: the least time between one vehicle leaving and the other reaching a piece of road.

    min |t_i - t_j| over all pairs of steps at which box a(t_i) overlaps box b(t_j) (Allen, Shin, Cooper 1978, for
    boxes); within the last step to a 50th of it.  For car following it is the time gap.
    """
    reach = (np.hypot(a.length, a.width) + np.hypot(b.length, b.width)) / 2
    i, j = np.nonzero(np.hypot(a.x[:, None] - b.x, a.y[:, None] - b.y) <= reach)
    touching = overlaps(pick(a.boxes(), i), pick(b.boxes(), j))
    i, j = i[touching], j[touching]
    if not len(i):
        return Encroachment(float("inf"), None, None)
    lag = b.time[j] - a.time[i]
    best = int(np.argmin(np.abs(lag)))
    i0, j0, value = int(i[best]), int(j[best]), float(lag[best])
    point = (float((a.x[i0] + b.x[j0]) / 2), float((a.y[i0] + b.y[j0]) / 2))
    if value == 0:
        return Encroachment(0.0, point, None)
    return Encroachment(
        _refined(a, b, i0, j0) if value > 0 else _refined(b, a, j0, i0), point, "a" if value > 0 else "b"
    )


def _refined(a: Track, b: Track, i: int, j: int) -> float:
    """PET inside the last step: the least lag at which the boxes overlap, a later by up to a step, b earlier, in 50ths.

    ``a`` was there first.
    """
    part = np.linspace(0.0, 1.0, PET_SUBSTEP_COUNT)
    left, leaving = _between(a, i, min(i + 1, len(a.time) - 1), part[:, None])
    arrived, coming = _between(b, j, max(j - 1, 0), part)
    return max(float(np.where(overlaps(leaving, coming), arrived - left, np.inf).min()), 0.0)


def _between(track: Track, start: int, stop: int, part: Floats) -> tuple[Floats, Boxes]:
    """Time and boxes between two steps of a track, at the given parts of the way."""
    turn = wrap_below_pi(np.asarray(track.heading[stop] - track.heading[start]))
    time, x, y, speed = (v[start] + part * (v[stop] - v[start]) for v in (track.time, track.x, track.y, track.speed))
    z = height_as(track, lambda z: z[start] + part * (z[stop] - z[start]))
    return time, Boxes(x, y, track.heading[start] + part * turn, speed, track.length, track.width, z)


CRITICALITY_COLUMNS = ("ttc", "gap", "centre_distance", "drac", "btn", "headway", "required_lateral")


def series(ego: Track, others: Sequence[Track]) -> dict[str, Floats]:
    """Measures of the ego against every other vehicle over the ego's steps: each of ``CRITICALITY_COLUMNS`` as ``(n,
    steps)``.

    Plus ``time`` ``(steps,)`` [s].  Rows are in the order of ``others``; where a vehicle is not there TTC, gap, headway
    and centre distance are inf and the rates 0.
    """
    own, them = ego.boxes(), on_grid(others, ego.time)
    times = ttc(own, them)
    absent = np.isnan(them.x)
    return {
        "time": ego.time,
        "ttc": times,
        "gap": np.where(absent, np.inf, gap(own, them)),
        "centre_distance": np.where(absent, np.inf, np.hypot(them.x - own.x, them.y - own.y)),
        "drac": drac(own, them, times),
        "btn": btn(own, them, times),
        "headway": headway(own, them),
        "required_lateral": required_lateral(own, them, times),
    }
