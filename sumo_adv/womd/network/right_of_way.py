"""Decide which links of a junction are in each other's way, and which of them yields without signals.

SUMO sees a conflict inside a junction only if two lanes cross. Two lanes that pass each other nearer than vehicles can
are therefore bent until they cross, each by half of the missing distance.

Every link has a rank. Of two links in each other's way, the one with the lower rank yields. Ranks are a strict order,
so there is no ring of waiting vehicles. Links with stop signs come last. Then the road (axis) decides: less speed and
fewer lanes rank lower. Then the turn decides: straight before right before left. The first to arrive goes first if all
approaches have a stop sign, or if three have one and every road has one.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.geometry import LAYER_HEIGHT_M
from sumo_adv.womd.lines import SAME_POINT_DISTANCE_M, at, line_stations
from sumo_adv.womd.network.roads import JunctionLink, RoadEdge

if TYPE_CHECKING:
    from shapely import LineString

MAX_CONFLICT_DISTANCE_M = 0.8  # two links this near are in each other's way without crossing
BEND_LENGTH_M = 4.0  # a line is bent this far before and after the nearest place
UNBENT_END_M = 1.0  # a line is not bent within this distance of its ends
MAX_BEND_OFFSET_M = 0.45  # maximum offset of one line
CROSSING_OVERLAP_M = 0.05  # by which bent lines overlap
SAME_AXIS_RAD = math.radians(35.0)  # approaches whose directions (or opposites) differ by less are one road
SAME_LIMIT_M_S = 2.2  # (5 mph); limits that differ by less count as the same
MOVEMENT_PRIORITY = {"s": 3, "r": 2, "l": 1, "t": 0}
Rank = tuple[float, ...]


def find_foes(links: Sequence[JunctionLink]) -> set[tuple[int, int]]:
    """Return pairs of links of one junction that are in each other's way.

    They merge, cross or come too close. Links from the same lane are never in each other's way.

    Args:
        links: The links.

    Returns:
        Pairs (i, j) of indices, i < j.
    """
    from shapely import STRtree, linestrings

    if not links:
        return set()
    lines = [linestrings(link.shape) for link in links]
    pairs = STRtree(lines).query(lines, predicate="dwithin", distance=MAX_CONFLICT_DISTANCE_M).T
    foes = set()
    for i, j in pairs[pairs[:, 0] < pairs[:, 1]].tolist():
        a, b = links[i], links[j]
        if a.junction != b.junction or (a.source, a.from_lane) == (b.source, b.from_lane):
            continue
        if (a.target, a.to_lane) == (b.target, b.to_lane) or not _apart(a, b):
            foes.add((i, j))
    return foes


def _apart(a: JunctionLink, b: JunctionLink) -> bool:
    """Return whether one link passes over the other."""
    if abs(float(np.mean(a.heights)) - float(np.mean(b.heights))) < LAYER_HEIGHT_M / 2:
        return False
    distance = np.hypot(a.shape[:, None, 0] - b.shape[None, :, 0], a.shape[:, None, 1] - b.shape[None, :, 1])
    i, j = np.unravel_index(int(np.argmin(distance)), distance.shape)
    return abs(float(a.heights[i] - b.heights[j])) >= LAYER_HEIGHT_M


def bend_together(links: Sequence[JunctionLink], foes: set[tuple[int, int]]) -> tuple[JunctionLink, ...]:
    """Bend links that pass a foe closely without crossing it on the way.

    Args:
        links: The links.
        foes: The pairs of links in each other's way (``find_foes``).

    Returns:
        The links in the same order.
    """
    from shapely import LineString
    from shapely.ops import substring

    bent = list(links)
    for i, j in sorted(foes):
        a, b = bent[i], bent[j]
        if (a.target, a.to_lane) == (b.target, b.to_lane):
            continue
        lines = LineString(a.shape), LineString(b.shape)
        if lines[0].intersects(lines[1]):
            continue
        nearest_at, missing = _nearest(
            lines, [substring(line, UNBENT_END_M, line.length - UNBENT_END_M) for line in lines]
        )
        if np.hypot(*missing) > 2.0 * MAX_BEND_OFFSET_M:
            nearest_at, missing = _nearest(lines, lines)
        midway = [
            UNBENT_END_M - SAME_POINT_DISTANCE_M <= w <= line.length - UNBENT_END_M + SAME_POINT_DISTANCE_M
            for w, line in zip(nearest_at, lines, strict=True)
        ]
        if not any(midway) or (not all(midway) and np.hypot(*missing) > MAX_BEND_OFFSET_M):
            continue
        share = 1.0 / sum(midway)
        if midway[0]:
            bent[i] = _bend(a, nearest_at[0], share * missing)
        if midway[1]:
            bent[j] = _bend(b, nearest_at[1], -share * missing)
    return tuple(bent)


def _nearest(lines: Sequence[LineString], parts: Sequence[LineString]) -> tuple[list[float], Floats]:
    """Return where parts of two lines are nearest, and what the first lacks to cross the second there.

    Returns:
        The stations on both lines [m], and the missing offset ``(2,)`` [m].
    """
    from shapely.ops import nearest_points

    ends = nearest_points(*parts)
    nearest_at = [float(line.project(end)) for line, end in zip(lines, ends, strict=True)]
    gap = np.array([ends[1].x - ends[0].x, ends[1].y - ends[0].y])
    return nearest_at, gap * (1.0 + CROSSING_OVERLAP_M / max(float(np.hypot(*gap)), 1e-6))


def _bend(link: JunctionLink, station: float, way: Floats) -> JunctionLink:
    """Move the link by ``way`` [m] at ``station``, decreasing to both sides, with its ends unchanged."""
    along = line_stations(link.shape)
    reach = min(BEND_LENGTH_M, station, float(along[-1]) - station)
    extra = station + reach * np.linspace(-1.0, 1.0, 17)
    every = np.unique(np.concatenate([along, extra]))
    weight = 0.5 + 0.5 * np.cos(np.pi * np.clip((every - station) / reach, -1.0, 1.0))
    shape = at(link.shape, along, every) + weight[:, None] * way
    return replace(link, shape=shape, heights=np.interp(every, along, link.heights))


@dataclass(frozen=True, slots=True)
class LinkPriorities:
    """The right of way at all junctions.

    Attributes:
        kind: The kind of each junction by its name.
        state: SUMO's letter of each link (M, m, s, w).
        yields_to: For each link, the links that it yields to.
        foes: For each link, all links in its way.
    """

    kind: dict[str, str]
    state: tuple[str, ...]
    yields_to: tuple[frozenset[int], ...]
    foes: tuple[frozenset[int], ...]


def settle(
    links: Sequence[JunctionLink], edges: dict[str, RoadEdge], foes: set[tuple[int, int]], stops: Collection[int],
    ruled: Collection[int],
) -> LinkPriorities:  # fmt: skip
    """Rank the links of every junction.

    Args:
        links: The links.
        edges: The edges by name.
        foes: The pairs of links in each other's way (``find_foes``).
        stops: WOMD lanes that begin at a stop sign.
        ruled: Links that a signal rules. They go before all others of their junction.

    Returns:
        The right of way.
    """
    of_junction: dict[str, list[int]] = {}
    for k, link in enumerate(links):
        of_junction.setdefault(link.junction, []).append(k)
    against: list[set[int]] = [set() for _ in links]
    for i, j in foes:
        against[i].add(j)
        against[j].add(i)
    stopped = [k not in ruled and any(n in stops for n in link.lanes) for k, link in enumerate(links)]
    state, kind = [""] * len(links), {}
    yields: list[set[int]] = [set() for _ in links]
    for junction, members in of_junction.items():
        in_conflict = {links[k].source for k in members if against[k]}
        halting = {links[k].source for k in members if stopped[k]}
        allway = not any(k in ruled for k in members) and _all_stop(edges, in_conflict, halting)
        kind[junction] = "allway_stop" if allway else "priority"
        ranks = _ranks(links, edges, members, stopped, ruled)
        for k in members:
            yields[k] = set(against[k]) if allway else {j for j in against[k] if ranks[j] > ranks[k]}
            state[k] = "w" if allway else "s" if stopped[k] else "m" if yields[k] else "M"
    return LinkPriorities(kind, tuple(state), tuple(map(frozenset, yields)), tuple(map(frozenset, against)))


def _all_stop(edges: dict[str, RoadEdge], approaches: set[str], halting: set[str]) -> bool:
    """Return whether a junction is an all-way stop.

    It is one if both of two approaches, or at least three approaches, have a stop sign, and no road leads through
    without one.
    """
    stopping = [_heading(edges[name]) for name in approaches & halting]
    if len(approaches) < 2 or len(stopping) < min(3, len(approaches)):
        return False
    return all(any(_one_road(_heading(edges[name]), heading) for heading in stopping) for name in approaches)


def _ranks(
    links: Sequence[JunctionLink],
    edges: dict[str, RoadEdge],
    members: list[int],
    stopped: list[bool],
    ruled: Collection[int],
) -> dict[int, Rank]:
    """Return a distinct rank for every link of a junction; the greater goes first."""
    sources = sorted({links[k].source for k in members})
    heading = {name: _heading(edges[name]) for name in sources}
    straight = {name: any(links[k].direction == "s" for k in members if links[k].source == name) for name in sources}
    worth: dict[str, tuple[float, ...]] = {}
    for name in sources:
        axis = [source for source in sources if _one_road(heading[name], heading[source])]
        lanes = sum(len(edges[source].lanes) for source in axis)
        speed = max(math.floor(edges[source].speed / SAME_LIMIT_M_S + 0.5) for source in axis)
        worth[name] = (float(any(straight[source] for source in axis)), float(speed), float(lanes))
    ranks = {}
    for k in members:
        link = links[k]
        sign = (float(k in ruled), float(not stopped[k]))
        turn = (float(MOVEMENT_PRIORITY[link.direction]), float(not link.turning), -round(abs(link.turn), 2))
        ranks[k] = (*sign, *worth[link.source], *turn, -float(k))
    return ranks


def _heading(edge: RoadEdge) -> float:
    """Return the direction at the end of an edge [rad]."""
    shape = edge.lanes[0].shape
    back = shape[max(0, len(shape) - 5)]
    return float(np.arctan2(*(shape[-1] - back)[::-1]))


def _one_road(a: float, b: float) -> bool:
    """Return whether two directions, or their opposites, belong to one road."""
    difference = abs((a - b + math.pi / 2) % math.pi - math.pi / 2)
    return difference < SAME_AXIS_RAD
