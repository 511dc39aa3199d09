"""Export a run as a record of the Waymo Open Motion Dataset: 91 steps of 0.1 s in a TFRecord file.

The takeover is at the current step, 10. If the contact comes more than 8 s after the takeover, the record begins later.
The ego is ``sdc_track_index``. The adversaries are ``objects_of_interest`` and ``tracks_to_predict``. A run whose input
is such a record keeps the record's map, signals, numbers and object types. Otherwise these come from the network.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import MPH_M_S, Bools, Floats, Role, Track
from sumo_adv.errors import UsageError
from sumo_adv.report.export.piece import HEIGHT_M, ExportedRun, MapLane, kind, map_lanes, spaced
from sumo_adv.report.page_road import network
from sumo_adv.womd.lines import road_outline

RECORD_STEPS, CURRENT_STEP, RECORD_STEP_S = 91, 10, 0.1
EXPORTED_AFTER_CONTACT_S = 0.5  # the record ends at least this long after the contact
OBJECT_TYPES = {"car": 1, "truck": 1, "obstacle": 1, "pedestrian": 2, "bicycle": 3}  # Track.ObjectType
FREEWAY, SURFACE = 1, 2  # LaneCenter.LaneType
FREEWAY_SPEED_M_S = 22.5  # a lane with at least this speed limit is a freeway's
EDGE_BOUNDARY, BROKEN_WHITE = 1, 1  # RoadEdgeType, RoadLineType
SIGNAL_STOP, SIGNAL_CAUTION, SIGNAL_GO = 4, 5, 6  # TrafficSignalLaneState.State
SIGNAL_FLASHING_STOP, SIGNAL_FLASHING_CAUTION = 7, 8
SIGNAL_STATE_NUMBERS = {
    "r": SIGNAL_STOP, "u": SIGNAL_STOP, "y": SIGNAL_CAUTION, "Y": SIGNAL_CAUTION, "g": SIGNAL_GO, "G": SIGNAL_GO,
    "s": SIGNAL_FLASHING_STOP, "o": SIGNAL_FLASHING_CAUTION,
}  # fmt: skip
"""The state for each of SUMO's letters. A light that is off (O) is unknown."""
CLOCK_STEP_S = 1e-3
Heights = Callable[[Floats, Floats], Floats]


def write_womd(target: Path, piece: ExportedRun) -> str | None:
    """Write one framed Scenario message. This needs protobuf.

    Args:
        target: The file.
        piece: What is exported.

    Returns:
        A sentence if the map of the run's record is lost, otherwise None.

    Raises:
        UsageError: The network cannot be read.
    """
    from sumo_adv.womd.framing import frame

    record, lost = record_of(piece)
    target.write_bytes(frame(_scenario(piece, record).SerializeToString(deterministic=True)))
    return lost


def _scenario(piece: ExportedRun, record: Any | None) -> Any:
    """Assemble the Scenario message. Raise UsageError if the network cannot be read."""
    from sumo_adv.womd.scenario_pb2 import Scenario

    time: Floats = first_step(piece) + RECORD_STEP_S * np.arange(RECORD_STEPS, dtype=np.float64)
    message = Scenario(
        scenario_id=re.sub(r"[^A-Za-z0-9_.-]", "_", piece.name)[:100] or "run", current_time_index=CURRENT_STEP
    )
    message.timestamps_seconds.extend((RECORD_STEP_S * np.arange(RECORD_STEPS)).tolist())
    known = {} if record is None else {track.id: track.object_type for track in record.tracks}
    numbers = track_numbers(piece, known)
    heights = None if record is None else heights_of(record)
    shown = [t for t in piece.tracks if _valid(t, time, piece.step).any()]
    for index, track in enumerate(shown):
        number = numbers[track.id]
        object_type = known.get(number, OBJECT_TYPES[kind(track)])
        _add_track(message, track, number, object_type, time, _valid(track, time, piece.step), heights)
        if track.id == piece.ego:
            message.sdc_track_index = index
        elif track.role is Role.ADVERSARY:
            message.objects_of_interest.append(number)
            message.tracks_to_predict.add(track_index=index)
    if record is None:
        add_net_map(message, piece, time)
    else:
        add_record_map(message, record, time)
    return message


