"""Supports: what other vehicles do so that a collider succeeds. Another vehicle may also attack as the collider does.

In an attempt, the ego may escape: it brakes or swerves to the left or right. A third party may also be in the
collider's way. A variation of that attempt may gain a support against this escape, or lose one (``evolution``).
Compositions that the bank, the expert or an analyzer knows are tried as they are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from random import Random

import numpy as np

from sumo_adv.asked import Attacker
from sumo_adv.datatypes import Duty, LibraryEntry, ObservedMotion, Proposal
from sumo_adv.memory.records import Composition, Part
from sumo_adv.road_users import is_unprotected
from sumo_adv.search.attackers import Attackers, attack_of
from sumo_adv.search.sampling import EMERGENCY_BRAKING_LABEL, AttackTemplate
from sumo_adv.search.support_intents import SUPPORT_INTENTS, can_do_duty
from sumo_adv.situation import MEET_AHEAD, Situation

# -- how an ego escapes ---------------------------------------------------------------------------------------------

MIN_SWERVE_M = 0.4  # from its path; an ego farther away has swerved
MIN_SPEED_LOSS_M_S = 0.5  # below its unattacked speed; a slower ego has braked


def duties_against(offset: float, speed: float, unattacked: float) -> tuple[Duty, ...]:
    """Return the duties of a support that counter an escape.

    Args:
        offset: The ego's offset from its path, positive to the left [m].
        speed: The ego's speed [m/s].
        unattacked: Its speed without the attack [m/s].
    """
    if offset > MIN_SWERVE_M:
        return (Duty.BLOCK_LEFT,)
    if offset < -MIN_SWERVE_M:
        return (Duty.BLOCK_RIGHT,)
    return (Duty.SLOW, Duty.HIDE) if speed < unattacked - MIN_SPEED_LOSS_M_S else ()


def observed_escape(situation: Situation, motion: ObservedMotion) -> tuple[Duty, ...]:
    """Return the duties of a support that counter the ego's escape in an attempt.

    The escape is the ego's widest swerve or, if it did not swerve, its hardest braking.

    Args:
        situation: The situation at the start of the attempt.
        motion: The ego's motion in the attempt.
    """
    seen = slice(0, max(motion.seen, 1))
    offset = motion.d[seen]
    widest = float(offset[np.abs(offset).argmax()])
    baseline = situation.baseline.v
    count = min(len(motion.v[seen]), len(baseline))
    slower = int((motion.v[:count] - baseline[:count]).argmin())
    return duties_against(widest, float(motion.v[slower]), float(baseline[slower]))


# -- compositions ---------------------------------------------------------------------------------------------------

ANY_FITTING = ""  # as the mode of a part: any mode of the intent; as a vehicle of a cast: any vehicle that fits


@dataclass(frozen=True, slots=True)
class Cast:
    """A composition with its vehicles.

    Attributes:
        composition: The composition.
        vehicles: The id of the vehicle that carries out each part, or ``ANY_FITTING``; empty allows any vehicles.
    """

    composition: Composition
    vehicles: tuple[str, ...] = ()

    def vehicle(self, part: int) -> str:
        """Return the vehicle of a part.

        Args:
            part: The index of the part; 0 is the collider.
        """
        return self.vehicles[part] if self.vehicles else ANY_FITTING


def _of(label: str, description: str, collider: str, *supports: tuple[Duty, str]) -> Composition:
    """Return a composition whose parts take any mode."""
    parts = (
        Part(Duty.COLLIDER, collider, ANY_FITTING),
        *(Part(duty, intent, ANY_FITTING) for duty, intent in supports),
    )
    return Composition(label, description, parts)


CUT_IN_LABEL = "Aggressive Cut-in"
EXPERT_COMPOSITIONS: tuple[Composition, ...] = (
    _of(
        "Box-in",
        "The leader slows down, a vehicle on the left closes the gap beside the ego, and another one cuts in from the "
        "right.",
        CUT_IN_LABEL, (Duty.SLOW, "Slow Leader"), (Duty.BLOCK_LEFT, "Escape Block Left"),
    ),
    _of(
        "Squeezed Cut-in",
        "A vehicle cuts in from the right while another one keeps beside the ego on the left, so that the ego cannot "
        "make room.",
        CUT_IN_LABEL, (Duty.BLOCK_LEFT, "Escape Block Left"),
    ),
    _of(
        "Blocked Escape",
        "The leader brakes hard just when an oncoming vehicle passes, so that the ego cannot swerve to the left.",
        EMERGENCY_BRAKING_LABEL, (Duty.BLOCK_LEFT, "Oncoming Block Left"),
    ),
    _of(
        "Hidden Crossing",
        "A vehicle crosses the junction without giving way, hidden from the ego by a vehicle beside it.",
        "Intersection Rush-through Go-straight", (Duty.HIDE, "View Screen"),
    ),
    _of(
        "Double Cut-in",
        "Two vehicles cut in, one after the other or at the same time.",
        CUT_IN_LABEL, (Duty.ATTACK, CUT_IN_LABEL),
    ),
    _of(
        "Opened Gap",
        "A vehicle of a platoon beside the ego opens a gap, and another one cuts in through it.",
        CUT_IN_LABEL, (Duty.OPEN, "Gap Opening"),
    ),
)  # fmt: skip
"""Compositions of intents of the shipped memory bank and of supports."""


def composition_label(collider: Proposal, supports: Sequence[Proposal], known: Iterable[Composition]) -> str:
    """Return the label of the composition that has these parts.

    Args:
        collider: The candidate of the collider.
        supports: Those of the supports, in any order.
        known: The compositions to look in.

    Returns:
        The label; without a matching composition the labels of the parts, the collider's first.
    """
    parts = sorted((_side(p.duty), p.label) for p in (collider, *supports))
    same = (c for c in known if sorted((_side(part.duty), part.intent) for part in c.parts) == parts)
    composition = next(same, None)
    return composition.label if composition is not None else " + ".join([collider.label, *(p.label for p in supports)])


def _side(duty: Duty) -> Duty:
    """Return the duty; that of all attackers is the same, whichever of them is the collider."""
    return Duty.ATTACK if duty is Duty.COLLIDER else duty


def description_of(p: Proposal, library: Sequence[LibraryEntry], proposed: Iterable[Cast] = ()) -> str:
    """Describe a candidate's composition.

    Args:
        p: The candidate.
        library: The intents of the bank.
        proposed: Compositions that an analyzer proposed.

    Returns:
        The description of the expert's or a proposed composition; otherwise the descriptions of the parts.
    """
    compositions = (*EXPERT_COMPOSITIONS, *(cast.composition for cast in proposed))
    own = next((c.description for c in compositions if c.label == p.composition), None)
    entries = (*library, *(entry for those in SUPPORT_INTENTS.values() for entry in those))
    words = {entry.label: entry.description for entry in entries}
    return own or " ".join(words.get(q.label, q.label) for q in p.members)


# -- giving and taking supports --------------------------------------------------------------------------------------

MAX_COLLIDERS = 2  # maximum number for a composition; each costs an attempt
ATTACK_SHARE = 0.3  # of the vehicles that a candidate gains; they attack, the others support


class Supports:
    """Adds supports to the candidates of one encounter, and removes them."""

    def __init__(
        self, situations: Mapping[float, Situation], random: Random, most: int, known: Sequence[Composition] = (),
        library: Sequence[LibraryEntry] = (), attackers: Sequence[Attacker] = (),
    ) -> None:  # fmt: skip
        """Know the expert's compositions and the given ones.

        Args:
            situations: The situations by delay after the trigger [s].
            random: The random generator.
            most: The maximum number of adversaries of a candidate.
            known: Compositions that are tried in addition to the expert's.
            library: The intents that their parts may name.
            attackers: The vehicles that attack in each candidate; empty for one collider.
        """
        self._compositions, self._library = (*known, *EXPERT_COMPOSITIONS), library
        self.attackers = Attackers(attackers, random)
        self._situations, self._random, self._most = situations, random, most
        self._proposed: tuple[Composition, ...] = ()  # by the analyzer

    def let_attack(self, attackers: Sequence[Attacker]) -> None:
        """Have these vehicles attack together in each candidate from now on.

        Args:
            attackers: The vehicles.
        """
        self.attackers = Attackers(attackers, self._random)

    def known(self, templates: Sequence[AttackTemplate]) -> list[Proposal]:
        """Return candidates of the known compositions, with default parameters.

        Args:
            templates: The templates of the colliders.

        Returns:
            The candidates; none if the scene says who attacks.
        """
        return [] if self.attackers.names else self._carried_out([Cast(c) for c in self._compositions], templates)

    def completed(self, p: Proposal) -> Proposal:
        """Return a candidate with all attackers of the scene; the same one if it has them.

        Args:
            p: The candidate.
        """
        more = self.attackers.lacking(p)
        return replace(self._together(p, (*p.supports, *more)), by=p.by) if more else p

    def proposed(self, casts: Sequence[Cast], by: str, templates: Sequence[AttackTemplate]) -> list[Proposal]:
        """Return candidates of compositions that an analyzer proposes.

        From now on, candidates with the parts of one of these compositions have its label.

        Args:
            casts: The compositions, with their vehicles.
            by: The name of the analyzer.
            templates: The templates of the colliders.
        """
        self._proposed = tuple(cast.composition for cast in casts)
        return [replace(p, by=by) for p in self._carried_out(casts, templates)]

    def changed(self, p: Proposal, escape: Sequence[Duty]) -> Proposal:
        """Add a support to a candidate, or remove one.

        Args:
            p: The candidate.
            escape: Duties of a support that would have countered the ego's escape; empty if unknown.

        Returns:
            The changed candidate, or the same one if nothing fits.
        """
        p = self.completed(p)
        spare = [k for k, support in enumerate(p.supports) if support.bv not in self.attackers.names]
        full = len(p.supports) == self._most - 1
        if spare and (full or self._random.random() < 0.5):
            gone = self._random.choice(spare)
            return self._together(p, (*p.supports[:gone], *p.supports[gone + 1 :]))
        if full:
            return p
        collider = self._situations[p.delay].targets[p.bv]
        if is_unprotected(collider.state):  # all adversaries of a candidate have the same limits
            return p
        meets = collider.relation in MEET_AHEAD  # a vehicle beside the ego can hide only these
        duties = [duty for duty in escape or SUPPORT_INTENTS if meets or duty is not Duty.HIDE]
        fitting = [each for duty in duties for each in self._fitting(p, duty, SUPPORT_INTENTS[duty])]
        attacks = [] if self.attackers.names else self.attackers.others(p)
        if attacks and (not fitting or self._random.random() < ATTACK_SHARE):
            return self._together(p, (*p.supports, attack_of(self._random.choice(attacks), self._random)))
        if not fitting:
            return p
        duty, template = self._random.choice(fitting)
        numbers = None if self._random.random() < 0.5 else self._random
        return self._together(p, (*p.supports, replace(template.proposal(numbers), duty=duty)))

    def _fitting(
        self,
        p: Proposal,
        duty: Duty,
        entries: Iterable[LibraryEntry],
        mode: str = ANY_FITTING,
        vehicle: str = ANY_FITTING,
    ) -> list[tuple[Duty, AttackTemplate]]:
        """Return the vehicles that can do a duty for a candidate, each with an intent and a planner."""
        return [
            (duty, AttackTemplate(p.delay, target, entry, planner))
            for target in self._situations[p.delay].target_list()
            if target.state.id not in p.bvs and vehicle in (ANY_FITTING, target.state.id)
            for entry in entries if can_do_duty(duty, entry, target)
            for planner in entry.planners if mode in (ANY_FITTING, planner.mode)
        ]  # fmt: skip

    def _carried_out(self, casts: Sequence[Cast], templates: Sequence[AttackTemplate]) -> list[Proposal]:
        """Return candidates of compositions, each with the most dangerous colliders that fit, as early as possible."""
        made = list[Proposal]()
        for cast in (c for c in casts if len(c.composition.parts) <= self._most):
            first, colliders = cast.composition.parts[0], dict[str, AttackTemplate]()
            for t in templates:
                fitting = t.entry.label == first.intent and first.mode in (ANY_FITTING, t.planner.mode)
                if fitting and cast.vehicle(0) in (ANY_FITTING, t.target.state.id):
                    colliders.setdefault(t.target.state.id, t)
            complete = [q for t in colliders.values() if (q := self._cast(cast, t.proposal(None))) is not None]
            made += complete[:MAX_COLLIDERS]
        return made

    def _cast(self, cast: Cast, p: Proposal) -> Proposal | None:
        """Add a composition's supports to its collider; return None if no vehicle fits a part."""
        for k, part in enumerate(cast.composition.parts[1:], start=1):
            fitting = self._fitting_part(p, part, cast.vehicle(k))
            if not fitting:
                return None
            duty, template = self._random.choice(fitting)
            p = self._together(p, (*p.supports, replace(template.proposal(None), duty=duty)))
        return p

    def _fitting_part(self, p: Proposal, part: Part, vehicle: str) -> list[tuple[Duty, AttackTemplate]]:
        """Return the vehicles that can carry out a part of a composition, each with an intent and a planner."""
        if part.duty is not Duty.ATTACK:
            entries = [e for e in (*SUPPORT_INTENTS[part.duty], *self._library) if e.label == part.intent]
            return self._fitting(p, part.duty, entries, part.mode, vehicle)
        return [
            (Duty.ATTACK, t) for t in self.attackers.others(p)
            if t.entry.label == part.intent and part.mode in (ANY_FITTING, t.planner.mode)
            and vehicle in (ANY_FITTING, t.target.state.id)
        ]  # fmt: skip

    def _together(self, collider: Proposal, supports: tuple[Proposal, ...]) -> Proposal:
        """Return the collider's candidate with these supports and the label of their composition."""
        label = composition_label(collider, supports, (*self._compositions, *self._proposed)) if supports else ""
        return replace(collider.unscored(), supports=supports, composition=label, by="tuner")
