"""Read OpenStreetMap XML, and write it so that netconvert understands all of it.

netconvert 1.28 expects nodes before ways, and draws a way straight across a node that the file lacks. It reads bus and
cycle lanes only from tags that name a side or each lane. Of the tags on access for cars, it knows only ``access``.
Therefore nodes are written first, including those that ways carry themselves (Overpass's ``out geom`` writes them).
Ways are cut where nodes are missing, and tags are made explicit.
"""

from __future__ import annotations

import contextlib
import gzip
import itertools
import math
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence, Set
from functools import partial
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement
from xml.sax.saxutils import quoteattr

from sumo_adv.errors import UsageError
from sumo_adv.geometry import wrap
from sumo_adv.simulation.map_content import MapContent, parse_map

MAX_LANES_OF_WAY = 30  # the widest real roads have about 25 lanes, and netconvert creates any number that a tag gives
LANE_COUNTS = ("lanes", "lanes:forward", "lanes:backward", "lanes:both_ways")
PUBLIC = ("bus", "psv")
ALLOWING = ("yes", "designated", "official")
CLOSING = ("access", "vehicle", "motor_vehicle")
OF_CARS = ("motorcar", "motor_vehicle", "vehicle", "access")  # OpenStreetMap's order; the first that is given holds
CLOSED_TO_CARS = frozenset(("no", "agricultural", "forestry", "emergency", "military", "bus", "psv", "taxi"))
SIDED = ("sidewalk", "cycleway", "busway")
SWAP = {"left": "right", "right": "left"}
ONE_WAY = ("motorway", "motorway_link")
MOTOR_ROADS = frozenset(
    f"{kind}{link}" for kind in ("motorway", "trunk", "primary", "secondary", "tertiary") for link in ("", "_link")
) | {"unclassified", "residential", "living_street", "service", "road"}
"""Values of ``highway`` whose roads say on which side traffic drives."""
MIN_ROUNDABOUT_TURN_RAD = math.radians(120.0)  # a lane that bypasses a roundabout turns by 90 degrees the other way
FIRST_PIECE_ID = 10**17  # first id for the pieces of ways that were cut; OpenStreetMap's ids have 11 digits
Tags = dict[str, str]


def read_openstreetmap(path: Path) -> MapContent:
    """Read an OpenStreetMap file.

    Args:
        path: The map.

    Returns:
        The content of the map.

    Raises:
        UsageError: The map is damaged, is not OpenStreetMap, has a way with too many lanes, or says that traffic drives
            on both sides.
    """
    parse_map(path, lambda tag, attributes: None, "osm")
    known: set[str] = set()  # ids of nodes whose place is known
    kinds: dict[str, str] = {}
    nodes: dict[str, list[str]] = {}
    lost: Counter[str] = Counter()
    ruled = _Sides()  # by the relations of countries
    driven = _Sides()  # by the tags of roads
    roundabouts: dict[str, list[str]] = {}  # their nodes in the direction of traffic
    for element in _elements(path):
        name, tags = element.get("id", ""), _tags(element)
        if tags.get("type") == "lanelet" and element.tag == "relation":
            raise UsageError(
                f"{path} is a Lanelet2 map, not OpenStreetMap: convert it to OpenDRIVE first, for example with "
                "CommonRoad's Scenario Designer."
            )
        known.update(place for place, *_ in _placed(element))
        if element.tag == "relation" and "boundary" in tags:
            ruled.add(f"relation {name}", tags.get("driving_side"))
        if element.tag == "way" and ("highway" in tags or "railway" in tags):
            kinds[name] = tags["highway"] if "highway" in tags else f"railway {tags['railway']}"
            nodes[name] = [each.get("ref", "") for each in element.iterfind("nd")]
            if tags.get("highway") in MOTOR_ROADS:
                driven.add(f"way {name}", tags.get("driving_side"))
                if tags.get("junction") == "roundabout":
                    backward = tags.get("oneway") in ("-1", "reverse")
                    roundabouts[name] = nodes[name][::-1] if backward else nodes[name]
            _check_lanes(path, name, tags)
            lost["bus lane without a side"] += _is_without_side(tags)
            lost["closing of a lane to cars"] += _closed_lanes(tags)
            lost["closing of a direction to cars"] += _closed_directions(tags)
            lost["way with limits of single lanes"] += any(key.startswith("maxspeed:lanes") for key in tags)
            lost["second direction of a lane for both"] += _count(tags.get("lanes:both_ways", "")) or 0
    for name, along in nodes.items():
        runs = _runs(along, known)
        if not runs:
            kinds[name] += " without nodes"
        elif runs[0] != slice(0, len(along)):
            lost["way cut where nodes are missing"] += 1
    roads = sum(not kind.startswith("railway") for kind in kinds.values())
    turned = 0 if ruled.known else _turned_left(path, roundabouts)
    sides = ruled if ruled.known else driven
    left_hand = turned < 0 if turned else sides.is_left(path)
    write = partial(_write, path, known, left_hand)
    missing = {kind: number for kind, number in lost.items() if number}
    return MapContent(kinds, roads, left_hand, missing, write, says_side=bool(turned) or sides.known)


