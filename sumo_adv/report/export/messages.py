"""Export a run as MCAP with Foxglove's schemas (for Lichtblick and Foxglove), and as an ASAM OSI trace.

MCAP topics: ``/vehicles`` and ``/road`` (SceneUpdate), ``/ego`` (PoseInFrame), ``/adversaries`` (PosesInFrame) and
``/log`` (Log). If the ego's driver reported them, ``/plan`` (SceneUpdate) and ``/notes`` (JSON) exist, too. The frame
``world`` is the network's.

OSI: There is one GroundTruth for each step, preceded by its length in 4 bytes (little-endian). Only the first message
has the lanes, because they do not change. Objects are numbered from 1 in the order of the run; their ids are in
``source_reference``.

In both formats, times are simulation times, and positions are centres of boxes.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import Role, Track
from sumo_adv.drivers.protocol import DriverInside
from sumo_adv.report.export.piece import HEIGHT_M, ExportedRun, height_of, kind, map_lanes, stands, state_at

FRAME = "world"
ROLE_RGB = {
    Role.EGO: (0.1, 0.4, 0.9), Role.ADVERSARY: (0.95, 0.5, 0.1), Role.BACKGROUND: (0.6, 0.6, 0.6),
    Role.OBSTACLE: (0.4, 0.35, 0.3),
}  # fmt: skip
LINE_WIDTH_M = 0.15  # width at which lines of the road are drawn
NANOSECONDS_PER_S = 1_000_000_000
FIRST_LANE_ID = 100_000  # the ids of OSI's lanes follow this number
OSI_TYPES = {"car": "TYPE_CAR", "truck": "TYPE_HEAVY_TRUCK", "bicycle": "TYPE_BICYCLE"}


def write_mcap(target: Path, piece: ExportedRun) -> None:
    """Write an MCAP file with one message for each topic and step. This needs foxglove-sdk.

    Args:
        target: The file.
        piece: What is exported.

    Raises:
        UsageError: The network cannot be read.
    """
    import foxglove
    from foxglove import channels
    from foxglove import messages as m

    context = foxglove.Context()
    vehicles, road = (channels.SceneUpdateChannel(name, context=context) for name in ("/vehicles", "/road"))
    ego = channels.PoseInFrameChannel("/ego", context=context)
    adversaries = channels.PosesInFrameChannel("/adversaries", context=context)
    log = channels.LogChannel("/log", context=context)
    plan = channels.SceneUpdateChannel("/plan", context=context) if piece.inside else None
    notes = foxglove.Channel("/notes", message_encoding="json", context=context) if piece.inside else None
    with foxglove.open_mcap(target, allow_overwrite=True, context=context):
        road.log(_road(piece), log_time=nanoseconds(piece.begin))
        for each in piece.inside:
            if plan is not None and each.plan:
                plan.log(_plan(each, piece), log_time=nanoseconds(each.time))
            if notes is not None and each.notes:
                notes.log({"time": each.time, **each.notes}, log_time=nanoseconds(each.time))
        said = sorted(_said(piece), key=lambda pair: pair[0])
        for step in range(round((piece.end - piece.begin) / piece.step) + 1):
            time = piece.begin + step * piece.step
            at = nanoseconds(time)
            there = [(t, k) for t in piece.tracks if (k := state_at(t, time, piece.step)) is not None]
            vehicles.log(_scene(there, time, piece.step), log_time=at)
            poses = {t.id: _pose(t, k) for t, k in there}
            if piece.ego in poses:
                ego.log(m.PoseInFrame(timestamp=_stamp(time), frame_id=FRAME, pose=poses[piece.ego]), log_time=at)
            attack = [poses[t.id] for t, _ in there if t.role is Role.ADVERSARY]
            adversaries.log(m.PosesInFrame(timestamp=_stamp(time), frame_id=FRAME, poses=attack), log_time=at)
            while said and said[0][0] < time + piece.step / 2:
                when, text, severe = said.pop(0)
                level = m.LogLevel.Warning if severe else m.LogLevel.Info
                words = m.Log(timestamp=_stamp(when), level=level, message=text, name="sumo_adv")
                log.log(words, log_time=max(at, nanoseconds(when)))


def nanoseconds(time: float) -> int:
    """Convert a time [s] to nanoseconds, rounded to whole microseconds."""
    return round(time * 1e6) * 1000


def _stamp(time: float) -> Any:
    from foxglove.messages import Timestamp

    sec, nsec = divmod(nanoseconds(time), NANOSECONDS_PER_S)
    return Timestamp(sec=sec, nsec=nsec)


def _pose(track: Track, k: int, z: float = 0.0) -> Any:
    from foxglove.messages import Pose, Quaternion, Vector3

    half = float(track.heading[k]) / 2
    return Pose(
        position=Vector3(x=float(track.x[k]), y=float(track.y[k]), z=z + height_of(track, k)),
        orientation=Quaternion(x=0.0, y=0.0, z=math.sin(half), w=math.cos(half)),
    )


def _scene(there: list[tuple[Track, int]], time: float, step: float) -> Any:
    """Make a box for each vehicle; it lasts until the next step."""
    from foxglove import messages as m

    entities = []
    for track, k in there:
        height = HEIGHT_M[kind(track)]
        red, green, blue = ROLE_RGB[track.role]
        cube = m.CubePrimitive(
            pose=_pose(track, k, height / 2), size=m.Vector3(x=track.length, y=track.width, z=height),
            color=m.Color(r=red, g=green, b=blue, a=0.9),
        )  # fmt: skip
        known = {"role": str(track.role), "speed_m_s": f"{track.speed[k]:.4f}", "lane": track.lane[k]}
        entity = m.SceneEntity(
            timestamp=_stamp(time), frame_id=FRAME, id=track.id, cubes=[cube],
            lifetime=m.Duration(sec=0, nsec=round(step * NANOSECONDS_PER_S)),
            metadata=[m.KeyValuePair(key=key, value=value) for key, value in known.items()],
        )  # fmt: skip
        entities.append(entity)
    return m.SceneUpdate(entities=entities)


def _plan(inside: DriverInside, piece: ExportedRun) -> Any:
    """Draw the plan of the ego's driver as a line."""
    from foxglove import messages as m

    red, green, blue = ROLE_RGB[Role.EGO]
    line = m.LinePrimitive(
        type=m.LinePrimitiveLineType.LineStrip, thickness=2 * LINE_WIDTH_M,
        color=m.Color(r=red, g=green, b=blue, a=1.0), points=[m.Point3(x=x, y=y, z=0.0) for x, y in inside.plan],
    )  # fmt: skip
    return m.SceneUpdate(
        entities=[m.SceneEntity(timestamp=_stamp(inside.time), frame_id=FRAME, id=f"plan of {piece.ego}", lines=[line])]
    )


