"""Convert the layout to SUMO's terms: edges with lanes, links and junctions, all with their exact shapes.

A lane extends from its centre to the painted line or road edge on either side.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.geometry import LAYER_HEIGHT_M
from sumo_adv.womd.lines import at, headings, joined_line, part, turned
from sumo_adv.womd.network.layout import ConnectionPath, Layout, Leg, Row, StrandStretch
from sumo_adv.womd.network.strands import Strand
from sumo_adv.womd.record import LineFeature

BORDER_SEARCH_DISTANCE_M = 3.5  # distance to each side within which lines are searched for
WIDTH_PROBE_COUNT = 5  # number of places along a stretch
DEFAULT_LANE_WIDTH_M = 3.4
DEFAULT_BIKE_LANE_WIDTH_M = 1.5
MIN_CAR_LANE_WIDTH_M, MAX_CAR_LANE_WIDTH_M = 2.8, 5.0  # m
MIN_BIKE_LANE_WIDTH_M, MAX_BIKE_LANE_WIDTH_M = 1.0, 2.5  # m
MAX_STRAIGHT_TURN_RAD = math.radians(30.0)  # a smaller turn is straight on
MIN_U_TURN_RAD = math.radians(150.0)  # a greater turn to the left is a U-turn
BEND_LATERAL_ACCELERATION_M_S2 = 5.5  # limits the speed in a bend, as in netconvert
MIN_BEND_SPEED_M_S = 3.0  # minimum speed in a bend


def find_widths(
    strands: tuple[Strand, ...], rows: Sequence[Row], lines: Iterable[LineFeature]
) -> dict[StrandStretch, float]:
    """Return the width of every stretch of every row.

    Args:
        strands: The strands.
        rows: The rows of stretches.
        lines: The painted lines and road edges.

    Returns:
        The widths [m].
    """
    stretches = [stretch for row in rows for stretch in row]
    centre, side = _probes(strands, stretches)
    sides = _distances(np.vstack([centre, centre]), np.vstack([side, -side]), lines)
    left, right = (part.reshape(-1, WIDTH_PROBE_COUNT) for part in np.split(sides, 2))
    spacing = _spacings(strands, rows)
    width: dict[StrandStretch, float] = {}
    for k, stretch in enumerate(stretches):
        bike = strands[stretch.strand].bike
        value = _choose(
            left[k], right[k], spacing.get(stretch), DEFAULT_BIKE_LANE_WIDTH_M if bike else DEFAULT_LANE_WIDTH_M
        )
        low, high = (
            (MIN_BIKE_LANE_WIDTH_M, MAX_BIKE_LANE_WIDTH_M) if bike else (MIN_CAR_LANE_WIDTH_M, MAX_CAR_LANE_WIDTH_M)
        )
        width[stretch] = round(min(max(value, low), high), 2)
    return width


def _choose(left: Floats, right: Floats, spacing: float | None, default: float) -> float:
    """Choose the width by lines on both sides, otherwise by the neighbours in the row, otherwise by a line on one."""
    both = left + right
    if np.isfinite(both).any():
        return float(np.median(both[np.isfinite(both)]))
    if spacing is not None:
        return spacing
    finite = np.concatenate([left[np.isfinite(left)], right[np.isfinite(right)]])
    return 2 * float(np.median(finite)) if len(finite) else default


def _probes(strands: tuple[Strand, ...], stretches: list[StrandStretch]) -> tuple[Floats, Floats]:
    """Return points ``(n, 3)`` [m] on the centres, and the unit vector ``(n, 2)`` to the left of each."""
    centres, sides = [], []
    for stretch in stretches:
        strand = strands[stretch.strand]
        places = (
            stretch.start + (stretch.end - stretch.start) * (np.arange(WIDTH_PROBE_COUNT) + 0.5) / WIDTH_PROBE_COUNT
        )
        centres.append(at(strand.points, strand.along, places))
        heading = headings(strand.points, strand.along, places)
        sides.append(np.stack([-np.sin(heading), np.cos(heading)], axis=-1))
    if not centres:
        return np.empty((0, 3)), np.empty((0, 2))
    return np.vstack(centres), np.vstack(sides)


def _distances(centre: Floats, side: Floats, lines: Iterable[LineFeature]) -> Floats:
    """Return the distance from each centre to the first line that crosses the ray to its side [m].

    The distance is inf if there is no such line within ``BORDER_SEARCH_DISTANCE_M``.
    """
    from shapely import STRtree, linestrings

    distances = np.full(len(centre), np.inf)
    pieces = [np.stack([line.points[:-1], line.points[1:]], axis=1) for line in lines if len(line.points) > 1]
    if not pieces or not len(centre):
        return distances
    segments = np.concatenate(pieces)
    rays = np.stack([centre[:, :2] + 0.2 * side, centre[:, :2] + BORDER_SEARCH_DISTANCE_M * side], axis=1)
    ray, hit = STRtree(linestrings(segments[:, :, :2])).query(linestrings(rays))
    p, d = centre[ray], side[ray]
    a, b = segments[hit, 0], segments[hit, 1]
    along = b[:, :2] - a[:, :2]
    cross = d[:, 0] * along[:, 1] - d[:, 1] * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        to = a[:, :2] - p[:, :2]
        t = (to[:, 0] * along[:, 1] - to[:, 1] * along[:, 0]) / cross
        u = (to[:, 0] * d[:, 1] - to[:, 1] * d[:, 0]) / cross
    good = (
        (t > 0.2) & (t < BORDER_SEARCH_DISTANCE_M) & (u >= 0) & (u <= 1) & (np.abs(a[:, 2] - p[:, 2]) < LAYER_HEIGHT_M)
    )
    np.minimum.at(distances, ray[good], t[good])
    return distances


def _spacings(strands: tuple[Strand, ...], rows: Iterable[Row]) -> dict[StrandStretch, float]:
    """Return the mean distance between the middles of neighbours in a row [m]."""
    spacings: dict[StrandStretch, list[float]] = {}
    for row in rows:
        middles = [at(strands[s.strand].points, strands[s.strand].along, (s.start + s.end) / 2) for s in row]
        for right, left, p, q in zip(row, row[1:], middles, middles[1:], strict=False):
            distance = float(np.hypot(*(p - q)[:2]))
            spacings.setdefault(right, []).append(distance)
            spacings.setdefault(left, []).append(distance)
    return {stretch: float(np.mean(values)) for stretch, values in spacings.items()}


@dataclass(frozen=True, slots=True)
class RoadLane:
    """A lane of an edge.

    Attributes:
        shape: Its shape, ``(n, 2)`` [m].
        heights: The heights of its points, ``(n,)`` [m].
        width: Its width [m].
        speed: Its speed limit [m/s].
        bike: Whether only bicycles may use it.
    """

    shape: Floats
    heights: Floats
    width: float
    speed: float
    bike: bool


@dataclass(frozen=True, slots=True)
class RoadEdge:
    """An edge between two junctions.

    Attributes:
        name: The name of the edge.
        start: The junction at its start.
        end: The junction at its end.
        lanes: Its lanes, from right to left.
    """

    name: str
    start: str
    end: str
    lanes: tuple[RoadLane, ...]

    @property
    def speed(self) -> float:
        """The limit of the fastest lane [m/s]."""
        return max(lane.speed for lane in self.lanes)


@dataclass(frozen=True, slots=True)
class JunctionLink:
    """A link through a junction from one lane to another.

    Attributes:
        junction: The junction.
        source: The edge that it leaves.
        from_lane: The index of the lane that it leaves.
        target: The edge that it enters.
        to_lane: The index of the lane that it enters.
        shape: Its shape, ``(n, 2)`` [m].
        heights: The heights of its points, ``(n,)`` [m].
        width: Its width [m].
        speed: Its speed limit [m/s].
        turn: The angle by which it turns [rad], left positive.
        legs: The spans that it uses.
        lanes: The WOMD lanes that begin on it, in order.
        turning: Whether some of it is a lane that turns in a junction.
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
        if abs(self.turn) < MAX_STRAIGHT_TURN_RAD:
            return "s"
        if self.turn > MIN_U_TURN_RAD:
            return "t"
        return "l" if self.turn > 0 else "r"


