"""The junction ahead of the ego and its right of way there, on our own networks."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import pytest
from situation_samples import car

from sumo_adv.datatypes import VehicleState
from sumo_adv.episode.situation_builder import goes_first, way_ahead
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.network import RoadMap, read_network


@cache
def road(name: str) -> RoadMap:
    return read_network(data_folder("networks") / f"{name}.net.xml")


def ahead(network: str, ego: VehicleState, route: tuple[str, ...]) -> tuple[float, str] | None:
    """Metres to the junction, and the right of way letter there."""
    way = way_ahead(road(network), ego, route)
    return None if way is None else (way.junction, way.rule)


def before_the_end(network: str, lane: str, metres: float) -> VehicleState:
    """A car with its box centre a distance [m] before the end of a straight lane."""
    (x0, y0), (x1, y1) = road(network).lanes[lane].shape[-2:]
    heading = math.atan2(y1 - y0, x1 - x0)
    place = car("ego", x1 - metres * math.cos(heading), y1 - metres * math.sin(heading), heading)
    return VehicleState(
        place.id, place.x, place.y, place.heading, place.speed, 0.0, place.length, place.width, lane
    )  # fmt: skip


@pytest.mark.parametrize("metres", [100.0, 30.0, 6.0])
def test_from_the_side_road_it_has_to_give_way_where_the_lane_ends(metres: float) -> None:
    ego = before_the_end("priority_crossing", "south_in_0", metres)
    junction = ahead("priority_crossing", ego, ("south_in", "north_out"))
    assert junction == (pytest.approx(metres, abs=0.01), "m")


def test_on_the_main_road_it_need_not_unless_it_turns_left() -> None:
    right, left = (before_the_end("priority_crossing", lane, 60.0) for lane in ("west_in_0", "west_in_1"))
    for ego, way, rule in ((right, "east_out", "M"), (left, "east_out", "M"), (left, "north_out", "m")):
        junction = ahead("priority_crossing", ego, ("west_in", way))
        assert junction == (pytest.approx(60.0, abs=0.01), rule)


def test_an_all_way_stop_has_a_letter_of_its_own() -> None:
    ego = before_the_end("allway_stop", "west_in_0", 20.0)
    assert ahead("allway_stop", ego, ("west_in", "east_out")) == (pytest.approx(20.0, abs=0.01), "w")


def test_where_no_junction_comes_or_no_lane_is_known_there_is_none() -> None:
    ego = before_the_end("two_way", "eastbound_0", 50.0)
    assert ahead("two_way", ego, ()) == (math.inf, "")
    assert ahead("two_way", car("ego", 0.0, 0.0), ()) is None  # on no lane


# ---- right of way


def test_a_vehicle_from_the_side_road_waits_for_one_on_the_main_road_and_not_the_reverse() -> None:
    """Vehicles from the south and the north go straight on. Both give way, and neither waits for the other."""
    lanes = ("south_in_0", "west_in_1", "north_in_0")
    south, west, north = (road("priority_crossing").ways(lane, 100.0, 200.0)[0].first for lane in lanes)
    assert goes_first(west, south)
    assert not goes_first(south, west)
    assert not goes_first(north, south)


def test_where_they_meet_at_another_junction_either_may_go_first() -> None:
    here = road("priority_crossing").ways("west_in_1", 100.0, 200.0)[0].first
    arm = road("allway_stop").ways("west_in_0", 0.0, 200.0)[0].first
    assert here is not None
    assert arm is not None
    elsewhere = replace(arm, link=("another", 0))
    assert goes_first(elsewhere, here)
    assert goes_first(None, here)
    assert goes_first(here, None)
