"""Try a planner in synthetic situations, before it enters a bank and in ``memory verify``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sumo_adv.datatypes import Planner
from sumo_adv.errors import SandboxError
from sumo_adv.geometry import seen_from_segments, wrap
from sumo_adv.road_users import UNPROTECTED_SPEEDS_M_S, RoadUser
from sumo_adv.situation import NO_ARRIVAL_S, fastest_of

if TYPE_CHECKING:
    from sumo_adv.planners.sandbox import Sandbox
    from sumo_adv.planners.session import Call, PlannerSession

# -- synthetic situations -------------------------------------------------------------------------------------------

TRIAL_LENGTH_M, TRIAL_WIDTH_M, TRIAL_LANE_WIDTH_M = 5.0, 1.8, 3.2
TRIAL_HORIZON_S = 8.0
TRIAL_CURVATURE_1_M = 1.0 / 80.0  # of the curve
TRIAL_TIMES_S = (0.0, 2.0, 5.0)  # after the trigger
TRIAL_EGO_SPEEDS_M_S = {"standing": 0.0, "slow": 4.0, "fast": 24.0}  # of the ego
CONFLICT_STATION_M = 45.0  # along the ego's path: where crossing and merging ways meet it

LANE_PLACES_M = {"leader": (18.0, 0.0), "follower": (-16.0, 0.0), "neighbour": (4.0, 3.2), "oncoming": (0.0, 3.2)}
"""The BV's distance ahead of the ego and to its left [m], along the ego's path. An oncoming BV is farther ahead, so
that the two meet at ``CONFLICT_TIME_S``."""

CONFLICT_TIME_S = 6.0

UNPROTECTED_SIZES_M = {
    "pedestrian": (0.5, 0.5), "pedestrian_hidden": (0.5, 0.5), "cyclist": (1.8, 0.6), "cyclist_hidden": (1.8, 0.6),
    "cyclist_straight": (1.8, 0.6),
}  # fmt: skip
"""Length and width [m] of pedestrians and cyclists. They are ``UNPROTECTED_OFFSET_M`` metres beside the ego's path."""

UNPROTECTED_OFFSET_M = 4.0

CROSSING_ANGLES_RAD = {"crossing_straight": 1.57, "crossing_left": 2.2, "crossing_right": 0.7, "merging": 0.25}
"""The BV's heading at the conflict, relative to the ego's path there [rad]."""


@dataclass(frozen=True, slots=True)
class Probe:
    """One synthetic situation: the ``bv``, ``ego`` and ``road`` of a call."""

    name: str
    bv: dict[str, Any]
    ego: dict[str, Any]
    road: dict[str, Any]


Pose = tuple[float, float, float]


def probes(relation: str) -> list[Probe]:
    """Make the synthetic situations of a relation, which vary road shape, ego speed and time after the trigger."""
    make = _small if relation in UNPROTECTED_SIZES_M else _crossing if relation in CROSSING_ANGLES_RAD else _lane
    return [
        make(f"{relation}, {pace}, {shape}, after {time:.0f} s", relation, curvature, speed, time)
        for curvature, shape in ((0.0, "straight"), (TRIAL_CURVATURE_1_M, "curve"))
        for pace, speed in TRIAL_EGO_SPEEDS_M_S.items()
        for time in TRIAL_TIMES_S
    ]


def on_arc(station: float, left: float, curvature: float) -> Pose:
    """Return the pose beside a path that begins at the origin along x.

    Args:
        station: The station on the path [m].
        left: The offset to the left [m].
        curvature: The curvature of the path [1/m].

    Returns:
        x, y [m] and heading [rad].
    """
    turned = station * curvature
    x = math.sin(turned) / curvature if curvature else station
    y = (1.0 - math.cos(turned)) / curvature if curvature else 0.0
    return x - left * math.sin(turned), y + left * math.cos(turned), turned


def _ego(curvature: float, speed: float, time: float, arrivals: list[float]) -> dict[str, Any]:
    path = [[float(t), *on_arc(speed * (time + t), 0.0, curvature), speed] for t in range(9)]
    x, y, heading = path[0][1:4]
    return {
        "x": x, "y": y, "heading": heading, "speed": speed, "acceleration": 0.0,
        "length": TRIAL_LENGTH_M, "width": TRIAL_WIDTH_M,
        "path": path, "arrivals": arrivals,
    }  # fmt: skip


