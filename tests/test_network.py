"""The road map on our own networks: lanes 3.2 m wide, so every offset is known by hand."""

from __future__ import annotations

import math
import pickle
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from sumo_adv.errors import UsageError
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.network import RoadMap, read_network


@cache
def road(name: str) -> RoadMap:
    return read_network(data_folder("networks") / f"{name}.net.xml")


def test_lanes_are_read_as_they_are_drawn() -> None:
    lane = road("straight_3lane").lanes["eastbound_2"]
    assert (lane.edge, lane.index, lane.width, lane.length, lane.speed) == ("eastbound", 2, 3.2, 1200.0, 22.0)
    assert lane.shape.tolist() == [[0.0, 3.2], [1200.0, 3.2]]
    assert lane.allows("passenger")
    assert not lane.internal
    assert road("straight_3lane").edges["eastbound"] == ("eastbound_0", "eastbound_1", "eastbound_2")
    assert road("priority_crossing").lanes[":centre_15_0"].internal
    assert road("straight_3lane").name == "straight_3lane"


def test_a_file_that_is_no_network_is_refused_by_name(tmp_path: Path) -> None:
    broken = tmp_path / "broken.net.xml"
    broken.write_text("<net><edge")
    with pytest.raises(UsageError, match=r"broken\.net\.xml could not be read as a SUMO network"):
        read_network(broken)


# ---- ways on


def test_from_the_right_lane_of_the_main_road_one_goes_straight_or_right() -> None:
    ways = road("priority_crossing").ways("west_in_0", 107.6, 150.0)  # the lane is 207.6 m long
    assert [w.movement for w in ways] == ["straight", "right"]
    assert [w.junction for w in ways] == pytest.approx([100.0, 100.0])
    assert [w.gives_way for w in ways] == [False, False]
    assert ways[0].lanes == ("west_in_0", ":centre_13_0", "east_out_0")
    assert ways[0].path.at(np.array(0.0))[:2] == pytest.approx((-112.4, -4.8))
    assert ways[0].path.at(np.array(120.0))[:2] == pytest.approx((7.6, -4.8), abs=1e-6)
    assert ways[1].path.at(np.array(140.0))[2] == pytest.approx(-math.pi / 2, abs=0.01)  # southwards
    assert all(w.path.length >= 150.0 for w in ways)


def test_a_left_turn_follows_both_pieces_of_the_junction_and_gives_way() -> None:
    straight, left = road("priority_crossing").ways("west_in_1", 107.6, 160.0)
    assert (straight.movement, straight.gives_way) == ("straight", False)
    assert (left.movement, left.gives_way) == ("left", True)
    assert left.lanes == ("west_in_1", ":centre_15_0", ":centre_17_0", "north_out_1")
    x, y, h = left.path.at(np.array(150.0))  # 100 m + 22.7 m of turn + 27.3 m north
    assert (float(x), float(y)) == pytest.approx((1.6, 12.4 + 27.295), abs=0.4)
    assert float(h) == pytest.approx(math.pi / 2, abs=0.01)


def test_the_side_road_gives_way_whatever_it_does() -> None:
    ways = [w for lane in ("south_in_0", "south_in_1") for w in road("priority_crossing").ways(lane, 150.0, 100.0)]
    assert sorted(w.movement for w in ways) == ["left", "right", "straight", "straight"]
    assert all(w.gives_way for w in ways)


def test_inside_the_junction_the_way_on_is_the_turn_begun() -> None:
    (way,) = road("priority_crossing").ways(":centre_15_0", 2.0, 60.0)
    assert way.lanes == (":centre_15_0", ":centre_17_0", "north_out_1")
    assert way.junction == 0.0
    assert float(way.path.at(np.array(50.0))[2]) == pytest.approx(math.pi / 2, abs=0.01)


def test_a_route_leaves_one_way_even_from_the_lane_beside_it() -> None:
    ways = road("priority_crossing").ways("west_in_0", 107.6, 150.0, ("west_in", "north_out"))
    assert [(w.movement, w.lanes[-1]) for w in ways] == [("left", "north_out_1")]
    (end,) = road("priority_crossing").ways("west_in_0", 107.6, 150.0, ("west_in",))
    assert (end.movement, end.junction, end.lanes) == ("none", math.inf, ("west_in_0",))


def test_far_from_a_junction_there_is_one_way_as_long_as_asked() -> None:
    (way,) = road("two_way").ways("eastbound_0", 950.0, 120.0)  # 50 m before the road ends
    assert (way.movement, way.junction, way.gives_way) == ("none", math.inf, False)
    assert way.path.length == pytest.approx(120.0, abs=0.5)
    assert way.path.at(np.array(110.0))[:2] == pytest.approx((1060.0, -1.6))


