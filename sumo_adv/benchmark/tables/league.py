"""The league: which of several drivers is harder to bring into a collision that counts.

One attacker meets every driver in the same encounters. The harder a driver is to hit, the more attempts it takes, and
the fewer attacks are valid. The search has a model of known drivers and must find out about others. So
the ranks of known drivers and of unknown ones stand apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any

from sumo_adv.benchmark.nouns import Cell
from sumo_adv.benchmark.tables import cells as c
from sumo_adv.benchmark.tables.columns import COLUMNS
from sumo_adv.benchmark.tables.markdown import grid, number, signed
from sumo_adv.metrics.statistics import Estimate, Paired, bootstrap, paired_bootstrap

LIKELY = 0.5  # an attempt counts as predicted to be valid from this probability on
SHOWN = ("valid", "strict", "serious", "valid_1", "kinds")
WARNING = (
    "Attempts against known and unknown drivers do not compare: the search has the rules of the known ones, and has to "
    "find out how the unknown ones drive."
)


@dataclass(frozen=True, slots=True)
class Place:
    """One driver. attempts: mean until the first valid one, where an encounter without one counts as one more than its
    budget. called: attempts that were predicted to be valid; right: the share of them that were."""

    ego: str
    known: bool
    encounters: int
    figures: dict[str, Estimate | None]
    attempts: Estimate
    called: int
    right: float | None


@dataclass(frozen=True, slots=True)
class Duel:
    """Two drivers in the same encounters: ``fewer`` and ``more`` attempts until the first valid one; the rates."""

    fewer: str
    more: str
    attempts: Paired
    valid: Paired


def league(cells: Sequence[Cell], budget: int) -> tuple[list[Place], list[Duel]]:
    """The drivers, hardest to hit first, the known ones before the others; and each pair of them."""
    by_ego = {ego: [cell for cell in cells if cell["ego"] == ego] for ego in c.names(cells, "ego")}
    places = [_place(ego, group, budget) for ego, group in by_ego.items()]
    places.sort(key=lambda p: (not p.known, -p.attempts.value))
    duels = [
        _duel(first.ego, second.ego, by_ego, budget)
        for first, second in combinations(places, 2)
        if first.known == second.known
    ]  # fmt: skip
    return places, [duel for duel in duels if duel is not None]


def to_markdown(places: Sequence[Place], duels: Sequence[Duel], title: str) -> str:
    """Both as tables, with the warning where it applies."""
    titles = {column.key: column for column in COLUMNS}
    head = ["driver", "", "attempts until valid", *(titles[k].title for k in SHOWN), "called valid", "of these valid"]
    rows = [
        [
            p.ego, "known" if p.known else "unknown", number(p.attempts, 1),
            *(number(p.figures[k], titles[k].digits) for k in SHOWN), str(p.called),
            "–" if p.right is None else f"{p.right:.2f}",
        ]
        for p in places
    ]  # fmt: skip
    lines = [f"# {title}", "", "The driver that is hardest to hit stands first.", "", *grid(head, rows)]
    if len({p.known for p in places}) > 1:
        lines += [WARNING, ""]
    pairs = [[d.more, d.fewer, signed(d.attempts, 1), signed(d.valid)] for d in duels]
    if pairs:
        lines += grid(["harder to hit", "than", "attempts until valid, difference", "valid, difference"], pairs)
    lines.append("Rates: Wilson's 95 % interval. Attempts and differences: bootstrap over encounters, paired, 95 %.")
    return "\n".join(lines) + "\n"


def document(places: Sequence[Place], duels: Sequence[Duel]) -> dict[str, Any]:
    """Both as data."""
    return {"schema": 1, "drivers": [asdict(p) for p in places], "pairs": [asdict(d) for d in duels]}


def _place(ego: str, cells: Sequence[Cell], budget: int) -> Place:
    called = [a for cell in cells for a in c.attempts(cell) if (a.get("predicted_valid") or 0.0) >= LIKELY]
    figures = {column.key: column.estimate(cells) for column in COLUMNS if column.key in SHOWN}
    right = sum(bool(a.get("valid")) for a in called) / len(called) if called else None
    is_known = all(cell.get("driver_known") is not False for cell in cells)  # None: there was no encounter
    return Place(
        ego, is_known, len(cells), figures, bootstrap([_attempts(cell, budget) for cell in cells]), len(called), right
    )


def _duel(first_ego: str, second_ego: str, by_ego: dict[str, list[Cell]], budget: int) -> Duel | None:
    """The pair with the driver that takes more attempts as ``more``; None if they met in no encounter."""
    first, second = ({c.key(cell): cell for cell in by_ego[ego]} for ego in (first_ego, second_ego))
    both = sorted(first.keys() & second.keys())
    if not both:
        return None
    a, b = ([group[k] for k in both] for group in (first, second))
    attempts = paired_bootstrap([_attempts(x, budget) for x in a], [_attempts(x, budget) for x in b])
    if attempts.difference < 0:
        return _duel(second_ego, first_ego, by_ego, budget)
    valid = paired_bootstrap(*([float(c.first_valid(x) is not None) for x in group] for group in (a, b)))
    return Duel(fewer=second_ego, more=first_ego, attempts=attempts, valid=valid)


def _attempts(cell: Cell, budget: int) -> float:
    first = c.first_valid(cell)
    return float(budget + 1 if first is None else first)