def _lane(name: str, relation: str, curvature: float, speed: float, time: float) -> Probe:
    ahead, left = LANE_PLACES_M[relation]
    oncoming = relation == "oncoming"
    bv_speed = max(speed, 3.0) if oncoming else speed + 1.0
    ahead += CONFLICT_TIME_S * (bv_speed + speed) if oncoming else 0.0
    travelled = bv_speed * time
    station = ahead + (-travelled if oncoming else travelled)
    x, y, h = on_arc(station, left, curvature)
    turned = math.pi if oncoming else 0.0
    step = -2.0 if oncoming else 2.0
    line = [list(on_arc(ahead + step * i, left, curvature)[:2]) for i in range(60)]
    way = {"movement": "straight", "junction": NO_ARRIVAL_S, "conflict": None, "centreline": line}
    bv = _bv((x, y, wrap(h + turned)), bv_speed, travelled, time)
    bv |= {
        "ahead": station - speed * time, "left": left, "relative_heading": turned, "road_heading": h,
        "target_left": 0.0 if time else left, "lateral_time": 1.5 if time == TRIAL_TIMES_S[1] else 0.0,
        "speed_along": -bv_speed if oncoming else bv_speed,
    }  # fmt: skip
    road = _road(relation, left, curvature, bv_speed, (*on_arc(ahead, left, curvature)[:2], turned), way)
    return Probe(name, bv, _ego(curvature, speed, time, [NO_ARRIVAL_S]), road)


def _meeting(
    kind: str, movement: str, junction: float, angle: float, away: float, points: int, curvature: float
) -> tuple[dict[str, Any], Callable[[float], Pose]]:
    """Make a way that begins ``away`` metres before it meets the ego's path, and a function for poses on it."""
    cx, cy, ch = on_arc(CONFLICT_STATION_M, 0.0, curvature)
    heading = wrap(ch + angle)
    c, s = math.cos(heading), math.sin(heading)

    def at(travelled: float) -> Pose:
        return cx + (travelled - away) * c, cy + (travelled - away) * s, heading

    conflict = {
        "kind": kind, "x": cx, "y": cy, "heading": heading, "bv_distance": away, "ego_distance": CONFLICT_STATION_M,
        "angle": angle,
    }  # fmt: skip
    line = [list(at(2.0 * i)[:2]) for i in range(points)]
    return {"movement": movement, "junction": junction, "conflict": conflict, "centreline": line}, at


def _arrival(speed: float, time: float) -> float:
    """Return the time until the ego is where the ways meet [s]."""
    left = CONFLICT_STATION_M - speed * time
    return left / max(speed, 3.0) if left <= 0 else (left / speed if speed > 2.8 else NO_ARRIVAL_S)


def _crossing(name: str, relation: str, curvature: float, speed: float, time: float) -> Probe:
    angle, away, pace = CROSSING_ANGLES_RAD[relation], 40.0, 7.0
    kind = "merging" if relation == "merging" else "crossing"
    movement = relation.removeprefix("crossing_") if relation != "merging" else "right"
    way, at = _meeting(kind, movement, away - 8.0, angle, away, 60, curvature)
    x, y, heading = at(pace * time)
    bv = _bv((x, y, heading), pace, pace * time, time)
    bv |= {
        "ahead": x - speed * time, "left": y, "relative_heading": angle,
        "road_heading": on_arc(CONFLICT_STATION_M, 0.0, curvature)[2], "target_left": y, "lateral_time": 0.0,
        "speed_along": pace * math.cos(angle),
    }  # fmt: skip
    start = at(0.0)
    road = _road(kind, start[1], curvature, pace, start, way)
    return Probe(name, bv, _ego(curvature, speed, time, [_arrival(speed, time)]), road)


