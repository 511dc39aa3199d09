"""Measures of a conversion, each on a network with figures worked out by hand."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from womd_nets import Piece, edge, junction, link, net
from womd_samples import empty, four_way, gap, lane, line, merge, straight, track

from sumo_adv.womd.fidelity import (
    _lengths,
    _signals,
    connectivity,
    inside_lanes,
    lane_deviations,
)
from sumo_adv.womd.lines import LineSegments, resample
from sumo_adv.womd.matching import match, net_graph, record_graph
from sumo_adv.womd.reader import parse_record
from sumo_adv.womd.record import Record


def record(message: Any) -> Record:
    return parse_record(message, "a record")


def test_segments_near_a_point() -> None:
    """A line along x to 10 m, then up: the point (4, 1) is 1 m from it at station 4, (10.5, 3) half a metre at 13."""
    hits = LineSegments({"a": np.array([(0, 0), (10, 0), (10, 5)], float), "none": np.zeros((1, 2))}).near(
        np.array([(4.0, 1.0), (10.5, 3.0), (50.0, 0.0)]), 2.0, np.array([0.0, 0.0, 0.0])
    )
    assert hits.point.tolist() == [0, 1]
    assert hits.distance == pytest.approx([1.0, 0.5])
    assert hits.station == pytest.approx([4.0, 13.0])
    assert hits.turned == pytest.approx([0.0, np.pi / 2])


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.tuples(st.integers(-50, 50), st.integers(-50, 50)), min_size=2, max_size=8, unique=True),
    st.tuples(st.floats(-50, 50), st.floats(-50, 50)),
)
def test_the_least_distance_is_that_of_a_fine_search(corners: list[tuple[float, float]], point: Any) -> None:
    fine = np.concatenate([np.linspace(a, b, 400) for a, b in pairwise(corners)])
    expected = np.hypot(*(fine - point).T).min()
    hits = LineSegments({0: np.array(corners)}).near(np.array([point]), 200.0)
    assert hits.least(1, 200.0)[0] == pytest.approx(expected, abs=0.5)
    assert hits.least(1, 200.0)[0] <= expected + 1e-6


def test_resampling_keeps_both_ends() -> None:
    at, xy, heading = resample(np.array([(0, 0, 7), (3.2, 0, 7)], float), 0.5)
    assert (at[0], at[-1], len(at)) == (0.0, 3.2, 7)
    assert xy[-1] == pytest.approx([3.2, 0.0]) and np.allclose(heading, 0.0)


def test_a_network_that_lies_beside_its_record(tmp_path: Path) -> None:
    """Both lanes of 300 m are 0.3 m off, the left one ends after 150 m; traffic the other way does not count."""
    roads = net(
        tmp_path, edge("e", [(0, 0.3), (300, 0.3)], [(0, 3.8), (150, 3.8)]), edge("back", [(300, 3.5), (0, 3.5)])
    )
    pieces = {12: [Piece("e_0", 0.0, 300.0)], 11: [Piece("e_1", 0.0, 150.0)]}
    deviations = lane_deviations(record(straight()), roads)
    on = deviations.xy[:, 1] < 1.0
    assert np.allclose(deviations.distance[on], 0.3)
    rest = deviations.distance[~on & (deviations.xy[:, 0] > 155.0)]
    assert rest.max() == pytest.approx(3.2)  # the right lane is the nearest that leads there
    lengths = _lengths(record(straight()), pieces)
    assert lengths["lane_length"] == pytest.approx(600.0) and lengths["represented"] == pytest.approx(0.75)


def test_bike_lanes_are_compared_with_lanes_for_bicycles(tmp_path: Path) -> None:
    message = empty("bikes")
    lane(message, 1, line((0.0, 0.0), (100.0, 0.0)), kind=3)
    lane(message, 2, line((0.0, -3.0), (100.0, -3.0)), kind=3)
    track(message, 1, line((0.0, 0.0), (100.0, 0.0)), start=0.0, speed=1.0)
    roads = net(
        tmp_path, edge("car", [(0, 0), (100, 0)], allow="passenger"), edge("b", [(0, -3), (100, -3)], allow="bicycle")
    )
    deviations = lane_deviations(record(message), roads)
    assert set(np.round(deviations.distance, 6)) == {0.0, 3.0}


def test_length_inside_junctions_counts_a_lane_once() -> None:
    """A lane of 300 m with 60 m inside a junction, said twice."""
    pieces = {12: [Piece("e_0", 0.0, 240.0), Piece(":J_0_0", 240.0, 300.0, True), Piece(":J_1_0", 240.0, 300.0, True)]}
    lengths = _lengths(record(straight()), pieces)
    assert lengths["in_junctions"] == pytest.approx(0.1) and lengths["represented"] == pytest.approx(0.5)


def test_connections_that_can_be_driven(tmp_path: Path) -> None:
    """Of the three exits of the merge one is missing in the network, and one goes by an internal lane of 0.4 m."""
    message = merge()
    roads = net(
        tmp_path, edge("a", [(0, 0), (120, 0)]), edge("b", [(120.4, 0), (240, 0)]), edge("r", [(0, -30), (90, -3.5)]),
        edge("m", [(90, -3.5), (120, 0)]), edge(":J_0", [(120, 0), (120.4, 0)]),
        link("a_0", "b_0", ":J_0_0"), link(":J_0_0", "b_0"), link("r_0", "m_0"),
    )  # fmt: skip
    pieces = {1: [Piece("a_0", 0, 120)], 2: [Piece("b_0", 0, 120)], 4: [Piece("r_0", 0, 98)], 5: [Piece("m_0", 0, 30)]}
    connections = connectivity(record(message), roads, pieces)
    assert (connections["wanted"], connections["kept"], connections["lost"]) == (3, 2, [(5, 2)])
    assert connectivity(record(gap()), roads, {})["wanted"] == 0  # 100 m apart: no connection


def test_signals_that_a_sumo_signal_rules(tmp_path: Path) -> None:
    roads = junction(tmp_path)
    pieces = {331: [Piece(":J_2_0", 0, 30, True)], 302: [Piece(":J_0_0", 0, 30, True)]}
    assert _signals(record(four_way()), roads, pieces) == {"lanes": 12, "known": 12, "mapped": 1}


def test_vehicles_inside_lanes(tmp_path: Path) -> None:
    """The ego drives at the lane's middle, the leader too; the one beside 0.3 m off in a lane of 0.4 m; the parked one
    and the pedestrian do not count. 91 + 91 + 76 states."""
    roads = net(tmp_path, edge("e", [(0, 0), (300, 0)]), edge("thin", [(0, 3.2), (300, 3.2)], width=0.4))
    shares = inside_lanes(record(straight()), roads)
    assert shares == {"states": 258, "inside": pytest.approx(182 / 258), "near_centre": 1.0}


def test_a_vehicle_against_a_lane_is_not_inside_it(tmp_path: Path) -> None:
    """The ego drives against the only lane for 31 steps, another vehicle along it for 60. A second lane in the ego's
    direction takes the ego in."""
    message = empty("against")
    lane(message, 1, line((0.0, 0.0), (300.0, 0.0)))
    track(message, 1, line((100.0, 0.0), (0.0, 0.0)), start=0.0, speed=10.0, seen=(0, 31))
    track(message, 2, line((100.0, 0.0), (300.0, 0.0)), start=0.0, speed=10.0, seen=(31, 91))
    one_way = net(tmp_path, edge("e", [(0, 0), (300, 0)]))
    shares = {"states": 91, "inside": pytest.approx(60 / 91), "near_centre": pytest.approx(60 / 91)}
    assert inside_lanes(record(message), one_way) == shares
    both_ways = net(tmp_path, edge("e", [(0, 0), (300, 0)]), edge("back", [(300, 0), (0, 0)]))
    assert inside_lanes(record(message), both_ways) == {**shares, "inside": 1.0}


def test_the_lanes_of_a_track_on_the_record_itself() -> None:
    crossing = record(four_way())
    (whole,) = match(record_graph(crossing), crossing.tracks[0])
    assert whole.driven == (104, 331, 202)
    (begun_inside,) = match(record_graph(crossing), crossing.tracks[1])
    assert begun_inside.driven[-2:] == (302, 203)


def test_a_track_without_a_connection_breaks() -> None:
    message = empty("parted")
    lane(message, 1, line((0.0, 0.0), (50.0, 0.0)))
    lane(message, 2, line((50.0, 0.0), (200.0, 0.0)))
    track(message, 1, line((0.0, 0.0), (200.0, 0.0)), start=5.0, speed=12.0)
    stretches = match(record_graph(record(message)), record(message).tracks[0])
    assert [s.driven for s in stretches] == [(1,), (2,)]
    assert stretches[0].steps[-1] < stretches[1].steps[0]


def test_a_lane_change_is_no_break() -> None:
    """From the right lane of the straight road to the left one, on the record's graph and on SUMO's."""
    message = straight()
    track(message, 9, line((20.0, 0.0), (60.0, 0.0), (90.0, 3.5), (200.0, 3.5)), start=0.0, speed=12.0)
    with_change = record(message)
    (change,) = match(record_graph(with_change), with_change.tracks[-1])
    assert change.driven == (12, 11)


def test_a_lane_change_in_sumo(tmp_path: Path) -> None:
    message = straight()
    track(message, 9, line((20.0, 0.0), (60.0, 0.0), (90.0, 3.5), (200.0, 3.5)), start=0.0, speed=12.0)
    roads = net(tmp_path, edge("e", [(0, 0), (300, 0)], [(0, 3.5), (300, 3.5)]))
    (change,) = match(net_graph(roads), record(message).tracks[-1])
    assert change.driven == ("e_0", "e_1")


def test_a_track_beside_all_lanes_is_on_none(tmp_path: Path) -> None:
    straight_road = record(straight())
    roads = net(tmp_path, edge("e", [(0, 30), (300, 30)]), edge("bike", [(0, 0), (300, 0)], allow="bicycle"))
    assert match(net_graph(roads), straight_road.tracks[0]) == ()
