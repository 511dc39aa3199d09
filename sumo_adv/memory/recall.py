"""Find the most similar scene with a success (``--recall scene``), and the planner of an intent to try first.

Scenes are comparable only if they have the same geometry class, the same relation of the BV to the ego and the same ego
controller. Their distance is then Euclidean over five numbers, each divided by its scale. A scale is a clear change of
that number, about one step of the search, so that distance 1 is one clear change of one number.

Planners are ordered by Thompson sampling (Thompson, 1933; Chapelle and Li, "An empirical evaluation of Thompson
sampling", 2011). Each planner's chance of success gets a Beta(1 + successes, 1 + failures) belief. One value is drawn
from each belief, and the planners are tried from the largest value down, so that planners without evidence are tried
too. Evidence from other scenes counts less: its weight is the product of the ``OTHER_*`` constants for everything that
differs.
"""

from __future__ import annotations

import json
import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sumo_adv.datatypes import Bools, Floats, Planner, acceleration_at
from sumo_adv.memory.records import Evidence, SceneSignature

SCENE_SCALES: Mapping[str, float] = {"ahead": 5.0, "left": 1.0, "heading": 0.2, "speed": 2.0, "ego_speed": 2.0}
"""The scales of a scene [m, m, rad, m/s, m/s]: position and heading of the BV in the ego's frame, and both speeds. They
were chosen by hand.
"""

MAX_SIMILAR_DISTANCE = 1.0  # two scenes at most this far apart are similar

ROUNDING_SHARE = 1e-4  # candidates are rounded to four digits, and may lie this far outside of their planner's bounds

_SIGNATURE_FIELDS = tuple(SCENE_SCALES)
_HEADING = _SIGNATURE_FIELDS.index("heading")
_SCALE = np.asarray(tuple(SCENE_SCALES.values()))
OTHER_GEOMETRY_DISTANCE = 0.3
OTHER_RELATION_DISTANCE = 0.5
OTHER_CONTROLLER_DISTANCE = 0.5


def signature_distance(a: SceneSignature, b: SceneSignature) -> float:
    """Return the distance between two scenes. It is symmetric, and 0 for equal scenes.

    Args:
        a: One scene.
        b: The other scene.

    Returns:
        The distance [-]. It is ``inf`` if geometry class, relation or ego controller differ, or if a number of
        ``SCENE_SCALES`` is absent or not finite.
    """
    if _kind(a) != _kind(b):
        return math.inf
    numbers_a, numbers_b = _numbers(a), _numbers(b)
    if numbers_a is None or numbers_b is None:
        return math.inf
    return float(_distances(numbers_a[None, :], numbers_b)[0])


def allows(planner: Planner, evidence: Evidence) -> bool:
    """Return whether evidence has exactly the parameters of a planner, each within its bounds.

    Args:
        planner: The planner.
        evidence: The evidence about it.
    """
    given = evidence.parameters
    return given.keys() == planner.defaults().keys() and all(
        p.low - ROUNDING_SHARE <= given[p.name] <= p.high + ROUNDING_SHARE for p in planner.parameters
    )


class SceneIndex:
    """Evidence in arrays, grouped by geometry class, relation and controller."""

    def __init__(self, evidence: Sequence[Evidence]) -> None:
        """Index evidence; leave out evidence whose scene lacks a number.

        Args:
            evidence: The evidence, in any order.
        """
        groups: dict[tuple[str, str, str], list[tuple[Floats, Evidence]]] = {}
        for each in evidence:
            if (numbers := _numbers(each.scene)) is not None:
                groups.setdefault(_kind(each.scene), []).append((numbers, each))
        self._kinds: dict[tuple[str, str, str], tuple[Floats, Bools, list[Evidence]]] = {}
        for kind, rows in groups.items():
            rows.sort(key=lambda row: _order(row[1]))
            table, pieces = np.stack([numbers for numbers, _ in rows]), [each for _, each in rows]
            self._kinds[kind] = table, np.asarray([each.valid is True for each in pieces]), pieces

    def nearest(self, signature: SceneSignature, limit: float = MAX_SIMILAR_DISTANCE) -> Evidence | None:
        """Return the evidence of the nearest scene; valid collisions take precedence over others.

        Ties are resolved by the content of the evidence, not by its order.

        Args:
            signature: The scene to compare with.
            limit: The maximum distance [-].

        Returns:
            The evidence, or None if no scene is near enough.
        """
        numbers, kind = _numbers(signature), self._kinds.get(_kind(signature))
        if numbers is None or kind is None:
            return None
        table, valid, evidence = kind
        distances = _distances(table, numbers)
        for selected in (valid, ~valid):
            near = np.where(selected, distances, np.inf)
            best = int(np.argmin(near))
            if near[best] <= limit:
                return evidence[best]
        return None