def _small(name: str, relation: str, curvature: float, speed: float, time: float) -> Probe:
    """Place a pedestrian who stands beside the road at first, or a cyclist who rides along it. Both may cross and turn
    back; a ``cyclist_straight`` rides where the ego's path crosses its way."""
    cyclist = relation.startswith("cyclist")
    across, at = _meeting("crossing", "across", NO_ARRIVAL_S, math.pi / 2, UNPROTECTED_OFFSET_M, 15, curvature)
    along = [list(on_arc(CONFLICT_STATION_M + 2.0 * i, -UNPROTECTED_OFFSET_M, curvature)[:2]) for i in range(60)]
    onward = {"movement": "along", "junction": NO_ARRIVAL_S, "conflict": None, "centreline": along}
    if relation == "cyclist_straight":
        onward |= {"conflict": {**across["conflict"], "heading": 0.0, "angle": math.pi / 2}}
    ways = [onward] if cyclist else []
    back = _back(across, at)
    pace, ch = 4.0 if cyclist else 1.5, on_arc(CONFLICT_STATION_M, 0.0, curvature)[2]
    travelled = min(pace * time, 20.0)
    station = CONFLICT_STATION_M + travelled
    x, y, heading = on_arc(station, -UNPROTECTED_OFFSET_M, curvature) if cyclist else at(travelled)
    turned, speed_now = heading - ch, pace if cyclist or time else 0.0
    bv = _bv((x, y, heading), speed_now, travelled, time)
    left = -UNPROTECTED_OFFSET_M if cyclist else travelled - UNPROTECTED_OFFSET_M
    bv |= {
        "ahead": (station if cyclist else CONFLICT_STATION_M) - speed * time, "left": left, "relative_heading": turned,
        "road_heading": ch, "target_left": left, "lateral_time": 0.0, "speed_along": speed_now * math.cos(turned),
        "length": UNPROTECTED_SIZES_M[relation][0], "width": UNPROTECTED_SIZES_M[relation][1],
    }  # fmt: skip
    road = _road("crossing", -UNPROTECTED_OFFSET_M, curvature, speed_now, (*at(0.0)[:2], heading), across)
    fastest = UNPROTECTED_SPEEDS_M_S[RoadUser(relation.partition("_")[0])]
    road |= {"ways": [*ways, across, back], "sides": [], "fastest": fastest}
    arrivals = [_arrival(speed, time) if way["conflict"] else NO_ARRIVAL_S for way in road["ways"]]
    return Probe(name, bv, _ego(curvature, speed, time, arrivals), road)


def _back(across: dict[str, Any], at: Callable[[float], Pose]) -> dict[str, Any]:
    """Make a way that follows ``across`` to 2 m past the ego's path, turns within 2 m, and leads back on it."""
    turn = UNPROTECTED_OFFSET_M + 2.0
    line = [list(at(min(2.0 * i, 2.0 * turn + 2.0 - 2.0 * i))[:2]) for i in range(15)]
    meets = across["conflict"] | {
        "heading": wrap(across["conflict"]["heading"] + math.pi), "bv_distance": turn + 4.0, "angle": -math.pi / 2,
    }  # fmt: skip
    return across | {"movement": "back", "conflict": meets, "centreline": line, "turn": [turn, turn + 2.0]}


def _bv(pose: Pose, speed: float, travelled: float, time: float) -> dict[str, Any]:
    x, y, heading = pose
    last = {"x": x, "y": y, "heading": heading, "speed": speed, "time": 2.0} if time else None
    return {
        "x": x, "y": y, "heading": heading, "speed": speed, "acceleration": 0.0, "travelled": travelled, "offset": 0.0,
        "length": TRIAL_LENGTH_M, "width": TRIAL_WIDTH_M, "time": time, "last": last,
    }  # fmt: skip


def _road(
    relation: str, left: float, curvature: float, speed: float, start: Pose, way: dict[str, Any]
) -> dict[str, Any]:
    x, y, heading = start
    return {
        "relation": relation, "left": left, "lane_width": TRIAL_LANE_WIDTH_M, "ways": [way],
        "sides": [{"offset": TRIAL_LANE_WIDTH_M, "kind": "same"}, {"offset": -TRIAL_LANE_WIDTH_M, "kind": "opposite"}],
        "start": {"x": x, "y": y, "heading": heading, "speed": speed},
        "ego_centreline": [list(on_arc(2.0 * i, 0.0, curvature)[:2]) for i in range(100)],
        "fastest": fastest_of(speed), "signals": {"bv": [], "ego": []},
    }  # fmt: skip


# -- the trial ------------------------------------------------------------------------------------------------------

# An endpoint may be this far away, plus this speed times its time
ENDPOINT_REACH_M, ENDPOINT_REACH_SPEED_M_S = 20.0, 60.0
# An endpoint may be this far from every centreline, plus this share of its distance, because bends may be cut
MAX_ROAD_DISTANCE_M, ROAD_DISTANCE_PER_METRE = 10.0, 0.5
TRIAL_ACCELERATIONS_M_S2 = (0.0, -6.0)


