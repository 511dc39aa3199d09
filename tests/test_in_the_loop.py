"""Levels hold in the loop: the careful driver avoids each strict attack, whose adversary plans again."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli_samples import Program

import sumo_adv

SCENARIOS = (
    "leader_brakes_hard", "neighbour_ahead_left", "neighbour_ahead_right", "motorway_cut_in_left",
    "priority_straight_from_left", "priority_straight_from_right", "signals_red_light", "oncoming_country_road",
)  # fmt: skip


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight attacks on SUMO's IDM."""
    folder = tmp_path_factory.mktemp("runs")
    for name in SCENARIOS:
        sumo_adv.run(name, until="strict", learn="off", attempts=40, seconds=600, out=folder / name)
    return folder


def outcome_of(run: Path) -> dict[str, object]:
    written: dict[str, object] = json.loads((run / "outcome.json").read_text(encoding="utf-8"))["outcome"]
    return written


def test_a_level_needs_a_driver_that_avoids_the_collision_in_both_checks(runs: Path) -> None:
    outcomes = [outcome_of(runs / name) for name in SCENARIOS]
    claimed = [o for o in outcomes if o["level"] in ("valid", "strict", "serious")]
    assert len(claimed) >= 6
    for outcome in claimed:
        references, in_loop = outcome["references"], outcome["in_loop"]
        assert isinstance(references, dict) and isinstance(in_loop, dict)
        both = [n for n, answer in references.items() if answer == "avoids" and in_loop.get(n) == "avoids"]
        assert outcome["preventable_by"] == both and {"cc_human", "manoeuvre", "reg157"} & set(both)
        assert (outcome["level"] == "valid") == ("cc_human" not in both)


def test_the_careful_driver_passes_every_strict_case(runs: Path, program: Program) -> None:
    strict = [name for name in SCENARIOS if outcome_of(runs / name)["level"] in ("strict", "serious")]
    assert len(strict) >= 5
    kept = program.here("keep", str(runs), "--suite", "suite", "--level", "strict")
    assert kept.status == 0 and f"{len(strict)} cases" in kept.out, kept.out
    done = program.here("regress", "suite", "--ego", "careful", "--out", "careful")
    assert (done.status, done.out.count(" pass ")) == (0, len(strict)), done.out
