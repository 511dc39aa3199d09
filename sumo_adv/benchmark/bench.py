"""All cells of a table: missing cells are run on worker processes, the others are kept."""

from __future__ import annotations

import multiprocessing
import os
import signal
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from sumo_adv.benchmark.banks import known_place
from sumo_adv.benchmark.jobs import Job, Setup, cell_path
from sumo_adv.benchmark.nouns import Cell
from sumo_adv.benchmark.waits import note_of, waited
from sumo_adv.benchmark.worker import begin, failure, keep_cell, work
from sumo_adv.errors import UsageError
from sumo_adv.parsing import parse_json
from sumo_adv.simulation.engine import deaf

TICK = 0.5  # s between looks at the clock
KILLED = 5.0  # s that a process that was killed may take to be gone
CELL_KEYS = {"case", "kind", "group", "ego", "row", "seed", "ending"}


class Watcher(Protocol):
    """Shows the progress."""

    def begin(self, total: int, before: int) -> None:
        """``total`` cells, ``before`` of them there already."""
        ...

    def finished(self, job: Job) -> None:
        """Its cells are there."""
        ...


@dataclass(slots=True)
class _Turn:
    """A job under way. ``chain``: of which it is the next; ``left``: rows without a cell when the last one came,
    ``since`` [s]; ``suspect``: it was under way when a process died before."""

    job: Job
    chain: int | None
    suspect: bool
    left: int
    since: float
    stuck: bool = False


