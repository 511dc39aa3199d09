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
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.errors import UsageError, nearest
from sumo_adv.files import scratch_prefix
from sumo_adv.geometry import stations
from sumo_adv.simulation.centreline import Centreline, centreline
from sumo_adv.simulation.inputs import data_folder, shipped_files
from sumo_adv.simulation.network import is_left_hand
from sumo_adv.simulation.programs import find_netconvert
from sumo_adv.words.draft import RoadDraft

NETCONVERT_OPTIONS = (
    "--offset.disable-normalization", "--precision", "3", "--no-turnarounds", "--junctions.corner-detail", "6",
    "--junctions.internal-link-detail", "12", "--default.junctions.radius", "6", "--no-warnings",
    "--xml-validation", "never",
)  # fmt: skip
NETCONVERT_TIMEOUT_S = 60.0
STREET_LANE_WIDTH_M = 3.2
WIDE_LANE_WIDTH_M = 3.5  # on motorways and ramps
WIDE_LANE_SPEED_KM_H = 80.0  # lanes are wide at this speed limit or a higher one
ACCELERATION_LANE_M = 200.0
ROUNDABOUT_RADIUS_M = 18.0
ROUNDABOUT_SPEED_KM_H = 30.0
SIDEWALK_WIDTH_M, BIKE_LANE_WIDTH_M = 2.0, 1.5

Attributes = dict[str, object]
Plain = tuple[list[Attributes], list[Attributes], list[Attributes]]
"""Nodes, edges and connections."""
ARMS = {"west": (-1, 0), "east": (1, 0), "south": (0, -1), "north": (0, 1)}
CONTROLS = {
    "priority": "priority", "signals": "traffic_light", "all_stop": "allway_stop",
    "right_before_left": "right_before_left",
}  # fmt: skip
MEETING_DISTANCE_M = 2.0  # ways that come nearer than this meet
DRIVE_POINT_SPACING_M = 1.0  # between two points of a way


def make_network(road: RoadDraft, target: Path, given: Path | None) -> Path:
    """Return the network of a draft; write it first if it is generated.

    Args:
        road: The road of the draft.
        target: The path for a generated network.
        given: The user's network; None if there is none.

    Raises:
        UsageError: The name is not that of a shipped network, the user gave no network, or netconvert fails.
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
    makers = {"straight": _straight, "ramp": _ramp, "lane_drop": _lane_drop, "roundabout": _roundabout}
    return _build(*makers.get(road.kind, _junction)(road), target)


def _edge(name: str, start: str, end: str, lanes: int, kmh: float, **more: object) -> Attributes:
    """Return an edge in netconvert's attributes."""
    width = WIDE_LANE_WIDTH_M if kmh >= WIDE_LANE_SPEED_KM_H else STREET_LANE_WIDTH_M
    return {
        "id": name, "from": start, "to": end, "priority": 10, "numLanes": lanes, "speed": round(kmh / 3.6, 2),
        "width": width, "spreadType": "right", **more,
    }  # fmt: skip


def _node(name: str, x: float, y: float, **more: object) -> Attributes:
    """Return a node in netconvert's attributes."""
    return {"id": name, "x": round(x, 2), "y": round(y, 2), **more}


def _beside(road: RoadDraft) -> Attributes:
    """Return the attributes of the sidewalk and bicycle lane of a street."""
    extra: Attributes = {"disallow": "pedestrian"} if road.sidewalk or road.bike_lane else {}
    extra |= {"sidewalkWidth": SIDEWALK_WIDTH_M} if road.sidewalk else {}
    return extra | ({"bikeLaneWidth": BIKE_LANE_WIDTH_M} if road.bike_lane else {})


def _straight(road: RoadDraft) -> Plain:
    """Return a straight road."""
    nodes = [_node("west", 0, 0), _node("east", road.length, 0)]
    edges = [_edge("forward", "west", "east", road.lanes, road.speed_limit, **_beside(road))]
    if road.lanes_back:
        edges.append(_edge("backward", "east", "west", road.lanes_back, road.speed_limit, **_beside(road)))
    return nodes, edges, []


def _ramp(road: RoadDraft) -> Plain:
    """Return a road with an on-ramp."""
    nodes = [
        _node("west", -road.length, 0), _node("start", -min(road.length, 300.0), -75.0),
        _node("nose", 0, 0, type="priority"), _node("taper", ACCELERATION_LANE_M, 0, type="priority"),
        _node("east", ACCELERATION_LANE_M + road.length, 0),
    ]  # fmt: skip
    width = WIDE_LANE_WIDTH_M if road.speed_limit >= WIDE_LANE_SPEED_KM_H else STREET_LANE_WIDTH_M
    lower = -(road.lanes + 0.5) * width
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


