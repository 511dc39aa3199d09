"""The junction ahead of the ego and its right of way there, on our own networks."""

from __future__ import annotations

import math
from functools import cache

import pytest
from situation_samples import car

from sumo_adv.datatypes import VehicleState
from sumo_adv.episode.survey import _junction_ahead
from sumo_adv.world.inputs import data_folder
from sumo_adv.world.network import RoadMap, read_network


@cache
def road(name: str) -> RoadMap:
    return read_network(data_folder("networks") / f"{name}.net.xml")


def before_the_end(network: str, lane: str, metres: float) -> VehicleState:
    """A car whose box centre is so many metres before the end of a straight lane."""
    (x0, y0), (x1, y1) = road(network).lanes[lane].shape[-2:]
    heading = math.atan2(y1 - y0, x1 - x0)
    place = car("ego", x1 - metres * math.cos(heading), y1 - metres * math.sin(heading), heading)
    return VehicleState(
        place.id, place.x, place.y, place.heading, place.speed, 0.0, place.length, place.width, lane
    )  # fmt: skip


@pytest.mark.parametrize("metres", [100.0, 30.0, 6.0])
def test_from_the_side_road_it_has_to_give_way_where_the_lane_ends(metres: float) -> None:
    ego = before_the_end("priority_crossing", "south_in_0", metres)
    at, rule = _junction_ahead(road("priority_crossing"), ego, ("south_in", "north_out"))
    assert at == pytest.approx(metres, abs=0.01)
    assert rule == "m"


def test_on_the_main_road_it_need_not_unless_it_turns_left() -> None:
    crossing = road("priority_crossing")
    right, left = (before_the_end("priority_crossing", lane, 60.0) for lane in ("west_in_0", "west_in_1"))
    for ego, way, rule in ((right, "east_out", "M"), (left, "east_out", "M"), (left, "north_out", "m")):
        found = _junction_ahead(crossing, ego, ("west_in", way))
        assert found == (pytest.approx(60.0, abs=0.01), rule)


def test_an_all_way_stop_has_a_letter_of_its_own() -> None:
    ego = before_the_end("allway_stop", "west_in_0", 20.0)
    assert _junction_ahead(road("allway_stop"), ego, ("west_in", "east_out")) == (pytest.approx(20.0, abs=0.01), "w")


def test_where_no_junction_comes_or_no_lane_is_known_there_is_none() -> None:
    ego = before_the_end("two_way", "eastbound_0", 50.0)
    assert _junction_ahead(road("two_way"), ego, ()) == (math.inf, "")
    assert _junction_ahead(road("two_way"), car("ego", 0.0, 0.0), ()) == (math.inf, "")  # on no lane