def _road(piece: ExportedRun) -> Any:
    """Draw both sides of each lane, once."""
    from foxglove import messages as m

    entities, strip, grey = [], m.LinePrimitiveLineType.LineStrip, m.Color(r=0.8, g=0.8, b=0.8, a=1.0)
    for each in map_lanes(piece):
        points = [
            [m.Point3(x=x, y=y, z=float(each.height(x, y))) for x, y in line.tolist()]
            for line in (each.left, each.right)
        ]  # fmt: skip
        lines = [m.LinePrimitive(type=strip, thickness=LINE_WIDTH_M, color=grey, points=some) for some in points]
        entities.append(m.SceneEntity(timestamp=_stamp(piece.begin), frame_id=FRAME, id=each.lane.id, lines=lines))
    return m.SceneUpdate(entities=entities)


def _said(piece: ExportedRun) -> list[tuple[float, str, bool]]:
    """Return the log: the time [s], the words, and whether it is a warning."""
    said = [(piece.begin, f"{piece.name}: ego {piece.ego}", False)]
    if piece.adversary is not None and piece.takeover is not None:
        said.append((piece.takeover, f"takeover of {', '.join((piece.adversary, *piece.supports))}", False))
        if (time := piece.contact()) is not None:
            said.append((time, f"contact of {piece.ego} and {piece.adversary}", True))
        said.append((piece.end, f"level: {piece.level}", False))
    return said


