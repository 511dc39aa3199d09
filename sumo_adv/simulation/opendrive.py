"""Read ASAM OpenDRIVE 1.x, and write it so that netconvert understands it as the standard means it.

netconvert 1.28 reads neither the limits of ``<type>`` nor limits in words. It ignores ``rule`` and puts the lanes of
left-hand roads on the wrong side. It does not know all types of lanes, takes ``<border>`` for no width, and closes the
gap that a median or a border within the road leaves. Therefore:

- limits are written to the lanes in m/s;
- left-hand roads are mirrored in their lane numbers;
- borders become widths;
- what lies between lanes, or between them and the middle, is kept as lanes that are closed to all.
"""

from __future__ import annotations

import gzip
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from sumo_adv.datatypes import MPH_M_S, Floats
from sumo_adv.errors import UsageError
from sumo_adv.simulation.map_content import MapContent, parse_map

MAX_ROADS_LENGTH_M = 1e7  # of all roads together; netconvert samples curves every 2 m
SPEED_UNITS_M_S = {"": 1.0, "m/s": 1.0, "km/h": 1 / 3.6, "mph": MPH_M_S}  # in m/s; the standard's default unit is m/s
NO_LIMIT_M_S = 39.44  # netconvert's value (142 km/h) if a map says that there is no limit
UNKNOWN_LIMIT_M_S = 13.89  # SUMO's type map: lanes for driving
MOTOR_LANE_TYPES = frozenset({
    "driving", "stop", "restricted", "entry", "exit", "onRamp", "offRamp", "mwyEntry", "mwyExit", "slipLane",
    "connectingRamp", "bus", "taxi", "HOV", "shared", "bidirectional",
})  # fmt: skip
"""Types of lanes to which limits are written."""
OPENDRIVE_LANE_TYPES = MOTOR_LANE_TYPES | {"biking", "sidewalk", "walking", "parking", "roadWorks", "tram", "rail"}
"""Types of lanes that become SUMO lanes."""
TRAFFIC_LIGHT_TYPES = frozenset(str(1_000_000 + k) for k in (1, 2, 3, 4, 5, 6, 7, 9, 10, 11, 12, 13, 20))
"""Types of signals that netconvert 1.28 converts to traffic lights."""
SECTION_SIDE_ORDER = {"left": 0, "center": 1, "right": 2}  # the order of sides in a section
CLOSED_LANE_TYPE = "restricted"  # SUMO's type map: a lane that no class may use
NO_ROAD = "rail rail_urban rail_electric rail_fast tram subway cable_car ship drone aircraft container"  # classes
TYPE_MAP = f"""<types>
    <type id="bus" priority="1" speed="13.89" width="3.65" allow="bus coach emergency authority"/>
    <type id="taxi" priority="1" speed="13.89" width="3.65" allow="taxi emergency authority"/>
    <type id="HOV" priority="1" speed="13.89" width="3.65" allow="hov bus coach taxi emergency authority"/>
    <type id="walking" priority="-2" speed="2.78" width="2.50" allow="pedestrian"/>
    <type id="shared" priority="1" speed="13.89" width="3.65" disallow="{NO_ROAD}"/>
    <type id="slipLane" priority="1" speed="13.89" width="3.65" disallow="pedestrian {NO_ROAD}"/>
    <type id="connectingRamp" priority="1" speed="22.22" width="3.65" disallow="pedestrian bicycle moped {NO_ROAD}"/>
</types>
"""
"""Lane types of OpenDRIVE 1.4 to 1.8 that SUMO's type maps lack."""


