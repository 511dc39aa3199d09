"""Make two further tables: which driver is harder to bring into a valid collision, and how the bank grows.

League: One attacker meets every driver in the same encounters. The harder a driver is to hit, the more attempts are
needed, and the fewer attacks are valid. The search has a model of known drivers but must learn how others drive, so
known and unknown drivers are ranked separately.

Growth: Memory hits and times over a sequence of encounters while a row learns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.benchmark import cells as c
from sumo_adv.benchmark.cells import counted_outcome, first_valid, remembered
from sumo_adv.benchmark.columns import TABLE_COLUMNS
from sumo_adv.benchmark.nouns import Cell, SuiteCase
from sumo_adv.benchmark.table import grid, number, signed
from sumo_adv.benchmark.write import MAIN, TABLE_SCHEMA, aligned, as_csv, as_json, on_screen, plain, rate, write_files
from sumo_adv.datatypes import Level
from sumo_adv.metrics.statistics import Estimate, Paired, bootstrap, paired_means, paired_rates, wilson

VALID_LEVELS = tuple(str(level) for level in Level if level >= Level.VALID)
LEAGUE_COLUMNS = ("valid", "strict", "serious", "valid_1", "kinds")
WARNING = (
    "Attempts against known and unknown drivers cannot be compared: the search has the rules of the known ones, and "
    "has to find out how the unknown ones drive."
)


@dataclass(frozen=True, slots=True)
class LeaguePlace:
    """One driver.

    Attributes:
        ego: The driver.
        known: Whether the search has a model of the driver.
        encounters: The number of encounters.
        figures: The figures of ``LEAGUE_COLUMNS``.
        attempts: The mean number of attempts until the first valid one. An encounter without a valid attempt counts as
            one more than the budget.
        called: The number of attempts that were predicted to be valid.
        right: The share of these attempts that were valid; None if there were none.
    """

    ego: str
    known: bool
    encounters: int
    figures: dict[str, Estimate | None]
    attempts: Estimate
    called: int
    right: float | None


@dataclass(frozen=True, slots=True)
class Duel:
    """Two drivers in the same encounters.

    Attributes:
        fewer: The driver that needs fewer attempts until the first valid one.
        more: The driver that needs more attempts.
        attempts: The difference of attempts, ``more`` - ``fewer``.
        valid: The difference of the rates of valid attacks.
    """

    fewer: str
    more: str
    attempts: Paired
    valid: Paired


def league(cells: Sequence[Cell], budget: int) -> tuple[list[LeaguePlace], list[Duel]]:
    """Rank drivers.

    Args:
        cells: The cells of one row against several drivers.
        budget: The maximum number of attempts in an encounter.

    Returns:
        The drivers, known ones first, the hardest to hit first; and the pairs of known and of unknown drivers.
    """
    by_ego = {ego: [cell for cell in cells if cell["ego"] == ego] for ego in c.names(cells, "ego")}
    places = [_place(ego, group, budget) for ego, group in by_ego.items()]
    places.sort(key=lambda p: (not p.known, -p.attempts.value))
    duels = [
        _duel(first.ego, second.ego, by_ego, budget)
        for first, second in combinations(places, 2)
        if first.known == second.known
    ]  # fmt: skip
    return places, [duel for duel in duels if duel is not None]


def to_markdown(places: Sequence[LeaguePlace], duels: Sequence[Duel], title: str) -> str:
    """Format the league as Markdown."""
    titles = {column.key: column for column in TABLE_COLUMNS}
    head = [
        "driver",
        "",
        "attempts until valid",
        *(titles[k].title for k in LEAGUE_COLUMNS),
        "called valid",
        "of these valid",
    ]
    rows = [
        [
            p.ego, "known" if p.known else "unknown", number(p.attempts, 1),
            *(number(p.figures[k], titles[k].digits) for k in LEAGUE_COLUMNS), str(p.called),
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


def league_text(places: Sequence[LeaguePlace], title: str, file: Path) -> str:
    """Format the league for the terminal: the drivers, the hardest to hit first."""
    levels = MAIN[1:]
    rows = [
        [p.ego, "known" if p.known else "unknown", plain(p.attempts), *(rate(p.figures[k]) for k in levels)]
        for p in places
    ]
    sections = [("", aligned(["driver", "", "attempts", *levels], rows))]
    return on_screen(title, sections, ["Attempts: mean until the first valid one."], file)


def write_league(
    places: Sequence[LeaguePlace], duels: Sequence[Duel], title: str, cells: Sequence[Cell], folder: Path,
    about: Mapping[str, Any],
) -> list[Path]:  # fmt: skip
    """Write ``league.md``, ``.json`` and ``league.manifest.json``.

    Args:
        places: The drivers.
        duels: The pairs.
        title: The title.
        cells: The cells that it was made of.
        folder: The folder.
        about: What the manifest says about the table.

    Returns:
        The files.

    Raises:
        UsageError: A file cannot be written.
    """
    document = {"schema": 1, "drivers": [asdict(p) for p in places], "pairs": [asdict(d) for d in duels]}
    texts = {".md": to_markdown(places, duels, title), ".json": as_json(document)}
    return write_files(folder, "league", texts, cells, about)


def _place(ego: str, cells: Sequence[Cell], budget: int) -> LeaguePlace:
    """Compute the figures of one driver."""
    called = [a for cell in cells for a in c.attempts(cell) if a["predicted_level"] in VALID_LEVELS]
    figures = {column.key: column.estimate(cells) for column in TABLE_COLUMNS if column.key in LEAGUE_COLUMNS}
    right = sum(bool(a.get("valid")) for a in called) / len(called) if called else None
    is_known = all(cell.get("driver_known") is not False for cell in cells)  # None: there was no encounter
    return LeaguePlace(
        ego, is_known, len(cells), figures, bootstrap([_attempts(cell, budget) for cell in cells]), len(called), right
    )


def _duel(first_ego: str, second_ego: str, by_ego: dict[str, list[Cell]], budget: int) -> Duel | None:
    """Compare two drivers; the one that needs more attempts is ``more``. Return None if they met in no encounter."""
    first, second = ({c.key(cell): cell for cell in by_ego[ego]} for ego in (first_ego, second_ego))
    both = sorted(first.keys() & second.keys())
    if not both:
        return None
    a, b = ([group[k] for k in both] for group in (first, second))
    attempts = paired_means([_attempts(x, budget) for x in a], [_attempts(x, budget) for x in b])
    if attempts.difference < 0:
        return _duel(second_ego, first_ego, by_ego, budget)
    valid = paired_rates(*([c.first_valid(x) is not None for x in group] for group in (a, b)))
    return Duel(fewer=second_ego, more=first_ego, attempts=attempts, valid=valid)


def _attempts(cell: Cell, budget: int) -> float:
    """Return the number of attempts until the first valid one; budget + 1 if there is none."""
    first = c.first_valid(cell)
    return float(budget + 1 if first is None else first)


# -- growth of the bank


MOVING_MEAN_ENCOUNTERS = 10  # in the window of a moving mean
THIRDS = ("first third", "second third", "last third")


@dataclass(frozen=True, slots=True)
class Step:
    """One encounter in the sequence of a row.

    Attributes:
        row: The row.
        ego: The ego's driver.
        seed: The seed.
        place: The position in the suite, from 1.
        case: The encounter.
        hit: Whether the bank had the attack; None if it was not asked.
        hit_rate: The share of hits so far; None if the bank was never asked.
        seconds: The time of the row, including the model [s]; None if there was no encounter.
        seconds_window: The mean time of the last 10 encounters [s]; None if there is none.
        calls: The number of calls of a model.
        attempts_to_valid: The number of attempts until the first valid one; None if there is none.
        valid: Whether the attempt that counts is valid.
    """

    row: str
    ego: str
    seed: int
    place: int
    case: str
    hit: bool | None
    hit_rate: float | None
    seconds: float | None
    seconds_window: float | None
    calls: int
    attempts_to_valid: int | None
    valid: bool


def growth(cells: Sequence[Cell], cases: Sequence[SuiteCase]) -> list[Step]:
    """Return the steps of every row, ego and seed.

    Args:
        cells: The cells.
        cases: The encounters, in the suite's order.

    Returns:
        The steps, each sequence in the suite's order. Missing cells leave a gap in ``place``.
    """
    place = {case.name: k for k, case in enumerate(cases, 1)}
    lines: dict[tuple[str, str, int], list[Cell]] = {}
    for cell in cells:
        if cell["case"] in place:
            lines.setdefault((cell["row"], cell["ego"], cell["seed"]), []).append(cell)
    steps = []
    for own_cells in lines.values():
        hits: list[bool] = []
        seconds: list[float] = []
        for cell in sorted(own_cells, key=lambda c: place[c["case"]]):
            steps.append(_step(cell, place[cell["case"]], hits, seconds))
    return steps


def _step(cell: Cell, place: int, hits: list[bool], seconds: list[float]) -> Step:
    """Make the step of a cell; append to ``hits`` and ``seconds``, which hold the values so far."""
    timing, hit = cell.get("timing") or {}, remembered(cell)
    took = timing.get("row")
    hits += [] if hit is None else [hit]
    seconds += [] if took is None else [float(took)]
    return Step(
        cell["row"], cell["ego"], cell["seed"], place, cell["case"], hit,
        float(np.mean(hits)) if hits else None, took,
        float(np.mean(seconds[-MOVING_MEAN_ENCOUNTERS:])) if seconds else None,
        int((cell.get("llm") or {}).get("calls") or 0), first_valid(cell), counted_outcome(cell).get("valid") is True,
    )  # fmt: skip


def write_growth(steps: Sequence[Step], cells: Sequence[Cell], folder: Path, about: Mapping[str, Any]) -> list[Path]:
    """Write ``growth.md``, ``.csv``, ``.json`` and ``growth.manifest.json``.

    Args:
        steps: The steps.
        cells: The cells that they were made of.
        folder: The folder.
        about: What the manifest says about the table.

    Returns:
        The files.

    Raises:
        UsageError: A file cannot be written.
    """
    rows = [asdict(step) for step in steps]
    texts = {
        ".md": _to_markdown(steps, about["suite"]), ".csv": as_csv(list(Step.__dataclass_fields__), rows),
        ".json": as_json({"schema": TABLE_SCHEMA, "steps": rows, "thirds": _plain(thirds(steps))}),
    }  # fmt: skip
    return write_files(folder, "growth", texts, cells, about)


def _plain(thirds: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [{k: asdict(v) if isinstance(v, Estimate) else v for k, v in third.items()} for third in thirds]


def thirds(steps: Sequence[Step]) -> list[dict[str, Any]]:
    """Summarise each third of each sequence.

    Args:
        steps: The steps.

    Returns:
        A dict for each row, ego, seed and third: ``n``, and ``hits``, ``seconds``, ``calls`` and ``valid`` as
            estimates, which are None if there is nothing to estimate.
    """
    rows = []
    for row, ego, seed in dict.fromkeys((s.row, s.ego, s.seed) for s in steps):
        own_steps = [s for s in steps if (s.row, s.ego, s.seed) == (row, ego, seed)]
        for name, third in zip(THIRDS, np.array_split(np.arange(len(own_steps)), 3), strict=True):
            if third.size:
                rows.append(
                    {"row": row, "ego": ego, "seed": seed, "encounters": name, **_third([own_steps[k] for k in third])}
                )
    return rows


def _third(steps: Sequence[Step]) -> dict[str, Any]:
    hits = [s.hit for s in steps if s.hit is not None]
    seconds = [s.seconds for s in steps if s.seconds is not None]
    return {
        "n": len(steps), "hits": wilson(sum(hits), len(hits)) if hits else None,
        "seconds": bootstrap(seconds) if seconds else None, "calls": bootstrap([s.calls for s in steps]),
        "valid": wilson(sum(s.valid for s in steps), len(steps)),
    }  # fmt: skip


def _to_markdown(steps: Sequence[Step], suite: str) -> str:
    rows = [
        [f"`{t['row']}`", t["ego"], str(t["seed"]), t["encounters"], str(t["n"]), number(t["hits"]),
         number(t["seconds"]), number(t["calls"], 1), number(t["valid"])]
        for t in thirds(steps)
    ]  # fmt: skip
    head = ["row", "ego", "seed", "encounters", "n", "memory hits", "s", "model calls", "valid"]
    return "\n".join([f"# Growth of the bank over {suite}", "", *grid(head, rows)])
