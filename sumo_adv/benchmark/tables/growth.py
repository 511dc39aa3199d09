"""How the bank grows over a sequence of encounters: hits and seconds as a row learns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.benchmark.nouns import Case, Cell
from sumo_adv.benchmark.tables.cells import counted, first_valid, remembered
from sumo_adv.benchmark.tables.markdown import grid, number
from sumo_adv.benchmark.tables.write import SCHEMA, About, as_csv, as_json, manifest, write_texts
from sumo_adv.metrics.statistics import Estimate, bootstrap, wilson

WINDOW = 10  # encounters of a moving figure
THIRDS = ("first third", "second third", "last third")
COLUMNS = (
    "row", "ego", "seed", "place", "case", "hit", "hit_rate", "seconds", "seconds_window", "calls", "attempts_to_valid",
    "valid",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Step:
    """One encounter in its place (from 1). ``hit_rate``: so far; ``seconds_window``: mean of the last 10 encounters.

    ``seconds``: of the row, the model included; None where there was no encounter.
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


def growth(cells: Sequence[Cell], cases: Sequence[Case]) -> list[Step]:
    """The steps of every row, ego and seed, each in the suite's order. Cells that are missing leave a gap in place."""
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
    """The step of a cell; ``hits`` and ``seconds`` are those so far, and grow."""
    timing, hit = cell.get("timing") or {}, remembered(cell)
    took = timing.get("row")
    hits += [] if hit is None else [hit]
    seconds += [] if took is None else [float(took)]
    return Step(
        cell["row"], cell["ego"], cell["seed"], place, cell["case"], hit,
        float(np.mean(hits)) if hits else None, took, float(np.mean(seconds[-WINDOW:])) if seconds else None,
        int((cell.get("llm") or {}).get("calls") or 0), first_valid(cell), counted(cell).get("valid") is True,
    )  # fmt: skip


def write_growth(
    steps: Sequence[Step], cells: Sequence[Cell], folder: Path, about: About, name: str = "growth"
) -> list[Path]:
    """``NAME.md``, ``.csv``, ``.json`` and ``NAME.manifest.json``. Raises UsageError."""
    rows = [asdict(step) for step in steps]
    texts = {
        f"{name}.md": _to_markdown(steps, about), f"{name}.csv": as_csv(COLUMNS, rows),
        f"{name}.json": as_json({"schema": SCHEMA, "steps": rows, "thirds": _plain(thirds(steps))}),
    }  # fmt: skip
    texts[f"{name}.manifest.json"] = as_json(manifest(about, cells, list(texts)))
    return write_texts(folder, texts)


def _plain(thirds: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [{k: asdict(v) if isinstance(v, Estimate) else v for k, v in third.items()} for third in thirds]


def thirds(steps: Sequence[Step]) -> list[dict[str, Any]]:
    """For each row, ego and seed each third of its sequence: ``n``, and ``hits``, ``seconds``, ``calls``, ``valid`` as
    estimates, None where there is nothing to estimate."""
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


def _to_markdown(steps: Sequence[Step], about: About) -> str:
    """The thirds as a table."""
    rows = [
        [f"`{t['row']}`", t["ego"], str(t["seed"]), t["encounters"], str(t["n"]), number(t["hits"]),
         number(t["seconds"]), number(t["calls"], 1), number(t["valid"])]
        for t in thirds(steps)
    ]  # fmt: skip
    head = ["row", "ego", "seed", "encounters", "n", "memory hits", "s", "model calls", "valid"]
    return "\n".join([f"# Growth of the bank over {about.suite}", "", *grid(head, rows)])
