"""The layout as SUMO's nouns: edges with lanes, links between lanes, junctions; all with their exact shapes."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.womd.network.layout import Layout
from sumo_adv.womd.network.paths import Leg, Way
from sumo_adv.womd.network.polyline import joined, part, turned
from sumo_adv.womd.network.rows import Stretch
from sumo_adv.womd.network.widths import Widths

STRAIGHT = math.radians(30.0)  # less of a turn is straight on
ROUND = math.radians(150.0)  # more of a turn to the left is a U-turn
SIDE_GRIP = 5.5  # m/s2 that limits speed in a bend, as netconvert has it
MIN_TURN_SPEED = 3.0  # m/s, no bend is slower


@dataclass(frozen=True, slots=True)
class RoadLane:
    """A lane of an edge. shape ``(n, 2)`` [m], width m, speed m/s."""

    stretch: Stretch
    shape: Floats
    width: float
    speed: float
    bike: bool


@dataclass(frozen=True, slots=True)
class RoadEdge:
    """An edge from junction ``start`` to junction ``end``; lanes from right to left."""

    name: str
    start: str
    end: str
    lanes: tuple[RoadLane, ...]

    @property
    def speed(self) -> float:
        """The fastest lane's limit [m/s]."""
        return max(lane.speed for lane in self.lanes)


@dataclass(frozen=True, slots=True)
class Link:
    """A way through ``junction`` from lane ``from_lane`` of edge ``source`` to ``to_lane`` of ``target``.

    shape ``(n, 2)`` [m]; heights ``(n,)`` [m]; width m; speed m/s; turn rad, left positive; legs: the spans it uses;
    lanes: WOMD lanes that begin on it, in order; turning: some of it is a lane that turns in a junction.
    """

    junction: str
    source: str
    from_lane: int
    target: str
    to_lane: int
    shape: Floats
    heights: Floats
    width: float
    speed: float
    turn: float
    legs: tuple[Leg, ...]
    lanes: tuple[int, ...]
    turning: bool

    @property
    def direction(self) -> str:
        """SUMO's letter: s straight, l left, r right, t U-turn."""
        if abs(self.turn) < STRAIGHT:
            return "s"
        if self.turn > ROUND:
            return "t"
        return "l" if self.turn > 0 else "r"


@dataclass(frozen=True, slots=True)
class Roads:
    """The whole network. junctions: name -> centre (x, y) [m]."""

    edges: dict[str, RoadEdge]
    links: tuple[Link, ...]
    junctions: dict[str, tuple[float, float]]
    place: dict[Stretch, tuple[str, int]]


def make_roads(layout: Layout, widths: Widths) -> Roads:
    """Name and shape everything."""
    edges, place = _edges(layout, widths)
    links = tuple(_link(layout, way, edges, place, widths) for way in layout.ways)
    ends: dict[str, list[Floats]] = {}
    for edge in edges.values():
        for lane in edge.lanes:
            ends.setdefault(edge.start, []).append(lane.shape[0])
            ends.setdefault(edge.end, []).append(lane.shape[-1])
    centres = {name: np.mean(points, axis=0) for name, points in ends.items()}
    junctions = {name: (float(c[0]), float(c[1])) for name, c in centres.items()}
    return Roads(edges, links, junctions, place)


def _edges(layout: Layout, widths: Widths) -> tuple[dict[str, RoadEdge], dict[Stretch, tuple[str, int]]]:
    edges: dict[str, RoadEdge] = {}
    place: dict[Stretch, tuple[str, int]] = {}
    strands = layout.strands.all
    repeated: Counter[int] = Counter()
    for row, start, end in zip(layout.rows, layout.nodes.start, layout.nodes.end, strict=True):
        lane_id = strands[row[0].strand].lane_at(row[0].start)
        name = f"w{lane_id}" + (f".{repeated[lane_id]}" if repeated[lane_id] else "")
        repeated[lane_id] += 1
        lanes = []
        for index, stretch in enumerate(row):
            strand = strands[stretch.strand]
            shape = part(strand.points[:, :2], strand.along, stretch.start, stretch.end)
            lanes.append(RoadLane(stretch, shape, widths.of(stretch), strand.speed, strand.bike))
            place[stretch] = name, index
        edges[name] = RoadEdge(name, f"n{start}", f"n{end}", tuple(lanes))
    return edges, place


def _link(
    layout: Layout, way: Way, edges: dict[str, RoadEdge], place: dict[Stretch, tuple[str, int]], widths: Widths
) -> Link:
    source, from_lane = place[way.source]
    target, to_lane = place[way.target]
    parts, lanes = [], []
    for number, k in way.legs:
        strand = layout.strands.all[number]
        a, b = layout.spans.of[number][k]
        parts.append(part(strand.points, strand.along, a, b))
        lanes += strand.begin_between(a, b)
    line = joined(parts)
    shape = line[:, :2]
    before, after = edges[source].lanes[from_lane], edges[target].lanes[to_lane]
    strands = [layout.strands.all[number] for number, _ in way.legs]
    speed = min(min(strand.speed for strand in strands), bend_speed(shape))
    return Link(
        edges[source].end, source, from_lane, target, to_lane, shape, line[:, 2], min(before.width, after.width), speed,
        turned(_with_ends(before.shape, shape, after.shape)), way.legs, tuple(lanes),
        any(strand.turning for strand in strands),
    )  # fmt: skip


def _with_ends(before: Floats, shape: Floats, after: Floats) -> Floats:
    """The shape with the last metre before it and the first after it, so that short ones have a direction."""
    return joined([before[-3:], shape, after[:3]])


def bend_speed(shape: Floats) -> float:
    """The speed [m/s] at which the mean bend of a shape takes ``SIDE_GRIP``."""
    length = float(np.sum(np.hypot(*np.diff(shape, axis=0).T)))
    bend = abs(turned(shape)) / max(length, 1.0)
    return max(math.sqrt(SIDE_GRIP / max(bend, 1e-4)), MIN_TURN_SPEED)
