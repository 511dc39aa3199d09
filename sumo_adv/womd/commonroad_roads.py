"""Read the lanelets of a CommonRoad scenario as lanes: their lines, neighbours, speed limits and traffic lights."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from xml.etree.ElementTree import Element

import numpy as np

from sumo_adv.datatypes import Floats, Ints
from sumo_adv.womd.commonroad_obstacles import child, points
from sumo_adv.womd.lines import at, line_stations, road_outline
from sumo_adv.womd.record import (
    BIKE,
    LANE_TYPES,
    SIGNAL_STATES,
    AreaFeature,
    LaneFeature,
    LineFeature,
    Neighbour,
    SignalState,
)

CENTRE_LINE_SPACING_M = 0.5  # between points of a centre line
SPEED_LIMIT_SIGNS = {"USA": "R2-1", "ESP": "r301"}
"""Speed limit signs by country in commonroad-io's catalogues. Other countries, and Zamunda, use ``DEFAULT_SIGN``."""
DEFAULT_SIGN = "274"
WALKWAYS = ("sidewalk", "crosswalk")  # lanelet types that are not lanes for vehicles
SIGNAL_STATE_OF_COLOUR = {
    "red": "stop",
    "redYellow": "stop",
    "yellow": "caution",
    "green": "go",
    "inactive": "flashing_caution",
}
MAX_LIGHT_CYCLE_STEPS = 10**9  # maximum length of a light's cycle
SUCCESSOR_TAGS = {"right": "successorsRight", "straight": "successorsStraight", "left": "successorsLeft"}


def is_walkway(lanelet: Element) -> bool:
    """Return whether a lanelet is for pedestrians."""
    return any(kind in WALKWAYS for kind in lanelet_types(lanelet))


def lanelet_types(lanelet: Element) -> set[str]:
    """Return CommonRoad's types of a lanelet."""
    return {(each.text or "").strip() for each in lanelet.findall("laneletType")}


def read_lanes(root: Element, lanelets: Sequence[Element], version: str) -> dict[int, LaneFeature]:
    """Return the lanelets as lanes.

    A centre line runs halfway between the bounds, with a point every half metre.

    Args:
        root: The scenario.
        lanelets: The lanelets that become lanes.
        version: The version of the format.

    Returns:
        The lanes by id.
    """
    lines = {int(lanelet.attrib["id"]): _centre(lanelet) for lanelet in lanelets}
    limits, turns = _sign_limits(root), _turns(root)

    def beside(lanelet: Element, name: str, own: int) -> tuple[Neighbour, ...]:
        found = [each for each in lanelet.findall(name) if each.get("drivingDir") == "same"]
        numbers = [int(each.attrib["ref"]) for each in found if int(each.attrib["ref"]) in lines]
        return tuple(Neighbour(n, 0, len(lines[own]) - 1, 0, len(lines[n]) - 1) for n in numbers)

    lanes = {}
    for lanelet in lanelets:
        own, kinds = int(lanelet.attrib["id"]), lanelet_types(lanelet)
        before, after = (
            tuple(int(each.attrib["ref"]) for each in lanelet.findall(name) if int(each.attrib["ref"]) in lines)
            for name in ("predecessor", "successor")
        )
        given = [limits[ref] for ref in _refs(lanelet, "trafficSignRef") if ref in limits]
        if version == "2018b":
            given += [float(each.text or "nan") for each in lanelet.findall("speedLimit")]
        lanes[own] = LaneFeature(
            own, lines[own], BIKE if "bicycleLane" in kinds else LANE_TYPES.index("surface"), min(given, default=0.0),
            "intersection" in kinds or own in turns, before, after, beside(lanelet, "adjacentLeft", own),
            beside(lanelet, "adjacentRight", own),
        )  # fmt: skip
    return lanes


def _centre(lanelet: Element) -> Floats:
    """Return the centre line of a lanelet ``(n, 3)`` [m], at height 0."""
    bounds = [points(child(lanelet, name)) for name in ("leftBound", "rightBound")]
    length = max(float(np.hypot(*np.diff(bound, axis=0).T).sum()) for bound in bounds)
    count = max(2, math.ceil(length / CENTRE_LINE_SPACING_M) + 1)
    along = [line_stations(bound) for bound in bounds]
    middle = sum(at(b, s, np.linspace(0.0, s[-1], count)) for b, s in zip(bounds, along, strict=True)) / 2
    return np.column_stack([middle, np.zeros(count)])


def _refs(lanelet: Element, name: str) -> list[str]:
    return [each.get("ref", "") for each in lanelet.findall(name)]


def _outline(lanelet: Element) -> Floats:
    return np.concatenate([points(child(lanelet, "leftBound")), points(child(lanelet, "rightBound"))[::-1]])


