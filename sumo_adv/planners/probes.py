"""Made-up situations for trials of planners, with the observations of ``AdversaryBatch`` written by hand.

Each relation has 18 situations. The ego stands, drives slowly or drives fast, on a straight road or in a left-hand
curve. The BV is at the trigger, 2 s later in the middle of a move sideways, or 5 s later.
Frame: the ego's pose at the trigger, x forward, y left; SI units.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from sumo_adv.geometry import wrap
from sumo_adv.road_users import FASTEST, RoadUser
from sumo_adv.situation import NO_ARRIVAL, fastest_of

LENGTH, WIDTH, LANE_WIDTH = 5.0, 1.8, 3.2  # m
HORIZON = 8.0  # s
CURVATURE = 1.0 / 80.0  # 1/m, of the curve
TIMES = (0.0, 2.0, 5.0)  # s after the trigger
SPEEDS = {"standing": 0.0, "slow": 4.0, "fast": 24.0}  # m/s, of the ego
CONFLICT = 45.0  # m along the ego's path: where crossing and merging ways meet it

LANE_PLACES = {"leader": (18.0, 0.0), "follower": (-16.0, 0.0), "neighbour": (4.0, 3.2), "oncoming": (0.0, 3.2)}
"""m ahead and to the left, along the ego's path. An oncoming BV is farther ahead and meets the ego after ``MEET``."""

MEET = 6.0  # s

SIZES = {
    "pedestrian": (0.5, 0.5), "pedestrian_hidden": (0.5, 0.5), "cyclist": (1.8, 0.6), "cyclist_hidden": (1.8, 0.6),
}  # fmt: skip
"""m, of the road users that are no vehicles. They are ``BESIDE`` metres beside the ego's path."""

BESIDE = 4.0

CROSSING_ANGLES = {"crossing_straight": 1.57, "crossing_left": 2.2, "crossing_right": 0.7, "merging": 0.25}
"""rad: the BV's heading at the conflict, relative to the ego's path there."""


@dataclass(frozen=True, slots=True)
class Probe:
    """One call's ``bv``, ``ego`` and ``road``."""

    name: str
    bv: dict[str, Any]
    ego: dict[str, Any]
    road: dict[str, Any]


Pose = tuple[float, float, float]


def probes(relation: str) -> list[Probe]:
    """All situations of one of the bank's relations."""
    return list(_probes(relation))


def _probes(relation: str) -> Iterator[Probe]:
    small = relation in SIZES
    for curvature, shape in ((0.0, "straight"), (CURVATURE, "curve")):
        for pace, speed in SPEEDS.items():
            for time in TIMES:
                name = f"{relation}, {pace}, {shape}, after {time:.0f} s"
                crossing = relation in CROSSING_ANGLES
                yield (_small if small else _crossing if crossing else _lane)(name, relation, curvature, speed, time)


def on_arc(station: float, left: float, curvature: float) -> Pose:
    """The pose beside a path that begins at the origin along x."""
    turned = station * curvature
    x = math.sin(turned) / curvature if curvature else station
    y = (1.0 - math.cos(turned)) / curvature if curvature else 0.0
    return x - left * math.sin(turned), y + left * math.cos(turned), turned


def _ego(curvature: float, speed: float, time: float, arrivals: list[float]) -> dict[str, Any]:
    path = []
    for t in range(9):
        path.append([float(t), *on_arc(speed * (time + t), 0.0, curvature), speed])
    x, y, heading = path[0][1:4]
    return {
        "x": x, "y": y, "heading": heading, "speed": speed, "acceleration": 0.0, "length": LENGTH, "width": WIDTH,
        "path": path, "arrivals": arrivals,
    }  # fmt: skip


def _lane(name: str, relation: str, curvature: float, speed: float, time: float) -> Probe:
    ahead, left = LANE_PLACES[relation]
    oncoming = relation == "oncoming"
    bv_speed = max(speed, 3.0) if oncoming else speed + 1.0
    ahead += MEET * (bv_speed + speed) if oncoming else 0.0
    travelled = bv_speed * time
    station = ahead + (-travelled if oncoming else travelled)
    x, y, h = on_arc(station, left, curvature)
    turned = math.pi if oncoming else 0.0
    step = -2.0 if oncoming else 2.0
    line = [list(on_arc(ahead + step * i, left, curvature)[:2]) for i in range(60)]
    way = {"movement": "straight", "junction": NO_ARRIVAL, "conflict": None, "centreline": line}
    bv = _bv((x, y, wrap(h + turned)), bv_speed, travelled, time, (x, y))
    bv |= {
        "ahead": station - speed * time, "left": left, "relative_heading": turned, "road_heading": h,
        "target_left": 0.0 if time else left, "lateral_time": 1.5 if time == TIMES[1] else 0.0,
        "speed_along": -bv_speed if oncoming else bv_speed,
    }  # fmt: skip
    road = _road(relation, left, curvature, bv_speed, (*on_arc(ahead, left, curvature)[:2], turned), way)
    return Probe(name, bv, _ego(curvature, speed, time, [NO_ARRIVAL]), road)


