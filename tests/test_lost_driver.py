"""Drivers that hang, end their process or take too much memory: one sentence, and only the attempt is lost."""

from __future__ import annotations

import json
import re

import pytest
from cli_samples import Program

DRIVER = """
import os, sys, time

class Driver:
    forkable = True

    def reset(self, seed):
        self.kept = []

    def act(self, seen):
        if any(other.acceleration < -2.0 for other in seen.others):
            {does}
        return None
"""  # SUMO drives, until the vehicle ahead brakes hard: that happens in an attack alone


def lost(program: Program, does: str, *options: str) -> tuple[int, dict[str, object]]:
    """Status and outcome of a run with one attempt against a driver that does this."""
    (program.folder / "lost.py").write_text(DRIVER.format(does=does), encoding="utf-8")
    done = program(
        "run", "leader_brakes_hard", "--ego", "lost:Driver", "--until", "serious", "--attempts", "1", "--learn", "off",
        "--out", "out", "--force", *options,
    )  # fmt: skip
    return done.status, json.loads((program.folder / "out" / "outcome.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("does", "sentence"),
    [
        ("time.sleep(1000)", "The ego 'lost:Driver' was still in act at "),
        ("while True: pass", "The ego 'lost:Driver' was still in act at "),
        ("sys.exit(3)", "The ego 'lost:Driver' wanted to end the program in act at "),
        ("os._exit(3)", "The driver under test ended its process in act at "),
        ("os.kill(os.getpid(), 11)", "The driver under test ended its process in act at "),
        ("self.kept.append(bytearray(6 * 10**9))", "it used more memory than an attempt may (attempt_memory)"),
    ],
)
def test_an_attempt_is_lost_with_a_sentence_that_names_driver_step_and_time(
    program: Program, does: str, sentence: str
) -> None:
    status, outcome = lost(program, does, "--ego-deadline", "0.5")
    assert status == 1
    assert outcome["ending"] == "simulation_failed"
    assert sentence in str(outcome["reason"])
    assert re.search(r" at \d+\.\d s", str(outcome["reason"]))


def test_a_driver_that_does_nothing_of_it_is_not_disturbed(program: Program) -> None:
    status, outcome = lost(program, "pass", "--ego-deadline", "0.5")
    assert (status, outcome["ending"]) in [(0, "critical"), (0, "attempts_exhausted")]


def test_without_forks_the_sentence_says_where_the_process_ended(program: Program) -> None:
    _, outcome = lost(program, "os._exit(3)", "--no-fork")
    assert "The driver under test ended the simulation process in act at " in str(outcome["reason"])
