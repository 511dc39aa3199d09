"""The built-in expert: plays analyzer, generator and modifier by kinematic prediction. It is no language model.

It draws proposals (BV, intent, mode, parameters, delay) round robin over all that apply, has each predicted against
the model of the ego's driver, and ranks intents by the share of their candidates that is predicted to collide (more is
drawn near what is good), then by their best score. The tuner chooses what is tried first. It writes planners in
``composing``.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from sumo_adv.datatypes import Intent, LibraryEntry, ObservedMotion, Proposal
from sumo_adv.search.composed_intents import NAME, compose, composed
from sumo_adv.search.correction import PredictionCorrection
from sumo_adv.search.robustness import OF, alone, drawn, firm, firmed, varied
from sumo_adv.search.scorer import Scorer
from sumo_adv.search.templates import AttackTemplate, templates_of
from sumo_adv.situation import Situation

REACHES = 1.5  # a score below is a predicted collision that counts
AVOIDABLE = 0.75  # a score below is one that somebody could have avoided
BRAKES = 0.09  # a score below is one that a careful driver who only brakes could have avoided
REDRAW = 150  # proposals drawn at once where the first were not good
FOR_BRAKES = 750  # drawn at most in the hope of one that a brake would avoid, where some manoeuvre would already
MOST_DRAWN, EACH = 2000, 300  # drawn at most where nothing is avoidable, and so many more for each attempt
FEW = 5  # where so few proposals are avoidable, intents that the library lacks are composed as well
AT_FIRST = 14  # times the proposals that are wanted: what is drawn at most before the first attempt is chosen
CLEAR = 0.35  # taken off what a careful driver who only brakes avoids: of all predictions these come true most often
HARSH = 0.4  # what it costs to brake all the time up to the contact: traffic hardly brakes
LATE = 0.06  # what each second until a predicted contact costs: the later, the less sure
SPARE = 2.0  # s before the end: against a driver that nobody knows a contact comes later than foreseen, maybe too late
AT_THE_END = 0.3  # what a contact at the very end costs there
AGAIN = 240  # of the best ones are predicted again where the ego is thought to be another driver
NEAREST = 10  # of the best ones whose numbers are varied
FIRMED, AT_LEAST_FIRMED = 8, 3  # of the best ones whose neighbours are predicted at once; before the first attempt,
ROUNDS = 4  # and how often at most, until the best one is among them


class Expert:
    """Analyzer by prediction. ``pool`` holds every scored proposal of the last analysis."""

    name = NAME

    def __init__(
        self,
        scorer: Scorer,
        *,
        proposals: int,
        seed: int,
        allowed: Sequence[str] = (),
        unsure: bool = False,
        known: bool = False,
    ) -> None:
        """``unsure``: nobody knows the ego's driver; ``known``: it is known exactly."""
        self._scorer = scorer
        self._count = proposals
        self._draw = random.Random(seed)
        self._allowed = tuple(allowed)
        self.correction = PredictionCorrection(scorer, known)
        self._at_the_end = AT_THE_END if unsure else 0.0
        self.pool: list[Proposal] = []

    def analyze(self, situations: Mapping[float, Situation], library: Sequence[LibraryEntry]) -> list[Intent]:
        """Predict, then rank."""
        self.predict(situations, library)
        return self.ranking(situations, library)

    def predict(self, situations: Mapping[float, Situation], library: Sequence[LibraryEntry]) -> None:
        """Fill the pool: every way that applies, drawn and scored; more where nothing of it is good. What the expert
        composed itself waits until it is wanted (``ranking``), also where the bank has it by now, unless it is asked
        for by name."""
        self.pool = []
        self.widen(situations, [e for e in library if not composed(e) or e.label in self._allowed])

    def recall(self, situations: Mapping[float, Situation], known: Proposal) -> None:
        """Begin with what worked in a like scene alone; nothing is predicted until that has failed."""
        self.pool = [known]

    def widen(self, situations: Mapping[float, Situation], library: Sequence[LibraryEntry]) -> None:
        """Add to the pool what the library has and the pool has not; more where nothing is good then."""
        ways = templates_of(situations, library, self._allowed)
        known = {(p.delay, p.bv, p.label, p.planner.hash) for p in self.pool}
        fresh = [w for w in ways if (w.delay, w.target.state.id, w.entry.label, w.planner.hash) not in known]
        self.pool += self._first(fresh, self._count // 2 if self.pool else self._count)
        while ways and len(self.pool) < min(self.wanted(self.pool), AT_FIRST * self._count):
            self.pool += self.more(ways, sorted(self.pool, key=self.price))
        self.pool = self.firmed(self.pool)

    def firmed(
        self,
        pool: Sequence[Proposal],
        choose: Callable[[Sequence[Proposal]], Proposal] | None = None,
        at_once: int = AT_LEAST_FIRMED,
    ) -> list[Proposal]:
        """The pool with the best ones, ``at_once``, weighed together with their neighbours, and these, until what would
        be chosen (the one with the least price, if not said otherwise) is firm."""
        found = list(pool)
        for _ in range(ROUNDS if found else 0):
            first = choose(found) if choose is not None else min(found, key=self.price)
            if firm(first) or first.score >= AVOIDABLE:
                break
            loose = [p for p in found if p is not first and not firm(p) and p.score < AVOIDABLE]
            best = [first, *sorted(loose, key=self.price)[: at_once - 1]]
            taken = {id(p) for p in best}
            weighed = firmed(best, self._scored, self._draw)
            found = weighed + [p for p in found if id(p) not in taken]  # of equals a firm one comes first
        return found

    def ranking(self, situations: Mapping[float, Situation], library: Sequence[LibraryEntry]) -> list[Intent]:
        """The intents of the pool, most dangerous first; where few proposals reach it avoidably new ones, which nothing
        is predicted of yet, come behind what reaches it and before what does not."""
        reach, rest = self._ranked(library)
        good = sum(alone(p) < AVOIDABLE for p in drawn(self.pool))
        new = [] if good >= FEW or self._allowed else compose(situations, library)
        return reach + new + rest

    def _first(self, ways: Sequence[AttackTemplate], count: int) -> list[Proposal]:
        """``count`` scored proposals: of each mode one with its author's numbers, as early as can be; the others of any
        way in turn.

        What was learnt comes on top, with the numbers it was learnt with: it takes no draws from others, and these are
        the same as without it."""
        own = _own(ways)
        found = [w.proposal(None) for w in _earliest(own)]
        found += self._any(own, count - len(found))
        return self._scored(found + [w.proposal(None) for w in ways if w.learnt])

    def draw(self, ways: Sequence[AttackTemplate], count: int) -> list[Proposal]:
        """``count`` scored proposals, round robin; the first of each family with its author's numbers."""
        own = _own(ways)
        found = [w.proposal(None) for w in own] + self._any(own, count - len(own))
        return self._scored(found + [w.proposal(None) for w in ways if w.learnt])

    def heard(self, pool: Sequence[Proposal], tried: Proposal, course: ObservedMotion) -> list[Proposal]:
        """The pool after an attempt in which the ego went so: the ``AGAIN`` best predicted again where its driver is
        now thought to be another one. What worked in a like scene keeps its place."""
        if not self._scorer.heard(tried, course):
            return list(pool)
        found = list(pool)
        rows = sorted((k for k, p in enumerate(found) if p.by != "memory"), key=lambda k: self.price(found[k]))[:AGAIN]
        for k, again in zip(rows, self.correction.weigh(self._scorer.score([pool[k] for k in rows])), strict=True):
            mark = {OF: True} if pool[k].predicted.get(OF) else {}
            found[k] = replace(again, predicted={**again.predicted, **mark})
        return found

    def price(self, p: Proposal) -> float:
        """The predicted score, how late the contact comes, how much it brakes until then, and whether a brake would
        do."""
        hurried = self._at_the_end * max(1.0 - float(p.predicted.get("spare", SPARE)) / SPARE, 0.0)
        late = LATE * float(p.predicted.get("time", 0.0)) + hurried  # of a miss: to the end
        harsh = HARSH * float(p.predicted.get("braking", 0.0))
        brakes = CLEAR if alone(p) < BRAKES else 0.0
        return p.score + late + harsh - brakes

    def wanted(self, pool: Sequence[Proposal], tried: int = 0) -> int:
        """How many are drawn at most: more where nobody could avoid it by braking, most where by nothing, and then ever
        more as attempts go on."""
        best = min((p.score for p in pool), default=REACHES)
        return 0 if best < BRAKES else (self._count + FOR_BRAKES if best < AVOIDABLE else MOST_DRAWN + EACH * tried)

    def more(self, ways: Sequence[AttackTemplate], best: Sequence[Proposal]) -> list[Proposal]:
        """``REDRAW`` scored proposals: half of any way, half near the ``NEAREST`` first of ``best``."""
        found = self._any(_own(ways), REDRAW // 2)
        return self._scored(found + self._near(best[:NEAREST], REDRAW - len(found)))

    def vary(self, proposals: Sequence[Proposal], count: int) -> list[Proposal]:
        """``count`` scored proposals whose numbers are near those of the given ones, in turn."""
        return self._scored(self._near(proposals, count))

    def _any(self, ways: Sequence[AttackTemplate], count: int) -> list[Proposal]:
        """Proposals of the ways in turn, with drawn numbers."""
        return [ways[k % len(ways)].proposal(self._draw) for k in range(count if ways else 0)]

    def _near(self, proposals: Sequence[Proposal], count: int) -> list[Proposal]:
        return [varied(proposals[k % len(proposals)], self._draw) for k in range(count if proposals else 0)]

    def _scored(self, proposals: Sequence[Proposal]) -> list[Proposal]:
        """Predicted together, which takes less time than in parts."""
        return self.correction.weigh(self._scorer.score(proposals)) if proposals else []

    def _ranked(self, library: Sequence[LibraryEntry]) -> tuple[list[Intent], list[Intent]]:
        """The intents of the pool by which some way is predicted to collide, and those by which none is."""
        groups: dict[tuple[str, str], list[Proposal]] = {}
        for p in self.pool:
            groups.setdefault((p.bv, p.label), []).append(p)
        described = {e.label: e.description for e in library}

        def order(item: tuple[tuple[str, str], list[Proposal]]) -> tuple[float, float, str, str]:
            key, members = item
            return (-_share(drawn(members)), min(map(self.price, members)), *key)

        ranked = [(_share(drawn(g)), _intent(g, described[key[1]])) for key, g in sorted(groups.items(), key=order)]
        return [i for share, i in ranked if share > 0], [i for share, i in ranked if share == 0]


def _own(ways: Sequence[AttackTemplate]) -> list[AttackTemplate]:
    """What was not learnt, in the order in which it is drawn."""
    return sorted((w for w in ways if not w.learnt), key=lambda w: (w.entry.label, w.planner.mode, w.planner.hash))


def _earliest(ways: Sequence[AttackTemplate]) -> list[AttackTemplate]:
    """Of each vehicle's planners the first moment."""
    found: dict[tuple[str, str], AttackTemplate] = {}
    for way in sorted(ways, key=lambda w: w.delay):
        found.setdefault((way.target.state.id, way.planner.hash), way)
    return list(found.values())


def _share(members: Sequence[Proposal]) -> float:
    return sum(alone(p) < REACHES for p in members) / len(members)


def _intent(members: Sequence[Proposal], description: str) -> Intent:
    best = min(members, key=lambda p: p.score)
    members = drawn(members)
    share = _share(members)
    risk = "high" if best.score < AVOIDABLE else ("medium" if best.score < REACHES else "low")
    valid = sum(alone(p) < AVOIDABLE for p in members)
    reason = (
        f"predicted: {share:.0%} of {len(members)} candidates collide, {valid} of them avoidably; "
        f"least TTC {min(float(p.predicted.get('min_ttc', 10.0)) for p in members):.2f} s"
    )
    return Intent(best.bv, best.label, description, risk, best.acceleration, reason)
