"""Waymo records become SUMO networks: synthetic records with numbers worked out by hand."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import womd_samples as samples

from sumo_adv.errors import UsageError
from sumo_adv.simulation.network import RoadMap, read_network
from sumo_adv.womd.fidelity import connectivity
from sumo_adv.womd.matching import read_net
from sumo_adv.womd.network import ConvertedNetwork, convert_network
from sumo_adv.womd.record import Record


def convert(folder: Path, message: Any) -> tuple[ConvertedNetwork, RoadMap]:
    made = convert_network(samples.record(folder, message), folder / "net")
    return made, read_network(made.path)


def signal_letters(path: Path, lane: str) -> tuple[list[tuple[float, str]], ET.Element]:
    """(duration, letter) a phase for the first connection out of a SUMO edge, and its tlLogic."""
    net = ET.parse(path).getroot()
    link = next(c for c in net.findall("connection") if c.get("from") == lane)
    logic = next(t for t in net.findall("tlLogic") if t.get("id") == link.get("tl"))
    index = int(link.get("linkIndex", "-1"))
    phases = [(float(p.get("duration", "0")), p.get("state", "")[index]) for p in logic.findall("phase")]
    return phases, logic


def test_a_straight_road_is_one_edge_of_two_lanes(tmp_path: Path) -> None:
    made, road = convert(tmp_path, samples.straight())
    assert [p.name for p in (tmp_path / "net").iterdir()] == ["network.net.xml"]
    right, left = (road.lanes[made.pieces[n][0].sumo_lane] for n in (12, 11))
    assert (right.edge, right.index, left.index) == (left.edge, 0, 1)
    assert np.allclose(right.shape[[0, -1]], [[0, 0], [300, 0]])
    assert right.length == 300.0
    assert right.width == left.width == 3.5  # from the edges and the dashes at 1.75 m
    assert right.speed == pytest.approx(30 * 0.44704, abs=0.01)
    assert made.report["junction_share"] == 0.0


def test_what_crosses_above_does_not_meet(tmp_path: Path) -> None:
    made, road = convert(tmp_path, samples.overpass())
    assert not any(lane.internal for lane in road.lanes.values())
    assert [len(made.pieces[n]) for n in (1, 2)] == [1, 1]
    level = samples.overpass()
    for feature in level.map_features:
        for point in feature.lane.polyline:
            point.z = 0.0
    made, road = convert(tmp_path, level)
    assert sum(lane.internal for lane in road.lanes.values()) == 2
    inside = [p for p in made.pieces[1] if p.internal]
    assert inside[0].start == pytest.approx(97, abs=1) and inside[0].end == pytest.approx(103, abs=1)


def test_a_ramp_yields_where_it_merges(tmp_path: Path) -> None:
    made, road = convert(tmp_path, samples.merge())
    connections = connectivity(samples.record(tmp_path, samples.merge()), read_net(made.path), made.pieces)
    ramp = next(p for p in reversed(made.pieces[4]) if not p.internal)
    onward = [(lane, c) for lane in road.lanes.values() for c in lane.connections if not lane.internal]
    states = {lane.id: c.state for lane, c in onward}
    assert states.pop(ramp.sumo_lane) == "m"
    assert set(states.values()) == {"M"}
    assert connections["kept"] == connections["wanted"] == 3


def test_signals_hold_as_recorded_then_all_go_in_turn(tmp_path: Path) -> None:
    made, _ = convert(tmp_path, samples.four_way())
    edge = made.pieces[102][0].sumo_lane.rpartition("_")[0]
    north, logic = signal_letters(made.path, edge)
    assert north[0] == (4.0, "G") or north[0] == (4.0, "g")
    assert north[1] == (1.0, "y")
    assert north[2] == (4.1, "r")
    assert made.report["signals_unknown"] == 0
    states = [p.get("state", "") for p in logic.findall("phase")]
    assert all(any(state[k] in "gG" for state in states) for k in range(12))


def test_whoever_drives_over_the_line_had_green(tmp_path: Path) -> None:
    """The ego comes from the south at 10 m/s, its front 33.7 m before the line: over it at 3.4 s. Where the record
    never knows its signal, it is green until 1 s after that, then yellow for 3 s; turns stay red."""
    message = samples.four_way()
    for step in message.dynamic_map_states:
        for state in step.lane_states:
            state.state = 0 if state.lane // 10 == 33 else state.state
    made, _ = convert(tmp_path, message)
    assert made.report["signals_witnessed"] == 1
    net = ET.parse(made.path).getroot()
    phases = [(float(p.get("duration", "0")), p.get("state", "")) for p in net.iter("phase")]
    edge = made.pieces[104][0].sumo_lane.rpartition("_")[0]
    letters = {}
    for link in net.findall("connection"):
        if link.get("from") == edge:
            k = int(link.get("linkIndex", "-1"))
            letters[link.get("dir")] = "".join(state[k] * round(10 * duration) for duration, state in phases)[:91]
    assert letters["s"].lower() == 44 * "g" + 30 * "y" + 17 * "r"
    assert letters["l"] == letters["r"] == 91 * "r"


def test_a_stop_sign_where_the_map_begins_is_kept(tmp_path: Path) -> None:
    """Lane 2 begins at the map's rim with a stop sign, 1 m before it crosses lane 1. Half a metre of edge is left."""
    message = samples.empty("rim")
    samples.lane(message, 1, samples.line((-100.0, 0.0), (100.0, 0.0)))
    samples.lane(message, 2, samples.line((0.0, -1.0), (0.0, 100.0)))
    samples.track(message, 1, samples.line((-100.0, 0.0), (100.0, 0.0)), start=10.0, speed=10.0)
    sign = message.map_features.add(id=3).stop_sign
    sign.lane.append(2)
    made, road = convert(tmp_path, message)
    stub = road.lanes[made.pieces[2][0].sumo_lane]
    assert stub.length == pytest.approx(0.5)
    assert [c.state for c in stub.connections] == ["s"]


