"""The planners of a run as texts: which attempts used each, and what changed from the version it was made of."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any

MOST_LINES = 2000  # of a planner that is compared with another


def planner_versions(outcome: Mapping[str, Any], manifest: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The planners that attempts used, in the order of first use, each with a unified diff from its parent if known."""
    known: Mapping[str, Any] = manifest.get("planners") or {}
    used: dict[str, list[int]] = {}
    for attempt in outcome.get("attempts") or []:
        used.setdefault(attempt["planner"]["hash"], []).append(attempt["index"])
    counts = (manifest.get("attempt") or {}).get("planner")
    return [
        {
            "hash": name, "label": known[name]["label"], "mode": known[name]["mode"], "origin": known[name]["origin"],
            "parent": known[name]["parent"], "source": known[name]["source"], "attempts": attempts,
            "counts": name == counts, "diff": _diff(known, name),
        }
        for name, attempts in used.items() if name in known
    ]  # fmt: skip


def _diff(known: Mapping[str, Any], name: str) -> list[str] | None:
    """Lines of a unified diff without its file names; None without a parent, or for what is too long."""
    parent = known[name]["parent"]
    if parent not in known:
        return None
    before, after = (known[n]["source"].splitlines() for n in (parent, name))
    if max(len(before), len(after)) > MOST_LINES:
        return None
    return list(difflib.unified_diff(before, after, lineterm=""))[2:]
