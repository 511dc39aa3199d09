"""One table from the command to its cells: the request, the cells that are there, the cells to run."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sumo_adv.benchmark.bench import Bench, Watcher, read_cells
from sumo_adv.benchmark.jobs import Parts, Setup, examples_of, make_jobs
from sumo_adv.benchmark.methods import method_of
from sumo_adv.benchmark.nouns import Cell, Suite
from sumo_adv.benchmark.rows.registry import make_row
from sumo_adv.config import load_settings
from sumo_adv.drivers import make_ego
from sumo_adv.errors import UsageError
from sumo_adv.files import held, sentences, write_text
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.parsing import parse_json

SCHEMA = 1
PLAN, LOCK = "bench.json", "bench.lock"


@dataclass(frozen=True, slots=True)
class TableRequest:
    """What a table is made of. ``settings``: the same for all rows, as data; ``bank``: the library."""

    suite: Suite
    egos: tuple[str, ...]
    rows: tuple[str, ...]
    seed: int
    settings: Mapping[str, Any]
    bank: Path

    def check(self) -> None:
        """Raises UsageError for a row, an ego or a setting that there is not, before anything is run."""
        load_settings(None, **{**self.settings, "seed": self.seed})
        for ego in self.egos:
            make_ego(ego, {})
        for row in self.rows:
            if method_of(row) is None:
                make_row(row)


@dataclass(frozen=True, slots=True)
class Means:
    """How a table is run."""

    folder: Path
    workers: int
    parts: Parts
    versions: Mapping[str, str]
    keep_runs: bool = False
    cell_seconds: float = 900.0


def run_table(request: TableRequest, means: Means, watcher: Watcher) -> list[Cell]:
    """The cells of a table, those that are missing run now; also those that other commands left in the folder.

    Raises:
        UsageError: bad rows, egos or settings, a folder that holds cells of something else, or into which another
            bench writes; BankError.
    """
    request.check()
    plan = json.loads(json.dumps(manifest(request, means)))
    with sentences(means.folder):
        means.folder.mkdir(parents=True, exist_ok=True)
        _keep_plan(plan, means.folder)
        setup = Setup(
            means.folder.absolute(), request.suite.name, request.bank.absolute(), request.settings, means.parts,
            means.keep_runs, examples_of(request.suite.cases),
        )  # fmt: skip
        free, chains = make_jobs(request.suite.cases, request.egos, request.rows, request.seed)
        with held(means.folder / LOCK) as alone:
            if not alone:
                raise UsageError(f"Another bench writes into {means.folder}; wait for it, or give another --out.")
            Bench(setup, means.workers, watcher, means.cell_seconds).run(free, chains)
    return read_cells(means.folder)


def manifest(request: TableRequest, means: Means) -> dict[str, Any]:
    """What the cells of a folder have in common."""
    with MemoryBank.open(request.bank, read_only=True) as bank:
        content = bank.content_hash()
    suite = request.suite
    return {
        "schema": SCHEMA, "suite": suite.name, "version": suite.version, "content": suite.content,
        "cases": len(suite.cases), "seed": request.seed, "settings": dict(request.settings), "bank_hash": content,
        "versions": dict(means.versions),
    }  # fmt: skip


def _keep_plan(plan: Mapping[str, Any], folder: Path) -> None:
    """Remember what the folder is of. Raises UsageError where it holds something else."""
    file = folder / PLAN
    if file.exists():
        try:
            before = parse_json(file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise UsageError(f"{file} is damaged ({error}); give another --out.") from error
        if not isinstance(before, dict):
            raise UsageError(f"{file} is damaged (it holds no table); give another --out.")
        changed = [k for k in plan if before.get(k) != plan[k]]
        if changed:
            raise UsageError(
                f"{folder} holds cells of another {' and '.join(changed)}: they cannot stand in one table; "
                "give another --out."
            )
        return
    if any(folder.iterdir()):
        raise UsageError(f"{folder} is not empty and not the folder of a bench; give another --out.")
    write_text(file, json.dumps(plan, indent=2) + "\n")


def of_rows(cells: Sequence[Cell], rows: Sequence[str], egos: Sequence[str]) -> list[Cell]:
    """Those cells that a table asks for."""
    return [c for c in cells if c["row"] in rows and c["ego"] in egos]