def _elements(path: Path) -> Iterator[Element]:
    """Yield nodes, ways and relations, without those that an editor (JOSM) or a history marks as deleted."""
    opened = gzip.open if path.name.lower().endswith(".gz") else open
    with opened(path, "rb") as file:
        root: Element | None = None
        for event, element in ElementTree.iterparse(file, ("start", "end")):
            if root is None:
                root = element
            if event == "end" and element.tag in ("node", "way", "relation"):
                if element.get("action") != "delete" and element.get("visible") != "false":
                    yield element
                root.clear()


def _tags(element: Element) -> Tags:
    return {tag.get("k", ""): tag.get("v", "") for tag in element.iterfind("tag")}


def _placed(element: Element) -> Iterator[tuple[str, str, str]]:
    """Yield id, latitude and longitude of the nodes that an element places: itself, or those that a way carries."""
    for node, name in ((element, "id"), *((each, "ref") for each in element.iterfind("nd"))):
        if "lat" in node.attrib and "lon" in node.attrib:
            yield node.get(name, ""), node.attrib["lat"], node.attrib["lon"]


def _check_lanes(path: Path, way: str, tags: Tags) -> None:
    """Refuse a way with so many lanes that netconvert would run out of memory."""
    for key, value in tags.items():
        number = _count(value) if key in LANE_COUNTS else value.count("|") + 1 if ":lanes" in key else None
        if number is not None and number > MAX_LANES_OF_WAY:
            raise UsageError(
                f"{path} has way {way} with {number} lanes ({key}), more than the {MAX_LANES_OF_WAY} that are read: "
                "correct its tag."
            )


def _count(text: str) -> int | None:
    """Return the number that a tag gives, rounded down; None if it gives none."""
    try:
        return int(float(text))
    except (ValueError, OverflowError):
        return None


# -- the side of the road ---------------------------------------------------------------------------------------------


class _Sides:
    """What says that traffic drives on the left, and what says the right."""

    def __init__(self) -> None:
        self._left: list[str] = []
        self._right: list[str] = []

    def add(self, what: str, side: str | None) -> None:
        """Note what a tag ``driving_side`` says."""
        if side in SWAP:
            (self._left if side == "left" else self._right).append(what)

    @property
    def known(self) -> bool:
        """Whether anything says a side."""
        return bool(self._left or self._right)

    def is_left(self, path: Path) -> bool:
        """Return whether traffic drives on the left; refuse traffic on both sides."""
        if self._left and self._right:
            raise UsageError(
                f"{path} has traffic on both sides: by {self._left[0]}, it drives on the left, by {self._right[0]} on "
                "the right. SUMO has one side for all; correct driving_side, or split the map."
            )
        return bool(self._left)


def _turned_left(path: Path, roundabouts: Mapping[str, Sequence[str]]) -> int:
    """Return how many roundabouts turn left, as in right-hand traffic, less those that turn right.

    A single one may be drawn the wrong way round, so the majority tells the side.
    """
    wanted = {node for nodes in roundabouts.values() for node in nodes}
    places: dict[str, tuple[float, float]] = {}
    for element in _elements(path) if wanted else ():
        for name, lat, lon in (each for each in _placed(element) if each[0] in wanted):
            with contextlib.suppress(ValueError):  # no numbers, which netconvert refuses
                places[name] = float(lon) * math.cos(math.radians(float(lat))), float(lat)
    count = 0
    for nodes in roundabouts.values():
        closed = len(nodes) > 2 and nodes[0] == nodes[-1]
        turn = _turn([places[node] for node in (*nodes, *nodes[1 : 1 + closed]) if node in places])
        if abs(turn) >= MIN_ROUNDABOUT_TURN_RAD:
            count += 1 if turn > 0.0 else -1
    return count


