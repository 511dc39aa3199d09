"""Synthetic Waymo records in the dataset's own wire format, for tests without the dataset.

Every builder gives a Scenario message of 91 steps, the current one at 10, with the ego (track 1) among its vehicles;
``write`` frames messages into a file. Right-hand traffic, lanes 3.5 m wide, points 0.5 m apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.womd.framing import frame
from sumo_adv.womd.reader import read_records
from sumo_adv.womd.record import Record
from sumo_adv.womd.scenario_pb2 import Scenario

STEPS, CURRENT = 91, 10
VEHICLE, PEDESTRIAN, CYCLIST = 1, 2, 3
HALF = 1.75  # m, half a lane
Corner = tuple[float, ...]


def write(path: Path, *messages: Any) -> Path:
    """A TFRecord file of messages."""
    path.write_bytes(b"".join(frame(m.SerializeToString()) for m in messages))
    return path


def record(folder: Path, message: Any) -> Record:
    """A message as it is read from a file of its own."""
    return next(iter(read_records(write(folder / "one.tfrecord", message))))


def empty(name: str) -> Any:
    """A scenario with steps and an ego, but no map; the ego stands at the origin."""
    message = Scenario(scenario_id=name, current_time_index=CURRENT, sdc_track_index=0)
    message.timestamps_seconds.extend(0.1 * i for i in range(STEPS))
    for _ in range(STEPS):
        message.dynamic_map_states.add()
    return message


def line(*corners: Corner, step: float = 0.5) -> Floats:
    """Points ``(n, 3)`` every ``step`` m along the corners (x, y[, z]), the last corner included."""
    whole = np.array([(*c, 0.0)[:3] for c in corners], dtype=float)
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(whole[:, :2], axis=0), axis=1))])
    stations = np.append(np.arange(0.0, at[-1] - 0.25 * step, step), at[-1])
    return np.stack([np.interp(stations, at, whole[:, k]) for k in range(3)], axis=1)


def curve(start: Corner, direction: float, end: Corner, final: float) -> Floats:
    """A smooth turn between two poses (headings in rad)."""
    reach = math.hypot(end[0] - start[0], end[1] - start[1]) * 0.55
    a, d = np.array(start[:2]), np.array(end[:2])
    b = a + reach * np.array([math.cos(direction), math.sin(direction)])
    c = d - reach * np.array([math.cos(final), math.sin(final)])
    u = np.linspace(0.0, 1.0, 201)[:, None]
    points = (1 - u) ** 3 * a + 3 * u * (1 - u) ** 2 * b + 3 * u**2 * (1 - u) * c + u**3 * d
    return line(*[tuple(p) for p in points])


def lane(
    message: Any, number: int, points: Floats, *, entries: Sequence[int] = (), exits: Sequence[int] = (),
    speed: float = 30.0, kind: int = 2, interpolating: bool = False,
) -> Any:  # fmt: skip
    """A lane feature; ``speed`` in mph."""
    feature = message.map_features.add(id=number)
    made = feature.lane
    made.type, made.speed_limit_mph, made.interpolating = kind, speed, interpolating
    made.entry_lanes.extend(entries)
    made.exit_lanes.extend(exits)
    for x, y, z in points:
        made.polyline.add(x=x, y=y, z=z)
    return made


def beside(left: Any, right: Any, left_id: int, right_id: int, a: tuple[int, int], b: tuple[int, int]) -> None:
    """Make two lanes neighbours over index ranges: ``a`` of the left lane, ``b`` of the right one."""
    for made, neighbour_id, own, neighbour_range in (
        (left.right_neighbors, right_id, a, b), (right.left_neighbors, left_id, b, a),
    ):  # fmt: skip
        made.add(
            feature_id=neighbour_id, self_start_index=own[0], self_end_index=own[1],
            neighbor_start_index=neighbour_range[0], neighbor_end_index=neighbour_range[1],
        )  # fmt: skip


def track(
    message: Any, number: int, points: Floats, *, start: float, speed: float, kind: int = VEHICLE,
    seen: tuple[int, int] = (0, STEPS), size: tuple[float, float] = (4.6, 1.9),
) -> None:  # fmt: skip
    """An object that moves along ``points`` from station ``start`` at ``speed``, valid in steps ``seen`` only."""
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1))])
    made = message.tracks.add(id=number, object_type=kind)
    for i in range(STEPS):
        state = made.states.add(valid=False)
        s = start + speed * 0.1 * i
        if not seen[0] <= i < seen[1] or s > at[-1]:
            continue
        x, y, z = (float(np.interp(s, at, points[:, k])) for k in range(3))
        k = int(np.clip(np.searchsorted(at, s, side="right"), 1, len(at) - 1))
        heading = math.atan2(*(points[k, :2] - points[k - 1, :2])[::-1])
        state.center_x, state.center_y, state.center_z = x, y, z
        state.length, state.width, state.height, state.heading = size[0], size[1], 1.6, heading
        state.velocity_x, state.velocity_y = speed * math.cos(heading), speed * math.sin(heading)
        state.valid = True


def straight(name: str = "straight") -> Any:
    """Two lanes of 300 m with road edges: ego behind a leader, one beside it seen late, one parked, a pedestrian."""
    message = empty(name)
    right, left = line((0.0, 0.0), (300.0, 0.0)), line((0.0, 3.5), (300.0, 3.5))
    n = len(right) - 1
    made = [lane(message, 11, left), lane(message, 12, right)]
    beside(made[0], made[1], 11, 12, (0, n), (0, n))
    for number, y, course in ((21, 3.5 + HALF, (300.0, 150.0, 0.0)), (22, -HALF, (0.0, 150.0, 300.0))):
        edge = message.map_features.add(id=number).road_edge
        edge.type = 1
        for x in course:  # the road is on the left
            edge.polyline.add(x=x, y=y)
    dashes = message.map_features.add(id=23).road_line
    dashes.type = 1
    for x in (0.0, 300.0):
        dashes.polyline.add(x=x, y=HALF)
    for own, first, second in ((made[0], 23, 21), (made[1], 22, 23)):
        own.right_boundaries.add(lane_start_index=0, lane_end_index=n, boundary_feature_id=first, boundary_type=1)
        own.left_boundaries.add(lane_start_index=0, lane_end_index=n, boundary_feature_id=second, boundary_type=1)
    track(message, 1, right, start=20.0, speed=12.0)
    track(message, 2, right, start=50.0, speed=10.0)
    track(message, 3, left, start=5.0, speed=14.0, seen=(15, STEPS))
    track(message, 4, line((100.0, -3.2), (110.0, -3.2)), start=0.0, speed=0.0)
    track(message, 5, line((60.0, -4.0), (80.0, -4.0)), start=0.0, speed=1.4, kind=PEDESTRIAN, size=(0.8, 0.8))
    message.objects_of_interest.extend((1, 3))
    message.tracks_to_predict.add(track_index=2)
    return message


ARMS = {"e": 0.0, "n": math.pi / 2, "w": math.pi, "s": -math.pi / 2}
_INNER, _OUTER = 14.0, 90.0  # m from the middle where the arms end and begin


def _arm_lane(angle: float, *, inbound: bool) -> Floats:
    u = np.array([math.cos(angle), math.sin(angle)])
    side = np.array([u[1], -u[0]]) * HALF  # right of the way out
    ends = [tuple(u * r + (-side if inbound else side)) for r in (_INNER, _OUTER)]
    return line(*(reversed(ends) if inbound else ends))


def four_way(name: str = "four_way", *, signals: bool = True) -> Any:
    """Four arms of one lane each way, all movements; north-south has green for 5 s, then east-west.

    Lanes: in ``e`` 101, ``n`` 102, ``w`` 103, ``s`` 104; out 201 to 204; from i to j ``300 + 10 i + j``.
    """
    message = empty(name)
    arms = list(ARMS.values())
    turns = [(i, j) for i in range(4) for j in range(4) if i != j]
    for i, angle in enumerate(arms):
        lane(message, 101 + i, _arm_lane(angle, inbound=True), exits=[300 + 10 * a + b for a, b in turns if a == i])
        lane(message, 201 + i, _arm_lane(angle, inbound=False), entries=[300 + 10 * a + b for a, b in turns if b == i])
    ways = {}
    for i, j in turns:
        begin, end = _arm_lane(arms[i], inbound=True)[-1], _arm_lane(arms[j], inbound=False)[0]
        ways[i, j] = curve(tuple(begin), arms[i] + math.pi, tuple(end), arms[j])
        lane(
            message, 300 + 10 * i + j, ways[i, j], entries=[101 + i], exits=[201 + j], interpolating=True, speed=20.0,
        )  # fmt: skip
    if signals:
        for step, states in enumerate(message.dynamic_map_states):
            go = (1, 3) if step < 50 else (0, 2)
            for i, j in turns:
                held = 5 if step in range(40, 50) and i in (1, 3) else 6
                point = _arm_lane(arms[i], inbound=True)[-1]
                made = states.lane_states.add(lane=300 + 10 * i + j, state=held if i in go else 4)
                made.stop_point.x, made.stop_point.y, made.stop_point.z = (float(v) for v in point)
    south = np.concatenate([_arm_lane(arms[3], inbound=True), ways[3, 1][1:], _arm_lane(arms[1], inbound=False)[1:]])
    track(message, 1, south, start=40.0, speed=10.0)
    east = np.concatenate([ways[0, 2], _arm_lane(arms[2], inbound=False)[1:]])
    track(message, 2, east, start=16.0, speed=8.0)  # begins inside the junction
    track(message, 3, _arm_lane(arms[2], inbound=True), start=74.0, speed=0.0)  # waits at the light
    track(
        message, 4, line((10.0, -12.0), (-10.0, -12.0)), start=0.0, speed=1.2, kind=PEDESTRIAN, size=(0.7, 0.7)
    )  # fmt: skip
    track(message, 5, _arm_lane(arms[0], inbound=True), start=10.0, speed=4.0, kind=CYCLIST, size=(1.8, 0.6))
    walk = message.map_features.add(id=401).crosswalk
    for x, y in ((-3.5, -14.0), (3.5, -14.0), (3.5, -11.0), (-3.5, -11.0)):
        walk.polygon.add(x=x, y=y)
    sign = message.map_features.add(id=402).stop_sign
    sign.lane.append(101)
    sign.position.x, sign.position.y = 14.0, 6.0
    return message


def overpass(name: str = "overpass") -> Any:
    """Two roads that cross 6 m above one another and do not meet."""
    message = empty(name)
    below, above = line((-100.0, 0.0, 0.0), (100.0, 0.0, 0.0)), line((0.0, -100.0, 6.0), (0.0, 100.0, 6.0))
    lane(message, 1, below)
    lane(message, 2, above)
    track(message, 1, below, start=10.0, speed=10.0)
    track(message, 2, above, start=10.0, speed=10.0)
    return message


def merge(name: str = "merge") -> Any:
    """A ramp (lane 4) beside the right lane over part of both, then an interpolating lane (5) into it.

    Right lane 1 (0 to 120 m) and 2 (120 to 240 m), left lane 3 (0 to 240 m).
    """
    message = empty(name)
    lines = {
        1: line((0.0, 0.0), (120.0, 0.0)), 2: line((120.0, 0.0), (240.0, 0.0)), 3: line((0.0, 3.5), (240.0, 3.5)),
        4: line((0.0, -30.0), (40.0, -3.5), (90.0, -3.5)), 5: curve((90.0, -3.5), 0.0, (120.0, 0.0), 0.0),
    }  # fmt: skip
    made = {
        1: lane(message, 1, lines[1], exits=[2], speed=55.0),
        2: lane(message, 2, lines[2], entries=[1, 5], speed=55.0),
        3: lane(message, 3, lines[3], speed=55.0),
        4: lane(message, 4, lines[4], exits=[5], speed=35.0),
    }
    lane(message, 5, lines[5], entries=[4], exits=[2], interpolating=True, speed=45.0)
    beside(made[3], made[1], 3, 1, (0, 240), (0, 240))
    beside(made[3], made[2], 3, 2, (240, 480), (0, 240))
    along = int(np.argmin(abs(lines[4][:, 0] - 40.0)))
    beside(made[1], made[4], 1, 4, (80, 180), (along, len(lines[4]) - 1))
    ramp = np.concatenate([lines[4], lines[5][1:], lines[2][1:]])
    main = np.concatenate([lines[1], lines[2][1:]])
    track(message, 1, main, start=10.0, speed=15.0)
    track(message, 2, ramp, start=20.0, speed=12.0)
    return message


def one_point(name: str = "one_point") -> Any:
    """A road with a middle lane of a single point, and a lane without any."""
    message = empty(name)
    first, second = line((0.0, 0.0), (100.0, 0.0)), line((100.0, 0.0), (200.0, 0.0))
    lane(message, 1, first, exits=[2, 3])
    lane(message, 2, first[-1:], entries=[1], exits=[3])
    lane(message, 3, second, entries=[1, 2])
    lane(message, 4, np.empty((0, 3)))
    track(message, 1, np.concatenate([first, second[1:]]), start=5.0, speed=12.0)
    return message


def gap(name: str = "gap") -> Any:
    """A lane with an exit lane that begins 100 m further on."""
    message = empty(name)
    first, second = line((0.0, 0.0), (100.0, 0.0)), line((200.0, 0.0), (300.0, 0.0))
    lane(message, 1, first, exits=[2])
    lane(message, 2, second, entries=[1])
    track(message, 1, line((0.0, 0.0), (300.0, 0.0)), start=5.0, speed=12.0)
    return message


def no_map(name: str = "no_map") -> Any:
    """Tracks without any road."""
    message = empty(name)
    track(message, 1, line((0.0, 0.0), (300.0, 0.0)), start=5.0, speed=12.0)
    return message


WITH_MAP: tuple[Callable[[], Any], ...] = (straight, four_way, overpass, merge, one_point, gap)
