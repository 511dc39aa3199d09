"""The candidates of lattice drivers and their costs: each motion along the path with each motion sideways.

Sideways: quintic polynomials from the present offset, its rate and its second derivative to an offset that is then kept
(Werling et al. 2010, "Optimal trajectory generation for dynamic street scenarios in a Frenet frame").

Along: ordinary driving (the reference), and accelerations that are ramped to and held, until standstill or the maximum
speed. Quartics towards a speed, as in the paper, would be too slow in an emergency.

A contact costs more the sooner and the faster it is. A far contact therefore leads to gentle braking, and a near one to
anything that avoids it. Boxes are compared along the path's axes; a box at an angle to them counts as a larger box.

Arrays are ``(n, along, time)`` and ``(n, aside, time)`` for the candidates of ``n`` egos.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from sumo_adv.datatypes import Bools, Floats, Ints
from sumo_adv.drivers.lattice import COMPARED_STEP_S, Expected, LatticeEgos, LatticeSettings, Size
from sumo_adv.geometry import quintics

MOVE_DURATIONS_S = (1.2, 2.0, 3.0)  # durations of a move sideways
MIN_MOVE_REMAINDER_S = 0.5  # minimum remaining time of a move
LATERAL_OFFSETS_M = (-1.5, -1.0, -0.5, 0.5, 1.0, 1.5)  # from the lane's centre
BRAKING_LEVELS_M_S2 = (2.0, 4.0)  # comfortable, hard; the emergency brake is a setting
PEDAL_JERK_M_S3 = 20.0  # how fast pedals act
CONTACT_COST, CONTACT_SOON_S, CONTACT_FADE_S = 1000.0, 1.5, 0.8
NEAR_COST_1_S, CLOSE_COST_1_S, NEAR_FADE_S = 60.0, 6.0, 1.5  # within these margins around a vehicle
CONTACT_MARGINS_M = (0.3, 0.15)  # along, across
NEAR_MARGINS_M = (1.0, 0.3)
CLOSE_MARGINS_M, CLOSE_MARGIN_HEADWAY_S = (1.5, 0.6), 0.2  # the margin along grows with speed
OFF_ROAD_COST_1_M = 800.0
SLOWER_COST, FASTER_COST = 0.5, 4.0  # 1/(m/s)2, mean square deviation from the reference
BRAKING_COST, LATERAL_JERK_COST, LATERAL_ACCELERATION_COST = 0.2, 0.02, 0.05
TARGET_OFFSET_COST, MEAN_OFFSET_COST, TARGET_CHANGE_COST = 0.5, 4.0, 0.5  # 1/m2; change: from the last target
OTHER_LANE_COST = 8.0
MAX_LATERAL_SLOPE, SLOPE_COST = 0.3, 20.0  # -, (s/m)2: a car moves sideways by at most that share of its way
GRIP_M_S2, SLIDING_COST = 8.5, 40.0  # m/s2, 1/(m/s2): beyond the friction circle
BYTE_BITS = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1)  # of each byte, the highest first
FIRST_SET_BIT = np.where(BYTE_BITS.any(axis=1), BYTE_BITS.argmax(axis=1), 1 << 20)  # a large number if none is set


class Space(NamedTuple):
    """Where egos may go.

    Attributes:
        offsets: Target offsets ``(k,)`` [m].
        half: Half the width of the egos' lanes ``(n,)`` [m].
        right: Right edge, including the lanes beside the ego's, ``(n,)`` [m].
        left: Left edge, including the lanes beside the ego's, ``(n,)`` [m].
        until: How far ahead the lanes beside lead ``(n,)`` [m].
    """

    offsets: Floats
    half: Floats
    right: Floats
    left: Floats
    until: Floats

    @staticmethod
    def between(half: Floats, sides: Sequence[Sequence[float]], until: Floats, width: float) -> Space:
        """Return the space of egos.

        The targets are those of the first ego: the lane's centre, steps aside within the edges, and ``sides``.

        Args:
            half: Half the width of the egos' lanes ``(n,)`` [m].
            sides: Centres of the lanes beside each ego's lane, as offsets [m].
            until: How far ahead the lanes beside lead ``(n,)`` [m].
            width: Width of the egos [m].
        """
        right, left = (np.array([edge((0.0, *s)) for s in sides]) for edge in (min, max))
        right, left = right - half, left + half
        steps = [d for d in LATERAL_OFFSETS_M if right[0] + width / 2 <= d <= left[0] - width / 2]
        return Space(np.array([0.0, *steps, *sides[0]]), half, right, left, until)


class LongitudinalCandidates(NamedTuple):
    """Candidates along the path, the reference first. Arrays are ``(n, along, time)``.

    Attributes:
        s: Station [m].
        v: Speed [m/s].
        a: Acceleration [m/s2].
    """

    s: Floats
    v: Floats
    a: Floats


class Aside(NamedTuple):
    """Candidates sideways.

    Attributes:
        d: Offset ``(n, aside, time)`` [m].
        rate: First derivative of the offset ``(n, aside, time)`` [m/s].
        second: Second derivative of the offset ``(n, aside, time)`` [m/s2].
        target: Target offset ``(n, aside)`` [m].
        duration: Duration of the move ``(n, aside)`` [s].
        jerk: Integral of the square of the third derivative ``(n, aside)`` [m2/s5].
    """

    d: Floats
    rate: Floats
    second: Floats
    target: Floats
    duration: Floats
    jerk: Floats


class Chosen(NamedTuple):
    """The cheapest candidates.

    Attributes:
        along: Index of the candidate along the path (0: the reference), ``(n,)``.
        acceleration: Acceleration one step from now ``(n,)`` [m/s2].
        second: Second derivative of the offset one step from now ``(n,)`` [m/s2].
        target: Target offset ``(n,)`` [m].
        duration: Duration of the move sideways ``(n,)`` [s].
        s: Stations by time ``(n, time)`` [m].
        d: Offsets by time ``(n, time)`` [m].
    """

    along: Ints
    acceleration: Floats
    second: Floats
    target: Floats
    duration: Floats
    s: Floats
    d: Floats

    def offset_after(self, ahead: Floats) -> Floats:
        """Return the offsets of the chosen motions at places ahead.

        Args:
            ahead: Distance of the places from the present stations ``(n,)`` [m].

        Returns:
            The offsets ``(n,)`` [m].
        """
        way = self.s - self.s[:, :1] + 1e-6 * COMPARED_STEP_S * np.arange(self.s.shape[1])  # grows even at standstill
        reached = way >= ahead[:, None]
        k = np.where(reached.any(axis=1), np.maximum(reached.argmax(axis=1), 1), way.shape[1] - 1)
        rows = np.arange(len(way))
        before, after = way[rows, k - 1], way[rows, k]
        w = np.clip((ahead - before) / np.maximum(after - before, 1e-6), 0.0, 1.0)
        return np.asarray(self.d[rows, k - 1] * (1 - w) + self.d[rows, k] * w)


def choose(
    egos: LatticeEgos, size: Size, reference: Floats, fastest: Floats, others: Expected, space: Space,
    settings: LatticeSettings, dt: float, curvature: Callable[[Floats], Floats] | None = None,
) -> Chosen:  # fmt: skip
    """Return the cheapest candidates.

    Args:
        egos: The egos.
        size: Their size.
        reference: Accelerations of ordinary driving ``(n, time)`` [m/s2].
        fastest: Maximum speeds ``(n,)`` [m/s].
        others: The expected vehicles.
        space: Where the egos may go.
        settings: The driver's settings.
        dt: Step [s].
        curvature: Returns the curvature [1/m] of the paths at stations; None if they are straight.
    """
    times = settings.times
    on = longitudinal_candidates(egos, reference, fastest, settings)
    off = lateral_candidates(egos, space.offsets, times)
    bend = None if curvature is None else curvature(on.s)
    costs = _comfort(off, egos, space)[:, None] + _pace(on)[:, :, None]
    costs = costs + _off_road(off, on, egos, size, space, times)[:, None] + _physics(on, off, bend)
    costs = costs + _meetings(on, off, others, size, times)
    rows, count = np.arange(len(egos.s)), costs.shape[2]
    best = costs.reshape(len(rows), -1).argmin(axis=1)
    k, j = best // count, best % count
    a, second = _after(on.a[rows, k], dt), _after(off.second[rows, j], dt)
    return Chosen(
        k, np.where(k == 0, reference[:, 0], a), second, off.target[rows, j], off.duration[rows, j], on.s[rows, k],
        off.d[rows, j],
    )  # fmt: skip


def longitudinal_candidates(
    egos: LatticeEgos, reference: Floats, fastest: Floats, settings: LatticeSettings
) -> LongitudinalCandidates:
    """Return the candidates along the path.

    They are the reference, keeping the speed, accelerating up to ``fastest`` [m/s], and three brakings.
    """
    times, accelerate = settings.times, np.where(egos.speed < fastest, settings.idm.accel, 0.0)
    aims = np.zeros((len(fastest), 5, 1))
    aims[:, 1, 0], aims[:, 2:, 0] = accelerate, [*(-b for b in BRAKING_LEVELS_M_S2), -settings.braking]
    start = egos.acceleration[:, None, None]
    pressed = PEDAL_JERK_M_S3 * times
    pedals = np.concatenate([reference[:, None], start + np.clip(aims - start, -pressed, pressed)], axis=1)
    v = np.maximum(egos.speed[:, None, None] + _summed(pedals), 0.0)
    v[:, 2] = np.minimum(v[:, 2], np.maximum(fastest, egos.speed)[:, None])
    return LongitudinalCandidates(egos.s[:, None, None] + _summed(v), v, pedals)


def lateral_candidates(egos: LatticeEgos, offsets: Floats, times: Floats) -> Aside:
    """Return the candidates sideways.

    They go to each of ``offsets`` [m] in each of ``MOVE_DURATIONS_S``; the last one is the rest of the present move.
    """
    count = len(MOVE_DURATIONS_S) * len(offsets)
    target, duration = np.empty((2, len(egos.d), count + 1))
    target[:, :-1] = np.repeat(offsets, len(MOVE_DURATIONS_S))
    duration[:, :-1] = np.tile(MOVE_DURATIONS_S, len(offsets))
    target[:, -1], duration[:, -1] = egos.target, np.maximum(egos.left, MIN_MOVE_REMAINDER_S)
    start = (egos.d[:, None], egos.rate[:, None], egos.second[:, None])
    d, rate, second, jerk = quintics(start, target, duration, times)
    return Aside(d, rate, second, target, duration, jerk)


def _summed(values: Floats) -> Floats:
    """Integrate by time (the last axis), with trapezia from 0."""
    result = np.zeros_like(values)
    np.cumsum((values[..., 1:] + values[..., :-1]) * (COMPARED_STEP_S / 2), axis=-1, out=result[..., 1:])
    return result


def _after(values: Floats, dt: float) -> Floats:
    """Return ``values``, ``(n, time)``, at ``dt`` [s] from now."""
    at = min(dt / COMPARED_STEP_S, values.shape[1] - 1.0)
    k = min(int(at), values.shape[1] - 2)
    return np.asarray(values[:, k] * (k + 1 - at) + values[:, k + 1] * (at - k))


def _comfort(off: Aside, egos: LatticeEgos, space: Space) -> Floats:
    here = np.abs(off.target) < space.half[:, None]
    offset = TARGET_OFFSET_COST * off.target**2 + MEAN_OFFSET_COST * (off.d**2).mean(axis=2)
    away = np.where(here, offset, OTHER_LANE_COST)
    change = TARGET_CHANGE_COST * np.minimum((off.target - egos.target[:, None]) ** 2, 4.0)
    sideways = LATERAL_ACCELERATION_COST * (off.second**2).mean(axis=2)
    return np.asarray(away + change + LATERAL_JERK_COST * off.jerk + sideways)


def _pace(on: LongitudinalCandidates) -> Floats:
    slower, faster = np.maximum(on.v[:, :1] - on.v, 0.0), np.maximum(on.v - on.v[:, :1], 0.0)
    braking = BRAKING_COST * np.minimum(on.a, 0.0) ** 2
    braking[:, 0] = 0.0  # the reference brakes where it must, not by choice
    return np.asarray((SLOWER_COST * slower**2 + FASTER_COST * faster**2 + braking).mean(axis=2))


def _turned(off: Aside, on: LongitudinalCandidates) -> Floats:
    """Return the heading [rad] against the path that the candidate has at the speeds of the reference."""
    return np.asarray(np.minimum(np.abs(off.rate) / np.maximum(on.v[:, :1], 3.0), 0.4))


def _off_road(
    off: Aside, on: LongitudinalCandidates, egos: LatticeEgos, size: Size, space: Space, times: Floats
) -> Floats:
    """Return the cost of the metres by which the box sticks out over the road's edges, beyond now, ``(n, aside)``."""
    beside = egos.speed[:, None] * times < space.until[:, None]
    right = np.where(beside, space.right[:, None], -space.half[:, None])[:, None]
    left = np.where(beside, space.left[:, None], space.half[:, None])[:, None]
    corner = size.width / 2 + size.length / 2 * _turned(off, on)
    out = np.maximum(np.maximum(off.d + corner - left, right - off.d + corner), 0.0)
    return np.asarray(OFF_ROAD_COST_1_M * np.maximum(out.max(axis=2) - out[:, :, 0], 0.0))


