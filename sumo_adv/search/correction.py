"""Proposals weighed anew by how the ego really went: what a prediction got wrong once it gets wrong again.

After an attempt that came otherwise than predicted, the proposals of that vehicle and moment are also predicted against
an ego that drives as it was seen to in the most similar attempt; their score becomes a mean of both predictions, with
a weight that grows with every such surprise (in CAT, too, real rollouts take the place of predicted ones; Zhang et al.
2023, CoRL).  This is how an ego whose driver is unknown is learnt within an encounter.  Of a driver that is known what
was seen only makes predictions worse: an ego that drives as in another attempt does not see this one's adversary, and
of 78 attempts that were predicted to miss, and to hit such an ego, none did.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sumo_adv.datatypes import ObservedMotion, Proposal
from sumo_adv.search.robustness import ALONE
from sumo_adv.search.scorer import Scorer

Key = tuple[str, float]  # BV, delay

SURPRISE = 0.5  # share of what is left of a prediction's weight that goes to what was seen, each time
WORST = 2.5  # a score above it (a miss by far, a rear-end) counts as this
WEIGHED = 300  # of those that a surprise concerns so many are weighed anew at most, the best ones
HOPELESS = ("off_road", "beyond", "third_party", "failed")


class PredictionCorrection:
    """What was seen of the ego, by the vehicle that attacked and when."""

    def __init__(self, scorer: Scorer, known: bool = False) -> None:
        """``known``: the ego's driver is."""
        self._scorer, self._known = scorer, known
        self._seen: dict[Key, list[tuple[Proposal, ObservedMotion]]] = {}

    def surprised(self, tried: Proposal, course: ObservedMotion) -> Key:
        """Keep how the ego went in an attempt that was predicted otherwise; the key whose proposals that changes."""
        key = (tried.bv, tried.delay)
        self._seen.setdefault(key, []).append((tried, course))
        return key

    def weigh(self, proposals: Sequence[Proposal], only: Key | None = None) -> list[Proposal]:
        """The proposals; those that something was seen for (of a key ``only`` the ``WEIGHED`` best) have new scores."""
        found = list(proposals)
        rows = [k for k, p in enumerate(found) if self._concerns(p, only)]
        if only is not None:
            rows = sorted(rows, key=lambda k: found[k].score)[:WEIGHED]
        if not rows:
            return found
        courses = [_nearest(found[k], self._seen[found[k].bv, found[k].delay]) for k in rows]
        for k, again in zip(rows, self._scorer.score([found[k] for k in rows], courses), strict=True):
            weight = 1.0 - (1.0 - SURPRISE) ** len(self._seen[again.bv, again.delay])
            before = dict(found[k].predicted)
            first = float(before.get("before", before.pop(ALONE, found[k].score)))
            before.pop(ALONE, None)  # its neighbours are to be asked again
            score = (1.0 - weight) * min(first, WORST) + weight * min(again.score, WORST)
            score = max(score, first) if self._known else score
            found[k] = replace(found[k], score=score, predicted={**before, "before": first, "seen": again.score})
        return found

    def _concerns(self, p: Proposal, only: Key | None) -> bool:
        key = (p.bv, p.delay)
        return key in self._seen and only in (None, key) and not any(p.predicted.get(w) for w in HOPELESS)


def _nearest(p: Proposal, seen: Sequence[tuple[Proposal, ObservedMotion]]) -> ObservedMotion:
    """How the ego went in the attempt most like a proposal: of the same mode, with the nearest numbers, the later of
    equals; the last one where none was of its mode."""
    alike = [(tried, course) for tried, course in seen if tried.family == p.family]
    if not alike:
        return seen[-1][1]
    return min(reversed(alike), key=lambda each: _apart(p, each[0]))[1]


def _apart(p: Proposal, tried: Proposal) -> float:
    """Squared distance of the numbers of two proposals, each in parts of its range."""
    ranges = {q.name: max(q.high - q.low, 1e-9) for q in p.planner.parameters}
    known = ranges.keys() & p.parameters.keys() & tried.parameters.keys()
    return sum(((p.parameters[name] - tried.parameters[name]) / ranges[name]) ** 2 for name in sorted(known))
