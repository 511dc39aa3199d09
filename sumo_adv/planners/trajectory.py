"""The function f_traj: it turns the present motion and an endpoint into smooth, feasible states along a path.

The same formulas serve a single vehicle in an attempt and many predicted rollouts. A single vehicle uses Python floats,
which saves the overhead of arrays (about 15 us per step). Rollouts use numpy arrays. ``Scalar`` and ``Batch`` are the
two sets of operations, and every function takes one of them as ``m``.

Longitudinal motion: the target acceleration is that of the cubic to (s_T, v_T) at T. The acceleration moves towards it
by at most J dt per step. Its bounds are the limits, the bends ahead, a speed cap and the usual behaviour of people
(``metrics/realism.py``). Only a vehicle in the ego's lane may brake harder than people usually do.

Lateral motion: the offset d from the path follows a quintic, which is stretched until lateral acceleration, slope and
jerk are within bounds. The quintic's clock runs with the vehicle's speed. So braking in the middle of a lane change
slows the move down and does not turn the vehicle any further.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sumo_adv.datatypes import Limits
from sumo_adv.geometry import PATH_STEP_M, Path
from sumo_adv.metrics.realism import FAST_BOUND_SPEED_M_S, HUMAN_BOUNDS, SLOW_BOUND_SPEED_M_S

FULL_CLOCK_SPEED_M_S = 6.0  # the lateral move of a slower vehicle is planned for this speed, and takes longer
MAX_CLOCK_RATE = 1.15  # reached if a vehicle speeds up during a lateral move
MIN_LONGITUDINAL_HORIZON_S = 0.8  # shortest horizon of the longitudinal cubic
USUAL_ACCELERATION_M_S2 = 2.4  # bound of the acceleration, which drivers hardly exceed
SAME_LATERAL_TARGET_M = 0.12  # if the lateral target moved by less, the running quintic is kept
NO_LATERAL_TARGET_M = 1e6  # a lateral target that differs from that of every goal
LATERAL_STRETCH_FACTOR, MAX_LATERAL_STRETCHES = 1.13, 14  # of the quintic's duration
BEND_SPEED_TIMES_S = (0.3, 0.6, 1.0, 1.5)  # times ahead at which the bend speed is read
QUINTIC_SAMPLES = tuple((i + 0.5) / 10 for i in range(10))
LATERAL_RESERVE_M_S2 = 0.6  # lateral acceleration may grow by this before braking can be eased
USED_JERK_SHARE = 0.92
USED_HUMAN_BOUND_SHARE = 0.95  # the human bounds fall with speed, and they are judged after the step


class Scalar:
    """Operations on floats.

    ``worst`` returns the largest of the values at all samples, and ``least`` the smallest of the values at all times
    ahead.
    """

    minimum, maximum, sqrt, arcsin = min, max, math.sqrt, math.asin
    cos, sin, worst, least = math.cos, math.sin, max, min

    @staticmethod
    def where(condition: Any, a: Any, b: Any) -> Any:
        """Return ``a`` if the condition holds, and ``b`` otherwise."""
        return a if condition else b

    samples: Sequence[Any] = QUINTIC_SAMPLES
    ahead: Sequence[Any] = BEND_SPEED_TIMES_S


class Batch:
    """The operations of ``Scalar`` on arrays. ``worst`` and ``least`` return a value for each vehicle."""

    minimum, maximum, sqrt, arcsin = np.minimum, np.maximum, np.sqrt, np.arcsin
    cos, sin = np.cos, np.sin
    where = staticmethod(np.where)
    samples: Sequence[Any] = (np.array(QUINTIC_SAMPLES)[:, None],)  # all at once
    ahead: Sequence[Any] = (np.array(BEND_SPEED_TIMES_S)[:, None],)

    @staticmethod
    def worst(values: Sequence[Any]) -> Any:
        """Return each vehicle's largest value at all samples."""
        return values[0].max(axis=0)

    @staticmethod
    def least(values: Sequence[Any]) -> Any:
        """Return each vehicle's smallest value at all times ahead."""
        return values[0].min(axis=0)