@dataclass(frozen=True, slots=True)
class RoadNetwork:
    """The whole network.

    Attributes:
        edges: The edges by name.
        links: The links.
        junctions: The centre (x, y) [m] of each junction by its name.
        place: The edge and lane index of each stretch.
    """

    edges: dict[str, RoadEdge]
    links: tuple[JunctionLink, ...]
    junctions: dict[str, tuple[float, float]]
    place: dict[StrandStretch, tuple[str, int]]


def make_roads(layout: Layout, widths: dict[StrandStretch, float]) -> RoadNetwork:
    """Return the network of a layout, with names and shapes.

    Args:
        layout: The layout.
        widths: The width of each stretch [m].

    Returns:
        The network.
    """
    edges, place = _edges(layout, widths)
    links = tuple(_link(layout, way, edges, place) for way in layout.ways)
    ends: dict[str, list[Floats]] = {}
    for edge in edges.values():
        for lane in edge.lanes:
            ends.setdefault(edge.start, []).append(lane.shape[0])
            ends.setdefault(edge.end, []).append(lane.shape[-1])
    centres = {name: np.mean(points, axis=0) for name, points in ends.items()}
    junctions = {name: (float(c[0]), float(c[1])) for name, c in centres.items()}
    return RoadNetwork(edges, links, junctions, place)