def test_lanes_of_one_point_or_none_are_dropped_by_name(tmp_path: Path) -> None:
    made, road = convert(tmp_path, samples.one_point())
    assert made.report["dropped_lanes"] == [[2, "one point"], [4, "no points"]]
    assert made.pieces[1][-1].sumo_lane == made.pieces[3][0].sumo_lane  # one road of 200 m
    assert road.lanes[made.pieces[1][0].sumo_lane].length == pytest.approx(200.0)


def test_a_gap_is_not_bridged_but_told(tmp_path: Path) -> None:
    made, _ = convert(tmp_path, samples.gap())
    assert made.report["connections_with_a_gap"] == [[1, 2]]


def test_a_record_without_lanes_is_refused(tmp_path: Path) -> None:
    straight = samples.record(tmp_path, samples.straight())
    bare = Record(**{name: getattr(straight, name) for name in Record.__slots__} | {"lanes": {}})
    with pytest.raises(UsageError, match="no lane"):
        convert_network(bare, tmp_path / "net")
    assert not (tmp_path / "net").exists()


def test_turns_are_slower_than_the_road_and_know_their_side(tmp_path: Path) -> None:
    made, road = convert(tmp_path, samples.four_way())
    east = road.lanes[made.pieces[101][0].sumo_lane]
    assert {c.movement for c in east.connections} == {"left", "straight", "right"}
    speed = {c.movement: road.lanes[c.via[0]].speed for c in east.connections}
    length = {c.movement: road.lanes[c.via[0]].length for c in east.connections}
    assert speed["left"] == speed["straight"] == pytest.approx(20 * 0.44704, abs=0.01)
    assert speed["right"] == pytest.approx(math.sqrt(5.5 * length["right"] / (math.pi / 2)), rel=0.02)  # < 8.94
    assert length["straight"] == pytest.approx(28.0, abs=0.5)