def _crossing(name: str, relation: str, curvature: float, speed: float, time: float) -> Probe:
    cx, cy, ch = on_arc(CONFLICT, 0.0, curvature)
    heading = wrap(ch + CROSSING_ANGLES[relation])
    c, s = math.cos(heading), math.sin(heading)
    away = 40.0  # m from the conflict at the trigger
    bv_speed = 7.0
    travelled = bv_speed * time
    line = [[cx + (2.0 * i - away) * c, cy + (2.0 * i - away) * s] for i in range(60)]
    conflict = {
        "kind": "merging" if relation == "merging" else "crossing", "x": cx, "y": cy, "heading": heading,
        "bv_distance": away, "ego_distance": CONFLICT, "angle": CROSSING_ANGLES[relation],
    }  # fmt: skip
    movement = relation.removeprefix("crossing_") if relation != "merging" else "right"
    way = {"movement": movement, "junction": away - 8.0, "conflict": conflict, "centreline": line}
    x, y = cx + (travelled - away) * c, cy + (travelled - away) * s
    ego_left = CONFLICT - speed * time
    arrival = ego_left / max(speed, 3.0) if ego_left <= 0 else (ego_left / speed if speed > 2.8 else NO_ARRIVAL)
    bv = _bv((x, y, heading), bv_speed, travelled, time, (x, y))
    bv |= {
        "ahead": x - speed * time, "left": y, "relative_heading": CROSSING_ANGLES[relation], "road_heading": ch,
        "target_left": y, "lateral_time": 0.0, "speed_along": bv_speed * math.cos(CROSSING_ANGLES[relation]),
    }  # fmt: skip
    start = (cx - away * c, cy - away * s, heading)
    road = _road("merging" if relation == "merging" else "crossing", start[1], curvature, bv_speed, start, way)
    return Probe(name, bv, _ego(curvature, speed, time, [arrival]), road)


def _small(name: str, relation: str, curvature: float, speed: float, time: float) -> Probe:
    """A pedestrian that stands beside the road at first, or a cyclist that rides along it; both may cross."""
    cyclist = relation.startswith("cyclist")
    cx, cy, ch = on_arc(CONFLICT, 0.0, curvature)
    heading = wrap(ch + math.pi / 2)
    c, s = math.cos(heading), math.sin(heading)
    pace = 4.0 if cyclist else 1.5
    travelled = min(pace * time, 20.0)
    conflict = {
        "kind": "crossing", "x": cx, "y": cy, "heading": heading, "bv_distance": BESIDE, "ego_distance": CONFLICT,
        "angle": math.pi / 2,
    }  # fmt: skip
    line = [[cx + (2.0 * i - BESIDE) * c, cy + (2.0 * i - BESIDE) * s] for i in range(15)]
    across = {"movement": "across", "junction": NO_ARRIVAL, "conflict": conflict, "centreline": line}
    along = [list(on_arc(CONFLICT + 2.0 * i, -BESIDE, curvature)[:2]) for i in range(60)]
    ways = [{"movement": "along", "junction": NO_ARRIVAL, "conflict": None, "centreline": along}] if cyclist else []
    x, y = cx + (travelled - BESIDE) * c, cy + (travelled - BESIDE) * s
    if cyclist:
        x, y, heading = on_arc(CONFLICT + travelled, -BESIDE, curvature)
    turned = heading - ch
    ego_left = CONFLICT - speed * time
    arrival = ego_left / max(speed, 3.0) if ego_left <= 0 else (ego_left / speed if speed > 2.8 else NO_ARRIVAL)
    speed_now = pace if cyclist or time else 0.0
    bv = _bv((x, y, heading), speed_now, travelled, time, (x, y))
    left = -BESIDE if cyclist else travelled - BESIDE
    bv |= {
        "ahead": CONFLICT + (travelled if cyclist else 0.0) - speed * time, "left": left, "relative_heading": turned,
        "road_heading": ch, "target_left": left, "lateral_time": 0.0, "speed_along": speed_now * math.cos(turned),
        "length": SIZES[relation][0], "width": SIZES[relation][1],
    }  # fmt: skip
    start = (cx - BESIDE * c, cy - BESIDE * s, heading)
    road = _road("crossing", -BESIDE, curvature, speed_now, start, across)
    road |= {"ways": [*ways, across], "sides": [], "fastest": FASTEST[RoadUser(relation.removesuffix("_hidden"))]}
    return Probe(name, bv, _ego(curvature, speed, time, [NO_ARRIVAL] * len(ways) + [arrival]), road)


def _bv(pose: Pose, speed: float, travelled: float, time: float, here: tuple[float, float]) -> dict[str, Any]:
    x, y, heading = pose
    last = {"x": here[0], "y": here[1], "heading": heading, "speed": speed, "time": 2.0} if time else None
    return {
        "x": x, "y": y, "heading": heading, "speed": speed, "acceleration": 0.0, "travelled": travelled, "offset": 0.0,
        "length": LENGTH, "width": WIDTH, "time": time, "last": last,
    }  # fmt: skip


def _road(
    relation: str, left: float, curvature: float, speed: float, start: Pose, way: dict[str, Any]
) -> dict[str, Any]:
    x, y, heading = start
    return {
        "relation": relation, "left": left, "lane_width": LANE_WIDTH, "ways": [way],
        "sides": [{"offset": LANE_WIDTH, "kind": "same"}, {"offset": -LANE_WIDTH, "kind": "opposite"}],
        "start": {"x": x, "y": y, "heading": heading, "speed": speed},
        "ego_centreline": [list(on_arc(2.0 * i, 0.0, curvature)[:2]) for i in range(100)],
        "fastest": fastest_of(speed), "signals": {"bv": [], "ego": []},
    }  # fmt: skip
