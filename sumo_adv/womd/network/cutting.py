"""Find which spans of each strand lie inside junctions. What lies between spans becomes edges.

Spans begin as conflicts and as lane ends. A conflict is where vehicles on two lanes would be in each other's way: at a
crossing, after a split or before a merge. Spans then grow until neighbouring lanes are cut at the same places, and no
scrap of edge is left between two spans.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sumo_adv.datatypes import Bools, Floats, Ints
from sumo_adv.geometry import LAYER_HEIGHT_M, wrap
from sumo_adv.womd.lines import at, headings
from sumo_adv.womd.network.strands import KeptLane, Strand, Strands

CONFLICT_SAMPLE_STEP_M = 1.0  # distance between samples
MIN_PARALLEL_SPACING_M = 1.2  # lanes in one direction whose centres are nearer overlap
MIN_CROSSING_SPACING_M = 2.6  # the same at a right angle
# Lanes in opposite directions may share their ground (left-turn lanes of both sides), which is no conflict.
MIN_OPPOSITE_ANGLE_RAD = np.deg2rad(150.0)
JOINT_RADIUS_M = 8.0  # around the joint of a lane and its exit, where both are always near
MIN_ROW_LENGTH_M = 5.0  # lanes beside each other for a shorter length are not a row
HALF_CUT_LENGTH_M = 0.1  # half the length of a span that cuts one edge in two
CUT_SNAP_DISTANCE_M = 6.0  # two cuts this near to each other count as one
SPAN_TOLERANCE_M = 1.5  # by which spans of neighbouring lanes may differ
MIN_EDGE_LENGTH_M = 6.0  # shorter stretches between two spans become part of the junction
MIN_TURNING_EDGE_LENGTH_M = 25.0  # the same for lanes that turn in a junction
STOP_LINE_REACH_M = 15.0  # a span at most this far after a stop line is extended back to that line
STUB_LENGTH_M = 0.5  # length of edge that is kept if a strand begins or ends in a conflict without a connection
MAX_CUTTING_ROUNDS = 12

Span = tuple[float, float]
_Range = tuple[float, float, float, float]  # start and end on one strand, start and end on the other [m]


@dataclass(frozen=True, slots=True)
class Conflicts:
    """Pairs of near samples on different strands, each pair once. All arrays have shape ``(n,)``.

    Attributes:
        a: The first strand.
        sa: The station on the first strand [m].
        b: The second strand.
        sb: The station on the second strand [m].
    """

    a: Ints
    sa: Floats
    b: Ints
    sb: Floats


def find_conflicts(strands: tuple[Strand, ...]) -> Conflicts:
    """Return all conflicts between strands that motor vehicles use."""
    owners, stations = [np.empty(0, np.intp)], [np.empty(0)]
    places, directions = [np.empty((0, 3))], [np.empty(0)]
    for strand in strands:
        if not strand.bike:
            own_stations = np.linspace(0.0, strand.length, max(2, int(strand.length / CONFLICT_SAMPLE_STEP_M) + 1))
            owners.append(np.full(len(own_stations), strand.number, dtype=np.intp))
            stations.append(own_stations)
            places.append(at(strand.points, strand.along, own_stations))
            directions.append(headings(strand.points, strand.along, own_stations))
    owner, station = np.concatenate(owners), np.concatenate(stations)
    place, heading = np.concatenate(places), np.concatenate(directions)
    pairs = cKDTree(place[:, :2]).query_pairs(MIN_CROSSING_SPACING_M, output_type="ndarray")
    i, j = pairs[:, 0], pairs[:, 1]
    apart = (owner[i] != owner[j]) & (np.abs(place[i, 2] - place[j, 2]) < LAYER_HEIGHT_M)
    i, j = i[apart], j[apart]
    distance = np.hypot(*(place[i, :2] - place[j, :2]).T)
    angle = np.abs(wrap(heading[i] - heading[j]))
    near = (distance < MIN_PARALLEL_SPACING_M + (MIN_CROSSING_SPACING_M - MIN_PARALLEL_SPACING_M) * np.sin(angle)) & (
        angle < MIN_OPPOSITE_ANGLE_RAD
    )
    i, j = i[near], j[near]
    natural = _at_joint(strands, owner, station, i, j) | _at_joint(strands, owner, station, j, i)
    i, j = i[~natural], j[~natural]
    return Conflicts(owner[i], station[i], owner[j], station[j])


def _at_joint(strands: tuple[Strand, ...], owner: Ints, station: Floats, i: Ints, j: Ints) -> Bools:
    """Return whether the strand of ``j`` is an exit of the strand of ``i`` and both samples lie near their joint."""
    linked = np.zeros((len(strands), len(strands)), dtype=bool)
    for strand in strands:
        linked[strand.number, list(strand.exits)] = True
    length = np.array([strand.length for strand in strands])
    return linked[owner[i], owner[j]] & (length[owner[i]] - station[i] + station[j] < JOINT_RADIUS_M)


@dataclass(frozen=True, slots=True)
class Beside:
    """Two strands that run beside each other. The arrays have shape ``(n,)`` and ascend.

    Attributes:
        right: The strand on the right.
        left: The strand on the left.
        right_at: Stations on the right strand, from the beginning to the end of the common part [m].
        left_at: The stations of the same places on the left strand [m].
    """

    right: int
    left: int
    right_at: Floats
    left_at: Floats


def find_beside(lanes: dict[int, KeptLane], strands: Strands) -> list[Beside]:
    """Return all pairs of strands beside each other, which follow from the neighbours of their lanes.

    Args:
        lanes: The lanes by id.
        strands: The strands of these lanes.

    Returns:
        The pairs.
    """
    ranges: dict[tuple[int, int], list[_Range]] = {}
    for number, lane in lanes.items():
        for neighbours, is_left in ((lane.feature.left, True), (lane.feature.right, False)):
            for n in neighbours:
                if n.lane not in lanes or lane.bike != lanes[n.lane].bike:
                    continue
                own = _stations(lane, n.own_start, n.own_end)
                across = _stations(lanes[n.lane], n.other_start, n.other_end)
                if own[1] - own[0] <= 0 or across[1] - across[0] <= 0:
                    continue
                for a, b, span in _pieces(strands, number, own, n.lane, across):
                    key, row = ((a, b), span) if is_left else ((b, a), (*span[2:], *span[:2]))
                    ranges.setdefault(key, []).append(row)
    return [made for key, rows in sorted(ranges.items()) for made in _besides_of(key, rows)]


def _pieces(
    strands: Strands, lane: int, own: Floats, neighbour: int, there: Floats
) -> Iterator[tuple[int, int, _Range]]:
    """Yield a range of a lane beside a range of another as ranges of their strands, which may change on the way."""
    for a, run in strands.of_lane[lane]:
        for b, across in strands.of_lane[neighbour]:
            if a == b:
                continue
            ends = np.interp([across.lane_start, across.lane_end], there, own)
            low, high = max(run.lane_start, own[0], ends[0]), min(run.lane_end, own[1], ends[1])
            if high - low <= 1e-6:
                continue
            on_own = np.interp([low, high], [run.lane_start, run.lane_end], [run.start, run.end])
            on_other = np.interp(
                np.interp([low, high], own, there), [across.lane_start, across.lane_end], [across.start, across.end]
            )
            yield a, b, (float(on_own[0]), float(on_own[1]), float(on_other[0]), float(on_other[1]))


def _stations(lane: KeptLane, start: int, end: int) -> Floats:
    """Return the stations of a range of a lane's points [m]."""
    last = len(lane.index) - 1
    return lane.index[[min(max(start, 0), last), min(max(end, 0), last)]]


