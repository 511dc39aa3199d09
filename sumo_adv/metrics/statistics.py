"""Intervals and tests for every table: Wilson, bootstrap, McNemar, paired bootstrap.

Only numpy and the standard library.  Intervals are those of 95 %.  Every bootstrap takes a seed and is
deterministic.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sumo_adv.datatypes import Floats
from sumo_adv.errors import UsageError

CONFIDENCE = 0.95
TAILS = ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2)
RESAMPLES = 10_000
AT_ONCE = 1_000_000  # values drawn at a time
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

    centre = (p + z^2/2n) / (1 + z^2/n), half width = z sqrt(p(1-p)/n + z^2/4n^2) / (1 + z^2/n).
    With n = 0: value nan, interval 0 to 1.  Raises UsageError unless 0 <= successes <= n.
    """
    if not 0 <= successes <= n:
        raise UsageError(f"A rate needs 0 <= successes <= n; got {successes} of {n}.")
    if n == 0:
        return Estimate(float("nan"), 0.0, 1.0, 0)
    z, p = NormalDist().inv_cdf(TAILS[1]), successes / n
    scale = 1 + z * z / n
    centre = (p + z * z / (2 * n)) / scale
    half = z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / scale
    low = 0.0 if successes == 0 else centre - half
    high = 1.0 if successes == n else centre + half
    return Estimate(p, low, high, n)


def bootstrap(values: Values, *, resamples: int = RESAMPLES, seed: int = 0, of: Summary = np.mean) -> Estimate:
    """The mean (or another summary ``of`` the values) with a percentile bootstrap interval.

    Raises UsageError on no values or on any not finite.
    """
    data = _finite(values)
    low, high = np.quantile(_resampled(data, resamples, seed, of), TAILS)
    return Estimate(float(of(data, axis=0)), float(low), float(high), len(data))


def _finite(values: Values) -> Floats:
    data = np.asarray(values, dtype=float)
    if not data.size or not np.isfinite(data).all():
        raise UsageError("A mean needs at least one value and finite ones; cap TTC (inf = never) before averaging.")
    return data


def _resampled(data: Floats, resamples: int, seed: int, of: Summary) -> Floats:
    """The summary of each resample, in portions that keep memory small."""
    generator, size = np.random.default_rng(seed), len(data)
    at_once = max(AT_ONCE // size, 1)
    counts = [min(at_once, resamples - begun) for begun in range(0, resamples, at_once)]
    return np.concatenate([of(data[generator.integers(0, size, (count, size))], axis=1) for count in counts])


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

    Binomial on the discordant pairs (McNemar 1947): p = 2 P(X <= min(b, c)), X ~ B(b + c, 1/2), at most 1.
    Raises UsageError where the lengths differ.
    """
    _same_length(len(first), len(second))
    successes, other_successes = np.asarray(first, dtype=bool), np.asarray(second, dtype=bool)
    b, c = int((successes & ~other_successes).sum()), int((~successes & other_successes).sum())
    tail = sum(math.comb(b + c, k) for k in range(min(b, c) + 1))
    return float(min(2 * tail / 2 ** (b + c), 1.0))


def paired_bootstrap(first: Values, second: Values, *, resamples: int = RESAMPLES, seed: int = 0) -> Paired:
    """Difference of means on the same encounters, resampling encounters (both methods together).

    p is twice the smaller share of resampled differences on one side of zero (with one added, at most 1).
    Raises UsageError where the lengths differ or values are not finite.
    """
    _same_length(len(first), len(second))
    values, other_values = _finite(first), _finite(second)
    means = _resampled(values - other_values, resamples, seed, np.mean)
    low, high = np.quantile(means, TAILS)
    side = min(int((means <= 0).sum()), int((means >= 0).sum()))
    p = min(2 * (side + 1) / (resamples + 1), 1.0)
    return Paired(float((values - other_values).mean()), float(low), float(high), p, len(values))


def _same_length(one: int, two: int) -> None:
    if one != two:
        raise UsageError(f"Paired tests need the same encounters for both methods; got {one} and {two}.")
