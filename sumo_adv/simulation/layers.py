"""How high the lanes of a network are, so that a vehicle on a bridge and one below it are apart.

Every lane has a height at every place: the z of its shape. Where two lanes cross in plan within 3 m of height and the
network does not join them there, one is a bridge whose height the network leaves out, and it is inferred. Heights are
compared by ``geometry.same_layer`` alone.

A network that was converted from a record is a cut-out, in which lanes of one junction may not be joined: there nothing
is inferred. Where its record has roads above one another, its lanes carry their heights as SUMO's generic parameter
``heights``, a number [m] for each point of the shape, so that SUMO's own lengths stay those of the plan.

Lanes are joined where a way of at most ``OVERPASS_DISTANCE_M`` along the network leads from one to the other: at a
junction, at its pedestrian crossings, where a road was split. A bridge is raised to ``BRIDGE_CLEARANCE_M`` above the
other road. Its ramps follow the network, so that what branches off a bridge comes down with it. They are
``RAMP_LENGTH_M`` long, or shorter where they come to the road below."""

from __future__ import annotations

import heapq
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.geometry import LAYER_HEIGHT_M, along, same_layer, stations

HEIGHTS_KEY = "heights"
BRIDGE_CLEARANCE_M = 6.0  # of an inferred bridge: a lorry is 4 m high, and a deck is thick
OVERPASS_DISTANCE_M = 40.0  # along the network: no road climbs over another within less
RAMP_LENGTH_M = 250.0  # along the network; the half at the bridge is level, which is further than a driver sees
HEIGHT_SAMPLE_STEP_M = 5.0  # between the heights of a raised lane
MAX_RAISING_ROUNDS = 20  # of raising bridges over bridges
OFF_LANE_HEIGHT_DISTANCE_M = 10.0  # how far beside a lane a vehicle off all lanes is still taken to be at its height
MAX_VEHICLE_STEP_M = 60.0  # of a vehicle: one that moves further in a step was put there


@dataclass(frozen=True, slots=True)
class ElevatedLane:
    """A lane as this module needs it.

    edge: its edge; shape: ``(n, 2)`` [m]; z: ``(n,)`` [m]; start, end: its junctions, the same for a lane within one;
    rank: of two lanes that cross, the one of the higher rank is the bridge.
    """

    id: str
    edge: str
    shape: Floats
    z: Floats
    start: str
    end: str
    rank: tuple[Any, ...]

    @property
    def internal(self) -> bool:
        """Whether it lies within a junction."""
        return self.edge.startswith(":")

    @property
    def length(self) -> float:
        """Of its shape [m]."""
        return float(stations(*self.shape.T)[-1])


class Network:
    """The way along a network from one place to another, in either direction of its lanes."""

    def __init__(self, strips: Iterable[ElevatedLane]) -> None:
        self.strips = {strip.id: strip for strip in strips if len(strip.shape) > 1}
        self._length = {name: strip.length for name, strip in self.strips.items()}
        self._onward: dict[str, list[tuple[str, float]]] = defaultdict(list)
        for name, strip in self.strips.items():
            if not strip.internal:
                self._onward[strip.start].append((strip.end, self._length[name]))
                self._onward[strip.end].append((strip.start, self._length[name]))

    def from_place(self, lane: str, station: float, farthest: float) -> dict[str, float]:
        """Metres from a place on a lane to the junctions within ``farthest`` (Dijkstra)."""
        strip, found = self.strips[lane], dict[str, float]()
        ends = [(0.0, strip.start)]
        if not strip.internal:
            ends = sorted([(station, strip.start), (self._length[lane] - station, strip.end)])
        while ends:
            so_far, junction = heapq.heappop(ends)
            if so_far > farthest or junction in found:
                continue
            found[junction] = so_far
            for onward, length in self._onward[junction]:
                heapq.heappush(ends, (so_far + length, onward))
        return found

    def to_place(self, distance: Mapping[str, float], lane: str, station: Any) -> Any:
        """Metres to places on a lane, given those to junctions; inf where none is known."""
        strip = self.strips[lane]
        to_start, to_end = (distance.get(junction, math.inf) for junction in (strip.start, strip.end))
        if strip.internal:
            return to_start + 0.0 * station
        return np.minimum(to_start + station, to_end + self._length[lane] - station)


