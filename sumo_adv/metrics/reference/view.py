"""What a reference driver sees: other vehicles in the frame of the ego's path, over all steps of a counterfactual.

Paths are polylines, many at once: stations, offsets, poses; straight on before the first and past the last point. A
pedestrian or cyclist is seen unless other boxes, standing or moving, hide it.
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

MIN_POINT_DISTANCE_M = 1e-6  # below it two points of a path are one
MAX_PAIRS_PER_BLOCK = 30_000  # pairs of points and path samples that are compared at once


class EgoPaths:
    """The paths of N egos, ``(N, T)`` box centres with headings; ``station`` ``(N, T)``: arc length [m] of each."""

    def __init__(self, ego: Boxes) -> None:
        self._x, self._y, self._z = ego.x, ego.y, np.broadcast_to(ego.z, ego.x.shape) if np.ndim(ego.z) else ego.z
        self._heading = np.unwrap(np.broadcast_to(ego.heading, ego.x.shape), axis=1)
        step = np.hypot(np.diff(ego.x), np.diff(ego.y))
        self.station: Floats = np.concatenate([np.zeros((len(ego.x), 1)), np.cumsum(step, axis=1)], axis=1)
        self._onward, self._back = _moving(step)

    def heights(self, station: Floats) -> Floats | float:
        """The heights of the road [m] at stations ``(N, K)``; a number where all is flat."""
        if not isinstance(self._z, np.ndarray):
            return self._z
        return np.stack([np.interp(s, own, z) for s, own, z in zip(station, self.station, self._z, strict=True)])

    def locate(self, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        """Station [m], offset to the left [m] and path heading [rad] of points ``(N, K)``; NaN stays NaN."""
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
        """The index of the path's point that is nearest to each of the points ``(N, K)``; row by row and in parts,
        because the squares of a part stay in the processor's cache."""
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
        """Station, offset, heading and squared distance of points seen from the path's segments ``i``."""
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
        """x, y, heading ``(N, K)`` at stations ``(N, K)`` [m]."""
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
    """For each segment ``(N, T - 1)`` the next one, and the one before, over which the ego moves (itself, if it does);
    at the ends the last and the first such."""
    n, count = step.shape
    index, moves = np.broadcast_to(np.arange(count), (n, count)), step > MIN_POINT_DISTANCE_M
    before = np.maximum.accumulate(np.where(moves, index, -1), axis=1)
    after = np.minimum.accumulate(np.where(moves, index, count)[:, ::-1], axis=1)[:, ::-1]
    onward = np.where(after < count, after, before[:, -1:])
    back = np.where(before >= 0, before, after[:, :1])
    return np.clip(onward, 0, count - 1), np.clip(back, 0, count - 1)


YAW_RATE_SPAN_S = 0.5  # over which yaw rates are measured


class View(NamedTuple):
    """Other vehicles in one step, arrays ``(N, M)``; the egos' arrays ``(N, 1)``.  Units m, rad, m/s, m/s2.

    An absent vehicle is not ``ahead`` and has infinite gaps.
    """

    ahead: Bools  # its centre is ahead of the ego's along the path
    away: Floats  # between the centres, along the path
    left: Floats  # of its centre, from the path
    heading: Floats  # against the path's there
    same_direction: Bools  # it goes the ego's way (``is_same_direction``)
    gap: Floats  # along the path, between the boxes; negative where they overlap lengthwise
    side_gap: Floats  # across the path, between the boxes; negative inside the ego's corridor
    in_corridor: Bools  # its box lies in the strip that the ego's box sweeps
    near_edge: Floats  # from the path to its box
    speed: Floats
    along: Floats  # speed along the path
    towards: Floats  # sideways towards the path, from its last two positions
    crossing: Floats  # sideways towards the path, from its heading and speed
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
        """Gap over closing speed [s], 0 where the boxes overlap lengthwise, ``inf`` where the ego does not close in."""
        closing = self.closing
        closes = closing > 1e-9
        time = np.where(closes, np.maximum(self.gap, 0.0) / np.where(closes, closing, 1.0), np.inf)
        return np.where(self.gap <= 0.0, 0.0, time)


def is_same_direction(heading: Floats) -> Bools:
    """Whether vehicles with a heading [rad] against the ego's path go the ego's way (within 45 degrees)."""
    return np.abs(heading) < SAME_DIRECTION


