"""Random intent: any vehicle, intent, mode and moment that apply, with numbers drawn within their bounds.

Idea: the library's planners without any choice. Each attempt draws one of all ways to attack (vehicle, intent,
mode, delay) uniformly, then every number of its planner uniformly within the bounds its author gave. Nothing is
predicted and nothing is learnt from the attempts before. What a method gains over this row is what choosing is worth.
Limits: an intent with many modes, or that applies to many vehicles, is drawn more often.
Citation: the usual control of search-based testing (Arcuri and Briand 2011, "Adaptive random testing: an illusion of
effectiveness?", ISSTA); here over the paper's behaviour library.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import replace

from sumo_adv.benchmark.nouns import Encounter
from sumo_adv.datatypes import Attempt, Proposal
from sumo_adv.search.sampling import AttackTemplate, templates_of


class RandomIntent:
    """Draws templates and their numbers uniformly."""

    name = "random"

    def __init__(self) -> None:
        self._families: list[AttackTemplate] = []
        self._draw = random.Random(0)

    def begin(self, encounter: Encounter) -> None:
        """All that applies, and the seed's draws."""
        self._families = templates_of(encounter.situations, encounter.library)
        self._draw = random.Random(encounter.seed)

    def propose(self, tried: Sequence[Attempt]) -> Proposal | None:
        """The next draw; None only where no intent applies to any vehicle."""
        if not self._families:
            return None
        return replace(self._draw.choice(self._families).proposal(self._draw), by=self.name)
