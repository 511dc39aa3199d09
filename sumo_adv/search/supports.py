"""Supports for colliders that nearly succeed.

Where no candidate with one adversary promises a valid collision, the colliders that come nearest get a support against
the escape that saves the ego: brake, swerve left, swerve right, or a third party in the collider's way. The candidates
that still miss may get another one. Compositions that the bank or the expert knows are tried in the same way.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from random import Random

import numpy as np

from sumo_adv.datatypes import Duty, LibraryEntry, ObservedMotion, Proposal
from sumo_adv.memory.records import Composition, Part
from sumo_adv.road_users import is_unprotected
from sumo_adv.search.rollouts import Rollouts
from sumo_adv.search.sampling import AttackTemplate, Scorer, varied
from sumo_adv.search.settings import SupportSettings
from sumo_adv.search.support_intents import SUPPORT_INTENTS, fits
from sumo_adv.situation import MEET_AHEAD, Situation

# -- how an ego escapes ---------------------------------------------------------------------------------------------

ASIDE = 0.4  # m from its path, from which on the ego has swerved
BEHIND = 5.0  # m from centre to centre along the ego's path, from which on a vehicle is behind it
SLOWER = 0.5  # m/s below its unattacked speed, from which on it has braked


def against(offset: float, speed: float, unattacked: float) -> tuple[Duty, ...]:
    """What a support has to do against an escape: an offset from the ego's path [m, left positive], and a speed
    compared with the unattacked one [m/s]."""
    if offset > ASIDE:
        return (Duty.BLOCK_LEFT,)
    if offset < -ASIDE:
        return (Duty.BLOCK_RIGHT,)
    return (Duty.SLOW, Duty.HIDE) if speed < unattacked - SLOWER else ()


def predicted_escapes(
    situations: Mapping[float, Situation], proposals: Sequence[Proposal], rollouts: Rollouts
) -> list[tuple[Duty, ...]]:
    """What supports have to do so that each candidate succeeds, by its rollout.

    Where a third party is in the collider's way, it is to make room. Where the ego does not react and the collider
    stays behind it, a support has to hold the ego up; there is nothing to do where the collider does not stay behind.
    """
    x, y, _, v = rollouts.ego
    steps = np.hypot(x - rollouts.adversary[0], y - rollouts.adversary[1]).argmin(axis=1).tolist()
    duties = list[tuple[Duty, ...]]()
    for row, (p, k) in enumerate(zip(proposals, steps, strict=True)):
        if p.prediction is not None and p.prediction.third_party:
            duties.append((Duty.OPEN,))
            continue
        baseline = situations[p.delay].baseline
        station, offset = baseline.path.project(float(x[row, k]), float(y[row, k]))
        escape = against(offset, float(v[row, k]), float(baseline.v[min(k, len(baseline.v) - 1)]))
        behind, _ = baseline.path.project(*(float(q[row, k]) for q in rollouts.adversary[:2]))
        duties.append(escape or ((Duty.SLOW,) if behind < station - BEHIND else ()))
    return duties


def observed_escape(situation: Situation, motion: ObservedMotion) -> tuple[Duty, ...]:
    """The same for an attempt, by the ego's motion in it: its widest swerve, else its hardest braking."""
    seen = slice(0, max(motion.seen, 1))
    offset = motion.d[seen]
    widest = float(offset[np.abs(offset).argmax()])
    baseline = situation.baseline.v
    count = min(len(motion.v[seen]), len(baseline))
    slower = int((motion.v[:count] - baseline[:count]).argmin())
    return against(widest, float(motion.v[slower]), float(baseline[slower]))


# -- compositions ---------------------------------------------------------------------------------------------------

ANY = ""  # of a part: any mode of the intent; of a cast: any vehicle that fits


@dataclass(frozen=True, slots=True)
class Cast:
    """A composition with its vehicles. ``vehicles``: by part the id of the vehicle that carries it out, or ``ANY``;
    empty if any may."""

    composition: Composition
    vehicles: tuple[str, ...] = ()

    def vehicle(self, part: int) -> str:
        """The vehicle of a part, the collider's being 0."""
        return self.vehicles[part] if self.vehicles else ANY


def _of(label: str, description: str, collider: str, *supports: tuple[Duty, str]) -> Composition:
    parts = (Part(Duty.COLLIDER, collider, ANY), *(Part(duty, intent, ANY) for duty, intent in supports))
    return Composition(label, description, parts)


