"""What the conversion kept, dropped and assumed, as plain values."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from sumo_adv.womd.network.lanes import Kept
from sumo_adv.womd.network.layout import Layout
from sumo_adv.womd.network.pieces import Piece
from sumo_adv.womd.network.right_of_way import RightOfWay
from sumo_adv.womd.network.roads import Roads
from sumo_adv.womd.network.signals import SignalPlan
from sumo_adv.womd.network.widths import Widths
from sumo_adv.womd.record import Record


def make_report(
    record: Record, kept: Kept, layout: Layout, roads: Roads, widths: Widths, order: RightOfWay, signals: SignalPlan,
    pieces: Mapping[int, tuple[Piece, ...]], via: list[str],
) -> dict[str, Any]:  # fmt: skip
    """JSON-ready. Lengths in m."""
    total = sum(lane.length for lane in kept.lanes.values())
    inside = sum(b - a for strand_spans in layout.spans.of for a, b in strand_spans)
    shown = sum(
        end - start for lane_pieces in pieces.values() for start, end in {(p.start, p.end) for p in lane_pieces}
    )
    connections = {(a, b) for a, lane in kept.lanes.items() for b in lane.exits}
    missing = _missing(connections, pieces, roads, via)
    kinds = ["traffic_light" if name in signals.programs else kind for name, kind in order.kind.items()]
    return {
        "lanes": len(record.lanes),
        "dropped_lanes": [[number, reason] for number, reason in sorted(kept.dropped.items())],
        "lane_length": round(total, 2),
        "lane_length_shown": round(shown, 2),
        "junction_share": round(inside / total, 4) if total else 0.0,
        "edges": len(roads.edges),
        "lanes_made": sum(len(edge.lanes) for edge in roads.edges.values()),
        "links": len(roads.links),
        "parallel_ways_lost": len(layout.lost),
        "edges_closed_in_a_junction": layout.loops,
        "connections_wanted": len(connections),
        "connections_kept": len(connections) - len(missing),
        "connections_missing": missing,
        "connections_with_a_gap": [list(pair) for pair in kept.gaps],
        "speeds_assumed": kept.assumed_speeds,
        "widths_from": widths.sources,
        "junctions": dict(sorted(Counter(kinds).items())),
        "signals_recorded": len(signals.recorded),
        "signals_mapped": len(signals.mapped),
        "signals_without_a_link": sorted(signals.recorded - set(signals.mapped)),
        "signals_unknown": len(signals.unknown),
        "signals_witnessed": signals.witnessed,
        "signals_completed": signals.completed,
        "signals_assumed": signals.assumed,
        "signal_junctions": len(signals.programs),
        "crosswalks": sum(area.kind == "crosswalk" for area in record.areas),
    }


def _missing(
    connections: Iterable[tuple[int, int]], pieces: Mapping[int, tuple[Piece, ...]], roads: Roads, via: list[str]
) -> list[list[int]]:
    """Pairs of lanes with ends that are neither on one SUMO lane nor joined by a link."""
    joined = set()
    for link, inner in zip(roads.links, via, strict=True):
        source, target = f"{link.source}_{link.from_lane}", f"{link.target}_{link.to_lane}"
        joined |= {(source, inner), (inner, target), (source, target)}

    def kept(a: int, b: int) -> bool:
        end = max((piece.end for piece in pieces[a]), default=0.0)
        start = min((piece.start for piece in pieces[b]), default=0.0)
        before = {piece.sumo_lane for piece in pieces[a] if piece.end > end - 0.02}
        after = {piece.sumo_lane for piece in pieces[b] if piece.start < start + 0.02}
        return bool(before & after) or any((x, y) in joined for x in before for y in after)

    return [[a, b] for a, b in sorted(connections) if not kept(a, b)]