def write_osi(target: Path, piece: ExportedRun) -> None:
    """Write an OSI trace of GroundTruth messages. This needs osi-python.

    Args:
        target: The file.
        piece: What is exported.

    Raises:
        UsageError: The network cannot be read.
    """
    with target.open("wb") as file:
        for step in range(round((piece.end - piece.begin) / piece.step) + 1):
            data = _ground_truth(piece, step).SerializeToString(deterministic=True)
            file.write(struct.pack("<I", len(data)) + data)


def _ground_truth(piece: ExportedRun, step: int) -> Any:
    """Make the GroundTruth message of a step, counted from the first exported one; only step 0 has the lanes."""
    from osi3.osi_groundtruth_pb2 import GroundTruth
    from osi3.osi_version_pb2 import DESCRIPTOR, current_interface_version

    truth, time = GroundTruth(), piece.begin + step * piece.step
    truth.version.CopyFrom(DESCRIPTOR.GetOptions().Extensions[current_interface_version])
    truth.timestamp.seconds, truth.timestamp.nanos = divmod(nanoseconds(time), NANOSECONDS_PER_S)
    for number, track in enumerate(piece.tracks, 1):
        if track.id == piece.ego:
            truth.host_vehicle_id.value = number
        if (k := state_at(track, time, piece.step)) is not None:
            _add_object(truth, number, track, k)
    if step == 0:
        _add_lanes(truth, piece)
    return truth


def _add_object(truth: Any, number: int, track: Track, k: int) -> None:
    still = stands(track)
    made = (truth.stationary_object if still else truth.moving_object).add()
    made.id.value = number
    reference = made.source_reference.add(type="sumo_adv")
    reference.identifier.extend([track.id, str(track.role)])
    category, heading, speed = kind(track), float(track.heading[k]), float(track.speed[k])
    base = made.base
    base.dimension.length, base.dimension.width, base.dimension.height = track.length, track.width, HEIGHT_M[category]
    base.position.x, base.position.y = float(track.x[k]), float(track.y[k])
    base.position.z = height_of(track, k) + HEIGHT_M[category] / 2
    base.orientation.roll = base.orientation.pitch = 0.0
    base.orientation.yaw = heading
    if still:
        made.classification.type = made.classification.TYPE_OTHER
        return
    for vector, value in ((base.velocity, speed), (base.acceleration, float(track.acceleration[k]))):
        vector.x, vector.y, vector.z = value * math.cos(heading), value * math.sin(heading), 0.0
    if category == "pedestrian":
        made.type = made.TYPE_PEDESTRIAN
    elif category == "obstacle":
        made.type = made.TYPE_OTHER
    else:
        made.type = made.TYPE_VEHICLE
        made.vehicle_classification.type = getattr(made.vehicle_classification, OSI_TYPES[category])


def _add_lanes(truth: Any, piece: ExportedRun) -> None:
    for each in map_lanes(piece):
        lane = truth.lane.add()
        lane.id.value = FIRST_LANE_ID + each.number
        what = lane.classification
        what.type = what.TYPE_INTERSECTION if each.lane.internal else what.TYPE_DRIVING
        what.centerline_is_driving_direction = True
        for x, y, z in np.column_stack([each.lane.shape, each.height(*each.lane.shape.T)]).tolist():
            what.centerline.add(x=x, y=y, z=z)
        sides = (each.beside_left, what.left_adjacent_lane_id), (each.beside_right, what.right_adjacent_lane_id)
        for beside, ids in sides:
            if beside is not None:
                ids.add(value=FIRST_LANE_ID + beside)
        for before in each.entries or (None,):
            for after in each.exits or (None,):
                pairing = what.lane_pairing.add()
                if before is not None:
                    pairing.antecessor_lane_id.value = FIRST_LANE_ID + before
                if after is not None:
                    pairing.successor_lane_id.value = FIRST_LANE_ID + after
