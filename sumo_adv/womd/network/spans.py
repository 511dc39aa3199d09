"""Spans of a strand that lie inside junctions, and how spans grow so that lanes beside one another are cut alike."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.womd.network.lanes import KeptLane
from sumo_adv.womd.network.strands import Strands

MIN_BESIDE = 5.0  # m, lanes beside one another for less are not a row


@dataclass(frozen=True, slots=True)
class Beside:
    """Strand ``left`` runs at the left of ``right`` from station right_at[0] to right_at[-1] [m]; left_at: the same
    places on ``left``. Both ``(n,)``, rising."""

    right: int
    left: int
    right_at: Floats
    left_at: Floats


def find_beside(lanes: dict[int, KeptLane], strands: Strands) -> list[Beside]:
    """All pairs of strands beside one another, from the neighbours of their lanes."""
    found: dict[tuple[int, int], list[tuple[float, float, float, float]]] = {}
    for number, lane in lanes.items():
        own, offset = strands.of_lane[number]
        for neighbours, is_left in ((lane.feature.left, True), (lane.feature.right, False)):
            for n in neighbours:
                if n.lane not in lanes or strands.of_lane[n.lane][0] == own:
                    continue
                other, shift = strands.of_lane[n.lane]
                a = offset + _stations(lane, n.own_start, n.own_end)
                b = shift + _stations(lanes[n.lane], n.other_start, n.other_end)
                if a[1] - a[0] <= 0 or b[1] - b[0] <= 0:
                    continue
                key, row = ((own, other), (*a, *b)) if is_left else ((other, own), (*b, *a))
                found.setdefault(key, []).append((float(row[0]), float(row[1]), float(row[2]), float(row[3])))
    return [made for key, rows in sorted(found.items()) for made in _runs(key, rows)]


def _stations(lane: KeptLane, start: int, end: int) -> Floats:
    last = len(lane.index) - 1
    return lane.index[[min(max(start, 0), last), min(max(end, 0), last)]]


def _runs(key: tuple[int, int], rows: list[tuple[float, float, float, float]]) -> Iterator[Beside]:
    """Ranges that touch or overlap put together."""
    run: list[tuple[float, float, float, float]] = []
    for row in sorted(rows):
        if run and (row[0] > run[-1][1] + MIN_BESIDE or row[2] < run[-1][2] or row[2] > run[-1][3] + MIN_BESIDE):
            yield from _beside(key, run)
            run = []
        if run and row[0] < run[-1][1] - 0.1:  # the same range, told by the other lane
            if row[1] > run[-1][1] + 0.1 and row[3] > run[-1][3] + 0.1:
                run[-1] = (run[-1][0], row[1], run[-1][2], row[3])
            continue
        run.append(row)
    yield from _beside(key, run)


def _beside(key: tuple[int, int], run: list[tuple[float, float, float, float]]) -> Iterator[Beside]:
    if run and run[-1][1] - run[0][0] >= MIN_BESIDE and run[-1][3] - run[0][2] >= MIN_BESIDE:
        right = np.maximum.accumulate([v for row in run for v in row[:2]])
        left = np.maximum.accumulate([v for row in run for v in row[2:]])
        yield Beside(*key, right, left)
