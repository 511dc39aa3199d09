"""Trusted planners answer in this process: which they are, that their answers are the sandbox's, and what fails."""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bank_samples import shipped_planners
from situation_samples import crossing, leader, neighbour, situation

from sumo_adv.datatypes import Planner, PrescribedMotion, Proposal
from sumo_adv.episode.memory_access import unprotected_library
from sumo_adv.errors import PlannerRuntimeError, SandboxError
from sumo_adv.planners.adversary_batch import AdversaryBatch
from sumo_adv.planners.answers import Answer, PlannerObservation, planner_road
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.scripts import script_planner
from sumo_adv.planners.session import Call
from sumo_adv.planners.sessions import TRUSTED, InProcessSession, Roads, Sessions, ask_trusted, fingerprint, is_trusted
from sumo_adv.planners.text import make_planner
from sumo_adv.script import Script
from sumo_adv.search.intents import FREE
from sumo_adv.search.support_intents import SUPPORT_INTENTS

SHIPPED = [*shipped_planners().values(), *(p for entry in unprotected_library() for p in entry.planners)]
SIDE = shipped_planners()["Straight Lane Shift", "side"].text
BESIDE = situation([neighbour()])
WALKS = script_planner(
    Script.model_validate({"applies": ["pedestrian"], "actions": [{"verb": "walk_to", "offset": 0}]})
)
BRAKES = script_planner(Script.model_validate({"applies": ["leader"], "actions": [{"verb": "brake", "rate": 4}]}))


def planner(source: str) -> Planner:
    return make_planner("Any", "any", source, "somebody")


@pytest.mark.parametrize("p", SHIPPED, ids=lambda p: f"{p.label}/{p.mode}")
def test_every_planner_of_the_shipped_bank_is_trusted(p: Planner) -> None:
    assert is_trusted(p), f"write {fingerprint(p.text)} into TRUSTED (sumo_adv/planners/sessions.py)"


def test_no_text_is_trusted_that_the_bank_does_not_have() -> None:
    supports = [p for those in SUPPORT_INTENTS.values() for entry in those for p in entry.planners]
    assert {fingerprint(p.text) for p in (*SHIPPED, *supports, *FREE.planners, BRAKES, WALKS)} == TRUSTED


def test_a_text_with_other_numbers_and_another_movement_is_trusted() -> None:
    direct = shipped_planners()["Intersection Rush-through Turn Left", "direct"].text
    assert is_trusted(planner(direct.replace('MOVEMENT = "left"', 'MOVEMENT = "right"')))
    assert is_trusted(planner(SIDE.replace('"gap": (', '"gap": (2.5, 1.0, 12.0, "m", "x"), "gap_2": (')))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("import math", "import math\nimport os"),
        ("}\n\nimport math", "}; import os\n\nimport math"),  # on the table's own line
        ("base = base_lane", "base = 0.0 * base_lane"),
        ("import math", 'import math\nMOVEMENT = "left" + str(1)'),
        ("def beside(", "def trajectory(bv, endpoint, road, dt):\n    return []\n\n\ndef beside("),
    ],
)
def test_a_text_with_one_line_changed_is_not(old: str, new: str) -> None:
    assert old in SIDE
    changed = planner(SIDE.replace(old, new, 1))
    assert not is_trusted(changed)
    with pytest.raises(SandboxError, match="is not trusted"):
        InProcessSession(changed, {}, lambda: pytest.fail("no session is opened"))


def test_of_a_trusted_text_only_the_part_that_was_compared_runs(sandbox: Sandbox, tmp_path: Path) -> None:
    """An annotation of the table would be evaluated. It stands before the compared part, and never runs here."""
    annotated = f'"""Ours."""\nPARAMETERS: open({str(tmp_path / "owned")!r}, "w")'
    p = planner(SIDE.replace("PARAMETERS", annotated, 1))
    assert is_trusted(p)
    roads, calls = questions(p, 2)
    inside = InProcessSession(p, roads, lambda: sandbox.session(p, roads))
    assert all(isinstance(a, dict) for a in inside.endpoints(calls))
    assert list(tmp_path.iterdir()) == []


