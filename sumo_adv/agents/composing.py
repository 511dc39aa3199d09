"""What the built-in expert writes: intents that the library lacks, planners for them, and changed numbers."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence

from sumo_adv.datatypes import Attempt, Intent, LibraryEntry, Parameter, Planner
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


class ExpertModifier:
    """Moves a planner's numbers by what its attempts showed (ALGORITHM, "Refinement by diagnosis")."""

    name = NAME

    def __init__(self, make: MakePlanner) -> None:
        self._make = make

    def modify(self, planner: Planner, attempts: Sequence[Attempt], description: str = "") -> Planner | None:
        """Defaults become the nearest attempt's, changed by its diagnosis; bounds follow. None if nothing changed."""
        mine = [a for a in attempts if a.proposal.planner.hash == planner.hash]
        if not mine:
            return None
        best = min(mine, key=lambda a: (a.verdict.min_ttc, a.verdict.min_distance))
        numbers = dict(best.proposal.parameters)
        for name, change in _remedy(best):
            if name in numbers:
                numbers[name] += change
        text = planner.source
        for p in planner.parameters:
            text = _rewritten(text, p, numbers[p.name])
        if text == planner.source:
            return None
        return self._make(planner.label, planner.mode, text, NAME, planner.hash)


def _remedy(attempt: Attempt) -> list[tuple[str, float]]:
    """Which numbers to move, by what the attempt showed (units as in the planner's table)."""
    verdict = attempt.verdict
    if verdict.collided and verdict.avoidable == "unavoidable":
        return [("drift", 1.0), ("early", 0.8)]
    if {"lateral", "off_road", "curvature"} & set(verdict.failed_gates):
        return [("drift", 0.8)]
    if not verdict.collided:
        return [("gap", -0.5), ("early", 0.4), ("offset", -0.3), ("hold", 0.4), ("short", -1.5), ("across", 0.3)]
    return []


def _rewritten(source: str, p: Parameter, value: float) -> str:
    """The table's entry of one parameter with a new default, bounds moved along where it lies outside them."""
    value = round(value, 3)
    low, high = round(min(p.low, value), 3), round(max(p.high, value), 3)
    entry = re.compile(rf"""(["']{re.escape(p.name)}["']\s*:\s*\()[^,()]+,[^,()]+,[^,()]+,""")
    return entry.sub(rf"\g<1>{value!r}, {low!r}, {high!r},", source, count=1)
