"""Intervals, tests and distances of distributions, against tables and figures worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from metrics_tracks import TIME, car, cruise, drift
from scipy import stats

from sumo_adv.datatypes import Floats
from sumo_adv.errors import UsageError
from sumo_adv.metrics.realism import (
    PAPER_BINS,
    WOSAC_BINS,
    Bins,
    distances,
    jensen_shannon,
    kl,
    pooled_features,
    realism,
    wasserstein,
    wosac_features,
)
from sumo_adv.metrics.statistics import bootstrap, mcnemar, paired_means, paired_rates, wilson


def test_wilson_s_interval_of_eight_in_ten() -> None:
    """The textbook's 0.490 to 0.943; the ends stay inside [0, 1]."""
    rate = wilson(8, 10)
    assert (rate.value, rate.low, rate.high) == (0.8, pytest.approx(0.490, abs=5e-4), pytest.approx(0.943, abs=5e-4))
    assert wilson(0, 20).low == 0.0 and wilson(20, 20).high == 1.0
    assert rate.text() == "0.80 (0.49-0.94)"
    assert np.isnan(wilson(0, 0).value)
    with pytest.raises(UsageError, match="0 <= successes <= n"):
        wilson(3, 2)


def test_the_bootstrap_has_the_width_of_the_normal_interval() -> None:
    values = np.random.default_rng(1).normal(5.0, 2.0, 400)
    estimate = bootstrap(values, resamples=2000)
    assert estimate.value == pytest.approx(values.mean())
    assert estimate.high - estimate.low == pytest.approx(2 * 1.96 * 2.0 / 20, rel=0.15)
    assert bootstrap(values, resamples=200) == bootstrap(values, resamples=200)
    with pytest.raises(UsageError, match="cap TTC"):
        bootstrap([1.0, np.inf])


def test_mcnemar_looks_at_discordant_pairs_alone() -> None:
    first = [True] * 9 + [False] * 1 + [True] * 50
    second = [False] * 9 + [True] * 1 + [True] * 50
    assert mcnemar(first, second) == pytest.approx(2 * (1 + 10) / 1024)
    assert mcnemar([True, False], [True, False]) == 1.0
    with pytest.raises(UsageError, match="same encounters"):
        mcnemar([True], [True, False])


def test_the_paired_means_sees_a_difference_that_pairing_makes_plain() -> None:
    generator = np.random.default_rng(2)
    base = generator.normal(0, 10, 100)
    better = base + 0.5 + generator.normal(0, 0.5, 100)
    result = paired_means(better, base, resamples=2000)
    assert result.low > 0.3 and result.high < 0.7 and result.p < 0.01
    assert paired_means(base, base, resamples=200).p == 1.0


def test_six_pairs_that_all_went_down_are_no_proof() -> None:
    """One difference is 0, five are negative: of the 64 sign flips 2 have a mean as low, so p is 2 * 2 / 64."""
    after, before = [0.87, 2.0, 0.40, 0.35, 0.88, 0.98], [1.0, 2.0, 2.0, 2.0, 1.0, 1.0]
    assert paired_means(after, before).p == pytest.approx(0.0625)
    assert paired_means(after[2:3], before[2:3]).p == 1.0


def test_every_interval_and_p_is_scipy_s() -> None:
    draw = np.random.default_rng(3)
    few, many = draw.normal(0.5, 1.0, 12), draw.normal(0.2, 1.0, 40)
    rate = wilson(7, 31)
    assert (rate.low, rate.high) == pytest.approx(stats.binomtest(7, 31).proportion_ci(method="wilson"))
    interval = stats.bootstrap(
        (many,), np.median, method="percentile", n_resamples=10_000, rng=np.random.default_rng(0)
    ).confidence_interval
    estimate = bootstrap(many, of=np.median)
    assert (estimate.low, estimate.high) == pytest.approx((interval.low, interval.high))
    exact = stats.permutation_test((few,), np.mean, permutation_type="samples", n_resamples=np.inf).pvalue
    assert paired_means(few, np.zeros(12)).p == pytest.approx(exact)  # all 4096 sign flips
    assert paired_means(many, np.zeros(40)).p == pytest.approx(stats.ttest_1samp(many, 0.0).pvalue, abs=0.03)
    first, second = draw.random(50) < 0.7, draw.random(50) < 0.4
    only_first, only_second = int((first & ~second).sum()), int((second & ~first).sum())
    difference = paired_rates(first, second)
    assert difference.p == pytest.approx(stats.binomtest(only_first, only_first + only_second).pvalue)
    assert difference.difference == pytest.approx((only_first - only_second) / 50)


