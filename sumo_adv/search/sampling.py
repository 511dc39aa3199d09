"""Attack templates, and candidates drawn from them.

A template says which vehicle, which intent, which planner, and when. A candidate has numbers too: those that the
planner's author gave, uniform ones within their bounds, or numbers near those of another candidate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from random import Random
from typing import Protocol

from sumo_adv.datatypes import LibraryEntry, Planner, Proposal
from sumo_adv.search.settings import SamplingSettings
from sumo_adv.situation import Situation, Target

MAX_VERSIONS_PER_MODE = 2  # that are drawn from; as many learnt ones are tried with their own parameters
EMERGENCY_BRAKING_LABEL = "Emergency Braking"
DEFAULT_EMERGENCY_BRAKING_M_S2, EMERGENCY_BRAKING_RANGE_M_S2 = 7.5, (5.0, 8.0)  # of an intent with that label


@dataclass(frozen=True, slots=True)
class AttackTemplate:
    """One way to attack with open parameters. ``learnt``: its planner is a changed version of another one."""

    delay: float
    target: Target
    entry: LibraryEntry
    planner: Planner
    learnt: bool = False

    @property
    def key(self) -> tuple[float, str, str, str]:
        """What identifies it: the start [s], the vehicle, the intent, and the planner's hash."""
        return self.delay, self.target.state.id, self.entry.label, self.planner.hash

    def proposal(self, draw: Random | None) -> Proposal:
        """A candidate with the author's parameters (``draw`` None), or with uniform ones within their bounds."""
        if draw is None:
            numbers, braking = self.planner.defaults(), DEFAULT_EMERGENCY_BRAKING_M_S2
        else:
            numbers = {p.name: round(draw.uniform(p.low, p.high), 4) for p in self.planner.parameters}
            braking = draw.uniform(*EMERGENCY_BRAKING_RANGE_M_S2)
        acceleration = -braking if self.entry.label == EMERGENCY_BRAKING_LABEL else 0.0
        return Proposal(self.target.state.id, self.entry.label, self.planner, numbers, acceleration, self.delay)


def templates_of(
    situations: Mapping[float, Situation], library: Sequence[LibraryEntry], allowed: Collection[str] | None = None
) -> list[AttackTemplate]:
    """All templates that apply: by delay, most dangerous vehicle first, in the library's order. Of each mode, the first
    ``MAX_VERSIONS_PER_MODE`` versions and as many first learnt ones. ``allowed``: labels of intents, None for all."""
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
        if count[planner.mode, learnt] <= MAX_VERSIONS_PER_MODE:
            selected.append((planner, learnt))
    return selected


def kind_of(label: str, relation: str, side: str | None) -> str:
    """The kind of an attack: its intent, the adversary's relation to the ego, and the side of the ego that is hit."""
    return f"{label} / {relation} / {side or 'no contact'}"


class Scorer(Protocol):
    """Predicts candidates; lower scores are better."""

    def score(self, proposals: Sequence[Proposal]) -> list[Proposal]:
        """The same candidates with ``score`` and ``prediction``."""
        ...


class Sampler:
    """Draws candidates without scores; one seed gives one sequence."""

    def __init__(self, settings: SamplingSettings, seed: int) -> None:
        self.settings, self.random = settings, Random(seed)

    def first(self, templates: Sequence[AttackTemplate], count: int) -> list[Proposal]:
        """At least ``count`` candidates: of each vehicle's planners one with the author's parameters, as early as
        possible; the rest uniform, of each template in turn.

        Learnt versions come on top, with their own parameters, so that they do not change what else is drawn.
        """
        drawn_from = originals(templates)
        candidates = [t.proposal(None) for t in _earliest(drawn_from)]
        candidates += self.uniform(drawn_from, count - len(candidates))
        return candidates + _learnt(templates)

    def each(self, templates: Sequence[AttackTemplate], count: int) -> list[Proposal]:
        """At least ``count`` candidates: one of each template with its author's parameters, the rest uniform."""
        own = originals(templates)
        candidates = [t.proposal(None) for t in own] + self.uniform(own, count - len(own))
        return candidates + _learnt(templates)

    def more(self, templates: Sequence[AttackTemplate], best: Sequence[Proposal]) -> list[Proposal]:
        """``redraw`` candidates: half uniform, half near the first ``nearest`` of ``best``."""
        count = self.settings.redraw
        candidates = self.uniform(originals(templates), count // 2)
        return candidates + self.variations(best[: self.settings.nearest], count - len(candidates))

    def uniform(self, templates: Sequence[AttackTemplate], count: int) -> list[Proposal]:
        """``count`` candidates of the templates in turn, uniform within the bounds; where there are more templates, of
        some that are evenly spread."""
        every = max(len(templates) / count, 1.0) if count > 0 else 1.0
        rows = (int(k * every) % len(templates) for k in range(count if templates else 0))
        return [templates[k].proposal(self.random) for k in rows]

    def variations(self, proposals: Sequence[Proposal], count: int) -> list[Proposal]:
        """``count`` candidates with parameters near those of the given ones, in turn."""
        spread = self.settings.spread
        return [varied(proposals[k % len(proposals)], self.random, spread) for k in range(count if proposals else 0)]


def elites(ordered: Sequence[Proposal]) -> list[Proposal]:
    """The first candidate of each cell, in order: a cell is a vehicle, intent and mode, and the side of the ego that is
    hit or why it is not (MAP-Elites; Mouret and Clune 2015, "Illuminating search spaces by mapping elites")."""
    cells: dict[tuple[str, ...], Proposal] = {}
    for p in ordered:
        seen = p.prediction
        if seen is None or not seen.failure:
            side = "" if seen is None else seen.side or ("contact" if seen.hit else "miss")
            cells.setdefault((*p.family, side), p)
    return list(cells.values())


def varied(p: Proposal, random: Random, spread: float) -> Proposal:
    """A candidate with other parameters: normal around its own with a standard deviation of ``spread`` times the
    range, within the bounds; so have its supports."""
    return moved(p, lambda: random.gauss(0.0, spread))


def moved(p: Proposal, step: Callable[[], float]) -> Proposal:
    """A candidate with each parameter moved by a ``step``, a share of its range, and kept within its bounds; so are
    those of its supports. It counts as proposed by the search."""
    numbers = {}
    for q in p.planner.parameters:
        value = p.parameters.get(q.name, q.default) + step() * (q.high - q.low)
        numbers[q.name] = round(min(max(value, q.low), q.high), 4)
    supports = tuple(moved(support, step) for support in p.supports)
    return replace(p.unscored(), parameters=numbers, by="tuner", supports=supports)


def originals(templates: Sequence[AttackTemplate]) -> list[AttackTemplate]:
    """Templates of planners that were not learnt, in the order in which they are drawn."""
    originals = (t for t in templates if not t.learnt)
    return sorted(originals, key=lambda t: (t.entry.label, t.planner.mode, t.planner.hash))


def _learnt(templates: Sequence[AttackTemplate]) -> list[Proposal]:
    return [t.proposal(None) for t in templates if t.learnt]


def _earliest(templates: Sequence[AttackTemplate]) -> list[AttackTemplate]:
    """For each vehicle and planner, the template with the earliest start."""
    candidates: dict[tuple[str, str], AttackTemplate] = {}
    for template in sorted(templates, key=lambda t: t.delay):
        candidates.setdefault((template.target.state.id, template.planner.hash), template)
    return list(candidates.values())