def _besides_of(key: tuple[int, int], rows: list[_Range]) -> Iterator[Beside]:
    """Merge ranges that touch or overlap."""
    run: list[_Range] = []
    for row in sorted(rows):
        if run and (
            row[0] > run[-1][1] + MIN_ROW_LENGTH_M or row[2] < run[-1][2] or row[2] > run[-1][3] + MIN_ROW_LENGTH_M
        ):
            yield from _beside(key, run)
            run = []
        if run and row[0] < run[-1][1] - 0.1:  # the same range, given by the other lane
            if row[1] > run[-1][1] + 0.1 and row[3] > run[-1][3] + 0.1:
                run[-1] = (run[-1][0], row[1], run[-1][2], row[3])
            continue
        run.append(row)
    yield from _beside(key, run)


def _beside(key: tuple[int, int], run: list[_Range]) -> Iterator[Beside]:
    """Yield the merged ranges as one pair, if it is long enough."""
    if run and run[-1][1] - run[0][0] >= MIN_ROW_LENGTH_M and run[-1][3] - run[0][2] >= MIN_ROW_LENGTH_M:
        right = np.maximum.accumulate([v for row in run for v in row[:2]])
        left = np.maximum.accumulate([v for row in run for v in row[2:]])
        yield Beside(*key, right, left)


