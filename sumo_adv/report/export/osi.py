"""A run as an ASAM OSI trace: a GroundTruth a step, each after its length in 4 bytes (little-endian).

Positions are centres of boxes, timestamps are simulation times. The lanes are in the first message only: they do not
change. Objects are numbered in the order of the run from 1; their ids are in ``source_reference``.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

from sumo_adv.datatypes import Role, Track
from sumo_adv.report.export.entities import HEIGHT, kind
from sumo_adv.report.export.mcap import NANO, nanoseconds
from sumo_adv.report.export.piece import Piece
from sumo_adv.report.export.road import map_lanes

LANES = 100_000  # ids of lanes begin behind it
KINDS = {"car": "TYPE_CAR", "truck": "TYPE_HEAVY_TRUCK", "bicycle": "TYPE_BICYCLE"}


def write_osi(target: Path, piece: Piece) -> None:
    """Write the trace. Needs osi-python. Raises UsageError: the network is unreadable."""
    with target.open("wb") as file:
        for step in range(round((piece.end - piece.begin) / piece.step) + 1):
            data = ground_truth(piece, step).SerializeToString(deterministic=True)
            file.write(struct.pack("<I", len(data)) + data)


def ground_truth(piece: Piece, step: int) -> Any:
    """The GroundTruth message of a step, counted from the first exported one."""
    from osi3.osi_groundtruth_pb2 import GroundTruth
    from osi3.osi_version_pb2 import DESCRIPTOR, current_interface_version

    truth, time = GroundTruth(), piece.begin + step * piece.step
    truth.version.CopyFrom(DESCRIPTOR.GetOptions().Extensions[current_interface_version])
    truth.timestamp.seconds, truth.timestamp.nanos = divmod(nanoseconds(time), NANO)
    for number, track in enumerate(piece.tracks, 1):
        if track.id == piece.ego:
            truth.host_vehicle_id.value = number
        k = round((time - float(track.time[0])) / piece.step)
        if 0 <= k < len(track.time):
            _add_object(truth, number, track, k)
    if step == 0:
        _add_lanes(truth, piece)
    return truth


def _add_object(truth: Any, number: int, track: Track, k: int) -> None:
    still = track.role is Role.OBSTACLE
    made = (truth.stationary_object if still else truth.moving_object).add()
    made.id.value = number
    reference = made.source_reference.add(type="sumo_adv")
    reference.identifier.extend([track.id, str(track.role)])
    category, heading, speed = kind(track), float(track.heading[k]), float(track.speed[k])
    base = made.base
    base.dimension.length, base.dimension.width, base.dimension.height = track.length, track.width, HEIGHT[category]
    base.position.x, base.position.y, base.position.z = float(track.x[k]), float(track.y[k]), HEIGHT[category] / 2
    base.orientation.roll = base.orientation.pitch = 0.0
    base.orientation.yaw = heading
    if still:
        made.classification.type = made.classification.TYPE_OTHER
        return
    for vector, value in ((base.velocity, speed), (base.acceleration, float(track.acceleration[k]))):
        vector.x, vector.y, vector.z = value * math.cos(heading), value * math.sin(heading), 0.0
    if category == "pedestrian":
        made.type = made.TYPE_PEDESTRIAN
    else:
        made.type = made.TYPE_VEHICLE
        made.vehicle_classification.type = getattr(made.vehicle_classification, KINDS[category])


def _add_lanes(truth: Any, piece: Piece) -> None:
    for each in map_lanes(piece):
        lane = truth.lane.add()
        lane.id.value = LANES + each.number
        what = lane.classification
        what.type = what.TYPE_INTERSECTION if each.lane.internal else what.TYPE_DRIVING
        what.centerline_is_driving_direction = True
        for x, y in each.lane.shape.tolist():
            what.centerline.add(x=x, y=y, z=0.0)
        sides = (each.beside_left, what.left_adjacent_lane_id), (each.beside_right, what.right_adjacent_lane_id)
        for beside, ids in sides:
            if beside is not None:
                ids.add(value=LANES + beside)
        for before in each.entries or (None,):
            for after in each.exits or (None,):
                pairing = what.lane_pairing.add()
                if before is not None:
                    pairing.antecessor_lane_id.value = LANES + before
                if after is not None:
                    pairing.successor_lane_id.value = LANES + after
