"""Rates from weighted runs: pure functions of arrays.

The rate is a ratio of sums over runs, weighted crashes by weighted exposure. The interval is that of Fay and Feuer
(1997) for a weighted sum of rare events: gamma quantiles with the mean and the variance of the sum, the upper one with
one more event of the largest weight. The variance is the sum of the squared weights, and what uneven exposures of the
runs add. With equal weights and exposures it is the exact interval of a Poisson count (Garwood 1936). It
is never negative, and unlike the normal interval it covers where few crashes with uneven weights were seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from scipy.special import gammaincinv

from sumo_adv.datatypes import Floats

SECONDS_PER_HOUR = 3600.0
ENOUGH = 10  # crashes: the weights of fewer do not tell how large those are that were not seen


@dataclass(frozen=True, slots=True)
class Rate:
    """A rate with its interval, per unit of exposure.

    crashes: how many were seen. effective: how many of equal weight tell as much (Kish 1965). largest_share: of the
    estimate, that the crash with the largest weight has. plain_runs: how many runs of the model itself give the same
    variance. These are None without a crash.
    """

    value: float
    low: float
    high: float
    crashes: int
    effective: float
    largest_share: float | None
    plain_runs: float | None

    @property
    def half_width(self) -> float | None:
        """Half the interval over the estimate; None without a crash."""
        return (self.high - self.low) / (2 * self.value) if self.value > 0 else None


def rate(weights: Floats, exposure: Floats, most_weight: float = 1.0, confidence: float = 0.95) -> Rate:
    """The rate of crashes.

    weights ``(runs,)``: the weight of each run that crashed, at the crash; 0 for others. exposure ``(runs,)``:
    weighted, in any unit. most_weight: that a crash can have; the upper limit rests on it unless ``ENOUGH`` were seen.
    """
    total, over = float(weights.sum()), float(exposure.sum())
    seen = int((weights > 0).sum())
    if over <= 0.0:
        return Rate(math.nan, 0.0, math.inf, seen, 0.0, None, None)
    tail = (1 - confidence) / 2
    if not seen:
        return Rate(0.0, 0.0, float(gammaincinv(1.0, 1 - tail)) * most_weight / over, 0, 0.0, None, None)
    square, seen_largest = float((weights**2).sum()), float(weights.max())
    largest = seen_largest if seen >= ENOUGH else most_weight
    variance = square + (total / over) ** 2 * float(((exposure - exposure.mean()) ** 2).sum())
    low = _quantile(total, variance, tail)
    high = _quantile(total + largest, variance + largest**2, 1 - tail)
    plain_runs = len(weights) * total / variance
    return Rate(
        total / over, low / over, high / over, seen, total**2 / square, seen_largest / total, plain_runs
    )  # fmt: skip


def _quantile(mean: float, variance: float, share: float) -> float:
    """That of the gamma distribution with this mean and variance."""
    return float(gammaincinv(mean**2 / variance, share)) * variance / mean


def effective_runs(weights: Floats) -> float:
    """How many runs of equal weight the weighted runs are worth (Kish 1965)."""
    return float(weights.sum() ** 2 / (weights**2).sum())
