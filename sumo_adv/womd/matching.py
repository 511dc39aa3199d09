"""Which lanes a logged vehicle drove: the cheapest chain of lanes (Viterbi) through its positions.

The same search runs on the record's own lane graph and on the SUMO network, so that their breaks can be compared. A
break is where no lane near the vehicle can be reached from any lane it was near before. The SUMO network is read here
as this package measures it: unlike ``simulation.network`` with internal lanes in their order, and with bicycle lanes.
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

SUMO_LANE_WIDTH_M = 3.2  # SUMO's for lanes without one
MAX_MATCH_DISTANCE_M = 2.5  # from a lane's centre line at which a vehicle may still be on it
MAX_MATCH_ANGLE_RAD = 0.9  # between vehicle and lane at most
LATERAL_SIGMA_M = 0.8  # of a vehicle about its lane's centre line
HEADING_SIGMA_RAD = 0.35  # of its heading about the lane's
DETOUR_SIGMA_M = 3.0  # of the way along the lanes about the way driven
LANE_CHANGE_COST = 1.0  # of a lane change
MAX_DETOUR_M = 12.0  # that the way along the lanes may be longer than the way driven
MATCHED_STEP_M = 3.0  # between the positions that are matched
SEARCH_STEP_M = 20.0  # by which the search ahead grows
MAX_LANE_CHANGES = 2  # lane changes between two positions
Lane = Any  # a SUMO lane's name or a WOMD lane's number


@dataclass(frozen=True, slots=True)
class NetLane:
    """One lane. shape ``(n, 2)`` m; width, length m; cars, bicycles: which vehicles may use it."""

    edge: str
    shape: Floats
    width: float
    length: float
    internal: bool
    cars: bool
    bicycles: bool


@dataclass(frozen=True, slots=True)
class LaneLink:
    """One connection between lanes, the internal ones in between aside. direction: SUMO's letter; signal: whether a
    traffic light rules it."""

    start: str
    end: str
    via: str
    direction: str
    signal: bool


@dataclass(frozen=True, slots=True)
class SumoNet:
    """Lanes by id; edges to their lanes, rightmost first; following: lane to the lanes a vehicle is on next, internal
    ones included; links: connections between normal lanes."""

    lanes: Mapping[str, NetLane]
    edges: Mapping[str, tuple[str, ...]]
    following: Mapping[str, tuple[str, ...]]
    links: tuple[LaneLink, ...]

    def inner(self, link: LaneLink) -> tuple[str, ...]:
        """The internal lanes of a link, in order."""
        chain: list[str] = []
        lane = link.via
        while lane in self.lanes and lane not in chain and self.lanes[lane].internal:
            chain.append(lane)
            lane = next(iter(self.following.get(lane, ())), "")
        return tuple(chain)


def read_net(path: Path) -> SumoNet:
    """The network at ``path`` (written by ourselves: errors are not dressed up)."""
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
    """Lanes as polylines, what follows each, and what lies beside it: the other lane, and the other's station minus
    its own at the same height, m."""

    lengths: Mapping[Lane, float]
    following: Mapping[Lane, Sequence[Lane]]
    beside: Mapping[Lane, Sequence[tuple[Lane, float]]]
    segments: LineSegments = field(repr=False)
    # kept between searches
    ways: dict[tuple[Lane, int], dict[Lane, LaneRoute]] = field(repr=False, default_factory=dict)


@dataclass(frozen=True, slots=True)
class LaneRoute:
    """From station 0 of one lane to station 0 of another: m along the lanes, lane changes, lanes passed (the first
    left out)."""

    length: float
    changes: int
    passed: tuple[Lane, ...]


@dataclass(frozen=True, slots=True)
class MatchedStretch:
    """A part of a track without a break: the ``steps`` that were matched, the lane at each, and all lanes driven."""

    steps: tuple[int, ...]
    lanes: tuple[Lane, ...]
    driven: tuple[Lane, ...]


def record_graph(record: Record) -> LaneGraph:
    """The dataset's own graph, bike lanes aside: exits, and neighbours over any part."""
    kept = {i: lane for i, lane in record.lanes.items() if lane.kind != BIKE and len(lane.points) > 1}
    at = {i: line_stations(lane.points) for i, lane in kept.items()}
    return LaneGraph(
        {i: float(at[i][-1]) for i in kept}, {i: tuple(e for e in lane.exits if e in kept) for i, lane in kept.items()},
        {i: _neighbours(lane, at) for i, lane in kept.items()},
        LineSegments({i: lane.points for i, lane in kept.items()}),
    )  # fmt: skip


def _neighbours(lane: LaneFeature, at: Mapping[int, Floats]) -> tuple[tuple[int, float], ...]:
    neighbours = []
    for n in (*lane.left, *lane.right):
        if n.lane in at and 0 <= n.own_start < len(at[lane.id]) and 0 <= n.other_start < len(at[n.lane]):
            neighbours.append((n.lane, float(at[n.lane][n.other_start] - at[lane.id][n.own_start])))
    return tuple(neighbours)


def net_graph(net: SumoNet) -> LaneGraph:
    """SUMO's graph for cars: connections, the lanes of one edge, and of a junction the internal lanes that share the
    edge they come from (same height at their beginnings) or lead to (at their ends): such a change keeps the route."""
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
    """The stretches of a track on the graph's lanes; more than one: it breaks in between; none: it is on no lane.

    Positions with no lane near are passed over.
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
    """Steps about ``MATCHED_STEP_M`` apart, the first and the last one included, and the way driven until each, m."""
    valid = np.flatnonzero(track.valid)
    if not len(valid):
        return valid, np.empty(0)
    way = line_stations(np.column_stack([track.x, track.y])[valid])
    _, first = np.unique((way / MATCHED_STEP_M).astype(int), return_index=True)
    chosen = np.unique([*first, len(valid) - 1])
    return valid[chosen], way[chosen]


class _Row:
    """The candidates at one position: lanes, stations on them, costs so far, and where each came from."""

    def __init__(self, step: int, way: float, lanes: list[Lane], at: Floats, cost: Floats) -> None:
        self.step, self.way, self.lanes, self.at, self.cost = step, way, lanes, at, cost
        self.origin: list[tuple[int, LaneRoute] | None] = [None] * len(lanes)

    def link(self, graph: LaneGraph, before: _Row) -> bool:
        """Join to the row ``before``; False (and unchanged) if nothing here can be reached from there."""
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
    """Ways to all lanes that begin less than ``reach`` m (rounded up) after the end of ``lane``: of fewest changes,
    then shortest."""
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
            count += 1  # settles draws
            heapq.heappush(queue, (more, start, count, next_lane, (*passed, next_lane)))
    graph.ways[lane, rounds] = ways
    return ways


def _traced(rows: list[_Row]) -> MatchedStretch:
    """The cheapest chain through the rows."""
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
