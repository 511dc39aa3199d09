"""The centreline of a lane, and its relation to SUMO's lane positions.

SUMO counts a lane's positions from 0 to its ``length`` attribute. The attribute may differ from the length of the
shape: all lanes of an edge share it, even in a bend, and maps may set it. SUMO spreads the positions evenly over the
shape in space (``MSLane::interpolateLanePosToGeometryPos``). All stations of this program are metres along the shape in
plan.

A place is looked up for one vehicle at a time, several times a step. Numpy takes 50 us for that. A loop over the few
pieces of a lane takes 2 us, and its results are identical to the last bit.
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

SHORTEST_SHAPE_M = 1e-3  # length of a lane whose points are all the same


class _Numbers(NamedTuple):
    """A line as plain numbers.

    Attributes:
        x: x of its points [m].
        y: y of its points [m].
        stations: Stations of its points [m].
        positions: SUMO's lane positions of its points [m].
        pieces: For each straight piece, x and y of its first point, dx and dy to the next point, its length [m], the
            square of the length [m2], and the station of its first point [m].
    """

    x: list[float]
    y: list[float]
    stations: list[float]
    positions: list[float]
    pieces: list[tuple[float, float, float, float, float, float, float]]


@dataclass(frozen=True, slots=True, eq=False)
class Centreline:
    """A lane's centreline.

    Attributes:
        shape: Its points in the lane's direction, ``(n, 2)`` [m].
        stations: The station of each point, ``(n,)`` [m].
        positions: SUMO's lane position at each point, ``(n,)`` [m].
    """

    shape: Floats
    stations: Floats
    positions: Floats
    _made: list[_Numbers] = field(default_factory=list, init=False, repr=False)  # empty until first needed

    @property
    def length(self) -> float:
        """Its length [m]. SUMO's length of the lane is ``positions[-1]``."""
        return float(self.stations[-1])

    def station_of(self, position: float) -> float:
        """Return the station of SUMO's lane position [m]."""
        line = self._numbers()
        return _between(position, line.positions, line.stations)

    def position_of(self, station: float) -> float:
        """Return SUMO's lane position of a station [m]."""
        line = self._numbers()
        return _between(station, line.stations, line.positions)

    def station_at(self, x: float, y: float) -> float:
        """Return the station of the line's point that is nearest to a place [m].

        For many places at once, use ``geometry.along``.
        """
        nearest, station = math.inf, 0.0
        for px, py, dx, dy, length, square, before in self._numbers().pieces:
            t = ((x - px) * dx + (y - py) * dy) / square
            t = 0.0 if t < 0.0 else 1.0 if t > 1.0 else t
            away = abs(complex(px + t * dx - x, py + t * dy - y))  # the system's hypot, which numpy uses too
            if away < nearest:
                nearest, station = away, before + t * length
        return station

    def point_at(self, station: float) -> tuple[float, float, float]:
        """Return x, y [m] and direction [rad] of the line at a station [m]."""
        line = self._numbers()
        x, y = _between(station, line.stations, line.x), _between(station, line.stations, line.y)
        return x, y, self.direction_at(station)

    def direction_at(self, station: float) -> float:
        """Return the direction of the line [rad] at a station [m]."""
        line = self._numbers()
        _, _, dx, dy, *_ = line.pieces[min(max(bisect_right(line.stations, station) - 1, 0), len(line.pieces) - 1)]
        return math.atan2(dy, dx)

    def away(self, x: float, y: float) -> float:
        """Return the distance of a place from the line [m]."""
        return math.dist((x, y), self.point_at(self.station_at(x, y))[:2])

    def _numbers(self) -> _Numbers:
        """Return the line as plain numbers, which are made once."""
        if not self._made:
            steps = np.diff(self.shape, axis=0)
            length = np.hypot(*steps.T)
            before, square = np.r_[0.0, np.cumsum(length)][:-1], np.maximum(length**2, 1e-9)
            pieces = zip(*(v.tolist() for v in (*self.shape[:-1].T, *steps.T, length, square, before)), strict=True)
            x, y, stations, positions = (v.tolist() for v in (*self.shape.T, self.stations, self.positions))
            self._made.append(_Numbers(x, y, stations, positions, list(pieces)))
        return self._made[0]


def _between(at: float, places: list[float], values: list[float]) -> float:
    """Interpolate linearly like ``numpy.interp``; ``places`` ascend, and values beyond them are those at the ends."""
    k = bisect_right(places, at) - 1
    if k < 0:
        return values[0]
    if k == len(places) - 1 or places[k] == at:
        return values[k]
    return (values[k + 1] - values[k]) / (places[k + 1] - places[k]) * (at - places[k]) + values[k]


def centreline(points: Sequence[Any], length: float) -> Centreline:
    """Return the centreline of a lane.

    Args:
        points: The points of the lane, ``(n, 2)`` or ``(n, 3)`` [m].
        length: SUMO's length of the lane [m].

    Returns:
        The centreline in plan.
    """
    shape = read_only(points)
    steps = np.diff(shape, axis=0)
    stations, in_space = (np.r_[0.0, np.cumsum(np.linalg.norm(s, axis=1))] for s in (steps[:, :2], steps))
    return Centreline(shape[:, :2], read_only(stations), in_space * (length / max(in_space[-1], SHORTEST_SHAPE_M)))