class Bench:
    """Runs jobs. ``deadline`` [s]: after which a row is held to be stuck, its wait for a language model left out."""

    def __init__(self, setup: Setup, workers: int, watcher: Watcher, deadline: float) -> None:
        self._setup, self._workers, self._watcher, self._deadline = setup, workers, watcher, deadline
        self._suspects: deque[tuple[Job, int | None]] = deque()  # one at a time, so that the culprit is known
        self._waiting: deque[Job] = deque()
        self._chains: dict[int, deque[Job]] = {}

    def run(self, free: Sequence[Job], chains: Sequence[Sequence[Job]]) -> None:
        """Whatever has no cell yet. Raises UsageError, BankError, OSError; KeyboardInterrupt leaves whole cells."""
        every = [*free, *(job for chain in chains for job in chain)]
        total = sum(len(j.rows) for j in every)
        left = [m for j in free if (m := self._missing(j)) is not None]
        todo = [self._rest(chain) for chain in chains]
        missing = sum(len(j.rows) for j in left) + sum(map(len, todo))
        self._watcher.begin(total, total - missing)
        self._chains = {k: deque(chain) for k, chain in enumerate(todo) if chain}
        self._waiting = deque(left)
        with tempfile.TemporaryDirectory(prefix="sumo_adv-bench-", ignore_cleanup_errors=True) as scratch:
            while self._suspects or self._waiting or any(self._chains.values()):
                self._pool(Path(scratch))

    def _missing(self, job: Job) -> Job | None:
        """The job with those of its rows that have no cell."""
        rows = tuple(r for r in job.rows if not self._cell(job, r).exists())
        return replace(job, rows=rows) if rows else None

    def _cell(self, job: Job, row: str) -> Path:
        return cell_path(self._setup.folder, job.ego, job.case.name, row)

    def _rest(self, chain: Sequence[Job]) -> list[Job]:
        """A chain from the first encounter on that has no cell, since those after it hang on it; or from before that,
        where the bank it begins with is gone."""
        first = next((job for job in chain if self._missing(job) is not None), None)
        return [] if first is None else list(chain[known_place(first, self._setup) :])

    def _pool(self, scratch: Path) -> None:
        """Work until all is done or a process dies."""
        context = multiprocessing.get_context("spawn")
        running: dict[Future[None], _Turn] = {}
        pool = ProcessPoolExecutor(self._workers, context, begin, (self._setup, scratch))
        try:
            while True:
                self._submit(pool, running)
                if not running:
                    return
                done, _ = wait(running, timeout=TICK, return_when=FIRST_COMPLETED)
                for future in done:
                    future.result()
                    turn = running.pop(future)
                    self._done(turn.job, turn.chain)
                self._watch(running, scratch)
        except BrokenProcessPool:
            self._broken(running)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            _kill_all()

    def _submit(self, pool: ProcessPoolExecutor, running: dict[Future[None], _Turn]) -> None:
        """As many jobs as there are workers: the next one of every chain first, since others wait for it. A suspect
        has them all for itself."""
        if self._suspects or any(turn.suspect for turn in running.values()):
            if not running:
                job, chain = self._suspects[0]
                running[self._begun(pool, job)] = self._turn(job, chain, suspect=True)
                self._suspects.popleft()
            return
        busy = {turn.chain for turn in running.values()}
        for k, jobs in self._chains.items():
            if jobs and k not in busy and len(running) < self._workers:
                running[self._begun(pool, jobs[0])] = self._turn(jobs[0], k)
        while self._waiting and len(running) < self._workers:
            job = self._waiting[0]
            running[self._begun(pool, job)] = self._turn(job, None)
            self._waiting.popleft()

    def _begun(self, pool: ProcessPoolExecutor, job: Job) -> Future[None]:
        """The job, given to a process; a cell that depends on a missing one is void. Raises BrokenProcessPool."""
        for row in job.rows:
            self._cell(job, row).unlink(missing_ok=True)
        with deaf():
            return pool.submit(work, self._setup, job)

    def _turn(self, job: Job, chain: int | None, *, suspect: bool = False) -> _Turn:
        return _Turn(job, chain, suspect, len(job.rows), time.monotonic())

    def _done(self, job: Job, chain: int | None) -> None:
        if chain is not None:
            self._chains[chain].popleft()
        self._watcher.finished(job)

    def _watch(self, running: dict[Future[None], _Turn], scratch: Path) -> None:
        """End all processes where a row is stuck: which one has it is not known."""
        checked_at = time.monotonic()
        for turn in running.values():
            missing = self._missing(turn.job)
            left = 0 if missing is None else len(missing.rows)
            if left < turn.left:
                turn.left, turn.since = left, checked_at
            if missing is not None and checked_at - turn.since > self._deadline:
                own = checked_at - turn.since - waited(note_of(scratch, turn.job, missing.rows[0]))
                turn.stuck = own > self._deadline
        if any(turn.stuck for turn in running.values()):
            _kill_all()

    def _broken(self, running: dict[Future[None], _Turn]) -> None:
        """What becomes of jobs that were under way when a process died: each is tried again by itself. If that ends in
        the same way, or if it was stuck, the row that it was at has failed, and those after it go on."""
        hung = any(turn.stuck for turn in running.values())
        for turn in running.values():
            missing = self._missing(turn.job)
            rows = () if missing is None else missing.rows
            to_blame = bool(rows) and (turn.stuck or turn.suspect)
            if to_blame:
                why = (
                    f"It was not done after {self._deadline:g} s; raise cell_seconds."
                    if turn.stuck
                    else "Its process died, twice."
                )
                keep_cell(
                    self._setup.folder, failure(self._setup, turn.job, rows[0], why, time.monotonic() - turn.since)
                )
                rows = rows[1:]
            if not rows:
                self._done(turn.job, turn.chain)
                continue
            left = replace(turn.job, rows=rows)
            if not (to_blame or hung):
                self._suspects.append((left, turn.chain))
            elif turn.chain is None:
                self._waiting.appendleft(left)
            if over := tuple(row for row in turn.job.rows if row not in rows):
                self._watcher.finished(replace(turn.job, rows=over))


def _kill_all() -> None:
    """End the workers with everything they started."""
    children = multiprocessing.active_children()
    for child in children:
        try:
            os.killpg(child.pid or 0, signal.SIGKILL)
        except (OSError, AttributeError):  # it has no group of its own yet, or this system knows none
            child.kill()
    for child in children:
        child.join(KILLED)


def read_cells(folder: Path) -> list[Cell]:
    """Every cell of a bench. Raises UsageError for a cell that cannot be read."""
    cells: list[Cell] = []
    for file in sorted((folder / "cells").glob("*/*/*.json")):
        try:
            cell = parse_json(file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise UsageError(f"{file} cannot be read ({error}); delete it to have it run again.") from error
        if not isinstance(cell, dict) or not cell.keys() >= CELL_KEYS:
            raise UsageError(f"{file} is not a cell of a bench; delete it to have it run again.")
        cells.append(cell)
    return cells
