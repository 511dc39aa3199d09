"""The middle line of a lane, and SUMO's lane positions on it.

SUMO counts a lane's positions from 0 to its ``length`` attribute, which need not be the length of the shape: all lanes
of an edge share it, also in a bend, and maps may set it. SUMO spreads the positions evenly over the shape in space
(``MSLane::interpolateLanePosToGeometryPos``). All stations of this program are metres along the shape in plan.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.geometry import along, read_only

SHORTEST_SHAPE_M = 1e-3  # of a lane whose points are all the same


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

    @property
    def length(self) -> float:
        """Its length [m]; SUMO's length of the lane is ``positions[-1]``."""
        return float(self.stations[-1])

    def station_of(self, position: float) -> float:
        """Metres along the line to SUMO's lane position [m]."""
        return float(np.interp(position, self.positions, self.stations))

    def position_of(self, station: float) -> float:
        """SUMO's lane position [m] of the place ``station`` metres along the line."""
        return float(np.interp(station, self.stations, self.positions))

    def station_at(self, x: float, y: float) -> float:
        """Metres along the line to its point that is nearest to a place."""
        return float(along(self.shape, x, y))

    def point_at(self, station: float) -> tuple[float, float, float]:
        """x, y [m] and direction [rad] of the line ``station`` metres along it."""
        x, y = (float(np.interp(station, self.stations, self.shape[:, k])) for k in range(2))
        i = min(max(int(np.searchsorted(self.stations, station, side="right")) - 1, 0), len(self.shape) - 2)
        dx, dy = self.shape[i + 1] - self.shape[i]
        return x, y, math.atan2(dy, dx)

    def away(self, x: float, y: float) -> float:
        """Distance of a place from the line [m]."""
        return math.dist((x, y), self.point_at(self.station_at(x, y))[:2])


def centreline(points: Sequence[Any], length: float) -> Centreline:
    """The middle line of a lane with these points, ``(n, 2)`` or ``(n, 3)`` [m], and this ``length`` in SUMO [m]."""
    shape = read_only(points)
    steps = np.diff(shape, axis=0)
    stations, in_space = (np.r_[0.0, np.cumsum(np.linalg.norm(s, axis=1))] for s in (steps[:, :2], steps))
    return Centreline(shape[:, :2], read_only(stations), in_space * (length / max(in_space[-1], SHORTEST_SHAPE_M)))
