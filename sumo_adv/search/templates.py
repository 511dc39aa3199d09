"""Attack templates: which vehicle, which intent, which planner, when; the parameters are still open."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from sumo_adv.datatypes import LibraryEntry, Parameter, Planner, Proposal
from sumo_adv.situation import Situation, Target

VERSIONS = 2  # versions of a mode that are drawn from; the same number of learnt ones is tried with its own parameters
BRAKING_LABEL = "Emergency Braking"
DEFAULT_BRAKING, BRAKING_RANGE = 7.5, (5.0, 8.0)  # m/s2, the intent's acceleration with that label


@dataclass(frozen=True, slots=True)
class AttackTemplate:
    """One way to attack with open parameters. ``learnt``: its planner is a changed version of another one."""

    delay: float
    target: Target
    entry: LibraryEntry
    planner: Planner
    learnt: bool = False

    def proposal(self, draw: random.Random | None) -> Proposal:
        """A candidate with the author's parameters (``draw`` None), or with uniform ones within their bounds."""
        if draw is None:
            numbers, braking = self.planner.defaults(), DEFAULT_BRAKING
        else:
            numbers = {p.name: _drawn(p, draw) for p in self.planner.parameters}
            braking = draw.uniform(*BRAKING_RANGE)
        acceleration = -braking if self.entry.label == BRAKING_LABEL else 0.0
        return Proposal(self.target.state.id, self.entry.label, self.planner, numbers, acceleration, self.delay)


def _drawn(parameter: Parameter, draw: random.Random) -> float:
    return round(draw.uniform(parameter.low, parameter.high), 4)


def templates_of(
    situations: Mapping[float, Situation], library: Sequence[LibraryEntry], allowed: Collection[str] | None = None
) -> list[AttackTemplate]:
    """All templates that apply: by delay, most dangerous vehicle first, in the library's order. Of each mode, the first
    ``VERSIONS`` versions and the first ``VERSIONS`` learnt ones. ``allowed``: labels of intents, None for all."""
    entries = library if allowed is None else [entry for entry in library if entry.label in allowed]
    versions = [(entry, _first_versions(entry, library)) for entry in entries]
    selected = []
    for delay in sorted(situations):
        for target in situations[delay].target_list():
            words = set(target.applies())
            for entry, planners in versions:
                if words & set(entry.applies):
                    selected += [AttackTemplate(delay, target, entry, planner, learnt) for planner, learnt in planners]
    return selected


def _first_versions(entry: LibraryEntry, library: Sequence[LibraryEntry]) -> list[tuple[Planner, bool]]:
    """The first versions of each mode, and whether each was learnt: it has a parent in the same intent. A learnt
    version stands for its mode where the mode has no other."""
    elsewhere = {p.hash for intent in library if intent.label != entry.label for p in intent.planners}
    first = {p.mode for p in entry.planners if p.parent is None or p.parent in elsewhere}
    count: Counter[tuple[str, bool]] = Counter()
    selected = []
    for planner in entry.planners:
        learnt = planner.mode in first and planner.parent is not None and planner.parent not in elsewhere
        count[planner.mode, learnt] += 1
        if count[planner.mode, learnt] <= VERSIONS:
            selected.append((planner, learnt))
    return selected


def kind_of(label: str, relation: str, side: str | None) -> str:
    """The kind of an attack: its intent, the adversary's relation to the ego, and the side of the ego that is hit."""
    return f"{label} / {relation} / {side or 'no contact'}"