class Spans:
    """The spans inside junctions. ``add`` changes them.

    Attributes:
        strands: The strands.
        of: For each strand, disjoint (start, end) [m], in order.
        bounds: For each strand, the stations between which spans may lie [m].
    """

    def __init__(self, strands: tuple[Strand, ...]) -> None:
        """Start without spans."""
        self.strands = strands
        self.of: list[list[Span]] = [[] for _ in strands]
        stubs = [min(STUB_LENGTH_M, strand.length / 3) for strand in strands]
        self.bounds = [
            (0.0 if s.entries else stub, s.length if s.exits else s.length - stub)
            for s, stub in zip(strands, stubs, strict=True)
        ]

    def add(self, strand: int, start: float, end: float) -> bool:
        """Add a span, as far as the strand's stubs allow, and merge it with the spans that it touches.

        Args:
            strand: The number of the strand.
            start: The beginning of the span [m].
            end: The end of the span [m].

        Returns:
            Whether the spans changed.
        """
        low, high = self.bounds[strand]
        start, end = max(start, low), min(end, high)
        if end <= start:
            return False
        kept, before = [], self.of[strand]
        for a, b in before:
            if b < start or a > end:
                kept.append((a, b))
            else:
                start, end = min(a, start), max(b, end)
        self.of[strand] = sorted([*kept, (start, end)])
        return self.of[strand] != before

    def covers(self, strand: int, start: float, end: float, slack: float) -> bool:
        """Return whether one span covers a range.

        Args:
            strand: The number of the strand.
            start: The beginning of the range [m].
            end: The end of the range [m].
            slack: How much of each end may be uncovered [m].

        Returns:
            Whether it does. An empty range is covered.
        """
        low, high = self.bounds[strand]
        start, end = max(start, low), min(end, high)
        return end <= start or any(a <= start + slack and b >= end - slack for a, b in self.of[strand])

    def stretches(self, strand: int) -> list[Span]:
        """Return what lies outside the spans of a strand, in order [m]."""
        edges = [0.0, *(v for span in self.of[strand] for v in span), self.strands[strand].length]
        return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 1e-6]


def first_spans(strands: Strands, conflicts: Conflicts, held: Collection[int]) -> Spans:
    """Return the spans of conflicts, strand ends and stop lines.

    Args:
        strands: The strands.
        conflicts: The conflicts between them.
        held: The lanes that begin at a signal or a stop sign.

    Returns:
        The spans.
    """
    spans = Spans(strands.all)
    owner = np.concatenate([conflicts.a, conflicts.b])
    station = np.concatenate([conflicts.sa, conflicts.sb])
    for strand in strands.all:
        if strand.bike:
            continue
        least = MIN_TURNING_EDGE_LENGTH_M if strand.turning else MIN_EDGE_LENGTH_M
        for a, b in _runs(np.sort(station[owner == strand.number]), least):
            start = 0.0 if a < CUT_SNAP_DISTANCE_M and strand.entries else a - 0.5
            end = strand.length if b > strand.length - CUT_SNAP_DISTANCE_M and strand.exits else b + 0.5
            spans.add(strand.number, start, end)
        if strand.entries:
            spans.add(strand.number, 0.0, HALF_CUT_LENGTH_M)
        if strand.exits:
            spans.add(strand.number, strand.length - HALF_CUT_LENGTH_M, strand.length)
    for lane in held:
        number, run = strands.of_lane[lane][0]
        start = run.start
        ends = [a for a, _ in spans.of[number] if start <= a < start + STOP_LINE_REACH_M]
        ends += [b for _, b in spans.of[number] if start - CUT_SNAP_DISTANCE_M < b <= start]
        nearest = min(ends, key=lambda end: abs(end - start), default=start)
        if not spans.covers(number, start - HALF_CUT_LENGTH_M, start + HALF_CUT_LENGTH_M, HALF_CUT_LENGTH_M):
            spans.add(number, min(start, nearest) - HALF_CUT_LENGTH_M, max(start, nearest) + HALF_CUT_LENGTH_M)
    return spans