def test_divergences_by_hand() -> None:
    p, q = np.array([0.5, 0.5]), np.array([0.25, 0.75])
    assert kl(p, q) == pytest.approx(0.5 * np.log(2) + 0.5 * np.log(2 / 3))
    assert kl(p, p) == 0.0 and jensen_shannon(p, q) == pytest.approx(jensen_shannon(q, p))
    assert 0 < jensen_shannon(p, q) < np.log(2)
    assert wasserstein(np.array([0.0, 1.0]), np.array([2.0, 3.0, np.nan])) == pytest.approx(2.0)
    assert wasserstein(np.array([0.0]), np.array([0.0, 4.0])) == pytest.approx(2.0)


def test_histograms_are_smoothed_and_keep_what_lies_outside() -> None:
    shares = Bins(0.0, 2.0, 2).histogram(np.array([-5.0, 0.5, 9.0, np.inf]))
    assert shares == pytest.approx(np.array([2.1, 1.1]) / 3.2)


def test_realism_of_calm_traffic_against_itself_is_zero_and_of_swerving_is_not() -> None:
    calm = [cruise(f"b{i}", 0, 0, 10.0 + i) for i in range(5)]
    same = realism(calm, calm)
    assert all(same[f"{n}_kl"] == 0 and same[f"{n}_wasserstein"] == 0 for n in PAPER_BINS)
    wild = [drift("adversary", 0, 3.2, 15, 2.0, 1.0, 0.0)]  # peak 18 m/s2
    swerving = realism(wild, calm, on_road=lambda x, y: np.abs(y) < 1.0)
    assert swerving["lateral_acceleration_kl"] > 0.1 and swerving["abnormal_lateral_share"] > 0.03
    assert swerving["reference_abnormal_lateral_share"] == 0.0
    assert swerving["off_road_share"] == pytest.approx(np.mean(np.abs(wild[0].y) >= 1.0))
    before = realism(wild, calm, end=2.0)
    assert before["abnormal_lateral_share"] == 0.0
    with pytest.raises(UsageError, match="both sides"):
        realism(wild, [])


def test_wosac_features_of_a_circle() -> None:
    angle = 0.4 * TIME
    track = car("adversary", 25 * np.sin(angle), 25 * (1 - np.cos(angle)), 10.0, (angle + np.pi) % (2 * np.pi) - np.pi)

    def edge(x: Floats, y: Floats) -> Floats:
        return 60.0 - np.abs(y)

    wosac = wosac_features(track, [cruise("b", 0, 100, 10)], edge)
    assert set(wosac) == set(WOSAC_BINS)
    inner = slice(2, -2)
    assert wosac["linear_speed"][inner] == pytest.approx(np.full(len(TIME) - 4, 10.0), abs=0.01)
    assert wosac["angular_speed"][inner] == pytest.approx(np.full(len(TIME) - 4, 0.4))
    assert wosac["angular_acceleration"][inner] == pytest.approx(np.zeros(len(TIME) - 4), abs=1e-9)
    assert wosac["distance_to_road_edge"].min() > 5 and wosac["time_to_collision"].max() == 5.0
    assert distances(wosac, wosac, WOSAC_BINS)["angular_speed_js"] == 0.0


def test_features_pool_vehicles_and_ignore_those_seen_once() -> None:
    once = cruise("once", 0, 0, 10).between(1.0, 1.0)
    pooled = pooled_features([cruise("a", 0, 0, 10), once, cruise("b", 0, 0, 20)], end=1.0)
    assert len(pooled["speed"]) == 22 and len(pooled["jerk"]) == 20
