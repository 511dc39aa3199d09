"""The search for an attack: a pool of predicted candidates, from which the next ones to try are proposed.

``AttackSearch`` draws candidates (``sampling``), has them predicted and scored (``scorer``), weighs the best ones with
their neighbours (``robustness``), and draws more while none is good. ``propose`` takes the candidate with the least
price: its score, and what else counts (``settings.PriceSettings``). ``observe`` corrects the pool by how the ego really
drove (``correction``). It plays the analyzer where no language model does (``ranking``).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from sumo_adv.datatypes import Intent, LibraryEntry, ObservedMotion, Planner, Proposal
from sumo_adv.search.composed_intents import compose, composed
from sumo_adv.search.correction import PredictionCorrection
from sumo_adv.search.protocols import Scorer
from sumo_adv.search.ranking import ranked_intents
from sumo_adv.search.robustness import drawn, is_robust, weighed_with_neighbours
from sumo_adv.search.sampling import Sampler
from sumo_adv.search.settings import SearchSettings
from sumo_adv.search.templates import AttackTemplate, templates_of
from sumo_adv.situation import Situation

PredictedMotion = tuple[str | float, ...]


class AttackSearch:
    """The candidates of one encounter. ``pool``: all that were predicted and not tried yet."""

    def __init__(
        self,
        scorer: Scorer,
        situations: Mapping[float, Situation],
        library: Sequence[LibraryEntry],
        settings: SearchSettings,
        *,
        seed: int,
        allowed: Sequence[str] = (),
        unknown_driver: bool = False,
        exact_driver: bool = False,
        recalled: Proposal | None = None,
    ) -> None:
        """Predict the first candidates.

        situations: by delay after the trigger [s]. allowed: the only intents, if any are named. unknown_driver: no
        model of the ego's driver is known; exact_driver: the model is the driver's own. recalled: a candidate that
        succeeded in a similar scene; it is tried first, and nothing is predicted until it has failed.
        """
        self._scorer, self._situations, self._settings = scorer, dict(situations), settings
        self._allowed, self._unknown_driver = tuple(allowed), unknown_driver
        self._sampler = Sampler(settings.sampling, seed)
        self._correction = PredictionCorrection(scorer, settings.correction, known_driver=exact_driver)
        self._ranks: Mapping[tuple[str, str], int] = {}
        self._tried: list[Proposal] = []
        self._by_family: Counter[tuple[str, str, str]] = Counter()
        self._by_planner: Counter[Planner] = Counter()
        self._by_motion: Counter[PredictedMotion | None] = Counter()
        self._added: set[str] = set()  # hashes of planners with a share of attempts of their own
        self._templates: list[AttackTemplate] = []
        self._redrawn = 0  # candidates drawn, with those of the first analysis
        self.pool: list[Proposal] = []
        if recalled is not None:
            self.pool = [recalled]
        else:
            self.extend([e for e in library if not composed(e) or e.label in self._allowed])

    # -- the pool -----------------------------------------------------------------------------------------------

    @property
    def reaches(self) -> bool:
        """Whether some candidate is predicted to collide, or succeeded in a similar scene."""
        return any(p.score < self._settings.reaches for p in self.pool)

    def extend(self, library: Sequence[LibraryEntry]) -> None:
        """Predict candidates of whatever the library has and the pool has not; more while none is good."""
        settings, count = self._settings, self._settings.proposals
        templates = templates_of(self._situations, library, self._allowed)
        present = {(p.delay, p.bv, p.label, p.planner.hash) for p in self.pool}
        fresh = [t for t in templates if (t.delay, t.target.state.id, t.entry.label, t.planner.hash) not in present]
        self.pool += self._scored(self._sampler.first(fresh, count // 2 if self.pool else count))
        most = settings.sampling.before_first_attempt * count
        while templates and len(self.pool) < min(self._wanted(self.pool), most):
            self.pool += self._scored(self._sampler.more(templates, sorted(self.pool, key=self.price)))
        self.pool = self._made_robust(self.pool, self._cheapest, settings.robustness.first)

    def ranking(self, library: Sequence[LibraryEntry]) -> list[Intent]:
        """The intents of the pool, most dangerous first.

        Where few candidates are avoidable, intents that the library lacks are composed. They come behind the intents
        that reach the ego and before those that do not; nothing is predicted of them yet.
        """
        descriptions = {e.label: e.description for e in library}
        reaching, rest = ranked_intents(self.pool, descriptions, self.price, self._settings)
        good = sum(p.nominal_score < self._settings.avoidable for p in drawn(self.pool))
        new = [] if good >= self._settings.few or self._allowed else compose(self._situations, library)
        return reaching + new + rest

    def price(self, p: Proposal) -> float:
        """A candidate's score with what else counts: a late contact, much braking, and that a brake would do."""
        weights, seen = self._settings.price, p.prediction
        clear = weights.clear if p.nominal_score < weights.braked else 0.0
        if seen is None:
            return p.score - clear
        hurried = max(1.0 - seen.spare / weights.spare, 0.0) if self._unknown_driver else 0.0
        late = weights.late * seen.time + weights.at_the_end * hurried
        return p.score + late + weights.harsh * seen.braking - clear

    # -- attempts -----------------------------------------------------------------------------------------------

    def follow(
        self, intents: Sequence[Intent], library: Sequence[LibraryEntry], *, in_their_order: bool = False
    ) -> list[AttackTemplate]:
        """From now on draw only from these intents; ``in_their_order``: a place in the ranking has its price.

        Returns their templates.
        """
        self._templates = templates_of(self._situations, library, [i.label for i in intents])
        self._ranks = {(i.bv, i.label): k for k, i in enumerate(intents)} if in_their_order else {}
        self._redrawn = len(drawn(self.pool))
        return list(self._templates)

    def propose(self, budget: int) -> list[Proposal]:
        """The next candidates to try, at most ``budget``; none when nothing is left. They leave the pool."""
        selected = list[Proposal]()
        while len(selected) < budget and (proposal := self._next()) is not None:
            selected.append(proposal)
        return selected

    def propose_default(self, bv: str, label: str) -> Proposal | None:
        """The best candidate of an intent with its author's parameters, or None; it leaves the pool."""
        templates = [t for t in self._templates if (t.target.state.id, t.entry.label) == (bv, label)]
        pool = [p for p in self.pool if (p.bv, p.label) == (bv, label)]
        defaults = [p for p in pool if dict(p.parameters) == p.planner.defaults()]
        there = {(p.delay, p.planner.hash) for p in defaults}
        missing = [t for t in templates if (t.delay, t.planner.hash) not in there]
        fresh = self._scored(self._sampler.each(missing, 0))
        self.pool += fresh
        return self._take(min(defaults + fresh, key=lambda p: p.score)) if defaults or fresh else None

    def observe(self, tried: Proposal, motion: ObservedMotion, *, avoidable: bool) -> None:
        """Correct the pool by the ego's motion in an attempt; ``avoidable``: it was a collision that counts."""
        before, self.pool = self.pool, self._predicted_again(tried, motion)
        for old, new in zip(before, self.pool, strict=True):  # predicted otherwise, it is still what was tried
            if new is not old and (count := self._same(old)):
                self._by_motion[_motion(new)] = count
        if (tried.nominal_score < self._settings.avoidable) != avoidable:
            self.pool = self._correction.corrected(self.pool, self._correction.observe(tried, motion))

    def exhausted(self) -> list[str]:
        """Hashes of planners without attempts left; of versions with one share, the most tried one."""
        over, most = self._used_up(), dict[str, str]()
        for planner, _ in self._by_planner.most_common():
            if self._share_of(planner) in over:
                most.setdefault(self._share_of(planner), planner.hash)
        return list(most.values())

    def add_version(self, planner: Planner) -> None:
        """A changed planner, for every vehicle and start that its mode has; it gets a share of attempts of its own."""
        same = {
            (t.delay, t.target.state.id): t for t in self._templates
            if (t.planner.label, t.planner.mode) == (planner.label, planner.mode)
        }  # fmt: skip
        fresh = [AttackTemplate(t.delay, t.target, t.entry, planner) for t in same.values()]
        self._templates += fresh
        self._added.add(planner.hash)
        self.pool += self._scored(self._sampler.each(fresh, 3 * len(fresh)))

    # -- choosing -----------------------------------------------------------------------------------------------

    def _next(self) -> Proposal | None:
        open_, closed = self._split()
        while self._redrawn < self._wanted([p for p in open_ if not self._same(p)], len(self._tried)):
            over = self._used_up()
            templates = [t for t in self._templates if self._share_of(t.planner) not in over]
            fresh = self._scored(self._sampler.more(templates, sorted(open_, key=self._price_now)))
            if not fresh:
                break
            self._redrawn += len(fresh)
            self.pool += fresh
            open_, closed = self._split()
        if not open_:
            return None
        robustness = self._settings.robustness
        open_ = self._made_robust(open_, self._choice, robustness.later if self._tried else robustness.first)
        self.pool = closed + open_
        return self._take(self._choice(open_))

    def _choice(self, open_: Sequence[Proposal]) -> Proposal:
        """The cheapest candidate; every few attempts, the cheapest of the template that was tried least."""
        every, weights = self._settings.diverse_every, self._settings.price
        if len(self._tried) % every == every - 1:
            promising = [p for p in open_ if p.score < self._settings.reaches] or list(open_)
            least = min(self._by_family[p.family] for p in promising)
            return min((p for p in promising if self._by_family[p.family] == least), key=self._price_now)
        return min(open_, key=lambda p: self._price_now(p) + weights.tried * self._by_family[p.family])

    def _cheapest(self, pool: Sequence[Proposal]) -> Proposal:
        return min(pool, key=self.price)

    def _price_now(self, p: Proposal) -> float:
        """The price, with what the analyzer's order adds and what it costs to try the same motion again."""
        weights = self._settings.price
        again = weights.same_motion * self._same(p)
        return self.price(p) + weights.rank * self._ranks.get((p.bv, p.label), len(self._ranks)) + again

    def _take(self, chosen: Proposal) -> Proposal:
        self.pool.remove(chosen)
        self._tried.append(chosen)
        self._by_family[chosen.family] += 1
        self._by_planner[chosen.planner] += 1
        self._by_motion[_motion(chosen)] += 1
        return chosen

    def _split(self) -> tuple[list[Proposal], list[Proposal]]:
        """The candidates that may still be tried, and those of planners without attempts left."""
        over = self._used_up()
        open_ = [p for p in self.pool if self._share_of(p.planner) not in over]
        return open_, [p for p in self.pool if self._share_of(p.planner) in over]

    def _used_up(self) -> set[str]:
        """Shares of attempts that are used up."""
        tries = Counter[str]()
        for planner, count in self._by_planner.items():
            tries[self._share_of(planner)] += count
        return {share for share, count in tries.items() if count >= self._settings.share}

    def _share_of(self, planner: Planner) -> str:
        """The name of the share of attempts that a planner counts towards."""
        return planner.hash if planner.hash in self._added else f"{planner.label}/{planner.mode}"

    def _same(self, p: Proposal) -> int:
        """The number of attempts that were predicted to move like a candidate."""
        motion = _motion(p)
        return 0 if motion is None else self._by_motion[motion]

    # -- predicting ---------------------------------------------------------------------------------------------

    def _scored(self, proposals: Sequence[Proposal]) -> list[Proposal]:
        """All predicted together, which takes less time than one by one."""
        return self._correction.corrected(self._scorer.score(proposals)) if proposals else []

    def _wanted(self, pool: Sequence[Proposal], tried: int = 0) -> int:
        """The number of candidates to draw at most: more where no brake avoids a contact, most where nothing does."""
        settings, sampling = self._settings, self._settings.sampling
        best = min((p.score for p in pool), default=settings.reaches)
        if best < settings.price.braked:
            return 0
        if best < settings.avoidable:
            return settings.proposals + sampling.for_brakes
        return sampling.most + sampling.for_each_attempt * tried

    def _made_robust(
        self, pool: Sequence[Proposal], choose: Callable[[Sequence[Proposal]], Proposal], at_once: int
    ) -> list[Proposal]:
        """The pool in which the chosen candidate is robust: it and the best others are weighed with neighbours, a few
        rounds at most."""
        settings, selected = self._settings, list(pool)
        for _ in range(settings.robustness.rounds if selected else 0):
            first = choose(selected)
            if is_robust(first) or first.score >= settings.avoidable:
                break
            loose = [p for p in selected if p is not first and not is_robust(p) and p.score < settings.avoidable]
            best = [first, *sorted(loose, key=self.price)[: at_once - 1]]
            taken = {id(p) for p in best}
            weighed = weighed_with_neighbours(best, self._scored, self._sampler.random, settings.robustness)
            selected = weighed + [p for p in selected if id(p) not in taken]  # of equals a robust one comes first
        return selected

    def _predicted_again(self, tried: Proposal, motion: ObservedMotion) -> list[Proposal]:
        """The pool after an attempt: the best candidates are predicted again if another driver model is believed."""
        selected = list(self.pool)
        if not self._scorer.observe(tried, motion):
            return selected
        rows = sorted((k for k, p in enumerate(selected) if p.by != "memory"), key=lambda k: self.price(selected[k]))
        rows = rows[: self._settings.correction.repeated]
        scored = self._correction.corrected(self._scorer.score([selected[k].unscored() for k in rows]))
        for k, again in zip(rows, scored, strict=True):
            selected[k] = replace(again, is_neighbour=selected[k].is_neighbour)
        return selected


def _motion(p: Proposal) -> PredictedMotion | None:
    """Numbers that tell predicted motions of a vehicle apart: parameters that only matter after the contact change
    nothing. None where no motion was predicted."""
    seen = p.prediction
    if seen is None or seen.failure:
        return None
    traces = (seen.time, seen.gap, seen.min_ttc, seen.warning, seen.braking)
    return (p.bv, p.delay, *(round(trace, 2) for trace in traces))
