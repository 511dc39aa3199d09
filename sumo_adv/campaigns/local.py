"""Run jobs on worker processes of one machine. Workers that hang are killed, and workers that died are replaced."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Self

from sumo_adv.campaigns.results import Done, EpisodeJob
from sumo_adv.errors import SumoAdvError
from sumo_adv.files import scratch_prefix
from sumo_adv.simulation.processes import SINGLE_THREAD_VARIABLES, deferred_interrupts, environment, exit_in_words

MAX_EPISODE_TRIES = 2  # for an episode whose worker crashes or hangs, or whose simulation fails
MAX_FAILED_STARTS = 3  # consecutive workers that may die before they are ready
WORKER_START_TIMEOUT_S = 120.0
POLL_INTERVAL_S = 0.25  # between checks of deadlines, results, messages and Ctrl-C
MAX_KEPT_OUTPUT_CHARACTERS = 20_000  # kept of a dead worker's output
OVERTIME_S = 8.0  # after the end of the work, in which the jobs that run may end; then they are killed


@dataclass
class Stop:
    """The state of Ctrl-C.

    Attributes:
        drain: Begin no more jobs.
        now: End the jobs that run.
    """

    drain: bool = False
    now: bool = False


@dataclass(frozen=True, slots=True)
class WorkerPace:
    """How the work is done.

    Attributes:
        workers: The number of workers.
        deadline: The maximum time of an episode [s].
        recycle: The number of episodes after which a worker is replaced.
        until: When the work should end, as ``time.time()`` [s]; jobs that go on for ``OVERTIME_S`` are killed and left
            out. None if the work ends with its jobs.
    """

    workers: int
    deadline: float
    recycle: int
    until: float | None = None


@dataclass
class _Slot:
    """A worker process and its current episode."""

    process: Any
    connection: Connection
    folder: Path
    until: float
    setup: Any
    ready: bool = False
    job: EpisodeJob | None = None
    seen: Any = None
    ran: int = 0

    @property
    def words(self) -> str:
        """The last part of the worker's output."""
        try:
            return (self.folder / "log").read_text(errors="replace")[-MAX_KEPT_OUTPUT_CHARACTERS:]
        except OSError:
            return ""

    def kill(self) -> None:
        """Kill the worker with everything that it started."""
        try:
            os.killpg(self.process.pid, signal.SIGKILL)
        except (OSError, AttributeError):  # it has no group of its own yet, or the system has no groups
            self.process.kill()
        self.process.join()
        self.connection.close()
        shutil.rmtree(self.folder, ignore_errors=True)


