"""Networks for scenarios from words: shipped ones by name, the user's own, and generated ones.

A generated network is plain XML (nodes, edges, connections) that netconvert builds. The names of its edges depend on
its kind alone:

    straight    forward, backward (if there are lanes back)
    ramp        main -> merge -> onward, and ramp, which joins from the right where merge begins
    lane_drop   before -> after, which has one lane less
    t           west_in, west_out, east_in, east_out, south_in, south_out; west and east are the main road
    crossing    the same with north_in, north_out
    roundabout  the same arms around ring_east_north, ring_north_west, ring_west_south, ring_south_east
"""

from __future__ import annotations

import math
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

from sumo_adv.errors import UsageError, nearest
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.programs import find_netconvert
from sumo_adv.simulation.shipped import shipped_files
from sumo_adv.words.draft import RoadDraft

OPTIONS = (
    "--offset.disable-normalization", "--precision", "3", "--no-turnarounds", "--junctions.corner-detail", "6",
    "--junctions.internal-link-detail", "12", "--default.junctions.radius", "6", "--no-warnings",
    "--xml-validation", "never",
)  # fmt: skip
TIMEOUT = 60.0  # s
LANE = 3.2  # m, of streets
WIDE = 3.5  # m, of motorways and ramps
FAST = 80.0  # km/h from which lanes are wide
ACCELERATION_LANE = 200.0  # m
RADIUS = 18.0  # m of a roundabout
RING_SPEED = 30.0  # km/h
SIDEWALK, BIKE_LANE = 2.0, 1.5  # m

Attributes = dict[str, object]


def make_network(road: RoadDraft, target: Path, given: Path | None) -> Path:
    """The network of a draft. A generated one is written to ``target``.

    Raises UsageError for a name that is not shipped, for ``given`` where there is none, and where netconvert refuses.
    """
    if road.kind == "given":
        if given is None:
            raise UsageError("There is no network of the user's: choose a shipped or a generated one.")
        return given
    if road.kind == "shipped":
        names = shipped_files("networks", ".net.xml")
        if road.name not in names:
            raise UsageError(f"There is no shipped network '{road.name}'{nearest(road.name, names)}.")
        return data_folder("networks") / f"{road.name}.net.xml"
    return _build(*_plain(road), target)


def _plain(road: RoadDraft) -> tuple[list[Attributes], list[Attributes], list[Attributes]]:
    """Nodes, edges and connections."""
    match road.kind:
        case "straight":
            return _straight(road)
        case "ramp":
            return _ramp(road)
        case "lane_drop":
            return _lane_drop(road)
        case "roundabout":
            return _roundabout(road)
        case _:
            return _junction(road)


def _edge(name: str, start: str, end: str, lanes: int, kmh: float, **more: object) -> Attributes:
    width = WIDE if kmh >= FAST else LANE
    return {
        "id": name, "from": start, "to": end, "priority": 10, "numLanes": lanes, "speed": round(kmh / 3.6, 2),
        "width": width, "spreadType": "right", **more,
    }  # fmt: skip


def _node(name: str, x: float, y: float, **more: object) -> Attributes:
    return {"id": name, "x": round(x, 2), "y": round(y, 2), **more}


def _beside(road: RoadDraft) -> Attributes:
    """Sidewalk and bicycle lane of a street."""
    extra: Attributes = {"disallow": "pedestrian"} if road.sidewalk or road.bike_lane else {}
    extra |= {"sidewalkWidth": SIDEWALK} if road.sidewalk else {}
    return extra | ({"bikeLaneWidth": BIKE_LANE} if road.bike_lane else {})


def _straight(road: RoadDraft) -> tuple[list[Attributes], list[Attributes], list[Attributes]]:
    nodes = [_node("west", 0, 0), _node("east", road.length, 0)]
    edges = [_edge("forward", "west", "east", road.lanes, road.speed_limit, **_beside(road))]
    if road.lanes_back:
        edges.append(_edge("backward", "east", "west", road.lanes_back, road.speed_limit, **_beside(road)))
    return nodes, edges, []


def _ramp(road: RoadDraft) -> tuple[list[Attributes], list[Attributes], list[Attributes]]:
    nodes = [
        _node("west", -road.length, 0), _node("start", -min(road.length, 300.0), -75.0),
        _node("nose", 0, 0, type="priority"), _node("taper", ACCELERATION_LANE, 0, type="priority"),
        _node("east", ACCELERATION_LANE + road.length, 0),
    ]  # fmt: skip
    lower = -(road.lanes + 0.5) * (WIDE if road.speed_limit >= FAST else LANE)
    shape = f"{-min(road.length, 300.0):.2f},-75.00 -120.00,{lower - 13:.2f} -60.00,{lower - 3:.2f} -5.00,{lower:.2f}"
    edges = [
        _edge("main", "west", "nose", road.lanes, road.speed_limit),
        _edge("ramp", "start", "nose", 1, road.minor_limit, priority=5, spreadType="center", shape=shape),
        _edge("merge", "nose", "taper", road.lanes + 1, road.speed_limit),
        _edge("onward", "taper", "east", road.lanes, road.speed_limit),
    ]
    links = [_link("ramp", "merge", 0, 0)]
    for lane in range(road.lanes):
        links += [_link("main", "merge", lane, lane + 1), _link("merge", "onward", lane + 1, lane)]
    return nodes, edges, links