class Motion(NamedTuple):
    """The motion of a vehicle along its path. The fields are floats, or arrays ``(n,)`` for many vehicles.

    Attributes:
        s: The station [m].
        d: The offset [m].
        dd: The time derivative of the offset [m/s].
        ddd: The second time derivative of the offset [m/s2].
        v: The speed along the track [m/s].
        a: The acceleration along the track [m/s2].
        slope: The sine of the angle from the path's heading to the vehicle's.
        pace: The speed at which the quintic's clock runs in real time [m/s].
        clock: The progress of the quintic [s].
        span: The duration of the quintic [s].
        c: The coefficients of the quintic in clock/span.
        target: The offset at the end of the quintic [m].
    """

    s: Any
    d: Any
    dd: Any
    ddd: Any
    v: Any
    a: Any
    slope: Any
    pace: Any
    clock: Any
    span: Any
    c: tuple[Any, ...]
    target: Any


class PathEndpoint(NamedTuple):
    """An endpoint in path coordinates.

    Attributes:
        s: The station [m].
        d: The offset [m].
        v: The speed [m/s].
        time: The time from now [s].
    """

    s: Any
    d: Any
    v: Any
    time: Any


STRAIGHT_ON_S = 3.0  # s ahead; the goal of a vehicle that keeps its speed and offset


def straight_on(motion: Motion) -> PathEndpoint:
    """Return the goal of a vehicle that goes straight on at its speed, without a planner.

    Args:
        motion: The present motion, of one vehicle or of many.
    """
    return PathEndpoint(motion.s + motion.v * STRAIGHT_ON_S, motion.d, motion.v, motion.v * 0 + STRAIGHT_ON_S)


class PathRow:
    """Look-ups on one path with floats."""

    def __init__(self, path: Path) -> None:
        self._table = list(
            zip(path.x.tolist(), path.y.tolist(), path.heading.tolist(), path.curvature.tolist(), path.speed.tolist(),
                strict=True)
        )  # fmt: skip
        self._last = len(self._table) - 1

    def at(self, s: float) -> tuple[float, float, float, float]:
        """Return x, y [m], heading [rad] and curvature [1/m] at a station [m]. The path continues straight past its
        ends."""
        u = s / PATH_STEP_M
        i = int(u)
        if u < 0.0 or i >= self._last:
            x, y, h, _, _ = self._table[0 if u < 0.0 else self._last]
            over = s if u < 0.0 else s - self._last * PATH_STEP_M
            return x + over * math.cos(h), y + over * math.sin(h), h, 0.0
        w = u - i
        a, b = self._table[i], self._table[i + 1]
        e = 1.0 - w
        return a[0] * e + b[0] * w, a[1] * e + b[1] * w, a[2] * e + b[2] * w, a[3] * e + b[3] * w

    def bend_speed(self, s: float, d: float) -> float:
        """Return the highest speed for the bends at a station [m] and an offset [m]. Bends are tighter on the inside.

        Returns:
            The speed [m/s].
        """
        i = int(s / PATH_STEP_M)
        row = self._table[i if 0 <= i < self._last else (0 if i < 0 else self._last)]
        return row[4] * math.sqrt(max(1.0 - row[3] * d, 0.2))


