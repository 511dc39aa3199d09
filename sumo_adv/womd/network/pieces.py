"""Where each WOMD lane lies in the network."""

from __future__ import annotations

from dataclasses import dataclass

from sumo_adv.womd.network.lanes import KeptLane
from sumo_adv.womd.network.layout import Layout
from sumo_adv.womd.network.paths import Leg
from sumo_adv.womd.network.roads import Roads
from sumo_adv.womd.network.rows import Stretch

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
    found = {}
    for number, lane in lanes.items():
        strand, offset = layout.strands.of_lane[number]
        parts: list[tuple[float, float, float, str, bool]] = []
        for k, (a, b) in enumerate(layout.spans.of[strand]):
            parts += [(a, b, turn, name, True) for turn, name in inner.get((strand, k), [])]
        for a, b in layout.spans.stretches(strand):
            edge, index = roads.place[Stretch(strand, a, b)]
            parts.append((a, b, 0.0, f"{edge}_{index}", False))
        pieces = []
        for a, b, _, name, internal in sorted(parts):
            start, end = max(a - offset, 0.0), min(b - offset, lane.length)
            if end - start > SCRAP:
                pieces.append(Piece(name, start, end, internal))
        found[number] = tuple(pieces)
    return found
