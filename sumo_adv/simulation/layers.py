"""The heights of a network's lanes, which keep a vehicle on a bridge apart from one below it.

Every lane has a height at every place: the z of its shape. If two lanes cross in plan within 3 m of height and the
network does not join them there, one of them is a bridge whose height the network omits, and its height is inferred.
Only ``geometry.same_layer`` compares heights.

A network that was converted from a record is a cut-out, in which lanes of one junction may not be joined. Nothing is
inferred there. If its record has roads above one another, its lanes carry their heights as SUMO's generic parameter
``heights``: a number [m] for each point of the shape. SUMO's own lengths thus remain those of the plan.

Lanes count as joined if a way of at most ``OVERPASS_DISTANCE_M`` along the network leads from one to the other: at a
junction, at its pedestrian crossings, or where a road was split. A bridge is raised to ``BRIDGE_CLEARANCE_M`` above the
other road. Its ramps follow the network, so that roads that branch off a bridge descend with it. Ramps are
``RAMP_LENGTH_M`` long, or shorter if they reach the road below earlier.
"""

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
BRIDGE_CLEARANCE_M = 6.0  # of an inferred bridge; a lorry is 4 m high, and a bridge deck is thick
OVERPASS_DISTANCE_M = 40.0  # along the network; no road climbs over another within less
RAMP_LENGTH_M = 250.0  # along the network; the half next to the bridge is level, which is farther than a driver sees
HEIGHT_SAMPLE_STEP_M = 5.0  # between the points of a raised lane
MAX_RAISING_ROUNDS = 20  # maximum number of rounds in which bridges are raised over bridges
OFF_LANE_HEIGHT_DISTANCE_M = 10.0  # a vehicle off all lanes has the height of a lane within this distance
MAX_VEHICLE_STEP_M = 60.0  # a vehicle that moves farther in one step was put there