def read_edges(lanelets: Sequence[Element], last: int) -> dict[int, LineFeature]:
    """Return the outline of all lanelets as road edges.

    Args:
        lanelets: The lanelets.
        last: The edges are numbered from the number after this one.

    Returns:
        The edges by number.
    """
    from shapely import Polygon

    areas = [Polygon(_outline(each)).buffer(0.0) for each in lanelets]
    return {
        number: LineFeature(True, np.column_stack([line, np.zeros(len(line))]))
        for number, line in enumerate(road_outline(areas), last + 1)
    }


def read_crosswalks(lanelets: Sequence[Element]) -> tuple[AreaFeature, ...]:
    """Return the lanelets that are crosswalks."""
    return tuple(
        AreaFeature(int(each.attrib["id"]), "crosswalk", np.column_stack([line, np.zeros(len(line))]))
        for each in lanelets if "crosswalk" in lanelet_types(each)
        for line in (_outline(each),)
    )  # fmt: skip


# -- signs and lights


def country(root: Element) -> str:
    """Return the three letters of the country in the scenario's name.

    Names of cooperative scenarios begin with ``C-``.
    """
    return root.attrib["benchmarkID"].removeprefix("C-")[:3]


def _sign_limits(root: Element) -> dict[str, float]:
    """Return speed limits by the sign's id [m/s]; the values are in m/s in every country."""
    wanted = SPEED_LIMIT_SIGNS.get(country(root), DEFAULT_SIGN)
    limits: dict[str, float] = {}
    for sign in root.findall("trafficSign"):
        for element in sign.findall("trafficSignElement"):
            value = element.findtext("additionalValue")
            if element.findtext("trafficSignID", "").strip() == wanted and value is not None:
                name = sign.attrib["id"]
                limits[name] = min(float(value), limits.get(name, math.inf))
    return limits


def other_signs(root: Element) -> Counter[str]:
    """Count the signs that give no speed limit, by their catalogue number."""
    wanted = SPEED_LIMIT_SIGNS.get(country(root), DEFAULT_SIGN)
    ids = (each.findtext("trafficSignID", "").strip() for each in root.iterfind("trafficSign/trafficSignElement"))
    return Counter(f"sign {name}" for name in ids if name != wanted)


def _turns(root: Element) -> dict[int, str]:
    """Return the direction in which each lanelet of an intersection leads."""
    incoming = root.findall("intersection/incoming")
    return {int(ref): turn for turn, name in SUCCESSOR_TAGS.items() for each in incoming for ref in _refs(each, name)}


def read_lights(
    root: Element, lanelets: Sequence[Element], lanes: Mapping[int, LaneFeature], count: int
) -> list[tuple[SignalState, ...]]:
    """Return the signal states at each time step.

    A lanelet ends at its light, so the light rules the lanelets after it. A light with a direction rules only those
    with that turn. The cycle repeats forever, as in commonroad-io's ``TrafficLight.get_state_at_time_step``.

    Args:
        root: The scenario.
        lanelets: The lanelets that became lanes.
        lanes: The lanes by id.
        count: The number of time steps.

    Returns:
        For each step, the state of each lane after a traffic light.
    """
    lights = {light.attrib["id"]: light for light in root.findall("trafficLight") if is_lit(light)}
    turns = _turns(root)
    ruled: dict[int, Ints] = {}
    for lanelet in lanelets:
        for ref in _refs(lanelet, "trafficLightRef"):
            if ref in lights:
                states = _states(lights[ref], count)
                direction = lights[ref].findtext("direction", "all").strip().lower()
                for after in lanes[int(lanelet.attrib["id"])].exits:
                    if direction == "all" or turns.get(after, direction) in direction:
                        ruled.setdefault(after, states)
    return [tuple(SignalState(lane, int(states[k]), None) for lane, states in ruled.items()) for k in range(count)]


def is_lit(light: Element) -> bool:
    """Return whether a light is active and has a cycle."""
    active = light.findtext("active", "true").strip() != "false"
    return active and light.find("cycle/cycleElement") is not None


def _states(light: Element, count: int) -> Ints:
    """Return the state of a light at each step, as indices of ``SIGNAL_STATES``."""
    cycle = light.findall("cycle/cycleElement")
    colours = np.array(
        [SIGNAL_STATES.index(SIGNAL_STATE_OF_COLOUR[each.findtext("color", "").strip()]) for each in cycle]
    )
    durations = [int(child(each, "duration").text or "") for each in cycle]
    if min(durations) < 0 or not 0 < sum(durations) < MAX_LIGHT_CYCLE_STEPS:
        raise ValueError(f"traffic light {light.get('id', '')} has a cycle of {sum(durations)} steps")
    ends = np.cumsum(durations)
    passed = (np.arange(count) - int(light.findtext("cycle/timeOffset", "0"))) % ends[-1]
    return np.asarray(colours[np.searchsorted(ends, passed, side="right")])