CUT_IN, BRAKING = "Aggressive Cut-in", "Emergency Braking"
EXPERT_COMPOSITIONS: tuple[Composition, ...] = (
    _of(
        "Box-in",
        "The leader slows down, a vehicle on the left closes the gap beside the ego, and another one cuts in from the "
        "right.",
        CUT_IN, (Duty.SLOW, "Slow Leader"), (Duty.BLOCK_LEFT, "Escape Block Left"),
    ),
    _of(
        "Squeezed Cut-in",
        "A vehicle cuts in from the right while another one keeps beside the ego on the left, so that the ego cannot "
        "make room.",
        CUT_IN, (Duty.BLOCK_LEFT, "Escape Block Left"),
    ),
    _of(
        "Blocked Escape",
        "The leader brakes hard just when an oncoming vehicle passes, so that the ego cannot swerve to the left.",
        BRAKING, (Duty.BLOCK_LEFT, "Oncoming Block Left"),
    ),
    _of(
        "Hidden Crossing",
        "A vehicle crosses the junction without giving way, hidden from the ego by a vehicle beside it.",
        "Intersection Rush-through Go-straight", (Duty.HIDE, "View Screen"),
    ),
    _of(
        "Opened Gap",
        "A vehicle of a platoon beside the ego opens a gap, and another one cuts in through it.",
        CUT_IN, (Duty.OPEN, "Gap Opening"),
    ),
)  # fmt: skip
"""Compositions of intents of the shipped memory bank and of supports."""


def named(collider: Proposal, supports: Sequence[Proposal], known: Iterable[Composition]) -> str:
    """The label of the composition that has these parts, in any order of the supports; without one the labels of the
    parts, the collider's first."""
    parts = sorted((p.duty, p.label) for p in (collider, *supports))
    same = (c for c in known if sorted((part.duty, part.intent) for part in c.parts) == parts)
    composition = next(same, None)
    return composition.label if composition is not None else " + ".join([collider.label, *(p.label for p in supports)])


def description_of(p: Proposal, library: Sequence[LibraryEntry], proposed: Iterable[Cast] = ()) -> str:
    """The description of a candidate's composition: that of the expert or of a proposed one, or made of those of its
    parts."""
    compositions = (*EXPERT_COMPOSITIONS, *(cast.composition for cast in proposed))
    own = next((c.description for c in compositions if c.label == p.composition), None)
    entries = (*library, *(entry for those in SUPPORT_INTENTS.values() for entry in those))
    words = {entry.label: entry.description for entry in entries}
    return own or " ".join(words.get(q.label, q.label) for q in p.members)


# -- the search for supports ----------------------------------------------------------------------------------------

