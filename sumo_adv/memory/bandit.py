"""Which planner of an intent to try first: Thompson sampling over the evidence.

Each planner's chance of success gets a Beta(1 + successes, 1 + failures) belief, one value is drawn from each, and they
are tried from the largest draw down (Thompson, 1933; Chapelle and Li, "An empirical evaluation of Thompson sampling",
2011).  A planner without evidence draws evenly from 0 to 1, so new ones get tried.  Evidence of other scenes counts for
less: its weight is the product of ``OTHER_*`` for all that differs.
"""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sumo_adv.datatypes import Planner
from sumo_adv.memory.records import Evidence, SceneSignature

OTHER_GEOMETRY = 0.3
OTHER_RELATION = 0.5
OTHER_CONTROLLER = 0.5


@dataclass(frozen=True, slots=True)
class Arm:
    """One planner's weighted record and the value that was drawn for it."""

    planner: Planner
    successes: float
    failures: float
    rows: int
    draw: float

    @property
    def mean(self) -> float:
        """The mean of its belief."""
        return (1.0 + self.successes) / (2.0 + self.successes + self.failures)


def likeness(scene: SceneSignature, now: SceneSignature) -> float:
    """How much evidence from ``scene`` counts in ``now``: 1 for the same kind of scene and ego, never 0."""
    weight = 1.0 if scene.geometry == now.geometry else OTHER_GEOMETRY
    weight *= 1.0 if scene.relation == now.relation else OTHER_RELATION
    return weight * (1.0 if scene.controller == now.controller else OTHER_CONTROLLER)


def draw(
    planners: Sequence[Planner], evidence: Sequence[Evidence], signature: SceneSignature, rng: random.Random
) -> list[Arm]:
    """The arms, largest draw first. The same planners, evidence and state of ``rng`` give the same, in any order."""
    weights = {planner.hash: [0.0, 0.0] for planner in planners}
    rows = dict.fromkeys(weights, 0)
    for each in sorted(evidence, key=lambda e: likeness(e.scene, signature)):
        if each.planner_hash in weights:
            weights[each.planner_hash][0 if each.success else 1] += likeness(each.scene, signature)
            rows[each.planner_hash] += 1
    arms = []
    for planner in sorted(planners, key=lambda planner: (planner.mode, planner.hash)):
        good, bad = weights[planner.hash]
        arms.append(Arm(planner, good, bad, rows[planner.hash], rng.betavariate(1.0 + good, 1.0 + bad)))
    return sorted(arms, key=lambda arm: -arm.draw)


def choose(
    planners: Sequence[Planner], evidence: Sequence[Evidence], signature: SceneSignature, rng: random.Random
) -> list[Planner]:
    """The planners of one intent, the one to try first at the front. ``evidence``: that of the intent."""
    return [arm.planner for arm in draw(planners, evidence, signature, rng)]


def explain(arms: Sequence[Arm]) -> list[Mapping[str, Any]]:
    """What ``draw`` found, for the manifest: mode, hash, evidence rows, weighted successes and failures, mean, draw."""
    return [
        {
            "mode": arm.planner.mode, "planner": arm.planner.hash, "rows": arm.rows,
            "successes": round(arm.successes, 3), "failures": round(arm.failures, 3),
            "mean": round(arm.mean, 4), "draw": round(arm.draw, 4),
        }
        for arm in arms
    ]  # fmt: skip
