"""Intervals and tests for every table: Wilson, bootstrap, McNemar, sign flips of paired differences.

All are those of ``scipy.stats``. It is imported only when a figure is computed, because the import takes half a second.
Intervals are 95 % intervals. Random draws use one seed and are deterministic.
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
BOOTSTRAP_RESAMPLES = 10_000  # this many sign flips make a test exact up to 13 pairs
MAX_VALUES_AT_ONCE = 1_000_000  # values drawn at a time
RESAMPLING_SEED = 0
Summary = Callable[..., Any]  # a numpy function with an ``axis``: mean, median
Values = Sequence[float] | NDArray[np.float64]
Flags = Sequence[bool] | NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value with its confidence interval.

    Attributes:
        value: The value.
        low: Lower end of the interval.
        high: Upper end of the interval.
        n: The number of observations behind the value.
    """

    value: float
    low: float
    high: float
    n: int

    def text(self, digits: int = 2) -> str:
        """Return the estimate as text, such as ``0.75 (0.70-0.80)``."""
        return f"{self.value:.{digits}f} ({self.low:.{digits}f}-{self.high:.{digits}f})"


def wilson(successes: int, n: int) -> Estimate:
    """Estimate a rate with Wilson's score interval (Wilson 1927).

    Args:
        successes: Number of successes.
        n: Number of trials. With 0, the value is nan and the interval 0 to 1.

    Raises:
        UsageError: Not 0 <= successes <= n.
    """
    from scipy.stats import binomtest

    if not 0 <= successes <= n:
        raise UsageError(f"A rate needs 0 <= successes <= n; got {successes} of {n}.")
    if n == 0:
        return Estimate(float("nan"), 0.0, 1.0, 0)
    share = successes / n
    test = binomtest(successes, n, share)  # tests its own share, so scipy need not sum up p
    interval = test.proportion_ci(CONFIDENCE_LEVEL, method="wilson")
    return Estimate(share, float(interval.low), float(interval.high), n)


def bootstrap(values: Values, *, resamples: int = BOOTSTRAP_RESAMPLES, of: Summary = np.mean) -> Estimate:
    """Estimate the mean, or another summary, with a percentile bootstrap interval.

    Args:
        values: The values.
        resamples: Number of resamples.
        of: The summary, a numpy function with an ``axis``.

    Raises:
        UsageError: There are no values, or one is not finite.
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
    """Return the percentile bootstrap interval; for a single value, that value.

    The resamples are drawn in portions that keep memory small.
    """
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
    """A comparison of two methods on the same encounters.

    Attributes:
        difference: First minus second.
        low: Lower end of its interval.
        high: Upper end of its interval.
        p: Two-sided p.
        n: Number of encounters.
    """

    difference: float
    low: float
    high: float
    p: float
    n: int


def mcnemar(first: Flags, second: Flags) -> float:
    """Return the exact two-sided p of McNemar's test: do two methods succeed equally often on the same encounters?

    The test is binomial on the discordant pairs (McNemar 1947).

    Args:
        first: Successes of the first method.
        second: Successes of the second method, in the same order of encounters.

    Raises:
        UsageError: The lengths differ.
    """
    from scipy.stats import binomtest

    _same_length(len(first), len(second))
    successes, other_successes = np.asarray(first, dtype=bool), np.asarray(second, dtype=bool)
    b, c = int((successes & ~other_successes).sum()), int((~successes & other_successes).sum())
    return float(binomtest(b, b + c).pvalue) if b + c else 1.0


def paired_means(first: Values, second: Values, *, resamples: int = BOOTSTRAP_RESAMPLES) -> Paired:
    """Estimate the difference of means on the same encounters.

    The interval is a percentile bootstrap over encounters. p comes from the sign-flip test (Fisher 1935): under the
    hypothesis of no difference, each encounter's difference is equally likely to have the other sign. If ``resamples``
    are enough (up to 13 encounters), all flips are counted. Otherwise, ``resamples`` random flips are drawn.

    Args:
        first: Values of the first method.
        second: Values of the second method, in the same order of encounters.
        resamples: Number of resamples and of sign flips.

    Raises:
        UsageError: The lengths differ, or a value is not finite.
    """
    _same_length(len(first), len(second))
    values, other_values = _finite(first), _finite(second)
    differences = values - other_values
    low, high = _percentiles(differences, resamples, np.mean)
    return Paired(float(differences.mean()), low, high, _sign_flips(differences, resamples), len(values))


def paired_rates(first: Flags, second: Flags, *, resamples: int = BOOTSTRAP_RESAMPLES) -> Paired:
    """Estimate the difference of rates on the same encounters.

    The interval is a percentile bootstrap over encounters; p comes from McNemar's exact test.

    Args:
        first: Successes of the first method.
        second: Successes of the second method, in the same order of encounters.
        resamples: Number of resamples.

    Raises:
        UsageError: The lengths differ.
    """
    p = mcnemar(first, second)
    differences = _finite(np.asarray(first, dtype=float) - np.asarray(second, dtype=float))
    low, high = _percentiles(differences, resamples, np.mean)
    return Paired(float(differences.mean()), low, high, p, len(differences))


def _sign_flips(differences: Floats, resamples: int) -> float:
    """Return the two-sided p of the sign-flip test."""
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