def _physics(on: LongitudinalCandidates, off: Aside, bend: Floats | None) -> Floats:
    """Return the cost of lateral motion without progress, and of accelerations beyond the friction circle.

    The shape is ``(n, along, aside)``.
    """
    slope = (np.abs(off.rate)[:, None] - (MAX_LATERAL_SLOPE * on.v + 0.1)[:, :, None]).max(axis=3)
    sideways = off.second[:, None] if bend is None else off.second[:, None] + (bend * on.v**2)[:, :, None]
    square = np.where((on.v > 0.5)[:, :, None], sideways**2 + (on.a**2)[:, :, None], 0.0).max(axis=3)
    sliding = np.maximum(np.sqrt(square) - GRIP_M_S2, 0.0)
    return np.asarray(SLOPE_COST * np.maximum(slope, 0.0) ** 2 + SLIDING_COST * sliding)


def _meetings(on: LongitudinalCandidates, off: Aside, others: Expected, size: Size, times: Floats) -> Floats:
    """Return the cost of contacts with and nearness to other vehicles, ``(n, along, aside)``."""
    gap_s = np.abs(others.s[:, None] - on.s[:, :, None]) - others.half_s[:, None] - size.length / 2
    corner = _turned(off, on)[:, :, None] * size.length / 2
    gap_d = np.abs(others.d[:, None] - off.d[:, :, None]) - others.half_d[:, None] - size.width / 2 - corner
    contact = _overlap(gap_s < CONTACT_MARGINS_M[0], gap_d < CONTACT_MARGINS_M[1])
    near = _overlap(gap_s < NEAR_MARGINS_M[0], gap_d < NEAR_MARGINS_M[1])
    long = (CLOSE_MARGINS_M[0] + CLOSE_MARGIN_HEADWAY_S * on.v)[:, :, None]
    close = _overlap(gap_s < long, gap_d < CLOSE_MARGINS_M[1])
    first = _first(contact)
    when = np.minimum(first, len(times) - 1)
    pace = np.take_along_axis(on.v, when, axis=2)
    weight = CONTACT_COST * np.exp(-np.maximum(times - CONTACT_SOON_S, 0.0) / CONTACT_FADE_S)
    hit = np.where(first < len(times), weight[when] * (0.5 + pace / 20.0), 0.0)
    fades = np.exp(-times / NEAR_FADE_S) * COMPARED_STEP_S
    return np.asarray(hit + _total(near, NEAR_COST_1_S * fades) + _total(close, CLOSE_COST_1_S * fades))


