"""A planner that runs into its limits now and then: it is given up after a few calls, for the rest of an episode."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
from cli_samples import HEAD, TRAIL
from situation_samples import KRAUSS, neighbour, situation

from sumo_adv.datatypes import Limits, Planner, Proposal
from sumo_adv.errors import PlannerLimitError
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.session import MAX_STOPPED_CALLS, SandboxLimits
from sumo_adv.planners.sessions import Roads, Sessions
from sumo_adv.planners.text import make_planner
from sumo_adv.search.rollouts import predict

HERE = {0.0: situation([neighbour()], model=replace(KRAUSS, kind="replay"))}
AT_TIMES = "    while 0.9 < bv['time'] < 1.9:\n        pass\n"
"""Never in the trial of planners, which asks 0, 2 and 5 s after the trigger."""


@pytest.fixture(scope="module")
def sandbox() -> Iterator[Sandbox]:
    with Sandbox(SandboxLimits(call_seconds=0.05, batch_seconds=60.0)) as box:
        yield box


def planner(before: str) -> Planner:
    return make_planner("Odd", "plain", HEAD + before + TRAIL.removeprefix(HEAD), "person")


def predicted(sandbox: Sandbox, chosen: Planner, stopped: dict[str, int] | None = None) -> Sessions:
    """The sessions after a prediction of 20 candidates over 4 s, in which the planner is asked each second."""
    proposals = [Proposal("bv", "Odd", chosen, chosen.defaults(), 0.0, 0.0)] * 20
    with Sessions(sandbox, Roads(HERE), proposals, 0, stopped=stopped) as sessions:
        predict(
            HERE, proposals, lambda rows, observations: sessions.answers(proposals, rows, observations),
            limits=Limits(), steps=40, replan=10,
        )  # fmt: skip
    return sessions


def test_a_batch_gives_up_after_three_calls_that_never_end(sandbox: Sandbox) -> None:
    endless = make_planner("Odd", "endless", HEAD + "    while True:\n        pass\n", "person")
    with sandbox.session(endless, {"a": {}}) as session:
        answers = session.endpoints([("a", {}, {"path": []}, {}, 0.0, 1.0)] * 20)
    assert all(isinstance(answer, PlannerLimitError) for answer in answers)
    stopped = ["ran into a limit" in str(answer) for answer in answers]
    assert stopped == [True] * MAX_STOPPED_CALLS + [False] * (20 - MAX_STOPPED_CALLS)


def test_a_planner_that_loops_for_a_second_is_asked_no_more_in_that_episode(sandbox: Sandbox) -> None:
    looping, honest = planner(AT_TIMES), planner("")
    assert predicted(sandbox, honest).failures == {}
    first = predicted(sandbox, looping)
    assert "ran into a limit" in first.failures[looping.hash]
    later = predicted(sandbox, looping, dict(first.stopped))
    assert "ran into its limits again and again" in later.failures[looping.hash]
    assert later.broken == {}  # nothing was asked
