"""PredictionCorrection: predictions weighed against how the ego really went."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sumo_adv.datatypes import ObservedMotion, Parameter, Planner, Prediction, Proposal
from sumo_adv.search.correction import PredictionCorrection
from sumo_adv.search.settings import CorrectionSettings

PLANNER = Planner("any", "plain", "", (), "seed")
SLOW = ObservedMotion(np.array([0.0, 0.5]), np.zeros(2), np.array([5.0, 5.0]))
SLOWER = ObservedMotion(np.array([0.0, 0.3]), np.zeros(2), np.array([3.0, 3.0]))


class BySpeed:
    """Against an ego that was seen: a fifth of its last speed, 1.0 at 5 m/s and 0.6 at 3 m/s."""

    def __init__(self) -> None:
        self.asked: list[tuple[list[Proposal], list[ObservedMotion]]] = []

    def score(self, proposals: Sequence[Proposal], motions: Sequence[ObservedMotion] | None = None) -> list[Proposal]:
        assert motions is not None
        self.asked.append((list(proposals), list(motions)))
        return [replace(p, score=float(c.v[-1]) / 5.0) for p, c in zip(proposals, motions, strict=True)]

    def observe(self, tried: Proposal, motion: ObservedMotion) -> bool:
        return False


def proposal(
    score: float, bv: str = "bv", delay: float = 0.0, nominal: float | None = None, **predicted: Any
) -> Proposal:
    made = Prediction(**predicted)
    return Proposal(bv, "any", PLANNER, {}, 0.0, delay, score=score, prediction=made, nominal=nominal)


def correcting(scorer: BySpeed, known_driver: bool = False) -> PredictionCorrection:
    return PredictionCorrection(scorer, CorrectionSettings(), known_driver=known_driver)


def scores(proposals: Sequence[Proposal]) -> list[float]:
    return [p.score for p in proposals]


def test_what_was_seen_counts_for_a_half_and_then_for_three_quarters() -> None:
    scorer = BySpeed()
    correction = correcting(scorer)
    pool = [proposal(0.2), proposal(0.8)]
    assert correction.corrected(pool) == pool  # no attempt was observed yet, so no scorer is called
    assert scorer.asked == []

    pool = correction.corrected(pool, correction.observe(pool[0], SLOW))
    assert scores(pool) == pytest.approx([0.5 * 0.2 + 0.5 * 1.0, 0.5 * 0.8 + 0.5 * 1.0])

    pool = correction.corrected(pool, correction.observe(pool[0], SLOWER))
    assert scores(pool) == pytest.approx([0.25 * 0.2 + 0.75 * 0.6, 0.25 * 0.8 + 0.75 * 0.6])
    assert [c is SLOWER for c in scorer.asked[-1][1]] == [True, True]  # the last one seen


def test_of_a_driver_that_is_known_what_was_seen_only_makes_predictions_worse() -> None:
    """Against the ego that was seen both score 1.0: what was predicted to hit comes half way, a miss stays one."""
    correction = correcting(BySpeed(), known_driver=True)
    pool = [proposal(0.2), proposal(1.9), proposal(4.0)]
    pool = correction.corrected(pool, correction.observe(pool[0], SLOW))
    assert scores(pool) == pytest.approx([0.5 * 0.2 + 0.5 * 1.0, 1.9, 4.0])


def test_weighing_twice_does_not_compound() -> None:
    correction = correcting(BySpeed())
    pool = [proposal(0.2)]
    key = correction.observe(pool[0], SLOW)
    once = correction.corrected(pool, key)
    assert once[0].uncorrected == 0.2
    assert correction.corrected(once, key) == once
    assert scores(once) == pytest.approx([0.6])


def test_the_attempt_most_like_a_proposal_says_how_the_ego_goes() -> None:
    """Offsets from -1 to 1 s: one attempt at 0 slowed the ego to 5 m/s, one at 0.8 to 3; 0.3 is nearer to the first,
    0.5 to the second. Another mode has the last one seen."""
    planner = replace(PLANNER, parameters=(Parameter("offset", 0.0, -1.0, 1.0, "s", "when"),))
    another_mode = replace(PLANNER, mode="other")
    at = [replace(proposal(0.0), planner=planner, parameters={"offset": x}) for x in (0.0, 0.8, 0.3, 0.5)]
    correction = correcting(BySpeed())
    correction.observe(at[1], SLOWER)
    correction.observe(at[0], SLOW)
    corrected = correction.corrected([*at[2:], replace(proposal(0.0), planner=another_mode)])
    assert scores(corrected) == pytest.approx([0.75 * 1.0, 0.75 * 0.6, 0.75 * 1.0])


def test_only_the_proposals_of_that_vehicle_and_moment_change() -> None:
    correction = correcting(BySpeed())
    pool = [proposal(0.2), proposal(0.2, bv="other"), proposal(0.2, delay=1.5), proposal(0.4)]
    key = correction.observe(pool[0], SLOW)
    assert key == ("bv", 0.0)
    pool = correction.corrected(pool, key)
    assert scores(pool) == pytest.approx([0.6, 0.2, 0.2, 0.7])

    later = correction.observe(pool[2], SLOWER)
    pool = correction.corrected(pool, later)  # the first ones stay as they are
    assert scores(pool) == pytest.approx([0.6, 0.2, 0.5 * 0.2 + 0.5 * 0.6, 0.7])


def test_what_is_drawn_later_is_weighed_by_all_that_was_seen() -> None:
    correction = correcting(BySpeed())
    correction.observe(proposal(0.2), SLOW)
    correction.observe(proposal(0.2, delay=1.5), SLOWER)
    fresh = [proposal(0.0), proposal(0.0, delay=1.5), proposal(0.0, delay=3.0)]
    assert scores(correction.corrected(fresh)) == pytest.approx([0.5, 0.3, 0.0])


def test_a_rear_end_or_a_miss_by_far_counts_as_2_5() -> None:
    correction = correcting(BySpeed())
    pool = [proposal(5.0), proposal(4.5)]
    key = correction.observe(pool[0], SLOW)
    assert scores(correction.corrected(pool, key)) == pytest.approx([0.5 * 2.5 + 0.5 * 1.0] * 2)


@pytest.mark.parametrize("why", [{"off_road": True}, {"third_party": True}, {"failure": "It divides by zero."}])
def test_what_is_hopeless_whatever_the_ego_does_is_left_as_it_is(why: dict[str, Any]) -> None:
    scorer = BySpeed()
    correction = correcting(scorer)
    pool = [proposal(3.0, **why), proposal(0.2, off_road=False, third_party=False)]
    corrected = correction.corrected(pool, correction.observe(pool[0], SLOW))
    assert corrected[0] is pool[0]
    assert scores(corrected) == pytest.approx([3.0, 0.6])
    assert scorer.asked[0][0] == pool[1:]


def test_what_was_firm_starts_from_its_own_score_and_is_to_be_firmed_again() -> None:
    """Alone 0.0, with its neighbours 0.6; against the ego that was seen 1.0: the mean of 0.0 and 1.0."""
    correction = correcting(BySpeed())
    pool = [proposal(0.6, nominal=0.0)]
    key = correction.observe(pool[0], SLOW)
    once = correction.corrected(pool, key)
    assert once[0].score == pytest.approx(0.5)
    assert (once[0].uncorrected, once[0].nominal) == (0.0, None)
