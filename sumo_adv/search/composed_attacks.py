"""Compositions that the built-in expert proposes, and what a composition is called."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from sumo_adv.datatypes import Duty, LibraryEntry, Proposal
from sumo_adv.memory.records import Composition, Part
from sumo_adv.search.support_intents import SUPPORT_INTENTS

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
