"""Predictions where planners fail: of one proposal, of all, and what is asked again."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from bank_samples import shipped_planners
from situation_samples import neighbour, situation

from sumo_adv.config import Settings
from sumo_adv.datatypes import Planner, Proposal
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.source import make_planner
from sumo_adv.search.batch_prediction import PredictionOrder, fulfilled
from sumo_adv.search.prediction import Predictor
from sumo_adv.search.settings import ScoreSettings

FRAGILE = """
PARAMETERS = {"worst": (0.0, 0.0, 9.0, "s", "from when on it fails")}


def endpoint(bv, ego, road, parameters, acc, horizon):
    share = 1.0 / (bv["time"] < parameters["worst"])
    return {"x": bv["x"] + 10.0 * share, "y": 3.2, "heading": 0.0, "speed": 5.0, "time": 2.0}
"""


@pytest.fixture(scope="module")
def sandbox() -> Iterator[Sandbox]:
    with Sandbox() as box:
        yield box


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


def cut_ins(planner: Planner, number: int) -> list[Proposal]:
    """Cut-ins that the first parameter alone tells apart: its bounds, and what lies evenly between them."""
    first = planner.parameters[0]
    shares = np.linspace(0.0, 1.0, number).tolist()
    return [
        Proposal(
            "bv",
            planner.label,
            planner,
            planner.defaults() | {first.name: (1 - k) * first.low + k * first.high},
            0.0,
            0.0,
        )
        for k in shares
    ]


def test_another_process_predicts_the_second_half_of_many(sandbox: Sandbox) -> None:
    """Of 30 candidates it gets 15, of 19 none; what it answers, and that it cannot, changes no result."""
    situations = {0.0: situation([neighbour()])}
    planner = shipped_planners()["Aggressive Cut-in", "side"]
    sent: list[int] = []

    def elsewhere(order: PredictionOrder) -> Callable[[], list[Proposal] | None]:
        sent.append(len(order.proposals))
        return lambda: fulfilled(order, situations, everywhere, Settings())  # type: ignore[arg-type]

    def busy(order: PredictionOrder) -> Callable[[], None]:
        sent.append(len(order.proposals))
        return lambda: None

    alone, both, refused = (
        Predictor(sandbox, Settings(), everywhere, situations, elsewhere=other)  # type: ignore[arg-type]
        for other in (None, elsewhere, busy)
    )
    many = cut_ins(planner, 30)
    assert alone.score(many) == both.score(many) == refused.score(many)
    assert len({p.score for p in alone.score(many)}) > 1
    both.score(many[:19])
    assert sent == [15, 15]


def test_a_planner_from_a_model_stays_in_this_process(sandbox: Sandbox) -> None:
    planner = make_planner("Any", "fragile", FRAGILE, "person")
    sent: list[PredictionOrder] = []

    def elsewhere(order: PredictionOrder) -> Callable[[], None]:
        sent.append(order)
        return lambda: None

    foreseen = Predictor(sandbox, Settings(), everywhere, {0.0: situation([neighbour()])}, elsewhere=elsewhere)  # type: ignore[arg-type]
    foreseen.score([attack(planner, 99.0)] * 30)
    assert sent == []
