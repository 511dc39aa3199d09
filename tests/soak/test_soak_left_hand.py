"""Shipped scenarios in the mirrored network: the same proposal gives the mirrored attack and the same verdict."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from mirrors import both_ways, farthest

SAME_FOR = {"priority_left_turn_oncoming": 4.4, "signals_left_turn": 8.0, "onramp_cut_in": 9.3}
"""s from the trigger, in three scenarios: from then on SUMO drives the ego otherwise in the mirrored network, at first
by 0.00003 to 0.09 m. So level and fault may differ; why SUMO does was not found."""
ATTEMPTS = {"roundabout_entry": 400}
"""Until something comes of it; elsewhere six are enough."""


@pytest.mark.soak
@pytest.mark.parametrize("name", [
    "oncoming_country_road", "motorway_cut_in_left", "priority_straight_from_left", "priority_left_turn_oncoming",
    "leader_brakes_hard", "oncoming_in_bend", "neighbour_ahead_right", "roundabout_entry",
    "onramp_cut_in", "t_junction_left_into_stem", "signals_red_light", "signals_left_turn", "follower_closes_up",
])  # fmt: skip
def test_the_mirrored_scenario_gives_the_mirrored_attack(name: str, tmp_path: Path) -> None:
    ours, mirrored = both_ways(name, tmp_path, ATTEMPTS.get(name, 6))
    assert mirrored.ranking == ours.ranking
    if name not in SAME_FOR:
        assert (mirrored.level, mirrored.fault) == (ours.level, ours.fault)
    assert farthest(ours.tracks, mirrored.tracks, SAME_FOR.get(name, math.inf)) < 1e-4  # m
