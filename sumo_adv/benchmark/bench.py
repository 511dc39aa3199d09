"""All cells of a table: what is missing is run on worker processes, what is there is kept."""

from __future__ import annotations

import json
import multiprocessing
import time
from collections import Counter, deque
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from sumo_adv.benchmark.banks import known_place
from sumo_adv.benchmark.jobs import Job, Setup, cell_path
from sumo_adv.benchmark.nouns import Cell
from sumo_adv.benchmark.worker import begin, failure, keep_cell, work
from sumo_adv.errors import UsageError

TRIES = 2  # of a job whose process died or got stuck
TICK = 0.5  # s between looks at the clock
Running = dict[Future[None], tuple[Job, int | None, float]]  # the job, its chain, since when [s]


class Watcher(Protocol):
    """Whoever shows how it goes on."""

    def begin(self, total: int, before: int) -> None:
        """So many cells, some of them there before."""
        ...

    def finished(self, job: Job) -> None:
        """Its cells are there."""
        ...


class Bench:
    """Runs jobs. ``deadline`` [s]: after which a job is held to be stuck."""

    def __init__(self, setup: Setup, workers: int, watcher: Watcher, deadline: float = 900.0) -> None:
        self._setup, self._workers, self._watcher, self._deadline = setup, workers, watcher, deadline
        self._tries: Counter[Job] = Counter()
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
        try:
            while self._waiting or any(self._chains.values()):
                self._pool()
        finally:
            for child in multiprocessing.active_children():
                child.kill()

    def _missing(self, job: Job) -> Job | None:
        """The job with those of its rows that have no cell."""
        rows = tuple(r for r in job.rows if not cell_path(self._setup.folder, job.ego, job.case.name, r).exists())
        return replace(job, rows=rows) if rows else None

    def _rest(self, chain: Sequence[Job]) -> list[Job]:
        """A chain from the first encounter on that has no cell, since those after it hang on it; or from before that,
        where the bank it begins with is gone."""
        first = next((job for job in chain if self._missing(job) is not None), None)
        return [] if first is None else list(chain[known_place(first, self._setup) :])

    def _pool(self) -> None:
        """Work until all is done or a process dies."""
        context = multiprocessing.get_context("spawn")
        running: Running = {}
        pool = ProcessPoolExecutor(self._workers, context, begin, (self._setup,))
        busy: set[int] = set()
        try:
            while True:
                self._submit(pool, running, busy)
                if not running:
                    return
                done, _ = wait(running, timeout=TICK, return_when=FIRST_COMPLETED)
                for future in done:
                    job, chain, _ = running[future]
                    future.result()
                    del running[future]
                    self._done(job, chain)
                    busy.discard(-1 if chain is None else chain)
                self._watch(running)
        except BrokenProcessPool:
            self._again(running)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for child in multiprocessing.active_children():
                child.kill()

    def _submit(self, pool: ProcessPoolExecutor, running: Running, busy: set[int]) -> None:
        """As many jobs as there are workers: the next one of every chain first, since others wait for it."""
        for k, chain in self._chains.items():
            if chain and k not in busy and len(running) < self._workers:
                busy.add(k)
                running[pool.submit(work, self._setup, chain[0])] = (chain[0], k, time.monotonic())
        while self._waiting and len(running) < self._workers:
            job = self._waiting.popleft()
            running[pool.submit(work, self._setup, job)] = (job, None, time.monotonic())

    def _done(self, job: Job, chain: int | None) -> None:
        if chain is not None:
            self._chains[chain].popleft()
        self._watcher.finished(job)

    def _watch(self, running: Running) -> None:
        """End all processes where a job is stuck: which one has it is not known."""
        late = [job for job, _, since in running.values() if time.monotonic() - since > self._deadline]
        if late:
            for job in late:
                self._tries[job] = TRIES
            for child in multiprocessing.active_children():
                child.kill()

    def _again(self, running: Running) -> None:
        """Jobs that were under way when a process died: once more, then they have failed."""
        for job, chain, _ in running.values():
            left = self._missing(job)
            if left is None:
                self._done(job, chain)
                continue
            self._tries[job] += 1
            if self._tries[job] < TRIES:
                if chain is None:
                    self._waiting.appendleft(job)
                continue
            for row in left.rows:
                why = "Its process died or was stuck, twice." if self._tries[job] == TRIES else "It was stuck."
                keep_cell(self._setup.folder, failure(self._setup, job, row, why))
            self._done(job, chain)


def read_cells(folder: Path) -> list[Cell]:
    """Every cell of a bench. Raises UsageError for one that cannot be read."""
    found = []
    for file in sorted((folder / "cells").glob("*/*/*.json")):
        try:
            found.append(json.loads(file.read_text(encoding="utf-8")))
        except (OSError, ValueError) as error:
            raise UsageError(f"{file} cannot be read ({error}); delete it to have it run again.") from error
    return found
