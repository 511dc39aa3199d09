"""Describe the lanes and the carriageway near the ego."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.drivers.protocol import Lane
from sumo_adv.geometry import read_only, wrap
from sumo_adv.simulation.lane_links import LaneGraph
from sumo_adv.simulation.network import NetworkLane as NetLane
from sumo_adv.simulation.network import RoadMap

LANES_RADIUS_M = 120.0  # m from the ego
LANES_RENEWED_AFTER_M = 10.0  # m; the lanes are rebuilt after the ego has gone this far
DIRECTION_SPAN_M = 0.25  # m before and behind a place, over which its direction is measured
SAME_DIRECTION_RAD = math.pi / 4  # rad; the maximum angle between a lane and the path that lead the same way


class RoadNear:
    """Makes ``Road.lanes`` and ``Road.edges``.

    Both stay the same objects until they have to be rebuilt.
    """

    def __init__(self, road: RoadMap) -> None:
        """Start without lanes.

        Args:
            road: The network.
        """
        self._road, self._graph = road, LaneGraph(road)
        self._around: tuple[object, tuple[float, float], tuple[NetLane, ...]] = (None, (0.0, 0.0), ())
        self._lanes: tuple[object, tuple[Lane, ...]] = (None, ())
        self._edges: tuple[object, tuple[float, float], tuple[Floats, ...]] = (None, (0.0, 0.0), ())

    def lanes(
        self, ego: tuple[float, float], route: Sequence[NetLane], met: frozenset[str],
        now: Callable[[str], tuple[float, bool]],
    ) -> tuple[Lane, ...]:  # fmt: skip
        """Return the lanes near the ego.

        Args:
            ego: The ego's place (x, y) [m].
            route: The lanes of the ego's path.
            met: The ids of the lanes that the path meets on junctions.
            now: Returns a lane's present speed limit [m/s] and whether the ego may use the lane now, from the lane's
                id.

        Returns:
            The lanes within ``LANES_RADIUS_M``. Lanes that pass over or under the path are left out unless they belong
            to it or meet it.
        """
        key = tuple(lane.id for lane in route[:3])
        on = {lane.id for lane in route}
        if self._around[0] != key or math.dist(self._around[1], ego) >= LANES_RENEWED_AFTER_M:
            way = self._way(route)
            near = (
                lane for lane in self._road.paved_lanes_within(*ego, LANES_RADIUS_M)
                if lane.id in on or lane.id in met or not self._road.leads_over(way, self._road.line(lane))
            )  # fmt: skip
            self._around = (key, ego, tuple(near))
        around = self._around[2]
        live = {lane.id: now(lane.id) for lane in around}
        if self._lanes[0] == (self._around, live):
            return self._lanes[1]
        path = _Direction(np.vstack([lane.shape for lane in route]))
        lanes = []
        for lane in around:
            relation = "route" if lane.id in on else "crossing" if lane.id in met else path.relation(lane.shape)
            (limit, allowed), links = live[lane.id], self._graph.links(lane)
            lanes.append(
                Lane(
                    lane.id, lane.shape, lane.width, limit, relation, links.left, links.right, lane.internal, allowed,
                    links.successors, links.predecessors, links.opposite_left, links.opposite_right,
                )
            )  # fmt: skip
        self._lanes = ((self._around, live), tuple(lanes))
        return self._lanes[1]

    def _way(self, route: Sequence[NetLane]) -> Floats:
        """Join the centrelines of lanes, with heights if the network has any."""
        return np.vstack([self._road.line(lane) for lane in route])

    def edges(
        self, ego: tuple[float, float], route: Sequence[str], lanes: Sequence[NetLane] = ()
    ) -> tuple[Floats, ...]:
        """Return the boundary of the drivable ground near the ego.

        Args:
            ego: The ego's place (x, y) [m].
            route: The ids of the ego's edges from the present one on.
            lanes: The lanes of the ego's path. Ground above or below them is left out.

        Returns:
            Lines ``(n, 2)`` within ``LANES_RADIUS_M`` [m].
        """
        if self._edges[0] == route and math.dist(self._edges[1], ego) < LANES_RENEWED_AFTER_M:
            return self._edges[2]
        from shapely import Point

        area = self._road.drivable(*ego, LANES_RADIUS_M, self._way(lanes) if lanes else None).area
        line = area.boundary.intersection(Point(*ego).buffer(LANES_RADIUS_M))
        parts = [part for part in getattr(line, "geoms", [line]) if part.geom_type == "LineString"]
        self._edges = (route, ego, tuple(read_only(part.coords) for part in parts))
        return self._edges[2]


class _Direction:
    """Compares the directions of a lane and a polyline where the two are nearest to each other."""

    def __init__(self, points: Floats) -> None:
        from shapely import LineString

        self._line = LineString(points)

    def relation(self, shape: Floats) -> str:
        """Return ``beside``, ``oncoming`` or ``crossing`` for a lane with the centreline ``shape``."""
        from shapely import LineString, Point, shortest_line

        line = LineString(shape)
        a, b = (Point(p) for p in shortest_line(self._line, line).coords)
        turn = abs(wrap(_heading(line, b) - _heading(self._line, a)))
        return (
            "beside" if turn < SAME_DIRECTION_RAD else "oncoming" if turn > math.pi - SAME_DIRECTION_RAD else "crossing"
        )


def _heading(line: Any, point: Any) -> float:
    """Return the direction of a line at a point on it [rad]."""
    at = min(max(line.project(point), DIRECTION_SPAN_M), line.length - DIRECTION_SPAN_M)
    a, b = line.interpolate(max(at - DIRECTION_SPAN_M, 0.0)), line.interpolate(at + DIRECTION_SPAN_M)
    return math.atan2(b.y - a.y, b.x - a.x)
