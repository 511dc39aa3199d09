"""SUMO drives an ego that is chosen here until an encounter comes; then the driver under test takes over."""

from __future__ import annotations

import json

from cli_samples import Program

MOTORWAY = (
    "run", "motorway", "--ego", "ego_samples:BrakingEgo", "--attempts", "1", "--total-seconds", "0", "--learn", "off",
    "--json",
)  # fmt: skip


def test_the_driver_drives_the_chosen_ego_in_the_attack(program: Program) -> None:
    """It gives each answer of the attempt, and few before: the encounter begins after two minutes, 1,200 steps."""
    told = json.loads(program.here(*MOTORWAY).out)
    assert told["encounter"]["time"] > 100.0
    assert told["ego_actions"]["LaneSpeed"] > 30 and "SUMO" not in told["ego_actions"]
    assert 30 < told["driver_time"]["calls"] < 600


def test_with_a_trigger_the_driver_drives_the_ego_from_its_choice_on(program: Program) -> None:
    """The ego is chosen after 5 s, so the driver answers 200 times until 25 s."""
    told = json.loads(program.here(*MOTORWAY, "--trigger", "25").out)
    assert told["driver_time"]["calls"] >= 200