@pytest.mark.parametrize("name", ["t_junction", "roundabout", "signalised_crossing", "allway_stop", "onramp_merge"])
def test_every_way_of_every_network_is_connected(name: str) -> None:
    for lane in road(name).lanes.values():
        if lane.internal or not lane.carriageway:
            continue
        for way in road(name).ways(lane.id, lane.length * 0.6, 120.0):
            shapes = [road(name).lanes[n].shape for n in way.lanes]
            gaps = [float(np.hypot(*(b[0] - a[-1]))) for a, b in pairwise(shapes)]
            assert max(gaps, default=0.0) < 1.0, way.lanes
            assert np.hypot(np.diff(way.path.x), np.diff(way.path.y)) == pytest.approx(0.5, abs=0.06)


# ---- beside and opposite


@pytest.mark.parametrize(
    ("network", "lane", "y", "expected"),
    [
        ("straight_3lane", "eastbound_1", 0.0, [(-3.2, "same"), (3.2, "same")]),
        ("straight_3lane", "eastbound_0", -3.2, [(3.2, "same"), (6.4, "same")]),
        ("straight_3lane", "eastbound_2", 3.2, [(-6.4, "same"), (-3.2, "same")]),
        ("two_way", "eastbound_0", -1.6, [(3.2, "opposite")]),
        ("two_way_4lane", "eastbound_0", -4.8, [(3.2, "same"), (6.4, "opposite")]),
        ("two_way_4lane", "eastbound_1", -1.6, [(-3.2, "same"), (3.2, "opposite")]),
    ],
)
def test_lanes_beside_are_lane_widths_away(
    network: str, lane: str, y: float, expected: list[tuple[float, str]]
) -> None:
    side_offsets = road(network).side_offsets(lane, 400.0, y, 0.0)
    assert [k for _, k in side_offsets] == [k for _, k in expected]
    assert [o for o, _ in side_offsets] == pytest.approx([o for o, _ in expected])


def test_nothing_is_beside_inside_a_junction_or_off_the_road() -> None:
    assert road("priority_crossing").side_offsets(":centre_13_0", 0.0, -4.8, 0.0) == []
    assert road("priority_crossing").side_offsets("", 0.0, 0.0, 0.0) == []


def test_the_opposite_lane_is_found_from_where_the_vehicle_is() -> None:
    two_way = road("two_way")
    assert two_way.opposite_offset(500.0, -1.6, 0.0) == pytest.approx(3.2)
    assert two_way.opposite_offset(500.0, -2.0, 0.0) == pytest.approx(3.6)
    assert two_way.opposite_offset(500.0, 1.6, math.pi) == pytest.approx(3.2)  # the same for oncoming vehicles
    assert two_way.opposite_offset(500.0, 3.0, 0.0) is None  # beyond it there is no further one
    assert road("straight_3lane").opposite_offset(500.0, 0.0, 0.0) is None


def test_on_a_curved_road_the_opposite_lane_is_one_lane_width_away_everywhere() -> None:
    curved = road("curved_road")
    lane = next(n for n in curved.lanes.values() if not n.internal)
    for a, b in zip(lane.shape[1:-2], lane.shape[2:-1], strict=True):
        heading = math.atan2(b[1] - a[1], b[0] - a[0])
        x, y = (a + b) / 2
        assert curved.opposite_offset(float(x), float(y), heading) == pytest.approx(3.2, abs=0.1)


def test_lanes_near_are_those_within_the_radius() -> None:
    names = {lane.id for lane in road("two_way_4lane").lanes_near(700.0, -8.0, 7.0)}
    assert names == {"eastbound_0", "eastbound_1"}  # 3.2 and 6.4 m away; the next one is 9.6 m away


# ---- where one can drive


def test_the_carriageway_ends_at_the_kerb_and_is_the_same_after_a_journey() -> None:
    area = road("two_way").drivable(500.0, 0.0, 60.0)
    x = np.full(6, 500.0)
    y = np.array([0.0, -3.1, 3.1, -3.4, 3.4, 10.0])
    inside = [True, True, True, False, False, False]
    assert area(x, y).tolist() == inside
    again = pickle.loads(pickle.dumps(area))
    assert again(x, y).tolist() == inside
    assert area(x.reshape(2, 3), y.reshape(2, 3)).shape == (2, 3)


def test_all_of_a_crossing_and_its_arms_are_drivable_but_not_the_corners() -> None:
    area = road("priority_crossing").drivable(0.0, 0.0, 80.0)
    x = np.array([0.0, 6.0, -50.0, 6.0, 0.0, 20.0, -20.0])
    y = np.array([0.0, 0.0, -6.0, 50.0, -60.0, 20.0, -20.0])
    assert area(x, y).tolist() == [True] * 5 + [False] * 2
