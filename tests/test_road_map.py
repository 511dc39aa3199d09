"""The road map that a driver sees, on the shipped crossings; their lanes are 3.2 m wide and meet 12.4 m from (0, 0)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from road_samples import drive, steps
from shapely import LineString, Point
from sumo_samples import vehicle

from sumo_adv.datatypes import VehicleState
from sumo_adv.drivers import Observation
from sumo_adv.episode.ego_place import EgoPlace
from sumo_adv.errors import SimulationError, UsageError
from sumo_adv.geometry import along
from sumo_adv.simulation.centreline import centreline
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.lane_links import LaneGraph
from sumo_adv.simulation.network import read_network

METRES = st.floats(-200.0, 200.0)

NETWORKS = data_folder("networks")
FROM_SOUTH = vehicle("ego", "south_in north_out", 1, 110.0, 12.0)  # its front at y = -110, its centre at y = -112.5


def everything(seen: Observation) -> dict[str, Any]:
    """All that the road tells, read in the step that it belongs to."""
    road = seen.road
    assert road is not None
    names = ("limit", "lanes", "edges", "limits", "stop_lines", "conflicts", "must_wait", "sides", "until", "width")
    return {name: getattr(road, name) for name in names} | {"seen": seen}


@pytest.fixture(scope="module")
def before_crossing(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Any]:
    """Seen 97.6 m before the line of the minor road."""
    with drive(tmp_path_factory.mktemp("road"), "priority_crossing", [FROM_SOUTH], everything) as (moving, watcher):
        steps(moving, 2)
        return dict(watcher.kept[0])


def test_each_lane_says_how_it_relates_to_the_path(before_crossing: Mapping[str, Any]) -> None:
    lanes = {lane.id: lane for lane in before_crossing["lanes"]}
    assert {name for name, lane in lanes.items() if lane.on_route} >= {"south_in_1", ":centre_9_1"}
    assert lanes["south_in_0"].relation == "beside" and lanes["south_out_1"].relation == "oncoming"
    assert lanes["west_in_0"].relation == "crossing" and lanes[":centre_13_0"].relation == "crossing"
    assert (lanes["south_in_1"].right, lanes["south_in_1"].left) == ("south_in_0", None)
    assert (lanes["south_in_1"].limit, lanes["south_in_1"].width) == (13.9, 3.2)
    assert lanes[":centre_9_1"].junction and not lanes["south_in_1"].junction
    assert lanes["south_in_0"].centre.tolist() == [[4.8, -220.0], [4.8, -12.4]]


def test_lanes_name_those_after_before_and_beside_them(before_crossing: Mapping[str, Any]) -> None:
    """Two lanes on each side of the road: from the inner one (x = 1.6) a driver goes straight on or turns left, and the
    oncoming inner lane (x = -1.6) shares its left boundary (x = 0)."""
    lanes = {lane.id: lane for lane in before_crossing["lanes"]}
    inner, outer, way = lanes["south_in_1"], lanes["south_in_0"], lanes[":centre_9_1"]
    assert inner.successors == (":centre_9_1", ":centre_11_0") and inner.predecessors == ()
    assert (way.predecessors, way.successors) == (("south_in_1",), ("north_out_1",))
    assert lanes[":centre_15_0"].successors == (":centre_17_0",)  # a left turn from the west waits between them
    assert (inner.opposite_left, inner.opposite_right) == ("south_out_1", None)
    assert (outer.left, outer.opposite_left) == ("south_in_1", None) and way.opposite_left is None
    assert lanes["south_out_1"].opposite_left == "south_in_1"


@pytest.mark.parametrize(
    ("network", "lane", "left", "right", "opposite_left", "opposite_right"),
    [
        ("left_hand_crossing", "south_in_1", "south_in_0", None, None, "south_out_1"),
        ("left_hand_crossing", "south_in_0", None, "south_in_1", None, None),
        ("curved_4lane", "eastbound_1", None, "eastbound_0", "westbound_1", None),
        ("motorway", "eastbound_2", None, "eastbound_1", None, None),  # nothing comes the other way
    ],
)
def test_neighbours_by_side_and_direction(
    network: str, lane: str, left: str | None, right: str | None, opposite_left: str | None, opposite_right: str | None
) -> None:
    road = read_network(NETWORKS / f"{network}.net.xml")
    links = LaneGraph(road).links(road.lanes[lane])
    assert (links.left, links.right) == (left, right)
    assert (links.opposite_left, links.opposite_right) == (opposite_left, opposite_right)


def test_distances_ahead_count_from_the_centre_of_the_box(before_crossing: Mapping[str, Any]) -> None:
    """From y = -112.5: the line at -12.4 is 100.1 m ahead, the lane began 107.5 m behind."""
    (line,) = before_crossing["stop_lines"]
    assert line.ahead == pytest.approx(100.1) and (line.signal, line.sign) == (None, "yield")
    (limit,) = before_crossing["limits"]
    assert limit.ahead == pytest.approx(-107.5) and limit.speed == 13.9
    assert not before_crossing["must_wait"]  # no vehicle comes


def test_conflicts_say_where_they_are_and_who_gives_way(before_crossing: Mapping[str, Any]) -> None:
    """The lane from the west is at y = -4.8: 107.7 m ahead. The left turn from the north waits for the ego instead."""
    conflicts = {conflict.lane: conflict for conflict in before_crossing["conflicts"]}
    west = conflicts[":centre_13_0"]
    assert (west.ahead, west.x, west.y) == pytest.approx((107.7, 1.6, -4.8))
    assert west.ego_yields and not west.joins
    assert not conflicts[":centre_3_0"].ego_yields
    assert [c.ahead for c in before_crossing["conflicts"]] == sorted(c.ahead for c in before_crossing["conflicts"])


def test_the_edges_bound_the_carriageway(before_crossing: Mapping[str, Any]) -> None:
    """The road's sides are at x = 6.4 and -6.4, to the 0.05 m by which lanes are widened."""
    points = np.vstack(before_crossing["edges"])
    assert np.hypot(points[:, 0] - 1.6, points[:, 1] + 112.5).max() < 120.1
    away = {x: min(LineString(line).distance(Point(x, -150.0)) for line in before_crossing["edges"]) for x in (0, 6.4)}
    assert away[0] == pytest.approx(6.45) and away[6.4] == pytest.approx(0.05)


