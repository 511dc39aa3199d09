"""Where the ego is on the lanes of its route, and the lanes and the carriageway near it.

On a junction SUMO takes a moved vehicle to be on whichever of the overlapping lanes fits best, and may rewrite its
route. For the ego's driver the way over a junction stays the one of the route until the ego is past the junction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats, VehicleState
from sumo_adv.drivers.protocol import Lane
from sumo_adv.episode.right_of_way import Link, Meetings
from sumo_adv.geometry import along, stations, wrap
from sumo_adv.simulation.network import Lane as NetLane
from sumo_adv.simulation.network import RoadMap
from sumo_adv.simulation.simulation import Simulation


@dataclass(frozen=True, slots=True)
class Place:
    """lane: the ego's; front: metres along its centreline to the front bumper; route: the edges from the present one
    on; link: on a junction, the way over it."""

    lane: NetLane
    front: float
    route: tuple[str, ...]
    link: Link | None = None


class EgoPlace:
    """Finds the ego's place. State: its route, and its way over the next junction."""

    def __init__(self, road: RoadMap, meetings: Meetings, simulation: Simulation) -> None:
        self._road, self._meetings, self._simulation = road, meetings, simulation
        self._routes: dict[str, tuple[str, ...]] = {}
        self._link: Link | None = None

    def __call__(self, ego: VehicleState, *, steered: bool) -> Place | None:
        """None while the ego is off all lanes. ``steered``: its driver, not SUMO, moved it in the last step."""
        lane = self._road.lanes.get(ego.lane)
        if lane is None:
            return None
        route = self._route(ego.id, lane.edge, steered=steered)
        if not lane.internal:
            onward = self._road.onward(lane, route)
            self._link = onward[0].link if onward else None
            return Place(lane, self._front(lane, ego), route)
        here = self._meetings.link_of.get(lane.id)
        if self._link not in self._meetings.ways or (not steered and here is not None):
            self._link = here
        elif here != self._link:
            lane = min((self._road.lanes[n] for n in self._meetings.ways[self._link].via), key=partial(_distance, ego))
        return Place(lane, self._front(lane, ego), route, self._link)

    def _front(self, lane: NetLane, ego: VehicleState) -> float:
        ahead = ego.length / 2
        x, y = ego.x + ahead * math.cos(ego.heading), ego.y + ahead * math.sin(ego.heading)
        return float(along(lane.shape, x, y))

    def _route(self, ego: str, edge: str, *, steered: bool) -> tuple[str, ...]:
        """The edges to come. A steered ego keeps its route: on ``edge`` it gets it back if SUMO has replaced it."""
        present, at = self._simulation.route(ego)
        kept = self._routes.setdefault(ego, present)
        if not steered or present[-1:] == kept[-1:]:
            if not steered:
                self._routes[ego] = present
            return present[max(at, 0) :]
        if edge in kept:
            self._simulation.set_route(ego, kept[kept.index(edge) :])
            return kept[kept.index(edge) :]
        return kept if self._road.lanes[self._road.edges[edge][0]].internal else present[max(at, 0) :]


def _distance(ego: VehicleState, lane: NetLane) -> float:
    """Metres between the ego's centre and a lane's centreline."""
    station = float(along(lane.shape, ego.x, ego.y))
    lengths = stations(*lane.shape.T)
    x, y = (np.interp(station, lengths, lane.shape[:, k]) for k in range(2))
    return float(np.hypot(x - ego.x, y - ego.y))


REACH = 120.0  # m from the ego
FRESH = 10.0  # m that the ego goes until they are made again
SPAN = 0.25  # m before and behind a place over which the direction there is taken
SAME = math.pi / 4  # rad between a lane and the path, for lanes that lead the same way


class RoadNear:
    """Makes ``Road.lanes`` and ``Road.edges``. Holds the last of them."""

    def __init__(self, road: RoadMap) -> None:
        self._road = road
        self._lanes: tuple[object, tuple[float, float], tuple[Lane, ...]] = (None, (0.0, 0.0), ())
        self._edges: tuple[object, tuple[float, float], tuple[Floats, ...]] = (None, (0.0, 0.0), ())

    def lanes(self, ego: tuple[float, float], route: Sequence[NetLane], met: frozenset[str]) -> tuple[Lane, ...]:
        """The lanes near a place; ``route``: those of the path, ``met``: those that it meets on junctions."""
        key = tuple(lane.id for lane in route[:3])
        if self._lanes[0] == key and math.dist(self._lanes[1], ego) < FRESH:
            return self._lanes[2]
        path, way = _Direction(np.vstack([lane.shape for lane in route])), self._way(route)
        on = {lane.id for lane in route}
        lanes = []
        for lane in self._road.passenger_lanes_within(*ego, REACH):
            if lane.id not in on and lane.id not in met and self._road.leads_over(way, self._road.line(lane)):
                continue
            relation = "route" if lane.id in on else "crossing" if lane.id in met else path.relation(lane.shape)
            row = self._road.edges[lane.edge]
            right = row[lane.index - 1] if lane.index > 0 else None
            left = row[lane.index + 1] if lane.index + 1 < len(row) else None
            lanes.append(Lane(lane.id, lane.shape, lane.width, lane.speed, relation, left, right, lane.internal))
        self._lanes = (key, ego, tuple(lanes))
        return self._lanes[2]

    def _way(self, route: Sequence[NetLane]) -> Floats:
        """The centrelines of lanes, one after the other, with heights where the network has some."""
        return np.vstack([self._road.line(lane) for lane in route])

    def edges(
        self, ego: tuple[float, float], route: Sequence[str], lanes: Sequence[NetLane] = ()
    ) -> tuple[Floats, ...]:
        """The boundary of the carriageway near a place; ``route``: of the ego; ``lanes``: of its path."""
        if self._edges[0] == route and math.dist(self._edges[1], ego) < FRESH:
            return self._edges[2]
        from shapely import Point

        area = self._road.drivable(*ego, REACH, self._way(lanes) if lanes else None).area
        line = area.boundary.intersection(Point(*ego).buffer(REACH))
        parts = [part for part in getattr(line, "geoms", [line]) if part.geom_type == "LineString"]
        self._edges = (route, ego, tuple(np.array(part.coords) for part in parts))
        return self._edges[2]


class _Direction:
    """The direction of lanes where they are nearest to a polyline, compared with the polyline's."""

    def __init__(self, points: Floats) -> None:
        from shapely import LineString

        self._line = LineString(points)

    def relation(self, shape: Floats) -> str:
        """``beside``, ``oncoming`` or ``crossing``."""
        from shapely import LineString, Point, shortest_line

        line = LineString(shape)
        a, b = (Point(p) for p in shortest_line(self._line, line).coords)
        turn = abs(wrap(_heading(line, b) - _heading(self._line, a)))
        return "beside" if turn < SAME else "oncoming" if turn > math.pi - SAME else "crossing"


def _heading(line: Any, point: Any) -> float:
    """The direction [rad] of a line at a point on it."""
    at = min(max(line.project(point), SPAN), line.length - SPAN)
    a, b = line.interpolate(max(at - SPAN, 0.0)), line.interpolate(at + SPAN)
    return math.atan2(b.y - a.y, b.x - a.x)
