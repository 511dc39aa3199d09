"""Attack templates, and candidates drawn from them.

A template specifies the vehicle, the intent, the planner and the start. A candidate also has parameter values: the
planner's defaults, uniform samples within the bounds, or values near those of another candidate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from random import Random
from typing import Protocol

from sumo_adv.datatypes import MAX_WAIT_S, Duty, LibraryEntry, Planner, Proposal
from sumo_adv.search.settings import SamplingSettings
from sumo_adv.situation import Situation, Target

MAX_VERSIONS_PER_MODE = 2  # that are drawn from; as many learnt ones are tried with their defaults
EMERGENCY_BRAKING_LABEL = "Emergency Braking"
DEFAULT_EMERGENCY_BRAKING_M_S2, EMERGENCY_BRAKING_RANGE_M_S2 = 7.5, (5.0, 8.0)  # for an intent with that label


@dataclass(frozen=True, slots=True)
class AttackTemplate:
    """One way to attack, with open parameters.

    Attributes:
        delay: The start, as time after the trigger [s].
        target: The vehicle.
        entry: The intent.
        planner: The planner.
        learnt: Whether the planner is a changed version of another one.
    """

    delay: float
    target: Target
    entry: LibraryEntry
    planner: Planner
    learnt: bool = False

    @property
    def key(self) -> tuple[float, str, str, str]:
        """What identifies the template: the start [s], the vehicle, the intent, and the planner's hash."""
        return self.delay, self.target.state.id, self.entry.label, self.planner.hash

    def proposal(self, draw: Random | None) -> Proposal:
        """Make a candidate.

        Args:
            draw: Draws the parameters uniformly within their bounds; None takes the planner's defaults.

        Returns:
            The candidate. Emergency braking also gets an acceleration [m/s2].
        """
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
    """List all templates that apply: by delay, most dangerous vehicle first, in the library's order.

    Each mode gets its first ``MAX_VERSIONS_PER_MODE`` versions and as many learnt ones.

    Args:
        situations: The situations by delay after the trigger [s].
        library: The intents to draw from.
        allowed: Labels of intents; None allows all.
    """
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
    """Return the first versions of each mode, and whether each was learnt.

    A learnt version has a parent in the same intent. It counts as the original of its mode if the mode has no other.
    """
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
    """Name the kind of an attack.

    Args:
        label: The label of its intent.
        relation: The adversary's relation to the ego.
        side: The side of the ego that is hit; None without a contact.
    """
    return f"{label} / {relation} / {side or 'no contact'}"


class Scorer(Protocol):
    """Predicts candidates. Lower scores are better."""

    def score(self, proposals: Sequence[Proposal]) -> list[Proposal]:
        """Return the same candidates with ``score`` and ``prediction``."""
        ...


