"""Compute plane geometry: angles, the paper's ego-centred frame, and paths sampled at equal distances."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from sumo_adv.datatypes import Bools, Floats

PATH_STEP_M = 0.5  # distance between samples of a path
HEADING_SMOOTHING_M = 1.5  # length over which headings are averaged
PATH_BRAKING_M_S2 = 4.0  # deceleration before bends
TURN_BRAKING_M_S2 = 2.0  # deceleration of pedestrians and cyclists before a half turn
MAX_PATH_SPEED_M_S = 60.0  # highest speed on a straight path
# numbers of smoothing passes for a path with a bend that is too tight; each adds to those before it
ROUNDING_PASSES = (2, 2, 3, 3, 4, 4, 6, 8)
LAYER_HEIGHT_M = 3.0
"""Largest difference of heights at one place on the same road.

It is less than the clearance of a bridge. It is more than the difference between two lanes of a road, or between two
ends of a long vehicle.
"""
Number = TypeVar("Number", float, Floats)


def read_only(values: Any) -> Floats:
    """Copy an array as float. The copy cannot be changed: it is a view, so its flag cannot be reset either."""
    made = np.array(values, float)
    made.setflags(write=False)
    return made.view()


def wrap(angle: Number) -> Number:
    """Wrap an angle [rad], a float or an array of any shape, to (-pi, pi]."""
    return math.pi - (math.pi - angle) % math.tau


def wrap_below_pi(angle: Number) -> Number:
    """Wrap an angle [rad], a float or an array of any shape, to [-pi, pi).

    The metrics use this half-open interval. Its last digit is rounded differently than that of :func:`wrap`, so
    replacing one by the other would change recorded results.
    """
    return (angle + math.pi) % math.tau - math.pi


def same_layer(z: Any, other: Any) -> Any:
    """Return whether two heights are on the same layer.

    Args:
        z: A height [m]; a number, or an array that broadcasts with ``other``.
        other: The other height [m].

    Returns:
        Truth values. NaN is on no layer.
    """
    return abs(z - other) <= LAYER_HEIGHT_M


def crosses_box(
    eye: tuple[Any, Any], point: tuple[Any, Any], box: tuple[Any, Any, Any], half: tuple[Any, Any]
) -> Bools:
    """Return whether lines of sight pass through boxes. No line does if the eye is inside the box.

    All values are numbers, or arrays that broadcast.

    Args:
        eye: x and y of the start of the line [m].
        point: x and y of its end [m].
        box: x and y of the box's centre [m], and its heading [rad].
        half: Half of the box's length and half of its width [m].

    Returns:
        Truth values of the broadcast shape.
    """
    c, s = np.cos(box[2]), np.sin(box[2])
    starts, steps = [], []
    for along, across in ((c, s), (-s, c)):
        start = (eye[0] - box[0]) * along + (eye[1] - box[1]) * across
        step = (point[0] - box[0]) * along + (point[1] - box[1]) * across - start
        starts.append(start)
        steps.append(np.where(np.abs(step) < 1e-9, 1e-9, step))
    inside = (np.abs(starts[0]) < half[0]) & (np.abs(starts[1]) < half[1])
    enters = [(-h - start) / step for h, start, step in zip(half, starts, steps, strict=True)]
    leaves = [(h - start) / step for h, start, step in zip(half, starts, steps, strict=True)]
    first = np.maximum(*(np.minimum(a, b) for a, b in zip(enters, leaves, strict=True)))
    last = np.minimum(*(np.maximum(a, b) for a, b in zip(enters, leaves, strict=True)))
    return np.asarray((first < last) & (last > 0.0) & (first < 1.0) & ~inside)


@dataclass(frozen=True, slots=True)
class Pose:
    """The pose and speed of a vehicle after a step.

    Attributes:
        x: The x of the box's centre [m].
        y: The y of the box's centre [m].
        heading: The heading [rad].
        speed: The speed [m/s].
    """

    x: float
    y: float
    heading: float
    speed: float


@dataclass(frozen=True, slots=True)
class Frame:
    """The frame of the ego's pose at the trigger: x forward, y left (the paper's R(-theta)(s - s_0)).

    Attributes:
        x: The x of the origin in the world [m].
        y: The y of the origin in the world [m].
        heading: The heading of the x axis in the world [rad].
        hand: 1, or -1 in left-hand traffic. With -1, y is to the right and headings are clockwise, so planners see the
            mirrored, right-hand scene.
    """

    x: float
    y: float
    heading: float
    hand: float = 1.0

    def to_local(self, x: Number, y: Number, heading: Number) -> tuple[Number, Number, Number]:
        """Transform a pose from the world into this frame.

        Args:
            x: x in the world [m]; a float, or an array of any shape.
            y: y in the world [m], of the same shape.
            heading: The heading in the world [rad], of the same shape.

        Returns:
            x [m], y [m] and heading [rad] in this frame.
        """
        c, s = math.cos(self.heading), math.sin(self.heading)
        dx, dy = x - self.x, y - self.y
        return c * dx + s * dy, self.hand * (-s * dx + c * dy), self.hand * wrap(heading - self.heading)

    def to_world(self, x: float, y: float, heading: float) -> tuple[float, float, float]:
        """Transform a pose from this frame into the world.

        Args:
            x: x in this frame [m].
            y: y in this frame [m].
            heading: The heading in this frame [rad].

        Returns:
            x [m], y [m] and heading [rad] in the world.
        """
        c, s = math.cos(self.heading), math.sin(self.heading)
        y, heading = self.hand * y, self.hand * heading
        return self.x + c * x - s * y, self.y + s * x + c * y, wrap(heading + self.heading)


@dataclass(frozen=True, slots=True)
class Path:
    """A line on the ground, sampled every ``PATH_STEP_M`` metres from station 0. Arrays are ``(n,)``.

    Attributes:
        x: The x of the samples [m].
        y: The y of the samples [m].
        heading: The headings [rad], unwrapped.
        curvature: The curvatures [1/m].
        speed: The highest speed at which a car takes the bends ahead [m/s].
        z: The height of the road [m]; a number if everything is flat.
    """

    x: Floats
    y: Floats
    heading: Floats
    curvature: Floats
    speed: Floats
    z: Floats | float = 0.0

    @property
    def length(self) -> float:
        """The length of the path [m]."""
        return (len(self.x) - 1) * PATH_STEP_M

    def height(self, s: Any) -> Any:
        """Return the height of the road [m] at stations ``s`` [m] of any shape; a number if everything is flat."""
        return np.interp(s, PATH_STEP_M * np.arange(len(self.x)), self.z) if np.ndim(self.z) else self.z

    def at(self, s: Floats, d: Floats | float = 0.0) -> tuple[Floats, Floats, Floats]:
        """Return positions at stations and offsets. Beyond both ends, the path continues straight.

        Args:
            s: Stations [m], of any shape.
            d: Offsets [m], left positive.

        Returns:
            x [m], y [m] and heading [rad].
        """
        return _place((self.x, self.y, self.heading), 0, len(self.x) - 1, np.asarray(s, float), d)

    def project(self, x: float, y: float, near: float | None = None, reach: float = 15.0) -> tuple[float, float]:
        """Project a point onto the path.

        Args:
            x: The x of the point [m].
            y: The y of the point [m].
            near: A station [m] near which the projection is sought; None searches the whole path.
            reach: The distance from ``near`` within which it is sought [m].

        Returns:
            The station and the offset of the point [m], left positive.
        """
        low, high = 0, len(self.x)
        if near is not None:
            low = min(max(0, int((near - reach) / PATH_STEP_M)), high - 2)
            high = max(min(high, int((near + reach) / PATH_STEP_M) + 2), low + 2)
        dx, dy = x - self.x[low:high], y - self.y[low:high]
        i = int(np.argmin(dx * dx + dy * dy))
        c, s = math.cos(self.heading[low + i]), math.sin(self.heading[low + i])
        along = c * dx[i] + s * dy[i]
        last = len(self.x) - 1
        if 0 < low + i < last:
            along = min(max(along, -PATH_STEP_M), PATH_STEP_M)
        station = (low + i) * PATH_STEP_M + along
        px, py, ph = (float(q) for q in self.at(np.asarray(station)))
        return float(station), float(-math.sin(ph) * (x - px) + math.cos(ph) * (y - py))

    def extended(self, metres: float) -> Path:
        """Return the path with a straight piece of ``metres`` [m], rounded up to whole steps, at its end."""
        n = max(1, math.ceil(metres / PATH_STEP_M))
        k = PATH_STEP_M * np.arange(1, n + 1)
        c, s = math.cos(self.heading[-1]), math.sin(self.heading[-1])
        fill = np.ones(n)
        return Path(
            np.concatenate([self.x, self.x[-1] + k * c]), np.concatenate([self.y, self.y[-1] + k * s]),
            np.concatenate([self.heading, self.heading[-1] * fill]), np.concatenate([self.curvature, 0 * fill]),
            np.concatenate([self.speed, max(self.speed[-1], 50.0) * fill]),
            np.concatenate([self.z, self.z[-1] * fill]) if isinstance(self.z, np.ndarray) else self.z,
        )  # fmt: skip


class Paths:
    """Several paths that are looked up at once."""

    def __init__(self, paths: Sequence[Path]) -> None:
        """Join the samples of the paths into tables."""
        longest = max(len(p.x) for p in paths)
        tables = [[np.pad(a, (0, longest - len(a)), "edge") for a in (p.x, p.y, p.heading)] for p in paths]
        self._tables = tuple(np.concatenate([t[k] for t in tables]) for k in range(3))
        self._first = longest * np.arange(len(paths))
        self._last = np.array([len(p.x) - 1 for p in paths])

    def at(self, path: Any, s: Floats, d: Floats | float = 0.0) -> tuple[Floats, Floats, Floats]:
        """Return positions at stations and offsets of several paths; see :meth:`Path.at`.

        Args:
            path: The indices of the paths.
            s: Stations [m].
            d: Offsets [m], left positive.

        Returns:
            x [m], y [m] and heading [rad].
        """
        return _place(self._tables, self._first[path], self._last[path], s, d)


def _place(
    tables: tuple[Floats, ...], first: Any, last: Any, s: Floats, d: Floats | float
) -> tuple[Floats, Floats, Floats]:
    """Return x, y and heading at stations and offsets.

    A path begins at the index ``first`` of each table and has ``last`` more samples.
    """
    u = np.minimum(np.maximum(s / PATH_STEP_M, 0.0), last)
    i = np.minimum(u.astype(np.intp), last - 1)
    w = u - i
    i = i + first
    x, y, heading = (t.take(i) * (1 - w) + t.take(i + 1) * w for t in tables)
    beyond, cos, sin = s - u * PATH_STEP_M, np.cos(heading), np.sin(heading)
    return x + beyond * cos - d * sin, y + beyond * sin + d * cos, heading


def make_path(
    points: Sequence[tuple[float, float]] | Floats, *, lateral: float = 3.2, tightest: float = math.inf
) -> Path:
    """Make a path through points.

    The bend speed is sqrt(lateral / curvature), with a backward pass at ``PATH_BRAKING_M_S2``.

    Args:
        points: The points ``(n, 2)`` [m], or ``(n, 3)`` with heights.
        lateral: The lateral acceleration in bends [m/s2].
        tightest: The largest curvature [1/m]. Tighter bends are rounded, as by a driver that cannot turn as sharply as
            a lane's centre line.

    Returns:
        The path.
    """
    p = np.asarray(points, float)
    p = p[np.concatenate([[True], np.hypot(*np.diff(p[:, :2], axis=0).T) > 1e-3])]
    if len(p) < 2:
        p = np.vstack([p[0], p[0] + [PATH_STEP_M, *(0.0,) * (p.shape[1] - 1)]])
    station = stations(p[:, 0], p[:, 1])
    x, y = _even(p[:, 0], p[:, 1])
    if station[-1] < PATH_STEP_M:
        x[1], y[1] = p[-1, :2] + (p[-1, :2] - p[0, :2]) / station[-1] * (PATH_STEP_M - station[-1])
    x, y = _smooth(x), _smooth(y)
    heading, curvature = _turning(x, y)
    for passes in ROUNDING_PASSES:
        if np.abs(curvature).max() <= tightest:
            break
        for _ in range(passes):
            x, y = _smooth(x), _smooth(y)
        x, y = _even(x, y)
        heading, curvature = _turning(x, y)
    z = np.interp(np.linspace(0.0, station[-1], len(x)), station, p[:, 2]) if p.shape[1] > 2 else 0.0
    return Path(x, y, heading, curvature, _bend_speed(curvature, lateral), z)


def turned_back(path: Path, station: float, turn: int, metres: float, fastest: float, less: float = 0.0) -> Path:
    """Return a path that goes along a flat one, makes a half turn, and leads straight back beside it.

    The samples of the turn are exact. Smoothing, as in :func:`make_path`, would move the place of the turn.

    Args:
        path: The path up to the turn. It is straight at the turn.
        station: The station at which the turn begins [m], rounded to a sample.
        turn: The length of the turn in steps of the path, positive to the left. The radius is this length over pi.
        metres: The length of the path after the turn [m].
        fastest: The highest speed in the turn [m/s].
        less: By how much the turn is less than a half one [rad].

    Returns:
        The path. The turn ends ``abs(turn)`` samples after it begins.
    """
    first = min(max(round(station / PATH_STEP_M), 1), len(path.x) - 1)
    steps, side = abs(turn), math.copysign(1.0, turn)
    angle = math.pi - less
    radius = steps * PATH_STEP_M / angle
    x, y, heading = float(path.x[first]), float(path.y[first]), float(path.heading[first])
    turned = heading + side * angle * np.arange(1, steps + 1) / steps
    turn_x = x + side * radius * (np.sin(turned) - math.sin(heading))
    turn_y = y - side * radius * (np.cos(turned) - math.cos(heading))
    back = PATH_STEP_M * np.arange(1, math.ceil(metres / PATH_STEP_M) + 1)
    speed = np.concatenate([path.speed[:first], np.full(steps + 1, fastest), np.full(len(back), MAX_PATH_SPEED_M_S)])
    bent = np.concatenate([path.curvature[:first], np.full(steps + 1, side / radius), 0.0 * back])
    ahead = heading - side * less  # straight back from there
    return Path(
        np.concatenate([path.x[: first + 1], turn_x, turn_x[-1] - back * math.cos(ahead)]),
        np.concatenate([path.y[: first + 1], turn_y, turn_y[-1] - back * math.sin(ahead)]),
        np.concatenate([path.heading[: first + 1], turned, np.full(len(back), turned[-1])]),
        bent, _reachable(speed**2, TURN_BRAKING_M_S2), path.z,
    )  # fmt: skip


def stations(x: Floats, y: Floats) -> Floats:
    """Return the distance of each point of a polyline from its first point, along the polyline [m]."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])


