"""What surrounds the ego when an attack may begin: the class of its road, its speed, and how dense the traffic is.

The road class is told from the network alone, by these rules in this order:

motorway   a limit of at least 90 km/h, and no lane of the other direction beside the carriageway
junction   the ego is on a junction where several roads come together, or comes to one within 8 s at its speed
rural      a limit above 50 km/h
urban      everything else
"""

from __future__ import annotations

import math

from sumo_adv.datatypes import Place, RoadClass, VehicleState
from sumo_adv.episode.drive import Drive
from sumo_adv.simulation.network import Lane, RoadMap

MOTORWAY_LIMIT = 25.0  # m/s, 90 km/h
URBAN_LIMIT = 13.9  # m/s, 50 km/h, as networks have it rounded
AHEAD = 8.0  # s: most attacks come to a contact within that time
SHORTEST = 10.0  # m: a way that is looked at is no shorter
NEAR = 70.0  # m: the radius in which vehicles are counted


def place_of(road: RoadMap, drive: Drive) -> Place:
    """The surroundings of the ego now."""
    assert drive.ego is not None
    ego = drive.state(drive.ego)
    obstacles = drive.obstacles
    count = sum(name not in obstacles for name in drive.near(ego, NEAR))
    at = _lane(road, drive, ego)
    if at is None:
        return Place(None, None, ego.speed, count)
    lane, position = at
    route, index = drive.simulation.route(drive.ego)
    kind = road_class(road, lane, position, AHEAD * ego.speed, route[max(index, 0) :])
    return Place(kind, lane.speed, ego.speed, count)


def road_class(road: RoadMap, lane: Lane, position: float, ahead: float, route: tuple[str, ...] = ()) -> RoadClass:
    """The class of the road ``position`` metres along a lane.

    ahead: how far a junction counts [m]. route: the edges from there on, where they are known.
    """
    if lane.speed >= MOTORWAY_LIMIT and not _two_way(road, lane):
        return RoadClass.MOTORWAY
    if _near_junction(road, lane, position, ahead, route):
        return RoadClass.JUNCTION
    return RoadClass.RURAL if lane.speed > URBAN_LIMIT else RoadClass.URBAN


def _lane(road: RoadMap, drive: Drive, ego: VehicleState) -> tuple[Lane, float] | None:
    """The ego's lane and its centre's station on it [m]; None off the network. A log names no lane."""
    if ego.lane in road.lanes and not drive.replayed():
        assert drive.ego is not None
        return road.lanes[ego.lane], max(drive.simulation.lane_position(drive.ego) - ego.length / 2, 0.0)
    lane_at = road.lane_at(ego.x, ego.y, ego.heading)
    return None if lane_at is None else (road.lanes[lane_at[0]], lane_at[1])


def _two_way(road: RoadMap, lane: Lane) -> bool:
    """Whether a lane of the other direction touches the carriageway."""
    middle = len(lane.shape) // 2
    (x, y), (dx, dy) = lane.shape[middle - 1], lane.shape[middle] - lane.shape[middle - 1]
    sides = road.side_offsets(lane.id, float(x + dx / 2), float(y + dy / 2), math.atan2(dy, dx))
    return any(kind == "opposite" for _, kind in sides)


def _near_junction(road: RoadMap, lane: Lane, position: float, ahead: float, route: tuple[str, ...]) -> bool:
    if lane.internal:
        return lane.id[1:].rsplit("_", 2)[0] in road.meeting_junctions
    ways = road.ways(lane.id, position, max(ahead, SHORTEST), route)
    return any(
        way.first is not None and way.junction <= ahead and way.first.link[0] in road.meeting_junctions for way in ways
    )