@dataclass(frozen=True, slots=True)
class Hump:
    """A bridge: it raises the roads around a place by ``height`` [m].

    edge, at: the bridge's edge and the station [m] of the crossing; reach: metres along the network to where it raises
    nothing; distance: those to the junctions within.
    """

    edge: str
    at: float
    height: float
    reach: float
    distance: Mapping[str, float]

    def over(self, network: Network, lane: str, station: Floats) -> Floats:
        """How high it raises a lane at stations [m]."""
        away = network.to_place(self.distance, lane, station)
        if network.strips[lane].edge == self.edge:
            away = np.minimum(away, np.abs(station - self.at))
        return np.asarray(self.height * np.clip(2.0 * (1.0 - away / self.reach), 0.0, 1.0))


@dataclass(frozen=True)
class Heights:
    """The heights of a network's lanes. lines: by lane id the centreline ``(n, 3)`` [m]: x, y, z. inferred: whether
    some are not the network's own."""

    network: Network
    lines: Mapping[str, Floats]
    inferred: bool = False

    def at(self, lane: str, x: Any, y: Any) -> Any:
        """The height [m] of a lane where it is nearest to (x, y): floats, or any shape."""
        line = self.lines[lane]
        return np.interp(along(line[:, :2], x, y), stations(*line[:, :2].T), line[:, 2])

    def follow(self, lane: str, x: float, y: float, before: tuple[float, float, float] | None) -> float:
        """The height [m] of a vehicle at (x, y) that was at ``before`` a step ago.

        It is that of SUMO's lane. SUMO may take a vehicle that is moved, or is off the road, to be on a lane above or
        below it: then it is that of the lane near that continues its motion, or it stays.
        """
        if before is not None and math.hypot(x - before[0], y - before[1]) > MAX_VEHICLE_STEP_M:
            before = None
        own = float(self.at(lane, x, y)) if lane in self.lines else None
        if own is not None and (before is None or same_layer(own, before[2])):
            return own
        near = [float(self.at(name, x, y)) for name in self.beside(x, y)]
        if before is None:
            return near[0] if near else 0.0
        best = min(near, key=lambda z: abs(z - before[2]), default=before[2])
        return best if same_layer(best, before[2]) else before[2]

    def along(self, points: Floats, z: float) -> Floats:
        """A way through ``points`` ``(n, 2)`` [m] that begins at a height, with heights ``(n, 3)``."""
        heights, before = list[float](), None
        for x, y in points.tolist():
            heights.append(self.follow("", x, y, before or (x, y, z)))
            before = (x, y, heights[-1])
        return np.column_stack([points, np.array(heights)])

    def beside(self, x: float, y: float) -> list[str]:
        """Lanes within ``OFF_LANE_HEIGHT_DISTANCE_M`` of a point, nearest first."""
        from shapely import Point, distance

        tree, names = self._tree
        point = Point(x, y)
        near = tree.query(point, predicate="dwithin", distance=OFF_LANE_HEIGHT_DISTANCE_M)
        return [names[i] for i in near[np.argsort(distance(tree.geometries[near], point), kind="stable")]]

    def way(self, lane: str, x: float, y: float, other: str, other_x: float, other_y: float, farthest: float) -> float:
        """Metres along the network from a place on a lane to one on another, inf if they are more than ``farthest``."""
        if lane not in self.lines or other not in self.lines:
            return math.inf
        shapes = (self.network.strips[name].shape for name in (lane, other))
        here, there = (float(along(s, *p)) for s, p in zip(shapes, ((x, y), (other_x, other_y)), strict=True))
        if self.network.strips[lane].edge == self.network.strips[other].edge:
            return abs(there - here)
        return float(self.network.to_place(self.network.from_place(lane, here, farthest), other, there))

    @cached_property
    def _tree(self) -> tuple[Any, list[str]]:
        from shapely import LineString, STRtree

        return STRtree([LineString(line[:, :2]) for line in self.lines.values()]), list(self.lines)


def covers(line: Floats, width: float, x: Floats | float, y: Floats | float, z: Floats | float) -> Bools:
    """Whether a lane passes over points of any one shape at heights ``z`` [m]; ``line``: ``(n, 2)`` or ``(n, 3)`` [m].

    A lane without heights covers nothing."""
    if line.shape[1] < 3 or not (line[:, 2].max() - np.min(z) > LAYER_HEIGHT_M):
        return np.zeros(np.shape(x), bool)
    station, own = along(line[:, :2], x, y), stations(*line[:, :2].T)
    near_x, near_y, height = (np.interp(station, own, values) for values in line.T)
    return np.asarray((np.hypot(near_x - x, near_y - y) < width / 2) & (height - z > LAYER_HEIGHT_M))


