"""Ways to attack whose numbers are still open: which vehicle, which intent, which planner, when."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sumo_adv.datatypes import LibraryEntry, Parameter, Planner, Proposal
from sumo_adv.situation import Situation, Target

VERSIONS = 2  # of a mode that are drawn from, and as many that were learnt, which are asked with their own numbers only
BRAKING_LABEL = "Emergency Braking"


@dataclass(frozen=True, slots=True)
class AttackTemplate:
    """One way of attacking whose numbers are still open. ``learnt``: its planner is a version of one that is there."""

    delay: float
    target: Target
    entry: LibraryEntry
    planner: Planner
    learnt: bool = False

    def proposal(self, draw: random.Random | None) -> Proposal:
        """With the author's numbers (no ``draw``) or drawn ones, uniform within their bounds."""
        if draw is None:
            numbers, braking = self.planner.defaults(), 7.5
        else:
            numbers = {p.name: _drawn(p, draw) for p in self.planner.parameters}
            braking = draw.uniform(5.0, 8.0)
        acceleration = -braking if self.entry.label == BRAKING_LABEL else 0.0
        return Proposal(self.target.state.id, self.entry.label, self.planner, numbers, acceleration, self.delay)


def _drawn(parameter: Parameter, draw: random.Random) -> float:
    return round(draw.uniform(parameter.low, parameter.high), 4)


def templates_of(
    situations: Mapping[float, Situation], library: Sequence[LibraryEntry], allowed: Sequence[str] = ()
) -> list[AttackTemplate]:
    """All that applies: by delay, most dangerous BV first, in the library's order; of each mode the ``VERSIONS`` that
    come first there, and of those that were learnt."""
    versions = [(entry, _first_versions(entry, library)) for entry in library if not allowed or entry.label in allowed]
    found = []
    for delay in sorted(situations):
        for target in situations[delay].target_list():
            words = set(target.applies())
            for entry, planners in versions:
                if words & set(entry.applies):
                    found += [AttackTemplate(delay, target, entry, planner, learnt) for planner, learnt in planners]
    return found


def _first_versions(entry: LibraryEntry, library: Sequence[LibraryEntry]) -> list[tuple[Planner, bool]]:
    """At most ``VERSIONS`` planners of a mode, and as many that were learnt from others of the intent; of these one
    stands for its mode where no other does."""
    elsewhere = {p.hash for other in library if other.label != entry.label for p in other.planners}
    first = {p.mode for p in entry.planners if p.parent is None or p.parent in elsewhere}
    count: Counter[tuple[str, bool]] = Counter()
    found = []
    for planner in entry.planners:
        learnt = planner.mode in first and planner.parent is not None and planner.parent not in elsewhere
        count[planner.mode, learnt] += 1
        if count[planner.mode, learnt] <= VERSIONS:
            found.append((planner, learnt))
    return found
