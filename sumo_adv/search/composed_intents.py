"""Intents that the built-in expert composes for relations that the library does not cover."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sumo_adv.datatypes import Intent, LibraryEntry
from sumo_adv.situation import Situation

NAME = "expert"

NEW_INTENTS: Mapping[str, tuple[str, str, str]] = {
    "merging": (
        "Ramp Merge Rush",
        "From a slip road or a feeder road that joins, the vehicle ignores the yield sign and arrives where both "
        "carriageways unite together with the ego.",
        "any",
    ),
    "crossing_right": (
        "Intersection Rush-through Turn Right",
        "The vehicle turns right through the junction without giving way, at a moment that meets the ego.",
        "right",
    ),
}

COMPOSED = frozenset(label for label, _, _ in NEW_INTENTS.values())
"""Labels of the intents that the expert composes itself."""


def composed(entry: LibraryEntry) -> bool:
    """Whether all planners of the intent are the expert's own."""
    return entry.label in COMPOSED and all(p.origin == NAME for p in entry.planners)


def compose(situations: Mapping[float, Situation], library: Sequence[LibraryEntry]) -> list[Intent]:
    """Intents of ``NEW_INTENTS`` for relations that nothing else of the library covers; those that the bank has learnt
    by now have the source ``memory``."""
    labels = {entry.label for entry in library}
    covered = {word for entry in library if not composed(entry) for word in entry.applies}
    intents = []
    for target in situations[min(situations)].target_list():
        for word, (label, description, _) in NEW_INTENTS.items():
            if word in target.applies() and word not in covered:
                reason = "no intent of the library can reach the ego from where this vehicle is"
                source = "memory" if label in labels else "generated"
                intents.append(Intent(target.state.id, label, description, "medium", 0.0, reason, source))
    return intents


def applies_of(label: str) -> tuple[str, ...]:
    """The relations a composed intent applies to."""
    return tuple(word for word, (name, _, _) in NEW_INTENTS.items() if name == label)
