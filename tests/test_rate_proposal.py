"""The likelihood ratio of a run: what the proposal raises, what it may not, and how far a weight can go."""

from __future__ import annotations

import numpy as np
import pytest

from sumo_adv.rate.proposal import (
    ERROR_BUDGET,
    EXPECTED_ERRORS_PER_RUN,
    MAX_ERROR_PROBABILITY,
    MAX_WEIGHT,
    Counts,
    Decisions,
    ErrorProposal,
    learnt,
    pilot_proposal,
)  # fmt: skip

RAISED = ErrorProposal(np.array([[0.0, 0.0, 0.0, 0.2]]))  # one kind of error, raised to 0.2 at level 3
MODEL, HIGH, LOW = np.array([[0.01]]), np.array([[3]]), np.array([[0]])


def test_a_raised_probability_is_never_below_the_models_nor_above_zero_where_that_is_zero() -> None:
    proposal = ErrorProposal(np.array([[0.0, 0.0, 0.0, 0.2], [0.1, 0.1, 0.1, 0.6]]))
    model = np.array([[0.01, 0.0], [0.01, 0.02]])
    raised = proposal.raised(model, np.array([[3, 3], [0, 0]]))
    assert raised.tolist() == [[0.2, 0.0], [0.01, 0.1]]
    crowded = proposal.raised(np.array([[0.01, 0.02]]), np.array([[3, 3]]))
    assert crowded.sum() == pytest.approx(MAX_ERROR_PROBABILITY) and (crowded >= [[0.01, 0.02]]).all()


def test_weights_of_one_decision() -> None:
    """R/P is 0.2/0.01 with an error and 0.8/0.99 without; the weight is 1 / (0.1 + 0.9 R/P)."""
    seen = set()
    for seed in range(60):
        decisions = Decisions(np.random.default_rng(seed), RAISED)
        began = decisions.next(MODEL, HIGH)[0] == 0
        ratio = 0.2 / 0.01 if began else 0.8 / 0.99
        assert decisions.weight == pytest.approx(1 / (0.1 + 0.9 * ratio))
        seen.add(began)
    assert seen == {True, False}


def test_after_an_error_the_run_goes_on_as_the_model_has_it() -> None:
    decisions = next(
        d for d in (Decisions(np.random.default_rng(seed), RAISED) for seed in range(100))
        if d.next(MODEL, HIGH)[0] == 0
    )  # fmt: skip
    assert not decisions.raising
    before = decisions.weight
    later = [int(decisions.next(MODEL)[0]) for _ in range(2000)]
    assert decisions.weight == before
    assert 5 <= later.count(0) <= 40  # 20 expected


def test_what_is_spent_in_a_run_is_limited_and_so_is_every_weight() -> None:
    """Each decision without an error spends -log 0.8 = 0.223: the fourteenth would exceed 3."""
    weights = []
    for seed in range(400):
        decisions = Decisions(np.random.default_rng(seed), RAISED)
        raised = 0
        for _ in range(50):
            raised += decisions.raising
            decisions.next(MODEL, HIGH)
        assert raised <= ERROR_BUDGET / 0.223 + 1
        weights.append(decisions.weight)
    assert max(weights) <= MAX_WEIGHT
    assert np.mean(weights) == pytest.approx(1.0, abs=0.35)


def test_the_mean_weight_is_one() -> None:
    """P(begun) = 0.1 * 0.01 + 0.9 * 0.2 = 0.181 in the mixture: the mean weight over both outcomes is exactly 1."""
    begun, not_begun = 1 / (0.1 + 0.9 * 20), 1 / (0.1 + 0.9 * 0.8 / 0.99)
    assert 0.181 * begun + 0.819 * not_begun == pytest.approx(1.0)


def test_plain_runs_have_weight_one_and_need_no_danger() -> None:
    decisions = Decisions(np.random.default_rng(0), None)
    decisions.next(MODEL)
    assert (decisions.weight, decisions.raising) == (1.0, False)


def test_a_pilot_run_raises_to_its_end() -> None:
    decisions = Decisions(np.random.default_rng(0), pilot_proposal(1), pilot=True)
    begun = [int(decisions.next(MODEL, HIGH)[0]) for _ in range(300)]
    assert decisions.raising
    assert 15 <= begun.count(0) <= 50  # 0.1 of 300


def test_what_pilot_runs_teach() -> None:
    """Level 3: 37 of 99 errors collide, with the guess of 0.3 for one more c = 37.3/100; level 0: 0.002/101."""
    counts = Counts(np.array([[80.0, 0, 0, 20.0]]), np.array([[100.0, 0, 0, 99.0]]), np.array([[0.0, 0, 0, 37.0]]))
    none = Counts(*(np.zeros((1, 4)) for _ in range(3)))
    low, high = 1e-4 * np.sqrt(0.002 / 101), 1e-4 * np.sqrt(0.373)
    in_a_run = (80 * low + 20 * high) / 2  # two pilot runs
    starts = learnt([counts, none], np.array([1e-4])).starts[0]
    assert starts[0] == pytest.approx(low * EXPECTED_ERRORS_PER_RUN / in_a_run)
    assert starts[3] == pytest.approx(high * EXPECTED_ERRORS_PER_RUN / in_a_run)
    assert 80 / 2 * starts[0] + 20 / 2 * starts[3] == pytest.approx(EXPECTED_ERRORS_PER_RUN)


def test_pilot_runs_without_a_chance_of_an_error_teach_nothing() -> None:
    none = Counts(*(np.zeros((1, 4)) for _ in range(3)))
    starts = learnt([none], np.array([1e-4])).starts
    assert (starts <= 1e-4).all()
