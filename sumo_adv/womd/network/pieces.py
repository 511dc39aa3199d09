"""Where each WOMD lane lies in the network."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from sumo_adv.womd.network.lanes import KeptLane
from sumo_adv.womd.network.layout import Layout
from sumo_adv.womd.network.paths import Leg
from sumo_adv.womd.network.roads import Roads
from sumo_adv.womd.network.rows import Stretch
from sumo_adv.womd.network.strands import Run

SCRAP = 0.01  # m, shorter parts are not told


@dataclass(frozen=True, slots=True)
class Piece:
    """The part of a WOMD lane from station ``start`` to ``end`` [m] lies on ``sumo_lane``; internal: in a junction."""

    sumo_lane: str
    start: float
    end: float
    internal: bool


def find_pieces(
    lanes: dict[int, KeptLane], layout: Layout, roads: Roads, via: list[str]
) -> dict[int, tuple[Piece, ...]]:
    """The pieces of every kept lane. Where several links of a junction run over a lane there is a piece for each, the
    straightest first."""
    inner: dict[Leg, list[tuple[float, str]]] = {}
    for link, internal_lane in zip(roads.links, via, strict=True):
        for leg in link.legs:
            inner.setdefault(leg, []).append((abs(link.turn), internal_lane))

    def parts(strand: int) -> list[tuple[float, float, float, str, bool]]:
        made: list[tuple[float, float, float, str, bool]] = []
        for k, (a, b) in enumerate(layout.spans.of[strand]):
            made += [(a, b, turn, name, True) for turn, name in inner.get((strand, k), [])]
        for a, b in layout.spans.stretches(strand):
            edge, index = roads.place[Stretch(strand, a, b)]
            made.append((a, b, 0.0, f"{edge}_{index}", False))
        return sorted(made)

    of_strand = [parts(strand.number) for strand in layout.strands.all]
    of_lane = {}
    for number in lanes:
        pieces = [piece for strand, run in layout.strands.of_lane[number] for piece in _on(run, of_strand[strand])]
        of_lane[number] = tuple(pieces)
    return of_lane


def _on(run: Run, parts: list[tuple[float, float, float, str, bool]]) -> Iterator[Piece]:
    """The pieces of one run of a lane; parts: (start, end, turn, SUMO lane, internal) of its strand in order."""
    scale = (run.lane_end - run.lane_start) / max(run.end - run.start, 1e-9)
    for a, b, _, name, internal in parts:
        start, end = max(a, run.start), min(b, run.end)
        if end - start > SCRAP:
            low, high = (run.lane_start + scale * (v - run.start) for v in (start, end))
            yield Piece(name, low, high, internal)
