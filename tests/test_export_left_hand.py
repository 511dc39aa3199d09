"""Exports of left-hand traffic: lanes, neighbours and vehicles are where they are in the network."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from shapely import LineString, MultiLineString, Point
from xodr_reader import lane_centres

import sumo_adv
from sumo_adv.datatypes import Floats
from sumo_adv.report.export import Format, Variant
from sumo_adv.report.export.commonroad import COMMONROAD_SCENARIO_FILE
from sumo_adv.report.export.formats import write_export
from sumo_adv.report.export.piece import ExportedRun, read_piece
from sumo_adv.simulation.maps import convert_map
from sumo_adv.simulation.network import read_network
from sumo_adv.womd.commonroad import read_commonroad
from sumo_adv.womd.reader import read_records


@pytest.fixture(scope="module")
def piece(tmp_path_factory: pytest.TempPathFactory) -> ExportedRun:
    """An ego that turns right, across the oncoming traffic."""
    home = tmp_path_factory.mktemp("left_hand")
    result = sumo_adv.run(
        "left_hand_turn_across", out=home / "run", attempts=1, proposals=24, learn="off", memory=home / "bank.sqlite"
    )
    return read_piece(result.folder)


def exported(piece: ExportedRun, format: Format, folder: Path) -> Path:
    write_export(folder / "made", piece, format, Variant.REPLAY, force=False)
    return folder / "made"


def is_left(line: Floats, other: Floats) -> bool:
    """Whether another line begins to the left of the beginning of this one."""
    (ax, ay), (bx, by) = (line[1] - line[0])[:2], (other[0] - line[0])[:2]
    return bool(ax * by - ay * bx > 0.0)


def test_opendrive_has_the_lanes_where_the_network_has_them(piece: ExportedRun, tmp_path: Path) -> None:
    """To the left of their reference lines, also within the junction."""
    folder = exported(piece, Format.OPENSCENARIO, tmp_path)
    centres = MultiLineString([line for line in lane_centres(folder / "road.xodr") if len(line) > 1])
    for lane in read_network(piece.network).lanes.values():
        if lane.carriageway and len(lane.shape) > 1:
            line = LineString(lane.shape)
            points = [line.interpolate(s) for s in np.arange(0.0, line.length, 2.0)]
            assert max(p.distance(centres) for p in points) < (0.25 if lane.internal else 0.1)


def test_opendrive_says_the_side_and_is_read_back_as_left_hand(piece: ExportedRun, tmp_path: Path) -> None:
    """ASAM OpenDRIVE 1.5 and later: ``rule``. The eight edges come back with their two lanes, where they were."""
    road = exported(piece, Format.OPENSCENARIO, tmp_path) / "road.xodr"
    roads = ElementTree.parse(road).getroot().findall("road")
    assert {each.get("rule") for each in roads} == {"LHT"}
    assert all(int(lane.attrib["id"]) > 0 for each in roads for lane in each.iterfind("lanes/laneSection/left/lane"))
    made = convert_map(road, cache=tmp_path / "cache")
    assert "8 edges with 16 lanes for cars" in made.said[0] and "left-hand traffic" in made.said[0]
    back, own = (
        {
            tuple(np.round(lane.shape[[0, -1]].ravel() - shift, 1))
            for lane in read_network(net).lanes.values()
            if not lane.internal
        }
        for net, shift in ((made.network, moved(made.network)), (piece.network, moved(piece.network)))
    )
    assert back == own


def moved(network: Path) -> Floats:
    """What netconvert added to the places of a map, for both ends of a line [m]."""
    location = ElementTree.parse(network).getroot().find("location")
    assert location is not None
    return np.tile([float(v) for v in location.attrib["netOffset"].split(",")], 2)


def test_the_sumo_replay_keeps_the_mark(piece: ExportedRun, tmp_path: Path) -> None:
    folder = exported(piece, Format.SUMO, tmp_path)
    assert 'lefthand="true"' in (folder / "net.net.xml").read_text(encoding="utf-8")


@pytest.mark.parametrize("format", [Format.COMMONROAD, Format.WOMD])
def test_records_have_the_ego_in_a_lane_and_neighbours_on_their_sides(
    piece: ExportedRun, tmp_path: Path, format: Format
) -> None:
    """The lane under the ego leads where the ego drives."""
    made = exported(piece, format, tmp_path)
    record = (
        read_commonroad(made / COMMONROAD_SCENARIO_FILE)
        if format is Format.COMMONROAD
        else next(iter(read_records(made)))
    )
    ego = record.tracks[record.sdc]
    k = int(ego.valid.argmax())
    here = Point(ego.x[k], ego.y[k])
    (lane,) = (each for each in record.lanes.values() if LineString(each.points[:, :2]).distance(here) < 1.0)
    along = lane.points[-1] - lane.points[0]
    assert np.cos(np.arctan2(along[1], along[0]) - ego.heading[k]) > 0.9
    pairs = 0
    for each in record.lanes.values():
        for neighbours, left in ((each.left, True), (each.right, False)):
            for other in neighbours:
                assert is_left(each.points, record.lanes[other.lane].points) == left
                pairs += 1
    assert pairs == 16  # two lanes each way on four arms
