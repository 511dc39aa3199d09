"""What a reference driver sees: other vehicles in the frame of the ego's path, over all steps of a counterfactual.

Paths are polylines, many at once, with stations, offsets and poses. They continue straight on before the first point
and past the last one. A pedestrian or cyclist is seen unless other boxes, standing or moving, hide it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from sumo_adv.datatypes import Bools, Boxes, Floats, Ints
from sumo_adv.geometry import crosses_box, same_layer, wrap_below_pi
from sumo_adv.metrics.boxes import corners, flat, pick
from sumo_adv.metrics.contact import SAME_DIRECTION
from sumo_adv.road_users import unprotected

MIN_POINT_DISTANCE_M = 1e-6  # nearer points of a path count as one
MAX_PAIRS_PER_BLOCK = 30_000  # pairs of points and path samples that are compared at once


class EgoPaths:
    """The paths of N egos.

    Attributes:
        station: Arc length of each point of the paths ``(N, T)`` [m].
    """

    def __init__(self, ego: Boxes) -> None:
        """Make the paths.

        Args:
            ego: The egos' motions, box centres with headings ``(N, T)``.
        """
        self._x, self._y, self._z = ego.x, ego.y, np.broadcast_to(ego.z, ego.x.shape) if np.ndim(ego.z) else ego.z
        self._heading = np.unwrap(np.broadcast_to(ego.heading, ego.x.shape), axis=1)
        step = np.hypot(np.diff(ego.x), np.diff(ego.y))
        self.station: Floats = np.concatenate([np.zeros((len(ego.x), 1)), np.cumsum(step, axis=1)], axis=1)
        self._onward, self._back = _moving(step)

    def heights(self, station: Floats) -> Floats | float:
        """Return the heights of the road at stations.

        Args:
            station: The stations ``(N, K)`` [m].

        Returns:
            The heights ``(N, K)`` [m]; a single number if the road is flat.
        """
        if not isinstance(self._z, np.ndarray):
            return self._z
        return np.stack([np.interp(s, own, z) for s, own, z in zip(station, self.station, self._z, strict=True)])

    def locate(self, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        """Project points on the paths.

        Args:
            x: Points ``(N, K)`` [m].
            y: Points ``(N, K)`` [m].

        Returns:
            Station [m], offset to the left [m] and path heading [rad] of each point ``(N, K)``; NaN stays NaN.
        """
        rows = np.arange(len(x))[:, None]
        there = np.isfinite(x)
        px, py = np.where(there, x, 0.0), np.where(there, y, 0.0)
        nearest = self._nearest(px, py)
        best = self._on_segment(rows, self._onward[rows, np.minimum(nearest, self._x.shape[1] - 2)], px, py)
        before = self._on_segment(rows, self._back[rows, np.maximum(nearest - 1, 0)], px, py)
        nearer = before[3] < best[3] - 1e-12
        station, left, heading = np.where(there, np.where(nearer, before[:3], best[:3]), np.nan)
        return station, left, heading

    def _nearest(self, x: Floats, y: Floats) -> Ints:
        """Return the index of the path's point that is nearest to each of the points ``(N, K)``.

        The points are compared row by row and in parts, because the squares of a part fit into the processor's cache.
        """
        nearest = np.empty(x.shape, np.intp)
        size = max(1, MAX_PAIRS_PER_BLOCK // max(1, self._x.shape[1]))
        for row in range(len(x)):
            for first in range(0, x.shape[1], size):
                part = slice(first, first + size)
                square, dy = (np.subtract.outer(p[row, part], path[row]) for p, path in ((x, self._x), (y, self._y)))
                square *= square
                dy *= dy
                square += dy
                nearest[row, part] = square.argmin(axis=1)
        return nearest

    def _on_segment(self, rows: Ints, i: Ints, x: Floats, y: Floats) -> Floats:
        """Return station, offset, heading and squared distance of points seen from the path's segments ``i``."""
        first, last = self._onward[:, :1], self._back[:, -1:]
        ax, ay, bx, by = self._x[rows, i], self._y[rows, i], self._x[rows, i + 1], self._y[rows, i + 1]
        length = np.hypot(bx - ax, by - ay)
        still = length < MIN_POINT_DISTANCE_M
        h = self._heading[rows, i]
        c = np.where(still, np.cos(h), (bx - ax) / np.where(still, 1.0, length))
        s = np.where(still, np.sin(h), (by - ay) / np.where(still, 1.0, length))
        dx, dy = x - ax, y - ay
        along, left = dx * c + dy * s, dy * c - dx * s
        on = np.where((along < 0) & (i > first), 0.0, np.where((along > length) & (i < last), length, along))
        return np.stack([self.station[rows, i] + on, left, np.arctan2(s, c), (along - on) ** 2 + left**2])

    def poses(self, station: Floats) -> tuple[Floats, Floats, Floats]:
        """Return poses on the paths.

        Args:
            station: The stations ``(N, K)`` [m].

        Returns:
            x [m], y [m] and heading [rad] ``(N, K)``.
        """
        poses = np.empty((3, *station.shape))
        for row, places in enumerate(station):
            stations = self.station[row]
            kept = np.concatenate([[True], np.diff(stations) > MIN_POINT_DISTANCE_M])
            s = stations[kept]
            for k, values in enumerate((self._x, self._y, self._heading)):
                poses[k, row] = np.interp(places, s, values[row][kept])
            first, last = self._heading[row][0], self._heading[row][-1]
            under, over = np.minimum(places - s[0], 0.0), np.maximum(places - s[-1], 0.0)
            poses[0, row] += under * np.cos(first) + over * np.cos(last)
            poses[1, row] += under * np.sin(first) + over * np.sin(last)
        return poses[0], poses[1], wrap_below_pi(poses[2])


