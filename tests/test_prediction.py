"""Predictions where planners fail: of one proposal, of all, and what is asked again."""

from __future__ import annotations

import numpy as np
from situation_samples import neighbour, situation

from sumo_adv.config import Settings
from sumo_adv.datatypes import Planner, Proposal
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.text import make_planner
from sumo_adv.search.prediction import Predictor
from sumo_adv.search.settings import ScoreSettings

FRAGILE = """
PARAMETERS = {"worst": (0.0, 0.0, 9.0, "s", "from when on it fails")}


def endpoint(bv, ego, road, parameters, acc, horizon):
    share = 1.0 / (bv["time"] < parameters["worst"])
    return {"x": bv["x"] + 10.0 * share, "y": 3.2, "heading": 0.0, "speed": 5.0, "time": 2.0}
"""


FAILED = ScoreSettings().failed


def everywhere(x: object, y: object) -> object:
    return np.ones(np.shape(x), bool)


def attack(planner: Planner, worst: float) -> Proposal:
    return Proposal("bv", "Any", planner, {"worst": worst}, 0.0, 0.0)


def predictor(sandbox: Sandbox) -> Predictor:
    return Predictor(sandbox, Settings(), everywhere, {0.0: situation([neighbour()])})  # type: ignore[arg-type]


def test_a_planner_that_fails_for_one_proposal_answers_for_the_others(sandbox: Sandbox) -> None:
    """From 3 s on it divides by zero with the second one's number, and never with the others'."""
    planner = make_planner("Any", "fragile", FRAGILE, "person")
    foreseen = predictor(sandbox)
    first, second, third = foreseen.score([attack(planner, worst) for worst in (99.0, 3.0, 99.0)])
    assert second.score == FAILED and second.prediction is not None and "ZeroDivisionError" in second.prediction.failure
    assert first.score == third.score < FAILED and first.prediction is not None and not first.prediction.failure
    assert foreseen.failures == {}


def test_a_planner_that_fails_for_all_proposals_is_not_asked_again(sandbox: Sandbox) -> None:
    planner = make_planner("Any", "fragile", FRAGILE, "person")
    foreseen = predictor(sandbox)
    assert [p.score for p in foreseen.score([attack(planner, 2.0), attack(planner, 3.0)])] == [FAILED, FAILED]
    assert list(foreseen.failures) == [planner.hash]
    again = foreseen.score([attack(planner, 99.0)])[0]
    assert again.prediction is not None
    assert again.score == FAILED and again.prediction.failure == foreseen.failures[planner.hash]
