"""What a replay page paints on the road: lines by type, stop lines, and the traffic lights as they were recorded."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_samples import ROOT
from page_samples import make_run, manifest
from test_report_page import data_of

import sumo_adv
from sumo_adv.report.page import make_page
from sumo_adv.report.page_road import (
    DASHED,
    LINE_GIVE_WAY,
    LINE_LIGHT,
    LINE_STOP,
    SOLID,
    Changes,
    DrawnMarking,
    DrawnStopLine,
    lane_changes,
    lights_of,
    markings_of,
    stop_lines,
)
from sumo_adv.report.tables import write_signals
from sumo_adv.simulation.network import read_network
from sumo_adv.simulation.signals import read_signals
from sumo_adv.simulation.sumo_states import Snapshot

NETWORKS = ROOT / "networks"


def painted(network: str, changes: Changes | None = None) -> list[DrawnMarking]:
    return list(markings_of(read_network(NETWORKS / f"{network}.net.xml"), changes or {}))


def stops(network: str) -> list[DrawnStopLine]:
    return list(stop_lines(read_network(NETWORKS / f"{network}.net.xml")))


def offsets(markings: list[DrawnMarking]) -> list[tuple[float, int]]:
    """The lateral place of lines along a road that goes east [m], from right to left, and their kinds."""
    return sorted((round(float(m.line[0, 1]), 2), m.kind) for m in markings)


def test_three_lanes_have_two_dashed_lines_between_solid_edges() -> None:
    """Three lanes of 3.2 m around y = 0: lines between lanes at 1.6 m, edge lines 0.15 m inside of 4.8 m."""
    assert offsets(painted("straight_3lane")) == [(-4.65, SOLID), (-1.6, DASHED), (1.6, DASHED), (4.65, SOLID)]


def test_where_cars_may_not_change_lanes_the_line_is_solid() -> None:
    road = read_network(NETWORKS / "straight_3lane.net.xml")
    right = next(lane.id for lane in road.lanes.values() if lane.index == 0)
    kinds = [kind for _, kind in offsets(painted("straight_3lane", {right: (False, True)}))]
    assert kinds == [SOLID, SOLID, DASHED, SOLID]


def test_permissions_are_read_from_the_network(tmp_path: Path) -> None:
    text = (NETWORKS / "straight_3lane.net.xml").read_text()
    road = read_network(NETWORKS / "straight_3lane.net.xml")
    right, middle, _ = (lane.id for lane in road.lanes.values())
    text = text.replace(f'<lane id="{right}"', f'<lane id="{right}" changeLeft="emergency authority"')
    text = text.replace(f'<lane id="{middle}"', f'<lane id="{middle}" changeRight="bus passenger"')
    (tmp_path / "no_change.net.xml").write_text(text)
    assert lane_changes(tmp_path / "no_change.net.xml") == {right: (False, True), middle: (True, True)}
    assert lane_changes(NETWORKS / "straight_3lane.net.xml") == {}


@pytest.mark.parametrize(
    ("network", "kinds"),
    [
        ("straight_3lane", set()),
        ("allway_stop", {LINE_STOP}),
        ("rural_crossing", {LINE_GIVE_WAY}),  # the minor road alone
        ("signalised_crossing", {LINE_LIGHT}),
    ],
)
def test_lines_across_lanes(network: str, kinds: set[int]) -> None:
    assert {stop.kind for stop in stops(network)} == kinds


def test_a_stop_line_lies_across_the_end_of_its_lane() -> None:
    road = read_network(NETWORKS / "allway_stop.net.xml")
    ends = [lane for lane in road.lanes.values() if lane.connections and not lane.internal]
    assert len(stops("allway_stop")) == len(ends) == 4
    for stop in stops("allway_stop"):
        lane = min(ends, key=lambda each: float(np.hypot(*(each.shape[-1] - stop.line.mean(axis=0)))))
        # 0.4 m before the end; 0.1 m narrower than the lane on each side
        assert np.hypot(*(stop.line.mean(axis=0) - lane.shape[-1])) == pytest.approx(0.4)
        assert np.hypot(*(stop.line[1] - stop.line[0])) == pytest.approx(lane.width - 0.2)


def test_a_light_names_the_connections_of_its_lane() -> None:
    stop_lines = stops("signalised_crossing")
    assert lights_of(stop_lines) == ["centre"] and len(stop_lines) == 8  # four arms of two lanes
    links = sorted(k for stop in stop_lines for k in stop.links)
    assert links == sorted(set(links)) and set(links) <= set(range(16))


def test_what_the_lights_showed_is_recorded_and_drawn(tmp_path: Path) -> None:
    result = sumo_adv.run(
        "signals_red_light", attempts=1, proposals=24, learn="off", memory=tmp_path / "bank.sqlite",
        out=tmp_path / "run",
    )  # fmt: skip
    log = read_signals(result.folder / "signals.csv.gz")
    times, states = log.lights["centre"]
    assert len(states) == len(set(zip(times, states, strict=True))) and {len(s) for s in states} == {16}
    assert all(before != after for before, after in pairwise(states))
    scene = data_of(make_page(result.folder))["scene"]
    ((frames, shown),) = scene["lights"]
    assert shown == list(states)
    assert frames[0] * scene["step"] + scene["start"] == pytest.approx(times[0], abs=0.051)
    assert {kind for kind, light, _ in scene["stops"] if light == 0} == {LINE_LIGHT}


def test_a_light_that_is_no_longer_near_is_not_shown(tmp_path: Path) -> None:
    """It is near from 1.0 s to 1.9 s, and again at 3.0 s."""
    shown = {round(0.1 * k, 1): {"c": "rG"} for k in (*range(10, 20), 30)}
    times = [round(0.1 * k, 1) for k in range(40)]
    write_signals(tmp_path / "signals.csv.gz", [Snapshot(time, {}, shown.get(time, {})) for time in times])
    log = read_signals(tmp_path / "signals.csv.gz", with_gaps=True)
    assert log.lights == {"c": ((1.0, 2.0, 3.0, 3.1), ("rG", "", "rG", ""))}
    assert (log.states(1.95), log.states(2.5), log.states(3.05)) == ({"c": "rG"}, {}, {"c": "rG"})


def test_a_run_without_lights_has_no_record_of_them(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    scene: Any = data_of(make_page(run))["scene"]
    assert scene["stops"] == [] and scene["lights"] == []
    assert [kind for _, kind in scene["markings"]].count(DASHED) == 2


def test_a_failed_run_says_so(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", written=manifest())
    for ending, failed in (("critical", False), ("no_encounter", False), ("model_failed", True)):
        document = json.loads((run / "outcome.json").read_text()) | {"ending": ending}
        (run / "outcome.json").write_text(json.dumps(document))
        assert data_of(make_page(run))["failed"] is failed
