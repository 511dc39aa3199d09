"""The engine process: its answers, its failures, and its end without remains."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from engine_samples import BrokenErrands, Errands
from sumo_samples import make_spec, vehicle

from sumo_adv.errors import SimulationError, UsageError
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.forks import can_fork
from sumo_adv.simulation.simulation_spec import SimulationSpec

needs_fork = pytest.mark.skipif(not can_fork(), reason="this system cannot fork a simulation")


@pytest.fixture(scope="module")
def engine() -> Iterator[Engine[Errands]]:
    """One engine for all stories that leave it alive."""
    with Engine(Errands) as shared:
        yield shared


def alive(pid: int) -> bool:
    """Whether a process is there and not just waiting to be collected."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


def gone(pid: int, patience: float = 3.0) -> bool:
    """Whether a process has ended within ``patience`` seconds."""
    end = time.monotonic() + patience
    while alive(pid) and time.monotonic() < end:
        time.sleep(0.02)
    return not alive(pid)


# ---- commands and questions


def test_commands_are_done_in_another_process(engine: Engine[Errands]) -> None:
    assert engine.call(Errands.add, 2, 3) == 5
    assert engine.call(Errands.pid) != os.getpid()


def test_the_front_answers_while_it_waits(engine: Engine[Errands]) -> None:
    assert engine.call_answering(lambda q: q * q, Errands.ask, [3, 4]) == [9, 16]
    assert engine.call(Errands.ask, [3]) == [None]  # there is no front to ask


def test_a_command_may_be_a_conversation(engine: Engine[Errands]) -> None:
    talk = engine.converse(lambda number: number * number, Errands.talk, 1)
    assert (talk.said, talk.ask(2), talk.ask(3)) == (1, 5, 14)
    talk.end()
    talk.end()
    assert engine.call(Errands.add, 2, 3) == 5


def test_a_conversation_that_fails_is_over(engine: Engine[Errands]) -> None:
    talk = engine.converse(None, Errands.talk, 1)
    for sentence in ("Nothing was added", "begin another"):
        with pytest.raises(SimulationError, match=sentence):
            talk.ask(0)
    talk.end()
    assert engine.call(Errands.add, 2, 3) == 5


@needs_fork
def test_two_forks_ask_through_slots_of_their_own(engine: Engine[Errands]) -> None:
    askers: list[int] = []

    def answer(pid: int) -> int:
        askers.append(pid)
        return -pid

    answers = engine.call_answering(answer, Errands.ask_in_forks)
    assert sorted(answers) == sorted(-pid for pid in askers)
    assert len({*askers, engine.call(Errands.pid)}) == 3


def test_errors_of_ours_come_through_and_others_are_named(engine: Engine[Errands]) -> None:
    with pytest.raises(UsageError, match=r"^The input is wrong; give another\.$"):
        engine.call(Errands.wrong_use)
    with pytest.raises(SimulationError, match=r"^The simulation failed \(ZeroDivisionError: one by none\)\.$"):
        engine.call(Errands.bug)
    assert engine.call(Errands.add, 1, 1) == 2


# ---- forks


@needs_fork
def test_forks_give_their_results_in_order(engine: Engine[Errands]) -> None:
    assert engine.call(Errands.squares, [3, 4, 5]) == [9, 16, 25]


@needs_fork
@pytest.mark.parametrize(
    ("failure", "kind", "sentence"),
    [
        ("divides", SimulationError, r"An attempt failed \(ZeroDivisionError: .*\)\."),
        ("refuses", UsageError, "The input is wrong; give another."),
        ("dies", SimulationError, r"A forked attempt was killed \(SIGKILL\)\.$"),
        ("crashes", SimulationError, r"SUMO or the ego's driver crashed in a forked attempt \(SIGSEGV\)\.$"),
        ("exits", SimulationError, r"A forked attempt ended without a result \(exit status 3\)\.$"),
        ("cannot_be_sent", SimulationError, r"An attempt failed \(.*pickle.*\)\."),
    ],
)
def test_a_fork_that_fails_is_an_error_and_the_engine_goes_on(
    engine: Engine[Errands], failure: str, kind: type[Exception], sentence: str
) -> None:
    with pytest.raises(kind, match=sentence):
        engine.call(Errands.fork_that, failure)
    assert engine.call(Errands.add, 2, 2) == 4


