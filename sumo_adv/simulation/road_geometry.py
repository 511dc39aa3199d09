"""Tell whether other roads soon join or leave the ego's road: ISO 34502's main roadway, merge and departure zones."""

from __future__ import annotations

import math
from collections.abc import Iterator

from sumo_adv.datatypes import RoadGeometry
from sumo_adv.geometry import wrap
from sumo_adv.simulation.network import Connection, NetworkLane, RoadMap
from sumo_adv.simulation.permissions import CAR, is_carriageway

SMALL_ANGLE_RAD = math.radians(
    40
)  # maximum angle between the roads of a merge or departure; at larger angles they cross or turn
SHORTEST_M = 10.0  # minimum length of road that is examined


def geometry_of(
    road: RoadMap, lane: NetworkLane, station: float, ahead: float, route: tuple[str, ...] = (), vclass: str = CAR
) -> RoadGeometry | None:
    """Return the geometry of the road ahead of a place.

    Args:
        road: The network.
        lane: The lane.
        station: The place on it [m].
        ahead: The distance within which junctions count [m].
        route: The edges from there on, if they are known.
        vclass: SUMO's class of the vehicle that drives there.

    Returns:
        The geometry; None if roads cross or turn there first.
    """
    gone, edges = -station, list[str]()
    reach = max(ahead, SHORTEST_M)
    chain = [road.lanes[name] for name in road.chain(lane.id, station, reach, route, vclass)]
    if lane.internal and _junction_of(lane) in road.meeting_junctions:
        return None
    for each in chain:
        gone += each.length
        if each.internal or each.edge in edges:
            continue
        edges.append(each.edge)
        if gone > ahead:
            break
        found = _at_the_end(road, each.edge)
        if found is not RoadGeometry.MAIN:
            return found
    if edges and _joined_lane_ends(road, edges[0]):
        return RoadGeometry.MERGE
    return RoadGeometry.MAIN


def _at_the_end(road: RoadMap, edge: str) -> RoadGeometry | None:
    """Return the geometry of the junction at the end of an edge; None if roads cross or turn on it."""
    own = list(_onward(road, edge))
    edges = {edge}.union(*(road.approaching.get(c.link[0], set()) for _, c in own))
    entering = [each for other in sorted(edges) for each in _onward(road, other)]
    if any(_angle(road, lane, c) > SMALL_ANGLE_RAD for lane, c in entering):
        return None
    leads_to = {road.lanes[c.to].edge for _, c in entering}
    comes_from = {lane.edge for lane, _ in entering}
    if len(leads_to) > 1 and len(comes_from) > 1:
        return None
    if len(comes_from) > 1:
        return RoadGeometry.MERGE
    return RoadGeometry.DEPARTURE if len(leads_to) > 1 else RoadGeometry.MAIN


def _joined_lane_ends(road: RoadMap, edge: str) -> bool:
    """Return whether an edge begins at a merge and loses a lane at its end, as beside an acceleration lane."""
    onward = {road.lanes[c.to].edge for _, c in _onward(road, edge)}
    if len(onward) != 1 or len(road.edges[onward.pop()]) >= len(road.edges[edge]):
        return False
    leading = (edges for edges in road.approaching.values() if len(edges) > 1)
    return any(edge in {road.lanes[c.to].edge for other in edges for _, c in _onward(road, other)} for edges in leading)


def _onward(road: RoadMap, edge: str) -> Iterator[tuple[NetworkLane, Connection]]:
    """Yield the connections of an edge that motor vehicles may take, without u-turns."""
    for lane in (road.lanes[name] for name in road.edges[edge]):
        for c in lane.connections if lane.carriageway else ():
            if is_carriageway(c.classes) and c.movement != "u-turn" and c.to in road.lanes:
                yield lane, c


def _angle(road: RoadMap, lane: NetworkLane, connection: Connection) -> float:
    """Return by how much a connection turns [rad]."""
    before, after = lane.point_at(lane.length)[2], road.lanes[connection.to].point_at(0.0)[2]
    return abs(float(wrap(after - before)))


def _junction_of(lane: NetworkLane) -> str:
    """Return the junction of an internal lane."""
    return lane.id[1:].rsplit("_", 2)[0]
