"""The road network as the rest of the program uses it, read from a net.xml by sumolib."""

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

MOVEMENT_OF_LETTER = {
    "s": "straight", "l": "left", "L": "left", "r": "right", "R": "right", "t": "u-turn", "T": "u-turn",
}  # fmt: skip
"""The movement by SUMO's letter of a connection's direction; ``T`` is a turnaround in left-hand traffic."""
LANE_SEARCH_DISTANCE_M = 6.0  # from a point to a lane that could contain it; no lane is wider
MAX_LANE_ANGLE_RAD = 0.6  # between a vehicle's heading and the direction of its lane
MAX_PATH_CURVATURE_1_M = 0.195  # curvature that a car can follow within the limit of 0.2
MAX_PATHS = 6  # paths per vehicle
HALF_LANE_GAP_M = 0.3  # gaps between lanes of up to twice this width also count as carriageway


@dataclass(frozen=True, slots=True)
class Connection:
    """A connection from the end of a lane through a junction to the next lane.

    Attributes:
        to: The id of the next lane.
        via: The ids of the internal lanes between.
        movement: straight, left, right or u-turn.
        state: SUMO's right-of-way letter: M has priority, m must give way, s and w stop, = is equal, o and O are off, -
            is a dead end.
        link: The junction, and the index of the connection there.
        yields_to: Indices of the connections that have the right of way over this one (SUMO's ``response``).
        light: The id of its traffic light, and its place in the light's state; an empty id without a light.
        classes: SUMO's vehicle classes that may use it.
    """

    to: str
    via: tuple[str, ...]
    movement: str
    state: str
    link: tuple[str, int] = ("", -1)
    yields_to: frozenset[int] = frozenset()
    light: tuple[str, int] = ("", -1)
    classes: frozenset[str] = field(repr=False, default=ALL_CLASSES)


@dataclass(frozen=True, slots=True, eq=False)
class NetworkLane(Centreline):
    """One lane.

    Attributes:
        id: The id of the lane.
        edge: The id of its edge.
        index: Its index from the right. This also holds in left-hand traffic, where SUMO counts from the left.
        width: Its width [m].
        speed: Its speed limit [m/s].
        internal: Whether it lies within a junction.
        classes: SUMO's vehicle classes that may use it.
        connections: Its connections to other lanes.
    """

    id: str
    edge: str
    index: int
    width: float
    speed: float
    internal: bool
    classes: frozenset[str] = field(repr=False)
    connections: tuple[Connection, ...] = ()

    def allows(self, vclass: str) -> bool:
        """Return whether a vehicle of a class may use the lane."""
        return vclass in self.classes

    @property
    def carriageway(self) -> bool:
        """Whether the lane is for motor vehicles of some class, such as a bus lane; not a cycle lane, sidewalk or
        track.
        """
        return is_carriageway(self.classes)

    @property
    def paved(self) -> bool:
        """Whether a car that leaves its own lane can drive on this one: a carriageway or a cycle lane."""
        return is_paved(self.classes)


@dataclass(frozen=True, slots=True)
class PathAhead:
    """A path that a vehicle could take from its present place.

    Attributes:
        lanes: The ids of the lanes, the present one first.
        movement: The movement at the first junction: straight, left, right or u-turn; ``none`` without a junction.
        path: The path; station 0 is the vehicle's place.
        junction: The station at which the first junction begins [m]; inf if none is in reach.
        rule: SUMO's right-of-way letter at that junction (see ``Connection``); empty without a junction.
        first: The connection at that junction.
        bay: The station on the junction at which a vehicle that gives way waits [m] (SUMO's internal junction); inf
            without one.
    """

    lanes: tuple[str, ...]
    movement: str
    path: Path
    junction: float
    rule: str = ""
    first: Connection | None = None
    bay: float = math.inf

    @property
    def gives_way(self) -> bool:
        """Whether SUMO's rules make the vehicle yield at the first junction."""
        return self.rule not in "MOo"


Closed = Callable[[str], bool]
"""Returns whether the lane with an id is closed now."""


def open_to_all(lane: str) -> bool:
    """Treat every lane as open (a ``Closed``)."""
    return False