class Sampler:
    """Draws candidates without scores. The same seed gives the same sequence."""

    def __init__(self, settings: SamplingSettings, seed: int) -> None:
        """Start the random generator.

        Args:
            settings: How many candidates are drawn, and where.
            seed: The seed of the random generator.
        """
        self.settings, self.random = settings, Random(seed)

    def first(self, templates: Sequence[AttackTemplate], count: int) -> list[Proposal]:
        """Draw the first candidates.

        Each planner is tried once for each vehicle, with its default parameters and as early as possible. The rest are
        uniform samples of each template in turn. Learnt versions are added with their defaults, so that they do not
        change the other draws.

        Args:
            templates: The templates to draw from.
            count: The minimum number of candidates.
        """
        drawn_from = originals(templates)
        candidates = [t.proposal(None) for t in _earliest(drawn_from)]
        candidates += self.uniform(drawn_from, count - len(candidates))
        return candidates + _learnt(templates)

    def each(self, templates: Sequence[AttackTemplate], count: int) -> list[Proposal]:
        """Draw one candidate of each template with default parameters; the rest are uniform samples.

        Learnt versions are added with their defaults.

        Args:
            templates: The templates to draw from.
            count: The minimum number of candidates.
        """
        own = originals(templates)
        candidates = [t.proposal(None) for t in own] + self.uniform(own, count - len(own))
        return candidates + _learnt(templates)

    def more(self, templates: Sequence[AttackTemplate], best: Sequence[Proposal]) -> list[Proposal]:
        """Draw ``redraw`` candidates: half uniform samples, half variations of the first ``nearest`` of ``best``.

        Args:
            templates: The templates to draw from.
            best: The best candidates so far, best first.
        """
        count = self.settings.redraw
        candidates = self.uniform(originals(templates), count // 2)
        return candidates + self.variations(best[: self.settings.nearest], count - len(candidates))

    def uniform(self, templates: Sequence[AttackTemplate], count: int) -> list[Proposal]:
        """Draw uniform samples of the templates in turn.

        If there are more templates than samples, evenly spread templates are drawn from.

        Args:
            templates: The templates to draw from.
            count: The number of candidates.
        """
        every = max(len(templates) / count, 1.0) if count > 0 else 1.0
        rows = (int(k * every) % len(templates) for k in range(count if templates else 0))
        return [templates[k].proposal(self.random) for k in rows]

    def variations(self, proposals: Sequence[Proposal], count: int) -> list[Proposal]:
        """Draw variations of the given candidates in turn.

        Args:
            proposals: The candidates to vary.
            count: The number of variations.
        """
        spread = self.settings.spread
        return [varied(proposals[k % len(proposals)], self.random, spread) for k in range(count if proposals else 0)]


def elites(ordered: Sequence[Proposal]) -> list[Proposal]:
    """Return the first candidate of each cell, in order.

    A cell is a vehicle, intent and mode, and the side of the ego that is hit or why it is not (MAP-Elites; Mouret and
    Clune 2015, "Illuminating search spaces by mapping elites").

    Args:
        ordered: The candidates, best first. Those whose planner failed are left out.
    """
    cells: dict[tuple[str, ...], Proposal] = {}
    for p in ordered:
        seen = p.prediction
        if seen is None or not seen.failure:
            side = "" if seen is None else seen.side or ("contact" if seen.hit else "miss")
            cells.setdefault((*p.family, side), p)
    return list(cells.values())


def varied(p: Proposal, random: Random, spread: float) -> Proposal:
    """Vary the parameters of a candidate and its supports with normally distributed steps, within the bounds.

    Args:
        p: The candidate.
        random: The random generator.
        spread: The standard deviation, as a share of a parameter's range.
    """
    return moved(p, lambda: random.gauss(0.0, spread))


def varied_in_one(p: Proposal, random: Random, spread: float) -> Proposal:
    """Vary one adversary of a candidate, as ``varied`` does, and keep the others.

    Args:
        p: The candidate.
        random: The random generator.
        spread: The standard deviation, as a share of a parameter's range.
    """
    k = random.randrange(len(p.members))
    if k == 0:
        return replace(varied(replace(p, supports=()), random, spread), supports=p.supports)
    supports = (*p.supports[: k - 1], varied(p.supports[k - 1], random, spread), *p.supports[k:])
    return replace(p.unscored(), by="tuner", supports=supports)


def moved(p: Proposal, step: Callable[[], float]) -> Proposal:
    """Move each parameter of a candidate and its supports, and the wait of each attacker, within its bounds.

    Args:
        p: The candidate.
        step: Returns a step, as a share of a parameter's range.

    Returns:
        The candidate, which counts as proposed by the search.
    """
    numbers = {}
    for q in p.planner.parameters:
        value = p.parameters.get(q.name, q.default) + step() * (q.high - q.low)
        numbers[q.name] = round(min(max(value, q.low), q.high), 4)
    wait = p.wait
    if wait > 0.0 or p.duty in (Duty.ATTACK, Duty.PLAY):
        wait = round(min(max(wait + step() * MAX_WAIT_S, 0.0), MAX_WAIT_S), 2)
    supports = tuple(moved(support, step) for support in p.supports)
    return replace(p.unscored(), parameters=numbers, by="tuner", supports=supports, wait=wait)


def originals(templates: Sequence[AttackTemplate]) -> list[AttackTemplate]:
    """Return templates of planners that were not learnt, ordered by label, mode and hash.

    Args:
        templates: The templates to choose from.
    """
    originals = (t for t in templates if not t.learnt)
    return sorted(originals, key=lambda t: (t.entry.label, t.planner.mode, t.planner.hash))


def _learnt(templates: Sequence[AttackTemplate]) -> list[Proposal]:
    """Return candidates of the learnt templates, with default parameters."""
    return [t.proposal(None) for t in templates if t.learnt]


def _earliest(templates: Sequence[AttackTemplate]) -> list[AttackTemplate]:
    """Return the template with the earliest start for each vehicle and planner."""
    candidates: dict[tuple[str, str], AttackTemplate] = {}
    for template in sorted(templates, key=lambda t: t.delay):
        candidates.setdefault((template.target.state.id, template.planner.hash), template)
    return list(candidates.values())
