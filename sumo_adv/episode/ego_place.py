"""Where the ego is on the lanes of its route.

SUMO takes a moved vehicle to be on whichever lane fits its pose best: beyond the centre line on the oncoming one, on a
junction on one of those that overlap. It then replaces the route by one over that lane. The ego keeps its own route,
and its place is on the lane of that route which is nearest to it, until it is far from all of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sumo_adv.datatypes import VehicleState
from sumo_adv.drivers import Steer
from sumo_adv.drivers.protocol import WHEELBASE_M
from sumo_adv.geometry import wrap
from sumo_adv.simulation.network import NetworkLane, RoadMap
from sumo_adv.simulation.simulation import Simulation

LEFT_ROUTE_M = 20.0  # from all lanes of the route: the ego has left it
WINDOW_M = 100.0  # of the route beyond the present edge in which the ego is looked for
LONGEST_STEP_M = 30.0  # along the route: no step is longer, but a route that comes back on the other side may be
ACROSS_RAD = 0.5  # more than that from its lane's direction a vehicle stands across
BESIDE_M = 8.0  # about two lanes: within which a lane of the ego's direction is looked for without a route


@dataclass(frozen=True, slots=True)
class LanePlace:
    """lane: the ego's; front: metres along its centreline to the front bumper; route: the edges from the present one
    on, which on a junction is the one before it."""

    lane: NetworkLane
    front: float
    route: tuple[str, ...]


class EgoPlace:
    """Finds the place of one ego. State: its route, and how far it has come.

    Attributes:
        road: the map that its lanes are of.
        astray: whether SUMO has another route for the ego since it was on a lane beside its own.
    """

    def __init__(self, road: RoadMap, simulation: Simulation, vclass: str) -> None:
        """vclass: SUMO's class of the ego."""
        self.road, self._simulation, self._vclass = road, simulation, vclass
        self.astray = False
        self._route: tuple[str, ...] = ()
        self._at = 0  # index of the present edge
        self._seen: tuple[str, ...] = ()  # SUMO's edges from the present one on, when they were last looked at
        self._last: LanePlace | None = None
        self._from = (0.0, 0.0)  # the ego's centre in the last look

    @property
    def route(self) -> tuple[str, ...]:
        """The edges of the whole route; empty before the ego was on a lane."""
        return self._route

    def __call__(self, ego: VehicleState, *, moved: bool, restores: bool) -> LanePlace | None:
        """None while the ego is off all lanes.

        Args:
            moved: whether the ego's driver, not SUMO, moves it.
            restores: whether SUMO gets the ego's own route back once the ego is on it again.
        """
        lane = self.road.lanes.get(ego.lane)
        near = math.dist(self._from, (ego.x, ego.y)) < LONGEST_STEP_M
        self._from = ego.x, ego.y
        if lane is None:
            return None
        present, index = self._simulation.route(ego.id)
        at = max(index, 0)  # SUMO's is -1 for a vehicle that has not departed
        if moved and near and self._route:
            self._follow(ego, lane, present, at, restores=restores)
        else:
            self._adopt(present, at)
        place = self._nearest(ego, lane)
        if place is None:  # it has left its route for good
            self._adopt(present, at)
            place = self._nearest(ego, lane) or LanePlace(lane, front_on(lane, ego, self._simulation), present[at:])
        self._last = place
        return place

    def _adopt(self, route: tuple[str, ...], at: int) -> None:
        self._route, self._at, self._seen, self.astray = route, at, route[at:], False

    def _follow(
        self, ego: VehicleState, lane: NetworkLane, present: tuple[str, ...], at: int, *, restores: bool
    ) -> None:
        """Take over what SUMO says of the route, except what ``moveToXY`` has made of it."""
        ahead, edge = present[at:], _edge_of(self.road, lane)
        here = self._advanced(ego, lane, present[at] if ahead else edge)
        if here is not None and self._route[here:] == ahead:
            self._at, self.astray = here, False
        elif not self.astray and edge in self._seen and here is None and ahead[:1] != self._seen[:1]:
            self.astray = True  # a later part of the route that lies beside the present one
        elif not self.astray and edge in self._seen:  # ``moveToXY`` leaves such a route as it is: it was given another
            self._adopt(present, at)
        elif here is not None and not lane.internal and restores:
            self._at, self.astray = here, False
            ahead = self._route[here:]
            self._simulation.set_route(ego.id, ahead)
        else:
            self.astray = True
        self._seen = ahead

    def _advanced(self, ego: VehicleState, lane: NetworkLane, edge: str) -> int | None:
        """The index of an edge of the route that the ego can have reached since its last place."""
        for index in range(self._at, len(self._route)):
            if self._route[index] == edge and self._gone(index, 0.0 if lane.internal else _front(lane, ego)):
                return index
        return None

    def _gone(self, index: int, front: float) -> bool:
        """Whether a place on an edge of the route is within one step's reach of the last place."""
        last = self._last
        if last is None or index == self._at:
            return True
        between = sum(self.road.lanes[self.road.edges[e][0]].length for e in self._route[self._at + 1 : index])
        left = 0.0 if last.lane.internal else last.lane.length - last.front
        return left + between + front < LONGEST_STEP_M

    def _nearest(self, ego: VehicleState, lane: NetworkLane) -> LanePlace | None:
        """The place on the route; None if it is farther than ``LEFT_ROUTE_M``."""
        route = self._route[self._at :]
        if not route:
            lane = _beside(self.road, ego, lane, self._vclass)
            return LanePlace(lane, front_on(lane, ego, self._simulation), ())
        if not self.astray and _edge_of(self.road, lane) in route[:2]:  # the second one from on the junction before it
            return LanePlace(lane, front_on(lane, ego, self._simulation), route)
        reached = [
            (k, other) for k, other in self._candidates()
            if (other.internal or self._gone(k, _front(other, ego))) and self.road.level([other], ego.x, ego.y, ego.z)
        ]  # fmt: skip
        k, nearest = min(reached, key=lambda option: option[1].away(ego.x, ego.y), default=(0, None))
        if nearest is None or nearest.away(ego.x, ego.y) > LEFT_ROUTE_M:
            return None
        self._at = k
        return LanePlace(nearest, front_on(nearest, ego, self._simulation), self._route[k:])

    def _candidates(self) -> Iterator[tuple[int, NetworkLane]]:
        """The lanes of the route from the present edge on, also those over junctions, with the index of their edge;
        those over a junction count with the edge before it."""
        beyond, lanes = 0.0, self.road.lanes
        for index in range(self._at, len(self._route)):
            edge = self._route[index]
            row = [lanes[name] for name in self.road.edges.get(edge, ())]
            row = [lane for lane in row if lane.allows(self._vclass)] or row
            yield from ((index, lane) for lane in row)
            following = self._route[index + 1] if index + 1 < len(self._route) else None
            for connection in (c for lane in row for c in lane.connections):
                if connection.to in lanes and lanes[connection.to].edge == following:
                    yield from ((index, lanes[name]) for name in connection.via)
            beyond += row[0].length if row and index > self._at else 0.0
            if beyond > WINDOW_M:
                return


