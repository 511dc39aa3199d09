"""The shipped scenarios hold what ``sumo-adv scenarios`` says of them: the kind and level of an attack."""

from __future__ import annotations

from pathlib import Path

import pytest
from bank_samples import shipped_planners

import sumo_adv
from sumo_adv.datatypes import Level
from sumo_adv.episode.memory_access import unprotected_library
from sumo_adv.search.intents import COMPOSED
from sumo_adv.simulation.shipped import shipped_scenarios

SHIPPED = {scenario.name: scenario for scenario in shipped_scenarios()}
IN_EVERY_TEST = ("follower_closes_up", "leader_brakes_hard", "signals_left_turn")
LEVELS = [str(level) for level in Level]
WORDS = {
    "leader": {"leader"}, "follower": {"follower"}, "neighbour": {"neighbour"}, "oncoming": {"oncoming"},
    "closes_up": {"Close Car-following"}, "brakes_hard": {"Emergency Braking"}, "cut_in": {"Aggressive Cut-in"},
    "junction_left": {"Intersection Rush-through Turn Left"}, "signals_left": {"Intersection Rush-through Turn Left"},
    "priority_left": {"Intersection Rush-through Turn Left"},
    "turn_right": {"Intersection Rush-through Turn Right"}, "merge_rush": {"Ramp Merge Rush"},
    "roundabout_entry": {"Ramp Merge Rush"}, "straight": {"Intersection Rush-through Go-straight"},
    "red_light": {"Intersection Rush-through Go-straight"}, "blind_side": {"Straight Lane Shift", "neighbour"},
    "from_right": {"crossing"}, "cyclist_swerve": {"Cyclist Swerve"}, "cyclist_crossing": {"Cyclist Crossing"},
    "cyclist_from_behind": {"Cyclist Crossing"}, "steps_out": {"Pedestrian Steps Out"},
    "parked": {"Pedestrian From Behind Obstacle"}, "box_in": {"Aggressive Cut-in"}, "opens_gap": {"Aggressive Cut-in"},
    "squeezed_merge": {"Aggressive Cut-in"}, "hidden_crossing": {"Intersection Rush-through Go-straight"},
    "blocked_escape": {"Emergency Braking"}, "turn_across": {"Intersection Rush-through Turn Left"},
    "pedestrian_turns_back": {"Pedestrian Turns Back"}, "cyclist_turns_back": {"Cyclist Turns Back"},
    "cyclist_wrong_way": {"Cyclist Rides On"},
}  # fmt: skip
"""What a part of a name says of the best attack: its intent, or the relation of the adversary to the ego."""


@pytest.mark.parametrize("name", SHIPPED)
def test_a_name_says_of_which_kind_the_best_attack_is(name: str) -> None:
    scenario = SHIPPED[name]
    meanings = [words for part, words in WORDS.items() if part in name]
    assert meanings, "the name says nothing of the attack"
    for words in meanings:
        assert words & {scenario.intents[0], scenario.relation}


def test_all_intents_of_the_paper_and_two_found_ones_are_best_somewhere() -> None:
    of_the_paper = {label for label, _ in shipped_planners()}
    assert len(of_the_paper) == 7 and len(COMPOSED) == 2
    on_foot_and_bicycle = {entry.label for entry in unprotected_library()}
    assert len(on_foot_and_bicycle) == 7
    assert {scenario.intents[0] for scenario in SHIPPED.values()} == of_the_paper | COMPOSED | on_foot_and_bicycle


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in IN_EVERY_TEST else pytest.mark.soak) for name in SHIPPED]
)
def test_the_listed_attack_is_found(name: str, tmp_path: Path) -> None:
    """A run until the listed level reaches it with a listed attack. Attempts end it, not the time, so that it is the
    same on every machine."""
    scenario = SHIPPED[name]
    run = sumo_adv.run(
        name, until=scenario.level, learn="off", memory=tmp_path / "bank.sqlite", out=tmp_path / name,
        adversaries=scenario.adversaries, attempts=400, seconds=3600.0, total_seconds=0.0,
    )  # fmt: skip
    document = run.outcome.document
    relations = {vehicle["id"]: vehicle["relation"] for vehicle in document["encounter"]["ranking"]}
    assert document["intent"]["label"] in scenario.intents
    assert relations[document["intent"]["bv"]] == scenario.relation
    assert LEVELS.index(document["outcome"]["level"]) >= LEVELS.index(scenario.level)
