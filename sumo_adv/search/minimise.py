"""The mildest variant of an attack that still reaches a level, for triage: later, gentler, slower.

Variants of the mildest attack so far are drawn near its parameters and at all starts. Those that are predicted to
reach the level and to be milder are tried, the mildest first. The search ends when no variant promises to be milder.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from random import Random

from sumo_adv.datatypes import Level, Proposal
from sumo_adv.search.protocols import Scorer
from sumo_adv.search.sampling import varied


@dataclass(frozen=True, slots=True)
class MinimiseSettings:
    """What counts as mild, and how variants are drawn.

    The harshness of an attack is a sum [m/s2]: its largest acceleration, the ego's delta-v, and how early it begins.
    """

    of_delta_v: float = 1.0  # 1/s: a delta-v of 1 m/s counts as an acceleration of 1 m/s2
    of_earliness: float = 0.2  # m/s3 for each second of delay that is given away: later tells more about the ego
    drawn: int = 120  # variants predicted in each round
    spreads: tuple[float, ...] = (0.3, 0.1, 0.03)  # of a parameter's range: standard deviations, in turn
    rounds: int = 6  # in a row without a milder attack, then it ends
    least_gain: float = 0.02  # share by which a variant must be predicted to be milder


class Minimiser:
    """Proposes variants of an attack that promise to be milder; ``best`` is the mildest that reached the level."""

    def __init__(
        self, scorer: Scorer, first: Proposal, harshness: float, level: Level, starts: Sequence[float], seed: int,
        settings: MinimiseSettings | None = None,
    ) -> None:  # fmt: skip
        """first: the attack, with ``harshness`` in the simulation; starts: delays at which variants may begin [s]."""
        self._scorer, self._level, self._starts = scorer, level, tuple(starts)
        self._settings, self._random = settings or MinimiseSettings(), Random(seed)
        self.best, self.harshness = first, harshness
        self._latest, self._failed, self._round = max(starts), 0, 0

    def harshness_of(self, acceleration: float, delta_v: float, delay: float) -> float:
        """Harshness [m/s2] from the largest acceleration [m/s2], the ego's delta-v [m/s] and the delay [s]."""
        settings = self._settings
        return acceleration + settings.of_delta_v * delta_v + settings.of_earliness * (self._latest - delay)

    def propose(self) -> Proposal | None:
        """The variant to try next; None when no variant has been milder for some rounds."""
        settings = self._settings
        while self._failed < settings.rounds:
            spread = settings.spreads[self._round % len(settings.spreads)]
            self._round += 1
            variants = [varied(self.best, self._random, spread) for _ in range(settings.drawn)]
            variants = [_begun(p, self._start(p)) for p in variants]
            scored = [(self._predicted(p), k, p) for k, p in enumerate(self._scorer.score(variants))]
            harshness, _, mildest = min(scored, key=lambda each: each[:2])
            if harshness < self.harshness * (1.0 - settings.least_gain):
                return mildest
            self._failed += 1
        return None

    def observe(self, tried: Proposal, level: Level, harshness: float) -> bool:
        """Take note of an attempt; whether it is the mildest so far that reaches the level."""
        if level >= self._level and harshness < self.harshness:
            self.best, self.harshness, self._failed = tried, harshness, 0
            return True
        self._failed += 1
        return False

    def _start(self, p: Proposal) -> float:
        """Half of the variants keep their start; the others get any."""
        return p.delay if self._random.random() < 0.5 else self._random.choice(self._starts)

    def _predicted(self, p: Proposal) -> float:
        """The predicted harshness; infinite where the level is not reached."""
        seen = p.prediction
        if seen is None or seen.failure or seen.level < self._level:
            return float("inf")
        return self.harshness_of(seen.acceleration, seen.delta_v, p.delay)


def _begun(p: Proposal, delay: float) -> Proposal:
    """The variant with another start, of its supports, too."""
    return replace(p, delay=delay, supports=tuple(replace(support, delay=delay) for support in p.supports))
