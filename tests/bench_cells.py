"""Cells made by hand, in the format of docs/benchmark.md."""

from __future__ import annotations

from typing import Any

Cell = dict[str, Any]


def attempt(intent: str = "Aggressive Cut-in", **given: Any) -> dict[str, Any]:
    """A feasible near miss, unless said otherwise; ``valid`` or ``strict`` make it a collision."""
    if given.get("strict"):
        given["valid"] = True
    if given.get("valid"):
        given["collided"] = True
    collided = bool(given.get("collided"))
    least = 0.0 if collided else given.get("min_ttc")
    defaults: dict[str, Any] = {
        "intent": intent, "adversaries": ["1"], "phase": "tuner", "min_ttc": least, "collided": collided,
        "critical": collided or (least is not None and least <= 1.0), "feasible": True, "rear_end": False,
        "valid": False if collided else None, "strict": False if collided else None, "failed_gates": [],
        "predicted_level": None,
    }  # fmt: skip
    return defaults | given


def cell(case: str, row: str = "expert", *tried: dict[str, Any], **given: Any) -> Cell:
    """A cell; its last attempt counts; cases called ``straight-*`` are leaders, others priority crossings."""
    straight = case.startswith("straight")
    verdict = None if not tried else {k: v for k, v in tried[-1].items() if k not in ("intent", "phase")}
    if verdict is not None and "paper_centre_distance" not in verdict:
        verdict["paper_centre_distance"] = {"minimum": 0.0 if verdict["collided"] else 9.0}
    valid = bool(verdict and verdict["valid"])
    made: Cell = {
        "schema": 1, "suite": "made", "case": case, "kind": "leader" if straight else "crossing_priority",
        "group": "straight" if straight else "intersection", "ego": "idm", "row": row, "seed": 0,
        "ending": "critical" if valid else "attempts_exhausted", "raw": {"min_ttc": None, "collided": False},
        "attempts": list(tried), "best": len(tried) - 1 if tried else None, "outcome": verdict, "realism": {},
        "intent": None, "intents": [], "recall": None, "motion": None,
        "timing": {"total": 2.0, "first_valid": 0.5 if valid else None},
        "llm": {"model": None, "calls": 0, "prompt_tokens": 0, "completion_tokens": 0, "seconds": 0.0},
    }  # fmt: skip
    return made | given


def unattacked(case: str, **outcome: Any) -> Cell:
    """A cell of the row ``raw``."""
    verdict = {"min_ttc": None, "collided": False, "critical": False} | outcome
    return cell(case, "raw", outcome=verdict, best=None)
