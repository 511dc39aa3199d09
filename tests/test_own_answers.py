"""Who answers in an attempt: a planner that is our own where the attempt runs, any other one elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bank_samples import shipped_planners
from situation_samples import neighbour, situation

from sumo_adv.datatypes import PrescribedMotion, Proposal
from sumo_adv.planners.adversary_batch import AdversaryBatch
from sumo_adv.planners.answers import Answer, Told
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.sessions import Roads, Sessions
from sumo_adv.planners.source import make_planner
from sumo_adv.planners.trusted_answers import answers

SIDE = shipped_planners()["Straight Lane Shift", "side"].source
BESIDE = situation([neighbour()])


def proposal(source: str = SIDE) -> Proposal:
    planner = make_planner("Straight Lane Shift", "side", source, "somebody")
    return Proposal("bv", planner.label, planner, planner.defaults(), 0.0, 0.0)


def told() -> Told:
    ground = AdversaryBatch([BESIDE], ["bv"])
    ego = tuple(np.array([q]) for q in (0.0, 0.0, 10.0, 0.0))
    return ground.tell(ground.begin(), 0.0, ego, [None])[0]  # type: ignore[arg-type]


class Elsewhere:
    """Answers for others; ``asked``: how often."""

    def __init__(self) -> None:
        self.asked = 0

    def __call__(self, told: Told) -> Answer | str:
        self.asked += 1
        return "asked elsewhere"


def test_our_own_planner_answers_as_in_the_sandbox_and_nobody_else_is_asked() -> None:
    elsewhere, mine = Elsewhere(), proposal()
    ours = answers(mine, BESIDE, elsewhere)(told())
    with Sandbox() as sandbox, Sessions(sandbox, Roads({0.0: BESIDE}), [mine], 0) as sessions:
        assert ours == sessions.one(mine, told())
    assert elsewhere.asked == 0


@pytest.mark.parametrize("changed", [SIDE.replace("base = base_lane", "base = 0.0 * base_lane"), "course"])
def test_any_other_planner_or_a_motion_given_in_advance_is_answered_for_elsewhere(changed: str) -> None:
    still = np.zeros(3)
    other = (
        replace(proposal(), course=PrescribedMotion(still, still, still, still))
        if changed == "course"
        else proposal(changed)
    )
    elsewhere = Elsewhere()
    assert answers(other, BESIDE, elsewhere) is elsewhere


def test_what_fails_here_is_asked_elsewhere_each_time() -> None:
    elsewhere, (bv, ego) = Elsewhere(), told()
    ask = answers(proposal(), BESIDE, elsewhere)
    broken = {name: value for name, value in bv.items() if name != "ahead"}
    assert [ask((broken, ego)), ask((broken, ego))] == ["asked elsewhere"] * 2
    assert elsewhere.asked == 2
    assert isinstance(ask((bv, ego)), Answer)
