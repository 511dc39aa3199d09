"""Scores corrected by how the ego really drove in an attempt that came out otherwise than predicted.

The candidates of the same vehicle and start are then predicted once more, against an ego that drives as it did in the
most similar attempt. Their score becomes a mean of both predictions, and the observation's weight grows with every
such surprise (CAT, too, replaces predictions by real rollouts; Zhang et al. 2023, CoRL). This is how an unknown driver
is learnt within an encounter. Against a known driver a correction only makes scores worse: an ego that drives as in
another attempt does not react to this adversary, and of 78 attempts predicted to hit only such an ego, none did.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sumo_adv.datatypes import ObservedMotion, Proposal
from sumo_adv.search.protocols import Scorer
from sumo_adv.search.settings import CorrectionSettings

Key = tuple[str, float]
"""Vehicle and delay [s]: what a surprise concerns."""


class PredictionCorrection:
    """The motions of the ego that were observed, by vehicle and start."""

    def __init__(self, scorer: Scorer, settings: CorrectionSettings, *, known_driver: bool = False) -> None:
        self._scorer, self._settings, self._known_driver = scorer, settings, known_driver
        self._observed: dict[Key, list[tuple[Proposal, ObservedMotion]]] = {}

    def observe(self, tried: Proposal, motion: ObservedMotion) -> Key:
        """Keep the ego's motion in an attempt that surprised; the key of the candidates that it changes."""
        key = (tried.bv, tried.delay)
        self._observed.setdefault(key, []).append((tried, motion))
        return key

    def corrected(self, proposals: Sequence[Proposal], only: Key | None = None) -> list[Proposal]:
        """The candidates, with new scores where a motion was observed (of the key ``only``: of its best ones)."""
        settings, pool = self._settings, list(proposals)
        rows = [k for k, p in enumerate(pool) if self._concerns(p, only)]
        if only is not None:
            rows = sorted(rows, key=lambda k: pool[k].score)[: settings.at_once]
        if not rows:
            return pool
        motions = [_most_similar(pool[k], self._observed[pool[k].bv, pool[k].delay]) for k in rows]
        for k, again in zip(rows, self._scorer.score([pool[k] for k in rows], motions), strict=True):
            weight = 1.0 - (1.0 - settings.share) ** len(self._observed[again.bv, again.delay])
            before = pool[k]
            first = before.nominal_score if before.uncorrected is None else before.uncorrected
            score = (1.0 - weight) * min(first, settings.worst) + weight * min(again.score, settings.worst)
            score = max(score, first) if self._known_driver else score
            pool[k] = replace(before, score=score, nominal=None, uncorrected=first)  # its neighbours are outdated
        return pool

    def _concerns(self, p: Proposal, only: Key | None) -> bool:
        key, hopeless = (p.bv, p.delay), p.prediction is not None and p.prediction.hopeless
        return key in self._observed and only in (None, key) and not hopeless and not p.supports


def _most_similar(p: Proposal, observed: Sequence[tuple[Proposal, ObservedMotion]]) -> ObservedMotion:
    """The ego's motion in the attempt most like a candidate: of the same mode, with the nearest parameters, the later
    of equals; without an attempt of its mode, the last one."""
    same = [(tried, motion) for tried, motion in observed if tried.family == p.family]
    if not same:
        return observed[-1][1]
    return min(reversed(same), key=lambda each: _apart(p, each[0]))[1]


def _apart(p: Proposal, tried: Proposal) -> float:
    """Squared distance of the parameters of two candidates, each as a share of its range."""
    ranges = {q.name: max(q.high - q.low, 1e-9) for q in p.planner.parameters}
    both = ranges.keys() & p.parameters.keys() & tried.parameters.keys()
    return sum(((p.parameters[name] - tried.parameters[name]) / ranges[name]) ** 2 for name in sorted(both))
