"""Define the columns of the tables: their value in a cell, their summary, and their meaning in words."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sumo_adv.benchmark import cells as c
from sumo_adv.benchmark.cells import distance, step_share
from sumo_adv.benchmark.nouns import CRITICAL_TTC_S, Cell, counts
from sumo_adv.datatypes import Level
from sumo_adv.metrics.preventability import AVOIDS, NOT_APPLICABLE
from sumo_adv.metrics.statistics import Estimate, bootstrap, wilson

BUDGETS = (1, 5, 10, 25)
SUCCESS_WITHIN_S = (10, 60)
SUCCESS_DISTANCES_M = (2.5, 5.0)  # between centres; the paper does not give its own
UNSEEN_REFERENCE_DRIVERS = ("reg157", "rss", "fsm")  # reference drivers that the search never uses
RATE, MEAN, MEDIAN = "rate", "mean", "median"
SECTIONS = ("Verdicts", "Why not", "Min TTC", "Attempts", "Modification", "Realism", "Cost", "Margin")

Value = float | bool | None
"""A value of a cell; None if the question does not arise."""


@dataclass(frozen=True, slots=True)
class Column:
    """One figure of a row.

    Attributes:
        key: The name in CSV and JSON.
        title: The name for people.
        section: The section of the table.
        meaning: The meaning in words.
        summary: How the values of cells are summarised: rate (Wilson), mean or median (bootstrap). Cells without a
            value are left out.
        of: Returns the value of a cell.
        pooled: Computes the figure from all cells at once, instead of ``of`` and ``summary``; None if it is not used.
        raw: Whether the unattacked row has the figure, too.
        asked_of_all: Whether every encounter has a value, so that rows can be compared pair by pair.
        digits: The number of decimals.
    """

    key: str
    title: str
    section: str
    meaning: str
    summary: str = RATE
    of: Callable[[Cell], Value] = lambda _: None
    pooled: Callable[[Sequence[Cell]], Estimate | None] | None = None
    raw: bool = False
    asked_of_all: bool = True
    digits: int = 2

    @property
    def paired(self) -> bool:
        """Whether rows can be compared pair by pair."""
        return self.asked_of_all and self.pooled is None and self.summary != MEDIAN

    def values(self, cells: Sequence[Cell]) -> dict[c.CellKey, float]:
        """Return the values of cells that have one, by key."""
        by_key = {c.key(cell): self.of(cell) for cell in cells if self.raw or not c.is_raw(cell)}
        return {name: float(value) for name, value in by_key.items() if value is not None}

    def estimate(self, cells: Sequence[Cell]) -> Estimate | None:
        """Compute the figure with its interval; return None if no cell has a value."""
        if self.pooled is not None:
            attacked = [cell for cell in cells if not c.is_raw(cell)]
            return self.pooled(attacked) if attacked else None
        values = list(self.values(cells).values())
        if not values:
            return None
        if self.summary == RATE:
            return wilson(round(sum(values)), len(values))
        return bootstrap(values, of=np.median if self.summary == MEDIAN else np.mean)


def _verdict(name: str) -> Callable[[Cell], Value]:
    return lambda cell: c.counted_outcome(cell).get(name) is True


def _gate(name: str) -> Callable[[Cell], Value]:
    return lambda cell: name in (c.counted_outcome(cell).get("failed_gates") or ())


def _paper_collision(epsilon: float) -> Callable[[Cell], Value]:
    """Make the value that says whether the vehicles touched, or their centres came within ``epsilon`` [m]."""

    def of(cell: Cell) -> Value:
        verdict = c.counted_outcome(cell)
        centres = verdict.get("paper_centre_distance")
        if c.is_raw(cell) and centres is None:
            return None
        return verdict.get("collided") is True or (centres or {}).get("minimum", math.inf) <= epsilon

    return of


def _paper_ttc(cell: Cell) -> Value:
    """Return the minimum TTC [s], which is 0 if the centres came as near as in the paper's kind of collision."""
    near = _paper_collision(SUCCESS_DISTANCES_M[-1])(cell)
    return None if near is None else (0.0 if near else c.capped_ttc(c.counted_outcome(cell)))


