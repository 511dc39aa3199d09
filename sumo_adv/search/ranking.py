"""Orders in which candidates are tried.

Intents are ranked by their predicted candidates. Without the built-in search (``tuner = off``), candidates are tried as
the analyzer chose them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from sumo_adv.datatypes import Intent, ObservedMotion, Proposal, Verdict
from sumo_adv.goal import Goal
from sumo_adv.search.sampling import AttackTemplate
from sumo_adv.search.settings import SearchSettings

NO_CONFLICT_TTC_S = 10.0  # s; reported as the minimum TTC if nothing was predicted


def ranked_intents(
    pool: Sequence[Proposal], descriptions: Mapping[str, str], price: Callable[[Proposal], float],
    settings: SearchSettings, goal: Goal,
) -> tuple[list[Intent], list[Intent]]:  # fmt: skip
    """Rank the intents of the pool, best first.

    Args:
        pool: The predicted candidates.
        descriptions: The description of each intent, by its label.
        price: Returns the price of a candidate; lower is better.
        settings: The scores from which on a candidate counts.
        goal: What an attack is meant to achieve.

    Returns:
        The intents with a candidate that is predicted to reach the ego in a way that counts, and the others.
    """
    groups: dict[tuple[str, str], list[Proposal]] = {}
    for p in pool:
        groups.setdefault((p.bv, p.label), []).append(p)

    def order(item: tuple[tuple[str, str], list[Proposal]]) -> tuple[float, float, str, str]:
        key, members = item
        return (-_share(members, settings), min(map(price, members)), *key)

    ranked = [
        (_share(g, settings), _intent(g, descriptions[key[1]], settings, goal))
        for key, g in sorted(groups.items(), key=order)
    ]
    return [i for share, i in ranked if share > 0], [i for share, i in ranked if share == 0]


def unpredicted_intents(templates: Sequence[AttackTemplate]) -> list[Intent]:
    """List the intents that can be drawn, most dangerous vehicle first, without predictions.

    Args:
        templates: The templates that candidates are drawn from.
    """
    first = {(t.target.state.id, t.entry.label): t for t in reversed(templates)}
    ordered = sorted(first.values(), key=lambda t: (-t.target.risk, t.target.state.id, t.entry.label))
    reason = "not predicted, so attempts show how the driver reacts"
    return [
        Intent(t.target.state.id, t.entry.label, t.entry.description, "medium", t.proposal(None).acceleration, reason)
        for t in ordered
    ]


def _share(members: Sequence[Proposal], settings: SearchSettings) -> float:
    """Return the share of the candidates that are predicted to collide in a way that counts."""
    return sum(p.score < settings.reaches for p in members) / len(members)


def _counts(goal: Goal, met: int, avoidable: int, count: int) -> str:
    """Say in words how many candidates meet the goal."""
    if goal.ttc is not None:
        return f"{met} of {count} candidates pass with a min TTC in the band"
    return f"{met} of {count} candidates collide{goal.hard}, {avoidable} of them avoidably"


def _intent(members: Sequence[Proposal], description: str, settings: SearchSettings, goal: Goal) -> Intent:
    """Summarise the candidates of one vehicle and label as an intent."""
    best = min(members, key=lambda p: p.score)
    risk = "high" if best.score < settings.avoidable else ("medium" if best.score < settings.reaches else "low")
    avoidable = sum(p.score < settings.avoidable for p in members)
    made = [p.prediction for p in members if p.prediction is not None and not p.prediction.failure]
    least = min((prediction.min_ttc for prediction in made), default=NO_CONFLICT_TTC_S)
    met = sum(p.score < settings.reaches for p in members)
    reason = f"predicted: {_counts(goal, met, avoidable, len(members))}; min TTC {least:.2f} s"
    return Intent(best.bv, best.label, description, risk, best.acceleration, reason)


# -- without the built-in search ------------------------------------------------------------------------------------


class FixedOrder:
    """Proposes listed candidates in their order; attempts change nothing."""

    def __init__(self, proposals: Sequence[Proposal]) -> None:
        """Start with all candidates.

        Args:
            proposals: The candidates, in the order in which they are tried.
        """
        self._left = list(proposals)

    def propose(self, budget: int) -> list[Proposal]:
        """Return the next candidates.

        Args:
            budget: The maximum number of candidates.
        """
        candidates, self._left = self._left[:budget], self._left[budget:]
        return candidates

    def observe(self, tried: Proposal, motion: ObservedMotion | None, verdict: Verdict) -> None:
        """Ignore the attempt."""


def as_written(
    intents: Sequence[Intent], templates: Sequence[AttackTemplate], recalled: Sequence[Proposal] = ()
) -> list[Proposal]:
    """List candidates as an analyzer ordered them.

    Args:
        intents: The intents, in their order.
        templates: The templates that candidates are drawn from.
        recalled: Candidates from memory, which come first.

    Returns:
        The recalled candidates, then those of each intent, without duplicates. An intent comes in the ways that the
        analyzer chose. If it chose none, all planners are tried with their default parameters at the earliest start.
    """
    candidates = list(recalled)
    for intent in intents:
        applicable = [t for t in templates if (t.target.state.id, t.entry.label) == (intent.bv, intent.label)]
        earliest = min((t.delay for t in applicable), default=0.0)
        first = [t.proposal(None) for t in applicable if t.delay == earliest]
        candidates += chosen_candidates(intent, templates) or [
            replace(p, acceleration=intent.acceleration) for p in first
        ]
    return [p for k, p in enumerate(candidates) if p not in candidates[:k]]


def chosen_candidates(intent: Intent, templates: Sequence[AttackTemplate]) -> list[Proposal]:
    """Turn the ways that an analyzer chose for an intent into candidates.

    Args:
        intent: The intent with its ways.
        templates: The templates that candidates are drawn from.

    Returns:
        One candidate for each way that has a template.
    """
    candidates = []
    for way in intent.ways:
        key = (intent.bv, intent.label, way.mode, way.delay)
        matches = (t for t in templates if (t.target.state.id, t.entry.label, t.planner.mode, t.delay) == key)
        template = next(matches, None)
        if template is not None:
            numbers = template.planner.defaults() | dict(way.parameters)
            candidates.append(replace(template.proposal(None), parameters=numbers, acceleration=intent.acceleration))
    return candidates
