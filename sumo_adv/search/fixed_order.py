"""Without the built-in search (``tuner = off``): candidates in the order in which the analyzer chose them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sumo_adv.datatypes import Intent, ObservedMotion, Proposal, Verdict
from sumo_adv.search.templates import AttackTemplate


class FixedOrder:
    """Proposes listed candidates; attempts change nothing."""

    def __init__(self, proposals: Sequence[Proposal]) -> None:
        self._left = list(proposals)

    def propose(self, budget: int) -> list[Proposal]:
        """The next ``budget`` candidates."""
        candidates, self._left = self._left[:budget], self._left[budget:]
        return candidates

    def observe(self, tried: Proposal, motion: ObservedMotion | None, verdict: Verdict) -> None:
        """Nothing."""


def as_written(
    intents: Sequence[Intent], templates: Sequence[AttackTemplate], recalled: Sequence[Proposal] = ()
) -> list[Proposal]:
    """What was recalled, then the intents in their order: in the ways that the analyzer chose, or where it chose none,
    all planners with their authors' parameters at the earliest start."""
    candidates = list(recalled)
    for intent in intents:
        applicable = [t for t in templates if (t.target.state.id, t.entry.label) == (intent.bv, intent.label)]
        earliest = min((t.delay for t in applicable), default=0.0)
        first = [t.proposal(None) for t in applicable if t.delay == earliest]
        candidates += chosen(intent, templates) or [replace(p, acceleration=intent.acceleration) for p in first]
    return [p for k, p in enumerate(candidates) if p not in candidates[:k]]


def chosen(intent: Intent, templates: Sequence[AttackTemplate]) -> list[Proposal]:
    """The ways that an analyzer chose for an intent, as candidates."""
    candidates = []
    for way in intent.ways:
        key = (intent.bv, intent.label, way.mode, way.delay)
        matches = (t for t in templates if (t.target.state.id, t.entry.label, t.planner.mode, t.delay) == key)
        template = next(matches, None)
        if template is not None:
            numbers = template.planner.defaults() | dict(way.parameters)
            candidates.append(replace(template.proposal(None), parameters=numbers, acceleration=intent.acceleration))
    return candidates
