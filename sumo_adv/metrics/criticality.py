"""Measure how close a conflict was: TTC, PET, DRAC and related measures, on arrays. ``inf`` means never.

Everything broadcasts: an ego ``(time,)`` against vehicles ``(n, time)`` gives ``(n, time)``. All units are SI.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Boxes, Floats, Track
from sumo_adv.geometry import LAYER_HEIGHT_M, same_layer, wrap_below_pi
from sumo_adv.metrics.boxes import corners, flat, gap, half, height_as, on_grid, overlaps, pick

AVAILABLE_BRAKING_M_S2 = 8.0  # the braking of a car on a dry road
PET_SUBSTEP_COUNT = 51  # samples of a step with which PET is refined
MIN_MOVE_PER_STEP_M = 0.01  # a vehicle that moves less stands, so it shows no slope


def ttc(a: Boxes, b: Boxes) -> Floats:
    """Compute the two-dimensional time to collision of boxes at constant velocity and heading.

    The result is exact. With fixed headings, the boxes overlap at t if |p + u t| <= R on each of the four separating
    axes, which is an interval in t. TTC is the start of the intersection of the four intervals with t >= 0. If roads
    have heights, these are a fifth axis: each vehicle continues up or down as steeply as it does now.

    Args:
        a: Boxes.
        b: Boxes.

    Returns:
        The TTC [s]; 0 if the boxes touch, inf if they never do.
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
    """Return the slope of the road under moving boxes.

    Args:
        b: Boxes ``(..., steps)``.

    Returns:
        The rise in metres per metre; 0 if a vehicle stands or the road has no heights.
    """
    if not isinstance(b.z, np.ndarray) or not b.z.ndim or b.z.shape[-1] < 2 or b.x.shape != b.z.shape:
        return np.zeros(())
    moved = np.hypot(np.gradient(b.x, axis=-1), np.gradient(b.y, axis=-1))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(moved > MIN_MOVE_PER_STEP_M, np.gradient(b.z, axis=-1) / moved, 0.0)


def drac(ego: Boxes, other: Boxes, times: Floats | None = None) -> Floats:
    """Compute the deceleration rate to avoid a crash (DRAC).

    DRAC is the closing speed along the ego's heading / (2 TTC). For car following, this is the textbook formula
    (v_e - v_l)^2 / (2 gap) (Cooper and Ferguson 1976). For other headings, it is the deceleration with which the ego
    loses its closing speed before the moment of contact.

    Args:
        ego: The ego's boxes.
        other: The other boxes.
        times: The TTC, if it is known already [s].

    Returns:
        The rate [m/s2]; 0 if there is no conflict, inf if the boxes touch.
    """
    times = ttc(ego, other) if times is None else times
    closing = np.maximum(ego.speed - other.speed * np.cos(other.heading - ego.heading), 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        rate = np.where(closing > 0, closing / (2 * times), 0.0)
    return np.where(np.isfinite(times), rate, 0.0)


def required_lateral(ego: Boxes, other: Boxes, times: Floats | None = None) -> Floats:
    """Compute the lateral acceleration with which the ego just clears the other box by the TTC, on the nearer side.

    a = 2 D / TTC^2. D is the lateral shift out of the other box's extent across the ego's heading at the moment of
    contact (Jansson 2005).

    Args:
        ego: The ego's boxes.
        other: The other boxes.
        times: The TTC, if it is known already [s].

    Returns:
        The acceleration [m/s2]; 0 if there is no conflict, inf if the boxes touch.
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
    """Compute the time headway: the gap to the part of a box in the ego's straight path ahead, over the ego's speed.

    Returns:
        The headway [s]; inf if nothing lies in the path, or the ego stands.
    """
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
    """Compute the brake threat number: :func:`drac` over ``AVAILABLE_BRAKING_M_S2``.

    From 1 on, braking alone is too late.
    """
    return drac(ego, other, times) / AVAILABLE_BRAKING_M_S2


def exposure(times: Floats, threshold: float, dt: float) -> tuple[Floats, Floats]:
    """Compute TET and TIT over the last axis (Minderhoud and Bovy 2001).

    Args:
        times: The TTC at each step [s].
        threshold: The TTC up to which a step counts [s].
        dt: Step [s].

    Returns:
        TET, the time spent with TTC <= threshold [s], and TIT, the integral of (threshold - TTC) over that time [s2].
    """
    below = times <= threshold
    deficit = np.where(below, threshold - np.where(below, times, 0.0), 0.0)
    return below.sum(axis=-1) * dt, deficit.sum(axis=-1) * dt


@dataclass(frozen=True, slots=True)
class Encroachment:
    """The post-encroachment time and its place.

    Attributes:
        pet: The post-encroachment time [s]; 0 = collision, inf = the swept areas never meet.
        point: Where the swept areas meet, (x, y) [m]; None if they do not.
        first: Which vehicle was there first; None in a collision or if the areas never meet.
    """

    pet: float
    point: tuple[float, float] | None
    first: str | None  # "a" | "b"


def pet(a: Track, b: Track) -> Encroachment:
    """Compute the post-encroachment time: the minimum time between one vehicle leaving and the other reaching a place.

    It is min |t_i - t_j| over all pairs of steps at which box a(t_i) overlaps box b(t_j) (Allen, Shin, Cooper 1978, for
    boxes), refined to a 50th of the last step. For car following, it is the time gap.
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
    """Refine the PET inside the last step: the minimum lag at which the boxes overlap, in 50ths of a step.

    ``a`` was there first. It is up to a step later, and ``b`` up to a step earlier.
    """
    part = np.linspace(0.0, 1.0, PET_SUBSTEP_COUNT)
    left, leaving = _between(a, i, min(i + 1, len(a.time) - 1), part[:, None])
    arrived, coming = _between(b, j, max(j - 1, 0), part)
    return max(float(np.where(overlaps(leaving, coming), arrived - left, np.inf).min()), 0.0)


def _between(track: Track, start: int, stop: int, part: Floats) -> tuple[Floats, Boxes]:
    """Return the time and the boxes between two steps of a track, at the given parts of the way."""
    turn = wrap_below_pi(np.asarray(track.heading[stop] - track.heading[start]))
    time, x, y, speed = (v[start] + part * (v[stop] - v[start]) for v in (track.time, track.x, track.y, track.speed))
    z = height_as(track, lambda z: z[start] + part * (z[stop] - z[start]))
    return time, Boxes(x, y, track.heading[start] + part * turn, speed, track.length, track.width, z)


CRITICALITY_COLUMNS = ("ttc", "gap", "centre_distance", "drac", "btn", "headway", "required_lateral")


def series(ego: Track, others: Sequence[Track]) -> dict[str, Floats]:
    """Compute measures of the ego against every other vehicle over the ego's steps.

    Args:
        ego: The ego's track.
        others: The other tracks.

    Returns:
        Each of ``CRITICALITY_COLUMNS`` as ``(n, steps)``, in the order of ``others``, and ``time`` ``(steps,)`` [s]. If
        a vehicle is absent, its TTC, gap, headway and centre distance are inf and its rates 0.
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