def test_the_observation_says_where_the_ego_is_in_its_lane(before_crossing: Mapping[str, Any]) -> None:
    seen = before_crossing["seen"]
    assert (seen.lane_heading, seen.lane_offset) == pytest.approx((math.pi / 2, 0.0))
    assert before_crossing["sides"] == pytest.approx((-3.2,)) and before_crossing["until"] == pytest.approx(100.1)


def test_what_was_not_read_in_its_own_step_is_refused(tmp_path: Path) -> None:
    with drive(tmp_path, "priority_crossing", [FROM_SOUTH], lambda seen: seen) as (moving, watcher):
        steps(moving, 3)
        seen = watcher.kept[0]
        with pytest.raises(SimulationError, match=r"observation.road of 0.1 s was read at 0.3 s"):
            _ = seen.road.lanes
        with pytest.raises(SimulationError, match=r"the path of an observation of 0.1 s was read at 0.3 s"):
            _ = seen.path
        assert (seen.time, seen.lane_offset, seen.others) == (0.1, pytest.approx(0.0), ())


def test_an_observation_can_be_copied_with_a_change(tmp_path: Path) -> None:
    def later(seen: Observation) -> tuple[Observation, Observation]:
        return seen, replace(seen, time=seen.time + 5.0)

    with drive(tmp_path, "priority_crossing", [FROM_SOUTH], later) as (moving, watcher):
        steps(moving, 2)
        seen, copied = watcher.kept[0]
        assert copied.time == 5.1 and copied.path is seen.path and copied.road is seen.road


@given(points=st.lists(st.tuples(METRES, METRES), min_size=2, max_size=6, unique=True), place=st.tuples(METRES, METRES))
def test_a_lane_has_the_same_numbers_as_numpy(points: list[tuple[float, float]], place: tuple[float, float]) -> None:
    line = centreline(points, 100.0)
    station = line.station_at(*place)
    assert station == along(line.shape, *place)
    xy = [float(np.interp(station, line.stations, column)) for column in line.shape.T]
    assert line.point_at(station)[:2] == tuple(xy)
    assert line.station_of(place[0]) == np.interp(place[0], line.positions, line.stations)


def waits(seen: Observation) -> tuple[bool, float]:
    """Whether it must wait, and its speed."""
    assert seen.road is not None
    return seen.road.must_wait, seen.ego.speed


def test_it_must_wait_for_the_main_road_once_and_then_go(tmp_path: Path) -> None:
    """From the west 14 m/s, 127.6 m before the crossing: both would be there after some 9 s. SUMO's driver drives."""
    others = [vehicle("w", "west_in east_out", 1, 80.0, 14.0)]
    with drive(tmp_path, "priority_crossing", [FROM_SOUTH, *others], waits) as (moving, watcher):
        steps(moving, 150)
    waiting = [must for must, _ in watcher.kept]
    assert [must for must, after in pairwise(waiting) if must != after] == [False, True]  # no flicker
    assert not waiting[0] and not waiting[-1]


def test_the_main_road_waits_for_nobody(tmp_path: Path) -> None:
    cars = [vehicle("ego", "west_in east_out", 1, 150.0, 14.0), vehicle("s", "south_in north_out", 1, 150.0, 12.0)]
    with drive(tmp_path, "priority_crossing", cars, everything) as (moving, watcher):
        steps(moving, 30)
    assert all(not kept["must_wait"] and not kept["stop_lines"] for kept in watcher.kept)
    assert not any(conflict.ego_yields for kept in watcher.kept for conflict in kept["conflicts"])


