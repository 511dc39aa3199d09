"""Many polylines as one set of segments: which of them lie near many points, exactly and at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sumo_adv.datatypes import Floats
from sumo_adv.geometry import wrap_below_pi

Ints = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Hits:
    """Pairs of a point and a segment near it, all ``(k,)``.

    point: index of the point; line: index into ``Segments.names``; distance m; station m along the line; turned rad:
    angle between the point's heading and the segment, in [0, pi] (0 where no headings were given).
    """

    point: Ints
    line: Ints
    distance: Floats
    station: Floats
    turned: Floats

    def where(self, chosen: Any) -> Hits:
        """Only the pairs of a mask."""
        return Hits(*(v[chosen] for v in (self.point, self.line, self.distance, self.station, self.turned)))

    def least(self, points: int, beyond: float) -> Floats:
        """For each of ``points`` points the least distance; ``beyond`` where it has no pair."""
        distances = np.full(points, beyond)
        np.minimum.at(distances, self.point, self.distance)
        return distances

    def nearest_of_each_line(self) -> Hits:
        """For each point and line only the nearest segment, ordered by point, then line."""
        order = np.lexsort((self.distance, self.line, self.point))
        point, line = self.point[order], self.line[order]
        first = np.ones(len(order), bool)
        first[1:] = (point[1:] != point[:-1]) | (line[1:] != line[:-1])
        return self.where(order[first])


class Segments:
    """The segments of named polylines ``(n, 2+)`` m; lines of fewer than two points have none."""

    def __init__(self, lines: Mapping[Any, Floats]) -> None:
        from shapely import STRtree, linestrings

        self.names: Sequence[Any] = list(lines)
        shapes = [np.asarray(lines[name], float)[:, :2] for name in self.names]
        parts = [shape for shape in shapes if len(shape) > 1]
        owner = [np.full(len(s) - 1, i, np.intp) for i, s in enumerate(shapes) if len(s) > 1]
        steps = [np.hypot(*np.diff(s, axis=0).T) for s in parts]
        self._a = np.concatenate([s[:-1] for s in parts]) if parts else np.empty((0, 2))
        self._b = np.concatenate([s[1:] for s in parts]) if parts else np.empty((0, 2))
        self._owner = np.concatenate(owner) if owner else np.empty(0, np.intp)
        self._start = np.concatenate([np.cumsum(s) - s for s in steps]) if steps else np.empty(0)
        self._tree = STRtree(linestrings(np.stack([self._a, self._b], axis=1)))

    def near(self, points: Floats, radius: float, headings: Floats | None = None) -> Hits:
        """All segments within ``radius`` m of points ``(n, 2)``."""
        from shapely import points as as_points

        point, segment = self._tree.query(as_points(points), predicate="dwithin", distance=radius)
        a, along = self._a[segment], self._b[segment] - self._a[segment]
        square = np.maximum((along**2).sum(axis=1), 1e-12)
        offset = points[point] - a
        share = np.clip((offset * along).sum(axis=1) / square, 0.0, 1.0)
        distance = np.hypot(*(offset - share[:, None] * along).T)
        turned = np.zeros(len(point))
        if headings is not None:
            difference = headings[point] - np.arctan2(along[:, 1], along[:, 0])
            turned = np.abs(wrap_below_pi(difference))
        return Hits(point, self._owner[segment], distance, self._start[segment] + share * np.sqrt(square), turned)


def stations(points: Floats) -> Floats:
    """Distance along a polyline ``(n, 2+)`` of each of its points, m."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points[:, :2], axis=0).T))])


def resample(points: Floats, step: float) -> tuple[Floats, Floats, Floats]:
    """Stations, points ``(n, 2)`` and headings of a polyline about every ``step`` m, both ends included."""
    at = stations(points)
    count = max(2, round(at[-1] / step) + 1)
    grid = np.linspace(0.0, at[-1], count)
    xy = np.stack([np.interp(grid, at, points[:, k]) for k in (0, 1)], axis=1)
    heading = np.arctan2(*np.gradient(xy, axis=0).T[::-1])
    return grid, xy, heading
