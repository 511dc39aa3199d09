"""What the built-in expert writes: intents that the library lacks, and planners for them."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence

from sumo_adv.datatypes import Intent, LibraryEntry, Planner
from sumo_adv.situation import Situation

NAME = "expert"
MakePlanner = Callable[[str, str, str, str, str | None], Planner]

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
    """Whether the expert composed it; not where somebody gave the intent a planner of their own."""
    return entry.label in COMPOSED and all(p.origin == NAME for p in entry.planners)


def compose(situations: Mapping[float, Situation], library: Sequence[LibraryEntry]) -> list[Intent]:
    """Intents of ``NEW_INTENTS`` for relations that nothing else of the library covers; those that the bank has learnt
    by now have the source ``memory``."""
    known = {entry.label for entry in library}
    covered = {word for entry in library if not composed(entry) for word in entry.applies}
    found = []
    for target in situations[min(situations)].target_list():
        for word, (label, description, _) in NEW_INTENTS.items():
            if word in target.applies() and word not in covered:
                reason = "no intent of the library can reach the ego from where this vehicle is"
                source = "memory" if label in known else "generated"
                found.append(Intent(target.state.id, label, description, "medium", 0.0, reason, source))
    return found


class ExpertGenerator:
    """Adapts the library's nearest planner text to a movement that it does not have yet."""

    name = NAME

    def __init__(self, make: MakePlanner) -> None:
        self._make = make

    def generate(
        self, intent: Intent, situation: Situation | None, examples: Sequence[LibraryEntry]
    ) -> tuple[Planner, ...]:
        """Planners for one of ``NEW_INTENTS``, one for each mode of the nearest intent that makes a movement; none for
        anything else or without an example to start from."""
        movement = next((m for _, (label, _, m) in NEW_INTENTS.items() if label == intent.label), None)
        pattern = re.compile(r'^MOVEMENT = "\w+"$', re.MULTILINE)
        for entry in examples if movement is not None else ():
            texts = [p for p in entry.planners if pattern.search(p.source) and 'MOVEMENT = "none"' not in p.source]
            if texts:
                word = f'MOVEMENT = "{movement}"'
                return tuple(self._adapted(intent.label, p, pattern.sub(word, p.source)) for p in texts)
        return ()

    def _adapted(self, label: str, planner: Planner, text: str) -> Planner:
        text = re.sub(r"\A# .*", f'# {label}, mode "{planner.mode}"', text)
        return self._make(label, planner.mode, text, NAME, planner.hash)


def applies_of(label: str) -> tuple[str, ...]:
    """The relations a composed intent applies to."""
    return tuple(word for word, (name, _, _) in NEW_INTENTS.items() if name == label)