def _lane_drop(road: RoadDraft) -> Plain:
    """Return a road on which a lane ends."""
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
    """Return a connection in netconvert's attributes."""
    return {"from": start, "to": end, "fromLane": from_lane, "toLane": to_lane}


def _junction(road: RoadDraft) -> Plain:
    """Return a T-junction or a crossing."""
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


def _roundabout(road: RoadDraft) -> Plain:
    """Return a roundabout with four arms."""
    order = ("east", "north", "west", "south")
    nodes, edges = [], []
    for place, arm in enumerate(order):
        x, y = ARMS[arm]
        nodes += [
            _node(f"ring_{arm}", x * ROUNDABOUT_RADIUS_M, y * ROUNDABOUT_RADIUS_M, type="priority"),
            _node(arm, x * (ROUNDABOUT_RADIUS_M + road.length), y * (ROUNDABOUT_RADIUS_M + road.length)),
        ]
        following = order[(place + 1) % 4]
        angles = [math.pi / 2 * (place + k / 9) for k in range(10)]
        points = ((ROUNDABOUT_RADIUS_M * math.cos(q), ROUNDABOUT_RADIUS_M * math.sin(q)) for q in angles)
        shape = " ".join(f"{x:.2f},{y:.2f}" for x, y in points)
        edges += [
            _edge(f"ring_{arm}_{following}", f"ring_{arm}", f"ring_{following}", 1, ROUNDABOUT_SPEED_KM_H, width=4,
                  spreadType="center", shape=shape),
            _edge(f"{arm}_in", arm, f"ring_{arm}", 1, road.speed_limit, priority=1),
            _edge(f"{arm}_out", f"ring_{arm}", arm, 1, road.speed_limit, priority=1),
        ]  # fmt: skip
    return nodes, edges, []


def _build(nodes: Sequence[Attributes], edges: Sequence[Attributes], links: Sequence[Attributes], target: Path) -> Path:
    """Build the network with netconvert."""
    program = find_netconvert()
    with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as scratch:
        folder = Path(scratch)
        arguments = [str(program), *NETCONVERT_OPTIONS, "-o", str(folder / "made.net.xml")]
        for option, kind, element, rows in (
            ("-n", "nodes", "node", nodes), ("-e", "edges", "edge", edges), ("-x", "connections", "connection", links)
        ):  # fmt: skip
            if rows:
                lines = [f"<{element} {' '.join(f'{k}={quoteattr(str(v))}' for k, v in r.items())}/>\n" for r in rows]
                (folder / kind).write_text(f"<{kind}>\n{''.join(lines)}</{kind}>\n", encoding="utf-8")
                arguments += [option, str(folder / kind)]
        try:
            done = subprocess.run(arguments, capture_output=True, text=True, check=False, timeout=NETCONVERT_TIMEOUT_S)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise UsageError(f"netconvert could not build the network: {error}.") from error
        if done.returncode != 0 or not (folder / "made.net.xml").is_file():
            last = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
            raise UsageError(f"netconvert could not build the network: {last.rstrip('.')}.")
        text = (folder / "made.net.xml").read_text(encoding="utf-8")
    opening = text.index("<net ")  # leave out netconvert's comment, which holds times and paths
    target.write_text(f"<!-- made by sumo-adv write -->\n{text[opening:]}", encoding="utf-8")
    return target


@dataclass(frozen=True, slots=True)
class VehicleRoute:
    """A vehicle's way.

    Attributes:
        edges: The ids of its edges.
        lane: SUMO's index of the lane on the first edge.
        points: Its points ``(n, 2)``, ``DRIVE_POINT_SPACING_M`` apart, from the beginning of the first edge on [m].
        line: The centre line of that lane.
        limit: The speed limit of that lane [m/s].
        begins: The station at which each edge begins [m].
    """

    edges: tuple[str, ...]
    lane: int
    points: Floats
    line: Centreline
    limit: float
    begins: tuple[float, ...]

    @property
    def first(self) -> float:
        """The length of the lane on the first edge [m]."""
        return self.line.length

    def at(self, station: float) -> tuple[float, float, float]:
        """Return x, y [m] and heading [rad] at a station. The way is straight beyond its ends.

        Args:
            station: The distance along the way [m].
        """
        k = int(np.clip(station / DRIVE_POINT_SPACING_M, 0, len(self.points) - 2))
        a, b = self.points[k], self.points[k + 1]
        along = (b - a) / max(float(np.hypot(*(b - a))), 1e-6)
        x, y = a + along * (station - k * DRIVE_POINT_SPACING_M)
        return float(x), float(y), float(np.arctan2(along[1], along[0]))

    def nearest(self, x: float, y: float) -> float:
        """Return the station of the point nearest to (x, y) [m].

        Args:
            x: The x coordinate [m].
            y: The y coordinate [m].
        """
        return float(np.argmin(np.hypot(*(self.points - (x, y)).T))) * DRIVE_POINT_SPACING_M


