"""The layout of a network, edges and junctions, settled until no edge begins and ends in one junction."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from sumo_adv.womd.network.conflicts import Conflicts, find_conflicts
from sumo_adv.womd.network.cutting import CUT, MIN_EDGE, Spans, first_spans, grow
from sumo_adv.womd.network.lanes import KeptLane
from sumo_adv.womd.network.nodes import MAX_TRIES, Nodes, make_nodes
from sumo_adv.womd.network.paths import Way, find_ways
from sumo_adv.womd.network.rows import Row, make_rows
from sumo_adv.womd.network.spans import Beside, find_beside
from sumo_adv.womd.network.strands import Strands, make_strands


@dataclass(frozen=True, slots=True)
class Layout:
    """Everything about a network but right of way: strands, spans inside junctions, edges (rows), junctions, ways."""

    strands: Strands
    spans: Spans
    besides: tuple[Beside, ...]
    conflicts: Conflicts
    rows: tuple[Row, ...]
    nodes: Nodes
    ways: tuple[Way, ...]
    lost: tuple[Way, ...]
    loops: int  # edges that became junction because they began and ended in one


def make_layout(lanes: dict[int, KeptLane], held: Collection[int]) -> Layout:
    """Lay the network out; ``held``: lanes that begin at a signal or a stop sign."""
    strands = make_strands(lanes, held)
    conflicts = find_conflicts(strands.all)
    spans = first_spans(strands, conflicts, held)
    besides = find_beside(lanes, strands)
    loops = 0
    for _ in range(MAX_TRIES):
        grow(spans, besides)
        rows = make_rows(spans, besides)
        nodes = make_nodes(spans, rows, conflicts)
        again = [n for n in range(len(rows)) if nodes.start[n] == nodes.end[n]]
        changed = False
        for n in again:
            for stretch in rows[n]:
                middle = (stretch.start + stretch.end) / 2
                if stretch.end - stretch.start > 2 * MIN_EDGE + 2 * CUT:
                    changed |= spans.add(stretch.strand, middle - CUT, middle + CUT)
                else:
                    changed |= spans.add(stretch.strand, stretch.start, stretch.end)
        loops += len(again)
        if not changed:
            break
    ways, lost = find_ways(spans)
    return Layout(strands, spans, tuple(besides), conflicts, tuple(rows), nodes, tuple(ways), tuple(lost), loops)
