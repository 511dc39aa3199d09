"""Right of way in a junction without signals.

Every link has a rank; of two links in each other's way the lower one yields. Ranks are a strict order, so there is no
ring of waiting vehicles. Stop signs come last, then the road (axis) of less speed and fewer lanes, then turns:
straight before right before left. Where all approaches have a stop sign, or three and every road has one, the first to
arrive goes first.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.womd.network.roads import Link, RoadEdge

AXIS = math.radians(35.0)  # approaches with directions (or opposites) that differ by less are one road
SPEED_STEP = 2.2  # m/s (5 mph), limits that differ by less count as the same
ORDER = {"s": 3, "r": 2, "l": 1, "t": 0}

Rank = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class RightOfWay:
    """For each link: SUMO's letter (M, m, s, w), and the links it yields to; foes both ways; the kind of junction."""

    kind: dict[str, str]
    state: tuple[str, ...]
    yields_to: tuple[frozenset[int], ...]
    foes: tuple[frozenset[int], ...]


def settle(
    links: Sequence[Link], edges: dict[str, RoadEdge], foes: set[tuple[int, int]], stops: Collection[int],
    ruled: Collection[int],
) -> RightOfWay:  # fmt: skip
    """Rank the links of every junction; ``stops``: WOMD lanes that begin at a stop sign; ``ruled``: links that a
    signal rules (they go before all others of their junction)."""
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
    return RightOfWay(kind, tuple(state), tuple(map(frozenset, yields)), tuple(map(frozenset, against)))


def _all_stop(edges: dict[str, RoadEdge], approaches: set[str], halting: set[str]) -> bool:
    """Whether all approaches have a stop sign; or three and more have one, and no road goes through without."""
    stopping = [_heading(edges[name]) for name in approaches & halting]
    if len(approaches) < 2 or len(stopping) < min(3, len(approaches)):
        return False
    return all(any(_one_road(_heading(edges[name]), heading) for heading in stopping) for name in approaches)


def _ranks(
    links: Sequence[Link], edges: dict[str, RoadEdge], members: list[int], stopped: list[bool], ruled: Collection[int]
) -> dict[int, Rank]:
    """A rank for every link of a junction, all different; the greater goes first."""
    sources = sorted({links[k].source for k in members})
    heading = {name: _heading(edges[name]) for name in sources}
    straight = {name: any(links[k].direction == "s" for k in members if links[k].source == name) for name in sources}
    worth: dict[str, tuple[float, ...]] = {}
    for name in sources:
        axis = [source for source in sources if _one_road(heading[name], heading[source])]
        lanes = sum(len(edges[source].lanes) for source in axis)
        speed = max(math.floor(edges[source].speed / SPEED_STEP + 0.5) for source in axis)
        worth[name] = (float(any(straight[source] for source in axis)), float(speed), float(lanes))
    ranks = {}
    for k in members:
        link = links[k]
        sign = (float(k in ruled), float(not stopped[k]))
        turn = (float(ORDER[link.direction]), float(not link.turning), -round(abs(link.turn), 2))
        ranks[k] = (*sign, *worth[link.source], *turn, -float(k))
    return ranks


def _heading(edge: RoadEdge) -> float:
    """Direction [rad] at the end of an edge."""
    shape = edge.lanes[0].shape
    back = shape[max(0, len(shape) - 5)]
    return float(np.arctan2(*(shape[-1] - back)[::-1]))


def _one_road(a: float, b: float) -> bool:
    difference = abs((a - b + math.pi / 2) % math.pi - math.pi / 2)
    return difference < AXIS
