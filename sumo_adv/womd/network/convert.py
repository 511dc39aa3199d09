"""From a Waymo record to a SUMO network."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sumo_adv.errors import UsageError
from sumo_adv.simulation.programs import find_netconvert
from sumo_adv.womd.network.finish import finish
from sumo_adv.womd.network.foes import bend_together, find_foes
from sumo_adv.womd.network.ground import drivable_ground
from sumo_adv.womd.network.lanes import keep
from sumo_adv.womd.network.layout import make_layout
from sumo_adv.womd.network.netconvert import run_netconvert
from sumo_adv.womd.network.pieces import Piece, find_pieces
from sumo_adv.womd.network.plain import write_plain
from sumo_adv.womd.network.report import make_report
from sumo_adv.womd.network.right_of_way import settle
from sumo_adv.womd.network.roads import make_roads
from sumo_adv.womd.network.signals import plan_signals, ruling_lanes
from sumo_adv.womd.network.widths import find_widths
from sumo_adv.womd.record import Record

NAME = "network.net.xml"


@dataclass(frozen=True, slots=True)
class ConvertedNetwork:
    """A record's network. path: the net.xml; pieces: WOMD lane id -> where it lies in the network, in order along it;
    report: what was kept, dropped and assumed; seconds: how long it took."""

    path: Path
    pieces: Mapping[int, tuple[Piece, ...]]
    report: dict[str, Any]
    seconds: float


def convert_network(record: Record, folder: Path) -> ConvertedNetwork:
    """Write ``folder/network.net.xml`` (and nothing else there) from the record's map.

    Raises:
        UsageError: the record has no lane to make a road of; netconvert is missing or fails.
    """
    began = time.perf_counter()
    program = find_netconvert()
    kept = keep(record)
    if not kept.lanes:
        raise UsageError(f"Record {record.scenario_id} has no lane of two points or more: no network can be made.")
    signalled = {state.lane for step in record.signals for state in step}
    stops = {lane for sign in record.stop_signs for lane in sign.lanes}
    layout = make_layout(kept.lanes, sorted(lane for lane in signalled | stops if lane in kept.lanes))
    widths = find_widths(layout.strands.all, layout.rows, record.lines.values())
    roads = make_roads(layout, widths)
    foes = find_foes(roads.links)
    links, bent = bend_together(roads.links, foes)
    roads = replace(roads, links=links)
    rulers = ruling_lanes(record, roads.links, foes, stops)
    order = settle(roads.links, roads.edges, foes, stops, rulers)
    signals = plan_signals(record, roads.links, rulers, order)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="womd-") as name:
        work = Path(name)
        write_plain(roads, work)
        run_netconvert(program, work, work / "raw.net.xml")
        via = finish(work / "raw.net.xml", work / NAME, roads, order, signals.programs, drivable_ground(record, roads))
        unfinished = folder / f"{NAME}.part"
        shutil.copyfile(work / NAME, unfinished)
    path = unfinished.replace(folder / NAME)
    pieces = find_pieces(kept.lanes, layout, roads, via)
    report = make_report(record, kept, layout, roads, widths, order, signals, pieces, via)
    report["close_passes_bent"] = bent
    return ConvertedNetwork(path, pieces, report, time.perf_counter() - began)
