"""The middle line of a lane, and SUMO's lane positions on it.

SUMO counts a lane's positions from 0 to its ``length`` attribute, which need not be the length of the shape: all lanes
of an edge share it, also in a bend, and maps may set it. SUMO spreads the positions evenly over the shape in space
(``MSLane::interpolateLanePosToGeometryPos``). All stations of this program are metres along the shape in plan.

A place is looked up for one vehicle at a time, several times a step. Numpy takes 50 us for that. A loop over the few
pieces of a lane takes 2 us and has the same numbers to the last bit.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.geometry import read_only

SHORTEST_SHAPE_M = 1e-3  # of a lane whose points are all the same


class _Numbers(NamedTuple):
    """A line as plain numbers: its columns, and by straight piece the first point and the way to the next one [m], its
    length, the square of that, and the metres before it."""

    x: list[float]
    y: list[float]
    stations: list[float]
    positions: list[float]
    pieces: list[tuple[float, float, float, float, float, float, float]]


@dataclass(frozen=True, slots=True, eq=False)
class Centreline:
    """A lane's middle line.

    Attributes:
        shape: its points in the lane's direction, ``(n, 2)`` [m].
        stations: metres along it to each of the points, ``(n,)``.
        positions: SUMO's lane position at each of the points, ``(n,)`` [m].
    """

    shape: Floats
    stations: Floats
    positions: Floats
    _made: list[_Numbers] = field(default_factory=list, init=False, repr=False)  # empty until they are first needed

    @property
    def length(self) -> float:
        """Its length [m]; SUMO's length of the lane is ``positions[-1]``."""
        return float(self.stations[-1])

    def station_of(self, position: float) -> float:
        """Metres along the line to SUMO's lane position [m]."""
        line = self._numbers()
        return _between(position, line.positions, line.stations)

    def position_of(self, station: float) -> float:
        """SUMO's lane position [m] of the place ``station`` metres along the line."""
        line = self._numbers()
        return _between(station, line.stations, line.positions)

    def station_at(self, x: float, y: float) -> float:
        """Metres along the line to its point that is nearest to a place; ``geometry.along`` says it of many places."""
        nearest, station = math.inf, 0.0
        for px, py, dx, dy, length, square, before in self._numbers().pieces:
            t = ((x - px) * dx + (y - py) * dy) / square
            t = 0.0 if t < 0.0 else 1.0 if t > 1.0 else t
            away = abs(complex(px + t * dx - x, py + t * dy - y))  # the system's hypot, which numpy has, too
            if away < nearest:
                nearest, station = away, before + t * length
        return station

    def point_at(self, station: float) -> tuple[float, float, float]:
        """x, y [m] and direction [rad] of the line ``station`` metres along it."""
        line = self._numbers()
        x, y = _between(station, line.stations, line.x), _between(station, line.stations, line.y)
        return x, y, self.direction_at(station)

    def direction_at(self, station: float) -> float:
        """The direction [rad] of the line ``station`` metres along it."""
        line = self._numbers()
        _, _, dx, dy, *_ = line.pieces[min(max(bisect_right(line.stations, station) - 1, 0), len(line.pieces) - 1)]
        return math.atan2(dy, dx)

    def away(self, x: float, y: float) -> float:
        """Distance of a place from the line [m]."""
        return math.dist((x, y), self.point_at(self.station_at(x, y))[:2])

    def _numbers(self) -> _Numbers:
        if not self._made:
            steps = np.diff(self.shape, axis=0)
            length = np.hypot(*steps.T)
            before, square = np.r_[0.0, np.cumsum(length)][:-1], np.maximum(length**2, 1e-9)
            pieces = zip(*(v.tolist() for v in (*self.shape[:-1].T, *steps.T, length, square, before)), strict=True)
            x, y, stations, positions = (v.tolist() for v in (*self.shape.T, self.stations, self.positions))
            self._made.append(_Numbers(x, y, stations, positions, list(pieces)))
        return self._made[0]


def _between(at: float, places: list[float], values: list[float]) -> float:
    """The value at a place between two of some, which ascend, as ``numpy.interp`` has it; beyond them the last one."""
    k = bisect_right(places, at) - 1
    if k < 0:
        return values[0]
    if k == len(places) - 1 or places[k] == at:
        return values[k]
    return (values[k + 1] - values[k]) / (places[k + 1] - places[k]) * (at - places[k]) + values[k]


def centreline(points: Sequence[Any], length: float) -> Centreline:
    """The middle line of a lane with these points, ``(n, 2)`` or ``(n, 3)`` [m], and this ``length`` in SUMO [m]."""
    shape = read_only(points)
    steps = np.diff(shape, axis=0)
    stations, in_space = (np.r_[0.0, np.cumsum(np.linalg.norm(s, axis=1))] for s in (steps[:, :2], steps))
    return Centreline(shape[:, :2], read_only(stations), in_space * (length / max(in_space[-1], SHORTEST_SHAPE_M)))
