"""A run as a record of the Waymo Open Motion Dataset: 91 steps of 0.1 s in a TFRecord file.

The takeover is at the current step, 10; where the contact comes more than 8 s after it, the record begins later.
The ego is ``sdc_track_index``; the adversaries are ``objects_of_interest`` and ``tracks_to_predict``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats, Role, Track
from sumo_adv.report.export.entities import HEIGHT, kind
from sumo_adv.report.export.piece import Piece
from sumo_adv.report.export.road import MapLane, map_lanes, network_of, spaced
from sumo_adv.womd.outline import road_outline

STEPS, CURRENT, STEP = 91, 10, 0.1
AFTER = 0.5  # s that a record goes on after the contact
MPH = 0.44704  # m/s
FREEWAY, SURFACE = 1, 2  # LaneCenter.LaneType
FREEWAY_SPEED = 22.5  # m/s, from which a lane is a freeway's
EDGE_BOUNDARY, BROKEN_WHITE = 1, 1  # RoadEdgeType, RoadLineType
TYPES = {"car": 1, "truck": 1, "obstacle": 1, "pedestrian": 2, "bicycle": 3}  # Track.ObjectType


def write_womd(target: Path, piece: Piece) -> None:
    """Write one framed Scenario message. Needs protobuf."""
    from sumo_adv.womd.framing import frame

    target.write_bytes(frame(scenario(piece).SerializeToString(deterministic=True)))


def scenario(piece: Piece) -> Any:
    """The Scenario message. Raises UsageError: the network is unreadable."""
    from sumo_adv.womd.scenario_pb2 import Scenario

    time: Floats = first_step(piece) + STEP * np.arange(STEPS, dtype=np.float64)
    message = Scenario(scenario_id=_safe(piece.name), current_time_index=CURRENT)
    message.timestamps_seconds.extend((STEP * np.arange(STEPS)).tolist())
    numbers = track_numbers(piece)
    shown = [t for t in piece.tracks if _valid(t, time).any()]
    for index, track in enumerate(shown):
        _add_track(message, track, numbers[track.id], time)
        if track.id == piece.ego:
            message.sdc_track_index = index
        elif track.role is Role.ADVERSARY:
            message.objects_of_interest.append(numbers[track.id])
            message.tracks_to_predict.add(track_index=index)
    lanes = map_lanes(piece)
    lines = {each.number: spaced(each.lane.shape) for each in lanes}
    for each in lanes:
        _add_lane(message, each, lines)
    _add_edges(message, lanes, network_of(piece).junctions)
    for _ in range(STEPS):
        message.dynamic_map_states.add()
    return message


def first_step(piece: Piece) -> float:
    """When the record begins [s]: with the takeover at its current step, later if the contact needs it."""
    if piece.takeover is None:
        return piece.begin
    start, contact = piece.takeover - CURRENT * STEP, piece.contact()
    late = 0 if contact is None else math.ceil((min(contact + AFTER, piece.end) - start) / STEP - 1e-6) - (STEPS - 1)
    return start + STEP * max(0, late)


def track_numbers(piece: Piece) -> dict[str, int]:
    """A number for each vehicle: its id where all ids are numbers (a converted record), else its place from 1 on."""
    ids = [t.id for t in piece.tracks]
    if all(i.isascii() and i.isdigit() and len(i) < 10 and str(int(i)) == i for i in ids):
        return {i: int(i) for i in ids}
    return {name: k for k, name in enumerate(ids, 1)}


def _safe(name: str) -> str:
    """The name as the record's id."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", name)[:100] or "run"


def _valid(track: Track, time: Floats) -> Any:
    return (time > track.time[0] - 1e-3) & (time < track.time[-1] + 1e-3)


def _add_track(message: Any, track: Track, number: int, time: Floats) -> None:
    """Its states at the record's times, linear between those of the run; not valid before and after."""
    category = kind(track)
    made = message.tracks.add(id=number, object_type=TYPES[category])
    x, y, speed = (np.interp(time, track.time, v) for v in (track.x, track.y, track.speed))
    heading = np.interp(time, track.time, np.unwrap(track.heading))
    for k, valid in enumerate(_valid(track, time).tolist()):
        if not valid:
            made.states.add(valid=False)
            continue
        made.states.add(
            center_x=x[k], center_y=y[k], center_z=HEIGHT[category] / 2, length=track.length, width=track.width,
            height=HEIGHT[category], heading=np.remainder(heading[k] + np.pi, 2 * np.pi) - np.pi,
            velocity_x=speed[k] * np.cos(heading[k]), velocity_y=speed[k] * np.sin(heading[k]), valid=True,
        )  # fmt: skip


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