def _runs(stations: np.ndarray, gap: float) -> Iterable[Span]:
    """Group sorted stations that are at most ``gap`` [m] apart."""
    if not len(stations):
        return []
    breaks = np.flatnonzero(np.diff(stations) > gap)
    starts, ends = np.concatenate([[0], breaks + 1]), np.concatenate([breaks, [len(stations) - 1]])
    return [(float(stations[a]), float(stations[b])) for a, b in zip(starts, ends, strict=True)]


def grow(spans: Spans, besides: list[Beside]) -> None:
    """Carry spans to neighbouring lanes and join spans that are too near, until nothing changes.

    At most ``MAX_CUTTING_ROUNDS`` rounds are made.

    Args:
        spans: The spans, which are changed.
        besides: The pairs of strands beside each other.
    """
    for _ in range(MAX_CUTTING_ROUNDS):
        changed = False
        for beside in besides:
            changed |= _carry(spans, beside.right, beside.left, beside.right_at, beside.left_at)
            changed |= _carry(spans, beside.left, beside.right, beside.left_at, beside.right_at)
        for strand in spans.strands:
            changed |= _join(spans, strand)
        if not changed:
            return


def _carry(spans: Spans, source: int, target: int, at: np.ndarray, there: np.ndarray) -> bool:
    """Carry spans and cuts of ``source`` to ``target`` where both run beside each other, and cut at the ends of that
    range.
    """
    changed = False
    length = spans.strands[target].length
    for end in (there[0], there[-1]):
        if CUT_SNAP_DISTANCE_M < end < length - CUT_SNAP_DISTANCE_M and not spans.covers(
            target, end - HALF_CUT_LENGTH_M, end + HALF_CUT_LENGTH_M, CUT_SNAP_DISTANCE_M
        ):
            changed |= spans.add(target, float(end) - HALF_CUT_LENGTH_M, float(end) + HALF_CUT_LENGTH_M)
    for a, b in spans.of[source]:
        start, end = max(a, at[0]), min(b, at[-1])
        if end < start:
            continue
        low, high = (float(v) for v in np.interp([start, end], at, there))
        if b - a > 4 * HALF_CUT_LENGTH_M:
            if high - low > 2 * HALF_CUT_LENGTH_M and not spans.covers(target, low, high, SPAN_TOLERANCE_M):
                changed |= spans.add(target, low, high)
        elif not spans.covers(target, low, high, CUT_SNAP_DISTANCE_M):
            changed |= spans.add(target, low, max(high, low + 2 * HALF_CUT_LENGTH_M))
    return changed


def _join(spans: Spans, strand: Strand) -> bool:
    """Turn stretches that are too short for an edge into junction, except at a strand's end without a continuation."""
    least = MIN_TURNING_EDGE_LENGTH_M if strand.turning else MIN_EDGE_LENGTH_M
    changed = False
    for a, b in spans.stretches(strand.number):
        loose = (a == 0.0 and not strand.entries) or (b == strand.length and not strand.exits)
        if b - a < least and not loose and not strand.bike:
            changed |= spans.add(strand.number, a, b)
    return changed