@dataclass(frozen=True)
class RoadMap:
    """All lanes of a network, and how they connect.

    Attributes:
        name: The name of the network.
        lanes: The lanes by id.
        edges: The ids of each edge's lanes, rightmost first.
        junctions: The outlines of the junctions, each ``(n, 2)`` [m].
        ground: The drivable area that the network carries (shapely polygons [m]); None if it carries none.
        hand: 1 in right-hand traffic, -1 in left-hand traffic (netconvert's ``--lefthand``).
        heights: The heights of the lanes; None if the network is flat and has no bridges.
        rims: The outlines of the junctions with heights, each ``(n, 3)`` [m]; empty without heights.
    """

    name: str
    lanes: dict[str, NetworkLane]
    edges: dict[str, tuple[str, ...]]
    junctions: tuple[Floats, ...] = field(repr=False, default=())
    ground: Any = field(repr=False, default=None)
    hand: float = 1.0
    heights: Heights | None = field(repr=False, default=None)
    rims: tuple[Floats, ...] = field(repr=False, default=())

    def line(self, lane: NetworkLane) -> Floats:
        """Return the centreline of a lane [m], ``(n, 3)`` if heights are known and ``(n, 2)`` otherwise."""
        line = None if self.heights is None else self.heights.lines.get(lane.id)
        return lane.shape if line is None else line

    @cached_property
    def _tree(self) -> tuple[Any, list[NetworkLane]]:
        return _tree_of(lane for lane in self.lanes.values() if not lane.internal)

    def lanes_near(self, x: float, y: float, radius: float) -> list[NetworkLane]:
        """Return lanes outside junctions near a point.

        Args:
            x: The point's x [m].
            y: The point's y [m].
            radius: The distance within which a lane must come [m].

        Returns:
            The lanes whose bounding boxes overlap that of the circle.
        """
        from shapely import Point

        tree, lanes = self._tree
        return [lanes[i] for i in sorted(tree.query(Point(x, y).buffer(radius)))]

    @cached_property
    def meeting_junctions(self) -> frozenset[str]:
        """Ids of the junctions that motor vehicles reach from two or more edges."""
        return frozenset(name for name, approaching in self.approaching.items() if len(approaching) > 1)

    @cached_property
    def approaching(self) -> dict[str, set[str]]:
        """The edges from which motor vehicles reach each junction, by the junction's id."""
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
        """Return paved lanes near a point, including those within junctions.

        Args:
            x: The point's x [m].
            y: The point's y [m].
            radius: The distance within which the centreline must come [m].

        Returns:
            The lanes.
        """
        from shapely import Point

        tree, lanes = self._paved_tree
        return [lanes[i] for i in sorted(tree.query(Point(x, y).buffer(radius), predicate="intersects"))]

    def lane_at(
        self, x: float, y: float, heading: float, vclass: str = CAR, z: float | None = None
    ) -> tuple[str, float] | None:
        """Return the lane outside junctions that contains a point and runs in its direction.

        Args:
            x: The point's x [m].
            y: The point's y [m].
            heading: The direction [rad], which must agree with the lane's.
            vclass: The vehicle class that must be allowed on the lane.
            z: The height [m], whose layer the lane must share; None means any.

        Returns:
            The lane's id and the station of the point on it [m]; None if there is no such lane.
        """
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
        """Return the lanes that are on the layer of a height at a point.

        Args:
            lanes: The lanes to choose from.
            x: The point's x [m].
            y: The point's y [m].
            z: The height [m]; None returns all lanes.

        Returns:
            The lanes.
        """
        if self.heights is None or z is None:
            return list(lanes)
        return [lane for lane in lanes if same_layer(self.heights.at(lane.id, x, y), z)]

    def opposite_offset(self, x: float, y: float, heading: float, z: float | None = None) -> float | None:
        """Return the lateral offset of the nearest oncoming lane on the inner side.

        The inner side is the left in right-hand traffic and the right in left-hand traffic. Only lanes for motor
        vehicles count.

        Args:
            x: The point's x [m].
            y: The point's y [m].
            heading: The direction of travel [rad].
            z: The height [m], whose layer the lane must share; None means any.

        Returns:
            The offset [m], left positive; None if no such lane is near.
        """
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
        """Return the lanes beside a lane, up to two on each side in the same direction and one oncoming lane.

        Args:
            lane_id: The id of the lane.
            x: The x of a point on it [m].
            y: The y of the point [m].
            heading: The direction of travel there [rad].
            vclass: The vehicle class that may use the lanes of the same direction.

        Returns:
            Pairs of an offset [m], left positive, and "same" or "opposite"; empty if the lane is unknown or internal.
        """
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
        """Yield the lanes of the same edge, up to two on each side.

        Args:
            lane: The lane.
            vclass: The vehicle class that may use them.

        Yields:
            A lane and its offset [m], left positive.
        """
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
        """Return the paths that a vehicle can take.

        With ``route``, there is only one path. Without it, there is one path for each connection at the first junction,
        at most ``MAX_PATHS``. Each goes on as straight as possible after that junction.

        Args:
            lane_id: The id of the present lane.
            station: Where the vehicle is on it [m].
            reach: The minimum length of a path [m]. A path is extended beyond its last lane if necessary.
            route: The ids of the edges to follow, from the present one on.
            farthest: The length up to which a path follows its lanes if they are long enough [m].
            vclass: The vehicle class.
            closed: Returns which lanes to avoid.

        Returns:
            The paths, straight ones first.
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
        """Return the ids of the lanes of the first path of ``ways``."""
        return tuple(next(self._chains(lane_id, station, reach, route, vclass, closed))[0])

    def metres_ahead(self, lanes: Sequence[str], station: float, distance: float) -> float:
        """Convert a distance in SUMO's lane lengths to metres along the lanes.

        Args:
            lanes: The ids of the lanes, the present one first.
            station: The place on the first lane from which to measure [m].
            distance: The distance ahead in SUMO's lengths [m].

        Returns:
            The distance in metres of road.
        """
        gone, position = -station, self.lanes[lanes[0]].position_of(station) + distance
        for lane in (self.lanes[name] for name in lanes):
            if position <= lane.positions[-1]:
                return gone + lane.station_of(position)
            gone, position = gone + lane.length, position - float(lane.positions[-1])
        return gone + position

    def _chains(
        self, lane_id: str, station: float, reach: float, route: tuple[str, ...], vclass: str, closed: Closed
    ) -> Iterator[tuple[list[str], Connection | None, float, float]]:
        """Yield the lanes of each path, its first connection, and the distances to the first junction and bay [m]."""
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
        """Return the distance to the end of the connection's first internal lane, if another one follows [m].

        Args:
            lane: The present lane.
            start: The distance to the end of that lane [m].
            on: The connection.

        Returns:
            The distance [m]; inf if no internal lane follows.
        """
        if lane.internal:
            return start if on.via else math.inf
        return start + self.lanes[on.via[0]].length if len(on.via) > 1 else math.inf

    def onward(
        self, lane: NetworkLane, route: tuple[str, ...], vclass: str = CAR, closed: Closed = open_to_all
    ) -> list[Connection]:
        """Return the connections that a vehicle can take from a lane, straight ones first.

        Connections to closed lanes are returned only if there are no others. A vehicle on a lane that its class may not
        use can take every connection of that lane.

        Args:
            lane: The lane.
            route: The ids of the edges to follow. If they contain the lane's edge, at most one connection is returned.
                It may start from a neighbouring lane, because the vehicle will change lanes.
            vclass: The vehicle class.
            closed: Returns which lanes to avoid.

        Returns:
            The connections.
        """
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
            # Include connections from the neighbouring lanes, because the vehicle will change lanes.
            beside = [c for other in row for c in other.connections if c.to in self.lanes and vclass in c.classes]
            leads = [c for c in (*options, *beside) if self.lanes[c.to].edge == following]
            return [c for c in leads if not closed(c.to)][:1] or leads[:1]
        options = [c for c in options if c.movement != "u-turn"]
        return [c for c in options if not closed(c.to)] or options

    def strips(self, x: float, y: float, radius: float) -> list[LaneStrip]:
        """Return all paved lanes near a place, for pictures, the highest last.

        Args:
            x: The x of the place [m].
            y: The y of the place [m].
            radius: The radius of the picture [m].

        Returns:
            The lanes in drawing order.
        """
        near = [
            lane for lane in self.lanes.values()
            if lane.paved
            and np.min(np.hypot(lane.shape[:, 0] - x, lane.shape[:, 1] - y)) < radius + lane.length
        ]  # fmt: skip
        return [LaneStrip(self.line(lane), lane.width, lane.internal) for lane in sorted(near, key=self.top)]

    def top(self, lane: NetworkLane) -> float:
        """Return the greatest height of a lane [m], which gives the drawing order."""
        line = self.line(lane)
        return float(line[:, 2].max()) if line.shape[1] > 2 else 0.0

    def leads_over(self, way: Floats, line: Floats) -> bool:
        """Return whether a lane passes above or below a path where the two are nearest.

        Args:
            way: The path, ``(n, 2)`` or ``(n, 3)`` [m].
            line: The lane's centreline, as :meth:`line` returns it.

        Returns:
            Whether they are on different layers there; False without heights.
        """
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
        """Return the drivable ground near a place.

        The ground is the area that the network carries or, without one, the paved lanes and the junctions. It is the
        same for all classes: a car that cuts into a bus lane is on the road.

        Args:
            x: The x of the place [m].
            y: The y of the place [m].
            radius: The approximate radius of the ground [m].
            way: A line ``(n, 3)`` [m]; lanes and junctions that pass over or under it are left out.

        Returns:
            The ground.
        """
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
    """Return a search tree over the lanes, and the lanes in its order."""
    from shapely import LineString, STRtree

    lines = [lane for lane in lanes if len(lane.shape) > 1]
    return STRtree([LineString(lane.shape) for lane in lines]), lines


def _cut(points: Floats, position: float, length: float) -> Floats:
    """Return the polyline from ``position`` [m] on, for ``length`` [m]."""
    step = np.hypot(*np.diff(points[:, :2], axis=0).T)
    station = np.concatenate([[0.0], np.cumsum(step)])
    position = min(max(position, 0.0), station[-1] - 0.1)
    ends = np.array([position, min(position + length, station[-1])])
    start, end = np.column_stack([np.interp(ends, station, values) for values in points.T])
    inside = (station > position + 1e-6) & (station < ends[1] - 1e-6)
    return np.vstack([start, points[inside], end])


def read_network(path: FilePath) -> RoadMap:
    """Read a net.xml or net.xml.gz.

    Raises:
        UsageError: sumolib cannot read the file, or the heights or the drivable area in it are damaged.
    """
    from sumolib.net import readNet

    try:
        net = readNet(str(path), withInternal=True)
    except Exception as error:  # sumolib passes on any exception of its XML and gzip readers
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
    """Return the height data of a sumolib lane, ranked so that a faster, wider road bridges another one."""
    edge = lane.getEdge()
    shape = np.asarray(lane.getShape3D(), float)
    start, end = edge.getFromNode().getID(), edge.getToNode().getID()
    if edge.getFunction():  # within a junction, whose name is part of the edge's name
        start = end = edge.getID()[1:].rpartition("_")[0]
    size = edge.getPriority(), edge.getSpeed(), edge.getLaneNumber()
    z = np.array(lane.getParam(HEIGHTS).split(), float) if lane.getParam(HEIGHTS) else shape[:, 2]
    if len(z) != len(shape):
        raise ValueError(f"lane {lane.getID()} has {len(shape)} points and {len(z)} heights")
    rank = (not edge.getFunction(), *size, *sorted((start, end)), edge.getID())
    return ElevatedLane(lane.getID(), edge.getID(), shape[:, :2], z, start, end, rank)


def _rim(node: Any, heights: Heights) -> Floats:
    """Return the outline of a junction with heights ``(n, 3)``; each point takes the height of the nearest lane end."""
    shape = np.asarray(node.getShape(), float)[:, :2]
    ways = ((node.getIncoming(), -1), (node.getOutgoing(), 0))
    lanes = ((lane.getID(), end) for edges, end in ways for edge in edges for lane in edge.getLanes())
    ends = np.array([heights.lines[name][end] for name, end in lanes if name in heights.lines]).reshape(-1, 3)
    if not len(ends):
        return shape
    nearest = np.hypot(*(shape[:, None, :] - ends[None, :, :2]).transpose(2, 0, 1)).argmin(axis=1)
    return np.column_stack([shape, ends[nearest, 2]])


def is_left_hand(path: FilePath) -> bool:
    """Return whether a network has left-hand traffic, which sumolib does not tell."""
    import gzip
    from xml.etree import ElementTree

    with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
        _, root = next(ElementTree.iterparse(file, events=("start",)))
    return str(root.get("lefthand")) in ("true", "1", "yes", "on")


def _ground(path: FilePath, net: Any) -> Any:
    """Return the drivable area that a network carries, or None."""
    try:
        return area_of(node.getParam(DRIVABLE_KEY) for node in net.getNodes() if node.getParam(DRIVABLE_KEY))
    except ValueError as error:
        raise UsageError(f"The drivable area in {path} is damaged ({error}); convert the record again.") from error


def _classes(lane: Any) -> frozenset[str]:
    """Return the vehicle classes that may use a sumolib lane; on crossings and the like, only people on foot."""
    classes = allowed(lane.getPermissions())
    return _one(classes if lane.getEdge().getFunction() in ("", "internal") else classes & ON_FOOT)


@cache
def _one(classes: frozenset[str]) -> frozenset[str]:
    """Return one object for equal sets; a large network has thousands of lanes, and few different sets."""
    return classes


def _connections(net: Any, lane: Any) -> tuple[Connection, ...]:
    """Return the connections from a lane that some vehicle class may use."""
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
    """Return a connection's junction and index, and the indices of the connections that go first.

    The name of the internal lane gives the index: it is the index of its edge's first lane plus the lane's place in the
    edge.
    """
    parts = via[0].rsplit("_", 2) if via else []
    if len(parts) != 3 or not (parts[1].isdigit() and parts[2].isdigit()):
        return ("", -1), frozenset()
    index, node = int(parts[1]) + int(parts[2]), lane.getEdge().getToNode()
    response = node._prohibits.get(index, "")  # sumolib has no fast way to ask for it
    return (node.getID(), index), frozenset(k for k, bit in enumerate(reversed(response)) if bit == "1")