@dataclass(frozen=True, slots=True)
class ElevatedLane:
    """A lane as this module needs it.

    Attributes:
        id: The id of the lane.
        edge: The id of its edge.
        shape: Its points, ``(n, 2)`` [m].
        z: The heights of the points, ``(n,)`` [m].
        start: The junction at its start; the same as ``end`` for a lane within a junction.
        end: The junction at its end.
        rank: Of two lanes that cross, the one with the higher rank is the bridge.
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
        """Whether the lane lies within a junction."""
        return self.edge.startswith(":")

    @property
    def length(self) -> float:
        """The length of its shape [m]."""
        return float(stations(*self.shape.T)[-1])


class Network:
    """Measures distances along a network, in either direction of its lanes.

    Attributes:
        strips: The lanes by id.
    """

    def __init__(self, strips: Iterable[ElevatedLane]) -> None:
        """Index the lanes.

        Args:
            strips: The lanes; those of fewer than two points are left out.
        """
        self.strips = {strip.id: strip for strip in strips if len(strip.shape) > 1}
        self._length = {name: strip.length for name, strip in self.strips.items()}
        self._onward: dict[str, list[tuple[str, float]]] = defaultdict(list)
        for name, strip in self.strips.items():
            if not strip.internal:
                self._onward[strip.start].append((strip.end, self._length[name]))
                self._onward[strip.end].append((strip.start, self._length[name]))

    def from_place(self, lane: str, station: float, farthest: float) -> dict[str, float]:
        """Return the distances from a place to junctions along the network (Dijkstra).

        Args:
            lane: The id of the lane.
            station: The place on it [m].
            farthest: The maximum distance [m].

        Returns:
            The distance [m] to each junction within ``farthest``, by its id.
        """
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
        """Return the distances to places on a lane, given the distances to junctions.

        Args:
            distance: The distances to junctions [m] (``from_place``).
            lane: The id of the lane.
            station: The places on it [m], of any shape.

        Returns:
            The distances [m], of the same shape; inf if none is known.
        """
        strip = self.strips[lane]
        to_start, to_end = (distance.get(junction, math.inf) for junction in (strip.start, strip.end))
        if strip.internal:
            return to_start + 0.0 * station
        return np.minimum(to_start + station, to_end + self._length[lane] - station)


@dataclass(frozen=True, slots=True)
class Hump:
    """An inferred bridge, which raises the roads around a place.

    Attributes:
        edge: The edge of the bridge.
        at: The station of the crossing [m].
        height: By how much it raises the crossing [m].
        reach: The distance along the network at which it raises nothing [m].
        distance: The distances to the junctions within reach [m].
    """

    edge: str
    at: float
    height: float
    reach: float
    distance: Mapping[str, float]

    def over(self, network: Network, lane: str, station: Floats) -> Floats:
        """Return by how much the bridge raises a lane at stations [m].

        Args:
            network: The network.
            lane: The id of the lane.
            station: The stations [m].

        Returns:
            The heights [m], of the same shape.
        """
        away = network.to_place(self.distance, lane, station)
        if network.strips[lane].edge == self.edge:
            away = np.minimum(away, np.abs(station - self.at))
        return np.asarray(self.height * np.clip(2.0 * (1.0 - away / self.reach), 0.0, 1.0))


@dataclass(frozen=True)
class Heights:
    """The heights of a network's lanes.

    Attributes:
        network: The network.
        lines: The centreline of each lane by id, ``(n, 3)`` [m].
        inferred: Whether some heights are not the network's own.
    """

    network: Network
    lines: Mapping[str, Floats]
    inferred: bool = False

    def at(self, lane: str, x: Any, y: Any) -> Any:
        """Return the height of a lane where it is nearest to places.

        Args:
            lane: The id of the lane.
            x: x of the places [m], a float or an array.
            y: y of the places [m], of the same shape.

        Returns:
            The heights [m], of the same shape.
        """
        line = self.lines[lane]
        return np.interp(along(line[:, :2], x, y), stations(*line[:, :2].T), line[:, 2])

    def follow(self, lane: str, x: float, y: float, before: tuple[float, float, float] | None) -> float:
        """Return the height of a vehicle that moves.

        It is the height of SUMO's lane. SUMO may assign a lane above or below to a vehicle that is moved or is off the
        road. In that case, the height is that of a near lane that continues the vehicle's motion or, without such a
        lane, the previous height.

        Args:
            lane: SUMO's lane of the vehicle; empty off all lanes.
            x: The vehicle's x [m].
            y: The vehicle's y [m].
            before: Its x, y and height one step ago [m]; None if unknown.

        Returns:
            The height [m].
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
        """Return a path with heights.

        Args:
            points: The path, ``(n, 2)`` [m].
            z: The height at its beginning [m].

        Returns:
            The path, ``(n, 3)`` [m].
        """
        heights, before = list[float](), None
        for x, y in points.tolist():
            heights.append(self.follow("", x, y, before or (x, y, z)))
            before = (x, y, heights[-1])
        return np.column_stack([points, np.array(heights)])

    def beside(self, x: float, y: float) -> list[str]:
        """Return the ids of lanes within ``OFF_LANE_HEIGHT_DISTANCE_M`` of a point, nearest first."""
        from shapely import Point, distance

        tree, names = self._tree
        point = Point(x, y)
        near = tree.query(point, predicate="dwithin", distance=OFF_LANE_HEIGHT_DISTANCE_M)
        return [names[i] for i in near[np.argsort(distance(tree.geometries[near], point), kind="stable")]]

    def way(self, lane: str, x: float, y: float, other: str, other_x: float, other_y: float, farthest: float) -> float:
        """Return the distance along the network between places on two lanes.

        Args:
            lane: The id of the first lane.
            x: The x of the place on it [m].
            y: The y of the place on it [m].
            other: The id of the second lane.
            other_x: The x of the place on it [m].
            other_y: The y of the place on it [m].
            farthest: The maximum distance to a junction on the way [m].

        Returns:
            The distance [m]; inf if no junction within ``farthest`` leads there.
        """
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
    """Return whether a lane passes over points. A lane without heights covers nothing.

    Args:
        line: The lane's centreline, ``(n, 2)`` or ``(n, 3)`` [m].
        width: Its width [m].
        x: x of the points [m], of any shape.
        y: y of the points [m], of the same shape.
        z: Heights of the points [m], of the same shape.

    Returns:
        The results, of the same shape.
    """
    if line.shape[1] < 3 or not (line[:, 2].max() - np.min(z) > LAYER_HEIGHT_M):
        return np.zeros(np.shape(x), bool)
    station, own = along(line[:, :2], x, y), stations(*line[:, :2].T)
    near_x, near_y, height = (np.interp(station, own, values) for values in line.T)
    return np.asarray((np.hypot(near_x - x, near_y - y) < width / 2) & (height - z > LAYER_HEIGHT_M))


def lane_heights(strips: Iterable[ElevatedLane], *, infer: bool = True) -> Heights | None:
    """Return the heights of a network's lanes.

    Args:
        strips: The lanes.
        infer: Whether a lane that crosses another one without a junction is taken for a bridge.

    Returns:
        The heights; None if all lanes are flat and there is no inferred bridge.
    """
    network = Network(strips)
    humps = _bridges(network) if infer else []
    levels = {float(z) for strip in network.strips.values() for z in (strip.z.min(), strip.z.max())}
    if not humps and len(levels) < 2:
        return None
    return Heights(network, {n: _line(network, strip, humps) for n, strip in network.strips.items()}, bool(humps))


def pass_over(lines: Sequence[Floats]) -> bool:
    """Return whether some of the lines ``(n, 3)`` [m] cross in plan on different layers."""
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
    """Return the centreline with heights ``(n, 3)``, with more points only if a bridge raises it."""
    own = stations(*strip.shape.T)
    station = np.union1d(own, np.arange(0.0, float(own[-1]), HEIGHT_SAMPLE_STEP_M))
    raised = np.max([hump.over(network, strip.id, station) for hump in humps], axis=0) if humps else 0.0 * station
    if not raised.any():
        return np.column_stack([strip.shape, strip.z])
    x, y, z = (np.interp(station, own, v) for v in (*strip.shape.T, strip.z))
    return np.column_stack([x, y, z + raised])


def _bridges(network: Network) -> list[Hump]:
    """Return the bridges whose height the network omits, raised until no two crossing roads are at one height."""
    humps: list[Hump] = []

    def height(lane: str, station: float) -> tuple[float, float]:
        """Return a lane's own height, and what the bridges add."""
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
    """Yield both lanes and stations [m] where two lanes at one height cross in plan without being joined there."""
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