@dataclass
class LocalWorkers:
    """Runs jobs on worker processes.

    Attributes:
        setup: What ``make`` makes each worker's runner from. It is sent to the worker.
        pace: How the work is done.
        scratch: The folder of the workers' folders.
        fail: Records a job that could not be run, from the job, the reason and a text.
        stop: The state of Ctrl-C.
        make: Makes a worker's runner. It is sent to the worker. None runs episodes of a batch, whose jobs have the
            type ``EpisodeJob``. The jobs of another runner are anything with an ``id``.
        seen: Returns how far a job is, and the time in it that does not count [s]. The job's deadline is extended when
            it gets further.
        hangs: The maximum number of tries of a job that is not done in time.
        kept: The workers of a crew, which outlive this object. None if they end with it.
    """

    setup: Any
    pace: WorkerPace
    scratch: Path
    fail: Callable[[Any, str, str], Done]
    stop: Stop
    make: Callable[[Any], AbstractContextManager[Any]] | None = None
    seen: Callable[[Any], tuple[Any, float]] = lambda job: (None, 0.0)
    hangs: int = MAX_EPISODE_TRIES
    kept: list[_Slot] | None = None
    _slots: list[_Slot] = field(default_factory=list)
    _tried: dict[str, int] = field(default_factory=dict)
    _again: deque[EpisodeJob] = field(default_factory=deque)
    _died: int = 0

    def __post_init__(self) -> None:
        if self.kept is not None:
            self._slots = self.kept

    def run(self, jobs: Iterable[Any], told: Callable[[Any, Done], None]) -> None:
        """Run all jobs, each at most ``MAX_EPISODE_TRIES`` times.

        Args:
            jobs: The jobs. If they are a deque, it may grow meanwhile.
            told: Called with each job that is finished and its outcome.

        Raises:
            SumoAdvError: The workers do not start, or a worker says that no job can be run.
        """
        waiting = jobs if isinstance(jobs, deque) else deque(jobs)
        while not (self.stop.now or self._overdue):
            self._staff(len(waiting) + len(self._again))
            self._assign(waiting)
            if not any(s.job for s in self._slots) and (self.stop.drain or not (waiting or self._again)):
                break
            self._listen(told)
            self._watch(told)

    def close(self) -> None:
        """Kill all workers; of a crew, those that have not finished their jobs."""
        for slot in [s for s in self._slots if self.kept is None or s.job is not None]:
            self._dismiss(slot)

    @property
    def _overdue(self) -> bool:
        return self.pace.until is not None and time.time() >= self.pace.until + OVERTIME_S

    def _staff(self, waiting: int) -> None:
        """Start missing workers, at most one for each job."""
        busy = sum(s.job is not None for s in self._slots)
        target = min(self.pace.workers, busy + (0 if self.stop.drain else waiting))
        while len(self._slots) < target:
            self._slots.append(self._start())

    def _start(self) -> _Slot:
        context = multiprocessing.get_context("spawn")
        folder = Path(tempfile.mkdtemp(prefix="worker-", dir=self.scratch))
        own_end, worker_end = context.Pipe()
        variables = {**SINGLE_THREAD_VARIABLES, "TMPDIR": str(folder)}
        process = context.Process(target=_work, args=(worker_end, self.setup, folder / "log", self.make))
        with environment(variables), deferred_interrupts():
            process.start()
        worker_end.close()
        return _Slot(process, own_end, folder, time.monotonic() + WORKER_START_TIMEOUT_S, self.setup)

    def _assign(self, waiting: deque[EpisodeJob]) -> None:
        """Give jobs to free workers."""
        for slot in self._slots:
            if self.stop.drain or not (waiting or self._again):
                return
            if slot.ready and slot.job is None:
                slot.job = self._again.popleft() if self._again else waiting.popleft()
                slot.seen, slot.until = None, time.monotonic() + self.pace.deadline
                last, renewed = self._tried.get(slot.job.id, 0) + 1 == MAX_EPISODE_TRIES, slot.setup is not self.setup
                slot.setup = self.setup
                with suppress(OSError):  # it may have died, which ``_listen`` finds
                    slot.connection.send((slot.job, last, self.setup if renewed else None))

    def _listen(self, told: Callable[[EpisodeJob, Done], None]) -> None:
        """Receive the workers' messages."""
        by_handle = {s.connection: s for s in self._slots}
        for ready in wait(list(by_handle), timeout=POLL_INTERVAL_S):
            slot = by_handle[ready]  # type: ignore[index]
            try:
                self._hear(slot, slot.connection.recv(), told)
            except (EOFError, OSError):
                slot.process.join(1.0)
                self._lose(slot, f"its worker process ended ({exit_in_words(slot.process.exitcode)})", told)

    def _hear(self, slot: _Slot, message: Any, told: Callable[[EpisodeJob, Done], None]) -> None:
        """Handle one message of a worker."""
        if isinstance(message, SumoAdvError):
            raise message
        if message == "ready":
            slot.ready, self._died = True, 0
            return
        assert isinstance(message, Done) and slot.job is not None
        job, slot.job = slot.job, None
        slot.ran += 1
        if message.again:
            self._retry(job, message.again, message.text, told)
        else:
            self._tried.pop(job.id, None)
            told(job, message)
        if slot.ran >= self.pace.recycle:
            self._dismiss(slot)

    def _watch(self, told: Callable[[EpisodeJob, Done], None]) -> None:
        """Replace workers whose deadline has passed."""
        checked_at = time.monotonic()
        for slot in list(self._slots):
            seen, uncounted = (None, 0.0) if slot.job is None else self.seen(slot.job)
            if seen != slot.seen:
                slot.seen, slot.until = seen, checked_at + self.pace.deadline
            if checked_at > slot.until + uncounted and (slot.job is not None or not slot.ready):
                self._lose(slot, f"it did not finish within {self.pace.deadline:g} s", told, self.hangs)

    def _lose(
        self, slot: _Slot, why: str, told: Callable[[EpisodeJob, Done], None], tries: int = MAX_EPISODE_TRIES
    ) -> None:
        """Replace a worker that died or must be killed, and retry its job."""
        text, job = slot.words, slot.job
        self._dismiss(slot)
        if job is not None:
            self._retry(job, why, text, told, tries)
        elif not slot.ready:
            self._died += 1
            if self._died >= MAX_FAILED_STARTS:
                last = next((line for line in reversed(text.splitlines()) if line.strip()), "they gave no reason")
                raise SumoAdvError(f"The worker processes do not start ({last.strip()[:300]}).")

    def _retry(
        self,
        job: EpisodeJob,
        why: str,
        text: str,
        told: Callable[[EpisodeJob, Done], None],
        tries: int = MAX_EPISODE_TRIES,
    ) -> None:
        """Queue a failed job again, or give it up after ``tries`` tries."""
        self._tried[job.id] = self._tried.get(job.id, 0) + 1
        if self._tried[job.id] < tries:
            self._again.append(job)
        else:
            told(job, self.fail(job, f"It failed {self._tried[job.id]} times: {why}.", text))

    def _dismiss(self, slot: _Slot) -> None:
        self._slots.remove(slot)
        slot.kill()


