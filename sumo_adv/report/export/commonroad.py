"""Export a run as a CommonRoad scenario with a solution, and as a ScenarioNet database, which MetaDrive replays.

CommonRoad: There are two files, the XML scenario of format 2020a and the ego's recorded motion as a solution. Time step
0 is the first exported step; the step length is the run's. The ego is the planning problem and no obstacle. Its goal is
where it was at the end. Obstacles are numbered in the order of the run, after the lanelets. A comment in the file gives
the id of each number, and the ego's size. Speed limits are signs, with the numbers after the ego's.

ScenarioNet: There is one scenario, a folder of three pickled dictionaries of plain values and numpy arrays. Time 0 is
the first exported step. Positions are box centres in the network's coordinates.
"""

from __future__ import annotations

import math
import pickle
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Comment, Element, SubElement, indent, tostring

import numpy as np

from sumo_adv import __version__
from sumo_adv.datatypes import Floats, Role, Track
from sumo_adv.report.export.piece import (
    DEFAULT_STEERING_RAD,
    HEIGHT_M,
    WHEELBASE_SHARE,
    ExportedRun,
    MapLane,
    kind,
    map_lanes,
    metres,
    printable,
    stands,
    stretches,
)

COMMONROAD_SCENARIO_FILE, COMMONROAD_SOLUTION_FILE = "scenario.xml", "solution.xml"
GOAL_SIZE_M = 10.0, 4.0  # length and width of the goal around the ego's last position
VEHICLE_MODELS = {"KS1": (4.298, 1.674), "KS2": (4.508, 1.610), "KS3": (4.569, 1.844)}
"""Length and width [m] of CommonRoad's kinematic single-track models: Ford Escort, BMW 320i and VW Vanagon."""
MIN_STEERED_SPEED_M_S = 1.0  # below this, the motion gives no steering angle
SPEED_LIMIT_SIGN = "274"  # the sign's number in Germany and in CommonRoad's Zamunda
SUMMARY, MAPPING = "dataset_summary.pkl", "dataset_mapping.pkl"
SCENARIONET_TYPES = {
    "car": "VEHICLE",
    "truck": "VEHICLE",
    "obstacle": "VEHICLE",
    "bicycle": "CYCLIST",
    "pedestrian": "PEDESTRIAN",
}
DATASET_NAME, DATASET_VERSION = "sumo_adv", "1"
PICKLE_PROTOCOL = 4  # readable by Python 3.4 and later


