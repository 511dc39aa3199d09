"""Drawing candidates: with the parameters that a planner's author gave, uniform within their bounds, or near others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from random import Random

from sumo_adv.datatypes import Proposal
from sumo_adv.search.settings import SamplingSettings
from sumo_adv.search.templates import AttackTemplate


class Sampler:
    """Draws candidates without scores; one seed gives one sequence."""

    def __init__(self, settings: SamplingSettings, seed: int) -> None:
        self.settings, self.random = settings, Random(seed)

    def first(self, templates: Sequence[AttackTemplate], count: int) -> list[Proposal]:
        """``count`` candidates: of each vehicle's planners one with the author's parameters, as early as possible; the
        rest uniform, of each template in turn.

        Learnt versions come on top, with their own parameters, so that they do not change what else is drawn.
        """
        drawn_from = originals(templates)
        candidates = [t.proposal(None) for t in _earliest(drawn_from)]
        candidates += self.uniform(drawn_from, count - len(candidates))
        return candidates + _learnt(templates)

    def earliest(self, templates: Sequence[AttackTemplate]) -> list[Proposal]:
        """With the authors' parameters, as early as possible: of each vehicle's planners one, learnt ones last."""
        return [t.proposal(None) for t in _earliest(originals(templates))] + _learnt(templates)

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