def located_on(paths: EgoPaths, others: Boxes) -> tuple[Floats, Floats, Floats]:
    """Stations [m], offsets [m] and path headings [rad] of vehicles ``(N, M, T)`` on the paths of N egos.

    They are NaN where a vehicle's road is above or below the path there."""
    n, m, steps = others.x.shape
    located = paths.locate(*(v.reshape((n, m * steps)) for v in (others.x, others.y)))
    heights = paths.heights(located[0])
    if np.ndim(heights) or np.ndim(others.z) or heights != others.z:
        level = same_layer(heights, np.broadcast_to(others.z, others.x.shape).reshape((n, m * steps)))
        located = tuple(np.where(level, v, np.nan) for v in located)  # type: ignore[assignment]
    station, left, heading = (v.reshape(others.x.shape) for v in located)
    return station, left, heading


class Views:
    """The views of all steps: M vehicles ``(N, M, T)`` seen from N egos that are on their paths."""

    def __init__(
        self, others: Boxes, located: tuple[Floats, Floats, Floats], ego_size: tuple[float, float], dt: float,
        lane_half_width: float,
    ) -> None:  # fmt: skip
        """``located``: what ``located_on`` says of the others."""
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
        # what does not depend on the ego's motion, by step
        self._steps = [np.ascontiguousarray(values.transpose(2, 0, 1)) for values in by_vehicle]
        self._size, self._half = ego_size, lane_half_width

    def at(self, step: int, station: Floats, speed: Floats, acceleration: Floats) -> View:
        """What egos at ``station`` [m], ``speed`` and ``acceleration`` ``(N,)`` see in a step."""
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
        """In which steps each vehicle is in the lane of an ego at ``ego_station`` ``(N, T)`` [m], ahead of it, and goes
        its way, ``(N, M, T)``."""
        ahead = self._station > ego_station[:, None, :]
        return np.asarray(ahead & (np.abs(self._left) < self._half) & (np.abs(self._heading) < SAME_DIRECTION))

    def place(self, row: Any, vehicle: Any, step: Any) -> tuple[Floats, Floats, Floats]:
        """Station and offset [m] of vehicles in steps, and their heading against the path's there [rad], 0 if they are
        absent; indices of one shape."""
        k = (row, vehicle, step)
        heading = self._heading[k]
        return self._station[k], self._left[k], np.where(np.isfinite(self._station[k]), heading, 0.0)


def _change(values: Floats, dt: float) -> Floats:
    """The backward difference over a step, 0 in the first one and after an absence."""
    rates = np.zeros(values.shape)
    rates[..., 1:] = np.diff(values, axis=-1) / dt
    return np.where(np.isfinite(rates), rates, 0.0)


def _known(values: Floats) -> Floats:
    return np.where(np.isfinite(values), values, 0.0)


def hidden(ego: Boxes, other: Boxes, screens: Boxes) -> Bools:
    """In which steps another box is hidden from the ego's centre, ``(N, T)``: its centre and all corners are.

    Any box between the two hides, standing or moving. A box on another layer than both hides nothing.
    ego, other: ``(N, T)``; screens: the boxes that may be in the way, ``(N, K, T)``, NaN = absent.
    """
    away = _blocked(ego, other, np.stack([other.x, other.y], -1)[..., None, :], screens)
    rows = np.flatnonzero(away.any(axis=1))
    if len(rows):  # corners count only where the centre is hidden
        ego, other, screens = (pick(each, rows) for each in (ego, other, screens))
        away[rows] &= _blocked(ego, other, corners(other), screens)
    return away


def _blocked(ego: Boxes, other: Boxes, points: Floats, screens: Boxes) -> Bools:
    """In which steps all points ``(N, T, P, 2)`` of another box are behind boxes, ``(N, T)``."""
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
    """The other boxes ``(N, T)`` as a driver sees them: a pedestrian or cyclist that is hidden is absent (NaN).

    Vehicles are taken to be seen always: the standards that the reference drivers follow know no occlusion.
    """
    small = np.broadcast_to(unprotected(other.length, other.width), other.x.shape)
    if screens is None or not small.any():
        return other
    away = small & hidden(ego, other, screens)
    x, y, heading, speed = (np.where(away, np.nan, v) for v in (other.x, other.y, other.heading, other.speed))
    return replace(other, x=x, y=y, heading=heading, speed=speed)
