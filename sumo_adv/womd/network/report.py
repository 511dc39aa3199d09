"""What the conversion kept, dropped and assumed, as plain values."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from itertools import pairwise
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
    pieces: Mapping[int, tuple[Piece, ...]],
) -> dict[str, Any]:  # fmt: skip
    """JSON-ready. Lengths in m."""
    total = sum(lane.length for lane in kept.lanes.values())
    inside = sum(b - a for found in layout.spans.of for a, b in found)
    shown = sum(end - start for found in pieces.values() for start, end in {(p.start, p.end) for p in found})
    wanted = {(a, b) for a, lane in kept.lanes.items() for b in lane.exits}
    missing = sorted(wanted - _chained(layout, roads))
    areas = Counter(area.kind for area in record.areas)
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
        "connections_wanted": len(wanted),
        "connections_kept": len(wanted) - len(missing),
        "connections_missing": [list(pair) for pair in missing],
        "connections_with_a_gap": [list(pair) for pair in kept.gaps],
        "speeds_assumed": kept.assumed_speeds,
        "widths_from": widths.sources,
        "junctions": dict(sorted(Counter(order.kind.values()).items())),
        "signals_recorded": signals.recorded,
        "signals_mapped": len(signals.mapped),
        "signals_unknown": len(signals.unknown),
        "signals_completed": signals.completed,
        "signal_junctions": len(signals.programs),
        "crosswalks": areas["crosswalk"],
    }


def _chained(layout: Layout, roads: Roads) -> set[tuple[int, int]]:
    """Pairs of WOMD lanes that follow one another on a lane or a link of the network."""
    found: set[tuple[int, int]] = set()
    strands = layout.strands.all
    for link in roads.links:
        source = roads.edges[link.source].lanes[link.from_lane].stretch
        target = roads.edges[link.target].lanes[link.to_lane].stretch
        before = strands[source.strand].lanes_between(source.start, source.end)
        after = strands[target.strand].lanes_between(target.start, target.end)
        found |= set(pairwise([*before, *link.lanes, *after]))
    for edge in roads.edges.values():
        for lane in edge.lanes:
            on = lane.stretch
            found |= set(pairwise(strands[on.strand].lanes_between(on.start, on.end)))
    return found
