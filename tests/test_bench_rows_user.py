"""A user's own generator in the benchmark: loading it, checking its answers, and the example against a real ego."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench_rows_samples import LIBRARY, encounter
from situation_samples import neighbour

from sumo_adv.app import load, shipped_bank
from sumo_adv.benchmark.arena import Arena
from sumo_adv.benchmark.nouns import course_proposal
from sumo_adv.benchmark.rows import make_row
from sumo_adv.config import Settings
from sumo_adv.datatypes import Ending, Level, PrescribedMotion, Proposal
from sumo_adv.episode.engine import episode_worker
from sumo_adv.episode.task import make_task
from sumo_adv.errors import PlannerResultError, PlannerRuntimeError, SumoAdvError, UsageError
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.simulation.engine import Engine

EXAMPLE = Path(__file__).parents[1] / "examples" / "own_generator"
N = 5


def course(**changed: Any) -> PrescribedMotion:
    arrays = {"x": np.arange(N) + 20.0, "y": np.full(N, 3.2), "heading": np.zeros(N), "speed": np.full(N, 10.0)}
    return PrescribedMotion(**{**arrays, **changed})


class Says:
    """A generator that answers what the test put into ``answer``."""

    answer: Callable[[], Any] = staticmethod(lambda: None)

    def begin(self, encounter: Any) -> None:
        """Nothing."""

    def propose(self, tried: Any) -> Any:
        return Says.answer()


class Stumbles(Says):
    def begin(self, encounter: Any) -> None:
        raise KeyError("targets")


class Scribbles(Says):
    def begin(self, encounter: Any) -> None:
        first = min(encounter.situations)
        encounter.situations[first].baseline.v[:] = 0.0
        encounter.situations.clear()


class WantsArguments(Says):
    def __init__(self, size: int) -> None:
        """It cannot be made without."""


class Half:
    def begin(self, encounter: Any) -> None:
        """It proposes nothing."""


HERE = __name__


def test_what_a_generator_writes_into_its_encounter_is_not_seen_by_other_rows() -> None:
    met = encounter([neighbour()])
    make_row(f"{HERE}:Scribbles").begin(met)
    assert len(met.situations) >= 1 and all((s.baseline.v > 0.0).all() for s in met.situations.values())


def answered(answer: Callable[[], Any]) -> Proposal | None:
    Says.answer = staticmethod(answer)
    row = make_row(f"{HERE}:Says")
    row.begin(encounter([neighbour()]))
    return row.propose([])


def sentence(error: pytest.ExceptionInfo[SumoAdvError]) -> str:
    text = str(error.value)
    assert "\n" not in text and text.endswith(".") and ".." not in text
    return text


# -- loading


@pytest.mark.parametrize(
    ("spec", "named"),
    [
        ("no_such_module_of_anybody:Row", "ModuleNotFoundError"),
        (f"{HERE}:Missing", "no class 'Missing'"),
        (f"{HERE}:N", "no class 'N'"),
        (f"{HERE}:WantsArguments", "size"),
        (f"{HERE}:Half", "no method 'propose'"),
        (":Row", "module:Class"),
    ],
)
def test_a_generator_that_cannot_be_loaded_is_refused(spec: str, named: str) -> None:
    with pytest.raises(UsageError) as error:
        make_row(spec)
    assert named in sentence(error) and repr(spec) in sentence(error)


# -- its answers


def test_what_it_proposes_is_taken_and_marked_as_its_own() -> None:
    plan = answered(lambda: course_proposal("anything", "bv", 0.0, course(x=[20, 21, 22, 23, 24])))
    assert plan is not None and plan.course is not None
    assert plan.by == f"{HERE}:Says"
    assert plan.course.x.dtype == np.float64 and plan.course.x.tolist() == [20.0, 21.0, 22.0, 23.0, 24.0]
    assert answered(lambda: None) is None


def test_it_may_propose_a_planner_of_the_library() -> None:
    planner = LIBRARY[0].planners[0]
    plan = answered(lambda: Proposal("bv", planner.label, planner, {"gap": 1.0}, -2.0, 0.0))
    assert plan is not None and plan.planner is planner and plan.by == f"{HERE}:Says"


PLANNER = LIBRARY[0].planners[0]
FINE = course_proposal("mine", "bv", 0.0, course())


@pytest.mark.parametrize(
    ("answer", "named"),
    [
        ("cut in!", "str; propose must return a Proposal or None"),
        (course(), "PrescribedMotion; propose must"),
        (replace(FINE, delay=0.7), "delay 0.7"),
        (replace(FINE, bv="nobody"), "vehicle 'nobody'; use one of the encounter's targets, bv"),
        (replace(FINE, course=[1.0, 2.0]), "course that is list"),
        (replace(FINE, course=course(y=np.zeros(N - 1))), "one length"),
        (replace(FINE, course=course(x=np.zeros((N, 2)))), "one length"),
        (replace(FINE, course=PrescribedMotion(*[np.zeros(0)] * 4)), "1 or more"),
        (replace(FINE, course=course(heading=np.array([0, 0, np.nan, 0, 0]))), "not finite"),
        (replace(FINE, course=course(speed=np.full(N, -1.0))), "negative speeds"),
        (replace(FINE, course=course(x=["a"] * N)), "arrays of numbers"),
        (replace(FINE, course=None), "neither a course nor a planner"),
        (Proposal("bv", "x", PLANNER, {"gap": float("inf")}, 0.0, 0.0), "finite numbers"),
        (Proposal("bv", "x", PLANNER, {}, float("nan"), 0.0), "finite numbers"),
        (replace(FINE, delay=[0.0]), "wrong type"),  # type: ignore[arg-type]
        (Proposal("bv", "x", PLANNER, None, 0.0, 0.0), "wrong type"),  # type: ignore[arg-type]
    ],
)
def test_an_answer_that_cannot_be_driven_is_named(answer: Any, named: str) -> None:
    with pytest.raises(PlannerResultError) as error:
        answered(lambda: answer)
    assert named in sentence(error) and f"'{HERE}:Says'" in sentence(error)


def test_its_exceptions_name_class_and_error() -> None:
    with pytest.raises(PlannerRuntimeError) as error:
        answered(lambda: 1 / 0)
    assert f"'{HERE}:Says' failed in propose: ZeroDivisionError: division by zero" in sentence(error)
    with pytest.raises(PlannerRuntimeError) as error:
        make_row(f"{HERE}:Stumbles").begin(encounter([neighbour()]))
    assert f"'{HERE}:Stumbles' failed in begin: KeyError: 'targets'" in sentence(error)


# -- against a real ego


@pytest.fixture(scope="module")
def arena() -> Iterator[tuple[Arena, MemoryBank]]:
    """A car beside and behind an ego that drives what it drove unattacked; at most two attempts a row."""
    run_input = load(Path("neighbour_behind_left"), None)
    settings = Settings(ego="replay", until="valid", attempts=2, horizon=run_input.horizon or 8.0)
    with (
        tempfile.TemporaryDirectory() as scratch,
        MemoryBank.open(shipped_bank(), read_only=True) as bank,
        Sandbox() as sandbox,
        Engine(episode_worker) as engine,
    ):
        yield (
            Arena(run_input, settings, make_task(run_input, settings, Path(scratch)), engine, sandbox, bank, settings),
            bank,
        )


def test_the_example_collides_within_two_attempts(
    arena: tuple[Arena, MemoryBank], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(EXAMPLE)
    run = arena[0].by_opponent(make_row("straight_at_it:StraightAtIt"), arena[1])
    assert run.best is not None
    best = run.best.best
    assert best is not None and best.verdict.level >= Level.COLLISION
    assert best.proposal.by == "straight_at_it:StraightAtIt"
    assert best.proposal.course is not None


def test_other_rows_run_there_too(arena: tuple[Arena, MemoryBank]) -> None:
    for name in ("random", "resampling"):
        run = arena[0].by_opponent(make_row(name), arena[1])
        assert run.best is not None
        attempts = run.best.attempts
        assert 1 <= len(attempts) <= 2 and {a.proposal.by for a in attempts} == {name}
        assert {a.ending for a in attempts} <= {"contact", "passed", "time_limit"}


class AsksForNobody:
    """What the engine refuses in its fork: an attempt that is lost, as if SUMO had crashed there."""

    name = "nobody"

    def begin(self, encounter: Any) -> None:
        self.row = make_row("resampling")
        self.row.begin(encounter)

    def propose(self, tried: Any) -> Proposal | None:
        plan = self.row.propose(tried)
        return replace(plan, bv="nobody") if plan is not None and not tried else plan


def test_an_attempt_that_is_lost_is_one_that_failed(arena: tuple[Arena, MemoryBank]) -> None:
    record = arena[0].by_opponent(AsksForNobody(), arena[1]).best
    assert record is not None
    lost, driven = record.attempts
    assert (lost.ending, lost.verdict.feasible, lost.verdict.collided) == ("planner_failed", False, False)
    assert lost.verdict.level is Level.NONE
    assert "nobody" in lost.message
    assert driven.ending in {"contact", "passed", "time_limit"}


def test_a_generator_that_fails_ends_its_row_with_a_sentence(arena: tuple[Arena, MemoryBank]) -> None:
    Says.answer = staticmethod(lambda: "cut in!")
    run = arena[0].by_opponent(make_row(f"{HERE}:Says"), arena[1])
    assert run.ending is Ending.PLANNER_FAILED
    assert "returned str" in run.reason