def questions(p: Planner, count: int) -> tuple[Mapping[str, Mapping[str, Any]], list[Call]]:
    """Calls for three vehicles at the trigger and, moved at random, later on."""
    draw = random.Random(3)
    calls: list[Call] = []
    roads = {}
    for k, target in enumerate((neighbour(), leader(), crossing())):
        sit = situation([target])
        batch = AdversaryBatch([sit] * count, ["bv"] * count)
        motion = batch.begin()
        motion = motion._replace(
            s=motion.s + np.linspace(0.0, 60.0, count), d=motion.d + np.linspace(-2.0, 2.0, count), v=motion.v * 0.7
        )
        ego = (np.linspace(0.0, 40.0, count), np.zeros(count), np.full(count, 9.0), np.zeros(count))
        last = [
            None if j % 2 else {"x": 1.0, "y": 0.0, "heading": 0.0, "speed": 3.0, "time": 1.0} for j in range(count)
        ]
        roads[str(k)] = planner_road(sit, "bv")
        for bv, ego_seen in batch.observe(motion, 1.5, ego, last):
            numbers = {q.name: draw.uniform(q.low, q.high) for q in p.parameters}
            calls.append((str(k), bv, ego_seen, numbers, draw.choice([0.0, -6.0]), 3.0))
    return roads, calls


@pytest.mark.parametrize("p", SHIPPED, ids=lambda p: f"{p.label}/{p.mode}")
def test_the_answers_are_the_sandbox_s_to_the_last_bit(p: Planner, sandbox: Sandbox) -> None:
    roads, calls = questions(p, 8)
    inside = InProcessSession(p, roads, lambda: sandbox.session(p, roads))
    with sandbox.session(p, roads) as session:
        expected = session.endpoints(calls)
    answers = inside.endpoints(calls)
    inside.close()
    assert [a if isinstance(a, dict) else type(a) for a in answers] == [
        a if isinstance(a, dict) else type(a) for a in expected
    ]
    assert any(isinstance(a, dict) for a in answers)


def test_a_call_that_fails_here_gets_the_sandbox_s_message(sandbox: Sandbox) -> None:
    p = planner(SIDE)
    roads, calls = questions(p, 2)
    broken = {**roads, "1": {}}
    inside = InProcessSession(p, broken, lambda: sandbox.session(p, broken))
    answers = inside.endpoints(calls)
    assert [isinstance(a, PlannerRuntimeError) for a in answers] == [False, False, True, True, False, False]
    assert "KeyError" in str(answers[2])
    with pytest.raises(PlannerRuntimeError, match="KeyError"):
        inside.endpoint(*calls[2])
    inside.close()
    inside.close()


# ---- in an attempt


def proposal(source: str = SIDE) -> Proposal:
    p = make_planner("Straight Lane Shift", "side", source, "somebody")
    return Proposal("bv", p.label, p, p.defaults(), 0.0, 0.0)


def observation() -> PlannerObservation:
    batch = AdversaryBatch([BESIDE], ["bv"])
    ego = tuple(np.array([q]) for q in (0.0, 0.0, 10.0, 0.0))
    return batch.observe(batch.begin(), 0.0, ego, [None])[0]  # type: ignore[arg-type]


class Fallback:
    """Answers instead of a planner; ``calls``: how often."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, observation: PlannerObservation) -> Answer | str:
        self.calls += 1
        return "fallback"


def test_a_trusted_planner_answers_as_in_the_sandbox_without_the_fallback(sandbox: Sandbox) -> None:
    fallback, p = Fallback(), proposal()
    answer = ask_trusted(p, BESIDE, fallback)(observation())
    with Sessions(sandbox, Roads({0.0: BESIDE}), [p], 0) as sessions:
        assert answer == sessions.answer(p, observation())
    assert fallback.calls == 0


def test_any_other_planner_and_a_prescribed_motion_use_the_fallback() -> None:
    still = np.zeros(3)
    prescribed = replace(proposal(), course=PrescribedMotion(still, still, still, still))
    fallback = Fallback()
    for p in (proposal(SIDE.replace("base = base_lane", "base = 0.0 * base_lane")), prescribed):
        assert ask_trusted(p, BESIDE, fallback) is fallback


def test_each_call_that_fails_in_an_attempt_uses_the_fallback() -> None:
    fallback, (bv, ego) = Fallback(), observation()
    ask = ask_trusted(proposal(), BESIDE, fallback)
    broken = {name: value for name, value in bv.items() if name != "ahead"}
    assert [ask((broken, ego)), ask((broken, ego))] == ["fallback"] * 2
    assert fallback.calls == 2
    assert isinstance(ask((bv, ego)), Answer)