class PathRows:
    """Look-ups for many vehicles at once. Vehicle ``k`` is on path ``row[k]``.

    Attributes:
        table: x, y, heading, curvature and speed of all paths, ``(paths, 5, samples)``.
        last: The index of each path's last sample.
        row: The index of each vehicle's path, ``(n,)``.
    """

    def __init__(self, paths: Sequence[Path], row: Any) -> None:
        """Build the table of the paths, and put each vehicle on its path."""
        longest = max(len(p.x) for p in paths)
        columns = [(p.x, p.y, p.heading, p.curvature, p.speed) for p in paths]
        self.table = np.array([[np.pad(a, (0, longest - len(a)), "edge") for a in own] for own in columns])
        self.last = np.array([len(p.x) - 1 for p in paths])
        self.row = np.asarray(row)
        self._last_input: tuple[Any, Any] = (None, None)
        self._last_output: tuple[Any, Any, Any, Any] = (None, None, None, None)

    def on(self, row: Any) -> PathRows:
        """Return the same paths for vehicles on the paths ``row``."""
        rows = object.__new__(PathRows)
        rows.__dict__.update(self.__dict__)
        rows.row = row
        return rows

    def at(self, s: Any) -> tuple[Any, Any, Any, Any]:
        """Return x, y [m], heading [rad] and curvature [1/m] at stations [m], each ``(n,)``.

        The paths continue straight past their ends. The last result is kept, so do not change ``s``, ``row`` or the
        result in place.
        """
        if self._last_input[0] is not s or self._last_input[1] is not self.row:
            self._last_input, self._last_output = (s, self.row), self._look_up(s)
        return self._last_output

    def _look_up(self, s: Any) -> tuple[Any, Any, Any, Any]:
        row = self.row
        last = self.last[row]
        u = np.minimum(np.maximum(s / PATH_STEP_M, 0.0), last)
        i = np.minimum(u.astype(np.intp), last - 1)
        w = u - i
        a, b = self.table[row, :4, i], self.table[row, :4, i + 1]
        x, y, h, k = (a + (b - a) * w[:, None]).T
        over = s - u * PATH_STEP_M
        return x + over * np.cos(h), y + over * np.sin(h), h, np.where(over == 0.0, k, 0.0)

    def bend_speed(self, s: Any, d: Any) -> Any:
        """Return the highest speeds for the bends at stations [m] and offsets [m]; see ``PathRow.bend_speed``."""
        row = self.row
        i = np.minimum(np.maximum((s / PATH_STEP_M).astype(np.intp), 0), self.last[row])
        curvature, speed = self.table[row, 3, i], self.table[row, 4, i]
        return speed * np.sqrt(np.maximum(1.0 - curvature * d, 0.2))


def start(m: Any, s: Any, d: Any, slope: Any, v: Any, a: Any) -> Motion:
    """Begin a motion whose slope levels out to the present offset.

    Args:
        m: The operations, ``Scalar`` or ``Batch``.
        s: The station [m].
        d: The offset [m].
        slope: The sine of the angle from the path's heading to the vehicle's.
        v: The speed [m/s].
        a: The acceleration [m/s2].
    """
    zero = v * 0.0
    stays = (d, zero, zero, zero, zero, zero)
    still = Motion(s, d, v * slope, zero, v, a, slope, zero + FULL_CLOCK_SPEED_M_S, zero, zero + 1.0, stays, d)
    return bend(m, still, d, zero + 1.5, zero)


def bend(m: Any, motion: Motion, target: Any, duration: Any, curvature: Any) -> Motion:
    """Start a quintic to an offset. It takes longer than asked if the bounds require that.

    The bounds at ten samples are |d''| <= clip(3.6 - v^2 |kappa|, 0.8, 3), |d'| <= 0.28 max(v, 6) and |d'''| <= 10. The
    first two are widened to the present lateral acceleration and slope.

    Args:
        m: The operations, ``Scalar`` or ``Batch``.
        motion: The present motion.
        target: The offset at the end [m].
        duration: The wanted duration [s].
        curvature: The curvature kappa of the path [1/m].
    """
    v = motion.v
    pace = m.maximum(v, FULL_CLOCK_SPEED_M_S)
    rate = m.maximum(v / pace, 0.05)
    creeps = v < 0.05 * pace
    d0, a0 = motion.d, motion.ddd / (rate * rate)
    v0 = m.where(creeps, motion.slope * pace, motion.dd / rate)  # a standing vehicle keeps its heading
    most = m.maximum(m.minimum(m.maximum(3.6 - v * v * abs(curvature), 0.8), 3.0), 1.02 * abs(a0))
    slope = m.maximum(0.28 * pace, 1.02 * abs(v0))  # the present slope remains, however long the move
    span = _long_enough(m, m.maximum(duration * rate, 0.5), (d0, v0, a0, target), most, slope)
    c = _quintic(d0, v0, a0, target, span)
    return motion._replace(pace=pace, clock=v * 0.0, span=span, c=c, target=target)