def _turn(points: Sequence[tuple[float, float]]) -> float:
    """Return by how much a line turns along its points, positive counter-clockwise [rad]."""
    headings = [
        math.atan2(by - ay, bx - ax) for (ax, ay), (bx, by) in itertools.pairwise(points) if (ax, ay) != (bx, by)
    ]
    return sum(wrap(after - before) for before, after in itertools.pairwise(headings))


# -- writing it for netconvert ----------------------------------------------------------------------------------------


def _write(path: Path, known: Set[str], left_hand: bool, target: Path) -> None:
    """Write the nodes, then everything else."""
    numbers = itertools.count(FIRST_PIECE_ID)
    written: set[str] = set()
    with tempfile.TemporaryFile() as later, target.open("wb") as out:
        out.write(b'<?xml version="1.0" encoding="UTF-8"?>\n<osm version="0.6">\n')
        for element in _elements(path):
            if element.tag == "way":
                carried = [each for each in element.iterfind("nd") if "lat" in each.attrib and "lon" in each.attrib]
                nodes = [
                    Element("node", id=n.get("ref", ""), lat=n.attrib["lat"], lon=n.attrib["lon"]) for n in carried
                ]
                for piece in _pieces(element, known, numbers):
                    later.write(ElementTree.tostring(_explicit(piece, left_hand)))
            elif element.tag == "node":
                nodes = [element] if "lat" in element.attrib and "lon" in element.attrib else []
            else:
                nodes = []
                later.write(ElementTree.tostring(element))
            for node in nodes:
                if node.get("id", "") not in written:
                    written.add(node.get("id", ""))
                    out.write(_node(node))
        later.seek(0)
        shutil.copyfileobj(later, out)
        out.write(b"</osm>\n")


def _node(node: Element) -> bytes:
    """Return a node as text. Most nodes have no tags, and these take a faster path."""
    if len(node):
        return ElementTree.tostring(node)
    name, lat, lon = (quoteattr(node.get(key, "")) for key in ("id", "lat", "lon"))
    return f"<node id={name} lat={lat} lon={lon}/>\n".encode()


def _runs(nodes: Sequence[str], known: Set[str]) -> list[slice]:
    """Return the parts of a way between missing nodes, the longest first."""
    gaps = [-1, *(k for k, node in enumerate(nodes) if node not in known), len(nodes)]
    runs = [slice(a + 1, b) for a, b in itertools.pairwise(gaps) if b - a > 2]
    return sorted(runs, key=lambda run: run.start - run.stop)


def _pieces(way: Element, known: Set[str], numbers: Iterator[int]) -> Iterator[Element]:
    """Yield the way, cut where nodes are missing. The longest piece keeps the id, because relations may name it."""
    nodes = way.findall("nd")
    for k, run in enumerate(_runs([node.get("ref", "") for node in nodes], known)):
        piece = Element("way", {**way.attrib, "id": str(next(numbers))} if k else way.attrib)
        piece.extend(nodes[run])
        piece.extend(way.findall("tag"))
        yield piece


def _explicit(way: Element, left_hand: bool) -> Element:
    """Return the way with its bus and cycle lanes and its access for cars in tags that netconvert reads."""
    tags = _tags(way)
    if "highway" not in tags:
        return way
    made = _sides(_lanes_of_buses(tags, left_hand), left_hand) | _access_of_cars(tags)
    for tag in way.findall("tag"):
        way.remove(tag)
    for key, value in made.items():
        SubElement(way, "tag", k=key, v=value)
    return way


def _access_of_cars(tags: Tags) -> Tags:
    """Return whether cars may use the way, as an ``access`` tag; no tag if none of the given ones tells."""
    given = next((tags[key] for key in OF_CARS if key in tags), None)
    if given is None:
        return {}
    return {"access": "no" if {word.strip() for word in given.split(";")} <= CLOSED_TO_CARS else "yes"}


def _closed_directions(tags: Tags) -> int:
    """Count the directions of a two-way road that are closed to cars, which netconvert leaves open."""
    if "highway" not in tags or _is_one_way(tags):
        return 0
    return sum(
        next((tags[f"{key}:{way}"] for key in OF_CARS if f"{key}:{way}" in tags), "") in CLOSED_TO_CARS
        for way in ("forward", "backward")
    )