def _moving(step: Floats) -> tuple[Ints, Ints]:
    """Return, for each segment ``(N, T - 1)``, the next and the previous segment over which the ego moves.

    If the ego moves over the segment itself, both are that segment. At the ends, they are the last and the first such
    segment.
    """
    n, count = step.shape
    index, moves = np.broadcast_to(np.arange(count), (n, count)), step > MIN_POINT_DISTANCE_M
    before = np.maximum.accumulate(np.where(moves, index, -1), axis=1)
    after = np.minimum.accumulate(np.where(moves, index, count)[:, ::-1], axis=1)[:, ::-1]
    onward = np.where(after < count, after, before[:, -1:])
    back = np.where(before >= 0, before, after[:, :1])
    return np.clip(onward, 0, count - 1), np.clip(back, 0, count - 1)


YAW_RATE_SPAN_S = 0.5  # yaw rates are measured over this span


class View(NamedTuple):
    """Other vehicles in one step. Arrays are ``(N, M)``; those of the egos are ``(N, 1)``.

    An absent vehicle is not ``ahead`` and has infinite gaps. The path is the ego's path.

    Attributes:
        ahead: Whether the vehicle's centre is ahead of the ego's along the path.
        away: Distance between the centres along the path [m].
        left: Offset of the vehicle's centre from the path, left positive [m].
        heading: Heading of the vehicle against that of the path there [rad].
        same_direction: Whether the vehicle goes the ego's way (``is_same_direction``).
        gap: Gap between the boxes along the path [m]; negative if they overlap lengthwise.
        side_gap: Gap between the boxes across the path [m]; negative inside the ego's corridor.
        in_corridor: Whether the vehicle's box lies in the strip that the ego's box sweeps.
        near_edge: Distance from the path to the vehicle's box [m].
        speed: Speed of the vehicle [m/s].
        along: Speed of the vehicle along the path [m/s].
        towards: Lateral speed towards the path, from the vehicle's last two positions [m/s].
        crossing: Lateral speed towards the path, from the vehicle's heading and speed [m/s].
        acceleration: Acceleration of the vehicle [m/s2].
        yaw_rate: Yaw rate of the vehicle [rad/s].
        length: Length of the vehicle [m].
        width: Width of the vehicle [m].
        ego_speed: Speed of the ego [m/s].
        ego_acceleration: Acceleration of the ego [m/s2].
        ego_length: Length of the ego [m].
        ego_width: Width of the ego [m].
        lane_half_width: Half the width of the ego's lane [m].
    """

    ahead: Bools
    away: Floats
    left: Floats
    heading: Floats
    same_direction: Bools
    gap: Floats
    side_gap: Floats
    in_corridor: Bools
    near_edge: Floats
    speed: Floats
    along: Floats
    towards: Floats
    crossing: Floats
    acceleration: Floats
    yaw_rate: Floats
    length: Floats
    width: Floats
    ego_speed: Floats
    ego_acceleration: Floats
    ego_length: float
    ego_width: float
    lane_half_width: Floats | float

    @property
    def closing(self) -> Floats:
        """How fast the ego comes nearer along the path [m/s]."""
        return self.ego_speed - self.along

    @property
    def time_to_reach(self) -> Floats:
        """Gap over closing speed [s]; 0 if the boxes overlap lengthwise, ``inf`` if the ego does not close in."""
        closing = self.closing
        closes = closing > 1e-9
        time = np.where(closes, np.maximum(self.gap, 0.0) / np.where(closes, closing, 1.0), np.inf)
        return np.where(self.gap <= 0.0, 0.0, time)


