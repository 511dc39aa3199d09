"""Run a batch from its plan to its table: missing episodes are run, finished ones are kept."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import sqlite3
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

from sumo_adv.campaigns.local import Crew, LocalWorkers, Stop, WorkerPace
from sumo_adv.campaigns.plan import CampaignPlan
from sumo_adv.campaigns.results import (
    LEARNT_FILE,
    CampaignParts,
    Done,
    EpisodeJob,
    Learn,
    Row,
    WorkerSetup,
    is_failed,
    read_row,
    results_table,
    write_csv,
    write_parquet,
)
from sumo_adv.campaigns.store import PLAN_FILE, TAUGHT_FILE, Store, discard, open_store, packed_texts
from sumo_adv.campaigns.worker import Lessons, lessons_of, teach
from sumo_adv.errors import BankError, UsageError
from sumo_adv.files import sentences, write_text
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.parsing import read_json


class Workers(Protocol):
    """Runs the jobs of a batch."""

    def run(self, jobs: Sequence[Any], told: Callable[[Any, Done], None]) -> None:
        """Run all jobs.

        Args:
            jobs: The jobs.
            told: Called with each job that is finished and its outcome.

        Raises:
            SumoAdvError: The jobs cannot be run.
        """
        ...

    def close(self) -> None: ...


class CampaignWatcher(Protocol):
    """Follows the progress of a batch."""

    def begin(self, total: int, before: Sequence[Row]) -> None: ...

    def finished(self, job: EpisodeJob, row: Row) -> None: ...

    def stopping(self, now: bool) -> None:
        """Take notice of Ctrl-C; ``now`` says whether it was pressed again."""
        ...


@dataclass(frozen=True, slots=True)
class Orders:
    """How a batch is run.

    Attributes:
        out: The folder of the results.
        bank: The user's memory bank.
        versions: The versions of the packages that affect the numbers.
        pace: How the work is done.
        force: Whether the results of another plan may be continued.
        retry_failed: Whether failed episodes are run again.
        parquet: Whether the table is also written as Parquet.
        ray: The address of a Ray cluster; None for this machine.
        stop: What ends the batch early: Ctrl-C, or the caller.
        crew: The workers of this machine that stay from one batch to the next; None for workers of this batch alone.
    """

    out: Path
    bank: Path
    versions: Mapping[str, str]
    pace: WorkerPace
    force: bool = False
    retry_failed: bool = False
    parquet: bool = False
    ray: str | None = None
    stop: Stop = field(default_factory=Stop)
    crew: Crew | None = None


@dataclass
class Summary:
    """The result of a batch.

    Attributes:
        folder: The folder of the results.
        total: The number of episodes in the plan.
        rows: The rows of the finished episodes.
        ran: The number of episodes that were run now.
        stopped: Whether Ctrl-C left episodes out.
        interrupted: Whether Ctrl-C was pressed, even if no episode was left out.
        seconds: The time that it took [s].
        bytes: The size of the episodes that were run now, without their inputs.
        input_bytes: The size of all inputs.
        learnt: The number of pieces written into the bank now; None if the bank was not taught.
        bank_hash: The hash of the bank's snapshot.
    """

    folder: Path
    total: int
    rows: Sequence[Row] = ()
    ran: int = 0
    stopped: bool = False
    interrupted: bool = False
    seconds: float = 0.0
    bytes: int = 0
    input_bytes: int = 0
    learnt: int | None = None
    bank_hash: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return the summary as plain data."""
        counts = {"critical": sum(bool(r["critical"]) for r in self.rows), "failed": sum(map(is_failed, self.rows))}
        return {
            "folder": str(self.folder), "episodes": self.total, "finished": len(self.rows), "ran": self.ran, **counts,
            "collided": sum(bool(r["collided"]) for r in self.rows), "valid": sum(bool(r["valid"]) for r in self.rows),
            **{k: sum(bool(r["valid"] and r.get(k)) for r in self.rows) for k in ("humanlike", "robust")},
            "driver_calls": sum(int(r.get("driver_calls") or 0) for r in self.rows),
            "driver_seconds": round(sum(float(r.get("driver_seconds") or 0.0) for r in self.rows), 2),
            "driver_p99_ms": max((r["driver_p99_ms"] for r in self.rows if r.get("driver_p99_ms")), default=None),
            "stopped": self.stopped, "seconds": round(self.seconds, 2), "learnt": self.learnt,
            "bytes_an_episode": round(self.bytes / self.ran) if self.ran else None, "input_bytes": self.input_bytes,
            "bank_hash": self.bank_hash,
        }  # fmt: skip