MOST_OF_A_FAMILY = 2  # bases of one vehicle, intent and mode
Base = tuple[Proposal, tuple[Duty, ...]]
"""A collider, and what supports have to do against the escape from it."""
Price = Callable[[Proposal], float]


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
        self._failed: list[Base] = []

    def observe(self, tried: Proposal, motion: ObservedMotion) -> None:
        """Take note of an attempt that failed, and of how the ego escaped in it."""
        if len(tried.supports) < self._most - 1:
            self._failed.append((tried, observed_escape(self._situations[tried.delay], motion)))
        self._failures += 1

    @property
    def due(self) -> bool:
        """Whether enough attempts have failed since the last round."""
        return self._most > 1 and self._failures >= self._settings.after

    def candidates(self, pool: Sequence[Proposal], price: Price) -> list[Proposal]:
        """Predicted candidates with supports that come nearer to a collision than their colliders alone; none if only
        one adversary is allowed, or if no attempt has failed since the last round."""
        settings = self._settings
        if self._most < 2 or self._rounds >= settings.rounds or (self._rounds > 0 and not self._failures):
            return []
        self._failures, self._rounds = 0, self._rounds + 1
        failed = sorted(self._failed, key=lambda each: price(each[0]))[: settings.tried]
        self._failed = []
        alone = nearly_succeeding((p for p in pool if not p.supports), price, settings.bases - len(failed))
        candidates = self._scored(self._supported([*failed, *self._escaping(alone)]))
        if self._rounds == 1:
            candidates += self._scored(self._carried_out([Cast(c) for c in self._compositions], pool, price))
        if self._most > 2:
            missing = nearly_succeeding(candidates, price, settings.again)
            candidates += self._scored(self._supported(self._escaping(missing)))
        return candidates

    def proposed(self, casts: Sequence[Cast], by: str, pool: Sequence[Proposal], price: Price) -> list[Proposal]:
        """Predicted candidates of compositions that an analyzer (``by``: its name) proposes; from now on supports that
        make one of them up have its label."""
        self._proposed = tuple(cast.composition for cast in casts)
        return self._scored([replace(p, by=by) for p in self._carried_out(casts, pool, price)])

    def _scored(self, drawn: Sequence[Proposal]) -> list[Proposal]:
        """The candidates with predictions, without those that fail a gate."""
        scored = self._scorer.score(drawn) if drawn else []
        return [p for p in scored if p.prediction is not None and not p.prediction.hopeless]

    def _escaping(self, colliders: Sequence[Proposal]) -> list[Base]:
        """Colliders, each with the ego's predicted escape from it that a support must block."""
        return list(zip(colliders, self._scorer.escapes(colliders) if colliders else (), strict=True))

    def _supported(self, bases: Iterable[Base]) -> list[Proposal]:
        """Candidates that give each base one support more, for each of its duties; without predictions."""
        made = []
        for base, duties in bases:
            situation = self._situations[base.delay]
            collider = situation.targets[base.bv]
            if is_unprotected(collider.state):  # all of a candidate's adversaries have the same limits
                continue
            others = [t for t in situation.target_list() if t.state.id not in base.bvs]
            meets = collider.relation in MEET_AHEAD  # only such a one can be hidden by a vehicle beside the ego
            for duty, target in product((d for d in duties if meets or d is not Duty.HIDE), others):
                for entry in SUPPORT_INTENTS[duty]:
                    if fits(duty, entry, target):
                        made += self._drawn(base, AttackTemplate(base.delay, target, entry, entry.planners[0]), duty)
        return made

    def _drawn(self, base: Proposal, template: AttackTemplate, duty: Duty) -> list[Proposal]:
        """Candidates with a support of that template; every other one with other numbers of the base, too."""
        made = []
        for k in range(self._settings.drawn):
            support = replace(template.proposal(None if k == 0 else self._random), duty=duty)
            collider = self._varied(base) if k % 2 else base.unscored()
            made.append(replace(self._together(collider, (*collider.supports, support)), by="tuner"))
        return made

    def _carried_out(self, casts: Sequence[Cast], pool: Sequence[Proposal], price: Price) -> list[Proposal]:
        """Candidates of compositions, each with the best colliders of its intent and mode; without predictions."""
        drawn = list[Proposal]()
        alone = sorted((p for p in pool if not p.supports and p.prediction is not None), key=price)
        for cast in (c for c in casts if len(c.composition.parts) <= self._most):
            first = cast.composition.parts[0]
            fitting = [p for p in alone if p.label == first.intent and first.mode in (ANY, p.planner.mode)]
            fitting = [p for p in fitting if cast.vehicle(0) in (ANY, p.bv)]
            for base in fitting[:MOST_OF_A_FAMILY]:
                drawn += self._cast(cast, base)
        return drawn

    def _cast(self, cast: Cast, base: Proposal) -> list[Proposal]:
        """Candidates in which vehicles support a base as a composition says; none where a part fits no vehicle, or not
        the vehicle of the cast."""
        made = []
        for _ in range(self._settings.drawn):
            supports = list[Proposal]()
            for k, part in enumerate(cast.composition.parts[1:], start=1):
                used = (base.bv, *(p.bv for p in supports))
                templates = [
                    AttackTemplate(base.delay, target, entry, planner)
                    for target in self._situations[base.delay].target_list()
                    if target.state.id not in used and cast.vehicle(k) in (ANY, target.state.id)
                    for entry in (*SUPPORT_INTENTS[part.duty], *self._library) if entry.label == part.intent
                    for planner in entry.planners if part.mode in (ANY, planner.mode) and fits(part.duty, entry, target)
                ]  # fmt: skip
                if not templates:
                    return []
                supports.append(replace(self._random.choice(templates).proposal(self._random), duty=part.duty))
            made.append(self._together(self._varied(base), tuple(supports)))
        return made

    def _varied(self, base: Proposal) -> Proposal:
        return varied(base, self._random, self._settings.spread)

    def _together(self, collider: Proposal, supports: tuple[Proposal, ...]) -> Proposal:
        label = named(collider, supports, (*self._compositions, *self._proposed))
        return replace(collider, supports=supports, composition=label)


def nearly_succeeding(pool: Iterable[Proposal], price: Price, most: int) -> list[Proposal]:
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
