"""Which spans of each strand lie inside junctions; what is between them becomes edges.

Spans begin as conflicts and lane ends. They then grow until lanes beside one another are cut at the same places and no
scrap of edge is left between two spans.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np

from sumo_adv.womd.network.conflicts import Conflicts
from sumo_adv.womd.network.spans import Beside
from sumo_adv.womd.network.strands import Strand, Strands

CUT = 0.1  # m, half of the span where one edge is cut in two
SNAP = 6.0  # m, a cut this near to another is the same
ALIKE = 1.5  # m by which spans of lanes beside one another may differ
MIN_EDGE = 6.0  # m, shorter stretches between two spans join them
MIN_TURNING_EDGE = 25.0  # m, the same on lanes that turn in a junction
STOP_LINE = 15.0  # m that a span reaches back to the line where a signal or stop sign holds
STUB = 0.5  # m of edge kept where a strand begins or ends in a conflict and nothing leads there
ROUNDS = 12

Span = tuple[float, float]


class Spans:
    """Spans inside junctions: for each strand disjoint (start, end) [m] in order. ``add`` and ``join`` change them."""

    def __init__(self, strands: tuple[Strand, ...]) -> None:
        self.strands = strands
        self.of: list[list[Span]] = [[] for _ in strands]
        self.bounds = [_bounds(strand) for strand in strands]

    def add(self, strand: int, start: float, end: float) -> bool:
        """Make [start, end] a span, as far as the strand's stubs allow; whether that changed anything."""
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
        """Whether one span holds [start, end] but for ``slack`` metres at each end."""
        low, high = self.bounds[strand]
        start, end = max(start, low), min(end, high)
        return end <= start or any(a <= start + slack and b >= end - slack for a, b in self.of[strand])

    def stretches(self, strand: int) -> list[Span]:
        """What lies outside the spans, in order."""
        edges = [0.0, *(v for span in self.of[strand] for v in span), self.strands[strand].length]
        return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 1e-6]


def _bounds(strand: Strand) -> Span:
    stub = min(STUB, strand.length / 3)
    return 0.0 if strand.entries else stub, strand.length if strand.exits else strand.length - stub


def first_spans(strands: Strands, conflicts: Conflicts, held: Collection[int]) -> Spans:
    """Conflicts, ends of strands, and stop lines of the lanes ``held`` (by a signal or a stop sign)."""
    spans = Spans(strands.all)
    owner = np.concatenate([conflicts.a, conflicts.b])
    station = np.concatenate([conflicts.sa, conflicts.sb])
    for strand in strands.all:
        if strand.bike:
            continue
        least = MIN_TURNING_EDGE if strand.turning else MIN_EDGE
        for a, b in _runs(np.sort(station[owner == strand.number]), least):
            start = 0.0 if a < SNAP and strand.entries else a - 0.5
            end = strand.length if b > strand.length - SNAP and strand.exits else b + 0.5
            spans.add(strand.number, start, end)
        if strand.entries:
            spans.add(strand.number, 0.0, CUT)
        if strand.exits:
            spans.add(strand.number, strand.length - CUT, strand.length)
    for lane in held:
        number, start = strands.start_of(lane)
        ends = [a for a, _ in spans.of[number] if start <= a < start + STOP_LINE]
        ends += [b for _, b in spans.of[number] if start - SNAP < b <= start]
        nearest = min(ends, key=lambda end: abs(end - start), default=start)
        if not spans.covers(number, start - CUT, start + CUT, CUT):
            spans.add(number, min(start, nearest) - CUT, max(start, nearest) + CUT)
    return spans


def _runs(stations: np.ndarray, gap: float) -> Iterable[Span]:
    if not len(stations):
        return []
    breaks = np.flatnonzero(np.diff(stations) > gap)
    starts, ends = np.concatenate([[0], breaks + 1]), np.concatenate([breaks, [len(stations) - 1]])
    return [(float(stations[a]), float(stations[b])) for a, b in zip(starts, ends, strict=True)]


def grow(spans: Spans, besides: list[Beside]) -> None:
    """Carry spans across to the lanes beside and join what is too near, until nothing changes."""
    for _ in range(ROUNDS):
        changed = False
        for beside in besides:
            changed |= _carry(spans, beside.right, beside.left, beside.right_at, beside.left_at)
            changed |= _carry(spans, beside.left, beside.right, beside.left_at, beside.right_at)
        for strand in spans.strands:
            changed |= _join(spans, strand)
        if not changed:
            return


def _carry(spans: Spans, source: int, target: int, at: np.ndarray, there: np.ndarray) -> bool:
    """Spans and cuts of ``source``, where the two are beside one another, to ``target``; and the ends of the range."""
    changed = False
    length = spans.strands[target].length
    for end in (there[0], there[-1]):
        if SNAP < end < length - SNAP and not spans.covers(target, end - CUT, end + CUT, SNAP):
            changed |= spans.add(target, float(end) - CUT, float(end) + CUT)
    for a, b in spans.of[source]:
        start, end = max(a, at[0]), min(b, at[-1])
        if end < start:
            continue
        low, high = (float(v) for v in np.interp([start, end], at, there))
        if b - a > 4 * CUT:
            if high - low > 2 * CUT and not spans.covers(target, low, high, ALIKE):
                changed |= spans.add(target, low, high)
        elif not spans.covers(target, low, high, SNAP):
            changed |= spans.add(target, low, max(high, low + 2 * CUT))
    return changed


def _join(spans: Spans, strand: Strand) -> bool:
    """Turn stretches too short for an edge into junction, except where a strand begins or ends for good."""
    least = MIN_TURNING_EDGE if strand.turning else MIN_EDGE
    changed = False
    for a, b in spans.stretches(strand.number):
        loose = (a == 0.0 and not strand.entries) or (b == strand.length and not strand.exits)
        if b - a < least and not loose and not strand.bike:
            changed |= spans.add(strand.number, a, b)
    return changed
