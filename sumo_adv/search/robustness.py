"""How robust a candidate is: it is weighed together with neighbours that have slightly different parameters.

A prediction is never exact. A contact that only just happens tends to become a miss in the simulation. A contact
that the neighbours make as well does not (a robust optimum; Beyer and Sendhoff 2007, "Robust optimization").
Neighbours can be tried as well, but they do not count among the candidates that were drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from random import Random

from sumo_adv.datatypes import Proposal
from sumo_adv.search.sampling import varied
from sumo_adv.search.settings import RobustnessSettings


def is_robust(p: Proposal) -> bool:
    """Whether its neighbours were predicted, or need not be: it has no parameters, or it succeeded before."""
    return p.nominal is not None or not p.planner.parameters or p.by == "memory"


def drawn(pool: Sequence[Proposal]) -> list[Proposal]:
    """The pool without neighbours."""
    return [p for p in pool if not p.is_neighbour]


def weighed_with_neighbours(
    proposals: Sequence[Proposal],
    score: Callable[[Sequence[Proposal]], list[Proposal]],
    random: Random,
    settings: RobustnessSettings,
) -> list[Proposal]:
    """Each candidate followed by its neighbours, all with scores that count how the neighbours do.

    Where a candidate's score is the expected one over several drivers, its neighbours are taken to differ from their
    nominal score by as much.
    """
    count, weighed = settings.neighbours, list[Proposal]()
    near = score([varied(p, random, settings.spread) for p in proposals for _ in range(count)])
    for k, p in enumerate(proposals):
        by_drivers = p.score - p.nominal_score
        around = near[k * count : (k + 1) * count]
        group = [
            p, *(replace(q, is_neighbour=True, score=q.score + by_drivers, nominal=q.nominal_score) for q in around)
        ]  # fmt: skip
        mean = sum(min(q.score, settings.worst) for q in group) / len(group)
        weighed += [
            replace(q, score=settings.own * q.score + (1.0 - settings.own) * mean, nominal=q.nominal_score)
            for q in group
        ]
    return weighed