def _long_enough(m: Any, span: Any, move: tuple[Any, Any, Any, Any], most: Any, slope: Any) -> Any:
    """Return ``span``, or longer durations if the quintics of ``move`` (d0, v0, a0, d1) would be too sharp."""
    if m is Scalar:
        for _ in range(MAX_LATERAL_STRETCHES):
            if not _too_sharp(m, _quintic(*move, span), span, most, slope):
                break
            span *= LATERAL_STRETCH_FACTOR
        return span
    rows = np.flatnonzero(_too_sharp(m, _quintic(*move, span), span, most, slope))
    if len(rows):  # try all durations of these vehicles at once
        spans = np.full((MAX_LATERAL_STRETCHES + 1, len(rows)), LATERAL_STRETCH_FACTOR)
        spans[0] = span[rows]
        spans = np.multiply.accumulate(spans)
        tried, each = spans[:-1].ravel(), np.tile(rows, MAX_LATERAL_STRETCHES)
        d0, v0, a0, d1 = (q[each] for q in move)
        sharp = _too_sharp(m, _quintic(d0, v0, a0, d1, tried), tried, most[each], slope[each])
        sharp = sharp.reshape(MAX_LATERAL_STRETCHES, -1)
        first = np.where(sharp.all(axis=0), MAX_LATERAL_STRETCHES, sharp.argmin(axis=0))
        span[rows] = spans[first, np.arange(len(rows))]
    return span


def _quintic(d0: Any, v0: Any, a0: Any, d1: Any, span: Any) -> tuple[Any, ...]:
    """Return the coefficients, in u = clock / span, of the quintic from (d0, v0, a0) to (d1, 0, 0)."""
    b, c = v0 * span, a0 * span * span / 2
    h = d1 - d0
    return (
        d0, b, c, 10 * h - 6 * b - 3 * c, -15 * h + 8 * b + 3 * c, 6 * h - 3 * b - c,
    )  # fmt: skip


def _too_sharp(m: Any, c: tuple[Any, ...], span: Any, most: Any, slope: Any) -> Any:
    """Return whether the quintic exceeds the lateral acceleration ``most``, the lateral speed ``slope`` or the jerk
    bound."""
    d1, d2, d3 = [], [], []
    for u in m.samples:
        d1.append(abs(c[1] + u * (2 * c[2] + u * (3 * c[3] + u * (4 * c[4] + u * 5 * c[5])))))
        d2.append(abs(2 * c[2] + u * (6 * c[3] + u * (12 * c[4] + u * 20 * c[5]))))
        d3.append(abs(6 * c[3] + u * (24 * c[4] + u * 60 * c[5])))
    two = span * span
    return (m.worst(d1) > slope * span) | (m.worst(d2) > most * two) | (m.worst(d3) > 10.0 * two * span)


def steer(m: Any, motion: Motion, goal: PathEndpoint, curvature: Any) -> Motion:
    """Aim the lateral motion at a goal. The running quintic continues if its end hardly moved.

    Args:
        m: The operations, ``Scalar`` or ``Batch``.
        motion: The present motion.
        goal: The goal.
        curvature: The curvature of the path [1/m].
    """
    moved = abs(goal.d - motion.target) >= SAME_LATERAL_TARGET_M
    if m is Scalar:
        return bend(m, motion, goal.d, goal.time, curvature) if moved else motion
    rows = np.flatnonzero(moved)
    if not len(rows):
        return motion
    part = Motion(*(_take(f, rows) for f in motion))
    fresh = bend(m, part, goal.d[rows], goal.time[rows], curvature[rows])
    return Motion(*(_put(f, rows, g) for f, g in zip(motion, fresh, strict=True)))