CREEP_M_S = 3.0  # a slower vehicle does not come back to its lane
AIM_S, AIM_M = 0.6, 4.0  # s at its speed and least m ahead, at which a vehicle aims on its way back


def back_to_lane(place: LanePlace, ego: VehicleState, speed: float | None, dt: float) -> Steer:
    """How an ego that SUMO has on a lane off its route comes back to its own: pure pursuit of its lane's centre.

    Args:
        speed: to drive at [m/s]; None: as now.
        dt: of a step [s].
    """
    x, y, _ = place.lane.point_at(place.front - ego.length / 2 + max(AIM_S * ego.speed, AIM_M))
    angle = wrap(math.atan2(y - ego.y, x - ego.x) - ego.heading)
    wanted = max(ego.speed if speed is None else speed, CREEP_M_S)
    away = max(math.dist((x, y), (ego.x, ego.y)), AIM_M / 2)
    return Steer((wanted - ego.speed) / dt, math.atan(2 * WHEELBASE_M * math.sin(angle) / away))


def front_on(lane: NetworkLane, vehicle: VehicleState, simulation: Simulation) -> float:
    """Metres along a lane to a vehicle's front bumper: SUMO's where it has the vehicle there, else half a length beyond
    the place that is nearest to its centre. So it is for a vehicle that stands across, too."""
    if lane.id == vehicle.lane and _turned(lane, vehicle) < ACROSS_RAD:
        return lane.station_of(simulation.lane_position(vehicle.id))
    return _front(lane, vehicle)