@needs_fork
def test_a_fork_that_dies_is_repeated_once_by_reload(engine: Engine[Errands]) -> None:
    """The second piece of work crashes before the reload and does well after it; the third crashes both times."""
    assert engine.call(Errands.fork_again, [1, -2, 3]) == ["1", "-2 reloaded", "3"]
    with pytest.raises(SimulationError, match="also when the simulation was loaded again and the attempt repeated"):
        engine.call(Errands.fork_again, [1, 0])


@needs_fork
def test_a_fork_that_dies_twice_may_be_skipped(engine: Engine[Errands]) -> None:
    first, died, last = engine.call(Errands.fork_again, [1, 0, 2], True)
    assert (first, last) == ("1", "2")
    assert died.startswith("SUMO OR THE EGO'S DRIVER CRASHED IN A FORKED ATTEMPT (SIGSEGV), ALSO WHEN")


@needs_fork
def test_forks_run_as_the_process_itself_would(engine: Engine[Errands], tmp_path: Path) -> None:
    cars = [vehicle(f"car{k}", "eastbound", k % 3, 40.0 + 9.0 * k, 12.0, "nervous") for k in range(8)]
    spec = make_spec(tmp_path, "straight_3lane", [*cars, vehicle("leader", "eastbound", 0, 125.0, 12.0)])
    first, second, in_place, again = engine.call(Errands.branches, spec)
    assert len(first) == 30
    assert first == second
    assert first == in_place
    assert first == again


# ---- SUMO's own words


def test_sumo_says_what_is_wrong_with_an_input(engine: Engine[Errands], tmp_path: Path) -> None:
    spec = make_spec(tmp_path, "straight_3lane", [vehicle("ego", "nowhere", 0, 10.0, 5.0)])
    with pytest.raises(
        SimulationError, match=r"The edge 'nowhere' within the route for vehicle 'ego' is not known\. The"
    ):
        engine.call(Errands.simulate, spec)
    missing = SimulationSpec(tmp_path / "missing.net.xml", (), (), 0.0, 1)
    with pytest.raises(SimulationError, match=r"missing\.net\.xml"):
        engine.call(Errands.simulate, missing)


def test_words_on_stderr_end_up_in_the_sentence_of_their_own_failure_alone(engine: Engine[Errands]) -> None:
    with pytest.raises(SimulationError, match=r"^SUMO failed: The wheel came off$"):
        engine.call(Errands.complain, "The wheel came off", "SUMO failed.")
    with pytest.raises(SimulationError, match=r"^No fuel\.$"):
        engine.call(Errands.complain, "", "No fuel.")


# ---- ends


def test_a_killed_engine_is_one_sentence_and_leaves_no_process() -> None:
    with Engine(Errands) as engine:
        pid = engine.call(Errands.pid)
        assert alive(pid)
        with pytest.raises(SimulationError, match=r"^The simulation process ended unexpectedly.*\.$"):
            engine.call(Errands.die)
        with pytest.raises(SimulationError, match="ended unexpectedly"):
            engine.call(Errands.add, 1, 1)
    assert gone(pid, 0.1)


def test_an_engine_that_cannot_be_set_up_says_why() -> None:
    with Engine(BrokenErrands) as engine, pytest.raises(SimulationError, match="Nothing works here"):
        engine.call(Errands.add, 1, 1)


@needs_fork
def test_a_front_that_gives_up_leaves_neither_engine_nor_forks() -> None:
    askers: list[int] = []

    def interrupted(pid: int) -> None:
        askers.append(pid)
        raise KeyboardInterrupt

    engine = Engine(Errands)
    pid = engine.call(Errands.pid)
    with pytest.raises(KeyboardInterrupt):
        engine.call_answering(interrupted, Errands.ask_in_forks)
    engine.close()
    assert gone(pid, 0.1)
    assert all(gone(child) for child in askers)


@needs_fork
def test_forks_of_a_killed_engine_do_not_take_its_place() -> None:
    askers: list[int] = []
    with Engine(Errands) as engine:
        pid = engine.call(Errands.pid)

        def kill_the_engine(child: int) -> None:
            askers.append(child)
            if alive(pid):
                os.kill(pid, signal.SIGKILL)

        with pytest.raises(SimulationError, match="ended unexpectedly"):
            engine.call_answering(kill_the_engine, Errands.ask_in_forks)
    assert gone(pid, 0.1)
    assert all(gone(child) for child in askers)


def test_a_busy_engine_is_ended_too() -> None:
    engine = Engine(Errands)
    pid = engine.call(Errands.pid)
    engine.post(Errands.sleep, 60.0)
    start = time.monotonic()
    engine.close()
    assert time.monotonic() - start < 4.0
    assert gone(pid, 0.1)