def _overlap(along: Bools, across: Bools) -> Ints:
    """Find the times at which any other vehicle overlaps both along and across.

    Args:
        along: Overlap along the path ``(n, along, m, time)``.
        across: Overlap across the path ``(n, aside, m, time)``.

    Returns:
        A bit for each time, eight to a byte, ``(bytes, n, along, aside)``.
    """
    a, b = (np.moveaxis(np.packbits(q, axis=-1), (-1, 2), (0, 1)) for q in (along, across))
    result = np.zeros((len(a), *along.shape[:2], across.shape[1]), np.uint8)
    for i in range(a.shape[1]):
        result |= a[:, i, :, :, None] & b[:, i, :, None, :]
    return result


def _first(bits: Ints) -> Ints:
    """Return the index of the first time with a bit set; a large number if there is none."""
    return np.min([FIRST_SET_BIT[byte] + 8 * k for k, byte in enumerate(bits)], axis=0)


def _total(bits: Ints, weights: Floats) -> Floats:
    """Return the sum of ``weights``, ``(time,)``, over the times with a bit set."""
    padded = np.zeros(8 * len(bits))
    padded[: len(weights)] = weights
    return np.sum([(BYTE_BITS @ padded[8 * k : 8 * k + 8])[byte] for k, byte in enumerate(bits)], axis=0)