class Net:
    """The network that a draft uses."""

    def __init__(self, path: Path) -> None:
        """Read a network.

        Args:
            path: The path of the file.

        Raises:
            UsageError: The file cannot be read.
        """
        import sumolib

        try:
            self._net = sumolib.net.readNet(str(path), withPrograms=True)
            self._left_hand = is_left_hand(path)
        except Exception as error:  # sumolib raises whatever its parser raises
            raise UsageError(f"The network {path} cannot be read ({error}).") from error

    def drive(self, route: Sequence[str], lane: int, vclass: str, who: str) -> VehicleRoute:
        """Find the shortest way from the first to the last edge.

        Args:
            route: The first and the last edge.
            lane: The lane on the first edge, counted from the right among the lanes for ``vclass``.
            vclass: SUMO's vehicle class.
            who: The name of the vehicle, for error messages.

        Raises:
            UsageError: An edge or lane does not exist, or no way leads there.
        """
        start, end = (self._edge(name, who) for name in (route[0], route[-1]))
        edges, _ = self._net.getShortestPath(start, end, vClass=vclass)
        if edges is None:
            raise UsageError(f"No way leads a {vclass} from edge '{route[0]}' to '{route[-1]}' (the route of {who}).")
        lanes = [each for each in start.getLanes() if each.allows(vclass)]
        if self._left_hand:  # SUMO counts its lanes from the left
            lanes.reverse()
        if lane >= len(lanes):
            raise UsageError(
                f"Edge '{route[0]}' has {len(lanes)} lanes for {who}, so its lane is 0 to {len(lanes) - 1}, not {lane}."
            )
        chosen = lanes[lane]
        shapes = _driven(edges, chosen, vclass)
        points = _even(np.concatenate(shapes))
        begins = tuple(float(np.argmin(np.hypot(*(points - shape[0]).T))) * DRIVE_POINT_SPACING_M for shape in shapes)
        return VehicleRoute(
            tuple(str(e.getID()) for e in edges), int(chosen.getIndex()), points,
            centreline(chosen.getShape3D(), float(chosen.getLength())), float(chosen.getSpeed()), begins,
        )  # fmt: skip

    def lanes_beside(self, drive: VehicleRoute) -> tuple[int, int]:
        """Return how many lanes for cars are to the right and to the left of a way at its beginning.

        Lanes of the opposite direction count as lanes to the left.

        Args:
            drive: The way.
        """
        edge = self._net.getEdge(drive.edges[0])
        back = [e for e in edge.getToNode().getOutgoing() if e.getToNode() is edge.getFromNode()]
        own = [lane.getIndex() for lane in edge.getLanes() if lane.allows("passenger")]
        opposite = sum(lane.allows("passenger") for e in back for lane in e.getLanes())
        right = sum(index < drive.lane for index in own)
        return right, sum(index > drive.lane for index in own) + opposite

    def turn(self, drive: VehicleRoute) -> str | None:
        """Return where a way goes at the end of its first edge.

        Args:
            drive: The way.

        Returns:
            Left, right or straight on; None if it has one edge.
        """
        if len(drive.edges) < 2:
            return None
        edge, after = (self._net.getEdge(name) for name in drive.edges[:2])
        directions = {str(c.getDirection()).lower() for c in edge.getConnections(after)}
        return "left" if "l" in directions else "right" if "r" in directions else "straight on"

    def light_states(self, edges: Sequence[str], shows: str) -> dict[str, str]:
        """Return the states of the traffic lights on the ego's way in a phase of a draft.

        Turns across the opposite lanes wait for oncoming traffic. Pedestrian crossings have red.

        Args:
            edges: The ids of the edges of the ego's way.
            shows: What the phase shows, as in the draft.

        Returns:
            SUMO's state string of each light, by its id.
        """
        states = {}
        side, _, colour = shows.partition("_")
        across = "r" if self._left_hand else "l"
        for light in self._net.getTrafficLights():
            links = light.getConnections()
            own = [a.getEdge().getID() for a, _, _ in links if a.getEdge().getID() in edges]
            if not own:
                continue
            ahead = self._facing(own[0])
            phases = [phase for program in light.getPrograms().values() for phase in program.getPhases()]
            # sumolib does not list the links of pedestrian crossings, but SUMO's programs have a letter for them.
            letters = ["r"] * max([k + 1 for _, _, k in links] + [len(phase.state) for phase in phases])
            for start, end, k in links:
                if side == "all" or (side == "ego") != (start.getEdge().getID() in ahead):
                    continue
                turns = [c.getDirection() for c in start.getOutgoing() if c.getToLane() is end]
                letters[k] = "y" if colour == "yellow" else "g" if across in turns else "G"
            states[str(light.getID())] = "".join(letters)
        return states

    def _facing(self, edge: str) -> set[str]:
        """Return the edge, and the edge from the opposite side to the same junction."""
        own = self._net.getEdge(edge)
        turn = _direction(own)
        return {edge} | {
            str(e.getID()) for e in own.getToNode().getIncoming() if float(np.dot(_direction(e), turn)) < -0.7
        }

    def words(self) -> str:
        """Describe the edges, in a few words each."""
        parts = []
        for edge in sorted(self._net.getEdges(), key=lambda e: str(e.getID())):
            limits = [lane.getSpeed() for lane in edge.getLanes() if lane.allows("passenger")]
            if limits:
                kmh = max(limits) * 3.6
                parts.append(f"{edge.getID()} ({len(limits)}, {kmh:.0f} km/h, {edge.getLength():.0f} m)")
        return ", ".join(parts)

    def _edge(self, name: str, who: str) -> Any:
        """Return an edge by its name; raise UsageError with the known edges if there is none."""
        if not self._net.hasEdge(name):
            names = sorted(str(e.getID()) for e in self._net.getEdges())
            listed = ", ".join(names[:30])
            raise UsageError(f"There is no edge '{name}' for {who}{nearest(name, names)}; there are {listed}.")
        return self._net.getEdge(name)