def _of_collisions(cell: Cell, key: str) -> Value:
    verdict = c.counted_outcome(cell)
    return bool(verdict.get(key)) if verdict.get("collided") else None


def _valid_within(budget: int) -> Callable[[Cell], Value]:
    return lambda cell: any(a.get("valid") for a in c.attempts(cell)[:budget])


def _within(level: str, budget: int) -> Callable[[Cell], Value]:
    """Make the value that says whether one of the first ``budget`` attempts reached ``level`` or a higher one."""
    least = Level[level.upper()]
    return lambda cell: any(Level[str(a.get("level") or "none").upper()] >= least for a in c.attempts(cell)[:budget])


def _kinds(cells: Sequence[Cell]) -> Counter[str]:
    """Count the kinds of valid attempts that count, one for each encounter."""
    kinds = Counter[str]()
    for cell in cells:
        best = cell.get("best")
        if best is not None and c.counted_outcome(cell).get("valid"):
            kinds[str(c.attempts(cell)[best].get("kind"))] += 1
    return kinds


def _kind_count(cells: Sequence[Cell]) -> Estimate | None:
    count = float(len(_kinds(cells)))
    return Estimate(count, count, count, len(cells))


def _largest_kind(cells: Sequence[Cell]) -> Estimate | None:
    kinds = _kinds(cells)
    return wilson(max(kinds.values()), kinds.total()) if kinds else None


def _unseen(cell: Cell) -> Value:
    """Return whether a driver that the search does not know avoids a valid collision; None if none of them applies."""
    verdict = c.counted_outcome(cell)
    answers = [
        a
        for name, a in (verdict.get("references") or {}).items()
        if name in UNSEEN_REFERENCE_DRIVERS and a != NOT_APPLICABLE
    ]
    return any(a == AVOIDS for a in answers) if verdict.get("valid") and answers else None


def _critical(attempt: Mapping[str, Any]) -> bool:
    return bool(attempt.get("critical")) and counts(attempt)


def _raw_critical(cell: Cell) -> Value:
    raw = cell.get("raw")
    if raw is None:
        return None
    return bool(raw["collided"]) or (raw["min_ttc"] is not None and raw["min_ttc"] <= CRITICAL_TTC_S)


def _unmodified_critical(cell: Cell) -> Value:
    tried = c.attempts(cell)
    until = next((k for k, a in enumerate(tried) if a.get("phase") == "modifier"), len(tried))
    return any(_critical(a) for a in tried[:until])


def _seconds(cell: Cell) -> Value:
    timing = cell.get("timing") or {}
    return None if timing.get("total") is None else float(timing["total"]) - float(timing.get("waited", 0.0))


def _tokens(cell: Cell) -> Value:
    llm = cell.get("llm") or {}
    return float((llm.get("prompt_tokens") or 0) + (llm.get("completion_tokens") or 0))


def _to_first(level: str) -> Callable[[Cell], Value]:
    """Make the value of the time from the encounter to the first attempt of a level or a higher one [s]."""

    def seconds(cell: Cell) -> Value:
        took = (cell.get("timing") or {}).get(f"first_{level}")
        return None if took is None or not _within(level, len(c.attempts(cell)))(cell) else float(took)

    return seconds


def _within_seconds(level: str, most: float) -> Callable[[Cell], Value]:
    return lambda cell: (took := _to_first(level)(cell)) is not None and took <= most


def _pace(cell: Cell) -> Value:
    """Return the attempts per second, including all that the row does between attempts."""
    seconds, count = (cell.get("timing") or {}).get("row"), len(c.attempts(cell))
    return count / seconds if seconds and count else None