class Crew:
    """Worker processes that stay from one batch to the next; a context manager.

    A worker takes seconds to start, which many small batches would pay again and again.
    """

    def __init__(self, make: Callable[[Any], AbstractContextManager[Any]] | None = None) -> None:
        """Gather a crew; its processes start with the first batch.

        Args:
            make: Makes a worker's runner; see :class:`LocalWorkers`.
        """
        self._make = make
        self._slots: list[_Slot] = []
        self._scratch: tempfile.TemporaryDirectory[str]

    def __enter__(self) -> Self:
        self._scratch = tempfile.TemporaryDirectory(prefix=scratch_prefix())
        return self

    def __exit__(self, *_: object) -> None:
        for slot in self._slots:
            slot.kill()
        self._slots.clear()
        self._scratch.cleanup()

    def workers(self, setup: Any, pace: WorkerPace, fail: Callable[[Any, str, str], Done], stop: Stop) -> LocalWorkers:
        """Return what runs the jobs of a batch on these processes; see :class:`LocalWorkers`."""
        return LocalWorkers(setup, pace, Path(self._scratch.name), fail, stop, self._make, kept=self._slots)


def _work(
    connection: Connection, setup: Any, log: Path, make: Callable[[Any], AbstractContextManager[Any]] | None = None
) -> None:
    """Run a worker process: it is its own process group, prints into a file, and ends when its parent does."""
    import faulthandler

    alone(log.parent.parent)
    try:
        words = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    except FileNotFoundError:  # the parent died, and another worker removed the scratch folder
        return
    os.dup2(words, 1)
    os.dup2(words, 2)
    faulthandler.enable()
    from sumo_adv.campaigns.worker import Runner

    try:
        with (make or Runner)(setup) as runner:
            connection.send("ready")
            while True:
                job, last, renewed = connection.recv()
                if renewed is not None:
                    runner.renew(renewed)
                connection.send(runner.run(job, last=last))
    except EOFError:
        return
    except SumoAdvError as error:
        connection.send(error)


def alone(scratch: Path) -> None:
    """Protect this process from Ctrl-C, which is for the parent, and let it end with the parent.

    When the parent ends, however it ends, this process kills its process group and removes the scratch folder.

    Args:
        scratch: The scratch folder.
    """
    import threading

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    parent = multiprocessing.parent_process()
    if hasattr(os, "setpgrp"):
        os.setpgrp()

    def watch() -> None:
        assert parent is not None
        wait([parent.sentinel])
        shutil.rmtree(scratch, ignore_errors=True)
        if hasattr(os, "killpg"):
            os.killpg(os.getpgrp(), signal.SIGKILL)
        os._exit(1)

    threading.Thread(target=watch, name="parent", daemon=True).start()
