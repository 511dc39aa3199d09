"""Lay out a network, until no edge begins and ends in the same junction.

Edges are stretches of strands beside each other. Junctions are what is connected through spans, conflicts and ends of
edges. Ways lead through the junctions.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sumo_adv.datatypes import Floats, Ints
from sumo_adv.womd.lines import at
from sumo_adv.womd.network.cutting import (
    HALF_CUT_LENGTH_M,
    MIN_EDGE_LENGTH_M,
    Beside,
    Conflicts,
    Spans,
    find_beside,
    find_conflicts,
    first_spans,
    grow,
)
from sumo_adv.womd.network.strands import KeptLane, Strands, make_strands

MIN_BESIDE_SHARE = 0.55  # minimum share of both stretches that must be beside each other
MAX_RAGGED_ENDS_M = 9.0  # by which the ends of an edge's lanes may differ along the road
MAX_LANE_SPACING_M = 7.0  # between the centres of neighbouring lanes
MAX_WAYS = 200  # maximum number of ways that are examined from one stretch
MAX_SPANS_PER_WAY = 12  # maximum number of spans in one way
MAX_LAYOUT_TRIES = 12
Leg = tuple[int, int]  # strand, index of its span


@dataclass(frozen=True, slots=True)
class StrandStretch:
    """A part of a strand that becomes one lane of an edge.

    Attributes:
        strand: The number of the strand.
        start: The station at which the part begins [m].
        end: The station at which it ends [m].
    """

    strand: int
    start: float
    end: float


Row = tuple[StrandStretch, ...]  # an edge's lanes from right to left


def _make_rows(spans: Spans, besides: list[Beside]) -> list[Row]:
    """Group all stretches into rows."""
    stretches = [StrandStretch(s.number, a, b) for s in spans.strands for a, b in spans.stretches(s.number)]
    of_strand: dict[int, list[StrandStretch]] = {}
    for stretch in stretches:
        of_strand.setdefault(stretch.strand, []).append(stretch)
    offers = []
    for beside in besides:
        for right in of_strand.get(beside.right, []):
            for left in of_strand.get(beside.left, []):
                share = _share(spans, beside, right, left)
                if share >= MIN_BESIDE_SHARE:
                    offers.append((-share, right, left))
    left_of: dict[StrandStretch, StrandStretch] = {}
    right_of: dict[StrandStretch, StrandStretch] = {}
    for _, right, left in sorted(offers, key=lambda o: (o[0], o[1].strand, o[1].start, o[2].strand)):
        if right not in left_of and left not in right_of and not _reaches(left_of, left, right):
            left_of[right], right_of[left] = left, right
    rows = []
    for stretch in stretches:
        if stretch not in right_of:
            row = [stretch]
            while row[-1] in left_of:
                row.append(left_of[row[-1]])
            rows.append(tuple(row))
    return rows


def _reaches(left_of: dict[StrandStretch, StrandStretch], start: StrandStretch, goal: StrandStretch) -> bool:
    """Return whether going left from ``start`` leads to ``goal``."""
    while start in left_of:
        start = left_of[start]
        if start == goal:
            return True
    return False


def _share(spans: Spans, beside: Beside, right: StrandStretch, left: StrandStretch) -> float:
    """Return the share of both stretches that is beside the other; 0 if their ends do not match."""
    start, end = max(right.start, beside.right_at[0]), min(right.end, beside.right_at[-1])
    if end <= start:
        return 0.0
    a, b = (float(v) for v in np.interp([start, end], beside.right_at, beside.left_at))
    common = min(b, left.end) - max(a, left.start)
    share = min(common / (right.end - right.start), common / (left.end - left.start))
    if share < MIN_BESIDE_SHARE:
        return 0.0
    there = np.interp([right.start, right.end], beside.right_at, beside.left_at)
    there[0] -= max(0.0, beside.right_at[0] - right.start)
    there[1] += max(0.0, right.end - beside.right_at[-1])
    if abs(there[0] - left.start) > MAX_RAGGED_ENDS_M or abs(there[1] - left.end) > MAX_RAGGED_ENDS_M:
        return 0.0
    strands = spans.strands
    middle = (max(a, left.start) + min(b, left.end)) / 2
    across = float(np.interp(middle, beside.left_at, beside.right_at))
    p = at(strands[left.strand].points, strands[left.strand].along, middle)
    q = at(strands[right.strand].points, strands[right.strand].along, across)
    return share if np.hypot(*(p - q)[:2]) < MAX_LANE_SPACING_M else 0.0


def _join_up(spans: Spans, rows: list[Row], conflicts: Conflicts) -> list[int]:
    """Return the number of the junction at the start (2 n) and at the end (2 n + 1) of each row."""
    keys = [(s, k) for s, strand_spans in enumerate(spans.of) for k in range(len(strand_spans))]
    span_id = {key: 2 * len(rows) + n for n, key in enumerate(keys)}
    pairs: list[tuple[int, int]] = []
    row_of: dict[StrandStretch, int] = {stretch: n for n, row in enumerate(rows) for stretch in row}
    first, last = {}, {}
    for strand in spans.strands:
        parts = [(a, span_id[strand.number, k], span_id[strand.number, k])
                 for k, (a, _) in enumerate(spans.of[strand.number])]  # fmt: skip
        for a, b in spans.stretches(strand.number):
            row = row_of[StrandStretch(strand.number, a, b)]
            parts.append((a, 2 * row, 2 * row + 1))
        parts.sort()
        pairs += [(before, after) for (_, _, before), (_, after, _) in pairwise(parts)]
        first[strand.number], last[strand.number] = parts[0][1], parts[-1][2]
    pairs += [(last[strand.number], first[follower]) for strand in spans.strands for follower in strand.exits]
    near = np.stack([
        _spans_at(spans, span_id, conflicts.a, conflicts.sa), _spans_at(spans, span_id, conflicts.b, conflicts.sb)
    ], axis=1)  # fmt: skip
    ends = np.concatenate([np.array(pairs, int).reshape(-1, 2), near[(near >= 0).all(axis=1)]])
    size = 2 * len(rows) + len(keys)
    graph = coo_array((np.ones(len(ends)), ends.T), shape=(size, size))
    return list(map(int, connected_components(graph, directed=False)[1]))


def _spans_at(spans: Spans, span_id: dict[tuple[int, int], int], owner: Ints, station: Floats) -> Ints:
    """Return the numbers of the spans that contain places on strands; -1 for none."""
    span_ids = np.full(len(owner), -1)
    for s, row in enumerate(spans.of):
        on_strand = np.flatnonzero(owner == s)
        if len(on_strand) and row:
            starts, ends = np.array(row).T
            k = np.searchsorted(starts, station[on_strand] + 1e-6) - 1
            inside = (k >= 0) & (station[on_strand] <= ends[np.maximum(k, 0)] + 1e-6)
            span_ids[on_strand[inside]] = span_id[s, 0] + k[inside]
    return span_ids


@dataclass(frozen=True, slots=True)
class ConnectionPath:
    """A connection between two stretches.

    Attributes:
        source: The stretch that it leaves.
        target: The stretch that it reaches.
        legs: The spans between.
        length: Its length [m].
    """

    source: StrandStretch
    target: StrandStretch
    legs: tuple[Leg, ...]
    length: float


def _find_ways(spans: Spans) -> list[ConnectionPath]:
    """Return the shortest way for each pair of stretches."""
    starts = {(s.number, a): StrandStretch(s.number, a, b) for s in spans.strands for a, b in spans.stretches(s.number)}
    kept: dict[tuple[StrandStretch, StrandStretch], ConnectionPath] = {}
    for stretch in starts.values():
        for way in _from(spans, stretch, starts):
            pair = way.source, way.target
            if pair not in kept or way.length < kept[pair].length:
                kept[pair] = way
    return list(kept.values())


def _from(
    spans: Spans, source: StrandStretch, starts: dict[tuple[int, float], StrandStretch]
) -> Iterator[ConnectionPath]:
    """Yield the ways from the end of ``source``, depth first."""
    stack: list[tuple[int, float, tuple[Leg, ...], float]] = [(source.strand, source.end, (), 0.0)]
    count = 0
    while stack and count < MAX_WAYS:
        strand, station, legs, length = stack.pop()
        at_end = station >= spans.strands[strand].length - 1e-9
        follow = [(e, 0.0) for e in spans.strands[strand].exits] if at_end else [(strand, station)]
        for number, start in follow:
            k = next((k for k, (a, _) in enumerate(spans.of[number]) if abs(a - start) < 1e-9), None)
            if k is None:
                if (number, start) in starts:
                    count += 1
                    yield ConnectionPath(source, starts[number, start], legs, length)
            elif (number, k) not in legs and len(legs) < MAX_SPANS_PER_WAY:
                a, b = spans.of[number][k]
                stack.append((number, b, (*legs, (number, k)), length + b - a))


@dataclass(frozen=True, slots=True)
class Layout:
    """A network without right of way.

    Attributes:
        strands: The strands.
        spans: The spans inside junctions.
        rows: The edges.
        junctions: The numbers of the junctions at the start (2 n) and end (2 n + 1) of each edge.
        ways: The connections.
    """

    strands: Strands
    spans: Spans
    rows: list[Row]
    junctions: list[int]
    ways: list[ConnectionPath]


def make_layout(lanes: dict[int, KeptLane], held: Collection[int]) -> Layout:
    """Lay out a network.

    Args:
        lanes: The lanes by id.
        held: The lanes that begin at a signal or a stop sign.

    Returns:
        The layout.
    """
    strands = make_strands(lanes, held)
    conflicts = find_conflicts(strands.all)
    spans = first_spans(strands, conflicts, held)
    besides = find_beside(lanes, strands)
    for _ in range(MAX_LAYOUT_TRIES):
        grow(spans, besides)
        rows = _make_rows(spans, besides)
        junctions = _join_up(spans, rows, conflicts)
        changed = False
        for row, start, end in zip(rows, junctions[::2], junctions[1::2], strict=False):
            for stretch in row if start == end else ():
                middle = (stretch.start + stretch.end) / 2
                if stretch.end - stretch.start > 2 * MIN_EDGE_LENGTH_M + 2 * HALF_CUT_LENGTH_M:
                    changed |= spans.add(stretch.strand, middle - HALF_CUT_LENGTH_M, middle + HALF_CUT_LENGTH_M)
                else:
                    changed |= spans.add(stretch.strand, stretch.start, stretch.end)
        if not changed:
            break
    return Layout(strands, spans, rows, junctions, _find_ways(spans))