def is_same_direction(heading: Floats) -> Bools:
    """Return whether vehicles go the ego's way (within 45 degrees).

    Args:
        heading: The vehicles' headings against the ego's path [rad].
    """
    return np.abs(heading) < SAME_DIRECTION


def located_on(paths: EgoPaths, others: Boxes) -> tuple[Floats, Floats, Floats]:
    """Project vehicles on the paths of N egos.

    Args:
        paths: The paths.
        others: The vehicles ``(N, M, T)``.

    Returns:
        Stations [m], offsets [m] and path headings [rad] ``(N, M, T)``. They are NaN if a vehicle's road is above or
        below the path there.
    """
    n, m, steps = others.x.shape
    located = paths.locate(*(v.reshape((n, m * steps)) for v in (others.x, others.y)))
    heights = paths.heights(located[0])
    if np.ndim(heights) or np.ndim(others.z) or heights != others.z:
        level = same_layer(heights, np.broadcast_to(others.z, others.x.shape).reshape((n, m * steps)))
        located = tuple(np.where(level, v, np.nan) for v in located)  # type: ignore[assignment]
    station, left, heading = (v.reshape(others.x.shape) for v in located)
    return station, left, heading


class Views:
    """The views of all steps: M vehicles seen from N egos that are on their paths."""

    def __init__(
        self, others: Boxes, located: tuple[Floats, Floats, Floats], ego_size: tuple[float, float], dt: float,
        lane_half_width: float,
    ) -> None:  # fmt: skip
        """Compute everything that does not depend on the ego's motion.

        Args:
            others: The vehicles ``(N, M, T)``.
            located: The result of ``located_on`` for these vehicles.
            ego_size: The egos' length and width [m].
            dt: Step [s].
            lane_half_width: Half the width of the egos' lanes [m].
        """
        n, m, steps = others.x.shape
        station, left, path_heading = located
        self._station, self._left = station, left
        self._heading = wrap_below_pi(others.heading - path_heading)
        self._length = np.broadcast_to(np.asarray(others.length, float), (n, m, 1))[..., 0]
        self._width = np.broadcast_to(np.asarray(others.width, float), (n, m, 1))[..., 0]
        cos, sin = np.abs(np.cos(self._heading)), np.abs(np.sin(self._heading))
        half_along = (cos * self._length[..., None] + sin * self._width[..., None]) / 2
        half_across = (sin * self._length[..., None] + cos * self._width[..., None]) / 2
        back = max(1, round(YAW_RATE_SPAN_S / dt))
        turned = np.unwrap(np.where(np.isfinite(self._heading), others.heading, 0.0), axis=-1)
        index = np.arange(steps)
        before = np.maximum(index - back, 0)
        span = np.maximum(index - before, 1) * dt
        there = np.isfinite(station)
        side = np.where(there & (left < 0.0), -1.0, 1.0)
        speed, near_edge = others.speed, np.where(there, np.abs(left) - half_across, np.inf)
        seen_heading, side_gap = np.where(there, self._heading, 0.0), near_edge - ego_size[1] / 2
        by_vehicle = (
            there, np.where(there, station, np.inf), np.where(there, half_along, 0.0), np.where(there, left, np.inf),
            seen_heading, is_same_direction(seen_heading), side_gap, side_gap <= 0.0, near_edge, _known(speed),
            _known(speed * np.cos(self._heading)), _known(-side * _change(left, dt)),
            _known(-side * speed * np.sin(self._heading)), _known(_change(speed, dt)),
            _known((turned - turned[..., before]) / span),
        )  # fmt: skip
        # by step
        self._steps = [np.ascontiguousarray(values.transpose(2, 0, 1)) for values in by_vehicle]
        self._size, self._half = ego_size, lane_half_width

    def at(self, step: int, station: Floats, speed: Floats, acceleration: Floats) -> View:
        """Return what the egos see in a step.

        Args:
            step: The step.
            station: The egos' stations ``(N,)`` [m].
            speed: The egos' speeds ``(N,)`` [m/s].
            acceleration: The egos' accelerations ``(N,)`` [m/s2].
        """
        (
            there, here, half_along, left, heading, same_direction, side_gap, in_corridor, near_edge,
            pace, along, towards, crossing, change, yaw_rate,
        ) = (values[step] for values in self._steps)  # fmt: skip
        away, (ego_length, ego_width) = here - station[:, None], self._size
        return View(
            there & (away > 0), away, left, heading, same_direction, np.abs(away) - half_along - ego_length / 2,
            side_gap, in_corridor, near_edge, pace, along, towards, crossing, change, yaw_rate, self._length,
            self._width, speed[:, None], acceleration[:, None], ego_length, ego_width, self._half,
        )  # fmt: skip

    def in_lane_ahead(self, ego_station: Floats) -> Bools:
        """Find the steps in which each vehicle is in the ego's lane, ahead of it, and goes its way.

        Args:
            ego_station: The egos' stations ``(N, T)`` [m].

        Returns:
            A flag for each vehicle and step ``(N, M, T)``.
        """
        ahead = self._station > ego_station[:, None, :]
        return np.asarray(ahead & (np.abs(self._left) < self._half) & (np.abs(self._heading) < SAME_DIRECTION))

    def place(self, row: Any, vehicle: Any, step: Any) -> tuple[Floats, Floats, Floats]:
        """Return where vehicles are. The indices have one common shape.

        Args:
            row: Index of the ego.
            vehicle: Index of the vehicle.
            step: The step.

        Returns:
            Station [m], offset [m] and heading against that of the path there [rad]; the heading is 0 if the vehicle is
            absent.
        """
        k = (row, vehicle, step)
        heading = self._heading[k]
        return self._station[k], self._left[k], np.where(np.isfinite(self._station[k]), heading, 0.0)


