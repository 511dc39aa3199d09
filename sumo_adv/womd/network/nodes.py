"""Junctions: what hangs together through spans, conflicts and the ends of edges."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sumo_adv.womd.network.conflicts import Conflicts
from sumo_adv.womd.network.cutting import Spans
from sumo_adv.womd.network.rows import Row, Stretch

MAX_TRIES = 12


@dataclass(frozen=True, slots=True)
class Nodes:
    """Numbers of junctions: of each row's start and end, and of each span as (strand, index)."""

    start: tuple[int, ...]
    end: tuple[int, ...]
    of_span: dict[tuple[int, int], int]


class _Union:
    def __init__(self, size: int) -> None:
        self.parent = list(range(size))

    def find(self, x: int) -> int:
        while self.parent[x] != x:
            self.parent[x] = self.parent[self.parent[x]]
            x = self.parent[x]
        return x

    def join(self, x: int, y: int) -> None:
        a, b = self.find(x), self.find(y)
        if a != b:
            self.parent[max(a, b)] = min(a, b)


def make_nodes(spans: Spans, rows: list[Row], conflicts: Conflicts) -> Nodes:
    """Union of all that belongs to one junction."""
    keys = [(s, k) for s, strand_spans in enumerate(spans.of) for k in range(len(strand_spans))]
    span_id = {key: 2 * len(rows) + n for n, key in enumerate(keys)}
    union = _Union(2 * len(rows) + len(keys))
    row_of: dict[Stretch, int] = {stretch: n for n, row in enumerate(rows) for stretch in row}
    first, last = {}, {}
    for strand in spans.strands:
        parts = [(a, span_id[strand.number, k], span_id[strand.number, k])
                 for k, (a, _) in enumerate(spans.of[strand.number])]  # fmt: skip
        for a, b in spans.stretches(strand.number):
            row = row_of[Stretch(strand.number, a, b)]
            parts.append((a, 2 * row, 2 * row + 1))
        parts.sort()
        for (_, _, before), (_, after, _) in pairwise(parts):
            union.join(before, after)
        first[strand.number], last[strand.number] = parts[0][1], parts[-1][2]
    for strand in spans.strands:
        for follower in strand.exits:
            union.join(last[strand.number], first[follower])
    _join_conflicts(spans, span_id, conflicts, union)
    names = {root: n for n, root in enumerate(sorted({union.find(x) for x in range(len(union.parent))}))}
    number = [names[union.find(x)] for x in range(len(union.parent))]
    return Nodes(
        tuple(number[2 * n] for n in range(len(rows))), tuple(number[2 * n + 1] for n in range(len(rows))),
        {key: number[n] for key, n in span_id.items()},
    )  # fmt: skip


def _join_conflicts(spans: Spans, span_id: dict[tuple[int, int], int], conflicts: Conflicts, union: _Union) -> None:
    def ids(owner: np.ndarray, station: np.ndarray) -> np.ndarray:
        span_ids = np.full(len(owner), -1)
        for s, row in enumerate(spans.of):
            on_strand = np.flatnonzero(owner == s)
            if not len(on_strand) or not row:
                continue
            starts = np.array([a for a, _ in row])
            ends = np.array([b for _, b in row])
            k = np.searchsorted(starts, station[on_strand] + 1e-6) - 1
            inside = (k >= 0) & (station[on_strand] <= ends[np.maximum(k, 0)] + 1e-6)
            base = span_id[s, 0]
            span_ids[on_strand[inside]] = base + k[inside]
        return span_ids

    pairs = np.stack([ids(conflicts.a, conflicts.sa), ids(conflicts.b, conflicts.sb)], axis=1)
    for a, b in np.unique(pairs[(pairs >= 0).all(axis=1)], axis=0):
        union.join(int(a), int(b))