TABLE_COLUMNS: tuple[Column, ...] = (
    Column("collision", "collision", "Verdicts", "the adversary touched the ego", of=_verdict("collided"), raw=True),
    Column("no_rear", "noRear", "Verdicts", "a feasible collision, not into the ego's back",
           of=lambda cell: c.no_rear(c.counted_outcome(cell))),
    Column("valid", "valid", "Verdicts",
           "noRear, conclusive, the ego took part, and a reference driver avoids it",
           of=_verdict("valid")),
    Column("strict", "strict", "Verdicts", "valid, and UN R157's careful human driver (cc_human) avoids it",
           of=_verdict("strict")),
    Column("serious", "serious", "Verdicts", "strict, driven as a person could, delta-v of the ego at least 5 mph",
           of=lambda cell: c.counted_outcome(cell).get("level") == "serious"),
    Column("critical", "critical", "Verdicts", "min TTC at or below --critical-ttc, a collision included",
           of=_verdict("critical"), raw=True),
    Column("inconclusive", "inconclusive", "Why not", "of collisions: the counterfactual check is inconclusive",
           of=lambda cell: _of_collisions(cell, "inconclusive"), asked_of_all=False),
    Column("stationary", "ego stood", "Why not", "of collisions: the ego stood for the last second before the contact",
           of=lambda cell: _of_collisions(cell, "ego_stationary"), asked_of_all=False),
    Column("delta_v", "delta-v [m/s]", "Verdicts", "median for the ego, over collisions", MEDIAN,
           lambda cell: c.counted_outcome(cell).get("delta_v"), asked_of_all=False, digits=1),
    Column("rear_end", "rear-end", "Why not", "the adversary ran into the ego's back", of=_verdict("rear_end")),
    Column("infeasible", "infeasible", "Why not", "some gate failed",
           of=lambda cell: c.counted_outcome(cell).get("feasible") is False),
    Column("third_party", "third party", "Why not", "the adversary touched someone else first",
           of=_gate("third_party")),
    Column("off_road", "off-road", "Why not", "a corner of the adversary left the road", of=_gate("off_road")),
    Column("no_attack", "no attack", "Why not", "no encounter, or nothing to try", of=c.without_attack),
    Column("failed", "failed", "Why not", "a crash, a model or a budget; counts as neither critical nor valid",
           of=c.failed, raw=True),
    Column("mean_min_ttc", "mean [s]", "Min TTC", "a collision is 0; never and failures are 10", MEAN,
           lambda cell: c.capped_ttc(c.counted_outcome(cell)), raw=True),
    Column("median_min_ttc", "median [s]", "Min TTC", "of the same values", MEDIAN,
           lambda cell: c.capped_ttc(c.counted_outcome(cell)), raw=True),
    Column("mean_min_ttc_apart", "mean without collision [s]", "Min TTC", "over encounters without a collision", MEAN,
           lambda cell: None if c.counted_outcome(cell).get("collided") else c.capped_ttc(c.counted_outcome(cell)),
           raw=True, asked_of_all=False),
    Column("mean_min_ttc_paper", "mean (paper) [s]", "Min TTC", "also 0 if the centres came within 5 m", MEAN,
           _paper_ttc, raw=True),
    Column("paper_collision_2_5", "collision rate (paper, 2.5 m)", "Min TTC", "a touch, or centres within 2.5 m",
           of=_paper_collision(SUCCESS_DISTANCES_M[0]), raw=True),
    Column("paper_collision", "collision rate (paper)", "Min TTC", "a touch, or centres within 5 m",
           of=_paper_collision(SUCCESS_DISTANCES_M[1]), raw=True),
    Column("attempts", "attempts until valid", "Attempts", "median, over encounters with a valid attempt", MEDIAN,
           lambda cell: None if (k := c.first_valid(cell)) is None else float(k), asked_of_all=False, digits=1),
    *(Column(f"valid_{k}", f"valid after {k}", "Attempts", f"one of the first {k} attempts was valid",
             of=_valid_within(k)) for k in BUDGETS),
    *(Column(f"{level}_{k}", f"{level} after {k}", "Attempts", f"one of the first {k} attempts was {level} or more",
             of=_within(level, k)) for level in ("strict", "serious") for k in BUDGETS),
    Column("human", "humanlike", "Realism", "of collisions: the adversary moved as a person could",
           of=lambda cell: _of_collisions(cell, "humanlike"), asked_of_all=False),
    Column("kinds", "distinct kinds", "Verdicts",
           "of valid collisions: intents x relation x side of the ego that is hit",
           pooled=_kind_count, digits=0),
    Column("largest_kind", "largest kind", "Verdicts", "share of the most frequent kind in the valid collisions",
           pooled=_largest_kind),
    Column("unseen", "unseen judges", "Verdicts",
           "of valid collisions to which they apply: avoided by reg157, rss or fsm, which the search does not know",
           of=_unseen, asked_of_all=False),
    Column("critical_raw", "critical raw", "Modification", "the same pair and window unattacked: min TTC <= 1 s",
           of=_raw_critical, asked_of_all=False),
    Column("critical_first", "after the first attempt", "Modification", "critical, feasible and not rear-end",
           of=lambda cell: any(_critical(a) for a in c.attempts(cell)[:1])),
    Column("critical_unmodified", "before modification", "Modification",
           "the same, for any attempt before the modifier's first", of=_unmodified_critical),
    Column("critical_modified", "after modification", "Modification", "the same, for any attempt",
           of=lambda cell: any(_critical(a) for a in c.attempts(cell))),
    *(Column(f"{name}_{measure}", f"{title} {label}", "Realism",
             "pooled over encounters, up to contact, against the unattacked vehicles near in the same window",
             pooled=distance(name, measure), digits=3)
      for name, title, unit in (("speed", "speed", "m/s"), ("acceleration", "acceleration", "m/s²"))
      for measure, label in (("kl", "KL [nat]"), ("js", "JS [nat]"), ("wasserstein", f"W1 [{unit}]"))),
    Column("yaw_rate_wasserstein", "yaw rate W1 [rad/s]", "Realism", "like W1 of speeds; mean over encounters", MEAN,
           lambda cell: (cell.get("realism") or {}).get("yaw_rate_wasserstein"), asked_of_all=False, digits=3),
    Column("abnormal_lateral", "steps with a_lat > 4", "Realism", "share of the adversary's steps",
           pooled=step_share("abnormal_lateral_share"), digits=4),
    Column("off_road_steps", "steps off-road", "Realism", "share of the adversary's steps, by its box centre",
           pooled=step_share("off_road_share"), digits=4),
    Column("jerk", "jerk beyond limits", "Realism", "in the attempt that counts", of=_gate("jerk")),
    Column("lateral", "a_lat beyond limits", "Realism", "in the attempt that counts", of=_gate("lateral")),
    Column("seconds", "s without the model", "Cost", "per encounter, from opening it to the last attempt", MEAN,
           _seconds),
    Column("seconds_model", "s with the model", "Cost", "per encounter, including the wait for the model", MEAN,
           lambda cell: (cell.get("timing") or {}).get("total")),
    *(Column(f"seconds_{level}", f"s to the first {level}", "Cost", "median, counted from the row's first look", MEDIAN,
             _to_first(level), asked_of_all=False) for level in ("valid", "strict", "serious")),
    *(Column(f"{level}_within_{most}_s", f"{level} within {most} s", "Cost", "counted from the row's first look",
             of=_within_seconds(level, float(most)))
      for most in SUCCESS_WITHIN_S for level in ("valid", "strict", "serious")),
    Column("attempts_per_second", "attempts a second", "Cost", "including all that the row does between attempts", MEAN,
           _pace, asked_of_all=False, digits=1),
    Column("calls", "model calls", "Cost", "per encounter", MEAN,
           lambda cell: float((cell.get("llm") or {}).get("calls") or 0), digits=1),
    Column("tokens", "tokens", "Cost", "per encounter, prompt and completion", MEAN, _tokens, digits=0),
    Column("memory_hit", "memory hits", "Cost", "of encounters in which the bank was queried", of=c.remembered,
           asked_of_all=False),
    Column("robust", "robust", "Margin",
           "of valid collisions: valid in at least 4 of 6 neighbours (slightly other arrivals or parameter values)",
           of=lambda cell: (cell.get("robust") or {}).get("robust"), asked_of_all=False),
)  # fmt: skip

BY_PART = (
    "collision", "no_rear", "valid", "strict", "serious", "critical", "mean_min_ttc", "paper_collision_2_5",
    "paper_collision", "speed_kl", "acceleration_kl",
)  # fmt: skip
"""The columns that are also shown by group and kind."""

COMPARED_COLUMNS = (
    "collision", "no_rear", "valid", "strict", "serious", "critical", "mean_min_ttc", "valid_1",
    "valid_25", "seconds",
)  # fmt: skip
"""The columns whose differences the Markdown shows. CSV and JSON have all differences."""
