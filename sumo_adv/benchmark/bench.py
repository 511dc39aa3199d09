"""Run a table from the request to its cells: missing cells are run on worker processes, the others are kept."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from sumo_adv.benchmark.jobs import (
    BenchJob,
    BenchParts,
    BenchSetup,
    cell_path,
    examples_of,
    known_place,
    make_jobs,
    method_of,
)
from sumo_adv.benchmark.nouns import Cell, Suite
from sumo_adv.benchmark.rows import make_row
from sumo_adv.benchmark.worker import Bencher, failure, keep_cell, missing_rows, note_of, waited
from sumo_adv.campaigns.local import LocalWorkers, Stop, WorkerPace
from sumo_adv.campaigns.results import Done
from sumo_adv.config import load_settings
from sumo_adv.drivers import make_ego
from sumo_adv.errors import UsageError
from sumo_adv.files import held, refuse_links, scratch_prefix, sentences, write_text
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.parsing import read_json, read_object

CELL_KEYS = {"case", "kind", "group", "ego", "row", "seed", "ending"}


class BenchWatcher(Protocol):
    """Shows the progress."""

    def begin(self, total: int, before: int) -> None: ...

    def finished(self, job: BenchJob) -> None: ...


class Bench:
    """Runs jobs."""

    def __init__(self, setup: BenchSetup, workers: int, watcher: BenchWatcher, deadline: float) -> None:
        """Prepare to run jobs.

        Args:
            setup: The workers' setup.
            workers: The number of workers.
            watcher: Shows the progress.
            deadline: The time after which a row is considered stuck, without its wait for a language model [s].
        """
        self._setup, self._watcher = setup, watcher
        self._pace = WorkerPace(workers, deadline, recycle=sys.maxsize)
        self._waiting: deque[BenchJob] = deque()
        self._chains: dict[tuple[str, str], deque[BenchJob]] = {}
        self._since: dict[str, tuple[int, float]] = {}  # by job: rows without a cell, and since when [s]
        self._scratch = Path()

    def run(self, free: Sequence[BenchJob], chains: Sequence[Sequence[BenchJob]]) -> None:
        """Run all rows that have no cell yet.

        KeyboardInterrupt leaves whole cells.

        Args:
            free: Jobs that do not depend on each other.
            chains: Chains of jobs, each of which depends on the one before it.

        Raises:
            SumoAdvError: The jobs cannot be run.
            OSError: A file cannot be written.
        """
        every = [*free, *(job for chain in chains for job in chain)]
        total = sum(len(j.rows) for j in every)
        left = [m for j in free if (m := self._missing(j)) is not None]
        todo = [self._rest(chain) for chain in chains]
        missing = sum(len(j.rows) for j in left) + sum(map(len, todo))
        self._watcher.begin(total, total - missing)
        self._chains = {(chain[0].ego, chain[0].rows[0]): deque(chain) for chain in todo if chain}
        self._waiting = deque(left)
        for chain in self._chains.values():
            self._go_on(chain)
        with tempfile.TemporaryDirectory(prefix=scratch_prefix(), ignore_cleanup_errors=True) as scratch:
            self._scratch = Path(scratch)
            workers = LocalWorkers(
                (self._setup, self._scratch), self._pace, self._scratch, self._fail, Stop(), Bencher, self._seen, 1
            )
            with closing(workers):
                workers.run(self._waiting, self._finished)

    def _missing(self, job: BenchJob) -> BenchJob | None:
        """Return the job with its rows that have no cell; None if there are none."""
        rows = missing_rows(self._setup, job)
        return replace(job, rows=rows) if rows else None

    def _rest(self, chain: Sequence[BenchJob]) -> list[BenchJob]:
        """Return a chain from its first encounter without a cell on, because later encounters depend on earlier ones.

        The part begins earlier if the bank that this encounter begins with is gone.
        """
        first = next((job for job in chain if self._missing(job) is not None), None)
        return [] if first is None else list(chain[known_place(first, self._setup) :])

    def _go_on(self, chain: deque[BenchJob]) -> None:
        """Queue the next job of a chain first, because later ones wait for it; its cell, if any, is void."""
        job = chain.popleft()
        cell_path(self._setup.folder, job.ego, job.case.name, job.rows[0]).unlink(missing_ok=True)
        self._waiting.appendleft(job)

    def _finished(self, job: BenchJob, done: Done) -> None:
        left = self._missing(job)
        rows = tuple(row for row in job.rows if left is None or row not in left.rows)
        self._watcher.finished(replace(job, rows=rows))
        if left is not None:
            self._waiting.appendleft(left)
        elif job.place is not None and (chain := self._chains[job.ego, job.rows[0]]):
            self._go_on(chain)

    def _seen(self, job: BenchJob) -> tuple[int, float]:
        """Return how many rows have no cell, and how long the first of them has waited for a language model [s]."""
        rows = missing_rows(self._setup, job)
        before, _ = self._since.get(job.id, (-1, 0.0))
        if before != len(rows):
            self._since[job.id] = len(rows), time.monotonic()
        return len(rows), waited(note_of(self._scratch, job, rows[0])) if rows else 0.0

    def _fail(self, job: BenchJob, why: str, text: str) -> Done:
        """Record the failure of the row that a job was at."""
        if rows := missing_rows(self._setup, job):
            _, since = self._since.get(job.id, (0, time.monotonic()))
            if "did not finish within" in why:
                why = f"The cell did not finish within {self._pace.deadline:g} s; raise cell_seconds."
            keep_cell(self._setup.folder, failure(self._setup, job, rows[0], why, time.monotonic() - since))
        return Done(job.id, None)


def read_cells(folder: Path) -> list[Cell]:
    """Read every cell of a bench.

    Args:
        folder: The bench's folder.

    Returns:
        The cells.

    Raises:
        UsageError: A cell cannot be read.
    """
    cells: list[Cell] = []
    for file in sorted((folder / "cells").glob("*/*/*.json")):
        try:
            cell = read_json(file)
        except (OSError, ValueError) as error:
            raise UsageError(f"{file} cannot be read ({error}); delete it to rerun the cell.") from error
        if not isinstance(cell, dict) or not cell.keys() >= CELL_KEYS:
            raise UsageError(f"{file} is not a cell of a bench; delete it to rerun the cell.")
        cells.append(cell)
    return cells


BENCH_SCHEMA = 1
BENCH_FILE, BENCH_LOCK = "bench.json", "bench.lock"


@dataclass(frozen=True, slots=True)
class TableRequest:
    """What a table is made of.

    Attributes:
        suite: The encounters.
        egos: The ego drivers.
        rows: The rows.
        seed: The seed.
        settings: The settings of all rows, as data.
        bank: The memory bank, which is the library.
    """

    suite: Suite
    egos: tuple[str, ...]
    rows: tuple[str, ...]
    seed: int
    settings: Mapping[str, Any]
    bank: Path

    def check(self) -> None:
        """Check rows, egos and settings before anything is run.

        Raises:
            UsageError: A row, an ego or a setting does not exist.
        """
        load_settings(None, **{**self.settings, "seed": self.seed})
        for ego in self.egos:
            make_ego(ego, {})
        for row in self.rows:
            if method_of(row) is None:
                make_row(row)


@dataclass(frozen=True, slots=True)
class BenchResources:
    """Where and how a table is run.

    Attributes:
        folder: The bench's folder.
        workers: The number of workers.
        parts: The functions that load, run and write.
        versions: The versions of the packages that affect the numbers.
        keep_runs: Whether the folders of runs are kept.
        cell_seconds: The time after which a row is considered stuck [s].
    """

    folder: Path
    workers: int
    parts: BenchParts
    versions: Mapping[str, str]
    keep_runs: bool = False
    cell_seconds: float = 900.0


def run_table(request: TableRequest, means: BenchResources, watcher: BenchWatcher) -> list[Cell]:
    """Run the missing cells of a table.

    Args:
        request: What the table is made of.
        means: Where and how it is run.
        watcher: Shows the progress.

    Returns:
        All cells in the folder, including those of other commands.

    Raises:
        UsageError: Rows, egos or settings are wrong, the folder holds cells of something else, or another bench writes
            into it.
        BankError: The bank cannot be read.
    """
    request.check()
    plan = json.loads(json.dumps(manifest(request, means)))
    with sentences(means.folder):
        means.folder.mkdir(parents=True, exist_ok=True)
        refuse_links(means.folder)
        _keep_plan(plan, means.folder)
        setup = BenchSetup(
            means.folder.absolute(), request.suite.name, request.bank.absolute(), request.settings, means.parts,
            means.keep_runs, examples_of(request.suite.cases),
        )  # fmt: skip
        free, chains = make_jobs(request.suite.cases, request.egos, request.rows, request.seed)
        with held(means.folder / BENCH_LOCK) as alone:
            if not alone:
                raise UsageError(f"Another bench writes into {means.folder}; wait for it, or give another --out.")
            Bench(setup, means.workers, watcher, means.cell_seconds).run(free, chains)
    return read_cells(means.folder)


def manifest(request: TableRequest, means: BenchResources) -> dict[str, Any]:
    """Return what all cells of a folder have in common."""
    with MemoryBank.open(request.bank, read_only=True) as bank:
        content = bank.content_hash()
    suite = request.suite
    return {
        "schema": BENCH_SCHEMA, "suite": suite.name, "version": suite.version, "content": suite.content,
        "cases": len(suite.cases), "seed": request.seed, "settings": dict(request.settings), "bank_hash": content,
        "versions": dict(means.versions),
    }  # fmt: skip


def _keep_plan(plan: Mapping[str, Any], folder: Path) -> None:
    """Record what the folder's cells have in common. Raise UsageError if it holds something else."""
    file = folder / BENCH_FILE
    if file.exists():
        before = read_object(file, "The plan of the bench")
        changed = [k for k in plan if before.get(k) != plan[k]]
        if changed:
            raise UsageError(
                f"{folder} holds cells of another {' and '.join(changed)}: they cannot share a table; "
                "give another --out."
            )
        return
    if any(folder.iterdir()):
        raise UsageError(f"{folder} is not empty and not the folder of a bench; give another --out.")
    write_text(file, json.dumps(plan, indent=2) + "\n")


def of_rows(cells: Sequence[Cell], rows: Sequence[str], egos: Sequence[str]) -> list[Cell]:
    """Keep the cells of some rows and egos."""
    return [c for c in cells if c["row"] in rows and c["ego"] in egos]