def _front(lane: NetworkLane, vehicle: VehicleState) -> float:
    """Half a vehicle's length beyond the place on a lane that is nearest to its centre [m]."""
    return lane.station_at(vehicle.x, vehicle.y) + vehicle.length / 2


def _turned(lane: NetworkLane, vehicle: VehicleState) -> float:
    """The angle between a vehicle and a lane's direction [rad]."""
    return abs(wrap(lane.direction_at(lane.station_at(vehicle.x, vehicle.y)) - vehicle.heading))


def _edge_of(road: RoadMap, lane: NetworkLane) -> str:
    """A lane's edge; of one over a junction the edge that it leads to."""
    seen = set[str]()
    while lane.internal and lane.connections and lane.id not in seen:
        seen.add(lane.id)
        lane = road.lanes[lane.connections[0].to]
    return lane.edge


# -- without knowing how far along its route a vehicle is -----------------------------------------------------------


def against(lane: NetworkLane, vehicle: VehicleState) -> bool:
    """Whether a vehicle heads against a lane's direction."""
    return _turned(lane, vehicle) > math.pi / 2


def lane_on_route(road: RoadMap, vehicle: VehicleState, route: Sequence[str], vclass: str) -> NetworkLane | None:
    """The lane that a vehicle drives on along its route; None off all lanes.

    That is SUMO's lane, unless it is not on the route, leads the other way or is above or below the vehicle, and a lane
    of the route is near.

    Args:
        route: the vehicle's edges; empty: unknown.
        vclass: SUMO's class of the vehicle.
    """
    lane = road.lanes.get(vehicle.lane)
    if lane is None or (_edge_of(road, lane) in route and _leading(road, vehicle, [lane])):
        return lane
    if not route:
        return _beside(road, vehicle, lane, vclass)
    rows = (road.lanes[name] for edge in route for name in road.edges.get(edge, ()))
    near = [(other.away(vehicle.x, vehicle.y), other.id) for other in rows if other.allows(vclass)]
    near = [pair for pair in near if pair[0] < LEFT_ROUTE_M and _leading(road, vehicle, [road.lanes[pair[1]]])]
    return road.lanes[min(near)[1]] if near else lane


def _beside(road: RoadMap, vehicle: VehicleState, lane: NetworkLane, vclass: str) -> NetworkLane:
    """The nearest lane that leads the vehicle's way on its layer, where its own does not."""
    if _leading(road, vehicle, [lane]):
        return lane
    near = _leading(road, vehicle, road.lanes_near(vehicle.x, vehicle.y, BESIDE_M))
    near = [other for other in near if other.allows(vclass)]
    return min(near, key=lambda other: other.away(vehicle.x, vehicle.y), default=lane)


def _leading(road: RoadMap, vehicle: VehicleState, lanes: Sequence[NetworkLane]) -> list[NetworkLane]:
    """Those of some lanes that lead a vehicle's way on its layer."""
    return [lane for lane in road.level(lanes, vehicle.x, vehicle.y, vehicle.z) if not against(lane, vehicle)]