def _edges(
    layout: Layout, widths: dict[StrandStretch, float]
) -> tuple[dict[str, RoadEdge], dict[StrandStretch, tuple[str, int]]]:
    """Return the edges by name, and the edge and lane index of each stretch."""
    edges: dict[str, RoadEdge] = {}
    place: dict[StrandStretch, tuple[str, int]] = {}
    strands = layout.strands.all
    repeated: Counter[int] = Counter()
    for row, start, end in zip(layout.rows, layout.junctions[::2], layout.junctions[1::2], strict=False):
        lane_id = strands[row[0].strand].lane_at(row[0].start)
        name = f"w{lane_id}" + (f".{repeated[lane_id]}" if repeated[lane_id] else "")
        repeated[lane_id] += 1
        lanes = []
        for index, stretch in enumerate(row):
            strand = strands[stretch.strand]
            line = part(strand.points, strand.along, stretch.start, stretch.end)
            lanes.append(RoadLane(line[:, :2], line[:, 2], widths[stretch], strand.speed, strand.bike))
            place[stretch] = name, index
        edges[name] = RoadEdge(name, f"n{start}", f"n{end}", tuple(lanes))
    return edges, place


def _link(
    layout: Layout, way: ConnectionPath, edges: dict[str, RoadEdge], place: dict[StrandStretch, tuple[str, int]]
) -> JunctionLink:
    """Return the link of a way."""
    source, from_lane = place[way.source]
    target, to_lane = place[way.target]
    parts, lanes = [], []
    for number, k in way.legs:
        strand = layout.strands.all[number]
        a, b = layout.spans.of[number][k]
        parts.append(part(strand.points, strand.along, a, b))
        # After the stub of a strand that begins at the map's rim, the lane at the strand's beginning counts, too.
        first = 0.0 if a == layout.spans.bounds[number][0] else a - 1e-6
        lanes += [run.lane for run in strand.runs if run.lane_start == 0.0 and first <= run.start < b]
    line = joined_line(parts)
    shape = line[:, :2]
    before, after = edges[source].lanes[from_lane], edges[target].lanes[to_lane]
    strands = [layout.strands.all[number] for number, _ in way.legs]
    speed = min(min(strand.speed for strand in strands), _bend_speed(shape))
    with_ends = joined_line([before.shape[-3:], shape, after.shape[:3]])  # so that short links have a direction
    return JunctionLink(
        edges[source].end, source, from_lane, target, to_lane, shape, line[:, 2], min(before.width, after.width), speed,
        turned(with_ends), way.legs, tuple(lanes),
        any(strand.turning for strand in strands),
    )  # fmt: skip


def _bend_speed(shape: Floats) -> float:
    """Return the speed [m/s] at which the mean bend of a shape takes ``BEND_LATERAL_ACCELERATION_M_S2``."""
    length = float(np.sum(np.hypot(*np.diff(shape, axis=0).T)))
    bend = abs(turned(shape)) / max(length, 1.0)
    return max(math.sqrt(BEND_LATERAL_ACCELERATION_M_S2 / max(bend, 1e-4)), MIN_BEND_SPEED_M_S)
