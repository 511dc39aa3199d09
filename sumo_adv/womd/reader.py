"""Read TFRecord files of Waymo scenarios as :class:`Record` values, one at a time.

A faulty file or record raises a UsageError of one sentence that names both. A reader that continues after faults
reports the error to a callback, and takes the next record. This module needs the extra ``womd`` (protobuf).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import MPH_M_S, Floats
from sumo_adv.errors import UsageError
from sumo_adv.womd.framing import RecordFrame, read_frames
from sumo_adv.womd.record import (
    AreaFeature,
    LaneFeature,
    LineFeature,
    Neighbour,
    ObjectTrack,
    Record,
    SignalState,
    StopSign,
    check_record,
)

MAX_TRACKS_PER_RECORD = 5_000  # maximum number of tracks; records of the dataset have some hundreds
MAX_OBJECT_SIZE_M = 100.0  # a state with a greater length or width counts as invalid
MAX_INDEX_DIGITS = 9  # a longer number counts as an id
_SAFE_ID = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,99}")  # an id becomes the name of a folder
_AREAS = ("crosswalk", "speed_bump", "driveway")
_TRACK_FIELDS = (
    "center_x", "center_y", "length", "width", "heading", "velocity_x", "velocity_y", "center_z", "height",
)  # fmt: skip
"""Fields of a state, in the order of ``ObjectTrack``. The last two are only checked."""

Told = Callable[[UsageError], None]


@dataclass(frozen=True, slots=True)
class RecordChoice:
    """Which records of a file to read. Without any of the fields, all records are read.

    Attributes:
        id: The id of the record.
        index: The index of the record, from 0.
        first: The number of records from the start.
    """

    id: str | None = None
    index: int | None = None
    first: int | None = None


ALL_RECORDS = RecordChoice()


def read_records(path: Path, choice: RecordChoice = ALL_RECORDS, told: Told | None = None) -> Iterator[Record]:
    """Yield the chosen records of a file, each read when it is requested.

    Args:
        path: The file.
        choice: The records to read.
        told: Receives the error of a faulty record, which is then skipped; None raises the error.

    Yields:
        The records.

    Raises:
        UsageError: protobuf is not installed, the file cannot be read, or it has no such record. Without ``told``, also
            if a record is damaged or is no scenario with a map and a current step.
    """
    parse = _parser()
    try:
        with path.open("rb") as file:
            frames = read_frames(file, str(path), skip=choice.index or 0)
            yield from _chosen(_patient(frames, told), path, choice, parse, told)
    except OSError as error:
        raise UsageError(f"The file {path} cannot be read: {error.strerror or error}.") from error


def find_record(path: Path, choice: RecordChoice) -> Record:
    """Return the chosen record.

    The search for an id skips records that cannot be read.

    Args:
        path: The file.
        choice: The record to read.

    Returns:
        The record.

    Raises:
        UsageError: As for ``read_records``.
    """
    wrong: list[UsageError] = []
    try:
        return next(read_records(path, choice, None if choice.id is None else wrong.append))
    except UsageError as error:
        if wrong:
            raise UsageError(f"{str(error).rstrip('.')} that can be read. {wrong[0]}") from error
        raise


def record_message(path: Path, content: str) -> Any:
    """Return a Scenario message by its content.

    Args:
        path: The file.
        content: The SHA-256 of the message's bytes, in hex.

    Returns:
        The message; None if the file does not contain it.

    Raises:
        UsageError: protobuf is not installed, the file cannot be read, or it is damaged before that record.
    """
    parse = _parser()
    try:
        with path.open("rb") as file:
            for frame in read_frames(file, str(path)):
                if frame.data is not None and hashlib.sha256(frame.data).hexdigest() == content:
                    return parse(frame.data)
    except OSError as error:
        raise UsageError(f"The file {path} cannot be read: {error.strerror or error}.") from error
    return None


def choice_of(record: str | None) -> RecordChoice:
    """Return the choice that the option ``--record`` means.

    Args:
        record: The value of the option, an index or an id; None means the first record.

    Returns:
        The choice.
    """
    if record is None:
        return RecordChoice(index=0)
    if record.isascii() and record.isdigit() and len(record) <= MAX_INDEX_DIGITS:
        return RecordChoice(index=int(record))
    return RecordChoice(id=record)


def _parser() -> Callable[[bytes], Any]:
    """Return the function that parses bytes as a Scenario message."""
    try:
        from sumo_adv.womd.scenario_pb2 import Scenario
    except ImportError as error:
        raise UsageError(
            "Waymo records need protobuf, which is not installed: pip install 'sumo-adv[womd]'."
        ) from error
    return Scenario.FromString


def _patient(frames: Iterator[RecordFrame], told: Told | None) -> Iterator[RecordFrame]:
    """Yield frames until their file is damaged, and report or raise that error."""
    try:
        yield from frames
    except UsageError as error:
        if told is None:
            raise
        told(error)


def _chosen(
    frames: Iterator[RecordFrame], path: Path, choice: RecordChoice, parse: Callable[[bytes], Any], told: Told | None
) -> Iterator[Record]:
    """Yield the chosen records of the frames."""
    count = matches = 0
    for frame in islice(frames, choice.first):
        count = frame.number + 1
        if frame.data is None:
            continue
        try:
            record = _read(frame, path, choice.id, parse)
        except UsageError as error:
            if told is None:
                raise
            told(error)
            record = None
        if record is not None:
            matches += 1
            yield record
        if choice.index is not None or (choice.id is not None and record is not None):
            return
    if choice.index is not None:
        raise UsageError(f"{path} has no record {choice.index}: it has {count}, counted from 0.")
    if choice.id is not None and not matches:
        raise UsageError(f"{path} has no record '{choice.id}' among its {count}.")
    if count == 0 and told is None:
        raise UsageError(f"{path} holds no record: it is empty.")


def _read(frame: RecordFrame, path: Path, chosen_id: str | None, parse: Callable[[bytes], Any]) -> Record | None:
    """Return the record of a frame; None if its id is not ``chosen_id``."""
    label = f"Record {frame.number} of {path}"
    if not frame.intact or frame.data is None:
        raise UsageError(f"{label} is damaged: its checksum is wrong; fetch the file again.")
    try:
        message = parse(frame.data)
    except Exception as error:  # usually DecodeError, whose module differs between releases of protobuf
        raise UsageError(f"{label} is not a Scenario message of the Waymo Open Motion Dataset.") from error
    if chosen_id is not None and message.scenario_id != chosen_id:
        return None
    return replace(parse_record(message, label), content=hashlib.sha256(frame.data).hexdigest())


def parse_record(message: Any, where: str) -> Record:
    """Convert a Scenario message to a record.

    Args:
        message: The message.
        where: Names the message in errors.

    Returns:
        The record.

    Raises:
        UsageError: The message has no id, steps, current step, ego or map, contradicts itself, or spans too much.
    """
    name, time = message.scenario_id, np.array(message.timestamps_seconds, dtype=np.float64)
    if not name or not len(time):
        raise UsageError(f"{where} is not a scenario: it has no id or no time stamps (tf.Example files are not read).")
    if isinstance(name, bytes) or _SAFE_ID.fullmatch(name) is None:  # protobuf returns bytes if the id is not UTF-8
        raise UsageError(f"{where} has the id {name[:40]!r}, which cannot be the name of a folder.")
    label = f"{where} ('{name}')"
    if not np.isfinite(time).all() or (np.diff(time) <= 0.0).any():
        raise UsageError(f"{label} has time stamps that do not increase.")
    if not message.HasField("current_time_index") or not 0 <= message.current_time_index < len(time):
        raise UsageError(f"{label} has no current step: it does not say which of its {len(time)} steps is now.")
    if not message.HasField("sdc_track_index") or not 0 <= message.sdc_track_index < len(message.tracks):
        raise UsageError(f"{label} has no ego: its sdc_track_index points at no track.")
    lanes = {f.id: _lane(f, label) for f in message.map_features if f.HasField("lane")}
    if not lanes:
        raise UsageError(f"{label} has no map: it holds no lane, so it cannot be driven.")
    if len(message.tracks) > MAX_TRACKS_PER_RECORD:
        raise UsageError(
            f"{label} has {len(message.tracks):,} tracks, more than the {MAX_TRACKS_PER_RECORD:,} that are read."
        )
    tracks = [_track(t, len(time), label) for t in message.tracks]
    if len({t.id for t in tracks}) < len(tracks):
        raise UsageError(f"{label} has two tracks of the same id.")
    to_predict = tuple(p.track_index for p in message.tracks_to_predict if 0 <= p.track_index < len(tracks))
    record = Record(
        scenario_id=name, time=time, current=message.current_time_index, sdc=message.sdc_track_index, tracks=tracks,
        objects_of_interest=tuple(message.objects_of_interest), to_predict=to_predict, lanes=lanes,
        lines=_lines(message, label), stop_signs=_stop_signs(message, label), areas=_areas(message, label),
        signals=_signals(message, len(time), label),
    )  # fmt: skip
    check_record(record, label)
    return record


def _points(points: Sequence[Any], label: str) -> Floats:
    """Return map points as ``(n, 3)`` [m]."""
    array = np.array([(p.x, p.y, p.z) for p in points], dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(array).all():
        raise UsageError(f"{label} has a map point that is not a finite number.")
    return array


def _lane(feature: Any, label: str) -> LaneFeature:
    lane = feature.lane
    speed = lane.speed_limit_mph * MPH_M_S
    return LaneFeature(
        id=feature.id, points=_points(lane.polyline, label), kind=lane.type,
        speed_limit=speed if np.isfinite(speed) and speed > 0.0 else 0.0, interpolating=lane.interpolating,
        entries=tuple(lane.entry_lanes), exits=tuple(lane.exit_lanes), left=_neighbours(lane.left_neighbors),
        right=_neighbours(lane.right_neighbors),
    )  # fmt: skip


def _neighbours(neighbours: Iterable[Any]) -> tuple[Neighbour, ...]:
    return tuple(
        Neighbour(n.feature_id, n.self_start_index, n.self_end_index, n.neighbor_start_index, n.neighbor_end_index)
        for n in neighbours
    )


def _lines(message: Any, label: str) -> dict[int, LineFeature]:
    lines = {}
    for feature in message.map_features:
        for field, edge in (("road_line", False), ("road_edge", True)):
            if feature.HasField(field):
                line = getattr(feature, field)
                lines[feature.id] = LineFeature(edge, _points(line.polyline, label))
    return lines


def _stop_signs(message: Any, label: str) -> list[StopSign]:
    return [
        StopSign(tuple(f.stop_sign.lane), _points([f.stop_sign.position], label)[0])
        for f in message.map_features
        if f.HasField("stop_sign")
    ]


def _areas(message: Any, label: str) -> list[AreaFeature]:
    return [
        AreaFeature(f.id, kind, _points(getattr(f, kind).polygon, label))
        for f in message.map_features
        for kind in _AREAS
        if f.HasField(kind)
    ]


def _signals(message: Any, steps: int, label: str) -> list[tuple[SignalState, ...]]:
    """Return the signal states of every step; empty for steps that the record does not contain."""
    states = [
        tuple(
            SignalState(s.lane, s.state, _points([s.stop_point], label)[0] if s.HasField("stop_point") else None)
            for s in step.lane_states
        )
        for step in message.dynamic_map_states[:steps]
    ]
    return states + [()] * (steps - len(states))


def _track(track: Any, steps: int, label: str) -> ObjectTrack:
    """Return a track; states with impossible numbers are not valid."""
    if len(track.states) != steps:
        raise UsageError(f"{label} has {len(track.states)} states for its track {track.id}, not one a step ({steps}).")
    columns = np.array([[getattr(state, field) for state in track.states] for field in _TRACK_FIELDS], dtype=np.float64)
    size = columns[2:4]
    sound = np.isfinite(columns).all(axis=0) & (size > 0.0).all(axis=0) & (size < MAX_OBJECT_SIZE_M).all(axis=0)
    valid = np.array([state.valid for state in track.states], dtype=bool) & sound
    return ObjectTrack(track.id, track.object_type, valid, *columns[:-2])
