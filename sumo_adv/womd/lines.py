"""Lines as point arrays ``(n, 2)`` or ``(n, 3)`` [m] with stations along the ground: cutting, sampling, turning, and
which of many lines lie near many points, exactly and at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sumo_adv import geometry
from sumo_adv.datatypes import Floats, Ints
from sumo_adv.geometry import wrap, wrap_below_pi

SAME_POINT_DISTANCE_M = 1e-3  # points nearer than this are one
MAX_CONNECTION_GAP_M = 1.0  # between the end of a lane and the start of its exit
AREA_SEAM_M = 0.2  # gaps between areas that are no gaps of the road


def line_stations(points: Floats) -> Floats:
    """Distance of each point from the first along the ground ``(n,)`` [m]."""
    return geometry.stations(*points[:, :2].T)


def distinct_points(points: Floats) -> Floats:
    """The points without those that repeat the one before."""
    step = np.hypot(*np.diff(points[:, :2], axis=0).T)
    return points[np.concatenate([[True], step > SAME_POINT_DISTANCE_M])]


def at(points: Floats, along: Floats, where: Floats | float) -> Floats:
    """Points at stations ``where``; ``along`` are the stations of ``points``."""
    return np.stack([np.interp(where, along, points[:, k]) for k in range(points.shape[1])], axis=-1)


def part(points: Floats, along: Floats, start: float, end: float) -> Floats:
    """The line from station ``start`` to ``end``, with its own points between."""
    inner = points[(along > start + SAME_POINT_DISTANCE_M) & (along < end - SAME_POINT_DISTANCE_M)]
    ends = at(points, along, np.array([start, end]))
    return np.vstack([ends[:1], inner, ends[1:]])


def headings(points: Floats, along: Floats, where: Floats) -> Floats:
    """Directions [rad] at stations ``where``, from points 0.5 m before and after."""
    behind, ahead = at(points, along, where - 0.5), at(points, along, where + 0.5)
    return np.arctan2(ahead[..., 1] - behind[..., 1], ahead[..., 0] - behind[..., 0])


def turned(points: Floats) -> float:
    """Heading at the end less heading at the start [rad], added up along the line (left positive)."""
    step = np.diff(points[:, :2], axis=0)
    step = step[np.hypot(*step.T) > SAME_POINT_DISTANCE_M]
    heading = np.arctan2(step[:, 1], step[:, 0])
    return float(np.sum(wrap(np.diff(heading))))


def joined_line(parts: Sequence[Floats]) -> Floats:
    """One line through all parts, doubled points left out."""
    return distinct_points(np.vstack(parts))


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


class LineSegments:
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


def resample(points: Floats, step: float) -> tuple[Floats, Floats, Floats]:
    """Stations, points ``(n, 2)`` and headings of a polyline about every ``step`` m, both ends included."""
    at = line_stations(points)
    count = max(2, round(at[-1] / step) + 1)
    grid = np.linspace(0.0, at[-1], count)
    xy = np.stack([np.interp(grid, at, points[:, k]) for k in (0, 1)], axis=1)
    heading = np.arctan2(*np.gradient(xy, axis=0).T[::-1])
    return grid, xy, heading


def road_outline(areas: Sequence[Any]) -> list[Floats]:
    """Closed lines ``(n, 2)`` [m] around the union of shapely polygons."""
    from shapely import get_parts, union_all

    ground = union_all([area.buffer(AREA_SEAM_M) for area in areas]).buffer(-AREA_SEAM_M)
    lines = []
    for part in get_parts(ground):
        outer = part.exterior if part.exterior.is_ccw else part.exterior.reverse()
        inner = (ring.reverse() if ring.is_ccw else ring for ring in part.interiors)
        lines += [np.asarray(ring.coords, np.float64)[:, :2] for ring in (outer, *inner)]
    return lines
