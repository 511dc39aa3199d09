"""A run as MCAP with Foxglove's schemas, for Lichtblick and Foxglove: vehicles, road, the ego's pose, a log.

Topics: ``/vehicles`` and ``/road`` (SceneUpdate), ``/ego`` (PoseInFrame), ``/adversaries`` (PosesInFrame), ``/log``
(Log). Times are simulation times since 1970; the frame ``world`` is the network's.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from sumo_adv.datatypes import Role, Track
from sumo_adv.report.export.entities import HEIGHT, kind
from sumo_adv.report.export.piece import Piece
from sumo_adv.report.export.road import map_lanes

FRAME = "world"
COLOURS = {
    Role.EGO: (0.1, 0.4, 0.9), Role.ADVERSARY: (0.95, 0.5, 0.1), Role.BACKGROUND: (0.6, 0.6, 0.6),
    Role.OBSTACLE: (0.4, 0.35, 0.3),
}  # fmt: skip
LINE = 0.15  # m, how thick lines of the road are drawn
NANO = 1_000_000_000


def write_mcap(target: Path, piece: Piece) -> None:
    """Write one message a topic and step. Needs foxglove-sdk. Raises UsageError: the network is unreadable."""
    import foxglove
    from foxglove import channels

    context = foxglove.Context()
    vehicles, road = (channels.SceneUpdateChannel(name, context=context) for name in ("/vehicles", "/road"))
    ego = channels.PoseInFrameChannel("/ego", context=context)
    adversaries = channels.PosesInFrameChannel("/adversaries", context=context)
    log = channels.LogChannel("/log", context=context)
    with foxglove.open_mcap(target, allow_overwrite=True, context=context):
        road.log(_road(piece), log_time=nanoseconds(piece.begin))
        said = sorted(_said(piece), key=lambda pair: pair[0])
        for step in range(round((piece.end - piece.begin) / piece.step) + 1):
            time = piece.begin + step * piece.step
            at = nanoseconds(time)
            there = [(t, k) for t in piece.tracks if (k := _index(t, time, piece.step)) is not None]
            vehicles.log(_scene(there, time, piece.step), log_time=at)
            poses = {t.id: _pose(t, k) for t, k in there}
            if piece.ego in poses:
                ego.log(_messages().PoseInFrame(**_stamp(time), pose=poses[piece.ego]), log_time=at)
            attack = [poses[t.id] for t, _ in there if t.role is Role.ADVERSARY]
            adversaries.log(_messages().PosesInFrame(**_stamp(time), poses=attack), log_time=at)
            while said and said[0][0] < time + piece.step / 2:
                when, text, severe = said.pop(0)
                log.log(_log(when, text, severe), log_time=max(at, nanoseconds(when)))


def nanoseconds(time: float) -> int:
    """A time [s] as MCAP has it, whole microseconds."""
    return round(time * 1e6) * 1000


def _messages() -> Any:
    from foxglove import messages

    return messages


def _stamp(time: float, name: str = "timestamp") -> dict[str, Any]:
    sec, nsec = divmod(nanoseconds(time), NANO)
    return {name: _messages().Timestamp(sec=sec, nsec=nsec), "frame_id": FRAME}


def _index(track: Track, time: float, step: float) -> int | None:
    k = round((time - float(track.time[0])) / step)
    return k if 0 <= k < len(track.time) else None


def _pose(track: Track, k: int, z: float = 0.0) -> Any:
    m, half = _messages(), float(track.heading[k]) / 2
    return m.Pose(
        position=m.Vector3(x=float(track.x[k]), y=float(track.y[k]), z=z),
        orientation=m.Quaternion(x=0.0, y=0.0, z=math.sin(half), w=math.cos(half)),
    )


def _scene(there: list[tuple[Track, int]], time: float, step: float) -> Any:
    """A box a vehicle, which lasts until the next step."""
    m, entities = _messages(), []
    for track, k in there:
        height = HEIGHT[kind(track)]
        red, green, blue = COLOURS[track.role]
        cube = m.CubePrimitive(
            pose=_pose(track, k, height / 2), size=m.Vector3(x=track.length, y=track.width, z=height),
            color=m.Color(r=red, g=green, b=blue, a=0.9),
        )  # fmt: skip
        known = {"role": str(track.role), "speed_m_s": f"{track.speed[k]:.4f}", "lane": track.lane[k]}
        entities.append(
            m.SceneEntity(
                **_stamp(time),
                id=track.id,
                lifetime=m.Duration(sec=0, nsec=round(step * NANO)),
                cubes=[cube],
                metadata=[m.KeyValuePair(key=key, value=value) for key, value in known.items()],
            )
        )
    return m.SceneUpdate(entities=entities)


def _road(piece: Piece) -> Any:
    """Both sides of each lane, once."""
    m, entities = _messages(), []
    for each in map_lanes(piece):
        lines = [
            m.LinePrimitive(
                type=m.LinePrimitiveLineType.LineStrip, thickness=LINE, color=m.Color(r=0.8, g=0.8, b=0.8, a=1.0),
                points=[m.Point3(x=x, y=y, z=0.0) for x, y in line.tolist()],
            )
            for line in (each.left, each.right)
        ]  # fmt: skip
        entities.append(m.SceneEntity(**_stamp(piece.begin), id=each.lane.id, lines=lines))
    return m.SceneUpdate(entities=entities)


def _said(piece: Piece) -> list[tuple[float, str, bool]]:
    """Time [s], words, and whether it is bad news."""
    said = [(piece.begin, f"{piece.name}: ego {piece.ego}", False)]
    if piece.adversary is not None and piece.takeover is not None:
        said.append((piece.takeover, f"takeover of {', '.join((piece.adversary, *piece.supports))}", False))
        if (time := piece.contact()) is not None:
            said.append((time, f"contact of {piece.ego} and {piece.adversary}", True))
        said.append((piece.end, f"level: {piece.level}", False))
    return said


def _log(time: float, text: str, severe: bool) -> Any:
    m = _messages()
    sec, nsec = divmod(nanoseconds(time), NANO)
    level = m.LogLevel.Warning if severe else m.LogLevel.Info
    return m.Log(timestamp=m.Timestamp(sec=sec, nsec=nsec), level=level, message=text, name="sumo_adv")
