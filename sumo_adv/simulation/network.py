"""The road as the rest of the program sees it, read from a net.xml by sumolib."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats, LaneStrip
from sumo_adv.errors import UsageError
from sumo_adv.geometry import Path, along, make_path, read_only, same_layer, stations, wrap
from sumo_adv.simulation.centreline import Centreline, centreline
from sumo_adv.simulation.drivable import DRIVABLE_KEY, Drivable, Surface, area_of
from sumo_adv.simulation.layers import HEIGHTS_KEY as HEIGHTS
from sumo_adv.simulation.layers import ElevatedLane, Heights, lane_heights
from sumo_adv.simulation.permissions import ALL_CLASSES, CAR, EVERYWHERE, ON_FOOT, allowed, is_carriageway, is_paved

MOVEMENT_OF_LETTER = {"s": "straight", "l": "left", "L": "left", "r": "right", "R": "right", "t": "u-turn"}
LANE_SEARCH_DISTANCE_M = 6.0  # no lane is wider
MAX_LANE_ANGLE_RAD = 0.6  # between a box and the lane that it is in
MAX_PATH_CURVATURE_1_M = 0.195  # what a car can follow within the limit of 0.2
MAX_PATHS = 6  # ways on that are followed for one vehicle
HALF_LANE_GAP_M = 0.3  # gaps between lanes of up to twice this are carriageway, too


@dataclass(frozen=True, slots=True)
class Connection:
    """A way from the end of a lane through a junction (``via``: internal lanes) to the next lane.

    link: junction and index there; yields_to: indices of those that have the right of way (SUMO's ``response``).
    light: its traffic light's id and place in the light's state; empty without one. classes: SUMO's vehicle classes
    that may take it."""

    to: str
    via: tuple[str, ...]
    movement: str  # straight | left | right | u-turn
    state: str  # SUMO's right of way letter: M has priority, m must give way, s/w stop, = equal, o/O off, - dead end
    link: tuple[str, int] = ("", -1)
    yields_to: frozenset[int] = frozenset()
    light: tuple[str, int] = ("", -1)
    classes: frozenset[str] = field(repr=False, default=ALL_CLASSES)


@dataclass(frozen=True, slots=True, eq=False)
class NetworkLane(Centreline):
    """One lane. width [m]; speed [m/s]. index: from the right, also in left-hand traffic, where SUMO counts from the
    left. classes: SUMO's vehicle classes that may use it."""

    id: str
    edge: str
    index: int
    width: float
    speed: float
    internal: bool
    classes: frozenset[str] = field(repr=False)
    connections: tuple[Connection, ...] = ()

    def allows(self, vclass: str) -> bool:
        """Whether a vehicle of a class may use it."""
        return vclass in self.classes

    @property
    def carriageway(self) -> bool:
        """Whether it is for motor vehicles of some class: also a bus lane, no cycle lane, sidewalk or track."""
        return is_carriageway(self.classes)

    @property
    def paved(self) -> bool:
        """Whether a car that leaves its own lane can drive on it: a carriageway or a cycle lane."""
        return is_paved(self.classes)


@dataclass(frozen=True, slots=True)
class PathAhead:
    """A path a vehicle could take from where it is: the lanes, the first movement at a junction, the path."""

    lanes: tuple[str, ...]
    movement: str
    path: Path
    junction: float  # station at which the first junction begins, inf if none is in reach
    rule: str = ""  # SUMO's right of way letter there (see ``Connection``), empty where there is no junction
    first: Connection | None = None  # at that junction
    bay: float = math.inf  # station at which vehicles that give way wait on it (SUMO's internal junction), else inf

    @property
    def gives_way(self) -> bool:
        """Whether SUMO's rules make it yield at the first junction."""
        return self.rule not in "MOo"


Closed = Callable[[str], bool]
"""Says of a lane's id whether it is closed now."""


def open_to_all(lane: str) -> bool:
    """``Closed`` where nothing is."""
    return False


@dataclass(frozen=True)
class RoadMap:
    """All lanes of a network, with what can be reached from where.

    ground: the drivable area that the network carries (shapely polygons, m), None where it carries none.
    hand: 1; -1 in left-hand traffic (netconvert's ``--lefthand``).
    heights: of the lanes; None where the network is flat and has no bridges. rims: the junctions with heights."""

    name: str
    lanes: dict[str, NetworkLane]
    edges: dict[str, tuple[str, ...]]  # edge -> its lane ids, rightmost first
    junctions: tuple[Floats, ...] = field(repr=False, default=())  # polygons (n, 2)
    ground: Any = field(repr=False, default=None)
    hand: float = 1.0
    heights: Heights | None = field(repr=False, default=None)
    rims: tuple[Floats, ...] = field(repr=False, default=())

    def line(self, lane: NetworkLane) -> Floats:
        """The centreline of a lane ``(n, 2)`` [m], or ``(n, 3)`` with heights where the network has some."""
        line = None if self.heights is None else self.heights.lines.get(lane.id)
        return lane.shape if line is None else line

    @cached_property
    def _tree(self) -> tuple[Any, list[NetworkLane]]:
        return _tree_of(lane for lane in self.lanes.values() if not lane.internal)

    def lanes_near(self, x: float, y: float, radius: float) -> list[NetworkLane]:
        """Lanes outside junctions that come within ``radius`` metres of a point."""
        from shapely import Point

        tree, lanes = self._tree
        return [lanes[i] for i in sorted(tree.query(Point(x, y).buffer(radius)))]

    @cached_property
    def meeting_junctions(self) -> frozenset[str]:
        """Ids of the junctions that motor vehicles reach from two or more edges."""
        return frozenset(name for name, approaching in self.approaching.items() if len(approaching) > 1)

    @cached_property
    def approaching(self) -> dict[str, set[str]]:
        """By id of a junction the edges from which motor vehicles reach it."""
        edges: dict[str, set[str]] = {}
        for lane in self.lanes.values():
            for connection in () if lane.internal else lane.connections:
                if connection.link[0] and lane.carriageway and is_carriageway(connection.classes):
                    edges.setdefault(connection.link[0], set()).add(lane.edge)
        return edges

    @cached_property
    def _paved_tree(self) -> tuple[Any, list[NetworkLane]]:
        return _tree_of(lane for lane in self.lanes.values() if lane.paved)

    def paved_lanes_within(self, x: float, y: float, radius: float) -> list[NetworkLane]:
        """Paved lanes, also within junctions, of which a part of the centreline is within ``radius`` [m]."""
        from shapely import Point

        tree, lanes = self._paved_tree
        return [lanes[i] for i in sorted(tree.query(Point(x, y).buffer(radius), predicate="intersects"))]

    def lane_at(
        self, x: float, y: float, heading: float, vclass: str = CAR, z: float | None = None
    ) -> tuple[str, float] | None:
        """The lane for a class, outside junctions, in which a point is, and how far along [m]; its direction must
        agree. z: so must its layer [m]; None = any."""
        best: tuple[float, str, float] | None = None
        for lane in self.level(self.lanes_near(x, y, LANE_SEARCH_DISTANCE_M), x, y, z):
            station = lane.station_at(x, y)
            nearest_x, nearest_y, direction = lane.point_at(station)
            away, turned = math.dist((x, y), (nearest_x, nearest_y)), abs(wrap(direction - heading))
            inside = away < lane.width / 2 and turned < MAX_LANE_ANGLE_RAD
            if lane.allows(vclass) and inside and (not best or away < best[0]):
                best = away, lane.id, station
        return None if best is None else best[1:]

    def level(self, lanes: Sequence[NetworkLane], x: float, y: float, z: float | None) -> list[NetworkLane]:
        """The lanes that are at a point on the layer of the height ``z`` [m]; all where that is None."""
        if self.heights is None or z is None:
            return list(lanes)
        return [lane for lane in lanes if same_layer(self.heights.at(lane.id, x, y), z)]

    def opposite_offset(self, x: float, y: float, heading: float, z: float | None = None) -> float | None:
        """Lateral offset of the nearest lane on the inner side (left, in left-hand traffic right) that leads the
        other way and touches ours, on the layer of the height ``z`` [m]; None if none. Only lanes for motor vehicles
        count."""
        best: float | None = None
        for lane in self.level(self.lanes_near(x, y, 12.0), x, y, z):
            i = int(np.argmin(np.hypot(lane.shape[:-1, 0] - x, lane.shape[:-1, 1] - y))) if len(lane.shape) > 2 else 0
            for j in range(max(0, i - 1), min(i + 2, len(lane.shape) - 1)):
                a, b = lane.shape[j], lane.shape[j + 1]
                h = math.atan2(b[1] - a[1], b[0] - a[0])
                if not lane.carriageway or abs(wrap(h - heading)) < 2.6:
                    continue
                d = math.cos(h) * (y - a[1]) - math.sin(h) * (x - a[0])
                t = math.cos(h) * (x - a[0]) + math.sin(h) * (y - a[1])
                inside = -2 < t < math.hypot(*(b - a)) + 2
                if inside and self.hand * d > 0 and (best is None or abs(d) < abs(best)):
                    best = d
        return best

    def side_offsets(
        self, lane_id: str, x: float, y: float, heading: float, vclass: str = CAR
    ) -> list[tuple[float, str]]:
        """Lanes beside ``lane_id`` as (offset [m], "same" | "opposite"), left positive, up to two to each side. Those
        of the same direction are the ones that a vehicle of the class may use."""
        lane = self.lanes.get(lane_id)
        if lane is None or lane.internal:
            return []
        offsets = [(offset, "same") for _, offset in self.beside(lane, vclass)]
        row = self.edges[lane.edge]
        inner = row[lane.index + 1 :] if self.hand > 0 else row[: lane.index]
        reach = sum(self.lanes[n].width for n in inner) + lane.width / 2
        z = None if self.heights is None else float(self.heights.at(lane_id, x, y))
        opposite = self.opposite_offset(x, y, heading, z)
        if opposite is not None and abs(opposite) < reach + 2.6:
            offsets.append((opposite, "opposite"))
        return offsets

    def beside(self, lane: NetworkLane, vclass: str) -> Iterator[tuple[NetworkLane, float]]:
        """The lanes of its edge for a class, up to two to each side, and their offsets [m, left positive]."""
        row = [self.lanes[n] for n in self.edges[lane.edge]]
        for i, neighbour in enumerate(row):
            if i == lane.index or abs(i - lane.index) > 2 or not neighbour.allows(vclass):
                continue
            between = sum(o.width for o in row[min(i, lane.index) + 1 : max(i, lane.index)])
            yield neighbour, math.copysign(between + (neighbour.width + lane.width) / 2, i - lane.index)

    def ways(
        self, lane_id: str, station: float, reach: float, route: tuple[str, ...] = (), farthest: float = 0.0,
        vclass: str = CAR, closed: Closed = open_to_all,
    ) -> list[PathAhead]:  # fmt: skip
        """Ways on of a vehicle of a class from ``station`` metres along a lane for ``reach`` metres, on to
        ``farthest`` [m] where the last lane goes as far.

        With ``route`` (edge ids from the present one) only that way; else one way for each movement at the first
        junction, then the straightest. ``closed``: says which lanes are avoided.
        """
        ways: list[PathAhead] = []
        for chain, first, junction, bay in self._chains(lane_id, station, reach, route, vclass, closed):
            points = np.vstack([self.line(self.lanes[n]) for n in chain])
            path = make_path(_cut(points, station, max(reach, farthest)), tightest=MAX_PATH_CURVATURE_1_M)
            if path.length < reach:
                path = path.extended(reach - path.length)
            movement, rule = ("none", "") if first is None else (first.movement, first.state)
            ways.append(PathAhead(tuple(chain), movement, path, junction, rule, first, bay))
            if len(ways) == MAX_PATHS:
                break
        return ways

    def chain(
        self, lane_id: str, station: float, reach: float, route: tuple[str, ...], vclass: str = CAR,
        closed: Closed = open_to_all,
    ) -> tuple[str, ...]:  # fmt: skip
        """The lanes of the first of the ``ways``."""
        return tuple(next(self._chains(lane_id, station, reach, route, vclass, closed))[0])

    def metres_ahead(self, lanes: Sequence[str], station: float, distance: float) -> float:
        """Metres from ``station`` on the first of some lanes to what is ``distance`` [m] ahead in SUMO's lengths."""
        gone, position = -station, self.lanes[lanes[0]].position_of(station) + distance
        for lane in (self.lanes[name] for name in lanes):
            if position <= lane.positions[-1]:
                return gone + lane.station_of(position)
            gone, position = gone + lane.length, position - float(lane.positions[-1])
        return gone + position

    def _chains(
        self, lane_id: str, station: float, reach: float, route: tuple[str, ...], vclass: str, closed: Closed
    ) -> Iterator[tuple[list[str], Connection | None, float, float]]:
        lane = self.lanes[lane_id]
        start = lane.length - station
        options = self.onward(lane, route, vclass, closed)
        if start >= reach or not options:
            yield [lane_id], None, math.inf, math.inf
            return
        for first in options:
            chain, length = [lane_id, *first.via, first.to], start
            length += sum(self.lanes[n].length for n in (*first.via, first.to))
            while length < reach:
                onward = self.onward(self.lanes[chain[-1]], route, vclass, closed)
                if not onward:
                    break
                step = onward[0]
                chain += [*step.via, step.to]
                length += sum(self.lanes[n].length for n in (*step.via, step.to))
            inside = 0.0 if lane.internal else start
            yield chain, first, inside, self._bay(lane, start, first)

    def _bay(self, lane: NetworkLane, start: float, on: Connection) -> float:
        """Metres to where the first internal lane of a connection ends and another follows; ``start``: to this lane's
        end."""
        if lane.internal:
            return start if on.via else math.inf
        return start + self.lanes[on.via[0]].length if len(on.via) > 1 else math.inf

    def onward(
        self, lane: NetworkLane, route: tuple[str, ...], vclass: str = CAR, closed: Closed = open_to_all
    ) -> list[Connection]:
        """Connections from a lane for a class, straight ones first; only along ``route`` where that says something.
        Those to closed lanes only where there are no others.

        A vehicle on a lane that its class may not use goes on as the lane leads."""
        near, far = ("right", "left") if self.hand > 0 else ("left", "right")
        order = {"straight": 0, near: 1, far: 2, "u-turn": 3}
        errs = not lane.allows(vclass)
        options = sorted(
            (c for c in lane.connections if c.to in self.lanes and (errs or vclass in c.classes)),
            key=lambda c: order[c.movement],
        )
        if route and not lane.internal and lane.edge in route:
            at = route.index(lane.edge)
            following = route[at + 1] if at + 1 < len(route) else None
            row = (self.lanes[name] for name in self.edges[lane.edge][:: int(self.hand)])
            # From a lane beside it: the vehicle will change lanes.
            beside = [c for other in row for c in other.connections if c.to in self.lanes and vclass in c.classes]
            leads = [c for c in (*options, *beside) if self.lanes[c.to].edge == following]
            return [c for c in leads if not closed(c.to)][:1] or leads[:1]
        options = [c for c in options if c.movement != "u-turn"]
        return [c for c in options if not closed(c.to)] or options

    def strips(self, x: float, y: float, radius: float) -> list[LaneStrip]:
        """Return all paved lanes near a place, for pictures: upper ones last."""
        near = [
            lane for lane in self.lanes.values()
            if lane.paved
            and np.min(np.hypot(lane.shape[:, 0] - x, lane.shape[:, 1] - y)) < radius + lane.length
        ]  # fmt: skip
        return [LaneStrip(self.line(lane), lane.width, lane.internal) for lane in sorted(near, key=self.top)]

    def top(self, lane: NetworkLane) -> float:
        """The greatest height of a lane [m]: what is drawn later hides what is below it."""
        line = self.line(lane)
        return float(line[:, 2].max()) if line.shape[1] > 2 else 0.0

    def leads_over(self, way: Floats, line: Floats) -> bool:
        """Whether a lane passes above or below a way where it is nearest to it; lines as :meth:`line` has them."""
        from shapely import LineString, shortest_line

        if self.heights is None or way.shape[1] < 3 or line.shape[1] < 3:
            return False
        plans = [LineString(points[:, :2]) for points in (way, line)]
        places = np.asarray(shortest_line(*plans).coords)
        z = (
            np.interp(along(points[:, :2], *place), stations(*points[:, :2].T), points[:, 2])
            for points, place in zip((way, line), places, strict=True)
        )
        return not same_layer(*z)

    def drivable(self, x: float, y: float, radius: float, way: Floats | None = None) -> Drivable:
        """The drivable ground within about ``radius`` metres of a place: the network's own, else the paved lanes and
        the junctions. It is the same for all classes: a car that cuts into a bus lane is on the road.
        way: leave out what leads over or under this line ``(n, 3)`` [m]."""
        from shapely import LineString, Point, Polygon, union_all

        if self.ground is not None:
            return Drivable(self.ground)
        reach = Point(x, y).buffer(radius)
        lanes = [
            lane for lane in self.paved_lanes_within(x, y, radius)
            if way is None or not self.leads_over(way, self.line(lane))
        ]  # fmt: skip
        shapes = [
            LineString(lane.shape).buffer(lane.width / 2 + 0.05, cap_style="square" if lane.internal else "flat")
            for lane in lanes
        ]
        lines = [self.line(lane) for lane in lanes]
        for polygon, line in zip(self.junctions, self.rims or self.junctions, strict=True):
            if way is not None and self.leads_over(way, line):
                continue
            if len(polygon) > 2 and (p := Polygon(polygon).buffer(0.05)).intersects(reach):
                shapes.append(p)
                lines.append(line)
        surfaces = () if self.heights is None else map(Surface, (s.buffer(HALF_LANE_GAP_M) for s in shapes), lines)
        return Drivable(union_all(shapes).buffer(HALF_LANE_GAP_M).buffer(-HALF_LANE_GAP_M), tuple(surfaces))


def _tree_of(lanes: Iterable[NetworkLane]) -> tuple[Any, list[NetworkLane]]:
    """Lanes, and a tree to look them up by place."""
    from shapely import LineString, STRtree

    lines = [lane for lane in lanes if len(lane.shape) > 1]
    return STRtree([LineString(lane.shape) for lane in lines]), lines


def _cut(points: Floats, position: float, length: float) -> Floats:
    """The polyline from ``position`` metres on, for ``length`` metres."""
    step = np.hypot(*np.diff(points[:, :2], axis=0).T)
    station = np.concatenate([[0.0], np.cumsum(step)])
    position = min(max(position, 0.0), station[-1] - 0.1)
    ends = np.array([position, min(position + length, station[-1])])
    start, end = np.column_stack([np.interp(ends, station, values) for values in points.T])
    inside = (station > position + 1e-6) & (station < ends[1] - 1e-6)
    return np.vstack([start, points[inside], end])


def read_network(path: FilePath) -> RoadMap:
    """Read a net.xml or net.xml.gz. Raises UsageError: sumolib cannot read the file."""
    from sumolib.net import readNet

    try:
        net = readNet(str(path), withInternal=True)
    except Exception as error:  # sumolib raises what its XML and gzip readers raise
        raise UsageError(
            f"{path} could not be read as a SUMO network ({error}); rebuild it with netconvert."
        ) from error
    hand = -1.0 if is_left_hand(path) else 1.0
    ground = _ground(path, net)
    try:
        strips = [_strip(lane) for edge in net.getEdges(withInternal=True) for lane in edge.getLanes()]
    except ValueError as error:
        raise UsageError(f"The heights in {path} are damaged ({error}); convert the record again.") from error
    heights = lane_heights(strips, infer=ground is None)
    lanes: dict[str, NetworkLane] = {}
    edges: dict[str, tuple[str, ...]] = {}
    for edge in net.getEdges(withInternal=True):
        row = tuple(lane.getID() for lane in edge.getLanes())
        edges[edge.getID()] = row if hand > 0 else row[::-1]
        internal = edge.getFunction() == "internal"
        for lane in edge.getLanes():
            line = centreline(lane.getShape3D(), float(lane.getLength()))
            lanes[lane.getID()] = NetworkLane(
                line.shape, line.stations, line.positions,
                lane.getID(), edge.getID(), edges[edge.getID()].index(lane.getID()),
                float(lane.getWidth()), float(lane.getSpeed()), internal,
                _classes(lane), _connections(net, lane),
            )  # fmt: skip
    nodes = [n for n in net.getNodes() if len(n.getShape()) > 2]
    junctions = tuple(read_only(np.asarray(n.getShape(), float)[:, :2]) for n in nodes)
    rims = () if heights is None else tuple(_rim(n, heights) for n in nodes)
    return RoadMap(path.name.split(".net.xml")[0], lanes, edges, junctions, ground, hand, heights, rims)


def _strip(lane: Any) -> ElevatedLane:
    """A lane of sumolib for its height. A faster, wider road bridges another rather than the other way round."""
    edge = lane.getEdge()
    shape = np.asarray(lane.getShape3D(), float)
    start, end = edge.getFromNode().getID(), edge.getToNode().getID()
    if edge.getFunction():  # within a junction, whose name is in that of the edge
        start = end = edge.getID()[1:].rpartition("_")[0]
    size = edge.getPriority(), edge.getSpeed(), edge.getLaneNumber()
    z = np.array(lane.getParam(HEIGHTS).split(), float) if lane.getParam(HEIGHTS) else shape[:, 2]
    if len(z) != len(shape):
        raise ValueError(f"lane {lane.getID()} has {len(shape)} points and {len(z)} heights")
    rank = (not edge.getFunction(), *size, *sorted((start, end)), edge.getID())
    return ElevatedLane(lane.getID(), edge.getID(), shape[:, :2], z, start, end, rank)


def _rim(node: Any, heights: Heights) -> Floats:
    """The outline of a junction with heights ``(n, 3)``: at each point that of the lane that ends there."""
    shape = np.asarray(node.getShape(), float)[:, :2]
    ways = ((node.getIncoming(), -1), (node.getOutgoing(), 0))
    lanes = ((lane.getID(), end) for edges, end in ways for edge in edges for lane in edge.getLanes())
    ends = np.array([heights.lines[name][end] for name, end in lanes if name in heights.lines]).reshape(-1, 3)
    if not len(ends):
        return shape
    nearest = np.hypot(*(shape[:, None, :] - ends[None, :, :2]).transpose(2, 0, 1)).argmin(axis=1)
    return np.column_stack([shape, ends[nearest, 2]])


def is_left_hand(path: FilePath) -> bool:
    """Whether a network is of left-hand traffic; sumolib does not say it."""
    import gzip
    from xml.etree import ElementTree

    with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
        _, root = next(ElementTree.iterparse(file, events=("start",)))
    return str(root.get("lefthand")) in ("true", "1", "yes", "on")


def _ground(path: FilePath, net: Any) -> Any:
    """The drivable area that a network carries."""
    try:
        return area_of(node.getParam(DRIVABLE_KEY) for node in net.getNodes() if node.getParam(DRIVABLE_KEY))
    except ValueError as error:
        raise UsageError(f"The drivable area in {path} is damaged ({error}); convert the record again.") from error


def _classes(lane: Any) -> frozenset[str]:
    """The vehicle classes that may use a lane of sumolib's; none but people on crossings and the like."""
    classes = allowed(lane.getPermissions())
    return _one(classes if lane.getEdge().getFunction() in ("", "internal") else classes & ON_FOOT)


@cache
def _one(classes: frozenset[str]) -> frozenset[str]:
    """The one object for equal sets: a large network has thousands of lanes, and few different sets."""
    return classes


def _connections(net: Any, lane: Any) -> tuple[Connection, ...]:
    """The connections from a lane that any vehicle may take."""
    connections = []
    for c in lane.getOutgoing():
        via, name = [], c.getViaLaneID()
        while name:
            via.append(name)
            onward = net.getLane(name).getOutgoing()
            name = onward[0].getViaLaneID() if onward and onward[0].getViaLaneID() not in via else ""
        classes = _classes(lane) & _classes(c.getToLane()) & allowed(c._allowed)  # sumolib has no getter for it
        for name in via:
            classes &= _classes(net.getLane(name))
        if classes - ON_FOOT - {EVERYWHERE}:
            movement = MOVEMENT_OF_LETTER.get(c.getDirection(), "straight")
            link, yields_to = _right_of_way(lane, via)
            light = (c.getTLSID() or "", int(c.getTLLinkIndex()))
            to, state = c.getToLane().getID(), c.getState() or "M"
            connections.append(Connection(to, tuple(via), movement, state, link, yields_to, light, _one(classes)))
    return tuple(connections)


def _right_of_way(lane: Any, via: Sequence[str]) -> tuple[tuple[str, int], frozenset[int]]:
    """A connection's junction and index there, and the indices of those that go first; the index is in the name of its
    internal lane: that of its edge's first lane and the lane's place in the edge."""
    parts = via[0].rsplit("_", 2) if via else []
    if len(parts) != 3 or not (parts[1].isdigit() and parts[2].isdigit()):
        return ("", -1), frozenset()
    index, node = int(parts[1]) + int(parts[2]), lane.getEdge().getToNode()
    response = node._prohibits.get(index, "")  # sumolib has no fast way to ask for it
    return (node.getID(), index), frozenset(k for k, bit in enumerate(reversed(response)) if bit == "1")
