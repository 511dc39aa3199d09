"""Planners that are our own answer in this process: which they are, that they answer the same, and what fails."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bank_samples import shipped_planners
from situation_samples import crossing, leader, neighbour, situation

from sumo_adv.datatypes import Planner
from sumo_adv.errors import PlannerRuntimeError, SandboxError
from sumo_adv.planners.adversary_batch import AdversaryBatch
from sumo_adv.planners.road import road_of
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.session import Call
from sumo_adv.planners.source import make_planner
from sumo_adv.planners.trusted import OWN, InProcessSession, fingerprint, is_own

SHIPPED = list(shipped_planners().values())
SIDE = shipped_planners()["Straight Lane Shift", "side"].source


@pytest.fixture(scope="module")
def sandbox() -> Iterator[Sandbox]:
    with Sandbox() as box:
        yield box


def planner(source: str) -> Planner:
    return make_planner("Any", "any", source, "somebody")


@pytest.mark.parametrize("p", SHIPPED, ids=lambda p: f"{p.label}/{p.mode}")
def test_every_planner_of_the_shipped_bank_is_our_own(p: Planner) -> None:
    assert is_own(p), f"write {fingerprint(p.source)} into OWN (sumo_adv/planners/trusted.py)"


def test_nothing_is_our_own_that_the_bank_does_not_have() -> None:
    assert {fingerprint(p.source) for p in SHIPPED} == OWN


def test_other_numbers_and_another_movement_leave_it_our_own() -> None:
    direct = shipped_planners()["Intersection Rush-through Turn Left", "direct"].source
    assert is_own(planner(direct.replace('MOVEMENT = "left"', 'MOVEMENT = "right"')))
    assert is_own(planner(SIDE.replace('"gap": (', '"gap": (2.5, 1.0, 12.0, "m", "x"), "gap_2": (')))


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
    assert not is_own(changed)
    with pytest.raises(SandboxError, match="none of ours"):
        InProcessSession(changed, {}, lambda: pytest.fail("no session is opened"))


def test_of_a_text_that_is_our_own_only_the_part_that_was_compared_is_run(sandbox: Sandbox, tmp_path: Path) -> None:
    """An annotation of the table would be evaluated; it stands before what is compared, and is never run here."""
    annotated = f'"""Ours."""\nPARAMETERS: open({str(tmp_path / "owned")!r}, "w")'
    p = planner(SIDE.replace("PARAMETERS", annotated, 1))
    assert is_own(p)
    roads, calls = questions(p, 2)
    inside = InProcessSession(p, roads, lambda: sandbox.session(p, roads))
    assert all(isinstance(a, dict) for a in inside.endpoints(calls))
    assert list(tmp_path.iterdir()) == []


def questions(p: Planner, count: int) -> tuple[Mapping[str, Mapping[str, Any]], list[Call]]:
    """What the planner is asked of three vehicles at the trigger and, moved at random, later on."""
    draw = random.Random(3)
    calls: list[Call] = []
    roads = {}
    for k, target in enumerate((neighbour(), leader(), crossing())):
        sit = situation([target])
        ground = AdversaryBatch([sit] * count, ["bv"] * count)
        motion = ground.begin()
        motion = motion._replace(
            s=motion.s + np.linspace(0.0, 60.0, count), d=motion.d + np.linspace(-2.0, 2.0, count), v=motion.v * 0.7
        )
        ego = (np.linspace(0.0, 40.0, count), np.zeros(count), np.full(count, 9.0), np.zeros(count))
        last = [
            None if j % 2 else {"x": 1.0, "y": 0.0, "heading": 0.0, "speed": 3.0, "time": 1.0} for j in range(count)
        ]
        roads[str(k)] = road_of(sit, "bv")
        for bv, told in ground.tell(motion, 1.5, ego, last):
            numbers = {q.name: draw.uniform(q.low, q.high) for q in p.parameters}
            calls.append((str(k), bv, told, numbers, draw.choice([0.0, -6.0]), 3.0))
    return roads, calls


@pytest.mark.parametrize("p", SHIPPED, ids=lambda p: f"{p.label}/{p.mode}")
def test_the_answers_are_the_sandbox_s_to_the_last_bit(p: Planner, sandbox: Sandbox) -> None:
    roads, calls = questions(p, 8)
    inside = InProcessSession(p, roads, lambda: sandbox.session(p, roads))
    with sandbox.session(p, roads) as session:
        theirs = session.endpoints(calls)
    ours = inside.endpoints(calls)
    inside.close()
    assert [a if isinstance(a, dict) else type(a) for a in ours] == [
        a if isinstance(a, dict) else type(a) for a in theirs
    ]
    assert any(isinstance(a, dict) for a in ours)


def test_what_fails_here_is_asked_in_the_sandbox_which_has_the_sentence(sandbox: Sandbox) -> None:
    p = planner(SIDE)
    roads, calls = questions(p, 2)
    broken = {**roads, "1": {}}
    inside = InProcessSession(p, broken, lambda: sandbox.session(p, broken))
    found = inside.endpoints(calls)
    assert [isinstance(a, PlannerRuntimeError) for a in found] == [False, False, True, True, False, False]
    assert "KeyError" in str(found[2])
    with pytest.raises(PlannerRuntimeError, match="KeyError"):
        inside.endpoint(*calls[2])
    inside.close()
    inside.close()
