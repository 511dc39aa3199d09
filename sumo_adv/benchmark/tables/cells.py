"""Reading a cell: what counts of it, in one place, so that all tables count the same.

A failure is a cell too: it counts as neither a collision nor critical nor valid, with the largest min TTC.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sumo_adv.benchmark.nouns import GROUPS, Cell, counts
from sumo_adv.datatypes import Ending

RAW, ORACLE = "raw", "oracle"
CAP = 10.0  # s: a min TTC of never, and the most any counts
FAILED = frozenset(
    {
        Ending.SIMULATION_FAILED, Ending.PLANNER_FAILED, Ending.MODEL_FAILED, Ending.BUDGET_EXHAUSTED, Ending.EGO_LOST,
        Ending.INTERRUPTED,
    }
)  # fmt: skip

Key = tuple[str, int]
"""Case and seed: what two rows are paired by."""


def key(cell: Cell) -> Key:
    """What the cell is paired by."""
    return str(cell["case"]), int(cell["seed"])


def is_raw(cell: Cell) -> bool:
    """Whether there was no attack."""
    return bool(cell["row"] == RAW)


def failed(cell: Cell) -> bool:
    """Whether the work failed (a crash, a model, a budget); what it came to until then does not count."""
    return cell["ending"] in FAILED


def without_attack(cell: Cell) -> bool:
    """Whether no attempt was made although nothing failed: no encounter, or nothing to try."""
    return not failed(cell) and not is_raw(cell) and cell.get("best") is None


def counted(cell: Cell) -> Mapping[str, Any]:
    """The verdict that counts; empty for a failure and where no attempt was made."""
    return {} if failed(cell) else cell.get("outcome") or {}


def attempts(cell: Cell) -> Sequence[Mapping[str, Any]]:
    """The attempts that count; none of a failure."""
    return () if failed(cell) else cell.get("attempts") or ()


def no_rear(verdict: Mapping[str, Any]) -> bool:
    """A feasible collision in which the adversary does not run into the ego's back."""
    return bool(verdict.get("collided")) and counts(verdict)


def capped_ttc(verdict: Mapping[str, Any]) -> float:
    """Min TTC [s]: 0 for a collision, at most 10, which is never too."""
    if verdict.get("collided"):
        return 0.0
    given = verdict.get("min_ttc")
    return CAP if given is None or math.isinf(given) else min(float(given), CAP)


def first_valid(cell: Cell) -> int | None:
    """How many attempts it took until one was valid, from 1; None if none was."""
    return next((k for k, a in enumerate(attempts(cell), 1) if a.get("valid")), None)


def remembered(cell: Cell) -> bool | None:
    """Whether the bank had it: with ``recall = scene`` an attack on a like scene, else the intent. None: not asked."""
    intent, recall = cell.get("intent") or {}, cell.get("recall")
    if recall is None:
        return None
    if intent.get("recall") == "scene":
        return any(a.get("by") == "memory" for a in (cell.get("attempts") or ())[:1])
    return bool(recall == "hit")


def parts(cells: Iterable[Cell]) -> dict[str, list[Cell]]:
    """The cells altogether (``all``), by group, and by kind; parts without a cell are left out."""
    every = list(cells)
    by_part = {"all": every} | {group: [c for c in every if c["group"] == group] for group in GROUPS}
    for kind in dict.fromkeys(str(c["kind"]) for c in every):
        if kind not in by_part:
            by_part[kind] = [c for c in every if c["kind"] == kind]
    return {name: part for name, part in by_part.items() if part}


def names(cells: Iterable[Cell], what: str) -> list[str]:
    """The values of a key (``ego``, ``row``, ``case``), in order of appearance."""
    return list(dict.fromkeys(str(c[what]) for c in cells))
