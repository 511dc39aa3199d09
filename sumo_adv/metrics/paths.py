"""Paths of egos as polylines, many at once: stations, offsets, poses; straight on before the first and past the last
point."""

from __future__ import annotations

import numpy as np

from sumo_adv.datatypes import Boxes, Floats, Ints
from sumo_adv.geometry import wrap_below_pi

LEAST_STEP = 1e-6  # m, below it two points of a path are one
BLOCK = 30_000  # pairs of points and path samples that are compared at once


class EgoPaths:
    """The paths of N egos, ``(N, T)`` box centres with headings; ``station`` ``(N, T)``: arc length [m] of each."""

    def __init__(self, ego: Boxes) -> None:
        self._x, self._y = ego.x, ego.y
        self._heading = np.unwrap(np.broadcast_to(ego.heading, ego.x.shape), axis=1)
        step = np.hypot(np.diff(ego.x), np.diff(ego.y))
        self.station: Floats = np.concatenate([np.zeros((len(ego.x), 1)), np.cumsum(step, axis=1)], axis=1)
        self._onward, self._back = _moving(step)

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
        size = max(1, BLOCK // max(1, self._x.shape[1]))
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
        still = length < LEAST_STEP
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
            kept = np.concatenate([[True], np.diff(stations) > LEAST_STEP])
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
    index, moves = np.broadcast_to(np.arange(count), (n, count)), step > LEAST_STEP
    before = np.maximum.accumulate(np.where(moves, index, -1), axis=1)
    after = np.minimum.accumulate(np.where(moves, index, count)[:, ::-1], axis=1)[:, ::-1]
    onward = np.where(after < count, after, before[:, -1:])
    back = np.where(before >= 0, before, after[:, :1])
    return np.clip(onward, 0, count - 1), np.clip(back, 0, count - 1)
