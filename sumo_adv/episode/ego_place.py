"""Where the ego is on the lanes of its route.

SUMO assigns a moved vehicle to whichever lane fits its pose best: beyond the centre line, to the oncoming lane; on a
junction, to one of the lanes that overlap. SUMO then replaces the route by one over that lane. The ego keeps its own
route. Its place is on the nearest lane of that route, until it is far from all of them.
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

LEFT_ROUTE_M = 20.0  # m; an ego that is farther from all lanes of its route has left it
WINDOW_M = 100.0  # m of the route beyond the present edge that is searched for the ego
LONGEST_STEP_M = 30.0  # m along the route, more than any step; a near place beyond it is on a later part of the route
ACROSS_RAD = 0.5  # rad; a vehicle that is turned farther from its lane's direction stands across
BESIDE_M = 8.0  # m, about two lanes; without a route, a lane of the ego's direction is searched within it


@dataclass(frozen=True, slots=True)
class LanePlace:
    """A place on a lane.

    Attributes:
        lane: The ego's lane.
        front: Distance along the centreline of the lane to the front bumper [m].
        route: The edges from the present one on. On a junction, the present edge is the one before the junction.
    """

    lane: NetworkLane
    front: float
    route: tuple[str, ...]


class EgoPlace:
    """Finds the place of one ego. It keeps the ego's route, and how far the ego has come on it.

    Attributes:
        road: The map of the ego's lanes.
        astray: Whether SUMO has another route for the ego because the ego was on a lane beside its own route.
    """

    def __init__(self, road: RoadMap, simulation: Simulation, vclass: str) -> None:
        """Start without a route.

        Args:
            road: The map.
            simulation: The simulation.
            vclass: SUMO's class of the ego.
        """
        self.road, self._simulation, self._vclass = road, simulation, vclass
        self.astray = False
        self._route: tuple[str, ...] = ()
        self._at = 0  # index of the present edge
        self._seen: tuple[str, ...] = ()  # SUMO's edges from the present one on, in the last call
        self._last: LanePlace | None = None
        self._from = (0.0, 0.0)  # the ego's centre in the last call [m]

    @property
    def route(self) -> tuple[str, ...]:
        """The edges of the whole route; empty before the ego was on a lane."""
        return self._route

    def __call__(self, ego: VehicleState, *, moved: bool, restores: bool) -> LanePlace | None:
        """Find the ego's place.

        Args:
            ego: The ego's present state.
            moved: Whether the ego's driver, not SUMO, moves the ego.
            restores: Whether SUMO gets the ego's own route back once the ego is on it again.

        Returns:
            The place; None while the ego is off all lanes.
        """
        lane = self.road.lanes.get(ego.lane)
        near = math.dist(self._from, (ego.x, ego.y)) < LONGEST_STEP_M
        self._from = ego.x, ego.y
        if lane is None:
            return None
        present, index = self._simulation.route(ego.id)
        at = max(index, 0)  # SUMO's index is -1 for a vehicle that has not departed
        if moved and near and self._route:
            self._follow(ego, lane, present, at, restores=restores)
        else:
            self._adopt(present, at)
        place = self._nearest(ego, lane)
        if place is None:  # the ego has left its route for good
            self._adopt(present, at)
            place = self._nearest(ego, lane) or LanePlace(lane, front_on(lane, ego, self._simulation), present[at:])
        self._last = place
        return place

    def _adopt(self, route: tuple[str, ...], at: int) -> None:
        """Take SUMO's route as the ego's own."""
        self._route, self._at, self._seen, self.astray = route, at, route[at:], False

    def _follow(
        self, ego: VehicleState, lane: NetworkLane, present: tuple[str, ...], at: int, *, restores: bool
    ) -> None:
        """Adopt SUMO's changes of the route, except those that ``moveToXY`` has made."""
        ahead, edge = present[at:], _edge_of(self.road, lane)
        here = self._advanced(ego, lane, present[at] if ahead else edge)
        if here is not None and self._route[here:] == ahead:
            self._at, self.astray = here, False
        elif not self.astray and edge in self._seen and here is None and ahead[:1] != self._seen[:1]:
            self.astray = True  # a later part of the route that lies beside the present one
        elif not self.astray and edge in self._seen:  # ``moveToXY`` keeps the route there, so the ego was given another
            self._adopt(present, at)
        elif here is not None and not lane.internal and restores:
            self._at, self.astray = here, False
            ahead = self._route[here:]
            self._simulation.set_route(ego.id, ahead)
        else:
            self.astray = True
        self._seen = ahead

    def _advanced(self, ego: VehicleState, lane: NetworkLane, edge: str) -> int | None:
        """Return the index of an edge if it is on the route and in reach of the ego's last place; otherwise None."""
        for index in range(self._at, len(self._route)):
            if self._route[index] == edge and self._gone(index, 0.0 if lane.internal else _front(lane, ego)):
                return index
        return None

    def _gone(self, index: int, front: float) -> bool:
        """Return whether a place on an edge of the route is within one step's reach of the last place."""
        last = self._last
        if last is None or index == self._at:
            return True
        between = sum(self.road.lanes[self.road.edges[e][0]].length for e in self._route[self._at + 1 : index])
        left = 0.0 if last.lane.internal else last.lane.length - last.front
        return left + between + front < LONGEST_STEP_M

    def _nearest(self, ego: VehicleState, lane: NetworkLane) -> LanePlace | None:
        """Find the nearest place on the route and advance to its edge; None if it is farther than ``LEFT_ROUTE_M``."""
        route = self._route[self._at :]
        if not route:
            lane = _beside(self.road, ego, lane, self._vclass)
            return LanePlace(lane, front_on(lane, ego, self._simulation), ())
        if not self.astray and _edge_of(self.road, lane) in route[:2]:  # the second one on the junction before it
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
        """Yield the lanes of the route from the present edge on, with the indices of their edges.

        The lanes over junctions are included. They have the index of the edge before the junction.
        """
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


