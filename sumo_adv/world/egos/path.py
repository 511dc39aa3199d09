"""The ego's path as a line, and where others are along and across it.

With the engine's centreline (``Observation.path``) that is the ego's lane and route; without, the arc that it is on.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from sumo_adv.datatypes import Floats, VehicleState

REACH = 120.0  # m, how far an arc is drawn
STEP = 4.0  # m, between points of an arc


class EgoPath:
    """A polyline in the world frame; before its first and after its last point it goes on straight."""

    def __init__(self, points: Sequence[tuple[float, float]]) -> None:
        """``points``: (x, y) [m] in driving direction, at least two different ones."""
        self._starts: list[tuple[float, float, float, float, float]] = []  # s, x, y, cos, sin
        lengths: list[float] = []
        at = 0.0
        for (x0, y0), (x1, y1) in itertools.pairwise(points):
            length = math.hypot(x1 - x0, y1 - y0)
            if length < 1e-3:
                continue
            self._starts.append((at, x0, y0, (x1 - x0) / length, (y1 - y0) / length))
            lengths.append(length)
            at += length
        lows, highs = [-math.inf, *(0.0 for _ in lengths[1:])], [*lengths[:-1], math.inf]  # beyond it goes on straight
        self._spans = list(zip(lows, highs, strict=True))
        self._columns: Floats = np.array(self._starts).reshape(-1, 5).T
        self._low, self._high = np.array(self._spans).reshape(-1, 2).T

    @classmethod
    def arc(cls, state: VehicleState, direction: float, yaw_rate: float) -> EgoPath:
        """The circle that ``state`` is on: from its centre in ``direction`` [rad], at most 90 degrees on."""
        bend = yaw_rate / max(state.speed, 1.0) * STEP
        x, y, turned = state.x, state.y, 0.0
        points = [(x, y)]
        for _ in range(round(REACH / STEP)):
            middle = direction + turned + bend / 2
            x, y = x + STEP * math.cos(middle), y + STEP * math.sin(middle)
            points.append((x, y))
            turned = turned + bend if abs(turned) < math.pi / 2 else turned
        return cls(points)

    def __bool__(self) -> bool:
        """Whether there is a line at all."""
        return bool(self._starts)

    def locate(self, x: float, y: float) -> tuple[float, float, float]:
        """Arc length [m], offset to the left [m] and heading [rad] of the line at its point nearest to (x, y)."""
        found = (0.0, 0.0, 0.0)
        if not self._starts:
            return found
        best = math.inf
        for index in self._nearest(x, y):
            at, x0, y0, cos, sin = self._starts[index]
            dx, dy = x - x0, y - y0
            along, left = dx * cos + dy * sin, dy * cos - dx * sin
            low, high = self._spans[index]
            on = min(max(along, low), high)
            distance = math.hypot(along - on, left)
            if distance < best:
                best = distance
                found = (at + on, math.copysign(distance, left), math.atan2(sin, cos))
        return found

    def _nearest(self, x: float, y: float) -> list[int]:
        """The segment nearest to (x, y), with any that are as near but for rounding: all at once, and then exactly."""
        _, x0, y0, cos, sin = self._columns
        dx, dy = x - x0, y - y0
        along, left = dx * cos + dy * sin, dy * cos - dx * sin
        square = (along - np.minimum(np.maximum(along, self._low), self._high)) ** 2 + left**2
        return np.flatnonzero(square <= square.min() * (1.0 + 1e-9) + 1e-18).tolist()

    def pose(self, at: float) -> tuple[float, float, float]:
        """x, y, heading at arc length ``at`` [m]."""
        start = self._starts[0]
        for candidate in self._starts:
            if candidate[0] > at:
                break
            start = candidate
        s, x, y, cos, sin = start
        return x + (at - s) * cos, y + (at - s) * sin, math.atan2(sin, cos)