def _change(values: Floats, dt: float) -> Floats:
    """Return the backward difference over a step; 0 in the first step and after an absence."""
    rates = np.zeros(values.shape)
    rates[..., 1:] = np.diff(values, axis=-1) / dt
    return np.where(np.isfinite(rates), rates, 0.0)


def _known(values: Floats) -> Floats:
    return np.where(np.isfinite(values), values, 0.0)


def hidden(ego: Boxes, other: Boxes, screens: Boxes) -> Bools:
    """Find the steps in which another box is hidden from the ego's centre: its centre and all corners are.

    Any box between the two hides, standing or moving. A box on another layer than both hides nothing.

    Args:
        ego: The egos ``(N, T)``.
        other: The other boxes ``(N, T)``.
        screens: The boxes that may be in between ``(N, K, T)``; NaN = absent.

    Returns:
        A flag for each step ``(N, T)``.
    """
    away = _blocked(ego, other, np.stack([other.x, other.y], -1)[..., None, :], screens)
    rows = np.flatnonzero(away.any(axis=1))
    if len(rows):  # corners count only if the centre is hidden
        ego, other, screens = (pick(each, rows) for each in (ego, other, screens))
        away[rows] &= _blocked(ego, other, corners(other), screens)
    return away


def _blocked(ego: Boxes, other: Boxes, points: Floats, screens: Boxes) -> Bools:
    """Find the steps ``(N, T)`` in which all points ``(N, T, P, 2)`` of another box are behind boxes."""
    length, width = (np.asarray(v)[..., None] / 2 for v in (screens.length, screens.width))
    eye = ego.x[:, None, :, None], ego.y[:, None, :, None]
    point = points[:, None, ..., 0], points[:, None, ..., 1]
    box = screens.x[..., None], screens.y[..., None], screens.heading[..., None]
    with np.errstate(invalid="ignore"):
        blocked = crosses_box(eye, point, box, (length, width))
    if not (flat(ego, screens) and flat(other, screens)):
        z = np.broadcast_to(screens.z, screens.x.shape)
        level = [same_layer(np.broadcast_to(b.z, b.x.shape)[:, None], z) for b in (ego, other)]
        blocked &= (level[0] | level[1])[..., None]
    return np.asarray(blocked.any(axis=1).all(axis=-1))


def seen(ego: Boxes, other: Boxes, screens: Boxes | None) -> Boxes:
    """Return the other boxes as a driver sees them: a hidden pedestrian or cyclist is absent (NaN).

    Vehicles are assumed to be always visible: the standards that the reference drivers follow do not cover occlusion.

    Args:
        ego: The egos ``(N, T)``.
        other: The other boxes ``(N, T)``.
        screens: The boxes that may be in between ``(N, K, T)``; None if there are none.
    """
    small = np.broadcast_to(unprotected(other.length, other.width), other.x.shape)
    if screens is None or not small.any():
        return other
    away = small & hidden(ego, other, screens)
    x, y, heading, speed = (np.where(away, np.nan, v) for v in (other.x, other.y, other.heading, other.speed))
    return replace(other, x=x, y=y, heading=heading, speed=speed)
