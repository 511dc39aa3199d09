"""Scenes seen before: how far apart two are, and the nearest in which the bank holds a success (``--recall scene``).

Two scenes can be alike only with the same geometry class, the same relation of the BV to the ego and the same ego
controller.  Then the distance is Euclid's over five numbers, each divided by what counts as a clear change of it
(``SCALES``, chosen by hand: about what one step of the tuner's search moves), so 1 is one clear change of one number.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from sumo_adv.datatypes import Floats, acceleration_at
from sumo_adv.memory.records import Evidence, SceneSignature

if TYPE_CHECKING:
    from sumo_adv.memory.bank import MemoryBank

SCALES: Mapping[str, float] = MappingProxyType(
    {"ahead": 5.0, "left": 1.0, "heading": 0.2, "speed": 2.0, "ego_speed": 2.0}
)
"""m, m, rad, m/s, m/s: the BV's place in the ego's frame, its heading there, and both speeds."""

LIMIT = 1.0  # up to this distance a scene counts as seen before

_NAMES = tuple(SCALES)
_HEADING = _NAMES.index("heading")
_SCALE = np.asarray(tuple(SCALES.values()))


def signature_distance(a: SceneSignature, b: SceneSignature) -> float:
    """How far apart two scenes are, in clear changes of one number; symmetric, 0 for the same.

    ``inf`` where geometry class, relation or ego controller differ, or a number of ``SCALES`` is lacking or not finite.
    """
    if _kind(a) != _kind(b):
        return math.inf
    one, other = _numbers(a), _numbers(b)
    return math.inf if one is None or other is None else float(_distances(one[None, :], other)[0])


def recall_scene(bank: MemoryBank, signature: SceneSignature, limit: float = LIMIT) -> Evidence | None:
    """The success in a scene at most ``limit`` away: a valid collision before others, then the nearest.

    Of equally near ones the same whatever order the bank holds them in. Retired intents and planners are left out.
    """
    return bank.scenes().nearest(signature, limit)


class SceneIndex:
    """Evidence in arrays, by kind of scene. Made once for a bank's content (``MemoryBank.scenes``)."""

    def __init__(self, evidence: Sequence[Evidence]) -> None:
        found: dict[tuple[str, str, str], list[tuple[Floats, Evidence]]] = {}
        for each in evidence:
            if (numbers := _numbers(each.scene)) is not None:
                found.setdefault(_kind(each.scene), []).append((numbers, each))
        self._kinds = {kind: _columns(rows) for kind, rows in found.items()}

    def nearest(self, signature: SceneSignature, limit: float) -> Evidence | None:
        """See ``recall_scene``."""
        numbers, kind = _numbers(signature), self._kinds.get(_kind(signature))
        if numbers is None or kind is None:
            return None
        table, valid, evidence = kind
        distances = _distances(table, numbers)
        for wanted in (valid, ~valid):
            near = np.where(wanted, distances, np.inf)
            best = int(np.argmin(near))
            if near[best] <= limit:
                return evidence[best]
        return None


def _columns(rows: list[tuple[Floats, Evidence]]) -> tuple[Floats, np.ndarray, list[Evidence]]:
    """Numbers (n, 5), whether valid (n,), and the evidence, in an order that its content alone decides."""
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
    """Scaled distances of rows (n, 5) to one (5,), headings the shorter way round."""
    apart = np.abs(table - numbers)
    turned = apart[:, _HEADING] % (2.0 * math.pi)
    apart[:, _HEADING] = np.minimum(turned, 2.0 * math.pi - turned)
    scaled = apart / _SCALE
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", scaled, scaled)))
