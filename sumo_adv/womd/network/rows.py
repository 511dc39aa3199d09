"""Edges: stretches of strands beside one another, from junction to junction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sumo_adv.womd.network.cutting import Spans
from sumo_adv.womd.network.polyline import at
from sumo_adv.womd.network.spans import Beside

MIN_SHARE = 0.55  # of both stretches that must be beside one another
MAX_RAGGED = 9.0  # m by which the ends of lanes of an edge may differ along the road
MAX_SPACING = 7.0  # m between centres of lanes beside one another


@dataclass(frozen=True, slots=True)
class Stretch:
    """A part of a strand that becomes one lane of an edge, from ``start`` to ``end`` [m]."""

    strand: int
    start: float
    end: float


Row = tuple[Stretch, ...]  # an edge's lanes from right to left


def make_rows(spans: Spans, besides: list[Beside]) -> list[Row]:
    """Group all stretches into rows."""
    stretches = [Stretch(s.number, a, b) for s in spans.strands for a, b in spans.stretches(s.number)]
    of_strand: dict[int, list[Stretch]] = {}
    for stretch in stretches:
        of_strand.setdefault(stretch.strand, []).append(stretch)
    offers = []
    for beside in besides:
        for right in of_strand.get(beside.right, []):
            for left in of_strand.get(beside.left, []):
                share = _share(spans, beside, right, left)
                if share >= MIN_SHARE:
                    offers.append((-share, right, left))
    left_of: dict[Stretch, Stretch] = {}
    right_of: dict[Stretch, Stretch] = {}
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


def _reaches(left_of: dict[Stretch, Stretch], start: Stretch, goal: Stretch) -> bool:
    """Whether going left from ``start`` comes to ``goal``."""
    while start in left_of:
        start = left_of[start]
        if start == goal:
            return True
    return False


def _share(spans: Spans, beside: Beside, right: Stretch, left: Stretch) -> float:
    """How much of both is beside the other, 0 where their ends do not match."""
    start, end = max(right.start, beside.right_at[0]), min(right.end, beside.right_at[-1])
    if end <= start:
        return 0.0
    a, b = (float(v) for v in np.interp([start, end], beside.right_at, beside.left_at))
    common = min(b, left.end) - max(a, left.start)
    share = min(common / (right.end - right.start), common / (left.end - left.start))
    if share < MIN_SHARE:
        return 0.0
    there = np.interp([right.start, right.end], beside.right_at, beside.left_at)
    there[0] -= max(0.0, beside.right_at[0] - right.start)
    there[1] += max(0.0, right.end - beside.right_at[-1])
    if abs(there[0] - left.start) > MAX_RAGGED or abs(there[1] - left.end) > MAX_RAGGED:
        return 0.0
    strands = spans.strands
    middle = (max(a, left.start) + min(b, left.end)) / 2
    across = float(np.interp(middle, beside.left_at, beside.right_at))
    p = at(strands[left.strand].points, strands[left.strand].along, middle)
    q = at(strands[right.strand].points, strands[right.strand].along, across)
    return share if np.hypot(*(p - q)[:2]) < MAX_SPACING else 0.0
