"""The inner loop of refinement: which proposal is tried next.

By predicted score, with a growing price on what was tried already, every third time the best of the least tried family;
when all that is promising is used up, new proposals are drawn.  At most ``share`` attempts go to the versions of a mode
that were there at first, and to each that is added.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from sumo_adv.datatypes import ObservedMotion, Planner, Proposal
from sumo_adv.search.expert import AT_LEAST_FIRMED, AVOIDABLE, FIRMED, REACHES, Expert
from sumo_adv.search.robustness import alone, drawn
from sumo_adv.search.templates import AttackTemplate

TRIED_PRICE = 0.12  # score a family pays for each attempt (ALGORITHM, "How it was built")
SAME_PRICE = 1.0  # and what is predicted to drive just as one that was tried, for each of these
RANK_PRICE = 0.3  # score a place in a model's ranking costs: a good candidate further down comes after a fair one above
DIVERSE_EVERY = 3
TRACES = ("time", "gap", "min_ttc", "warning", "braking")  # of a prediction
Motion = tuple[str | float, ...]


class Tuner:
    """Orders the pool of an expert's proposals. ``ranks``: (BV, label) -> place in an analyzer's ranking, where that is
    not the pool's own; a later place, or none, has its price."""

    name = "builtin"

    def __init__(
        self,
        expert: Expert,
        ways: Sequence[AttackTemplate],
        *,
        share: int,
        ranks: Mapping[tuple[str, str], int] | None = None,
    ) -> None:
        self._ranks = dict(ranks or {})
        self._expert = expert
        self._ways = list(ways)
        self._share = share
        self.pool = list(expert.pool)
        self._drawn = len(drawn(self.pool))
        self._tries: Counter[tuple[str, str, str]] = Counter()
        self._by_planner: Counter[Planner] = Counter()
        self._motions: Counter[Motion | None] = Counter()  # that were tried, as predicted
        self._added: set[str] = set()  # planners' hashes
        self._count = 0

    def add(self, ways: Sequence[AttackTemplate], count: int) -> None:
        """More ways to attack: a new or changed planner's."""
        self._ways += ways
        self._added |= {w.planner.hash for w in ways}
        self.pool += self._expert.draw(ways, count)

    def first_of(self, bv: str, label: str) -> Proposal | None:
        """The best predicted way of an intent with its author's numbers, taken out of the pool, or None."""
        ways = [w for w in self._ways if (w.target.state.id, w.entry.label) == (bv, label)]
        mine = [p for p in self.pool if (p.bv, p.label) == (bv, label) and dict(p.parameters) == p.planner.defaults()]
        there = {(p.delay, p.planner.hash) for p in mine}
        fresh = self._expert.draw([w for w in ways if (w.delay, w.planner.hash) not in there], 0)
        self.pool += fresh
        return self._take(min(mine + fresh, key=lambda p: p.score)) if mine or fresh else None

    def next(self) -> Proposal | None:
        """The next proposal, or None when nothing is left to try."""
        open_, closed = self._split()
        while self._drawn < self._expert.wanted(self._untried(open_), self._count):
            over = self._over()
            ways = [w for w in self._ways if self._sharing(w.planner) not in over]
            fresh = self._expert.more(ways, sorted(open_, key=self._price))
            self._drawn += max(len(fresh), 1)
            self.pool += fresh
            open_, closed = self._split()
        if not open_:
            return None
        open_ = self._expert.firmed(open_, self._chosen, FIRMED if self._count else AT_LEAST_FIRMED)
        self.pool = closed + open_
        return self._take(self._chosen(open_))

    def _take(self, chosen: Proposal) -> Proposal:
        self.pool.remove(chosen)
        self._count += 1
        self._tries[chosen.family] += 1
        self._by_planner[chosen.planner] += 1
        self._motions[_motion(chosen)] += 1
        return chosen

    def heard(self, tried: Proposal, course: ObservedMotion, valid: bool) -> None:
        """How the ego went in an attempt; where that was predicted otherwise, the pool is weighed anew."""
        before, self.pool = self.pool, self._expert.heard(self.pool, tried, course)
        for old, new in zip(before, self.pool, strict=True):  # predicted otherwise, it is still what was tried
            if new is not old and (count := self._same(old)):
                self._motions[_motion(new)] = count
        if (alone(tried) < AVOIDABLE) != valid:
            correction = self._expert.correction
            self.pool = correction.weigh(self.pool, correction.surprised(tried, course))

    def exhausted(self) -> list[str]:
        """Hashes of planners whose share is used up; of versions that share one, that of the one tried most."""
        over, most = self._over(), dict[str, str]()
        for planner, _ in self._by_planner.most_common():
            if self._sharing(planner) in over:
                most.setdefault(self._sharing(planner), planner.hash)
        return list(most.values())

    def _split(self) -> tuple[list[Proposal], list[Proposal]]:
        """The pool: what may still be tried, and what has no attempts left."""
        over = self._over()
        closed = [self._sharing(p.planner) in over for p in self.pool]
        return (
            [p for p, shut in zip(self.pool, closed, strict=True) if not shut],
            [p for p, shut in zip(self.pool, closed, strict=True) if shut],
        )

    def _untried(self, proposals: Sequence[Proposal]) -> list[Proposal]:
        """Those that nothing tried was predicted to drive like."""
        return [p for p in proposals if not self._same(p)]

    def _same(self, p: Proposal) -> int:
        """How many were tried that were predicted to drive like it."""
        motion = _motion(p)
        return 0 if motion is None else self._motions[motion]

    def _over(self) -> set[str]:
        """Shares that are used up."""
        tries = Counter[str]()
        for planner, count in self._by_planner.items():
            tries[self._sharing(planner)] += count
        return {share for share, count in tries.items() if count >= self._share}

    def _sharing(self, planner: Planner) -> str:
        """What all planners that have one share of attempts have in common."""
        return planner.hash if planner.hash in self._added else f"{planner.label}/{planner.mode}"

    def _chosen(self, open_: Sequence[Proposal]) -> Proposal:
        if self._count % DIVERSE_EVERY == DIVERSE_EVERY - 1:
            promising = [p for p in open_ if p.score < REACHES] or list(open_)
            least = min(self._tries[p.family] for p in promising)
            return min((p for p in promising if self._tries[p.family] == least), key=self._price)
        return min(open_, key=lambda p: self._price(p) + TRIED_PRICE * self._tries[p.family])

    def _price(self, p: Proposal) -> float:
        """The predicted score, what the analyzer's order adds to it, and what it costs to try the same again."""
        again = SAME_PRICE * self._same(p)
        return self._expert.price(p) + RANK_PRICE * self._ranks.get((p.bv, p.label), len(self._ranks)) + again


def _motion(p: Proposal) -> Motion | None:
    """What tells predicted motions of a BV apart: numbers that only matter later than the contact change nothing. None
    where no motion was predicted."""
    if not p.predicted.keys() >= set(TRACES):
        return None
    return (p.bv, p.delay, *(round(float(p.predicted[name]), 2) for name in TRACES))