def run_batch(plan: CampaignPlan, orders: Orders, parts: CampaignParts, watcher: CampaignWatcher) -> Summary:
    """Run what is missing of a plan, and write the table.

    Finished episodes are kept even if an error is raised.

    Args:
        plan: The plan.
        orders: How it is run.
        parts: The functions that load, run and write an episode.
        watcher: Follows the progress.

    Returns:
        The summary.

    Raises:
        UsageError: The folder holds another plan's results or cannot be written.
        SumoAdvError: No episode can be run, or the disk is full.
    """
    began = time.perf_counter()
    with open_store(orders.out, parts.staged) as (store, scratch):
        document = {**plan.as_dict(), "versions": dict(orders.versions)}
        store.check(document, force=orders.force)
        summary = Summary(orders.out, len(plan.jobs))
        with sentences(orders.out):
            setup = _prepare(store, plan, document, orders, parts, summary)
        jobs = {job.id: job for job in plan.jobs}
        rows = store.rows(jobs)
        taught = _taught(store, plan, orders, rows) if plan.learn is Learn.AFTER else set()
        if orders.retry_failed:
            rows = {name: row for name, row in rows.items() if not is_failed(row)}
        watcher.begin(len(jobs), list(rows.values()))

        def finish(job: EpisodeJob, done: Done) -> None:
            assert done.row is not None
            rows[job.id] = done.row
            summary.ran += 1
            summary.bytes += done.bytes
            watcher.finished(job, done.row)

        try:
            stop = orders.stop
            with stopping(watcher, stop):
                missing = [job for job in plan.jobs if job.id not in rows]
                with sentences(orders.out):
                    for job in missing:  # remove the remains of failed and damaged episodes
                        discard(store.runs / job.id)
                for job in [job for job in missing if job.input.error]:
                    finish(job, store.fail(job, job.input.error, ""))
                with closing(_workers(setup, orders, scratch, store, stop)) as workers:
                    workers.run([job for job in missing if not job.input.error], finish)
                summary.stopped, summary.interrupted = len(rows) < len(jobs), stop.drain
        finally:
            summary.rows = results_table(plan.jobs, rows, plan.varied)
            with sentences(orders.out):
                varied = list(plan.varied[0])
                write_csv(store.folder / "results.csv", summary.rows, varied)
                if orders.parquet:
                    write_parquet(store.folder / "results.parquet", summary.rows, varied)
        if plan.learn is Learn.AFTER and not summary.stopped:
            summary.learnt = _teach(store, plan, orders, rows, taught)
        summary.input_bytes = sum(p.stat().st_size for p in (store.folder / "inputs").glob("*"))
    summary.seconds = time.perf_counter() - began
    return summary


def _prepare(
    store: Store,
    plan: CampaignPlan,
    document: Mapping[str, Any],
    orders: Orders,
    parts: CampaignParts,
    summary: Summary,
) -> WorkerSetup:
    """Write the bank's snapshot and the plan, and return the workers' setup. Raise OSError or BankError."""
    try:
        store.snapshot(orders.bank)
    except sqlite3.Error as error:
        if shutil.disk_usage(store.folder).free < orders.bank.stat().st_size:  # SQLite says "disk I/O error"
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from error
        raise BankError(f"The memory bank {orders.bank} could not be copied ({error}).") from error
    with MemoryBank.open(store.bank, read_only=True) as bank:
        summary.bank_hash = bank.content_hash()
    document = {**document, "bank_hash": summary.bank_hash}
    write_text(store.folder / PLAN_FILE, json.dumps(document, indent=1, ensure_ascii=False) + "\n")
    place = orders.bank if plan.learn is Learn.DURING else store.bank
    return WorkerSetup(
        store.runs.absolute(), place.absolute(), plan.learn, plan.variants, plan.figures, parts, orders.pace.until
    )  # fmt: skip


