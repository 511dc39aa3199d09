"""The search for an attack: a pool of predicted candidates, from which the next ones to try are proposed.

``AttackSearch`` draws candidates (``sampling``), has them predicted and scored (``prediction``), and draws more while
none is good. ``propose`` takes the candidate with the lowest price, as long as one promises a higher level than the
attempts so far have reached. The price is the score plus what ``settings.PriceSettings`` adds. After a few such
candidates, the search varies the best attempts (``evolution``). Without a language model, the search also takes the
analyzer's role (``ranking``).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from random import Random

from sumo_adv.asked import Attacker
from sumo_adv.datatypes import AS_FOUND, Duty, Intent, Level, LibraryEntry, ObservedMotion, Planner, Proposal, Verdict
from sumo_adv.goal import Goal
from sumo_adv.memory.records import Composition
from sumo_adv.search.evolution import Evolution
from sumo_adv.search.intents import Selection, compose, composed
from sumo_adv.search.ranking import ranked_intents, unpredicted_intents
from sumo_adv.search.sampling import AttackTemplate, Sampler, Scorer, elites, kind_of, templates_of
from sumo_adv.search.settings import SearchSettings
from sumo_adv.search.supports import Cast, Supports, observed_escape
from sumo_adv.situation import Situation


class AttackSearch:
    """The candidates of one encounter.

    Attributes:
        pool: All candidates that were predicted and not tried yet.
    """

    def __init__(
        self, scorer: Scorer, situations: Mapping[float, Situation], library: Sequence[LibraryEntry],
        settings: SearchSettings, *, seed: int, goal: Goal | None = None, selection: Selection | None = None,
        recalled: Proposal | None = None, adversaries: int = 1, colliders: Collection[str] = (),
        compositions: Sequence[Composition] = (), attackers: Sequence[Attacker] = (), predicts: bool = True,
    ) -> None:  # fmt: skip
        """Predict the first candidates.

        Args:
            scorer: Predicts and scores candidates.
            situations: The situations by delay after the trigger [s].
            library: The intents to draw from.
            settings: All weights of the search.
            seed: The seed of the random generators.
            goal: What an attack is meant to achieve; a serious collision by default.
            selection: The intents that may be tried; all by default.
            recalled: A candidate that succeeded in a similar scene. It is tried first, and nothing is predicted until
                it has failed.
            adversaries: The maximum number of adversaries of a candidate.
            colliders: The vehicles that may be the collider; empty allows all.
            compositions: Composed intents that the bank knows.
            attackers: The vehicles that attack together in each candidate; empty for one collider.
            predicts: Whether candidates are predicted. If not, the search learns from attempts only.
        """
        self._scorer, self._situations, self._settings = scorer, dict(situations), settings
        self._goal, self._best = goal or Goal(), Level.NONE
        self._level = max(self._goal.level, Level.VALID)
        self._selection = selection or Selection()
        self._sampler = Sampler(settings.sampling, seed)
        self._ranks: Mapping[tuple[str, str], int] = {}
        self._tried: list[Proposal] = []
        self._by_family: Counter[tuple[str, str, str]] = Counter()
        self._by_planner: Counter[Planner] = Counter()
        self._kinds: set[str] = set()  # kinds of the successes so far, if more than one kind is wanted
        self._added: set[str] = set()  # hashes of planners with a share of attempts of their own
        self._templates: list[AttackTemplate] = []
        supports = Supports(self._situations, Random(seed), adversaries, compositions, library, attackers)
        self._support = supports if adversaries > 1 else None
        self._supports_predicted = False
        self._colliders = frozenset(colliders)
        self._redrawn = 0  # number of candidates drawn, including those of the first analysis
        self._predicts, self._seed = predicts, seed
        self._evolution = self._new_evolution()
        self._pairs: frozenset[tuple[str, str]] = frozenset()  # may be tried; empty allows all
        self.pool: list[Proposal] = []
        if recalled is not None:
            self.pool = [recalled]
            self._evolution.add([] if predicts else [recalled])
        else:
            self.extend([e for e in library if not composed(e) or self._selection.names(e.label)])

    def __bool__(self) -> bool:
        """Return whether any candidate is left."""
        return bool(self.pool or self._evolution)

    # -- the pool -----------------------------------------------------------------------------------------------

    @property
    def reaches(self) -> bool:
        """Whether a candidate is predicted to reach the ego in a way that counts.

        Also true if candidates are left and nothing is predicted.
        """
        return (bool(self) and not self._predicts) or any(p.score < self._settings.reaches for p in self.pool)

    def extend(self, library: Sequence[LibraryEntry]) -> None:
        """Predict candidates for library entries that are not in the pool yet; draw more while none is good.

        Args:
            library: The intents to draw from.
        """
        count = self._settings.proposals
        templates = self._templates_of(library, [e.label for e in self._selection.of(library)])
        self._evolution.draw_from(templates)
        if not self._predicts:
            return
        present = {(p.delay, p.bv, p.label, p.planner.hash) for p in self.pool}
        fresh = [t for t in templates if t.key not in present]
        self.pool += self._scorer.score(self._sampler.first(fresh, count // 2 if self.pool else count))
        while templates and len(self.pool) < self._wanted(self.pool):
            self.pool += self._scorer.score(self._sampler.more(templates, elites(sorted(self.pool, key=self.price))))

    def ranking(self, library: Sequence[LibraryEntry]) -> list[Intent]:
        """Rank the intents of the pool, most dangerous first.

        If few candidates are avoidable, intents that the library lacks are composed. They come after the intents that
        reach the ego and before those that do not. They have no predictions yet.

        Args:
            library: The intents of the bank, for their descriptions.
        """
        descriptions = {e.label: e.description for e in library}
        if not self._predicts:
            return unpredicted_intents(self._evolution.templates) + self._composed(library)
        reaching, rest = ranked_intents(self.pool, descriptions, self.price, self._settings, self._goal)
        good = sum(p.score < self._settings.avoidable for p in self.pool)
        new = [] if good >= self._settings.few else self._composed(library)
        return reaching + new + rest

    def _composed(self, library: Sequence[LibraryEntry]) -> list[Intent]:
        """Compose intents that the library lacks and that may be tried."""
        return [i for i in compose(self._situations, library) if self._selection.allows(i.label)]

    def price(self, p: Proposal) -> float:
        """Return the price of a candidate: its score plus penalties for a late contact, much braking and supports.

        Args:
            p: The candidate.
        """
        weights, seen = self._settings.price, p.prediction
        if seen is None:
            return p.score
        supports = self._settings.evolution.support * len(p.supports)
        return p.score + weights.late * seen.time + weights.harsh * seen.braking + supports

    # -- attempts -----------------------------------------------------------------------------------------------

    def follow(
        self, intents: Sequence[Intent], library: Sequence[LibraryEntry], *, in_their_order: bool = False
    ) -> list[AttackTemplate]:
        """Draw from these intents from now on.

        Args:
            intents: The intents that the analyzer chose, best first.
            library: The intents to draw from.
            in_their_order: Whether to draw from the whole library, at a price that grows with the place in ``intents``.
                Intents that are not in ``intents`` come last.

        Returns:
            The templates that are drawn from.
        """
        open_ = [e.label for e in self._selection.of(library)]
        together = self._support is not None and bool(self._support.attackers.names)  # each has intents of its own
        drawn_from = open_ if in_their_order or together else [i.label for i in intents]
        self._templates = self._templates_of(library, drawn_from)
        self._ranks = {}
        for i in intents if in_their_order else ():
            self._ranks.setdefault((i.bv, i.label), len(self._ranks))
        self._redrawn = len(self.pool)
        self._evolution.draw_from(self._templates)
        if self._support is not None:
            self._evolution.add(self._support.known(self._templates))
        return list(self._templates)

    def confine(
        self, pairs: Collection[tuple[str, str]], library: Sequence[LibraryEntry], attackers: Sequence[Attacker] = ()
    ) -> None:  # fmt: skip
        """Try only these vehicles with these intents from now on.

        Args:
            pairs: The ids of vehicles and the labels of intents.
            library: The intents to draw from.
            attackers: The vehicles that attack together in each candidate; empty for one collider. Their candidates are
                not predicted, because a prediction knows one collider.
        """
        self._pairs = frozenset(pairs)
        if attackers and self._support is not None:
            self._support.let_attack(attackers)
            self._predicts = False
        self.pool = [p for p in self.pool if self._predicts and (p.bv, p.label) in self._pairs]
        self._evolution = self._new_evolution()
        self._evolution.draw_from(self._templates_of(library, [e.label for e in self._selection.of(library)]))

    def add_chosen(self, chosen: Sequence[Proposal]) -> None:
        """Add candidates that a language model chose, and predict them with variations of their parameters.

        Args:
            chosen: The candidates.
        """
        if not self._predicts:
            self._evolution.add(chosen)
            return
        variations = self._sampler.variations(chosen, self._settings.sampling.around_chosen * len(chosen))
        self.pool += self._scorer.score([*chosen, *variations])

    def completed(self, p: Proposal) -> Proposal:
        """Return a candidate with all attackers of the scene; the same one if it has them.

        Args:
            p: The candidate.
        """
        return p if self._support is None else self._support.completed(p)

    def add_casts(self, casts: Sequence[Cast], by: str) -> None:
        """Add candidates of compositions that an analyzer proposes; do nothing if only one adversary is allowed.

        Args:
            casts: The compositions, with their vehicles.
            by: The name of the analyzer.
        """
        if self._support is None:
            return
        made = self._support.proposed(casts, by, self._evolution.templates)
        if self._predicts:
            self.pool += self._scorer.score(made)
        else:
            self._evolution.add(made)

    def begin_anew(self, chosen: Sequence[Proposal]) -> None:
        """Forget the attempts so far, because the driver has changed, and try these candidates first.

        Args:
            chosen: The candidates.
        """
        self._tried, self._best = [], Level.NONE
        self._by_family.clear()
        self._by_planner.clear()
        self._evolution = self._new_evolution(self._sampler)
        self._evolution.draw_from(self._templates)
        self._evolution.add(chosen)

    def propose(self, budget: int) -> list[Proposal]:
        """Return the next candidates to try, and remove them from the pool.

        Args:
            budget: The maximum number of candidates.

        Returns:
            The candidates, fewer than ``budget`` if nothing is left.
        """
        selected = list[Proposal]()
        while len(selected) < budget and (proposal := self._predicted_or_drawn()) is not None:
            selected.append(proposal)
        return selected

    def _predicted_or_drawn(self) -> Proposal | None:
        """Return a candidate with a promising prediction if there is one, otherwise one from the evolution."""
        if self._predicts and len(self._tried) < self._settings.predicted and (best := self._next()) is not None:
            return best
        over = self._used_up()
        shares = {f"{t.entry.label}/{t.planner.mode}" for t in self._evolution.templates} - over
        drawn_now = self._evolution.propose(shares if over else None)
        return None if drawn_now is None else self._count(drawn_now)

    def take_best(self, bv: str, label: str) -> Proposal | None:
        """Return the best candidate of an intent, and remove it from the pool.

        Args:
            bv: The id of the vehicle.
            label: The label of the intent.

        Returns:
            The candidate, or None if there is none.
        """
        if not self._predicts:
            own = [t for t in self._evolution.templates if (t.target.state.id, t.entry.label) == (bv, label)]
            return self._count(own[0].proposal(None)) if own else None
        pool = [p for p in self.pool if (p.bv, p.label) == (bv, label)]
        return self._take(min(pool, key=lambda p: p.score)) if pool else None

    def observe(self, tried: Proposal, motion: ObservedMotion | None, verdict: Verdict) -> None:
        """Learn from an attempt.

        Args:
            tried: The candidate that was attempted.
            motion: How the ego moved in the attempt; None if it did not move.
            verdict: The verdict on the attempt.
        """
        if tried.arrival != AS_FOUND:
            self._evolution.observe(tried, verdict, "")
            return
        reached = self._goal.reached(verdict)
        if not self._kinds or reached < self._level:  # the kind of a success is no longer searched for
            self._best = max(self._best, reached)
        escape: tuple[Duty, ...] = ()
        if "third_party" in verdict.failed_gates:
            escape = (Duty.OPEN,)
        elif motion is not None:
            escape = observed_escape(self._situations[tried.delay], motion)
        self._evolution.observe(tried, verdict, self._kind_of(tried, verdict.contact_side), escape)

    def succeeded(self, kind: str) -> None:
        """Search for an attack of another kind from now on.

        Args:
            kind: The kind that succeeded (``sampling.kind_of``).
        """
        self._kinds.add(kind)
        self._evolution.close({kind})
        self._best = Level.NONE

    @property
    def result(self) -> str:
        """What the search has achieved, in a sentence."""
        count, wish = len(self.pool) + len(self._tried), self._goal.attack(self._level)
        if self._kinds:
            kinds = "one kind" if len(self._kinds) == 1 else f"{len(self._kinds)} kinds"
            return f"Attacks of {kinds} succeeded; {count} candidates promise no {wish} of another kind."
        best = "" if self._goal.ttc is not None else f"; the best level is {self._best}"
        return f"No {wish} found in {count} candidates{best}."

    def exhausted(self) -> list[str]:
        """Return the planners without attempts left.

        Returns:
            Their hashes. Of versions with a common share of attempts, only the most tried one.
        """
        over, most = self._used_up(), dict[str, str]()
        for planner, _ in self._by_planner.most_common():
            if self._share_of(planner) in over:
                most.setdefault(self._share_of(planner), planner.hash)
        return list(most.values())

    def add_version(self, planner: Planner) -> None:
        """Add a changed planner for every vehicle and start of its mode; it gets its own share of attempts.

        Args:
            planner: The changed planner.
        """
        same = {
            (t.delay, t.target.state.id): t for t in self._templates
            if (t.planner.label, t.planner.mode) == (planner.label, planner.mode)
        }  # fmt: skip
        fresh = [AttackTemplate(t.delay, t.target, t.entry, planner) for t in same.values()]
        self._templates += fresh
        self._added.add(planner.hash)
        if self._predicts:
            self.pool += self._scorer.score(self._sampler.each(fresh, 3 * len(fresh)))
        else:
            self._evolution.add(self._sampler.each(fresh, len(fresh)))

    # -- choosing -----------------------------------------------------------------------------------------------

    def _next(self) -> Proposal | None:
        """Take the best open candidate; first draw more candidates, and then supports, if none is good enough."""
        open_, avoidable = self._open(), self._settings.avoidable
        while self._redrawn < self._wanted(open_):
            over = self._used_up()
            templates = [t for t in self._templates if self._share_of(t.planner) not in over]
            if not templates:
                break
            fresh = self._scorer.score(self._sampler.more(templates, elites(sorted(self.pool, key=self._price_now))))
            self._redrawn += len(fresh)
            self.pool += fresh
            open_ = self._open()
        if self._support is not None and not self._supports_predicted and not any(p.score < avoidable for p in open_):
            self._supports_predicted = True
            self.pool += self._scorer.score(self._with_supports(self._support))
            open_ = self._open()
        if not open_:
            return None
        weight = self._settings.price.tried
        return self._take(min(open_, key=lambda p: self._price_now(p) + weight * self._by_family[p.family]))

    def _with_supports(self, support: Supports) -> list[Proposal]:
        """Return known compositions, and the best candidates with one support each."""
        settings = self._settings.sampling
        best = elites(sorted(self.pool, key=self.price))[: settings.nearest]
        alone = [p for p in best for _ in range(settings.supported)]
        return support.known(self._templates) + [q for p in alone if (q := support.changed(p, ())) is not p]

    def _open(self) -> list[Proposal]:
        """Return the candidates that promise more than attempts have reached, or all before the first attempt."""
        if not self._tried:  # the first attempt is informative in any case
            return list(self.pool)
        over, bound = self._used_up(), self._settings.bound(self._best)
        promising = [p for p in self.pool if p.score < bound and self._is_worth(p)]
        return [p for p in promising if self._share_of(p.planner) not in over]

    def _is_worth(self, p: Proposal) -> bool:
        """Return whether neither its prediction nor its kind rules a candidate out."""
        seen = p.prediction
        if p.by == "memory" or seen is None:
            return True
        return not seen.hopeless and self._kind_of(p, seen.side) not in self._kinds

    def _kind_of(self, p: Proposal, side: str | None) -> str:
        """Return the kind of attack of a candidate that hits this side of the ego."""
        return kind_of(p.label, self._situations[p.delay].targets[p.bv].relation, side)

    def _price_now(self, p: Proposal) -> float:
        """Return the price plus the penalty for the place in the analyzer's order."""
        ranks = self._ranks.get((p.bv, p.label), len(self._ranks))
        return self.price(p) + self._settings.price.rank * ranks

    def _take(self, chosen: Proposal) -> Proposal:
        """Remove a candidate from the pool and count it."""
        self.pool.remove(chosen)
        return self._count(chosen)

    def _count(self, chosen: Proposal) -> Proposal:
        """Count a candidate as tried."""
        self._tried.append(chosen)
        self._by_family[chosen.family] += 1
        self._by_planner[chosen.planner] += 1
        return chosen

    def _used_up(self) -> set[str]:
        """Return the shares of attempts that are used up."""
        tries = Counter[str]()
        for planner, count in self._by_planner.items():
            tries[self._share_of(planner)] += count
        return {share for share, count in tries.items() if count >= self._settings.share}

    def _share_of(self, planner: Planner) -> str:
        """Return the name of the share of attempts that a planner counts towards."""
        return planner.hash if planner.hash in self._added else f"{planner.label}/{planner.mode}"

    def _new_evolution(self, sampler: Sampler | None = None) -> Evolution:
        """Start an evolution without attempts."""
        settings = self._settings
        sampler = sampler or Sampler(settings.sampling, self._seed)
        return Evolution(sampler, self._goal, settings.evolution, self._support)

    def _templates_of(self, library: Sequence[LibraryEntry], allowed: Collection[str]) -> list[AttackTemplate]:
        """Return the templates of vehicles that may be the collider."""
        templates = templates_of(self._situations, library, allowed)
        if self._pairs:
            templates = [t for t in templates if (t.target.state.id, t.entry.label) in self._pairs]
        templates = [t for t in templates if not self._colliders or t.target.state.id in self._colliders]
        return templates if self._support is None else self._support.attackers.usable(templates)

    # -- predicting ---------------------------------------------------------------------------------------------

    def _wanted(self, pool: Sequence[Proposal]) -> int:
        """Return the maximum number of candidates to draw: 0 if one reaches the goal with a margin."""
        settings = self._settings
        best, bound = min((p.score for p in pool), default=math.inf), settings.bound(Level(self._level - 1))
        return 0 if best < bound - settings.spare else settings.proposals + settings.sampling.more
