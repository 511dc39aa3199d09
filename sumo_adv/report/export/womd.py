"""A run as a record of the Waymo Open Motion Dataset: 91 steps of 0.1 s in a TFRecord file.

The takeover is at the current step, 10; where the contact comes more than 8 s after it, the record begins later.
The ego is ``sdc_track_index``; the adversaries are ``objects_of_interest`` and ``tracks_to_predict``. A run that was
made of such a record keeps the record's map, signals, numbers and kinds of objects.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats, Role, Track
from sumo_adv.report.export.entities import HEIGHT, kind
from sumo_adv.report.export.piece import Piece
from sumo_adv.report.export.womd_road import Heights, add_net_map, add_record_map, heights_of, record_of

STEPS, CURRENT, STEP = 91, 10, 0.1
AFTER = 0.5  # s that a record goes on after the contact
TYPES = {"car": 1, "truck": 1, "obstacle": 1, "pedestrian": 2, "bicycle": 3}  # Track.ObjectType


def write_womd(target: Path, piece: Piece) -> str | None:
    """Write one framed Scenario message; gives a sentence if the map of the run's record is lost. Needs protobuf."""
    from sumo_adv.womd.framing import frame

    record, lost = record_of(piece)
    target.write_bytes(frame(_scenario(piece, record).SerializeToString(deterministic=True)))
    return lost


def _scenario(piece: Piece, record: Any | None) -> Any:
    """The Scenario message. Raises UsageError: the network is unreadable."""
    from sumo_adv.womd.scenario_pb2 import Scenario

    time: Floats = first_step(piece) + STEP * np.arange(STEPS, dtype=np.float64)
    message = Scenario(scenario_id=_safe(piece.name), current_time_index=CURRENT)
    message.timestamps_seconds.extend((STEP * np.arange(STEPS)).tolist())
    known = {} if record is None else {track.id: track.object_type for track in record.tracks}
    numbers = track_numbers(piece, known)
    heights = None if record is None else heights_of(record)
    shown = [t for t in piece.tracks if _valid(t, time).any()]
    for index, track in enumerate(shown):
        number = numbers[track.id]
        _add_track(message, track, number, known.get(number, TYPES[kind(track)]), time, heights)
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


def first_step(piece: Piece) -> float:
    """When the record begins [s]: with the takeover at its current step, later if the contact needs it."""
    if piece.takeover is None:
        return piece.begin
    start, contact = piece.takeover - CURRENT * STEP, piece.contact()
    late = 0 if contact is None else math.ceil((min(contact + AFTER, piece.end) - start) / STEP - 1e-6) - (STEPS - 1)
    return start + STEP * max(0, late)


def track_numbers(piece: Piece, taken: Collection[int] = ()) -> dict[str, int]:
    """A number for each vehicle: its id where that is one (a converted record), else the next that is not taken."""
    ids = [t.id for t in piece.tracks]
    numbers = {i: int(i) for i in ids if i.isascii() and i.isdigit() and len(i) < 10 and str(int(i)) == i}
    others = [name for name in ids if name not in numbers]
    return numbers | {name: k for k, name in enumerate(others, 1 + max({*numbers.values(), *taken}, default=0))}


def _safe(name: str) -> str:
    """The name as the record's id."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", name)[:100] or "run"


def _valid(track: Track, time: Floats) -> Any:
    return (time > track.time[0] - 1e-3) & (time < track.time[-1] + 1e-3)


def _add_track(
    message: Any, track: Track, number: int, object_type: int, time: Floats, heights: Heights | None
) -> None:  # fmt: skip
    """Its states at the record's times, linear between those of the run; not valid before and after."""
    height = HEIGHT[kind(track)]
    made = message.tracks.add(id=number, object_type=object_type)
    x, y, speed = (np.interp(time, track.time, v) for v in (track.x, track.y, track.speed))
    heading = np.interp(time, track.time, np.unwrap(track.heading))
    z = height / 2 + (np.zeros(len(time)) if heights is None else heights(x, y))
    for k, valid in enumerate(_valid(track, time).tolist()):
        if not valid:
            made.states.add(valid=False)
            continue
        made.states.add(
            center_x=x[k], center_y=y[k], center_z=z[k], length=track.length, width=track.width,
            height=height, heading=np.remainder(heading[k] + np.pi, 2 * np.pi) - np.pi,
            velocity_x=speed[k] * np.cos(heading[k]), velocity_y=speed[k] * np.sin(heading[k]), valid=True,
        )  # fmt: skip
