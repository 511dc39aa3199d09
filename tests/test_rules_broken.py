"""Who broke a red light or the right of way before a contact, in SUMO."""

from __future__ import annotations

from pathlib import Path

import pytest

import sumo_adv
from sumo_adv.episode.rules_broken import red_light_at
from sumo_adv.simulation.sumo_states import Snapshot


@pytest.mark.parametrize(
    ("scenario", "red_light", "right_of_way"),
    [
        ("signals_red_light", "adversary", "none"),
        ("priority_left_turn_oncoming", "none", "adversary"),
        ("signals_left_turn", "none", "adversary"),  # its green is a minor one
    ],
)
def test_an_adversary_that_breaks_a_rule_is_named(
    tmp_path: Path, scenario: str, red_light: str, right_of_way: str
) -> None:
    settings = {"until": "valid", "attempts": 6, "learn": "off", "memory": tmp_path / "bank.sqlite"}
    found = sumo_adv.run(scenario, out=tmp_path / "run", ego="idm", **settings)
    outcome = found.outcome.document["outcome"]
    assert outcome["collided"] and (outcome["red_light"], outcome["right_of_way"]) == (red_light, right_of_way)
    assert 0.0 < outcome["warning"] <= outcome["contact_time"]


def snapshot(time: float, x: float, light: str) -> Snapshot:
    return Snapshot(time, {"bv": (x, 0.0, 90.0, 10.0, "a_0")}, lights={"tls": light})


def test_a_light_that_changes_on_the_way_was_not_passed_on_red() -> None:
    """At 10 m/s the line, 15 m ahead, is passed after 2 s; with a change of the light before, nothing is said."""
    signals = (("tls", 15.0, "r"),)
    red = [snapshot(0.0, 0.0, "rG"), snapshot(1.0, 10.0, "rG"), snapshot(2.0, 20.0, "rG")]
    assert red_light_at("bv", signals, red) == 2.0
    changed = [red[0], snapshot(1.0, 10.0, "Gr"), snapshot(2.0, 20.0, "Gr")]
    assert red_light_at("bv", signals, changed) is None
    assert red_light_at("bv", (("tls", 15.0, "G"),), red) is None
    assert red_light_at("bv", (), red) is None
