"""Find which lanes a logged vehicle drove: the cheapest chain of lanes (Viterbi) through its positions.

The same search runs on the record's own lane graph and on the SUMO network, so that their breaks can be compared. A
break is where no lane near the vehicle can be reached from any lane that it was near before. This module reads the SUMO
network as this package needs it: unlike ``simulation.network``, with internal lanes in their order and with bicycle
lanes.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import permutations
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from sumo_adv.datatypes import Floats, Ints
from sumo_adv.womd.lines import LineSegments, line_stations
from sumo_adv.womd.record import BIKE, LaneFeature, ObjectTrack, Record

SUMO_LANE_WIDTH_M = 3.2  # SUMO's default width
MAX_MATCH_DISTANCE_M = 2.5  # maximum distance of a vehicle on a lane from its centre line
MAX_MATCH_ANGLE_RAD = 0.9  # maximum angle between a vehicle and its lane
LATERAL_SIGMA_M = 0.8  # standard deviation of a vehicle's distance from its lane's centre line
HEADING_SIGMA_RAD = 0.35  # standard deviation of its heading from the lane's
DETOUR_SIGMA_M = 3.0  # standard deviation of the distance along the lanes from the distance driven
LANE_CHANGE_COST = 1.0  # cost of one lane change
MAX_DETOUR_M = 12.0  # by which the distance along the lanes may exceed the distance driven
MATCHED_STEP_M = 3.0  # approximate distance between the positions that are matched
SEARCH_STEP_M = 20.0  # the reach of a search is rounded up to a multiple of this
MAX_LANE_CHANGES = 2  # lane changes between two positions
Lane = Any  # a SUMO lane's name or a WOMD lane's number


@dataclass(frozen=True, slots=True)
class NetLane:
    """One lane of a SUMO network.

    Attributes:
        edge: The id of its edge.
        shape: Its shape, ``(n, 2)`` [m].
        width: Its width [m].
        length: Its length in SUMO [m].
        internal: Whether it lies within a junction.
        cars: Whether cars may use it.
        bicycles: Whether bicycles may use it.
    """

    edge: str
    shape: Floats
    width: float
    length: float
    internal: bool
    cars: bool
    bicycles: bool


@dataclass(frozen=True, slots=True)
class LaneLink:
    """One connection between two lanes outside junctions.

    Attributes:
        start: The id of the lane before.
        end: The id of the lane after.
        via: The id of the first internal lane; empty without one.
        direction: SUMO's letter of the direction.
        signal: Whether a traffic light rules it.
    """

    start: str
    end: str
    via: str
    direction: str
    signal: bool


@dataclass(frozen=True, slots=True)
class SumoNet:
    """A SUMO network.

    Attributes:
        lanes: The lanes by id.
        edges: The lanes of each edge by its id, rightmost first.
        following: For each lane, the lanes that a vehicle is on next, including internal ones.
        links: The connections between lanes outside junctions.
    """

    lanes: Mapping[str, NetLane]
    edges: Mapping[str, tuple[str, ...]]
    following: Mapping[str, tuple[str, ...]]
    links: tuple[LaneLink, ...]

    def inner(self, link: LaneLink) -> tuple[str, ...]:
        """Return the internal lanes of a link, in order."""
        chain: list[str] = []
        lane = link.via
        while lane in self.lanes and lane not in chain and self.lanes[lane].internal:
            chain.append(lane)
            lane = next(iter(self.following.get(lane, ())), "")
        return tuple(chain)


def read_net(path: Path) -> SumoNet:
    """Read a network that this package has written. Exceptions are not converted."""
    root = ElementTree.parse(path).getroot()
    lanes: dict[str, NetLane] = {}
    edges: dict[str, tuple[str, ...]] = {}
    for edge in root.iter("edge"):
        function = edge.get("function", "normal")
        if function not in ("normal", "internal"):
            continue
        name = edge.attrib["id"]
        own = {lane.attrib["id"]: _lane(lane.attrib, name, function == "internal") for lane in edge.iter("lane")}
        lanes |= own
        edges[name] = tuple(own)
    following: dict[str, dict[str, None]] = {}
    links = []
    for c in root.iter("connection"):
        start, end = f"{c.get('from')}_{c.get('fromLane')}", f"{c.get('to')}_{c.get('toLane')}"
        if start not in lanes or end not in lanes:
            continue
        via = c.get("via", "")
        following.setdefault(start, {})[via or end] = None
        if not lanes[start].internal:
            links.append(LaneLink(start, end, via, c.get("dir", "s"), "tl" in c.attrib))
    return SumoNet(lanes, edges, {lane: tuple(onward) for lane, onward in following.items()}, tuple(links))


def _lane(attributes: Mapping[str, str], edge: str, internal: bool) -> NetLane:
    shape = np.array([[float(v) for v in pair.split(",")[:2]] for pair in attributes["shape"].split()])
    return NetLane(
        edge, shape, float(attributes.get("width", SUMO_LANE_WIDTH_M)), float(attributes["length"]), internal,
        _allows(attributes, "passenger"), _allows(attributes, "bicycle"),
    )  # fmt: skip


def _allows(attributes: Mapping[str, str], kind: str) -> bool:
    named = {kind, "all"}
    if "allow" in attributes:
        return not named.isdisjoint(attributes["allow"].split())
    return named.isdisjoint(attributes.get("disallow", "").split())


@dataclass(frozen=True)
class LaneGraph:
    """Lanes as polylines with their relations.

    Attributes:
        lengths: The length of each lane [m].
        following: The lanes that follow each lane.
        beside: The lanes beside each lane, each with its station minus that of the lane at the same place along the
            road [m].
        segments: The segments of all lanes.
        ways: Results of earlier searches.
    """

    lengths: Mapping[Lane, float]
    following: Mapping[Lane, Sequence[Lane]]
    beside: Mapping[Lane, Sequence[tuple[Lane, float]]]
    segments: LineSegments = field(repr=False)
    # results of earlier searches
    ways: dict[tuple[Lane, int], dict[Lane, LaneRoute]] = field(repr=False, default_factory=dict)


@dataclass(frozen=True, slots=True)
class LaneRoute:
    """A way from station 0 of one lane to station 0 of another.

    Attributes:
        length: Its length along the lanes [m].
        changes: The number of lane changes.
        passed: The lanes on the way, without the first.
    """

    length: float
    changes: int
    passed: tuple[Lane, ...]


@dataclass(frozen=True, slots=True)
class MatchedStretch:
    """A part of a track without a break.

    Attributes:
        steps: The steps that were matched.
        lanes: The lane at each of these steps.
        driven: All lanes that were driven, in order.
    """

    steps: tuple[int, ...]
    lanes: tuple[Lane, ...]
    driven: tuple[Lane, ...]


def record_graph(record: Record) -> LaneGraph:
    """Return the record's own graph without bike lanes.

    It contains exits, and neighbours over any part of a lane.
    """
    kept = {i: lane for i, lane in record.lanes.items() if lane.kind != BIKE and len(lane.points) > 1}
    at = {i: line_stations(lane.points) for i, lane in kept.items()}
    return LaneGraph(
        {i: float(at[i][-1]) for i in kept}, {i: tuple(e for e in lane.exits if e in kept) for i, lane in kept.items()},
        {i: _neighbours(lane, at) for i, lane in kept.items()},
        LineSegments({i: lane.points for i, lane in kept.items()}),
    )  # fmt: skip


def _neighbours(lane: LaneFeature, at: Mapping[int, Floats]) -> tuple[tuple[int, float], ...]:
    """Return the neighbours of a lane, each with its station minus that of the lane at the same place [m]."""
    neighbours = []
    for n in (*lane.left, *lane.right):
        if n.lane in at and 0 <= n.own_start < len(at[lane.id]) and 0 <= n.other_start < len(at[n.lane]):
            neighbours.append((n.lane, float(at[n.lane][n.other_start] - at[lane.id][n.own_start])))
    return tuple(neighbours)


def net_graph(net: SumoNet) -> LaneGraph:
    """Return SUMO's graph for cars.

    It contains connections and the lanes of one edge. In a junction, it also joins the first internal lanes that come
    from one edge (aligned at their beginnings) and the last internal lanes that lead to one edge (aligned at their
    ends), because such a lane change keeps the route.
    """
    kept = {name: lane for name, lane in net.lanes.items() if lane.cars}
    lengths = {name: float(line_stations(lane.shape)[-1]) for name, lane in kept.items()}
    beside: dict[Lane, dict[Lane, float]] = {
        n: {o: 0.0 for o in net.edges[lane.edge] if o != n and o in kept} for n, lane in kept.items()
    }
    from_edge: dict[str, list[str]] = {}
    to_edge: dict[str, list[str]] = {}
    for link in net.links:
        chain = net.inner(link)
        if chain and all(lane in kept for lane in (link.start, *chain, link.end)):
            from_edge.setdefault(net.lanes[link.start].edge, []).append(chain[0])
            to_edge.setdefault(net.lanes[link.end].edge, []).append(chain[-1])
    for groups, at_end in ((from_edge, False), (to_edge, True)):
        for group in groups.values():
            for first, second in permutations(group, 2):
                beside[first].setdefault(second, lengths[second] - lengths[first] if at_end else 0.0)
    return LaneGraph(
        lengths, {name: tuple(o for o in net.following.get(name, ()) if o in kept) for name in kept},
        {name: tuple(others.items()) for name, others in beside.items()},
        LineSegments({name: lane.shape for name, lane in kept.items()}),
    )  # fmt: skip


def match(graph: LaneGraph, track: ObjectTrack) -> tuple[MatchedStretch, ...]:
    """Return the stretches of a track on the graph's lanes.

    Positions without a near lane are skipped.

    Args:
        graph: The lanes.
        track: The track.

    Returns:
        The stretches. With more than one, the track breaks between them. With none, the track is on no lane.
    """
    steps, way = _positions(track)
    if not len(steps):
        return ()
    xy = np.stack([track.x[steps], track.y[steps]], axis=1)
    hits = graph.segments.near(xy, MAX_MATCH_DISTANCE_M, track.heading[steps])
    hits = hits.where(hits.turned < MAX_MATCH_ANGLE_RAD).nearest_of_each_line()
    cost = (hits.distance / LATERAL_SIGMA_M) ** 2 + (hits.turned / HEADING_SIGMA_RAD) ** 2
    stretches: list[MatchedStretch] = []
    rows: list[_Row] = []
    for i in np.unique(hits.point):
        own = np.flatnonzero(hits.point == i)
        names = [graph.segments.names[k] for k in hits.line[own]]
        row = _Row(int(steps[i]), float(way[i]), names, hits.station[own], cost[own])
        if rows and not row.link(graph, rows[-1]):
            stretches.append(_traced(rows))
            rows = []
        rows.append(row)
    return (*stretches, _traced(rows)) if rows else ()


def _positions(track: ObjectTrack) -> tuple[Ints, Floats]:
    """Return steps about ``MATCHED_STEP_M`` apart, including the first and last, and the distance driven until each
    [m].
    """
    valid = np.flatnonzero(track.valid)
    if not len(valid):
        return valid, np.empty(0)
    way = line_stations(np.column_stack([track.x, track.y])[valid])
    _, first = np.unique((way / MATCHED_STEP_M).astype(int), return_index=True)
    chosen = np.unique([*first, len(valid) - 1])
    return valid[chosen], way[chosen]


class _Row:
    """The candidates at one position.

    Attributes:
        step: The time step.
        way: The distance driven until then [m].
        lanes: The candidate lanes.
        at: The station on each [m].
        cost: The cost of the cheapest chain to each.
        origin: For each, the candidate that it was reached from and the way; None in the first row of a stretch.
    """

    def __init__(self, step: int, way: float, lanes: list[Lane], at: Floats, cost: Floats) -> None:
        self.step, self.way, self.lanes, self.at, self.cost = step, way, lanes, at, cost
        self.origin: list[tuple[int, LaneRoute] | None] = [None] * len(lanes)

    def link(self, graph: LaneGraph, before: _Row) -> bool:
        """Link to the row ``before``; return False and change nothing if no candidate can be reached from there."""
        driven = self.way - before.way
        best = np.full(len(self.lanes), np.inf)
        origin: list[tuple[int, LaneRoute] | None] = [None] * len(self.lanes)
        for k in np.flatnonzero(np.isfinite(before.cost)):
            ways = _ways(graph, before.lanes[k], driven + MAX_DETOUR_M)
            for j in range(len(self.lanes)):
                way = ways.get(self.lanes[j])
                gone = math.inf if way is None else way.length + self.at[j] - before.at[k]
                if way is None or not -MAX_DETOUR_M / 2 < gone < driven + MAX_DETOUR_M:
                    continue
                total = before.cost[k] + ((gone - driven) / DETOUR_SIGMA_M) ** 2 + LANE_CHANGE_COST * way.changes
                if total < best[j]:
                    best[j], origin[j] = total, (int(k), way)
        if not np.isfinite(best).any():
            return False
        self.cost, self.origin = self.cost + best, origin
        return True


def _ways(graph: LaneGraph, lane: Lane, reach: float) -> dict[Lane, LaneRoute]:
    """Return ways to all lanes that begin less than ``reach`` [m] after the end of ``lane``.

    The reach is rounded up. Each way has the fewest lane changes, and is the shortest of those.
    """
    rounds = math.ceil(reach / SEARCH_STEP_M)
    cached = graph.ways.get((lane, rounds))
    if cached is not None:
        return cached
    ways: dict[Lane, LaneRoute] = {}
    farthest = graph.lengths[lane] + rounds * SEARCH_STEP_M
    queue: list[tuple[int, float, int, Lane, tuple[Lane, ...]]] = [(0, 0.0, 0, lane, ())]
    count = 0
    while queue:
        changes, length, _, here, passed = heapq.heappop(queue)
        if here in ways:
            continue
        ways[here] = LaneRoute(length, changes, passed)
        end = length + graph.lengths[here]
        onward = [(changes, end, next_lane) for next_lane in graph.following[here] if end < farthest]
        if changes < MAX_LANE_CHANGES:
            onward += [(changes + 1, length - shift, next_lane) for next_lane, shift in graph.beside[here]]
        for more, start, next_lane in onward:
            count += 1  # breaks ties
            heapq.heappush(queue, (more, start, count, next_lane, (*passed, next_lane)))
    graph.ways[lane, rounds] = ways
    return ways


def _traced(rows: list[_Row]) -> MatchedStretch:
    """Return the cheapest chain through the rows."""
    k = int(np.argmin(rows[-1].cost))
    lanes, parts = [rows[-1].lanes[k]], []
    for row, before in zip(rows[:0:-1], rows[-2::-1], strict=True):
        origin = row.origin[k]
        assert origin is not None
        k = origin[0]
        lanes.append(before.lanes[k])
        parts.append(origin[1].passed)
    lanes.reverse()
    driven = [lanes[0]] + [lane for part in reversed(parts) for lane in part]
    return MatchedStretch(tuple(row.step for row in rows), tuple(lanes), tuple(driven))
