"""What the built-in expert writes: planners for the intents that it composes."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from sumo_adv.datatypes import Intent, LibraryEntry, Planner
from sumo_adv.search.composed_intents import NAME, NEW_INTENTS
from sumo_adv.situation import Situation

MakePlanner = Callable[[str, str, str, str, str | None], Planner]


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
