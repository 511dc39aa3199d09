"""The distance between two scenes, and the most similar scene with a success (``--recall scene``).

Scenes are comparable only with the same geometry class, the same relation of the BV to the ego and the same ego
controller. The distance is then Euclidean over five numbers, each divided by its scale. A scale is a clear change of
that number, about one step of the search, so distance 1 is one clear change of one number.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from sumo_adv.datatypes import Floats, Planner, acceleration_at
from sumo_adv.memory.records import Evidence, SceneSignature

SCALES: Mapping[str, float] = MappingProxyType(
    {"ahead": 5.0, "left": 1.0, "heading": 0.2, "speed": 2.0, "ego_speed": 2.0}
)
"""[m, m, rad, m/s, m/s]: position of the BV in the ego's frame, its heading there, and both speeds. Chosen by hand."""

LIMIT = 1.0  # the distance up to which two scenes count as similar

ROUNDED = 1e-4  # candidates are rounded to four digits, and may lie that far outside of their planner's bounds

_NAMES = tuple(SCALES)
_HEADING = _NAMES.index("heading")
_SCALE = np.asarray(tuple(SCALES.values()))


def signature_distance(a: SceneSignature, b: SceneSignature) -> float:
    """The distance between two scenes: symmetric, 0 for equal scenes.

    It is ``inf`` if geometry class, relation or ego controller differ, or if a number of ``SCALES`` is absent or not
    finite.
    """
    if _kind(a) != _kind(b):
        return math.inf
    numbers_a, numbers_b = _numbers(a), _numbers(b)
    if numbers_a is None or numbers_b is None:
        return math.inf
    return float(_distances(numbers_a[None, :], numbers_b)[0])


def allows(planner: Planner, evidence: Evidence) -> bool:
    """Whether evidence gives each parameter of its planner, no other one, and each within its bounds."""
    given = evidence.parameters
    return given.keys() == planner.defaults().keys() and all(
        p.low - ROUNDED <= given[p.name] <= p.high + ROUNDED for p in planner.parameters
    )


class SceneIndex:
    """Evidence in arrays, grouped by geometry class, relation and controller."""

    def __init__(self, evidence: Sequence[Evidence]) -> None:
        groups: dict[tuple[str, str, str], list[tuple[Floats, Evidence]]] = {}
        for each in evidence:
            if (numbers := _numbers(each.scene)) is not None:
                groups.setdefault(_kind(each.scene), []).append((numbers, each))
        self._kinds = {kind: _columns(rows) for kind, rows in groups.items()}

    def nearest(self, signature: SceneSignature, limit: float = LIMIT) -> Evidence | None:
        """The evidence of the nearest scene at most ``limit`` away; valid collisions have precedence over others.

        Ties are resolved by the content of the evidence, not by its order.
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


def _columns(rows: list[tuple[Floats, Evidence]]) -> tuple[Floats, np.ndarray, list[Evidence]]:
    """Numbers (n, 5), validity (n,) and the evidence, sorted by the content of the evidence."""
    rows = sorted(rows, key=lambda row: _order(row[1]))
    table = np.stack([numbers for numbers, _ in rows])
    return table, np.asarray([each.valid is True for _, each in rows]), [each for _, each in rows]


def _order(evidence: Evidence) -> tuple[float, str, str, str, int, float, float, str, str]:
    return (
        evidence.min_ttc, evidence.label, evidence.planner_hash, evidence.network, evidence.seed, evidence.delay,
        acceleration_at(evidence.acceleration, 0.0), json.dumps(dict(evidence.parameters), sort_keys=True),
        json.dumps(evidence.acceleration),
    )  # fmt: skip


def _kind(scene: SceneSignature) -> tuple[str, str, str]:
    return scene.geometry, scene.relation, scene.controller


def _numbers(scene: SceneSignature) -> Floats | None:
    values = [scene.relative.get(name, math.nan) for name in _NAMES]
    return np.asarray(values, dtype=np.float64) if all(map(math.isfinite, values)) else None


def _distances(table: Floats, numbers: Floats) -> Floats:
    """Scaled distances (n,) of ``table`` (n, 5) to ``numbers`` (5,). Headings differ by the smaller angle."""
    apart = np.abs(table - numbers)
    turned = apart[:, _HEADING] % (2.0 * math.pi)
    apart[:, _HEADING] = np.minimum(turned, 2.0 * math.pi - turned)
    scaled = apart / _SCALE
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", scaled, scaled)))
