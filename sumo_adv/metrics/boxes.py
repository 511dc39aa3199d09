"""Oriented boxes: corners, overlap, distance, and first contact between recorded steps.

Overlap uses the separating-axis theorem in closed form (Gottschalk, Lin, Manocha 1996). |cos| and |sin| of the relative
heading give the extent of one box along an axis of the other, so no corners are needed. Swept contact uses conservative
advancement (Mirtich 1996) with a bound for each axis. Boxes that do not turn are solved in one or two iterations.

Boxes that touch overlap. An absent vehicle is NaN and is never in contact.

Height is a fifth axis: two boxes are apart if the roads under them differ in height by more than ``LAYER_HEIGHT_M``, as
on a bridge and below it. This check costs nothing if all roads are flat.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sumo_adv.datatypes import Bools, Boxes, Floats, Ints, Track
from sumo_adv.geometry import LAYER_HEIGHT_M, wrap_below_pi

MIN_ADVANCE_SHARE = 1e-3  # -, share of one interval: 0.1 ms of a 0.1 s step
TOUCHING_DISTANCE_M = 1e-9  # boxes nearer than this touch
Half = tuple[Floats | float, Floats | float]
"""Half the length and half the width of a box [m]."""


def half(b: Boxes) -> Half:
    """Return half the length and half the width [m]."""
    return b.length / 2, b.width / 2


def corners(b: Boxes) -> Floats:
    """Return the corners of boxes.

    Args:
        b: The boxes, arrays ``(...)``.

    Returns:
        The corners ``(..., 4, 2)`` [m]: front left, rear left, rear right, front right (counter-clockwise).
    """
    c, s = np.cos(b.heading), np.sin(b.heading)
    along, across = half(b)
    x = [b.x + i * along * c - j * across * s for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    y = [b.y + i * along * s + j * across * c for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    return np.stack([np.stack(np.broadcast_arrays(*x), -1), np.stack(np.broadcast_arrays(*y), -1)], -1)


def sat(
    dx: Floats, dy: Floats, ca: Floats, sa: Floats, cb: Floats, sb: Floats, half_a: Half, half_b: Half
) -> tuple[Floats, Floats, Floats, Floats]:
    """Compute the signed separations of two boxes along their four axes.

    Args:
        dx: Centre of b seen from a, in x [m].
        dy: Centre of b seen from a, in y [m].
        ca: Cosine of a's heading.
        sa: Sine of a's heading.
        cb: Cosine of b's heading.
        sb: Sine of b's heading.
        half_a: Half the length and half the width of a [m].
        half_b: Half the length and half the width of b [m].

    Returns:
        The separations [m] along a's length, a's width, b's length and b's width. All are <= 0 if the boxes overlap.
    """
    c, s = np.abs(ca * cb + sa * sb), np.abs(sa * cb - ca * sb)
    (la, wa), (lb, wb) = half_a, half_b
    return (
        np.abs(dx * ca + dy * sa) - (la + lb * c + wb * s),
        np.abs(dy * ca - dx * sa) - (wa + lb * s + wb * c),
        np.abs(dx * cb + dy * sb) - (lb + la * c + wa * s),
        np.abs(dy * cb - dx * sb) - (wb + la * s + wa * c),
    )


def axis_separations(a: Boxes, b: Boxes) -> tuple[Floats, Floats, Floats, Floats]:
    """Apply :func:`sat` to boxes."""
    ca, sa, cb, sb = np.cos(a.heading), np.sin(a.heading), np.cos(b.heading), np.sin(b.heading)
    return sat(b.x - a.x, b.y - a.y, ca, sa, cb, sb, half(a), half(b))


def separation(a: Boxes, b: Boxes) -> Floats:
    """Return the largest of the axis separations [m].

    It is above 0 if the boxes are apart, and then a lower bound of :func:`gap`. It is <= 0 if they overlap.
    """
    along_a, across_a, along_b, across_b = axis_separations(a, b)
    apart = np.maximum(np.maximum(along_a, across_a), np.maximum(along_b, across_b))
    return apart if flat(a, b) else np.maximum(apart, np.abs(a.z - b.z) - LAYER_HEIGHT_M)


def flat(a: Boxes, b: Boxes) -> bool:
    """Return whether heights can be ignored because all boxes have one and the same height."""
    return not np.ndim(a.z) and not np.ndim(b.z) and a.z == b.z


def height_as(b: Boxes | Track, change: Callable[[Floats], Floats]) -> Floats | float:
    """Change the heights of boxes or a track in the way in which their positions are changed.

    Args:
        b: The boxes or the track.
        change: Is applied to the heights, broadcast to the shape of the positions.

    Returns:
        The changed heights; a height that is a single number stays as it is.
    """
    return change(np.broadcast_to(b.z, b.x.shape)) if np.ndim(b.z) else b.z


def overlaps(a: Boxes, b: Boxes) -> Bools:
    """Return whether the boxes touch or overlap. The test is exact and covers the broadcast shape."""
    return np.asarray(separation(a, b) <= 0)


def touching(a: Boxes, b: Boxes) -> Bools:
    """Return the same as :func:`overlaps`, but faster if few boxes are near each other.

    Args:
        a: Boxes.
        b: Boxes with positions of the same shape as those of ``a``.
    """
    near = np.asarray(np.hypot(a.x - b.x, a.y - b.y) < half_diagonal(a) + half_diagonal(b))
    touches = np.zeros(near.shape, bool)
    k = np.nonzero(near)
    if len(k[0]):
        touches[k] = overlaps(pick(a, k), pick(b, k))
    return touches


def half_diagonal(b: Boxes) -> Floats:
    """Return the distance of the corners from the centre [m], in the shape of the sizes."""
    return np.asarray(np.hypot(np.asarray(b.length, float), np.asarray(b.width, float)) / 2)


def pick(b: Boxes, k: Any) -> Boxes:
    """Return the boxes at an index of their positions.

    Args:
        b: The boxes.
        k: Any numpy index into the positions.

    Returns:
        The boxes. Their sizes have the shape of the positions.
    """
    length, width = (np.broadcast_to(np.asarray(v, float), b.x.shape)[k] for v in (b.length, b.width))
    return Boxes(b.x[k], b.y[k], b.heading[k], b.speed[k], length, width, height_as(b, lambda z: z[k]))


def some_steps(b: Boxes, steps: slice) -> Boxes:
    """Return the same boxes ``(..., steps)`` at some of the steps."""
    x, y, heading, speed = (v[..., steps] for v in (b.x, b.y, b.heading, b.speed))
    return Boxes(x, y, heading, speed, b.length, b.width, height_as(b, lambda z: z[..., steps]))


def gap(a: Boxes, b: Boxes) -> Floats:
    """Return the exact distance between the boxes [m], 0 if they overlap.

    It is the minimum distance from a corner of either box to the other box.
    """
    least = np.minimum(_corner_distance(a, b), _corner_distance(b, a))
    if flat(a, b):
        return np.where(overlaps(a, b), 0.0, np.sqrt(least))
    least = np.where(overlaps(replace(a, z=0.0), replace(b, z=0.0)), 0.0, least)
    return np.sqrt(least + np.maximum(np.abs(a.z - b.z) - LAYER_HEIGHT_M, 0.0) ** 2)


def _corner_distance(a: Boxes, b: Boxes) -> Floats:
    """Return the minimum squared distance [m2] from a corner of b to the box a."""
    ca, sa = np.cos(a.heading), np.sin(a.heading)
    turn = b.heading - a.heading
    c, s = np.cos(turn), np.sin(turn)
    dx, dy = b.x - a.x, b.y - a.y
    px, py = dx * ca + dy * sa, dy * ca - dx * sa
    (la, wa), (lb, wb) = half(a), half(b)
    least = np.asarray(np.inf)
    for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        x = np.maximum(np.abs(px + i * lb * c - j * wb * s) - la, 0.0)
        y = np.maximum(np.abs(py + i * lb * s + j * wb * c) - wa, 0.0)
        least = np.minimum(least, x * x + y * y)
    return least


def sweep(a: Boxes, b: Boxes) -> Floats:
    """Find the first contact inside each interval between consecutive steps.

    Positions and headings are linear between steps; headings turn the shorter way. A contact that lasts longer than a
    thousandth of the interval is always found, and no contact is found that does not exist.

    Args:
        a: Boxes, arrays ``(..., n)``.
        b: Boxes, arrays ``(..., n)``.

    Returns:
        The time of the contact as a fraction in [0, 1] of the interval ``(..., n - 1)``; inf if there is no contact.
    """
    near, motion = _near_intervals(a, b)
    out = np.full(near.shape, np.inf)
    if near.any():
        out[near] = _advance(motion, np.arange(len(motion[0])))
    return out


def touches(a: Boxes, b: Boxes) -> Bools:
    """Return whether the boxes touch at any time between the first step and the last one; see :func:`sweep`.

    The result keeps the leading axes. The function is faster than :func:`first_contact`.
    """
    near, motion = _near_intervals(a, b)
    touched = np.zeros(near.shape[:-1], bool)
    if near.any():
        row = np.nonzero(near.reshape(-1, near.shape[-1]))[0]
        touched.ravel()[row[np.isfinite(_advance(motion, row))]] = True
    return touched


def _near_intervals(a: Boxes, b: Boxes) -> tuple[Bools, list[Floats]]:
    """Find the intervals ``(..., n - 1)`` in which a contact is possible; return them and their motions ``(k,)``."""
    shape = np.broadcast_shapes(*(np.shape(v) for box in (a, b) for v in (box.x, box.y, box.heading)))
    steps = (np.broadcast_to(v, shape) for v in (b.x - a.x, b.y - a.y, a.heading, b.heading))
    (x0, x1), (y0, y1), (ha, ha1), (hb, hb1) = ((v[..., :-1], v[..., 1:]) for v in steps)
    sizes = [np.broadcast_to(v, shape)[..., :-1] for v in (*half(a), *half(b))]
    reach = np.hypot(sizes[0], sizes[1]) + np.hypot(sizes[2], sizes[3])
    vx, vy = x1 - x0, y1 - y0
    square = vx * vx + vy * vy
    nearest = np.clip(-(x0 * vx + y0 * vy) / np.where(square > 0, square, 1.0), 0.0, 1.0)
    near = np.hypot(x0 + nearest * vx, y0 + nearest * vy) <= reach
    if not flat(a, b):
        near &= _level_steps(np.broadcast_to(np.abs(b.z - a.z), shape))
    motion = (x0, y0, vx, vy, ha, wrap_below_pi(ha1 - ha), hb, wrap_below_pi(hb1 - hb), *sizes)
    return near, [v[near] for v in motion]


def _level_steps(dz: Floats) -> Bools:
    """Find the steps at either end of which two vehicles are on one layer, for height differences ``(..., n)`` [m]."""
    return np.asarray(np.minimum(dz[..., :-1], dz[..., 1:]) <= LAYER_HEIGHT_M)


def _advance(motion: list[Floats], group: Ints) -> Floats:
    """Advance ``(k,)`` intervals conservatively; see :func:`sweep`.

    Once an interval has a contact, the others of the same ``group`` ``(k,)`` are not advanced further.
    """
    contact, done = np.full(len(group), np.inf), np.zeros(group.max() + 1, bool)
    active = np.arange(len(contact))
    at = np.zeros(len(contact))
    while active.size:
        separated, safe = _safe_step(at, motion)
        contact[active[~separated]] = at[~separated]
        done[group[active[~separated]]] = True
        go_on = ~done[group[active]] & (at < 1.0) & (at + safe <= 1.0 + 1e-12)
        active, motion = active[go_on], [v[go_on] for v in motion]
        at = np.minimum(at[go_on] + np.maximum(safe[go_on], MIN_ADVANCE_SHARE), 1.0)
    return contact


def _safe_step(at: Floats, motion: list[Floats]) -> tuple[Bools, Floats]:
    """Return whether the boxes are apart at fraction ``at``, and for which further fraction they surely stay apart."""
    x0, y0, vx, vy, ha, da, hb, db, la, wa, lb, wb = motion
    dx, dy, speed = x0 + at * vx, y0 + at * vy, np.hypot(vx, vy)
    ca, sa, cb, sb = np.cos(ha + at * da), np.sin(ha + at * da), np.cos(hb + at * db), np.sin(hb + at * db)
    far = np.maximum(np.hypot(dx, dy), np.hypot(x0 + vx, y0 + vy))
    turning = np.abs(db - da)
    rates = []
    for c, s, own_turn, reach_of_other in ((ca, sa, da, np.hypot(lb, wb)), (cb, sb, db, np.hypot(la, wa))):
        extra = np.abs(own_turn) * (speed * (1 - at) + far) + turning * reach_of_other
        rates.append(extra - np.sign(dx * c + dy * s) * (vx * c + vy * s))
        rates.append(extra - np.sign(dy * c - dx * s) * (vy * c - vx * s))
    apart = np.zeros(len(at), dtype=bool)
    safe = np.zeros(len(at))
    for distance, rate in zip(sat(dx, dy, ca, sa, cb, sb, (la, wa), (lb, wb)), rates, strict=True):
        positive = distance > TOUCHING_DISTANCE_M
        apart |= positive
        with np.errstate(over="ignore"):  # a rate near 0 gives inf, which is right
            step = np.where(rate > 0, distance / np.where(rate > 0, rate, 1.0), np.inf)
        safe = np.where(positive, np.maximum(safe, step), safe)
    return apart, safe


def first_contact(a: Boxes, b: Boxes, time: Floats) -> Floats:
    """Find the first contact over the last axis.

    Args:
        a: Boxes, arrays ``(..., n)``.
        b: Boxes, arrays ``(..., n)``.
        time: Times of the steps ``(n,)`` [s].

    Returns:
        The time of the first contact ``(...)`` [s]; inf if there is none.
    """
    if len(time) == 1:
        return np.where(overlaps(a, b)[..., 0], time[0], np.inf)
    fractions = sweep(a, b)
    when = np.where(np.isfinite(fractions), time[:-1] + fractions * np.diff(time), np.inf)
    return np.asarray(when.min(axis=-1))


def row_of(track: Track) -> Boxes:
    """Return a track as one row of boxes, ``(1, n)``."""
    x, y, heading, speed = (v[None] for v in (track.x, track.y, track.heading, track.speed))
    return Boxes(x, y, heading, speed, track.length, track.width, height_as(track, lambda z: z[None]))


def at_time(track: Track, when: float) -> Boxes:
    """Return the box of a track at one time, as 0-d arrays.

    Args:
        track: The track. It is linear between steps; headings turn the shorter way.
        when: The time [s].
    """
    turns = np.unwrap(track.heading)
    x, y, heading, speed = (np.asarray(np.interp(when, track.time, v)) for v in (track.x, track.y, turns, track.speed))
    z = height_as(track, lambda z: np.asarray(np.interp(when, track.time, z)))
    return Boxes(x, y, heading, speed, track.length, track.width, z)


def between_steps(b: Boxes, step: Ints, share: Floats) -> Boxes:
    """Interpolate boxes within a step of each motion.

    Positions, speeds and heights are linear; headings turn the shorter way.

    Args:
        b: n motions, arrays ``(n, steps)``.
        step: The step at which each interval ends ``(n,)``. Before step 0, the motion stays at its first state.
        share: Where in the interval, ``(n,)`` in [0, 1].

    Returns:
        The boxes ``(n,)``.
    """
    rows = np.arange(len(step))
    before, after = pick(b, (rows, np.maximum(step - 1, 0))), pick(b, (rows, step))
    x, y, speed = (
        p + share * (q - p) for p, q in ((before.x, after.x), (before.y, after.y), (before.speed, after.speed))
    )
    heading = before.heading + share * wrap_below_pi(after.heading - before.heading)
    return Boxes(x, y, heading, speed, after.length, after.width, before.z + share * (after.z - before.z))


def on_grid(tracks: Sequence[Track], time: Floats) -> Boxes:
    """Put tracks on one time grid.

    Args:
        tracks: The tracks. They must lie on the same regular grid. Each may begin and end anywhere and leave out steps.
        time: The grid's times [s].

    Returns:
        Boxes ``(len(tracks), len(time))``; NaN at the times at which a vehicle is absent.
    """
    regular = (times for times in (time, *(track.time for track in tracks)) if len(times) > 1)
    step = next((times[1] - times[0] for times in regular), 1.0)
    raised = any(np.ndim(track.z) for track in tracks)
    state = np.full((5 if raised else 4, len(tracks), len(time)), np.nan)
    for row, track in enumerate(tracks):
        if not len(track.time):
            continue
        first = int(np.rint((track.time[0] - time[0]) / step))
        columns = [track.x, track.y, track.heading, track.speed]
        if raised:
            columns.append(np.broadcast_to(track.z, track.x.shape))
        if track.time[-1] - track.time[0] > (len(track.time) - 0.5) * step:  # the vehicle was absent for some steps
            at = np.rint((track.time - time[0]) / step).astype(np.intp)
            there = (at >= 0) & (at < len(time))
            for values, column in zip(state, columns, strict=True):
                values[row, at[there]] = column[there]
            continue
        low, high = max(first, 0), min(first + len(track.time), len(time))
        if high > low:
            for values, column in zip(state, columns, strict=True):
                values[row, low:high] = column[low - first : high - first]
    length, width = (np.array([getattr(t, name) for t in tracks]).reshape(-1, 1) for name in ("length", "width"))
    x, y, heading, speed = state[:4]
    return Boxes(x, y, heading, speed, length, width, state[4] if raised else 0.0)