def write_commonroad(folder: Path, piece: ExportedRun) -> None:
    """Write ``scenario.xml`` and ``solution.xml`` into a folder.

    Args:
        folder: The folder.
        piece: What is exported.

    Raises:
        UsageError: The network cannot be read.
    """
    lanes = map_lanes(piece)
    parts = [part for t in piece.tracks for part in ([t] if stands(t) else stretches(t, piece.step))]
    problem = len(lanes) + len(parts) + 1
    for name, root in (
        (COMMONROAD_SCENARIO_FILE, _scenario(piece, lanes, parts, problem)),
        (COMMONROAD_SOLUTION_FILE, _solution(piece, problem)),
    ):
        indent(root)
        text = tostring(root, encoding="unicode")
        (folder / name).write_text(f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n', encoding="utf-8")


def _benchmark_id(piece: ExportedRun) -> str:
    """Return the scenario's name as CommonRoad spells names: ``ZAM_PriorityCrossing-1_1_T-1``."""
    words = re.findall(r"[A-Za-z0-9]+", piece.name)
    return f"ZAM_{''.join(w[:1].upper() + w[1:] for w in words) or 'Run'}-1_1_T-1"


def _scenario(piece: ExportedRun, lanes: Sequence[MapLane], parts: Sequence[Track], problem: int) -> Element:
    root = Element(
        "commonRoad", commonRoadVersion="2020a", benchmarkID=_benchmark_id(piece), author=f"sumo_adv {__version__}",
        date=piece.written.strftime("%Y-%m-%d"), affiliation="", source="sumo_adv", timeStepSize=f"{piece.step:g}",
    )  # fmt: skip
    location = SubElement(root, "location")
    _add_texts(location, geoNameId="-999", gpsLatitude="999", gpsLongitude="999")  # not given
    SubElement(SubElement(root, "scenarioTags"), "critical")
    limits = {metres(speed): k for k, speed in enumerate(sorted({each.lane.speed for each in lanes}), problem + 1)}
    for lane in lanes:
        _add_lanelet(root, lane, limits[metres(lane.lane.speed)])
    for limit, number in limits.items():
        _add_limit(root, number, limit)
    tracks = sorted(enumerate(parts, len(lanes) + 1), key=lambda pair: not stands(pair[1]))
    for number, track in tracks:  # static ones first
        if track.id != piece.ego:
            _add_obstacle(root, number, track, piece)
    _add_problem(root, piece, problem)
    return root


def _add_lanelet(root: Element, lane: MapLane, limit: int) -> None:
    lanelet = SubElement(root, "lanelet", id=str(lane.number))
    for name, line in (("leftBound", lane.left), ("rightBound", lane.right)):
        bound = SubElement(lanelet, name)
        for x, y in line.tolist():
            _add_point(bound, x, y)
    for name, numbers in (("predecessor", lane.entries), ("successor", lane.exits)):
        for number in numbers:
            SubElement(lanelet, name, ref=str(number))
    for name, beside, opposite in (
        ("adjacentLeft", lane.beside_left, lane.opposite_left),
        ("adjacentRight", lane.beside_right, lane.opposite_right),
    ):
        if beside is not None:
            SubElement(lanelet, name, ref=str(beside), drivingDir="same")
        elif opposite is not None:
            SubElement(lanelet, name, ref=str(opposite), drivingDir="opposite")
    _add_texts(lanelet, laneletType="intersection" if lane.lane.internal else "unknown", userOneWay="vehicle")
    SubElement(lanelet, "trafficSignRef", ref=str(limit))


def _add_limit(root: Element, number: int, limit: str) -> None:
    sign = SubElement(root, "trafficSign", id=str(number))
    _add_texts(SubElement(sign, "trafficSignElement"), trafficSignID=SPEED_LIMIT_SIGN, additionalValue=limit)
    _add_texts(sign, virtual="true")


def _add_obstacle(root: Element, number: int, track: Track, piece: ExportedRun) -> None:
    static, category = stands(track), kind(track)
    root.append(Comment(f" {number}: {_safe(track)}, {track.role} "))
    obstacle = SubElement(root, "staticObstacle" if static else "dynamicObstacle", id=str(number))
    SubElement(obstacle, "type").text = "parkedVehicle" if static else "unknown" if category == "obstacle" else category
    rectangle = SubElement(SubElement(obstacle, "shape"), "rectangle")
    _add_texts(rectangle, length=metres(track.length), width=metres(track.width))
    steps = _steps(track, piece)
    _add_state(obstacle, "initialState", track, 0, 0 if static else steps[0])
    if static or len(steps) == 1:
        return
    trajectory = SubElement(obstacle, "trajectory")
    for k, step in enumerate(steps[1:], 1):
        _add_state(trajectory, "state", track, k, step)


def _safe(track: Track) -> str:
    """Return the track's id in a form that an XML comment can hold."""
    return printable(track.id).replace("-", "_")


def _steps(track: Track, piece: ExportedRun) -> list[int]:
    """Return the time steps of a track's states."""
    return [round((time - piece.begin) / piece.step) for time in track.time.tolist()]


def _add_state(parent: Element, tag: str, track: Track, k: int, step: int) -> Element:
    state = SubElement(parent, tag)
    _add_point(SubElement(state, "position"), float(track.x[k]), float(track.y[k]))
    for name, value in (
        ("orientation", f"{track.heading[k]:.6f}"), ("time", str(step)), ("velocity", metres(float(track.speed[k]))),
        ("acceleration", metres(float(track.acceleration[k]))),
    ):  # fmt: skip
        SubElement(SubElement(state, name), "exact").text = value
    return state


def _add_point(parent: Element, x: float, y: float) -> None:
    _add_texts(SubElement(parent, "point"), x=metres(x), y=metres(y))


def _add_texts(parent: Element, **texts: str) -> None:
    for name, text in texts.items():
        SubElement(parent, name).text = text


def _add_problem(root: Element, piece: ExportedRun, number: int) -> None:
    ego = piece.track(piece.ego)
    root.append(Comment(f" {number}: {_safe(ego)}, ego, {metres(ego.length)} m long, {metres(ego.width)} m wide "))
    problem = SubElement(root, "planningProblem", id=str(number))
    state = _add_state(problem, "initialState", ego, 0, _steps(ego, piece)[0])
    for name in ("yawRate", "slipAngle"):
        SubElement(SubElement(state, name), "exact").text = "0.0"
    goal = SubElement(problem, "goalState")
    last, time = _steps(ego, piece)[-1], SubElement(goal, "time")
    _add_texts(time, intervalStart=str(max(0, last - 1)), intervalEnd=str(last))
    rectangle = SubElement(SubElement(goal, "position"), "rectangle")
    _add_texts(rectangle, length=str(GOAL_SIZE_M[0]), width=str(GOAL_SIZE_M[1]), orientation=f"{ego.heading[-1]:.6f}")
    _add_texts(SubElement(rectangle, "center"), x=metres(float(ego.x[-1])), y=metres(float(ego.y[-1])))


def _steering(track: Track) -> Floats:
    """Compute steering angles [rad] of a single-track model from the motion; 0 at speeds that are too low."""
    if len(track.time) < 2:
        return np.zeros(len(track.time))
    turn = np.gradient(np.unwrap(track.heading), track.time)
    curvature = np.divide(turn, track.speed, out=np.zeros_like(turn), where=track.speed > MIN_STEERED_SPEED_M_S)
    return np.clip(np.arctan(WHEELBASE_SHARE * track.length * curvature), -DEFAULT_STEERING_RAD, DEFAULT_STEERING_RAD)


def _solution(piece: ExportedRun, problem: int) -> Element:
    ego = piece.track(piece.ego)
    vehicle = min(VEHICLE_MODELS, key=lambda name: math.dist(VEHICLE_MODELS[name], (ego.length, ego.width)))
    root = Element("CommonRoadSolution", benchmark_id=f"{vehicle}:JB1:{_benchmark_id(piece)}:2020a")
    root.set("date", piece.written.strftime("%Y-%m-%dT%H:%M:%S"))
    trajectory = SubElement(root, "ksTrajectory", planningProblem=str(problem))
    for k, (step, steer) in enumerate(zip(_steps(ego, piece), _steering(ego).tolist(), strict=True)):
        _add_texts(
            SubElement(trajectory, "ksState"), x=metres(float(ego.x[k])), y=metres(float(ego.y[k])),
            steeringAngle=f"{steer:.6f}", velocity=metres(float(ego.speed[k])), orientation=f"{ego.heading[k]:.6f}",
            time=str(step),
        )  # fmt: skip
    return root


def write_scenarionet(folder: Path, piece: ExportedRun) -> None:
    """Write the ScenarioNet database into a folder.

    Args:
        folder: The folder.
        piece: What is exported.

    Raises:
        UsageError: The network cannot be read.
    """
    scenario = _description(piece)
    file = f"sd_{DATASET_NAME}_{DATASET_VERSION}_{scenario['id']}.pkl"
    for name, value in ((file, scenario), (SUMMARY, {file: scenario["metadata"]}), (MAPPING, {file: ""})):
        (folder / name).write_bytes(pickle.dumps(value, protocol=PICKLE_PROTOCOL))


def _description(piece: ExportedRun) -> dict[str, Any]:
    length = round((piece.end - piece.begin) / piece.step) + 1
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", piece.name)
    tracks = {track.id: _track(track, piece, length) for track in piece.tracks}
    return {
        "id": name,
        "version": DATASET_VERSION,
        "length": length,
        "tracks": tracks,
        "dynamic_map_states": {},
        "map_features": {str(key): value for lane in map_lanes(piece) for key, value in _features(lane)},
        "metadata": {
            "id": name, "scenario_id": name, "dataset": DATASET_NAME, "coordinate": "right-handed",
            "metadrive_processed": False, "sdc_id": piece.ego, "ts": piece.step * np.arange(length, dtype=np.float64),
            "sample_rate": piece.step, "current_time_index": 0, "source_file": piece.name,
            "tracks_to_predict": {
                t.id: {"track_id": t.id, "object_type": SCENARIONET_TYPES[kind(t)]} for t in piece.tracks
                if t.role is Role.ADVERSARY
            },
            "object_summary": {
                key: {"type": value["type"], "object_id": key, "track_length": length} for key, value in tracks.items()
            },
        },
    }  # fmt: skip


def _track(track: Track, piece: ExportedRun, length: int) -> dict[str, Any]:
    """Describe a track by states over all steps; they are zero and not valid while the vehicle does not exist."""
    category, at = kind(track), _steps(track, piece)

    def filled(*columns: Any) -> Any:
        values = np.zeros((length, len(columns)), np.float64)
        values[at] = np.column_stack([np.broadcast_to(c, track.time.shape) for c in columns])
        return values[:, 0] if len(columns) == 1 else values

    valid = np.zeros(length, bool)
    valid[at] = True
    return {
        "type": SCENARIONET_TYPES[category],
        "state": {
            "position": filled(track.x, track.y, HEIGHT_M[category] / 2), "heading": filled(track.heading),
            "velocity": filled(track.speed * np.cos(track.heading), track.speed * np.sin(track.heading)),
            "length": filled(track.length), "width": filled(track.width), "height": filled(HEIGHT_M[category]),
            "valid": valid,
        },
        "metadata": {
            "type": SCENARIONET_TYPES[category], "object_id": track.id, "dataset": DATASET_NAME, "track_length": length,
            "role": str(track.role),
        },
    }  # fmt: skip


def _features(each: MapLane) -> list[tuple[str, dict[str, Any]]]:
    """Describe a lane and, outside junctions, the lines at its sides."""
    lane = {
        "type": "LANE_SURFACE_STREET", "polyline": _flat(each.lane.shape),
        "polygon": np.concatenate([each.left, each.right[::-1]]),
        "speed_limit_kmh": each.lane.speed * 3.6, "interpolating": each.lane.internal,
        "entry_lanes": [str(n) for n in each.entries], "exit_lanes": [str(n) for n in each.exits],
        "left_neighbor": [] if each.beside_left is None else [str(each.beside_left)],
        "right_neighbor": [] if each.beside_right is None else [str(each.beside_right)],
    }  # fmt: skip
    features = [(str(each.number), lane)]
    for side, line, beside in (("left", each.left, each.beside_left), ("right", each.right, each.beside_right)):
        if not each.lane.internal:
            sort = "ROAD_EDGE_BOUNDARY" if beside is None else "ROAD_LINE_BROKEN_SINGLE_WHITE"
            features.append((f"{each.number}_{side}", {"type": sort, "polyline": _flat(line)}))
    return features


def _flat(line: Any) -> Any:
    """Add a height of 0 to the points of a line."""
    return np.column_stack([line, np.zeros(len(line))])