def test_a_light_is_told_with_its_state_and_red_means_wait(tmp_path: Path) -> None:
    def light(seen: Observation) -> tuple[Any, ...]:
        assert seen.road is not None
        return tuple((line.signal, line.must_wait) for line in seen.road.stop_lines[:1])

    with drive(tmp_path, "signalised_crossing", [FROM_SOUTH], light) as (moving, watcher):
        steps(moving, 400)
    lights = {state for states in watcher.kept for state in states}
    assert lights >= {("green", False)}
    assert ("red", False) not in lights and ("green", True) not in lights


# ---- other vehicles


def neighbours(seen: Observation) -> dict[str, tuple[Any, ...]]:
    """What is told of the others: kind, indicator, brake light, yaw rate, visible."""
    return {o.id: (o.kind, o.indicator, o.brake_light, o.yaw_rate, o.visible) for o in seen.others}  # type: ignore[attr-defined]


def test_others_show_their_lamps_and_a_hidden_one_is_not_visible(tmp_path: Path) -> None:
    """Two cars ahead in one lane, standing still: the far one is hidden behind the near one, of equal width."""
    cars = [vehicle("ego", "west_in east_out", 1, 100.0, 5.0), vehicle("near", "west_in east_out", 1, 130.0, 5.0),
            vehicle("far", "west_in north_out", 1, 160.0, 9.0)]  # fmt: skip
    with drive(tmp_path, "priority_crossing", cars, neighbours) as (moving, watcher):
        steps(moving, 60)
    first = watcher.kept[0]
    assert first["near"][0] == "passenger" and first["near"][4] and not first["far"][4]
    turning = [observed["far"] for observed in watcher.kept if "far" in observed]
    assert "left" in {car[1] for car in turning} and True in {car[2] for car in turning}
    assert max(car[3] for car in turning) > 0.2  # rad/s, to the left


def test_a_driver_may_ask_for_visible_vehicles_only(tmp_path: Path) -> None:
    house = tmp_path / "house.add.xml"
    house.write_text('<additional><poly id="h" type="building" shape="-60,-20 -20,-20 -20,-60 -60,-60"/></additional>')
    cars = [vehicle("ego", "south_in north_out", 1, 150.0, 5.0), vehicle("w", "west_in east_out", 0, 150.0, 5.0)]

    def ids(seen: Observation) -> list[str]:
        return [neighbour.id for neighbour in seen.others]

    for sees_buildings, expected in ((True, []), (False, ["w"])):
        with drive(
            tmp_path, "priority_crossing", cars, ids, additional=(house,), visible_only=True,
            sees_buildings=sees_buildings,
        ) as (moving, watcher):  # fmt: skip
            steps(moving, 2)
        assert watcher.kept[0] == expected


# ---- the path in a junction


class Routed:
    """A simulation that knows one route."""

    def __init__(self, *edges: str) -> None:
        self.edges, self.given = edges, list[Sequence[str]]()

    def route(self, vehicle: str) -> tuple[tuple[str, ...], int]:
        return self.edges, 0

    def lane_position(self, vehicle: str) -> float:
        return 0.0

    def set_route(self, vehicle: str, edges: Sequence[str]) -> None:
        self.given.append(edges)


def test_on_a_junction_the_ego_stays_on_the_lane_of_its_route() -> None:
    """SUMO takes it to be on the left turn's lane for a moment, which begins as the straight one does."""
    road = read_network(NETWORKS / "priority_crossing.net.xml")
    place = EgoPlace(road, Routed("south_in", "north_out"), "passenger")  # type: ignore[arg-type]

    def at(y: float, lane: str) -> Any:
        state = VehicleState("ego", 1.6, y, math.pi / 2, 8.0, 0.0, 5.0, 2.0, lane)
        return place(state, moved=True, restores=True)

    assert at(-20.0, "south_in_1").lane.id == "south_in_1"
    inside = at(-10.0, ":centre_11_0")
    assert inside.lane.id == ":centre_9_1" and inside.front == pytest.approx(4.9)  # from y = -12.4 to -7.5
    assert at(20.0, "north_out_1").lane.id == "north_out_1"


def test_a_driver_may_ask_for_a_longer_path(tmp_path: Path) -> None:
    """The road goes on for 330 m. The path is renewed every 40 m, and is 250 m long just before that."""

    def ahead(seen: Observation) -> float:
        assert seen.path is not None
        return seen.path[-1][1] - seen.ego.y

    with drive(tmp_path, "priority_crossing", [FROM_SOUTH], ahead, path_ahead=250) as (moving, watcher):
        steps(moving, 50)
    assert len(watcher.kept) > 40 and min(watcher.kept) >= 249.0
    with (
        pytest.raises(UsageError, match=r"path_ahead = 2000; it must be a number of metres, above 0 and at most 1000"),
        drive(tmp_path, "priority_crossing", [FROM_SOUTH], ahead, path_ahead=2000),
    ):
        pass