def meeting(one: VehicleRoute, other: VehicleRoute) -> tuple[float, float] | None:
    """Find where two ways first meet.

    They meet where they come together, or where they reach the same edge in neighbouring lanes (a ramp with a lane to
    merge from).

    Args:
        one: One way.
        other: The other way.

    Returns:
        The stations on both ways [m]; None if they do not meet or begin on the same edge.
    """
    if one.edges[0] == other.edges[0]:
        return None
    apart = np.hypot(*(one.points[:, None, :] - other.points[None, :, :]).transpose(2, 0, 1))
    close = (apart < MEETING_DISTANCE_M).any(axis=1)
    shared = next((edge for edge in one.edges if edge in other.edges), None)
    beside = np.inf if shared is None else one.begins[one.edges.index(shared)]
    i = int(np.argmax(close)) if close.any() else len(close)
    if shared is not None and beside < i * DRIVE_POINT_SPACING_M:
        return beside, other.begins[other.edges.index(shared)]
    return (i * DRIVE_POINT_SPACING_M, float(np.argmin(apart[i])) * DRIVE_POINT_SPACING_M) if close.any() else None


def _driven(edges: Sequence[Any], lane: Any, vclass: str) -> list[Floats]:
    """Return the centre lines of the lanes along a route, one for each edge, with lane changes where needed."""
    shapes = [np.array(lane.getShape())[:, :2]]
    for edge, after in pairwise(edges):
        links = [c for c in edge.getConnections(after) if c.getToLane().allows(vclass)]
        link = next((c for c in links if c.getFromLane() is lane), links[0])
        lane = link.getToLane()
        shapes.append(np.array(lane.getShape())[:, :2])
    return shapes


def _direction(edge: Any) -> Floats:
    """Return the direction of an edge at its end."""
    a, b = np.array(edge.getShape())[[-2, -1], :2]
    return np.asarray((b - a) / max(float(np.hypot(*(b - a))), 1e-6))


def _even(points: Floats) -> Floats:
    """Resample points every ``DRIVE_POINT_SPACING_M``."""
    x, y = points[np.concatenate([[True], np.hypot(*np.diff(points, axis=0).T) > 1e-3])].T
    station = stations(x, y)
    s = np.arange(0.0, station[-1], DRIVE_POINT_SPACING_M)
    return np.stack([np.interp(s, station, x), np.interp(s, station, y)], axis=1)
