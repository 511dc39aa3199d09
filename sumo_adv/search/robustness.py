"""Proposals like a given one: variations of its numbers, which may be better, and which say how firm its prediction is.

A prediction is never exact. One that only just comes off tends to miss in the simulation; one whose neighbours come
off as well does not, so a proposal is weighed together with ``NEIGHBOURS`` of its own (a robust optimum; Beyer and
Sendhoff 2007, "Robust optimization"). Neighbours can be tried as well, but are not counted among what was drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from random import Random

from sumo_adv.datatypes import Proposal

SPREAD = 0.12  # of a parameter's range: standard deviation of a variation that may be better
NEAR = 0.04  # the same of a neighbour
NEIGHBOURS = 5
WORST = 1.5  # a neighbour's score above it (a miss, a rear-end) counts as this
OWN = 0.5  # weight of a proposal's own score, the rest is the mean over it and its neighbours
ALONE, OF = "alone", "neighbour"  # in ``predicted``: the score before it was firmed; whether it is a neighbour


def varied(p: Proposal, draw: Random, spread: float = SPREAD) -> Proposal:
    """With other numbers, normal around its own, within their bounds; the tuner's, whoever proposed the first one."""
    numbers = {}
    for q in p.planner.parameters:
        value = p.parameters[q.name] + draw.gauss(0.0, spread * (q.high - q.low))
        numbers[q.name] = round(min(max(value, q.low), q.high), 4)
    return replace(p, parameters=numbers, predicted={}, by="tuner")


def firm(p: Proposal) -> bool:
    """Whether its neighbours were asked, or are not worth asking: it has none, or it worked before."""
    return ALONE in p.predicted or not p.planner.parameters or p.by == "memory"


def alone(p: Proposal) -> float:
    """What is predicted for the very numbers of a proposal, whatever its neighbours make of it."""
    return float(p.predicted.get(ALONE, p.score))


def drawn(pool: Sequence[Proposal]) -> list[Proposal]:
    """The pool without neighbours."""
    return [p for p in pool if not p.predicted.get(OF)]


def firmed(
    proposals: Sequence[Proposal], score: Callable[[Sequence[Proposal]], list[Proposal]], draw: Random
) -> list[Proposal]:
    """The proposals, and their neighbours, with scores that count how the neighbours fare."""
    found = []
    near = score([varied(p, draw, NEAR) for p in proposals for _ in range(NEIGHBOURS)])
    near = [replace(p, predicted={**p.predicted, OF: True}) for p in near]
    for k, p in enumerate(proposals):
        group = [p, *near[k * NEIGHBOURS : (k + 1) * NEIGHBOURS]]
        mean = sum(min(q.score, WORST) for q in group) / len(group)
        found += [
            replace(q, score=OWN * q.score + (1.0 - OWN) * mean, predicted={**q.predicted, ALONE: q.score})
            for q in group
        ]
    return found