def _even(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Resample a polyline every ``PATH_STEP_M`` metres, with at least two points."""
    station = stations(x, y)
    s = PATH_STEP_M * np.arange(max(2, int(station[-1] / PATH_STEP_M) + 1))
    return np.interp(s, station, x), np.interp(s, station, y)


def _turning(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Compute heading [rad, unwrapped] and curvature [1/m] of evenly spaced points."""
    heading = _smooth(np.unwrap(np.arctan2(np.gradient(y), np.gradient(x))))
    return heading, np.gradient(heading, PATH_STEP_M)


def along(shape: Floats, x: Floats | float, y: Floats | float) -> Floats:
    """Measure how far along a polyline the nearest place to each point is.

    Args:
        shape: The polyline ``(k, 2)`` [m].
        x: The points' x [m], a float or an array of any shape.
        y: The points' y [m], of the same shape.

    Returns:
        The distances along the polyline [m], of the points' shape.
    """
    share, distance = seen_from_segments(shape, x, y)
    k, length = distance.argmin(axis=-1), np.hypot(*np.diff(shape, axis=0).T)
    before = np.concatenate([[0.0], np.cumsum(length)])
    return np.asarray(before[k] + np.take_along_axis(share, k[..., None], axis=-1)[..., 0] * length[k])


def seen_from_segments(
    shape: Floats, x: Floats | float, y: Floats | float, *, straight_on: bool = False
) -> tuple[Floats, Floats]:
    """Return the place on each segment of a polyline that is nearest to each point, and the distance to it.

    Args:
        shape: The polyline ``(k, 2)`` [m].
        x: The points' x [m], of any shape.
        y: The points' y [m], of the same shape.
        straight_on: Whether the first and the last segment continue without an end.

    Returns:
        The share of the segment up to the place, from 0 to 1, and the distance [m]. Both have the points' shape with
            one more axis, ``(..., k - 1)``.
    """
    x, y, a, step = np.asarray(x)[..., None], np.asarray(y)[..., None], shape[:-1], np.diff(shape, axis=0)
    length = np.hypot(*step.T)
    share = ((x - a[:, 0]) * step[:, 0] + (y - a[:, 1]) * step[:, 1]) / np.maximum(length**2, 1e-9)
    least, most = np.zeros(len(step)), np.ones(len(step))
    if straight_on:
        least[0], most[-1] = -np.inf, np.inf
    share = np.clip(share, least, most)
    return share, np.hypot(a[:, 0] + share * step[:, 0] - x, a[:, 1] + share * step[:, 1] - y)


def _smooth(values: Floats) -> Floats:
    """Average over ``HEADING_SMOOTHING_M`` metres and keep both ends."""
    half = round(HEADING_SMOOTHING_M / PATH_STEP_M / 2 + 0.5)
    if len(values) < 2 * half + 1:
        return values
    # odd reflection at the ends keeps them, and their slope, where they are
    head, tail = 2 * values[0] - values[half:0:-1], 2 * values[-1] - values[-2 : -half - 2 : -1]
    kernel = np.ones(2 * half + 1) / (2 * half + 1)
    return np.convolve(np.concatenate([head, values, tail]), kernel, "valid")


def _bend_speed(curvature: Floats, lateral: float) -> Floats:
    """Compute the minimum over all places ahead of sqrt(v^2 + 2 b distance), v = sqrt(lateral / curvature)."""
    return _reachable(np.minimum(lateral / np.maximum(np.abs(curvature), 1e-4), MAX_PATH_SPEED_M_S**2))


def _reachable(square: Floats, braking: float = PATH_BRAKING_M_S2) -> Floats:
    """Return the highest speeds [m/s] from which ``braking`` [m/s2] keeps to the squared speeds ahead."""
    gained = 2 * braking * PATH_STEP_M * np.arange(len(square))
    least = np.minimum.accumulate((square + gained)[::-1])[::-1]
    return np.asarray(np.sqrt(least - gained))


def quintics(
    start: tuple[Any, Any, Any], target: Floats, duration: Floats, times: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Compute quintic lateral moves that come to rest on a target offset.

    Source: Werling et al. 2010, "Optimal trajectory generation for dynamic street scenarios in a Frenet frame".

    Args:
        start: The present offset [m], its rate [m/s] and its second derivative [m/s2]; floats, or arrays that broadcast
            with ``target``.
        target: The target offsets [m], ``(...)``.
        duration: The durations of the moves [s], ``(...)``.
        times: The times at which the moves are evaluated [s], ``(k,)``.

    Returns:
        Offset [m], rate [m/s] and second derivative [m/s2], each ``(..., k)``, and the integral of the squared third
            derivative [m2/s5], ``(...)``.
    """
    (d0, rate, second), t = start, duration
    # d = d0 + rate u + second u^2 / 2 + c3 u^3 + c4 u^4 + c5 u^5, at rest on the target at u = t
    gap, slope, bow = target - d0 - rate * t - second * t * t / 2, -rate - second * t, -second
    c3 = (10 * gap - 4 * slope * t + bow * t * t / 2) / t**3
    c4 = (-15 * gap + 7 * slope * t - bow * t * t) / t**4
    c5 = (6 * gap - 3 * slope * t + bow * t * t / 2) / t**5
    jerk = 36 * c3**2 * t + 144 * c3 * c4 * t**2 + (192 * c4**2 + 240 * c3 * c5) * t**3
    jerk += 720 * c4 * c5 * t**4 + 720 * c5**2 * t**5
    u = np.minimum(times, t[..., None])
    d0, rate, second, c3, c4, c5 = (np.asarray(q)[..., None] for q in (d0, rate, second, c3, c4, c5))
    d = d0 + u * (rate + u * (second / 2 + u * (c3 + u * (c4 + u * c5))))
    d1 = rate + u * (second + u * (3 * c3 + u * (4 * c4 + u * 5 * c5)))
    d2 = second + u * (6 * c3 + u * (12 * c4 + u * 20 * c5))
    return d, d1, d2, jerk
