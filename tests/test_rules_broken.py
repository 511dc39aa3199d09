"""Who broke a red light or the right of way before a contact, in SUMO."""

from __future__ import annotations

from pathlib import Path

import pytest

import sumo_adv
from sumo_adv.episode.rules_broken import LightPassed, light_at_line, red_light_at
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


def test_the_light_at_the_stop_line_counts() -> None:
    """At 10 m/s the line, 15 m ahead, is passed after 2 s. What the vehicle's light shows then is known if all
    links that were red at first show the same."""
    signals = (("tls", 15.0, "r"),)
    red = [snapshot(0.0, 0.0, "rG"), snapshot(1.0, 10.0, "rG"), snapshot(2.0, 20.0, "rG")]
    assert red_light_at("bv", signals, red) == 2.0
    assert red_light_at("bv", signals, [*red[:2], snapshot(2.0, 20.0, "Gr")]) is None
    assert red_light_at("bv", (), red) is None
    green = (("tls", 15.0, "G"),)
    assert red_light_at("bv", green, red) is None
    assert red_light_at("bv", green, [*red[:2], snapshot(2.0, 20.0, "Gr")]) == 2.0
    assert light_at_line("bv", green, [*red[:2], snapshot(2.0, 20.0, "ry")]) == LightPassed(2.0, "y")
    several = [snapshot(0.0, 0.0, "GG"), snapshot(2.0, 20.0, "Gr")]
    assert light_at_line("bv", green, several) is None, "one of the two links is the vehicle's"
