"""Convert the map of a Waymo record to a SUMO network."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sumo_adv.errors import UsageError
from sumo_adv.files import write_whole
from sumo_adv.simulation.programs import find_netconvert
from sumo_adv.simulation.scenario import NETWORK_FILE
from sumo_adv.womd.network.finish import finish_network, run_netconvert, write_plain
from sumo_adv.womd.network.ground import drivable_ground
from sumo_adv.womd.network.layout import Layout, Leg, StrandStretch, make_layout
from sumo_adv.womd.network.right_of_way import LinkPriorities, bend_together, find_foes, settle
from sumo_adv.womd.network.roads import RoadNetwork, find_widths, make_roads
from sumo_adv.womd.network.signals import SignalPlan, plan_signals, ruling_lanes
from sumo_adv.womd.network.strands import Kept, KeptLane, LaneRun, keep_lanes
from sumo_adv.womd.record import Record

MIN_REPORTED_PART_M = 0.01  # shorter parts are not reported


@dataclass(frozen=True, slots=True)
class LanePiece:
    """A part of a WOMD lane in the SUMO network.

    Attributes:
        sumo_lane: The id of the SUMO lane.
        start: The station on the WOMD lane at which the part begins [m].
        end: The station at which it ends [m].
        internal: Whether the SUMO lane lies in a junction.
    """

    sumo_lane: str
    start: float
    end: float
    internal: bool


@dataclass(frozen=True, slots=True)
class ConvertedNetwork:
    """The network of a record.

    Attributes:
        path: The net.xml.
        pieces: The pieces of each WOMD lane by its id, in order along the lane.
        report: What was kept, dropped and assumed.
        seconds: How long the conversion took [s].
    """

    path: Path
    pieces: Mapping[int, tuple[LanePiece, ...]]
    report: dict[str, Any]
    seconds: float


def convert_network(record: Record, folder: Path) -> ConvertedNetwork:
    """Write ``folder/network.net.xml`` from a record's map. No other file is written there.

    Args:
        record: The record.
        folder: Where the network is written.

    Returns:
        The network.

    Raises:
        UsageError: The record has no lane from which a road can be made; netconvert is missing or fails.
    """
    began = time.perf_counter()
    program = find_netconvert()
    kept = keep_lanes(record)
    if not kept.lanes:
        raise UsageError(f"Record {record.scenario_id} has no lane of two points or more: no network can be made.")
    signalled = {state.lane for step in record.signals for state in step}
    stops = {lane for sign in record.stop_signs for lane in sign.lanes}
    layout = make_layout(kept.lanes, sorted(lane for lane in signalled | stops if lane in kept.lanes))
    widths = find_widths(layout.strands.all, layout.rows, record.lines.values())
    roads = make_roads(layout, widths)
    foes = find_foes(roads.links)
    roads = replace(roads, links=bend_together(roads.links, foes))
    rulers = ruling_lanes(record, roads.links, foes, stops)
    order = settle(roads.links, roads.edges, foes, stops, rulers)
    signals = plan_signals(record, roads.links, rulers, order)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="womd-") as name:
        work = Path(name)
        write_plain(roads, work)
        run_netconvert(program, work, work / "raw.net.xml")
        via = finish_network(
            work / "raw.net.xml", work / NETWORK_FILE, roads, order, signals.programs, drivable_ground(record, roads)
        )
        write_whole(folder / NETWORK_FILE, lambda part: shutil.copyfile(work / NETWORK_FILE, part))
    pieces = _find_pieces(kept.lanes, layout, roads, via)
    report = _report(kept, layout, roads, order, signals)
    report["crosswalks"] = sum(area.kind == "crosswalk" for area in record.areas)
    return ConvertedNetwork(folder / NETWORK_FILE, pieces, report, time.perf_counter() - began)


def _report(
    kept: Kept, layout: Layout, roads: RoadNetwork, order: LinkPriorities, signals: SignalPlan
) -> dict[str, Any]:
    """Return what was kept, dropped and assumed, for JSON; lengths in m."""
    total = sum(lane.length for lane in kept.lanes.values())
    inside = sum(b - a for strand_spans in layout.spans.of for a, b in strand_spans)
    kinds = ["traffic_light" if name in signals.programs else kind for name, kind in order.kind.items()]
    return {
        "dropped_lanes": [[number, reason] for number, reason in sorted(kept.dropped.items())],
        "lane_length": round(total, 2),
        "junction_share": round(inside / total, 4) if total else 0.0,
        "lanes_made": sum(len(edge.lanes) for edge in roads.edges.values()),
        "connections_with_a_gap": [list(pair) for pair in kept.gaps],
        "speeds_assumed": kept.assumed_speeds,
        "junctions": dict(sorted(Counter(kinds).items())),
        "signals_unknown": signals.unknown,
        "signals_witnessed": signals.witnessed,
        "signals_assumed": signals.assumed,
    }


def _find_pieces(
    lanes: dict[int, KeptLane], layout: Layout, roads: RoadNetwork, via: list[str]
) -> dict[int, tuple[LanePiece, ...]]:
    """Return the pieces of every kept lane.

    If several links of a junction run over a lane, there is a piece for each, the straightest first.
    """
    inner: dict[Leg, list[tuple[float, str]]] = {}
    for link, internal_lane in zip(roads.links, via, strict=True):
        for leg in link.legs:
            inner.setdefault(leg, []).append((abs(link.turn), internal_lane))

    def parts(strand: int) -> list[tuple[float, float, float, str, bool]]:
        made: list[tuple[float, float, float, str, bool]] = []
        for k, (a, b) in enumerate(layout.spans.of[strand]):
            made += [(a, b, turn, name, True) for turn, name in inner.get((strand, k), [])]
        for a, b in layout.spans.stretches(strand):
            edge, index = roads.place[StrandStretch(strand, a, b)]
            made.append((a, b, 0.0, f"{edge}_{index}", False))
        return sorted(made)

    of_strand = [parts(strand.number) for strand in layout.strands.all]
    return {
        number: tuple(piece for strand, run in layout.strands.of_lane[number] for piece in _on(run, of_strand[strand]))
        for number in lanes
    }


def _on(run: LaneRun, parts: list[tuple[float, float, float, str, bool]]) -> Iterator[LanePiece]:
    """Yield the pieces of one run of a lane.

    Args:
        run: The run.
        parts: The parts of its strand in order: start, end, turn, SUMO lane, internal.
    """
    scale = (run.lane_end - run.lane_start) / max(run.end - run.start, 1e-9)
    for a, b, _, name, internal in parts:
        start, end = max(a, run.start), min(b, run.end)
        if end - start > MIN_REPORTED_PART_M:
            low, high = (run.lane_start + scale * (v - run.start) for v in (start, end))
            yield LanePiece(name, low, high, internal)