def _workers(setup: WorkerSetup, orders: Orders, scratch: Path, store: Store, stop: Stop) -> Workers:
    if orders.crew is not None:
        return orders.crew.workers(setup, orders.pace, store.fail, stop)
    if orders.ray is None:
        return LocalWorkers(setup, orders.pace, scratch, store.fail, stop)
    from sumo_adv.campaigns.cluster import ClusterWorkers

    return ClusterWorkers(setup, orders.pace, orders.ray, orders.versions, store, stop)


def _taught(store: Store, plan: CampaignPlan, orders: Orders, rows: Mapping[str, Row]) -> set[str]:
    """Read the ids of the episodes that have taught the bank. Raise UsageError if the file is damaged.

    An earlier version kept no ids. The lessons of all episodes that are finished now count as taught then.
    """
    marker = store.folder / TAUGHT_FILE
    if not marker.exists():
        return set()
    try:
        kept = dict(read_json(marker))
        if "episodes" in kept:
            return set(kept["episodes"])
        written = int(kept["written"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(
            f"{marker} is damaged ({error}); delete it to write the lessons into the bank again."
        ) from error
    taught = {name for name, _, _ in _learnt(store, plan, rows)}
    _mark_taught(store, orders, written, taught)
    return taught


def _learnt(store: Store, plan: CampaignPlan, rows: Mapping[str, Row]) -> Iterator[tuple[str, str, str]]:
    """Yield the lessons of finished episodes in the plan's order: the id, the text, and its name for errors."""
    packed = packed_texts(store.folder, LEARNT_FILE)
    for job in plan.jobs:
        if job.id not in rows:
            continue
        file = store.runs / job.id / LEARNT_FILE
        if read_row(file.parent) is not None:  # newer than a packed run of the same id
            if file.exists():
                yield job.id, file.read_text(encoding="utf-8", errors="replace"), f"The file {file}"
        elif job.id in packed:
            yield job.id, packed[job.id], f"The lessons of the packed run {job.id}"


def _teach(store: Store, plan: CampaignPlan, orders: Orders, rows: Mapping[str, Row], taught: set[str]) -> int:
    """Write the lessons of episodes that are not in ``taught`` into the bank, in the plan's order.

    Returns:
        The number of pieces written.

    Raises:
        BankError: The bank cannot be written.
        UsageError: Lessons are damaged, or the results cannot be written.
    """
    done = set(taught)

    def lessons() -> Iterator[Lessons]:
        for name, text, what in _learnt(store, plan, rows):
            if name not in taught:
                yield from lessons_of(text, what)
                done.add(name)

    with MemoryBank.open(orders.bank) as bank, sentences(orders.out):
        written = teach(bank, lessons())
        _mark_taught(store, orders, written, done)
    return written


def _mark_taught(store: Store, orders: Orders, written: int, taught: set[str]) -> None:
    """Record the episodes that have taught the bank."""
    marked = {"written": written, "bank": str(orders.bank), "episodes": sorted(taught)}
    with sentences(orders.out):
        write_text(store.folder / TAUGHT_FILE, json.dumps(marked) + "\n")


@contextmanager
def stopping(watcher: CampaignWatcher, stop: Stop) -> Iterator[None]:
    """Let Ctrl-C change ``stop``: the first one asks to drain, the second one to end at once.

    Outside the main thread, signals cannot be handled, so the state never changes.

    Args:
        watcher: Told of each Ctrl-C.
        stop: The state.
    """

    def press(number: int, frame: FrameType | None) -> None:
        stop.drain, stop.now = True, stop.drain
        watcher.stopping(stop.now)

    try:
        before = {s: signal.signal(s, press) for s in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:  # signals only reach the main thread
        yield
        return
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
