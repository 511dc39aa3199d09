"""Supports for colliders that nearly succeed.

Where no candidate with one adversary promises a valid collision, the colliders that come nearest get a support against
the escape that saves the ego: brake, swerve left, swerve right, or a third party in the collider's way. The candidates
that still miss may get another one. Compositions that the bank or the expert knows are tried in the same way.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from random import Random

from sumo_adv.datatypes import Duty, LibraryEntry, ObservedMotion, Proposal
from sumo_adv.memory.records import Composition
from sumo_adv.road_users import is_unprotected
from sumo_adv.search.composed_attacks import ANY, EXPERT_COMPOSITIONS, Cast, named
from sumo_adv.search.escapes import observed_escape
from sumo_adv.search.protocols import Scorer
from sumo_adv.search.sampling import varied
from sumo_adv.search.settings import SupportSettings
from sumo_adv.search.support_intents import SUPPORT_INTENTS, fits
from sumo_adv.search.templates import AttackTemplate
from sumo_adv.situation import MEET_AHEAD, Situation

MOST_OF_A_FAMILY = 2  # bases of one vehicle, intent and mode


class SupportSearch:
    """Adds supports in one encounter; ``most``: adversaries of a candidate."""

    def __init__(
        self, scorer: Scorer, situations: Mapping[float, Situation], random: Random, settings: SupportSettings,
        most: int, known: Sequence[Composition] = (), library: Sequence[LibraryEntry] = (),
    ) -> None:  # fmt: skip
        """known: compositions that are tried whatever the escape, as the expert's are; library: intents that their
        parts may name."""
        self._compositions, self._library = (*known, *EXPERT_COMPOSITIONS), library
        self._scorer, self._situations, self._random, self._settings = scorer, situations, random, settings
        self._most, self._rounds = most, 0
        self._proposed: tuple[Composition, ...] = ()  # by the analyzer
        self._failures = 0  # attempts since the last round
        self._failed: list[tuple[Proposal, tuple[Duty, ...]]] = []

    def observe(self, tried: Proposal, motion: ObservedMotion) -> None:
        """Take note of an attempt that failed, and of how the ego escaped in it."""
        if len(tried.supports) < self._most - 1:
            self._failed.append((tried, observed_escape(self._situations[tried.delay], motion)))
        self._failures += 1

    @property
    def due(self) -> bool:
        """Whether enough attempts have failed since the last round."""
        return self._most > 1 and self._failures >= self._settings.after

    def candidates(self, pool: Sequence[Proposal], price: Callable[[Proposal], float]) -> list[Proposal]:
        """Predicted candidates with supports that come nearer to a collision than their colliders alone; none if only
        one adversary is allowed, or if no attempt has failed since the last round."""
        settings = self._settings
        if self._most < 2 or self._rounds >= settings.rounds or (self._rounds > 0 and not self._failures):
            return []
        self._failures, self._rounds = 0, self._rounds + 1
        failed = sorted(self._failed, key=lambda each: price(each[0]))[: settings.tried]
        self._failed = []
        alone = nearly_succeeding((p for p in pool if not p.supports), price, settings.bases - len(failed))
        bases = [*failed, *zip(alone, self._scorer.escapes(alone) if alone else (), strict=True)]
        candidates = self._predicted(bases)
        if self._rounds == 1:
            candidates += self._scored(self._carried_out([Cast(c) for c in self._compositions], pool, price))
        if self._most > 2:
            missing = nearly_succeeding(candidates, price, settings.again)
            candidates += self._predicted(zip(missing, self._scorer.escapes(missing) if missing else (), strict=True))
        return candidates

    def _predicted(self, bases: Iterable[tuple[Proposal, tuple[Duty, ...]]]) -> list[Proposal]:
        """The candidates of these bases with one support more that are predicted to fail no gate."""
        return self._scored(supported(bases, self._situations, self._random, self._settings, self._label))

    def proposed(
        self, casts: Sequence[Cast], by: str, pool: Sequence[Proposal], price: Callable[[Proposal], float]
    ) -> list[Proposal]:
        """Predicted candidates of compositions that an analyzer (``by``: its name) proposes; from now on supports that
        make one of them up have its label."""
        self._proposed = tuple(cast.composition for cast in casts)
        return self._scored([replace(p, by=by) for p in self._carried_out(casts, pool, price)])

    def _carried_out(
        self, casts: Sequence[Cast], pool: Sequence[Proposal], price: Callable[[Proposal], float]
    ) -> list[Proposal]:
        """Candidates of compositions, each with the best colliders of its intent and mode; without predictions."""
        drawn = list[Proposal]()
        alone = sorted((p for p in pool if not p.supports and p.prediction is not None), key=price)
        for cast in (c for c in casts if len(c.composition.parts) <= self._most):
            first = cast.composition.parts[0]
            fitting = [p for p in alone if p.label == first.intent and first.mode in (ANY, p.planner.mode)]
            fitting = [p for p in fitting if cast.vehicle(0) in (ANY, p.bv)]
            for base in fitting[:MOST_OF_A_FAMILY]:
                situation = self._situations[base.delay]
                drawn += carried_out(cast, base, situation, self._library, self._random, self._settings, self._label)
        return drawn

    def _label(self, collider: Proposal, supports: Sequence[Proposal]) -> str:
        return named(collider, supports, (*self._compositions, *self._proposed))

    def _scored(self, drawn: Sequence[Proposal]) -> list[Proposal]:
        """The candidates with predictions, without those that fail a gate."""
        scored = self._scorer.score(drawn) if drawn else []
        return [p for p in scored if p.prediction is not None and not p.prediction.hopeless]


def nearly_succeeding(pool: Iterable[Proposal], price: Callable[[Proposal], float], most: int) -> list[Proposal]:
    """The best colliders that miss or have a third party in their way, at most ``most``; of a family at most
    ``MOST_OF_A_FAMILY`` of each."""
    count = Counter[tuple[tuple[str, str, str], bool]]()
    selected = list[Proposal]()
    for p in sorted(pool, key=price):
        seen = p.prediction
        if seen is None or seen.failure or seen.off_road or seen.beyond_limits or (seen.hit and not seen.third_party):
            continue
        count[p.family, seen.third_party] += 1
        if count[p.family, seen.third_party] <= MOST_OF_A_FAMILY and len(selected) < most:
            selected.append(p)
    return selected


def supported(
    bases: Iterable[tuple[Proposal, tuple[Duty, ...]]], situations: Mapping[float, Situation], random: Random,
    settings: SupportSettings, label: Callable[[Proposal, Sequence[Proposal]], str],
) -> list[Proposal]:  # fmt: skip
    """Candidates that give each base one support more, for each of its duties; without predictions. ``label``: what the
    composition of a collider and its supports is called."""
    made = []
    for base, duties in bases:
        targets = situations[base.delay].targets
        if is_unprotected(targets[base.bv].state):  # all of a candidate's adversaries have the same limits
            continue
        others = [t for t in situations[base.delay].target_list() if t.state.id not in base.bvs]
        meets = (
            targets[base.bv].relation in MEET_AHEAD
        )  # only such a collider can be hidden by a vehicle beside the ego
        for duty, target in product((d for d in duties if meets or d is not Duty.HIDE), others):
            for entry in SUPPORT_INTENTS[duty]:
                if fits(duty, entry, target):
                    template = AttackTemplate(base.delay, target, entry, entry.planners[0])
                    made += _drawn(base, template, duty, random, settings, label)
    return made


def _drawn(
    base: Proposal, template: AttackTemplate, duty: Duty, random: Random, settings: SupportSettings,
    label: Callable[[Proposal, Sequence[Proposal]], str],
) -> list[Proposal]:  # fmt: skip
    """Candidates with a support of that template; every other one with other numbers of the base, too."""
    made = []
    for k in range(settings.drawn):
        support = replace(template.proposal(None if k == 0 else random), duty=duty)
        collider = varied(base, random, settings.spread) if k % 2 else replace(base.unscored())
        supports = (*collider.supports, support)
        made.append(replace(collider, supports=supports, composition=label(collider, supports), by="tuner"))
    return made


def carried_out(
    cast: Cast, base: Proposal, situation: Situation, library: Sequence[LibraryEntry], random: Random,
    settings: SupportSettings, label: Callable[[Proposal, Sequence[Proposal]], str],
) -> list[Proposal]:  # fmt: skip
    """Candidates in which vehicles support a base as a composition says; none where a part fits no vehicle, or not the
    vehicle of the cast."""
    made = []
    for _ in range(settings.drawn):
        supports = list[Proposal]()
        for k, part in enumerate(cast.composition.parts[1:], start=1):
            used = (base.bv, *(p.bv for p in supports))
            templates = [
                AttackTemplate(base.delay, target, entry, planner)
                for target in situation.target_list()
                if target.state.id not in used and cast.vehicle(k) in (ANY, target.state.id)
                for entry in (*SUPPORT_INTENTS[part.duty], *library) if entry.label == part.intent
                for planner in entry.planners if part.mode in (ANY, planner.mode) and fits(part.duty, entry, target)
            ]  # fmt: skip
            if not templates:
                return []
            supports.append(replace(random.choice(templates).proposal(random), duty=part.duty))
        collider = varied(base, random, settings.spread)
        made.append(replace(collider, supports=tuple(supports), composition=label(collider, supports)))
    return made
