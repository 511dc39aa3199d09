"""The planners of a run as texts: which attempts used each, and what changed from the version it was made of."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any

MOST_LINES = 2000  # of a planner that is compared with another


def planner_versions(outcome: Mapping[str, Any], manifest: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The planners that attempts used, in the order of first use, each with a unified diff from its parent if known."""
    planners: Mapping[str, Any] = manifest.get("planners") or {}
    used: dict[str, list[int]] = {}
    for attempt in outcome.get("attempts") or []:
        used.setdefault(attempt["planner"]["hash"], []).append(attempt["index"])
    counts = (manifest.get("attempt") or {}).get("planner")
    return [
        {
            "hash": name, "label": planners[name]["label"], "mode": planners[name]["mode"],
            "origin": planners[name]["origin"], "parent": planners[name]["parent"], "source": planners[name]["source"],
            "attempts": attempts, "counts": name == counts, "diff": _diff(planners, name),
        }
        for name, attempts in used.items() if name in planners
    ]  # fmt: skip


def _diff(planners: Mapping[str, Any], name: str) -> list[str] | None:
    """Lines of a unified diff without its file names; None without a parent, or for what is too long."""
    parent = planners[name]["parent"]
    if parent not in planners:
        return None
    before, after = (planners[n]["source"].splitlines() for n in (parent, name))
    if max(len(before), len(after)) > MOST_LINES:
        return None
    return list(difflib.unified_diff(before, after, lineterm=""))[2:]