def release(motion: Motion) -> Motion:
    """Remove the lateral target, so that the next ``steer`` starts a new quintic."""
    return motion._replace(target=motion.target * 0.0 + NO_LATERAL_TARGET_M)


def _take(values: Any, rows: Any) -> Any:
    return tuple(v[rows] for v in values) if isinstance(values, tuple) else values[rows]


def one_of(motion: Motion, k: int) -> Motion:
    """Return the motion of vehicle ``k`` of a batch, in floats."""
    fields: list[Any] = [tuple(float(q[k]) for q in f) if isinstance(f, tuple) else float(f[k]) for f in motion]
    return Motion(*fields)


def put_back(motion: Motion, rows: Sequence[int], ones: Sequence[Motion]) -> Motion:
    """Replace the motions of the vehicles ``rows`` of a batch by ``ones``, which are in floats."""
    columns = [
        tuple(np.array(q) for q in zip(*f, strict=True)) if isinstance(f[0], tuple) else np.array(f)
        for f in zip(*ones, strict=True)
    ]
    return Motion(*(_put(f, list(rows), g) for f, g in zip(motion, columns, strict=True)))


def _put(values: Any, rows: Any, new: Any) -> Any:
    if isinstance(values, tuple):
        return tuple(_put(v, rows, n) for v, n in zip(values, new, strict=True))
    values = np.array(values, float)
    values[rows] = new
    return values


def advance(
    m: Any, motion: Motion, goal: PathEndpoint, road: Any, limits: Limits, cap: Any, dt: float, hard: Any
) -> Motion:  # fmt: skip
    """Advance a motion by one step towards a goal.

    Args:
        m: The operations, ``Scalar`` or ``Batch``.
        motion: The present motion.
        goal: The goal.
        road: The vehicle's path, a ``PathRow`` or ``PathRows``.
        limits: The limits of the vehicle's motion.
        cap: The vehicle's highest speed [m/s].
        dt: The duration of the step [s].
        hard: Whether the vehicle may brake as hard as the limits allow; see ``faster``.
    """
    s, v, a = motion.s, motion.v, motion.a
    time = m.maximum(goal.time, MIN_LONGITUDINAL_HORIZON_S)
    left = goal.s - s + goal.v * (time - goal.time)  # up to MIN_LONGITUDINAL_HORIZON_S, the goal moves at its speed
    want = 6.0 * left / (time * time) - (4.0 * v + 2.0 * goal.v) / time
    bounds = []
    for t in m.ahead:
        ahead = m.maximum(v * t, 0.5)
        fastest = road.bend_speed(s + ahead, motion.d)
        bounds.append((fastest * fastest - v * v) / (2.0 * ahead) + m.where(fastest > v, 0.5, 0.0))
    want = m.minimum(m.minimum(want, m.least(bounds)), USUAL_ACCELERATION_M_S2)
    _, _, _, curvature = road.at(s)
    lateral = abs(motion.ddd + v * v * curvature) + LATERAL_RESERVE_M_S2
    speed, a = faster(m, v, a, want, lateral, limits, cap, dt, hard)
    clock, d, dd, ddd, slope = _sideways(m, motion, speed, dt)
    along = m.sqrt(m.maximum(speed * speed - dd * dd, 0.0)) / m.maximum(1.0 - curvature * d, 0.2)
    here, span, coefficients, target = s + along * dt, motion.span, motion.c, motion.target
    return Motion(here, d, dd, ddd, speed, a, slope, motion.pace, clock, span, coefficients, target)


