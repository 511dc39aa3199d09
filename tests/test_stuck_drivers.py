"""A driver that raises, hangs, leaks or ends its process costs an attempt, and the sentence names it."""

from __future__ import annotations

import pytest
from cli_samples import Program

from sumo_adv.simulation.forks import can_fork

needs_fork = pytest.mark.skipif(not can_fork(), reason="this system cannot fork a simulation")
RUN = ("run", "motorway_cut_in_left", "--attempts", "3", "--until", "serious", "--out", "out", "--learn", "off")
WHERE = "in act (its step 65, at 6.5 s)"  # the driver takes over at 0.1 s, when the ego is inserted
LATE = "The ego's driver 'sleepy' did not return within 1 s " + WHERE


@needs_fork
@pytest.mark.parametrize(
    ("driver", "sentence"),
    [
        ("Sleeps", LATE),
        ("CatchesAll", LATE),
        ("ExitsPython", f"'sleepy' ended the simulation process (SystemExit: 3) {WHERE}."),
        ("ExitsProcess", "'sleepy' ended the simulation process (exit status 4, also when the simulation was loaded"),
        (
            "Raises",
            "The ego 'stuck_drivers:Raises' failed in act at 6.5 s: ZeroDivisionError: no gap (stuck_drivers.py, line ",
        ),
        ("Leaks", "The memory of an attempt, 500 MiB, was used up with the ego's driver 'sleepy' in its step 65, at"),
    ],
)
def test_one_attempt_is_lost(program: Program, driver: str, sentence: str) -> None:
    (program.folder / "settings.toml").write_text("attempt_memory = 500\n")
    deadline = "60" if driver == "Leaks" else "1"  # a slow machine needs seconds to fill its memory
    options = ("--ego-deadline", deadline, "--settings", "settings.toml")
    done = program.here(*RUN, "--ego", f"stuck_drivers:{driver}", *options)
    assert done.status == 0, done.err
    first, *rest = done.outcome["attempts"]
    assert first["ending"] == "crashed" and sentence in first["message"]
    assert len(rest) == 2 and all(attempt["ending"] != "crashed" for attempt in rest)


@needs_fork
def test_five_lost_attempts_are_enough(program: Program) -> None:
    many = [word if word != "3" else "50" for word in RUN]
    done = program.here(*many, "--ego", "stuck_drivers:AlwaysRaises")
    assert done.status == 1 and done.outcome["ending"] == "simulation_failed"
    assert [attempt["ending"] for attempt in done.outcome["attempts"]] == ["crashed"] * 5
    assert "ZeroDivisionError: no gap" in done.err


@needs_fork
def test_a_process_that_cannot_go_on_is_explained(program: Program) -> None:
    done = program.here(*RUN, "--ego", "stuck_drivers:AlwaysExits")
    assert done.status == 1 and len(done.err.splitlines()) == 1
    assert f"The ego's driver 'sleepy' ended the simulation process (exit status 4) {WHERE}." in done.err
    assert done.outcome["ending"] == "simulation_failed"


@needs_fork
def test_a_process_that_ends_as_if_all_was_well_is_explained_too(program: Program) -> None:
    done = program.here(*RUN, "--ego", "stuck_drivers:AlwaysExitsAsIfDone")
    assert done.status == 1 and "'sleepy' ended the simulation process" in done.err, done.err


@needs_fork
def test_no_deadline_is_for_a_debugger(program: Program) -> None:
    """The driver stops for 3 s in its first attempt; with a deadline of 0 it may."""
    done = program.here(*RUN, "--ego", "stuck_drivers:Debugged", "--ego-deadline", "0")
    assert done.status == 0, done.err
    assert all(attempt["ending"] != "crashed" for attempt in done.outcome["attempts"])