def _is_one_way(tags: Tags) -> bool:
    given = tags.get("oneway")
    if given is None:
        return tags["highway"] in ONE_WAY or tags.get("junction") in ("roundabout", "circular")
    return given in ("yes", "true", "1", "-1", "reverse")


def _sides(tags: Tags, left_hand: bool) -> Tags:
    """Name the sides of cycle and bus lanes, which are at the kerb on a one-way road.

    netconvert calls the kerb's side "right", even with ``--lefthand``.
    """
    made = dict(tags)
    kerb = "left" if left_hand else "right"
    for key in ("cycleway", "busway"):
        if made.get(key) in ("lane", "track") and not any(f"{key}:{s}" in made for s in ("both", "left", "right")):
            made[f"{key}:{kerb if _is_one_way(tags) else 'both'}"] = made.pop(key)
    if not left_hand:
        return made
    swapped = {}
    for key, value in made.items():
        name, _, side = key.partition(":")
        if name in SIDED:
            key = f"{name}:{SWAP[side]}" if side in SWAP else key
            value = SWAP.get(value, value) if key == "sidewalk" else value
        swapped[key] = value
    return swapped


def _lanes_of_buses(tags: Tags, left_hand: bool) -> Tags:
    """Name the lanes that are for buses only.

    They follow from their number (``lanes:bus``, at the kerb), or from lanes that are closed to others
    (``access:lanes``).
    """
    made = dict(tags)
    for kind in PUBLIC:
        for direction in ("", ":forward", ":backward"):
            key = f"{kind}:lanes{direction}"
            closed = next((tags[f"{c}:lanes{direction}"] for c in CLOSING if f"{c}:lanes{direction}" in tags), "")
            number, lanes = _number_for(tags, kind, direction), _lanes(tags, direction)
            if key in tags:
                made[key] = _designated(tags[key], closed)
            elif number and lanes is not None and number <= lanes:
                words = ["yes"] * (lanes - number) + ["designated"] * number
                made[key] = "|".join(reversed(words) if left_hand else words)
    return made


def _number_for(tags: Tags, kind: str, direction: str) -> int:
    """Return the number of bus lanes in a direction: half of them if a two-way road gives one number."""
    own = _count(tags.get(f"lanes:{kind}{direction}", ""))
    if own is not None or not direction or _is_one_way(tags):
        return own or 0
    return (_count(tags.get(f"lanes:{kind}", "")) or 0) // 2


def _is_without_side(tags: Tags) -> bool:
    """Return whether a two-way road has an odd number of bus lanes without naming their direction."""
    odd = any((_count(tags.get(f"lanes:{kind}", "")) or 0) % 2 for kind in PUBLIC)
    said = any(key.startswith(("bus:lanes", "psv:lanes", "busway:", "lanes:bus:", "lanes:psv:")) for key in tags)
    return odd and not said and "highway" in tags and not _is_one_way(tags)


def _closed_lanes(tags: Tags) -> int:
    """Count lanes that are closed to cars and open to neither buses nor bicycles, which netconvert leaves open."""
    number = 0
    for direction in ("", ":forward", ":backward"):
        shut = [tags[f"{c}:lanes{direction}"].split("|") for c in CLOSING if f"{c}:lanes{direction}" in tags]
        open_to = [tags.get(f"{kind}:lanes{direction}", "").split("|") for kind in (*PUBLIC, "bicycle")]
        for k in range(max(map(len, shut), default=0)):
            closed = any(words[k] == "no" for words in shut if k < len(words))
            number += closed and not any(words[k] in ALLOWING for words in open_to if k < len(words))
    return number


def _designated(text: str, closed: str) -> str:
    """Return ``bus:lanes`` with the lanes that are open to buses and closed to others marked as designated."""
    words, shut = text.split("|"), closed.split("|")
    if len(words) != len(shut):
        return text
    return "|".join("designated" if w in ALLOWING and c == "no" else w for w, c in zip(words, shut, strict=True))


def _lanes(tags: Tags, direction: str) -> int | None:
    """Return the number of lanes in a direction, "" meaning that of a one-way road; None if unknown."""
    whole = _count(tags.get("lanes", ""))
    if not direction:
        return whole if _is_one_way(tags) else None
    own = _count(tags.get(f"lanes{direction}", ""))
    return whole // 2 if own is None and whole is not None else own
