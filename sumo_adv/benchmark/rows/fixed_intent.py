"""Fixed intent: always the same behaviour, whatever the encounter.

Idea: one intent of the library, on every vehicle, with every mode and at every moment it applies to: first all of
them with their authors' numbers, earliest and most dangerous first, then in turn with drawn ones. No prediction. The
row ``best fixed`` of the tables is the label with the best rate over a suite: what can be had without looking at the
encounter, chosen in hindsight, so it flatters.
Limits: where the intent applies to no vehicle there is nothing to try and the encounter counts as failed.
Citation: the best constant answer, the usual floor of a classifier; the paper's LLM-F is two such behaviours.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import replace

from sumo_adv.benchmark.nouns import Encounter
from sumo_adv.datatypes import Attempt, Proposal
from sumo_adv.search.sampling import AttackTemplate, templates_of

LABELS = (
    "Aggressive Cut-in",
    "Close Car-following",
    "Emergency Braking",
    "Intersection Rush-through Go-straight",
    "Intersection Rush-through Turn Left",
    "Opposite Direction Intrusion",
    "Straight Lane Shift",
)
"""The paper's seven behaviours, as the shipped library labels them."""


class FixedIntent:
    """One label in all ways it applies."""

    def __init__(self, label: str) -> None:
        self.name, self.label = f"fixed:{label}", label
        self._families: list[AttackTemplate] = []
        self._draw = random.Random(0)

    def begin(self, encounter: Encounter) -> None:
        """All that applies of the label."""
        self._families = templates_of(encounter.situations, encounter.library, [self.label])
        self._draw = random.Random(encounter.seed)

    def propose(self, tried: Sequence[Attempt]) -> Proposal | None:
        """Each family with its author's numbers, then round robin with drawn ones."""
        if not self._families:
            return None
        k = len(tried)
        family = self._families[k % len(self._families)]
        return replace(family.proposal(None if k < len(self._families) else self._draw), by=self.name)