CREEP_M_S = 3.0  # m/s; minimum speed on the way back, because a slower vehicle does not return to its lane
AIM_S, AIM_M = 0.6, 4.0  # a vehicle on its way back aims this far ahead: s at its speed, and minimum distance [m]


def back_to_lane(place: LanePlace, ego: VehicleState, speed: float | None, dt: float) -> Steer:
    """Steer an ego that SUMO has on a lane off its route back to its own lane, by pure pursuit of that lane's centre.

    Args:
        place: The ego's place on its route.
        ego: The ego's present state.
        speed: The speed to drive at [m/s]; None keeps the present speed.
        dt: The step [s].

    Returns:
        The action for the next step.
    """
    x, y, _ = place.lane.point_at(place.front - ego.length / 2 + max(AIM_S * ego.speed, AIM_M))
    angle = wrap(math.atan2(y - ego.y, x - ego.x) - ego.heading)
    wanted = max(ego.speed if speed is None else speed, CREEP_M_S)
    away = max(math.dist((x, y), (ego.x, ego.y)), AIM_M / 2)
    return Steer((wanted - ego.speed) / dt, math.atan(2 * WHEELBASE_M * math.sin(angle) / away))


def front_on(lane: NetworkLane, vehicle: VehicleState, simulation: Simulation) -> float:
    """Return the distance along a lane to a vehicle's front bumper [m].

    It is SUMO's value if SUMO has the vehicle on that lane and the vehicle does not stand across. Otherwise, it is half
    a length beyond the place on the lane that is nearest to the vehicle's centre.

    Args:
        lane: The lane.
        vehicle: The vehicle's present state.
        simulation: The simulation.
    """
    if lane.id == vehicle.lane and _turned(lane, vehicle) < ACROSS_RAD:
        return lane.station_of(simulation.lane_position(vehicle.id))
    return _front(lane, vehicle)


def _front(lane: NetworkLane, vehicle: VehicleState) -> float:
    """Return the station half a vehicle's length beyond the place on a lane that is nearest to its centre [m]."""
    return lane.station_at(vehicle.x, vehicle.y) + vehicle.length / 2


def _turned(lane: NetworkLane, vehicle: VehicleState) -> float:
    """Return the angle between a vehicle and a lane's direction [rad]."""
    return abs(wrap(lane.direction_at(lane.station_at(vehicle.x, vehicle.y)) - vehicle.heading))


def _edge_of(road: RoadMap, lane: NetworkLane) -> str:
    """Return the edge of a lane. For a lane over a junction, it is the edge to which the lane leads."""
    seen = set[str]()
    while lane.internal and lane.connections and lane.id not in seen:
        seen.add(lane.id)
        lane = road.lanes[lane.connections[0].to]
    return lane.edge


# -- without knowing how far along its route a vehicle is -----------------------------------------------------------


def against(lane: NetworkLane, vehicle: VehicleState) -> bool:
    """Return whether a vehicle heads against the direction of a lane.

    Args:
        lane: The lane.
        vehicle: The vehicle's present state.
    """
    return _turned(lane, vehicle) > math.pi / 2


def lane_on_route(road: RoadMap, vehicle: VehicleState, route: Sequence[str], vclass: str) -> NetworkLane | None:
    """Return the lane that a vehicle drives on along its route.

    It is SUMO's lane, unless that lane is not on the route, leads the other way, or is above or below the vehicle. In
    that case, it is a lane of the route near the vehicle, if there is one. Without a known route, a lane in the
    vehicle's direction replaces a lane that leads the other way.

    Args:
        road: The map.
        vehicle: The vehicle's present state.
        route: The vehicle's edges; empty if they are unknown.
        vclass: SUMO's class of the vehicle.

    Returns:
        The lane; None off all lanes.
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
    """Return the vehicle's lane or, if it does not lead the vehicle's way on its layer, the nearest lane that does."""
    if _leading(road, vehicle, [lane]):
        return lane
    near = _leading(road, vehicle, road.lanes_near(vehicle.x, vehicle.y, BESIDE_M))
    near = [other for other in near if other.allows(vclass)]
    return min(near, key=lambda other: other.away(vehicle.x, vehicle.y), default=lane)


def _leading(road: RoadMap, vehicle: VehicleState, lanes: Sequence[NetworkLane]) -> list[NetworkLane]:
    """Return the lanes that lead a vehicle's way on its layer."""
    return [lane for lane in road.level(lanes, vehicle.x, vehicle.y, vehicle.z) if not against(lane, vehicle)]