def _order(evidence: Evidence) -> tuple[Any, ...]:
    """Return the key by which evidence is sorted."""
    return (
        evidence.min_ttc, evidence.label, evidence.planner_hash, evidence.network, evidence.seed, evidence.delay,
        acceleration_at(evidence.acceleration, 0.0), json.dumps(dict(evidence.parameters), sort_keys=True),
        json.dumps(evidence.acceleration),
    )  # fmt: skip


def _kind(scene: SceneSignature) -> tuple[str, str, str]:
    """Return what two comparable scenes have in common."""
    return scene.geometry, scene.relation, scene.controller


def _numbers(scene: SceneSignature) -> Floats | None:
    """Return the numbers of a scene ``(5,)``, or None if one is absent or not finite."""
    values = [scene.relative.get(name, math.nan) for name in _SIGNATURE_FIELDS]
    return np.asarray(values, dtype=np.float64) if all(map(math.isfinite, values)) else None


def _distances(table: Floats, numbers: Floats) -> Floats:
    """Return the scaled distances (n,) of ``table`` (n, 5) to ``numbers`` (5,). Heading differences are wrapped."""
    apart = np.abs(table - numbers)
    turned = apart[:, _HEADING] % (2.0 * math.pi)
    apart[:, _HEADING] = np.minimum(turned, 2.0 * math.pi - turned)
    scaled = apart / _SCALE
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", scaled, scaled)))


@dataclass(frozen=True, slots=True)
class Arm:
    """One planner's weighted record and the value drawn for it.

    Attributes:
        planner: The planner.
        successes: The weighted number of successes.
        failures: The weighted number of failures.
        rows: The number of pieces of evidence.
        draw: The value drawn from its belief.
    """

    planner: Planner
    successes: float
    failures: float
    rows: int
    draw: float

    @property
    def mean(self) -> float:
        """The mean of the planner's belief."""
        return (1.0 + self.successes) / (2.0 + self.successes + self.failures)


def likeness(scene: SceneSignature, now: SceneSignature) -> float:
    """Return how much evidence from another scene counts: 1 for the same kind of scene and ego controller, never 0.

    Args:
        scene: The scene of the evidence.
        now: The present scene.
    """
    weight = 1.0 if scene.geometry == now.geometry else OTHER_GEOMETRY_DISTANCE
    weight *= 1.0 if scene.relation == now.relation else OTHER_RELATION_DISTANCE
    return weight * (1.0 if scene.controller == now.controller else OTHER_CONTROLLER_DISTANCE)


def drawn_order(
    planners: Sequence[Planner], evidence: Sequence[Evidence], signature: SceneSignature, rng: random.Random
) -> list[Arm]:
    """Order the planners of an intent, the one to try first at the front.

    The same planners and evidence, in any order, and the same state of ``rng`` give the same result.

    Args:
        planners: The planners of the intent.
        evidence: The evidence about the intent.
        signature: The present scene.
        rng: The random generator.
    """
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


def explain(arms: Sequence[Arm]) -> list[Mapping[str, Any]]:
    """Describe the result of ``drawn_order`` for the manifest.

    Args:
        arms: The planners, in their order.

    Returns:
        For each planner the mode, hash, number of evidence rows, weighted successes and failures, mean, and draw.
    """
    return [
        {
            "mode": arm.planner.mode, "planner": arm.planner.hash, "rows": arm.rows,
            "successes": round(arm.successes, 3), "failures": round(arm.failures, 3),
            "mean": round(arm.mean, 4), "draw": round(arm.draw, 4),
        }
        for arm in arms
    ]  # fmt: skip