def usual(m: Any, signal: str, v: Any) -> Any:
    """Return the bound of a signal of the human envelope that is used at a speed.

    Args:
        m: The operations, ``Scalar`` or ``Batch``.
        signal: The signal; see ``realism.HUMAN_BOUNDS``.
        v: The speed [m/s].
    """
    slow, fast = HUMAN_BOUNDS[signal]
    share = m.minimum(m.maximum((v - SLOW_BOUND_SPEED_M_S) / (FAST_BOUND_SPEED_M_S - SLOW_BOUND_SPEED_M_S), 0.0), 1.0)
    return USED_HUMAN_BOUND_SHARE * (slow + (fast - slow) * share)


def faster(
    m: Any, v: Any, a: Any, want: Any, lateral: Any, limits: Limits, cap: Any, dt: float, hard: Any
) -> tuple[Any, Any]:  # fmt: skip
    """Advance the speed and acceleration of a vehicle by one step, within the limits.

    Args:
        m: The operations, ``Scalar`` or ``Batch``.
        v: The speed [m/s].
        a: The acceleration [m/s2].
        want: The wanted acceleration [m/s2].
        lateral: The lateral acceleration [m/s2], which reduces the grip for braking.
        limits: The limits of the vehicle's motion.
        cap: The vehicle's highest speed [m/s].
        dt: The duration of the step [s].
        hard: Whether the vehicle may brake as hard as the limits allow. Otherwise, it brakes as people usually do.

    Returns:
        The speed [m/s] and the acceleration [m/s2] after the step.
    """
    jerk = limits.jerk * USED_JERK_SHARE
    room = cap - v
    want = m.minimum(want, m.where(room > 0.0, m.sqrt(1.6 * jerk * m.maximum(room, 0.0)), room))
    want = m.maximum(want, -m.sqrt(0.8 * jerk * m.maximum(v, 0.0)))
    grip = m.sqrt(m.maximum(limits.braking * limits.braking - lateral * lateral, 4.0))  # the friction circle
    braking = m.where(hard, grip, m.minimum(grip, usual(m, "braking", v)))
    want = m.minimum(m.minimum(m.maximum(want, -braking), limits.acceleration), usual(m, "acceleration", v))
    a = m.minimum(m.maximum(want, a - jerk * dt), a + jerk * dt)
    speed = m.maximum(v + a * dt, 0.0)
    return speed, (speed - v) / dt


def _sideways(m: Any, motion: Motion, v: Any, dt: float) -> tuple[Any, Any, Any, Any, Any]:
    """Return the clock, the offset, its two time derivatives and the slope after ``dt``. The slope of a stopped vehicle
    does not change."""
    rate = m.minimum(v / motion.pace, MAX_CLOCK_RATE)
    clock = m.minimum(motion.clock + rate * dt, motion.span)
    u, c, span = clock / motion.span, motion.c, motion.span
    d = c[0] + u * (c[1] + u * (c[2] + u * (c[3] + u * (c[4] + u * c[5]))))
    d1 = (c[1] + u * (2 * c[2] + u * (3 * c[3] + u * (4 * c[4] + u * 5 * c[5])))) / span
    d2 = (2 * c[2] + u * (6 * c[3] + u * (12 * c[4] + u * 20 * c[5]))) / (span * span)
    per_metre = m.minimum(1.0 / motion.pace, MAX_CLOCK_RATE / m.maximum(v, 1.0))
    slope = m.minimum(m.maximum(d1 * per_metre, -0.8), 0.8)
    return clock, d, d1 * rate, d2 * rate * rate, slope


def pose(m: Any, motion: Motion, road: Any) -> tuple[Any, Any, Any]:
    """Return x, y [m] and heading [rad] of a motion's box centre."""
    x, y, h, _ = road.at(motion.s)
    return x - motion.d * m.sin(h), y + motion.d * m.cos(h), h + m.arcsin(motion.slope)