def read_opendrive(path: Path) -> MapContent:
    """Read an OpenDRIVE map.

    Args:
        path: The map.

    Returns:
        The content of the map.

    Raises:
        UsageError: The map is damaged, is not OpenDRIVE 1.x in one file, or is longer than ``MAX_ROADS_LENGTH_M``; a
            limit, rule or lane cannot be understood; two roads have one id; or traffic drives on both sides.
    """
    parse_map(path, lambda tag, attributes: None, "OpenDRIVE")
    tree = _tree(path)
    root = tree.getroot()
    header = root.find("header")
    major = "1" if header is None else header.get("revMajor", "1")
    if major != "1":
        raise UsageError(f"{path} is OpenDRIVE of version {major}.x: give version 1.4 to 1.8.")
    if root.find(".//include") is not None:
        raise UsageError(f"{path} includes other files (<include>): put all of the map into one file.")
    roads = root.findall("road")
    length = sum(_number(path, road, "length") for road in roads)
    if not length <= MAX_ROADS_LENGTH_M:
        raise UsageError(f"{path} has {length:.3g} m of roads, more than the {MAX_ROADS_LENGTH_M:.0g} m that are read.")
    left_hand = _left_hand(path, roads)
    twice = [name for name, number in Counter(road.get("id", "") for road in roads).items() if number > 1]
    if twice:
        raise UsageError(f"{path} has two roads with the id {twice[0][:40]}: give each its own.")
    for lane in root.iter("lane"):
        if not re.fullmatch(r"[+-]?\d{1,4}", lane.get("id", ""), re.ASCII):
            raise UsageError(f'{path} has a <lane> with id="{lane.get("id", "")[:40]}": give a whole number.')
    for signal in root.iter("signal"):
        signal.set(
            "type", signal.get("type", "").replace(".", "")
        )  # the standard's catalogue writes types as 1.000.001
    lost = _left_out(root)
    kinds = {}
    for road in roads:
        _write_limits(path, road)
        for section in road.iter("laneSection"):
            for side in section:
                if side.tag in ("left", "right"):
                    _write_widths(path, side)
                    _close_gaps(side)
            if left_hand:
                _mirror(section)
        for lane in road.iter("lane"):
            kind = lane.attrib.pop("was", lane.get("type", "none"))
            if kind != "none":
                kinds[f"{road.get('id')}_{lane.get('id')}"] = f"lane {kind}"
    if left_hand:
        for element, names in (("laneLink", ("from", "to")), ("validity", ("fromLane", "toLane"))):
            for each in root.iter(element):
                _negate(each, *names)

    def write(target: Path) -> None:
        tree.write(target, encoding="UTF-8", xml_declaration=True)

    return MapContent(kinds, len(roads), left_hand, lost, write)


def _tree(path: Path) -> ElementTree.ElementTree[Element]:
    """Return the whole document, with tags without a namespace."""
    opened = gzip.open if path.name.lower().endswith(".gz") else open
    try:
        with opened(path, "rb") as file:
            tree = ElementTree.parse(file)
    except ElementTree.ParseError as error:
        raise UsageError(f"{path} is not valid XML (damaged or cut short): {error}.") from error
    for element in tree.iter():
        element.tag = element.tag.rpartition("}")[2]
    return tree


def _number(path: Path, element: Element, name: str, default: str = "") -> float:
    """Return an attribute as a finite number."""
    text = element.get(name, default)
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if math.isfinite(value):
        return value
    raise UsageError(f'{path} has a <{element.tag}> with {name}="{text[:40]}": give a number.')


def _left_out(root: Element) -> dict[str, int]:
    """Count what is left out: signs and objects that netconvert ignores, and the second direction of two-way lanes."""
    other = [signal for signal in root.iter("signal") if signal.get("type", "") not in TRAFFIC_LIGHT_TYPES]
    counts = {
        "sign": sum(signal.get("dynamic") != "yes" for signal in other),
        "dynamic signal": sum(signal.get("dynamic") == "yes" for signal in other),
        "object": sum(1 for _ in root.iter("object")),
        "second direction of a lane for both": sum(
            lane.get("direction") == "both" or lane.get("type") == "bidirectional" for lane in _motor(root)
        ),
    }
    return {kind: number for kind, number in counts.items() if number}


def _motor(element: Element) -> Iterator[Element]:
    """Yield the lanes for motor vehicles."""
    return (lane for lane in element.iter("lane") if lane.get("type") in MOTOR_LANE_TYPES)


# -- the side of the road ---------------------------------------------------------------------------------------------


