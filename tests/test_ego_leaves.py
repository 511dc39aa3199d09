"""A recorded ego that leaves the network before its log ends: every branch ends there, and no command fails."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from cli_samples import Program
from log_samples import MIDDLE, RIGHT, moving, write_scenario

import sumo_adv.gym  # noqa: F401 - registers the environments

END = 1200.0  # m: where the shipped straight_3lane ends


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An ego that is 120 m before the end of the road at 0 s, and needs less than the 9 s of its log to get there."""
    x = END - 120.0
    tracks = [
        moving("e", x, RIGHT + 0.3, 14.0), moving("lead", x + 25.0, RIGHT, 12.0),
        moving("side", x - 12.0, MIDDLE, 15.0), moving("behind", x - 25.0, RIGHT, 15.0),
    ]  # fmt: skip
    return write_scenario(tmp_path_factory.mktemp("log"), tracks, routed=("e", "lead", "side", "behind"))


@pytest.fixture(scope="module")
def program_there(tmp_path_factory: pytest.TempPathFactory, caches: Path, case: Path) -> Program:
    """A program with a run of idm in ``out``."""
    program = Program(tmp_path_factory.mktemp("run"), caches)
    done = program.here("run", case, "--ego", "idm", "--attempts", "6", "--until", "collision", "--out", "out")
    assert (done.status, done.err) == (0, "")
    return program


def test_its_branches_end_where_it_leaves(program_there: Program) -> None:
    found = json.loads((program_there.folder / "out" / "outcome.json").read_text())
    assert found["ending"] != "simulation_failed" and found["attempts"]
    assert "crashed" not in {attempt["ending"] for attempt in found["attempts"]}


@pytest.mark.parametrize("ego", ["replay", "lattice"])
def test_other_drivers_leave_too(program: Program, case: Path, ego: str) -> None:
    done = program.here("run", case, "--ego", ego, "--attempts", "1", "--no-fork", "--out", "out", "--json")
    assert (done.status, done.err) == (0, "")


def test_what_is_made_of_the_run_works(program_there: Program) -> None:
    again = program_there.here("run", "--replay", "out", "--out", "again", "--json")
    mild = program_there.here("minimise", "out", "--attempts", "2", "--out", "mild", "--json")
    kept = program_there.here("keep", "out", "--suite", "suite", "--all")
    tested = program_there.here("regress", "suite", "--ego", "idm", "--out", "tested", "--json")
    assert [each.status for each in (again, mild, kept)] == [0, 0, 0], (again.err, mild.err, kept.err)
    assert tested.status in (0, 3) and "KeyError" not in tested.err + tested.out


def test_an_environment_ends_with_the_ego(case: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import gymnasium

    monkeypatch.setenv("SUMO_ADV_MEMORY", str(tmp_path / "bank.sqlite"))
    with gymnasium.make("sumo_adv/Adversary-v0", scenario=case) as env:
        env.reset(seed=0)
        over = False
        while not over:
            *_, terminated, truncated, info = env.step(np.zeros(env.action_space.shape or 1, np.float32))
            over = terminated or truncated
    assert info
