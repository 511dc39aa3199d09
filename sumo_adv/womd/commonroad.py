"""A CommonRoad scenario (XML, format 2020a) as a record that the converter takes.

Lanelets become lanes with their centre lines, obstacles become tracks from time step 0 on; the planning problem's
initial state is the ego, at its own time step. Its track ends one step later. Signs other than speed limits, lights and
occupancy sets are left out.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.errors import UsageError
from sumo_adv.womd.lines import at, road_outline, stations
from sumo_adv.womd.record import VEHICLE, LaneFeature, LineFeature, Neighbour, ObjectTrack, Record, check_record

SPACING = 0.5  # m between points of a centre line
EGO_SIZE = 4.508, 1.610  # m: CommonRoad's vehicle 2, BMW 320i; a planning problem names no size
KINDS = {"pedestrian": 2, "bicycle": 3}  # index of TRACK_KINDS; all others are vehicles
SURFACE = 2  # index of LANE_TYPES
SPEED_LIMIT = "274"  # the sign, in Germany and in CommonRoad's Zamunda
Place = tuple[float, float, float, float]  # x, y [m], heading [rad], speed [m/s]


def read_commonroad(path: Path) -> Record:
    """The scenario at ``path``.

    Raises UsageError: it cannot be read, or has no lanelets or no planning problem.
    """
    try:
        data = path.read_bytes()
        record = _record(ElementTree.fromstring(data), path, hashlib.sha256(data).hexdigest())
    except OSError as error:
        raise UsageError(f"The file {path} cannot be read: {error.strerror or error}.") from error
    except (ElementTree.ParseError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError(f"{path} is no CommonRoad scenario that can be read ({error}); check the file.") from error
    check_record(record, str(path))
    return record


def _record(root: Element, path: Path, content: str) -> Record:
    lanelets, problem = root.findall("lanelet"), root.find("planningProblem")
    if not lanelets or problem is None:
        raise UsageError(f"{path} has no {'planning problem' if lanelets else 'lanelets'}, so there is nothing to run.")
    states = {o: _states(o) for o in (*root.findall("dynamicObstacle"), *root.findall("staticObstacle"))}
    initial = _child(problem, "initialState")
    ego, first = _place(initial), round(_number(initial, "time", 0.0))
    count = max([first + 2, *(max(of) + 1 for of in states.values())])
    x, y, heading, speed = ego
    ahead = speed * _step(root)
    onward = {first: ego, first + 1: (x + ahead * math.cos(heading), y + ahead * math.sin(heading), heading, speed)}
    tracks = [_track(int(problem.attrib["id"]), VEHICLE, EGO_SIZE, onward, count)]
    for obstacle, of in states.items():
        still = obstacle.tag == "staticObstacle"
        places = dict.fromkeys(range(count), of[min(of)]) if still else of
        kind = KINDS.get(obstacle.findtext("type", "").strip(), VEHICLE)
        tracks.append(_track(int(obstacle.attrib["id"]), kind, _size(obstacle), places, count))
    lanes = _lanes(root, lanelets)
    return Record(
        scenario_id=re.sub(r"[^A-Za-z0-9_.-]", "_", root.attrib["benchmarkID"])[:100] or "scenario",
        time=_step(root) * np.arange(count, dtype=np.float64), current=first, sdc=0, tracks=tracks,
        objects_of_interest=(), to_predict=(), lanes=lanes, lines=_edges(lanelets, max(lanes)), stop_signs=(),
        areas=(), signals=[()] * count, content=content,
    )  # fmt: skip


def _step(root: Element) -> float:
    step = float(root.attrib["timeStepSize"])
    if not 0.0 < step < 10.0:
        raise ValueError(f"its time step is {step:g} s")
    return step


def _child(parent: Element, name: str) -> Element:
    found = parent.find(name)
    if found is None:
        raise ValueError(f"{parent.tag} {parent.get('id', '')} has no {name}".replace("  ", " "))
    return found


def _number(state: Element, name: str, default: float | None = None) -> float:
    """An exact value, or the middle of an interval."""
    holder = state.find(name)
    if holder is None and default is not None:
        return default
    values = [float(v.text or "nan") for v in _child(state, name)]
    if not values or not all(map(math.isfinite, values)):
        raise ValueError(f"a {name} is no number")
    return sum(values) / len(values)


def _place(state: Element) -> Place:
    point = _child(state, "position").find("point")
    centre = state.find("position/*/center") if point is None else point
    if centre is None:
        raise ValueError("a state has no exact position")
    x, y = (float(centre.findtext(name, "nan")) for name in ("x", "y"))
    return x, y, _number(state, "orientation"), _number(state, "velocity", 0.0)


def _states(obstacle: Element) -> dict[int, Place]:
    """Places by time step."""
    every = [_child(obstacle, "initialState"), *obstacle.findall("trajectory/state")]
    return {round(_number(state, "time")): _place(state) for state in every}


def _size(obstacle: Element) -> tuple[float, float]:
    """Length and width of a rectangle, or of the box around a circle or polygon."""
    shape = _child(obstacle, "shape")
    if (rectangle := shape.find("rectangle")) is not None:
        return float(rectangle.findtext("length", "nan")), float(rectangle.findtext("width", "nan"))
    if (radius := shape.findtext("circle/radius")) is not None:
        return 2 * float(radius), 2 * float(radius)
    corners = _points(_child(shape, "polygon"))
    length, width = np.ptp(corners, axis=0).tolist()
    return length, width


def _track(number: int, kind: int, size: tuple[float, float], places: dict[int, Place], count: int) -> ObjectTrack:
    values, valid = np.zeros((count, 4)), np.zeros(count, bool)
    for step, place in places.items():
        values[step], valid[step] = place, True
    x, y, heading, speed = values.T
    length, width = (np.full(count, value) for value in size)
    vx, vy = speed * np.cos(heading), speed * np.sin(heading)
    return ObjectTrack(number, kind, valid, x, y, length, width, heading, vx, vy)


def _points(parent: Element) -> Floats:
    return np.array([[float(p.findtext(name, "nan")) for name in ("x", "y")] for p in parent.findall("point")])


def _lanes(root: Element, lanelets: Sequence[Element]) -> dict[int, LaneFeature]:
    """Centre lines halfway between the bounds, a point every half metre."""
    limits = {
        sign.attrib["id"]: float(element.findtext("additionalValue", "0"))
        for sign in root.findall("trafficSign") for element in sign.findall("trafficSignElement")
        if element.findtext("trafficSignID", "").strip() == SPEED_LIMIT
    }  # fmt: skip
    lines: dict[int, Floats] = {}
    for lanelet in lanelets:
        bounds = [_points(_child(lanelet, name)) for name in ("leftBound", "rightBound")]
        length = max(float(np.hypot(*np.diff(bound, axis=0).T).sum()) for bound in bounds)
        count = max(2, math.ceil(length / SPACING) + 1)
        along = [stations(bound) for bound in bounds]
        middle = sum(at(b, s, np.linspace(0.0, s[-1], count)) for b, s in zip(bounds, along, strict=True)) / 2
        lines[int(lanelet.attrib["id"])] = np.column_stack([middle, np.zeros(count)])

    def beside(lanelet: Element, name: str, own: int) -> tuple[Neighbour, ...]:
        found = [each for each in lanelet.findall(name) if each.get("drivingDir") == "same"]
        numbers = [int(each.attrib["ref"]) for each in found if int(each.attrib["ref"]) in lines]
        return tuple(Neighbour(n, 0, len(lines[own]) - 1, 0, len(lines[n]) - 1) for n in numbers)

    lanes = {}
    for lanelet in lanelets:
        own = int(lanelet.attrib["id"])
        before, after = (
            tuple(int(each.attrib["ref"]) for each in lanelet.findall(name) if int(each.attrib["ref"]) in lines)
            for name in ("predecessor", "successor")
        )
        limit = max([limits.get(each.attrib["ref"], 0.0) for each in lanelet.findall("trafficSignRef")], default=0.0)
        inside = "intersection" in {(each.text or "").strip() for each in lanelet.findall("laneletType")}
        lanes[own] = LaneFeature(
            own, lines[own], SURFACE, limit, inside, before, after, beside(lanelet, "adjacentLeft", own),
            beside(lanelet, "adjacentRight", own),
        )  # fmt: skip
    return lanes


def _edges(lanelets: Sequence[Element], last: int) -> dict[int, LineFeature]:
    """The outline of all lanelets, numbered behind ``last``."""
    from shapely import Polygon

    areas = [
        Polygon(np.concatenate([_points(_child(each, "leftBound")), _points(_child(each, "rightBound"))[::-1]]))
        for each in lanelets
    ]
    return {
        number: LineFeature(True, np.column_stack([line, np.zeros(len(line))]))
        for number, line in enumerate(road_outline([area.buffer(0.0) for area in areas]), last + 1)
    }