def _lane_drop(road: RoadDraft) -> tuple[list[Attributes], list[Attributes], list[Attributes]]:
    if road.lanes < 2:
        raise UsageError("A lane_drop needs lanes = 2 or more, of which one ends.")
    nodes = [_node("west", 0, 0), _node("drop", road.length, 0, type="priority"), _node("east", 2 * road.length, 0)]
    edges = [
        _edge("before", "west", "drop", road.lanes, road.speed_limit),
        _edge("after", "drop", "east", road.lanes - 1, road.speed_limit),
    ]
    first = 1 if road.ends == "right" else 0
    return nodes, edges, [_link("before", "after", lane + first, lane) for lane in range(road.lanes - 1)]


def _link(start: str, end: str, from_lane: int, to_lane: int) -> Attributes:
    return {"from": start, "to": end, "fromLane": from_lane, "toLane": to_lane}


ARMS = {"west": (-1, 0), "east": (1, 0), "south": (0, -1), "north": (0, 1)}
CONTROLS = {
    "priority": "priority", "signals": "traffic_light", "all_stop": "allway_stop",
    "right_before_left": "right_before_left",
}  # fmt: skip


def _junction(road: RoadDraft) -> tuple[list[Attributes], list[Attributes], list[Attributes]]:
    arms = ("west", "east", "south") if road.kind == "t" else tuple(ARMS)
    equal = road.control in ("right_before_left", "all_stop")
    nodes = [_node("centre", 0, 0, type=CONTROLS[road.control])]
    edges = []
    for arm in arms:
        x, y = ARMS[arm]
        nodes.append(_node(arm, x * road.length, y * road.length))
        main = arm in ("west", "east")
        kmh, priority = (road.speed_limit if main else road.minor_limit), 10 if main or equal else 1
        edges += [
            _edge(f"{arm}_in", arm, "centre", road.lanes, kmh, priority=priority),
            _edge(f"{arm}_out", "centre", arm, road.lanes, kmh, priority=priority),
        ]
    return nodes, edges, []


def _roundabout(road: RoadDraft) -> tuple[list[Attributes], list[Attributes], list[Attributes]]:
    order = ("east", "north", "west", "south")
    nodes, edges = [], []
    for place, arm in enumerate(order):
        x, y = ARMS[arm]
        nodes += [
            _node(f"ring_{arm}", x * RADIUS, y * RADIUS, type="priority"),
            _node(arm, x * (RADIUS + road.length), y * (RADIUS + road.length)),
        ]
        following = order[(place + 1) % 4]
        angles = [math.pi / 2 * (place + k / 9) for k in range(10)]
        shape = " ".join(f"{RADIUS * math.cos(q):.2f},{RADIUS * math.sin(q):.2f}" for q in angles)
        edges += [
            _edge(f"ring_{arm}_{following}", f"ring_{arm}", f"ring_{following}", 1, RING_SPEED, width=4,
                  spreadType="center", shape=shape),
            _edge(f"{arm}_in", arm, f"ring_{arm}", 1, road.speed_limit, priority=1),
            _edge(f"{arm}_out", f"ring_{arm}", arm, 1, road.speed_limit, priority=1),
        ]  # fmt: skip
    return nodes, edges, []


def _build(nodes: Sequence[Attributes], edges: Sequence[Attributes], links: Sequence[Attributes], target: Path) -> Path:
    program = find_netconvert()
    with tempfile.TemporaryDirectory(prefix="sumo_adv-") as scratch:
        folder = Path(scratch)
        arguments = [str(program), *OPTIONS, "-o", str(folder / "made.net.xml")]
        for option, kind, element, rows in (
            ("-n", "nodes", "node", nodes), ("-e", "edges", "edge", edges), ("-x", "connections", "connection", links)
        ):  # fmt: skip
            if rows:
                lines = [f"<{element} {' '.join(f'{k}={quoteattr(str(v))}' for k, v in r.items())}/>\n" for r in rows]
                (folder / kind).write_text(f"<{kind}>\n{''.join(lines)}</{kind}>\n", encoding="utf-8")
                arguments += [option, str(folder / kind)]
        try:
            done = subprocess.run(arguments, capture_output=True, text=True, check=False, timeout=TIMEOUT)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise UsageError(f"netconvert could not build the network: {error}.") from error
        if done.returncode != 0 or not (folder / "made.net.xml").is_file():
            last = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
            raise UsageError(f"netconvert could not build the network: {last.rstrip('.')}.")
        text = (folder / "made.net.xml").read_text(encoding="utf-8")
    opening = text.index("<net ")  # without netconvert's comment, which holds times and paths
    target.write_text(f"<!-- made by sumo-adv write -->\n{text[opening:]}", encoding="utf-8")
    return target