def lane_heights(strips: Iterable[ElevatedLane], *, infer: bool = True) -> Heights | None:
    """The heights of a network's lanes; None where all is flat and no lane crosses another without a junction. infer:
    such a lane is a bridge."""
    network = Network(strips)
    humps = _bridges(network) if infer else []
    levels = {float(z) for strip in network.strips.values() for z in (strip.z.min(), strip.z.max())}
    if not humps and len(levels) < 2:
        return None
    return Heights(network, {n: _line(network, strip, humps) for n, strip in network.strips.items()}, bool(humps))


def pass_over(lines: Sequence[Floats]) -> bool:
    """Whether some of the lines ``(n, 3)`` [m] cross in plan on different layers."""
    from shapely import STRtree, linestrings

    plans = [linestrings(line[:, :2]) for line in lines]
    for i, k in STRtree(plans).query(plans, predicate="crosses").T.tolist():
        point = plans[i].intersection(plans[k]).representative_point()
        z = (
            np.interp(along(line[:, :2], point.x, point.y), stations(*line[:, :2].T), line[:, 2])
            for line in (lines[i], lines[k])
        )
        if i < k and not same_layer(*z):
            return True
    return False


def _line(network: Network, strip: ElevatedLane, humps: Sequence[Hump]) -> Floats:
    """The centreline with heights ``(n, 3)``; it gets more points only where a bridge raises it."""
    own = stations(*strip.shape.T)
    station = np.union1d(own, np.arange(0.0, float(own[-1]), HEIGHT_SAMPLE_STEP_M))
    raised = np.max([hump.over(network, strip.id, station) for hump in humps], axis=0) if humps else 0.0 * station
    if not raised.any():
        return np.column_stack([strip.shape, strip.z])
    x, y, z = (np.interp(station, own, v) for v in (*strip.shape.T, strip.z))
    return np.column_stack([x, y, z + raised])


def _bridges(network: Network) -> list[Hump]:
    """The bridges whose height the network leaves out: raised until no two roads that cross are at one height."""
    humps: list[Hump] = []

    def height(lane: str, station: float) -> tuple[float, float]:
        """Of a lane: its own, and what the bridges add."""
        strip, place = network.strips[lane], np.array([station])
        own = float(np.interp(station, stations(*strip.shape.T), strip.z))
        return own, max((float(hump.over(network, lane, place)[0]) for hump in humps), default=0.0)

    crossings = list(_crossings(network))
    for _ in range(MAX_RAISING_ROUNDS if crossings else 0):
        before = len(humps)
        for pair in crossings:
            (under, below), (over, above) = sorted(pair, key=lambda place: network.strips[place[0]].rank)
            low, (own, raised) = sum(height(under, below)), height(over, above)
            if same_layer(low, own + raised):
                distance = network.from_place(over, above, RAMP_LENGTH_M)
                reach = min(RAMP_LENGTH_M, float(network.to_place(distance, under, below)))
                edge = network.strips[over].edge
                humps.append(Hump(edge, above, low + BRIDGE_CLEARANCE_M - own, reach, distance))
        if len(humps) == before:
            break
    return humps


def _crossings(network: Network) -> Iterator[tuple[tuple[str, float], tuple[str, float]]]:
    """Places at which two lanes of one height cross in plan though the network does not join them there: both lanes,
    and the stations [m] on them."""
    from shapely import LineString, STRtree

    strips = list(network.strips.values())
    lines = [LineString(strip.shape) for strip in strips]
    pairs = STRtree(lines).query(lines, predicate="crosses").T.tolist()
    for i, k in sorted((i, k) for i, k in pairs if i < k):
        a, b = strips[i], strips[k]
        if a.edge == b.edge or (a.internal and b.internal and a.start == b.start):
            continue
        points = lines[i].intersection(lines[k])
        for point in getattr(points, "geoms", [points]):
            if point.geom_type != "Point":
                continue
            s, t = (float(along(strip.shape, point.x, point.y)) for strip in (a, b))
            z = (np.interp(u, stations(*strip.shape.T), strip.z) for u, strip in ((s, a), (t, b)))
            joined = network.to_place(network.from_place(a.id, s, OVERPASS_DISTANCE_M), b.id, t) <= OVERPASS_DISTANCE_M
            if not joined and same_layer(*z):
                yield (a.id, s), (b.id, t)