def _left_hand(path: Path, roads: list[Element]) -> bool:
    """Return whether traffic drives on the left.

    A road without a rule is right-hand. Within a junction, such a road follows its arms. A road without motor traffic
    has no side.
    """
    sides: dict[bool, list[str]] = {False: [], True: []}
    for road in roads:
        name = road.get("id", "")
        rule = road.get("rule", "").upper()
        if rule not in ("", "LHT", "RHT"):
            raise UsageError(f'{path} has road {name} with rule="{rule[:40]}": give RHT or LHT.')
        directions = {lane.get("direction", "standard") for lane in _motor(road)}
        backward = "reversed" in directions
        if backward and directions != {"reversed"}:
            raise UsageError(
                f"{path} has road {name} with lanes in their standard and in reversed direction on one road, which "
                "netconvert does not read: make two roads of it."
            )
        if directions and (rule or road.get("junction", "-1") == "-1"):
            sides[(rule == "LHT") != backward].append(name)
    right, left = sides[False], sides[True]
    if left and right:
        raise UsageError(
            f"{path} has traffic on both sides: {_some(left)} drive on the left, {_some(right)} on the right. SUMO has "
            "one side for all; give each road its rule, or split the map."
        )
    return bool(left)


def _some(names: list[str]) -> str:
    return f"{'road' if len(names) == 1 else 'roads'} {', '.join(names[:3])}{' and others' if len(names) > 3 else ''}"


def _mirror(section: Element) -> None:
    """Negate the lane numbers of a section, and swap the names of its sides.

    With ``--lefthand``, netconvert puts lanes with negative numbers to the left, in the direction of the road. By the
    standard (``rule="LHT"``), these are the lanes with positive numbers.
    """
    for side in list(section):
        if side.tag not in SECTION_SIDE_ORDER:
            continue
        side.tag = {"left": "right", "right": "left"}.get(side.tag, side.tag)
        for lane in side:
            _negate(lane, "id")
            for link in lane.findall("link/*"):
                _negate(link, "id")
        side[:] = sorted(side, key=lambda lane: -int(lane.get("id", "0")))
    section[:] = sorted(section, key=lambda side: SECTION_SIDE_ORDER.get(side.tag, len(SECTION_SIDE_ORDER)))


def _negate(element: Element, *names: str) -> None:
    for name in names:
        text = element.get(name, "")
        if text.lstrip("+-").isdigit():
            element.set(name, str(-int(text)))


# -- lanes ------------------------------------------------------------------------------------------------------------


Pieces = list[tuple[float, Floats]]  # where each piece begins [m], and a, b, c, d of its cubic from there


def _write_widths(path: Path, side: Element) -> None:
    """Give lanes that have borders but no widths the widths between their borders and those of the lanes within."""
    sign = 1.0 if side.tag == "left" else -1.0
    inner: Pieces = [(0.0, np.zeros(4))]
    for lane in _from_the_middle(side):
        widths, borders = _pieces(path, lane, "width"), _pieces(path, lane, "border")
        if borders and not widths:  # by the standard, widths override borders
            widths = [(s, sign * (_cubic_at(borders, s) - _cubic_at(inner, s))) for s in _starts(inner, borders)]
            for s, cubic in widths:
                values = zip(("sOffset", *"abcd"), (s, *cubic.tolist()), strict=True)
                SubElement(lane, "width", {name: f"{value:.9g}" for name, value in values})
        if widths:
            inner = [(s, _cubic_at(inner, s) + sign * _cubic_at(widths, s)) for s in _starts(inner, widths)]


def _from_the_middle(side: Element) -> list[Element]:
    """Return the lanes of a side, from the middle outwards."""
    return sorted(side.findall("lane"), key=lambda lane: abs(int(lane.get("id", "0"))))


def _pieces(path: Path, lane: Element, tag: str) -> Pieces:
    """Return the cubics of ``<width>`` or ``<border>``, in order."""
    found = [
        (_number(path, each, "sOffset", "0"), np.array([_number(path, each, name, "0") for name in "abcd"]))
        for each in lane.findall(tag)
    ]
    return sorted(found, key=lambda piece: piece[0])


