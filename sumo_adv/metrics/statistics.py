"""Intervals and tests for every table: Wilson, bootstrap, McNemar, sign flips of paired differences.

All are those of ``scipy.stats``, which is imported where a figure is asked for, since that takes half a second.
Intervals are those of 95 %.  What is drawn has one seed and is deterministic.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sumo_adv.datatypes import Floats
from sumo_adv.errors import UsageError

CONFIDENCE_LEVEL = 0.95
BOOTSTRAP_RESAMPLES = 10_000  # as many sign flips make a test exact up to 13 pairs
MAX_VALUES_AT_ONCE = 1_000_000  # values drawn at a time
RESAMPLING_SEED = 0
Summary = Callable[..., Any]  # a numpy function with an ``axis``: mean, median
Values = Sequence[float] | NDArray[np.float64]
Flags = Sequence[bool] | NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value with its confidence interval; ``n`` is what it rests on."""

    value: float
    low: float
    high: float
    n: int

    def text(self, digits: int = 2) -> str:
        """``0.75 (0.70-0.80)``."""
        return f"{self.value:.{digits}f} ({self.low:.{digits}f}-{self.high:.{digits}f})"


def wilson(successes: int, n: int) -> Estimate:
    """A rate with Wilson's score interval (Wilson 1927).

    With n = 0: value nan, interval 0 to 1.  Raises UsageError unless 0 <= successes <= n.
    """
    from scipy.stats import binomtest

    if not 0 <= successes <= n:
        raise UsageError(f"A rate needs 0 <= successes <= n; got {successes} of {n}.")
    if n == 0:
        return Estimate(float("nan"), 0.0, 1.0, 0)
    share = successes / n
    test = binomtest(successes, n, share)  # of its own share: that p is known without a sum
    interval = test.proportion_ci(CONFIDENCE_LEVEL, method="wilson")
    return Estimate(share, float(interval.low), float(interval.high), n)


def bootstrap(values: Values, *, resamples: int = BOOTSTRAP_RESAMPLES, of: Summary = np.mean) -> Estimate:
    """The mean (or another summary ``of`` the values) with a percentile bootstrap interval.

    Raises UsageError on no values or on any not finite.
    """
    data = _finite(values)
    low, high = _percentiles(data, resamples, of)
    return Estimate(float(of(data, axis=0)), low, high, len(data))


def _finite(values: Values) -> Floats:
    data = np.asarray(values, dtype=float)
    if not data.size or not np.isfinite(data).all():
        raise UsageError("A mean needs at least one value and finite ones; cap TTC (inf = never) before averaging.")
    return data


def _percentiles(data: Floats, resamples: int, of: Summary) -> tuple[float, float]:
    """The percentile bootstrap interval, drawn in portions that keep memory small; of one value this value."""
    from scipy.stats import bootstrap as resampled

    if len(data) == 1:
        return float(data[0]), float(data[0])
    interval = resampled(
        (data,), of, n_resamples=resamples, confidence_level=CONFIDENCE_LEVEL, method="percentile",
        rng=np.random.default_rng(RESAMPLING_SEED), batch=max(MAX_VALUES_AT_ONCE // len(data), 1),
    ).confidence_interval  # fmt: skip
    return float(interval.low), float(interval.high)


@dataclass(frozen=True, slots=True)
class Paired:
    """Two methods on the same encounters: ``difference`` = first - second, its interval, p (two-sided)."""

    difference: float
    low: float
    high: float
    p: float
    n: int


def mcnemar(first: Flags, second: Flags) -> float:
    """Exact two-sided p of McNemar's test: are successes of two methods on the same encounters equally frequent?

    Binomial on the discordant pairs (McNemar 1947).  Raises UsageError where the lengths differ.
    """
    from scipy.stats import binomtest

    _same_length(len(first), len(second))
    successes, other_successes = np.asarray(first, dtype=bool), np.asarray(second, dtype=bool)
    b, c = int((successes & ~other_successes).sum()), int((~successes & other_successes).sum())
    return float(binomtest(b, b + c).pvalue) if b + c else 1.0


def paired_means(first: Values, second: Values, *, resamples: int = BOOTSTRAP_RESAMPLES) -> Paired:
    """Difference of means on the same encounters.

    The interval is a percentile bootstrap over encounters.  p is that of the sign-flip test (Fisher 1935): under the
    hypothesis of no difference, each encounter's difference is as likely to have the other sign.  All flips are counted
    where ``resamples`` are enough (up to 13 encounters), else that many are drawn.
    Raises UsageError where the lengths differ or values are not finite.
    """
    _same_length(len(first), len(second))
    values, other_values = _finite(first), _finite(second)
    differences = values - other_values
    low, high = _percentiles(differences, resamples, np.mean)
    return Paired(float(differences.mean()), low, high, _sign_flips(differences, resamples), len(values))


def paired_rates(first: Flags, second: Flags, *, resamples: int = BOOTSTRAP_RESAMPLES) -> Paired:
    """Difference of rates on the same encounters: percentile bootstrap over encounters, p of McNemar's exact test.

    Raises UsageError where the lengths differ.
    """
    p = mcnemar(first, second)
    differences = _finite(np.asarray(first, dtype=float) - np.asarray(second, dtype=float))
    low, high = _percentiles(differences, resamples, np.mean)
    return Paired(float(differences.mean()), low, high, p, len(differences))


def _sign_flips(differences: Floats, resamples: int) -> float:
    """Two-sided p of the sign-flip test."""
    from scipy.stats import permutation_test

    if len(differences) == 1:
        return 1.0
    test = permutation_test(
        (differences,), np.mean, permutation_type="samples", n_resamples=resamples,
        rng=np.random.default_rng(RESAMPLING_SEED), batch=max(MAX_VALUES_AT_ONCE // len(differences), 1),
        vectorized=True,
    )  # fmt: skip
    return float(test.pvalue)


def _same_length(one: int, two: int) -> None:
    if one != two:
        raise UsageError(f"Paired tests need the same encounters for both methods; got {one} and {two}.")
