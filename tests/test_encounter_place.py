"""The class of the ego's road, from shipped networks, and what an ODD contains."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli_samples import ROOT, Program, refused

import sumo_adv
from sumo_adv.config_odd import Odd, read_odd
from sumo_adv.datatypes import RoadClass, RoadPlace
from sumo_adv.episode.road_place import road_class
from sumo_adv.errors import UsageError
from sumo_adv.simulation.network import read_network


def class_at(network: str, before_the_end: float) -> RoadClass:
    """The class of a network's first road, ``before`` metres before its end. A junction counts within 80 m."""
    road = read_network(ROOT / "networks" / f"{network}.net.xml")
    leading_on = [lane for lane in road.lanes.values() if lane.connections and not lane.internal]
    lane = (leading_on or list(road.lanes.values()))[0]
    return road_class(road, lane, lane.length - before_the_end, ahead=80.0)


@pytest.mark.parametrize(
    ("network", "before_the_end", "expected"),
    [
        ("motorway", 300.0, "motorway"),  # a limit of 33 m/s
        ("straight_4lane", 300.0, "motorway"),  # 25 m/s, one-way
        ("straight_3lane", 300.0, "rural"),  # 22 m/s
        ("two_way", 300.0, "rural"),  # 22 m/s
        ("allway_stop", 100.0, "urban"),  # 13.9 m/s
        ("allway_stop", 60.0, "junction"),
        ("rural_crossing", 60.0, "junction"),
        ("rural_crossing", 100.0, "rural"),
        ("roundabout", 30.0, "junction"),
    ],
)
def test_the_class_of_a_road(network: str, before_the_end: float, expected: str) -> None:
    assert class_at(network, before_the_end) == expected


def test_within_a_junction_it_is_a_junction() -> None:
    road = read_network(ROOT / "networks" / "allway_stop.net.xml")
    inside = next(lane for lane in road.lanes.values() if lane.internal)
    assert road_class(road, inside, 1.0, ahead=80.0) is RoadClass.JUNCTION


HERE = RoadPlace(RoadClass.URBAN, 13.9, 8.0, 3)


@pytest.mark.parametrize(
    ("odd", "inside"),
    [
        (Odd(), True),
        (Odd(roads=(RoadClass.URBAN,)), True),
        (Odd(roads=(RoadClass.RURAL,)), False),
        (Odd(speed=(8.0, 14.0)), True),  # both ends belong to it
        (Odd(speed=(8.1, 14.0)), False),
        (Odd(vehicles_near=(1, 3)), True),
        (Odd(vehicles_near=(4, 9)), False),
    ],
)
def test_what_an_odd_contains(odd: Odd, inside: bool) -> None:
    assert odd.contains(HERE) is inside


def test_off_the_network_only_an_odd_without_roads_contains_the_ego() -> None:
    nowhere = RoadPlace(None, None, 8.0, 3)
    assert Odd(speed=(0.0, 14.0)).contains(nowhere) and not Odd(roads=(RoadClass.URBAN,)).contains(nowhere)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('road = ["urban"]', "unknown key 'road'; known keys are roads, relations, speed, vehicles_near"),
        ('roads = ["city"]', "bad 'roads.0': input should be 'motorway', 'rural', 'urban' or 'junction'"),
        ('relations = ["beside"]', "bad 'relations.0': input should be 'leader', 'follower'"),
        ("speed = [14, 8]", "bad 'speed': write the lower end of the range first"),
        ("speed = [-1, 8]", "bad 'speed.0': input should be greater than or equal to 0"),
        ("speed = 8", "bad 'speed'"),
        ("roads = [", "is not valid TOML"),
    ],
)
def test_a_bad_odd_is_refused_in_one_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "odd.toml").write_text(text)
    with pytest.raises(UsageError, match=r"The ODD .*odd\.toml") as refusal:
        read_odd(tmp_path / "odd.toml")
    assert sentence in str(refusal.value)


def test_batch_refuses_a_bad_odd_before_anything_runs(program: Program) -> None:
    (program.folder / "odd.toml").write_text('road = ["urban"]\n')
    batch = ("batch", "motorway_cut_in_left", "--odd", "odd.toml", "--out", "out")
    refused(program.here(*batch), 2, "unknown key 'road'", "known keys are roads")
    assert program.leftovers() == ["odd.toml"]


def test_outside_the_odd_nothing_is_attacked(tmp_path: Path) -> None:
    """The ego of this scenario is on a motorway, and the vehicle beside it could cut in."""
    quick = {"attempts": 1, "proposals": 24, "learn": "off", "memory": tmp_path / "bank.sqlite"}
    kept = sumo_adv.run("motorway_cut_in_left", odd={"roads": ["motorway"], "relations": ["neighbour"]}, **quick)
    encounter = kept.outcome.encounter
    assert encounter is not None and encounter.road == "motorway" and encounter.limit == 33.0
    assert {relation for _, relation, _ in encounter.ranking} == {"neighbour"}
    assert kept.outcome.relation == "neighbour" and len(kept.outcome.attempts) == 1
    for odd in ({"roads": ["urban"]}, {"relations": ["oncoming"]}):
        left = sumo_adv.run("motorway_cut_in_left", odd=odd, **quick)
        assert left.outcome.ending == "no_encounter"
        assert left.outcome.reason.endswith("no vehicle near could endanger the ego within the ODD.")
    searched = sumo_adv.run("motorway", odd={"roads": ["urban"]}, end=40.0, **quick)
    assert searched.outcome.ending == "no_encounter"
    assert searched.outcome.reason.endswith("The ODD kept vehicles from attacking.")
