"""Describe what surrounds the ego when an encounter begins, as the network shows it.

The road class follows from these rules, in this order:

motorway   a limit of at least 90 km/h, and no lane of the other direction beside the carriageway
junction   the ego is on a junction where several roads come together, or reaches one within 8 s at its speed
rural      a limit above 50 km/h
urban      everything else
"""

from __future__ import annotations

import math

from sumo_adv.datatypes import RoadClass, RoadPlace, VehicleState
from sumo_adv.episode.drive import Drive
from sumo_adv.simulation.network import NetworkLane, RoadMap
from sumo_adv.simulation.permissions import CAR
from sumo_adv.simulation.road_geometry import geometry_of

MOTORWAY_LIMIT_M_S = 25.0  # m/s, 90 km/h
URBAN_LIMIT_M_S = 13.9  # m/s, 50 km/h as networks round it
PLACE_LOOKAHEAD_S = 8.0  # s; most attacks that end in a contact do so within this time
MIN_LOOKAHEAD_M = 10.0  # m; the minimum length of road that is searched for junctions
VEHICLE_COUNT_RADIUS_M = 70.0  # m; vehicles within this radius are counted


def place_of(road: RoadMap, drive: Drive) -> RoadPlace:
    """Describe what surrounds the ego now.

    Args:
        road: The network.
        drive: The simulation.

    Returns:
        The surroundings. The road class and the speed limit are None off the network.
    """
    assert drive.ego is not None
    ego = drive.state(drive.ego)
    obstacles = drive.obstacles
    count = sum(name not in obstacles for name in drive.near(ego, VEHICLE_COUNT_RADIUS_M))
    at = _lane(road, drive, ego)
    if at is None:
        return RoadPlace(None, None, ego.speed, count)
    lane, station = at
    place = None if drive.replayed() else drive.place(road)
    route = drive.simulation.ahead(drive.ego) if place is None else place.route
    ahead, vclass = PLACE_LOOKAHEAD_S * ego.speed, drive.kind(drive.ego)
    kind = road_class(road, lane, station, ahead, route, vclass)
    geometry = geometry_of(road, lane, station, ahead, route, vclass)
    return RoadPlace(kind, drive.simulation.lane_limit(lane.id), ego.speed, count, geometry)


def road_class(
    road: RoadMap, lane: NetworkLane, station: float, ahead: float, route: tuple[str, ...] = (), vclass: str = CAR
) -> RoadClass:
    """Classify the road at a place.

    Args:
        road: The network.
        lane: The lane.
        station: The place on the lane [m].
        ahead: The distance within which a junction counts [m].
        route: The edges from there on, if they are known.
        vclass: SUMO's class of the vehicle that drives there.

    Returns:
        The class of the road.
    """
    if lane.speed >= MOTORWAY_LIMIT_M_S and not _two_way(road, lane):
        return RoadClass.MOTORWAY
    if _near_junction(road, lane, station, ahead, route, vclass):
        return RoadClass.JUNCTION
    return RoadClass.RURAL if lane.speed > URBAN_LIMIT_M_S else RoadClass.URBAN


def _lane(road: RoadMap, drive: Drive, ego: VehicleState) -> tuple[NetworkLane, float] | None:
    """Find the ego's lane and the station of its centre there [m]; None off the network. A log names no lane."""
    place = None if drive.replayed() else drive.place(road)
    if place is not None:
        return place.lane, max(place.front - ego.length / 2, 0.0)
    lane_at = road.lane_at(ego.x, ego.y, ego.heading, drive.kind(ego.id), ego.z)
    return None if lane_at is None else (road.lanes[lane_at[0]], lane_at[1])


def _two_way(road: RoadMap, lane: NetworkLane) -> bool:
    """Return whether a lane of the other direction touches the carriageway."""
    middle = len(lane.shape) // 2
    (x, y), (dx, dy) = lane.shape[middle - 1], lane.shape[middle] - lane.shape[middle - 1]
    sides = road.side_offsets(lane.id, float(x + dx / 2), float(y + dy / 2), math.atan2(dy, dx))
    return any(kind == "opposite" for _, kind in sides)


def _near_junction(
    road: RoadMap, lane: NetworkLane, station: float, ahead: float, route: tuple[str, ...], vclass: str
) -> bool:
    if lane.internal:
        return lane.id[1:].rsplit("_", 2)[0] in road.meeting_junctions
    ways = road.ways(lane.id, station, max(ahead, MIN_LOOKAHEAD_M), route, vclass=vclass)
    return any(
        way.first is not None and way.junction <= ahead and way.first.link[0] in road.meeting_junctions for way in ways
    )
