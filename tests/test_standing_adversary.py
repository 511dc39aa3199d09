"""A car that stands in the ego's lane: beyond a crest, or revealed by a leader that only plays its part."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from cli_samples import Program

from sumo_adv.asked import RequestOrigin
from sumo_adv.words.build import build_scenario
from sumo_adv.words.draft import SceneDraft

WRITTEN = RequestOrigin(words="a car stands in my lane", model="a model", date="2026-11-29")
ROUTE = ["forward", "forward"]
STANDS = {"name": "stands", "applies": ["leader"], "actions": [{"verb": "wait", "seconds": {
    "default": 10, "low": 10, "high": 10,
}}]}  # fmt: skip
STALLED = {"id": "stalled", "route": ROUTE, "speed": 0, "stands": True}
SWERVE = {"name": "late swerve", "applies": ["leader"], "actions": [{
    "verb": "lane_change", "side": "left", "seconds": {"default": 2, "low": 2, "high": 2},
    "when": {"kind": "time", "value": {"default": 3, "low": 2, "high": 4}},
}]}  # fmt: skip


def scene(ego: dict[str, Any], *vehicles: dict[str, Any], **attack: Any) -> SceneDraft:
    """A one-way road with two lanes, on which the ego drives 72 km/h."""
    return SceneDraft.model_validate({
        "road": {"kind": "straight", "lanes": 2, "lanes_back": 0, "speed_limit": 80, "length": 900},
        "ego": {"route": ROUTE, "speed": 72, **ego}, "vehicles": list(vehicles),
        "attack": {"adversary": "stalled", "script": STANDS, "asked": {"relation": "leader"}, **attack},
    })  # fmt: skip


def played(home: Path, made: SceneDraft, *more: str) -> dict[str, Any]:
    build_scenario(made, home / "my.toml", WRITTEN)
    kept = ("--learn", "off", "--memory", "bank.sqlite", "--out", "out", "--until", "collision")
    done = Program(home, home).here("run", home / "my.toml", *kept, *more)
    assert done.status == 0, done.err
    outcome: dict[str, Any] = json.loads((home / "out" / "outcome.json").read_text())
    return outcome


def test_a_car_that_stands_beyond_a_crest_is_an_adversary(tmp_path: Path) -> None:
    """It is 200 m ahead at the start, and 140 m, which is 7 s, when the attack begins 3 s later."""
    crest = {"crests": [{"begin": 60, "end": 190, "limit": 40}]}
    outcome = played(tmp_path, scene(crest, {**STALLED, "gap": 200}), "--attempts", "1")
    (attempt,) = outcome["attempts"]
    assert (attempt["intent"], attempt["adversaries"]) == ("Script: stands", ["stalled"])
    first = outcome["asked"]["motion"].splitlines()
    assert first[0].endswith("at first it is ahead of EGO in its lane.")
    assert first[1] == "A is hidden from EGO at first by something between them."


@pytest.fixture(scope="module")
def revealed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run: a van 20 m ahead changes to the left lane late and reveals the car that stands."""
    home = tmp_path_factory.mktemp("revealed")
    van = {"id": "lead", "type": "van", "route": ROUTE, "speed": 72, "gap": 20}
    swerve = {"adversary": "lead", "attacks": False, "script": SWERVE, "asked": {"events": ["leaves"]}}
    played(home, scene({}, {**STALLED, "gap": 170}, van, others=[swerve]), "--attempts", "6")
    return home


def test_scripts_of_several_are_tables_of_the_scenario(revealed: Path) -> None:
    table = tomllib.loads((revealed / "my.toml").read_text())
    assert [script["name"] for script in table["scripts"]] == ["stands", "late swerve"]
    assert [(each["id"], each["intents"], each.get("attacks", True)) for each in table["attackers"]] == [
        ("stalled", ["Script: stands"], True), ("lead", ["Script: late swerve"], False),
    ]  # fmt: skip


def test_a_leader_that_plays_reveals_the_car_that_stands(revealed: Path) -> None:
    """All attempts are judged on the car that stands. The van leaves the lane between 2 and 6 s after the start."""
    outcome = json.loads((revealed / "out" / "outcome.json").read_text())
    assert {tuple(attempt["adversaries"]) for attempt in outcome["attempts"]} == {("stalled", "lead")}
    assert [(each["id"], each["role"]) for each in outcome["adversaries"]] == [
        ("stalled", "collider"), ("lead", "play"),
    ]  # fmt: skip
    assert [each["id"] for each in outcome["attackers"]] == ["stalled"]
    asked = outcome["asked"]
    assert asked["fits"] and [part["name"] for part in asked["parts"]] == ["stalled: relation", "lead: events: leaves"]
    left = next(line for line in asked["motion"].splitlines() if line.endswith("B goes out of EGO's way."))
    assert 2.0 < float(left.split(" s:")[0]) < 7.5