def _starts(one: Pieces, other: Pieces) -> list[float]:
    """Return where pieces of either polynomial begin, in order [m]."""
    return sorted({s for s, _ in (*one, *other)})


def _cubic_at(pieces: Pieces, s: float) -> Floats:
    """Return the cubic that holds at ``s`` [m], shifted so that it starts there."""
    start, (a, b, c, d) = next((piece for piece in reversed(pieces) if piece[0] <= s), pieces[0])
    h = s - start
    return np.array([a + h * (b + h * (c + h * d)), b + h * (2 * c + 3 * h * d), c + 3 * h * d, d])


def _close_gaps(side: Element) -> None:
    """Keep what lies between a lane and the middle, such as a median or a border, as a closed lane.

    The lane's own type moves to the attribute ``was``. A lane without a width becomes 0 m wide, because netconvert
    would assume 3.65 m.
    """
    lanes = _from_the_middle(side)
    kept = [k for k, lane in enumerate(lanes) if lane.get("type") in OPENDRIVE_LANE_TYPES]
    for lane in lanes[: kept[-1]] if kept else ():
        if lane.get("type") not in OPENDRIVE_LANE_TYPES:
            lane.set("was", lane.get("type", "none"))
            lane.set("type", CLOSED_LANE_TYPE)
            if lane.find("width") is None:
                SubElement(lane, "width", sOffset="0", a="0", b="0", c="0", d="0")


Limit = tuple[float, float | None]  # where the limit begins [m], and the limit [m/s]; None if not given


def _write_limits(path: Path, road: Element) -> None:
    """Write the limits of the road's types to the lanes that have no limit of their own there."""
    types = _sorted((_number(path, each, "s", "0"), _limit(path, each.find("speed"))) for each in road.findall("type"))
    sections = [(_number(path, section, "s", "0"), section) for section in road.iter("laneSection")]
    for start, section in sections:
        end = min((s for s, _ in sections if s > start), default=_number(path, road, "length"))
        general = [(max(0.0, s - start), limit) for s, limit in types]
        general = [each for k, each in enumerate(general) if k + 1 == len(general) or general[k + 1][0] > each[0]]
        for lane in _motor(section):
            speeds = lane.findall("speed")
            own = _sorted((_number(path, each, "sOffset", "0"), _limit(path, each)) for each in speeds)
            for each in speeds:
                lane.remove(each)
            known = False
            last: float | None = None
            for offset, limit in _merged(general, own):
                if offset > 0.0 and offset >= end - start:
                    break  # netconvert would lose the lanes of later sections
                value = UNKNOWN_LIMIT_M_S if limit is None and known else limit
                if value is not None and value != last:
                    SubElement(lane, "speed", sOffset=f"{offset:.9g}", max=f"{value:.6g}", unit="m/s")
                    known, last = True, value


def _sorted(limits: Iterable[Limit]) -> list[Limit]:
    return sorted(limits, key=lambda limit: limit[0])


def _merged(general: list[Limit], own: list[Limit]) -> Iterator[Limit]:
    """Yield the limits along a lane: its own from where one begins, and the road's where it has none."""

    def at(limits: list[Limit], offset: float) -> float | None:
        return next((limit for s, limit in reversed(limits) if s <= offset), None)

    for offset in sorted({s for s, _ in (*general, *own)}):
        mine = at(own, offset)
        yield offset, at(general, offset) if mine is None else mine


def _limit(path: Path, speed: Element | None) -> float | None:
    """Return a limit [m/s]; None if it is absent, undefined or not above 0."""
    text = "undefined" if speed is None else speed.get("max", "undefined").strip()
    if speed is None or text == "undefined":
        return None
    if text == "no limit":
        return NO_LIMIT_M_S
    unit = speed.get("unit", "").strip()
    if unit not in SPEED_UNITS_M_S:
        raise UsageError(f'{path} has a speed limit in "{unit[:40]}": give m/s, km/h or mph.')
    value = _number(path, speed, "max") * SPEED_UNITS_M_S[unit]
    return value if value > 0.0 else None
