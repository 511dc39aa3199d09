"""Each ego of a campaign against what its episodes came to: rates with intervals, severity of the collisions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from sumo_adv.datatypes import Level
from sumo_adv.metrics.severity import Severity
from sumo_adv.metrics.statistics import Estimate, wilson
from sumo_adv.report.run_outcome import level_of

LEVELS = (Level.CRITICAL, Level.COLLISION, Level.VALID, Level.STRICT, Level.SERIOUS)


@dataclass(frozen=True, slots=True)
class EgoSummary:
    """An ego's episodes. All rates have all ``episodes`` below them, failed ones too.

    reached: for each of ``LEVELS`` the share of episodes that reached at least this level. failed: the share of failed
    episodes. severity: how many collisions that reached ``valid`` had each severity. delta_v: their median [m/s], None
    without any.
    """

    ego: str
    episodes: int
    reached: tuple[Estimate, ...]
    failed: Estimate
    severity: Mapping[str, int]
    delta_v: float | None


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[EgoSummary]:
    """A summary for each ego, in the order of their names."""
    return [_of(ego, [row for row in rows if row["ego"] == ego]) for ego in sorted({str(row["ego"]) for row in rows})]


def _of(ego: str, rows: Sequence[Mapping[str, Any]]) -> EgoSummary:
    total, levels = len(rows), [level_of(row["level"] or None) for row in rows]
    hits = [row for row, level in zip(rows, levels, strict=True) if level >= Level.VALID]
    counted = Counter(row["severity"] for row in hits)
    speeds = [row["delta_v"] for row in hits if row["delta_v"] is not None]
    return EgoSummary(
        ego, total, tuple(wilson(sum(level >= least for level in levels), total) for least in LEVELS),
        wilson(sum(bool(row["failure"]) for row in rows), total), {str(name): counted[name] for name in Severity},
        median(speeds) if speeds else None,
    )  # fmt: skip
