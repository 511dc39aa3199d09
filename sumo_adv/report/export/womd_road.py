"""The map and the signals of a Waymo record: those of the record that a run was made of, else those of its network."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.errors import UsageError
from sumo_adv.report.export.piece import Piece
from sumo_adv.report.export.road import MapLane, map_lanes, network_of, spaced
from sumo_adv.womd.lines import road_outline

MPH = 0.44704  # m/s
FREEWAY, SURFACE = 1, 2  # LaneCenter.LaneType
FREEWAY_SPEED = 22.5  # m/s, from which a lane is a freeway's
EDGE_BOUNDARY, BROKEN_WHITE = 1, 1  # RoadEdgeType, RoadLineType
STOP, CAUTION, GO, FLASHING_STOP, FLASHING_CAUTION = 4, 5, 6, 7, 8  # TrafficSignalLaneState.State
SIGNALS = {
    "r": STOP, "u": STOP, "y": CAUTION, "Y": CAUTION, "g": GO, "G": GO, "s": FLASHING_STOP, "o": FLASHING_CAUTION,
}  # fmt: skip
"""By SUMO's letter; a light that is off (O) is unknown."""
CLOCK = 1e-3  # s
Heights = Callable[[Floats, Floats], Floats]


def record_of(piece: Piece) -> tuple[Any | None, str | None]:
    """The Scenario message that the run was made of; else None, and a sentence if that record is gone."""
    if piece.waymo is None:
        return None, None
    from sumo_adv.womd.reader import record_message

    try:
        message = record_message(piece.waymo.file, piece.waymo.content)
        reason = f"{piece.waymo.file} no longer has the record {piece.waymo.id} as it was."
    except UsageError as error:
        message, reason = None, str(error)
    return message, None if message is not None else f"{reason} So the map is that of the converted network."


def add_record_map(message: Any, record: Any, time: Floats) -> None:
    """The record's own features, and its signals at ``time`` [s from the record's first step]; none after its end."""
    message.map_features.extend(record.map_features)
    clock = np.array(record.timestamps_seconds) - record.timestamps_seconds[0]
    for t, k in zip(time.tolist(), np.searchsorted(clock, time + CLOCK, side="right") - 1, strict=True):
        made = message.dynamic_map_states.add()
        if t <= clock[-1] + CLOCK and 0 <= k < len(record.dynamic_map_states):
            made.CopyFrom(record.dynamic_map_states[k])


def heights_of(record: Any) -> Heights:
    """The height of the ground [m] at points x, y: that of the nearest point of a lane."""
    from shapely import STRtree, points

    lanes = (feature.lane.polyline for feature in record.map_features if feature.HasField("lane"))
    ground = np.array([(p.x, p.y, p.z) for polyline in lanes for p in polyline])
    tree = STRtree(points(ground[:, :2]))
    return lambda x, y: np.asarray(ground[tree.nearest(points(x, y)), 2])


def add_net_map(message: Any, piece: Piece, time: Floats) -> None:
    """Lanes, lines and edges of the network around the run, and the signals that it recorded at ``time`` [s]."""
    lanes = map_lanes(piece)
    lines = {each.number: spaced(each.lane.shape) for each in lanes}
    for each in lanes:
        _add_lane(message, each, lines)
    _add_edges(message, lanes, network_of(piece).junctions)
    _add_signals(message, piece, lanes, time)


def _add_signals(message: Any, piece: Piece, lanes: Sequence[MapLane], time: Floats) -> None:
    """For each link with a light a state of the lane that it leads to, which begins at the stop line."""
    numbers = {each.lane.id: each.number for each in lanes}
    links = sorted(
        (connection.light, number, each.lane.shape[-1].tolist())
        for each in lanes if not each.lane.internal
        for connection in each.lane.connections if connection.light[0]
        for number in [next((numbers[n] for n in (*connection.via, connection.to) if n in numbers), None)]
        if number is not None
    )  # fmt: skip
    for t in time.tolist():
        states = message.dynamic_map_states.add()
        shown = piece.lights.states(t) if t <= piece.end + CLOCK else {}
        for (light, index), number, (x, y) in links:
            if light in shown:
                made = states.lane_states.add(lane=number, state=SIGNALS.get(shown[light][index], 0))
                made.stop_point.x, made.stop_point.y, made.stop_point.z = x, y, 0.0


def _add_lane(message: Any, each: MapLane, lines: Mapping[int, Floats]) -> None:
    """The lane's centre line, and a line at each side that has a neighbour of the same direction."""
    lane = message.map_features.add(id=each.number).lane
    lane.speed_limit_mph = each.lane.speed / MPH
    lane.type = FREEWAY if each.lane.speed >= FREEWAY_SPEED else SURFACE
    lane.interpolating = each.lane.internal
    lane.entry_lanes.extend(each.entries)
    lane.exit_lanes.extend(each.exits)
    _extend(lane.polyline, lines[each.number])
    last = len(lines[each.number]) - 1
    for side, line, neighbour, near, parts in (
        (0, each.left, each.beside_left, lane.left_neighbors, lane.left_boundaries),
        (1, each.right, each.beside_right, lane.right_neighbors, lane.right_boundaries),
    ):
        if neighbour is None:
            continue
        near.add(
            feature_id=neighbour, self_start_index=0, self_end_index=last, neighbor_start_index=0,
            neighbor_end_index=len(lines[neighbour]) - 1,
        )  # fmt: skip
        number = len(lines) + 2 * each.number + side
        parts.add(lane_start_index=0, lane_end_index=last, boundary_feature_id=number, boundary_type=BROKEN_WHITE)
        boundary = message.map_features.add(id=number).road_line
        boundary.type = BROKEN_WHITE
        _extend(boundary.polyline, spaced(line))


def _add_edges(message: Any, lanes: Sequence[MapLane], junctions: Sequence[Floats]) -> None:
    """The outline of all lanes and junctions, with the road to the left of it."""
    from shapely import Polygon, union_all

    strips = [Polygon(np.concatenate([each.left, each.right[::-1]])) for each in lanes]
    road = union_all(strips)
    near = [area for shape in junctions if (area := Polygon(shape)).intersects(road)]
    for number, line in enumerate(road_outline([*strips, *near]), 3 * len(lanes) + 2):  # behind the lines' numbers
        edge = message.map_features.add(id=number).road_edge
        edge.type = EDGE_BOUNDARY
        _extend(edge.polyline, spaced(line))


def _extend(points: Any, line: Floats) -> None:
    for x, y in line.tolist():
        points.add(x=x, y=y, z=0.0)
