"""What breaks a hunt: Ctrl-C, a full disk, a driver that hangs. What was found stays, and the same command goes on.

``test_batch_run.py`` interrupts what a hunt is made of, so that its own two long stories are in ``make soak``.
"""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from cli_samples import Program, tiny_disk
from test_interrupt import interrupted, wait_until

from sumo_adv.campaigns.local import OVERTIME_S
from sumo_adv.simulation.forks import can_fork

HUNT = (
    "hunt", "motorway_cut_in_left", "priority_crossing", "neighbour_ahead_left", "--ego", "idm", "--workers", "1",
    "--minutes", "0.5", "--no-pages",
)  # fmt: skip


def whole(hunt: Path) -> set[str]:
    """The runs that are there; those that are being written are hidden."""
    return {folder.name for folder in hunt.glob("rounds/*/runs/[!.]*") if (folder / "outcome.json").is_file()}


def table(hunt: Path) -> list[dict[str, str]]:
    """The rows of ``results.csv``."""
    with (hunt / "results.csv").open(newline="", encoding="utf-8") as text:
        return list(csv.DictReader(text))


@pytest.mark.soak
def test_ctrl_c_finishes_what_runs_and_the_same_command_goes_on(program: Program) -> None:
    """Pressed after the first of three runs: the second one is finished if it has begun; the third one is left out."""
    hunt = program.folder / "hunt"
    with program.start(*HUNT, "--out", "hunt") as process:
        wait_until(process, lambda: len(whole(hunt)) == 1)
        done = interrupted(program, process)
    assert (done.status, "Traceback" in done.err) == (1, False)
    assert done.err.startswith("Finishing the episodes that run; Ctrl-C again stops them.")
    assert "Stopped by Ctrl-C: " in done.out and "Rerun the same command to continue." in done.out
    before = whole(hunt)
    assert 1 <= len(before) <= 2
    assert len(table(hunt)) == len(list((hunt / "failures").glob("*")))
    again = program.here(*HUNT, "--distinct", "1", "--out", "hunt")
    assert again.status == 0, again.err
    assert len(whole(hunt)) >= 3 and before < whole(hunt) and table(hunt)


@pytest.mark.soak
def test_a_full_disk_is_a_sentence_and_what_was_found_stays(program: Program) -> None:
    """A disk of 500 kB takes the memory bank and a run or two. On a larger one the hunt goes on."""
    disk, saved = program.folder / "disk", program.folder / "saved"
    before = tiny_disk(disk, "500k", f'cp -r "{disk}/hunt" "{saved}"')
    done = program(*HUNT, "--out", disk / "hunt", before=before)
    assert done.status == 1, done.err
    assert len(done.err.splitlines()) == 1 and "no space left" in done.err
    runs = whole(saved)
    assert runs
    again = program.here(*HUNT, "--distinct", "1", "--out", "saved")
    assert again.status == 0, again.err
    assert runs <= whole(saved) and table(saved)


@pytest.mark.skipif(not can_fork(), reason="this system cannot fork a simulation")
def test_a_driver_that_hangs_loses_that_attempt_alone(program: Program) -> None:
    """In its first attempt the driver does not return; the hunt says so at the end, with the step."""
    (program.folder / "settings.toml").write_text("ego_deadline = 1.0\n")
    options = ("--settings", "settings.toml", "--workers", "1", "--no-pages", "--out", "hunt", "--json")
    done = program.here(
        "hunt", "motorway_cut_in_left", "--ego", "stuck_drivers:SleepsForked", "--distinct", "1", "--minutes", "0.5",
        *options,
    )  # fmt: skip
    assert done.status == 0, done.err
    told = json.loads(done.out)
    assert len(told["lost"]) == 1
    assert "The ego's driver 'sleepy' did not return within 1 s in act (its step 65, at 6.5 s)" in told["lost"][0]
    assert told["attempts"] > 1 and told["failures"]


def test_a_slow_driver_takes_no_longer_than_the_hunt(program: Program) -> None:
    """An attempt of 80 steps takes 16 s of the 6 s that the hunt has; an episode goes on for 8 s at most after them."""
    done = program.here(
        "hunt", "motorway_cut_in_left", "--ego", "stuck_drivers:Slow", "--minutes", "0.1", "--workers", "1",
        "--no-pages", "--out", "hunt", "--json",
    )  # fmt: skip
    assert done.status == 0, done.err
    told = json.loads(done.out)
    assert (told["ended"], told["failures"]) == ("time", [])
    assert 6.0 <= told["seconds"] < 6.0 + OVERTIME_S + 10.0


def test_a_driver_that_cannot_be_made_ends_the_hunt(program: Program) -> None:
    done = program.here("hunt", "motorway_cut_in_left", "--ego", "stuck_drivers:ExitsAtOnce", "--minutes", "30")
    assert done.status != 0 and len(done.err.splitlines()) == 1
    assert "The ego 'stuck_drivers:ExitsAtOnce' could not be made: SystemExit: no licence." in done.err
