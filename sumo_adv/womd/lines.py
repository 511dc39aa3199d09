"""Work with lines: cut, sample and measure them, and find which of many lines lie near many points.

A line is an array of points ``(n, 2)`` or ``(n, 3)`` [m]. Its stations are measured along the ground. The search for
near lines is exact and handles all points at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sumo_adv import geometry
from sumo_adv.datatypes import Floats, Ints
from sumo_adv.geometry import wrap, wrap_below_pi

SAME_POINT_DISTANCE_M = 1e-3  # points nearer than this are the same
MAX_CONNECTION_GAP_M = 1.0  # between the end of a lane and the start of its exit
AREA_SEAM_M = 0.2  # gaps between areas up to about twice this width are closed


def line_stations(points: Floats) -> Floats:
    """Return the distance of each point from the first along the ground, ``(n,)`` [m]."""
    return geometry.stations(*points[:, :2].T)


def distinct_points(points: Floats) -> Floats:
    """Return the points without those that repeat the previous one."""
    step = np.hypot(*np.diff(points[:, :2], axis=0).T)
    return points[np.concatenate([[True], step > SAME_POINT_DISTANCE_M])]


def at(points: Floats, along: Floats, where: Floats | float) -> Floats:
    """Return the points of a line at stations.

    Args:
        points: The line, ``(n, 2)`` or ``(n, 3)`` [m].
        along: The stations of its points, ``(n,)`` [m].
        where: The stations [m], of any shape.

    Returns:
        The points; the last axis holds their coordinates.
    """
    return np.stack([np.interp(where, along, points[:, k]) for k in range(points.shape[1])], axis=-1)


def part(points: Floats, along: Floats, start: float, end: float) -> Floats:
    """Return the part of a line between two stations, with its own points between.

    Args:
        points: The line [m].
        along: The stations of its points [m].
        start: The first station [m].
        end: The last station [m].

    Returns:
        The part.
    """
    inner = points[(along > start + SAME_POINT_DISTANCE_M) & (along < end - SAME_POINT_DISTANCE_M)]
    ends = at(points, along, np.array([start, end]))
    return np.vstack([ends[:1], inner, ends[1:]])


def headings(points: Floats, along: Floats, where: Floats) -> Floats:
    """Return the directions of a line at stations, from points 0.5 m before and after.

    Args:
        points: The line [m].
        along: The stations of its points [m].
        where: The stations [m].

    Returns:
        The directions [rad].
    """
    behind, ahead = at(points, along, where - 0.5), at(points, along, where + 0.5)
    return np.arctan2(ahead[..., 1] - behind[..., 1], ahead[..., 0] - behind[..., 0])


def turned(points: Floats) -> float:
    """Return the heading at the end minus that at the start, accumulated along the line [rad], left positive."""
    step = np.diff(points[:, :2], axis=0)
    step = step[np.hypot(*step.T) > SAME_POINT_DISTANCE_M]
    heading = np.arctan2(step[:, 1], step[:, 0])
    return float(np.sum(wrap(np.diff(heading))))


def joined_line(parts: Sequence[Floats]) -> Floats:
    """Return one line through all parts, without repeated points."""
    return distinct_points(np.vstack(parts))


@dataclass(frozen=True, slots=True)
class Hits:
    """Pairs of a point and a segment near it. All arrays have shape ``(k,)``.

    Attributes:
        point: The index of the point.
        line: The index of the line in ``LineSegments.names``.
        distance: The distance [m].
        station: The station of the nearest place on the line [m].
        turned: The angle between the point's heading and the segment [rad], in [0, pi]; 0 without headings.
    """

    point: Ints
    line: Ints
    distance: Floats
    station: Floats
    turned: Floats

    def where(self, chosen: Any) -> Hits:
        """Return only the pairs that a mask or index selects."""
        return Hits(*(v[chosen] for v in (self.point, self.line, self.distance, self.station, self.turned)))

    def least(self, points: int, beyond: float) -> Floats:
        """Return the minimum distance for each point.

        Args:
            points: The number of points.
            beyond: The value for a point without a pair, and the maximum.

        Returns:
            The distances [m], ``(points,)``.
        """
        distances = np.full(points, beyond)
        np.minimum.at(distances, self.point, self.distance)
        return distances

    def nearest_of_each_line(self) -> Hits:
        """Return only the nearest segment for each point and line, ordered by point, then by line."""
        order = np.lexsort((self.distance, self.line, self.point))
        point, line = self.point[order], self.line[order]
        first = np.ones(len(order), bool)
        first[1:] = (point[1:] != point[:-1]) | (line[1:] != line[:-1])
        return self.where(order[first])


class LineSegments:
    """The segments of named polylines.

    Attributes:
        names: The names of the lines.
    """

    def __init__(self, lines: Mapping[Any, Floats]) -> None:
        """Index the segments.

        Args:
            lines: The lines by name, ``(n, 2)`` or wider [m]. A line of fewer than two points has no segments.
        """
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
        """Return all segments near points.

        Args:
            points: The points, ``(n, 2)`` [m].
            radius: The maximum distance [m].
            headings: The headings of the points [rad]; None if they do not matter.

        Returns:
            The pairs of points and segments.
        """
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
    """Sample a polyline about every ``step`` metres, including both ends.

    Args:
        points: The line [m].
        step: The approximate spacing [m].

    Returns:
        Stations [m], points ``(n, 2)`` [m] and headings [rad].
    """
    at = line_stations(points)
    count = max(2, round(at[-1] / step) + 1)
    grid = np.linspace(0.0, at[-1], count)
    xy = np.stack([np.interp(grid, at, points[:, k]) for k in (0, 1)], axis=1)
    heading = np.arctan2(*np.gradient(xy, axis=0).T[::-1])
    return grid, xy, heading


def road_outline(areas: Sequence[Any]) -> list[Floats]:
    """Return closed lines ``(n, 2)`` [m] around the union of shapely polygons."""
    from shapely import get_parts, union_all

    ground = union_all([area.buffer(AREA_SEAM_M) for area in areas]).buffer(-AREA_SEAM_M)
    lines = []
    for part in get_parts(ground):
        outer = part.exterior if part.exterior.is_ccw else part.exterior.reverse()
        inner = (ring.reverse() if ring.is_ccw else ring for ring in part.interiors)
        lines += [np.asarray(ring.coords, np.float64)[:, :2] for ring in (outer, *inner)]
    return lines