def trial(sandbox: Sandbox, planner: Planner, applies: Sequence[str], *, type_check: bool = False) -> str | None:
    """Try a planner in every synthetic situation of its relations.

    The planner must load. Its endpoints must pass the sandbox's checks with all parameters at their defaults, low ends
    and high ends. They must be within reach and near the road, and must not depend on the order of the calls. If the
    planner defines its own ``trajectory``, that must pass the sandbox's checks in a dozen of the situations.

    Args:
        sandbox: Runs the planner.
        planner: The planner.
        applies: The relations in which the planner is tried.
        type_check: Whether to type check the planner's text.

    Returns:
        None if the planner passes, or otherwise a sentence on its first fault.
    """
    situations = [probe for relation in applies for probe in probes(relation)]
    roads = {probe.name: probe.road for probe in situations}
    named = list(_calls(planner, situations))
    calls = [call for _, call in named]
    try:
        with sandbox.session(planner, roads, type_check=type_check) as session:
            # Make one call first, so that a planner that never ends uses its time limit only once
            if (failure := _failure(session, calls[0])) is not None:
                return f"In the situation {named[0][0]!r}: {failure}"
            forth = session.endpoints(calls)
        for (name, call), answer in zip(named, forth, strict=True):
            if (fault := _fault(call, roads[call[0]], answer)) is not None:
                return f"In the situation {name!r}: {fault}"
        with sandbox.session(planner, roads) as session:
            back = session.endpoints(calls[::-1])[::-1]
            for (name, _), answer, again in zip(named, forth, back, strict=True):
                if not isinstance(again, dict) or answer != again:
                    return f"In the situation {name!r}: its answer depends on earlier calls."
            return _own_trajectory(session, named, forth) if session.has_trajectory else None
    except SandboxError as error:
        return str(error)


def trier(sandbox: Sandbox) -> Callable[[Any, Planner], str | None]:
    """Return ``trial`` as a function of an intent's record and a planner, for ``exchange.import_bank``."""
    return lambda intent, planner: trial(sandbox, planner, intent.applies)


def _failure(session: PlannerSession, call: Call) -> SandboxError | None:
    try:
        session.endpoint(*call)
    except SandboxError as error:
        return error
    return None


def _calls(planner: Planner, situations: Sequence[Probe]) -> list[tuple[str, Call]]:
    ends = {
        "defaults": planner.defaults(),
        "low parameters": {p.name: p.low for p in planner.parameters},
        "high parameters": {p.name: p.high for p in planner.parameters},
    }
    return [
        (f"{probe.name}, {words}", (probe.name, probe.bv, probe.ego, values, acceleration, TRIAL_HORIZON_S))
        for probe in situations
        for words, values in ends.items()
        for acceleration in TRIAL_ACCELERATIONS_M_S2
    ]


def _fault(call: Call, road: Mapping[str, Any], answer: dict[str, float] | SandboxError) -> str | None:
    if isinstance(answer, SandboxError):
        return str(answer)
    _, bv, *_ = call
    distance = math.hypot(answer["x"] - bv["x"], answer["y"] - bv["y"])
    if distance > ENDPOINT_REACH_M + ENDPOINT_REACH_SPEED_M_S * answer["time"]:
        return f"it asks for a place {distance:.0f} m away within {answer['time']:.1f} s, which no vehicle reaches."
    lines = [np.asarray(line, float) for line in (road["ego_centreline"], *(way["centreline"] for way in road["ways"]))]
    aside = min(seen_from_segments(line, answer["x"], answer["y"], straight_on=True)[1].min() for line in lines)
    if aside > MAX_ROAD_DISTANCE_M + ROAD_DISTANCE_PER_METRE * distance:
        return f"it asks for a place {aside:.0f} m beside the road."
    return None


def _own_trajectory(
    session: PlannerSession, named: Sequence[tuple[str, Call]], answers: Sequence[dict[str, float] | SandboxError]
) -> str | None:
    """Return a sentence on a fault of the planner's own trajectory in a dozen of the situations, or None."""
    for (name, call), endpoint in list(zip(named, answers, strict=True))[:: max(1, len(named) // 12)]:
        assert isinstance(endpoint, dict)  # failures were returned before
        try:
            session.trajectory(call[0], call[1], endpoint, 0.1)
        except SandboxError as error:
            return f"In the situation {name!r}: {error}"
    return None