def first_step(piece: ExportedRun) -> float:
    """Return the time of the record's first step.

    The takeover is at the current step. The record begins later if the contact needs it.

    Args:
        piece: What is exported.

    Returns:
        The time [s].
    """
    if piece.takeover is None:
        return piece.begin
    start, contact = piece.takeover - CURRENT_STEP * RECORD_STEP_S, piece.contact()
    late = (
        0
        if contact is None
        else math.ceil((min(contact + EXPORTED_AFTER_CONTACT_S, piece.end) - start) / RECORD_STEP_S - 1e-6)
        - (RECORD_STEPS - 1)
    )
    return start + RECORD_STEP_S * max(0, late)


def track_numbers(piece: ExportedRun, taken: Collection[int]) -> dict[str, int]:
    """Number the vehicles.

    Args:
        piece: What is exported.
        taken: Numbers that are already used.

    Returns:
        A number for each vehicle: its id if that is a number, as in a converted record, otherwise a number that is not
            taken.
    """
    ids = [t.id for t in piece.tracks]
    numbers = {i: int(i) for i in ids if i.isascii() and i.isdigit() and len(i) < 10 and str(int(i)) == i}
    others = [name for name in ids if name not in numbers]
    return numbers | {name: k for k, name in enumerate(others, 1 + max({*numbers.values(), *taken}, default=0))}


def _valid(track: Track, time: Floats, step: float) -> Bools:
    """Return at which times a track has states or is between two states that follow each other."""
    after = np.searchsorted(track.time, time - CLOCK_STEP_S)  # the first state that is not before each time
    low, high = track.time[np.maximum(after - 1, 0)], track.time[np.minimum(after, len(track.time) - 1)]
    at_state = np.abs(high - time) < CLOCK_STEP_S
    between = (low < time) & (time < high) & (high - low < 1.5 * step)
    return np.asarray(at_state | between)


def _add_track(
    message: Any, track: Track, number: int, object_type: int, time: Floats, valid: Bools, heights: Heights | None
) -> None:
    """Add a track: its states at the record's times are interpolated, and not valid where the run has none."""
    height = HEIGHT_M[kind(track)]
    made = message.tracks.add(id=number, object_type=object_type)
    x, y, speed = (np.interp(time, track.time, v) for v in (track.x, track.y, track.speed))
    heading = np.interp(time, track.time, np.unwrap(track.heading))
    own = np.interp(time, track.time, np.broadcast_to(track.z, track.time.shape))
    z = height / 2 + (own if heights is None else heights(x, y))
    for k, is_valid in enumerate(valid.tolist()):
        if not is_valid:
            made.states.add(valid=False)
            continue
        made.states.add(
            center_x=x[k], center_y=y[k], center_z=z[k], length=track.length, width=track.width,
            height=height, heading=np.remainder(heading[k] + np.pi, 2 * np.pi) - np.pi,
            velocity_x=speed[k] * np.cos(heading[k]), velocity_y=speed[k] * np.sin(heading[k]), valid=True,
        )  # fmt: skip


def record_of(piece: ExportedRun) -> tuple[Any | None, str | None]:
    """Read the Scenario message that the run's input was converted from.

    Args:
        piece: What is exported.

    Returns:
        The message, or None if there is none, and a sentence if the record is gone.
    """
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
    """Copy the map and the signals of a record.

    Args:
        message: The Scenario message to fill.
        record: The record.
        time: The times of the message's steps, from the record's first step [s]. There are no signals after the
            record's end.
    """
    message.map_features.extend(record.map_features)
    clock = np.array(record.timestamps_seconds) - record.timestamps_seconds[0]
    for t, k in zip(time.tolist(), np.searchsorted(clock, time + CLOCK_STEP_S, side="right") - 1, strict=True):
        made = message.dynamic_map_states.add()
        if t <= clock[-1] + CLOCK_STEP_S and 0 <= k < len(record.dynamic_map_states):
            made.CopyFrom(record.dynamic_map_states[k])


