"""Estimate when a hunt may stop: distinct failures are species, episodes are samples.

========================= ============================================================================================
figure                    source
========================= ============================================================================================
chance of a new kind      Good-Turing (Good 1953): the share of samples that would have been new had they come last,
                          i.e. that hold a kind that no other sample holds
least number of kinds     Chao1 (Chao 1984): S + f1^2 / (2 f2); if no kind was seen twice, S + f1 (f1 - 1) / 2.
                          S: kinds seen; f1, f2: kinds in one and in two samples. It is a lower bound
its interval (95 %)       log-normal (Chao 1987, "Estimating the population size for capture-recapture data with unequal
                          catchability"); if the estimate is that nothing is missing, the interval of EstimateS
                          (Colwell 2013, appendix B), which includes the kinds that were missed by chance
========================= ============================================================================================

Boehme 2018, "STADS: Software testing as species discovery", uses these estimates for fuzzers. They hold for samples
that are drawn in the same way. A hunt draws more from inputs that led to something new, so its estimated chance of a
new kind is rather too high.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Hashable, Sequence
from dataclasses import dataclass

MIN_SAMPLES = 10  # samples below which nothing is said of what is left: most kinds were seen once or not at all
NORMAL_95 = 1.96  # standard deviations on each side of a 95 % interval


@dataclass(frozen=True, slots=True)
class Discovery:
    """What samples tell about the kinds that are still to be found.

    Attributes:
        samples: Number of samples.
        kinds: Number of different kinds in them.
        once: Number of kinds that are in one sample only.
        chance: Chance that the next sample contains a new kind; nan without samples.
        least: Lower bound of the number of kinds that exist.
        low: Lower end of the 95 % interval of ``least``.
        high: Upper end of the 95 % interval of ``least``; inf if no kind was seen.
    """

    samples: int
    kinds: int
    once: int
    chance: float
    least: float
    low: float
    high: float

    def as_data(self) -> dict[str, float | int | None]:
        """Return the figures by name; those that are not finite are None."""
        finite = {name: getattr(self, name) for name in ("chance", "least", "low", "high")}
        return {
            "samples": self.samples, "kinds": self.kinds, "once": self.once,
            **{name: round(value, 4) if math.isfinite(value) else None for name, value in finite.items()},
        }  # fmt: skip

    @property
    def words(self) -> str:
        """The chance and the bound in words, or that there are too few samples for them."""
        if not self.samples:
            return "no episode yet"
        if self.samples < MIN_SAMPLES:
            return "too few episodes to say what is left"
        chance = f"the next episode brings a new kind with a probability of {100 * self.chance:.0f} %"
        if not self.kinds:
            return chance
        kinds = "kind" if round(self.least) == 1 else "kinds"
        return f"{chance}; at least {self.least:.0f} {kinds} ({self.low:.0f} to {self.high:.0f})"


def discovery(samples: Sequence[Collection[Hashable]]) -> Discovery:
    """Estimate what is left to find.

    Args:
        samples: The kinds in each sample; a kind counts once in a sample.
    """
    seen = Counter(kind for sample in samples for kind in set(sample))
    frequency = Counter(seen.values())
    once = {kind for kind, times in seen.items() if times == 1}
    n, kinds = len(samples), len(seen)
    chance = sum(not once.isdisjoint(sample) for sample in samples) / n if n else math.nan
    if not kinds:
        return Discovery(n, 0, 0, chance, 0.0, 0.0, math.inf)
    f1, f2 = frequency[1], frequency[2]
    missing = f1**2 / (2 * f2) if f2 else f1 * (f1 - 1) / 2
    if missing > 0:
        spread = math.exp(NORMAL_95 * math.sqrt(math.log(1 + _variance(f1, f2, kinds) / missing**2)))
        low, high = kinds + missing / spread, kinds + missing * spread
    else:
        low, high = _nothing_missing(frequency, kinds, n)
    return Discovery(n, kinds, f1, chance, kinds + missing, low, high)


def _variance(f1: int, f2: int, kinds: int) -> float:
    """Return the variance of Chao1 (Chao 1987; if no kind was seen twice, as in EstimateS)."""
    if f2:
        ratio = f1 / f2
        return f2 * (ratio**2 / 2 + ratio**3 + ratio**4 / 4)
    least = kinds + f1 * (f1 - 1) / 2
    return f1 * (f1 - 1) / 2 + f1 * (2 * f1 - 1) ** 2 / 4 - f1**4 / (4 * least)


def _nothing_missing(frequency: Counter[int], kinds: int, n: int) -> tuple[float, float]:
    """Return the interval if the estimate equals the number of kinds seen."""
    left_out = sum(many * math.exp(-times) for times, many in frequency.items())
    variance = left_out - sum(many * math.exp(-2 * times) for times, many in frequency.items())
    variance -= sum(many * times * math.exp(-times) for times, many in frequency.items()) ** 2 / n
    seen = 1 - left_out / kinds
    spread = NORMAL_95 * math.sqrt(max(variance, 0.0)) / seen
    return max(float(kinds), kinds / seen - spread), kinds / seen + spread
