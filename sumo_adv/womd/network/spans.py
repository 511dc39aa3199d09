"""Spans of a strand that lie inside junctions, and how spans grow so that lanes beside one another are cut alike."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.womd.network.lanes import KeptLane
from sumo_adv.womd.network.strands import Strands

MIN_BESIDE = 5.0  # m, lanes beside one another for less are not a row


_Range = tuple[float, float, float, float]  # from and to on one strand, from and to on the other [m]


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
    return [made for key, rows in sorted(ranges.items()) for made in _runs(key, rows)]


def _pieces(
    strands: Strands, lane: int, own: Floats, neighbour: int, there: Floats
) -> Iterator[tuple[int, int, _Range]]:
    """A range of a lane beside a range of another, as ranges of their strands (which may change on the way)."""
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
    last = len(lane.index) - 1
    return lane.index[[min(max(start, 0), last), min(max(end, 0), last)]]


def _runs(key: tuple[int, int], rows: list[_Range]) -> Iterator[Beside]:
    """Ranges that touch or overlap put together."""
    run: list[_Range] = []
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


def _beside(key: tuple[int, int], run: list[_Range]) -> Iterator[Beside]:
    if run and run[-1][1] - run[0][0] >= MIN_BESIDE and run[-1][3] - run[0][2] >= MIN_BESIDE:
        right = np.maximum.accumulate([v for row in run for v in row[:2]])
        left = np.maximum.accumulate([v for row in run for v in row[2:]])
        yield Beside(*key, right, left)
