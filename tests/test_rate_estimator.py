"""Rates from weighted runs: worked by hand, and on a world with an exactly known rate."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from sumo_adv.datatypes import Floats
from sumo_adv.rate.estimate import effective_runs, measure_rate
from sumo_adv.rate.proposal import MAX_WEIGHT, Counts, Decisions, ErrorProposal, learnt, pilot_proposal


def test_equal_weights_give_the_exact_interval_of_a_count() -> None:
    weights = np.zeros(1000)
    weights[:10] = 1.0
    crash_rate = measure_rate(weights, np.full(1000, 0.5))  # 10 crashes in 500 h
    assert crash_rate.value == pytest.approx(0.02)
    # Garwood's limits of a count of 10: 4.7954 and 18.3904
    assert crash_rate.low == pytest.approx(4.7954 / 500, rel=1e-4)
    assert crash_rate.high == pytest.approx(18.3904 / 500, rel=1e-4)
    assert crash_rate.half_width == pytest.approx((18.3904 - 4.7954) / 20, rel=1e-4)
    assert crash_rate.crashes == 10
    assert (crash_rate.effective, crash_rate.largest_share) == (pytest.approx(10), pytest.approx(0.1))
    assert crash_rate.plain_runs == pytest.approx(1000)


def test_no_crash_leaves_an_upper_limit_by_the_largest_possible_weight() -> None:
    hours = np.full(100, 1.0)
    assert measure_rate(np.zeros(100), hours).high == pytest.approx(3.6889 / 100, rel=1e-4)  # -log 0.025
    assert measure_rate(np.zeros(100), hours, most_weight=10.0).high == pytest.approx(36.889 / 100, rel=1e-4)
    assert measure_rate(np.zeros(100), hours).half_width is None


def test_uneven_weights_count_for_less() -> None:
    weights = np.zeros(100)
    weights[:2] = 0.5, 0.1
    crash_rate = measure_rate(weights, np.ones(100))
    assert crash_rate.value == pytest.approx(0.006)
    assert crash_rate.effective == pytest.approx(0.36 / 0.26)
    assert crash_rate.largest_share == pytest.approx(0.5 / 0.6)
    assert crash_rate.plain_runs == pytest.approx(100 * 0.6 / 0.26)
    assert 0.0 < crash_rate.low < 0.006 < crash_rate.high
    assert effective_runs(np.array([1.0, 1.0, 2.0])) == pytest.approx(16 / 6)


def test_few_crashes_do_not_tell_how_large_the_unseen_ones_are() -> None:
    """Nine crashes of weight 0.001: one of weight 10 may have been missed, and the upper limit says so."""
    few, enough = np.zeros(1000), np.zeros(1000)
    few[:9] = enough[:10] = 0.001
    high = measure_rate(few, np.ones(1000), most_weight=10.0).high
    assert high == pytest.approx(36.889 / 1000, rel=0.01)  # as without a crash
    assert measure_rate(enough, np.ones(1000), most_weight=10.0).high == pytest.approx(0.001 * 18.39 / 1000, rel=1e-3)


def test_the_limits_are_those_of_gamma_distributions() -> None:
    """Fay and Feuer 1997, by scipy.stats: weights 0.5 and 0.05, twelve times each, whose sum is 6.6."""
    weights = np.zeros(100)
    weights[:12], weights[12:24] = 0.5, 0.05
    total, square = 6.6, 12 * (0.25 + 0.0025)
    found = measure_rate(weights, np.ones(100))
    assert found.low * 100 == pytest.approx(stats.gamma.ppf(0.025, total**2 / square, scale=square / total))
    total, square = total + 0.5, square + 0.25
    assert found.high * 100 == pytest.approx(stats.gamma.ppf(0.975, total**2 / square, scale=square / total))


def test_uneven_exposure_widens_the_interval_and_the_unit_does_not_matter() -> None:
    weights = np.array([1.0, 1.0, 0.0, 0.0])
    even, uneven = measure_rate(weights, np.full(4, 2.0)), measure_rate(weights, np.array([1.0, 3.0, 1.0, 3.0]))
    assert even.value == uneven.value == 0.25
    assert uneven.plain_runs == pytest.approx(4 * 2 / (2 + 0.25**2 * 4))  # variance 2 plus that of the exposure
    assert uneven.low < even.low and uneven.high > even.high
    in_minutes = measure_rate(weights, np.full(4, 120.0))
    assert in_minutes.high == pytest.approx(even.high / 60)


def test_nothing_driven_says_nothing() -> None:
    crash_rate = measure_rate(np.zeros(3), np.zeros(3))
    assert np.isnan(crash_rate.value) and crash_rate.high == np.inf


# -- a world without SUMO, with a known rate -----------------------------------------------------------------------

SLOTS, ERROR, DANGEROUS, COLLIDES = 3, 1e-3, 0.2, 0.5
RUNS, PILOT = 600, 60
EXACT = 1 - (1 - ERROR * DANGEROUS * COLLIDES) ** SLOTS  # 3e-4 a run


def drive(draw: np.random.Generator, proposal: ErrorProposal | None, *, pilot: bool = False) -> tuple[float, Counts]:
    """One run of three slots. In each, an error is dangerous with probability 0.2, and then half of them collide.

    The weight at the crash, 0 without one; and what was counted."""
    decisions = Decisions(draw, proposal, pilot=pilot)
    tried, begun, crashed = np.zeros((1, 4)), np.zeros((1, 4)), np.zeros((1, 4))
    for _ in range(SLOTS):
        level = 3 if draw.random() < DANGEROUS else 0
        tried[0, level] += 1
        if decisions.next(np.array([[ERROR]]), np.array([[level]]))[0] < 0:
            continue
        begun[0, level] += 1
        if level == 3 and draw.random() < COLLIDES:
            crashed[0, level] += 1
            return decisions.weight, Counts(tried, begun, crashed)
    return 0.0, Counts(tried, begun, crashed)


def estimate(seed: int, runs: int) -> Floats:
    draw = np.random.default_rng(seed)
    counts = [drive(draw, pilot_proposal(1), pilot=True)[1] for _ in range(PILOT)]
    proposal = learnt(counts, np.array([ERROR]))
    return np.array([drive(draw, proposal)[0] for _ in range(runs)])


def test_the_interval_covers_a_known_rate_with_a_hundredth_of_the_runs() -> None:
    """Plain Monte Carlo needs (1.96/0.3)^2 / 3e-4, some 142 000 runs, for a half-width of 30 %."""
    assert pytest.approx(3e-4, rel=1e-3) == EXACT
    rates = [measure_rate(estimate(seed, RUNS), np.ones(RUNS), MAX_WEIGHT) for seed in range(100)]
    assert sum(r.low <= EXACT <= r.high for r in rates) >= 95
    assert np.mean([r.value for r in rates]) == pytest.approx(EXACT, rel=0.05)
    assert np.median([r.half_width or np.inf for r in rates]) < 0.3
    assert np.median([(r.plain_runs or 0.0) / (RUNS + PILOT) for r in rates]) > 100


def test_plain_runs_of_the_same_world_agree() -> None:
    draw = np.random.default_rng(7)
    weights = np.array([drive(draw, None)[0] for _ in range(20_000)])
    crash_rate = measure_rate(weights, np.ones(20_000))
    assert set(weights) <= {0.0, 1.0}
    assert crash_rate.low <= EXACT <= crash_rate.high