def heights_of(record: Any) -> Heights:
    """Make a function that returns the height of the ground [m] at points x, y: that of the nearest point of a lane."""
    from shapely import STRtree, points

    lanes = (feature.lane.polyline for feature in record.map_features if feature.HasField("lane"))
    ground = np.array([(p.x, p.y, p.z) for polyline in lanes for p in polyline])
    tree = STRtree(points(ground[:, :2]))
    return lambda x, y: np.asarray(ground[tree.nearest(points(x, y)), 2])


def add_net_map(message: Any, piece: ExportedRun, time: Floats) -> None:
    """Add lanes, lines and edges of the network around the run, and the recorded signals.

    Args:
        message: The Scenario message to fill.
        piece: What is exported.
        time: The times of the message's steps [s].
    """
    lanes = map_lanes(piece)
    lines = {each.number: spaced(each.lane.shape) for each in lanes}
    for each in lanes:
        _add_lane(message, each, lines)
    _add_edges(message, lanes, network(piece.network).junctions)
    _add_signals(message, piece, lanes, time)


def _add_signals(message: Any, piece: ExportedRun, lanes: Sequence[MapLane], time: Floats) -> None:
    """Add for each signalled link a state of the lane that it leads to, which begins at the stop line."""
    numbers = {each.lane.id: each.number for each in lanes}
    links = sorted(
        (connection.light, number, [*each.lane.shape[-1].tolist(), float(each.height(*each.lane.shape[-1]))])
        for each in lanes if not each.lane.internal
        for connection in each.lane.connections if connection.light[0]
        for number in [next((numbers[n] for n in (*connection.via, connection.to) if n in numbers), None)]
        if number is not None
    )  # fmt: skip
    for t in time.tolist():
        states = message.dynamic_map_states.add()
        shown = piece.lights.states(t) if t <= piece.end + CLOCK_STEP_S else {}
        for (light, index), number, (x, y, z) in links:
            if light in shown:
                made = states.lane_states.add(lane=number, state=SIGNAL_STATE_NUMBERS.get(shown[light][index], 0))
                made.stop_point.x, made.stop_point.y, made.stop_point.z = x, y, z


def _add_lane(message: Any, each: MapLane, lines: Mapping[int, Floats]) -> None:
    """Add a lane's centreline, and a line at each side that has a neighbour in the same direction."""
    lane = message.map_features.add(id=each.number).lane
    lane.speed_limit_mph = each.lane.speed / MPH_M_S
    lane.type = FREEWAY if each.lane.speed >= FREEWAY_SPEED_M_S else SURFACE
    lane.interpolating = each.lane.internal
    lane.entry_lanes.extend(each.entries)
    lane.exit_lanes.extend(each.exits)
    _extend(lane.polyline, lines[each.number], each)
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
        _extend(boundary.polyline, spaced(line), each)


def _add_edges(message: Any, lanes: Sequence[MapLane], junctions: Sequence[Floats]) -> None:
    """Add the outline of all lanes and junctions, with the road to its left."""
    from shapely import Polygon, union_all

    strips = [Polygon(np.concatenate([each.left, each.right[::-1]])) for each in lanes]
    road = union_all(strips)
    near = [area for shape in junctions if (area := Polygon(shape)).intersects(road)]
    for number, line in enumerate(road_outline([*strips, *near]), 3 * len(lanes) + 2):  # after the lines' numbers
        edge = message.map_features.add(id=number).road_edge
        edge.type = EDGE_BOUNDARY
        _extend(edge.polyline, spaced(line), _nearest(lanes, line))


def _nearest(lanes: Sequence[MapLane], line: Floats) -> MapLane | None:
    """Return the lane that is nearest to a line, for its height; None without lanes."""
    from shapely import LineString, distance, linestrings

    if not lanes:
        return None
    return lanes[int(np.argmin(distance([linestrings(each.lane.shape) for each in lanes], LineString(line))))]


def _extend(points: Any, line: Floats, lane: MapLane | None) -> None:
    """Add the points of a line at the height of a lane."""
    z = np.zeros(len(line)) if lane is None else lane.height(*line.T)
    for x, y, height in np.column_stack([line, z]).tolist():
        points.add(x=x, y=y, z=height)
