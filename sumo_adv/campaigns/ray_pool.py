"""Jobs on the nodes of a Ray cluster: each node is checked before its first job, and left out where it is unfit.

A node takes as many jobs at a time as it has processors. A job whose worker or node was lost is tried again,
``MAX_LOSSES_PER_JOB`` times; one on a node that turns out to be unfit is done elsewhere. Ray is spoken to by a process
of its own (``ray_driver.py``): where that hangs or dies, this one says so and ends in order."""

from __future__ import annotations

import multiprocessing
import os
import re
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from sumo_adv.campaigns import ray_driver
from sumo_adv.campaigns.local import POLL_INTERVAL_S, Stop
from sumo_adv.campaigns.ray_driver import LOG, JobRefused, JobResult, Lost, Node, Nodes, Put, Raised, Start
from sumo_adv.campaigns.results import Done
from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.simulation.processes import SINGLE_THREAD_VARIABLES, deferred_interrupts, environment

MAX_LOSSES_PER_JOB = 5  # times that a job is tried again after its worker or node was lost
RAY_START_TIMEOUT_S = 60.0  # for Python to start and to import Ray
CLUSTER_TIMEOUT_S = 10.0  # for the cluster to answer
CLUSTER_SILENCE_TIMEOUT_S = 90.0  # without a word of the cluster: Ray itself gives its head up after 60 s
RAY_CLOSE_TIMEOUT_S = 5.0  # for Ray to leave the cluster
LOG_LINE_ORIGIN = re.compile(r"^\[[^\]]*\] *(\S+:\d+: )?")  # at the beginning of a line of Ray's log
CHECK = "check"  # the job that a node's check is


@dataclass
class _Place:
    """A node: whether it was checked (``fit`` None: not yet), and how many jobs it has."""

    node: Node
    fit: bool | None = None
    busy: int = 0


class RayPool:
    """Runs ``task(sent, job)`` on the cluster for each job; ``sent`` is put into Ray's store once (``put``).

    Raises UsageError: Ray is not installed, or no cluster at ``address`` answers within ``CLUSTER_TIMEOUT_S``.
    """

    def __init__(
        self, task: Callable[..., Any], unfit: Callable[[Any], str], recycle: int, address: str, stop: Stop, *,
        driver: Callable[[Connection, str, Path], None] = ray_driver.serve_jobs,
        tell: Callable[[str], None] = lambda sentence: print(f"sumo-adv: {sentence}", file=sys.stderr, flush=True),
    ) -> None:  # fmt: skip
        """Connect, which takes some seconds.

        Args:
            task: runs one job on a node.
            unfit: run on each node before its first job, of what ``run`` says that nodes need; why the node cannot be
                used, '' if it can.
            recycle: jobs after which a worker process of a node is replaced.
            address: of the cluster.
            stop: what Ctrl-C asks for. One that comes while the cluster is asked leaves the pool without nodes.
            driver: what speaks to Ray, in a process of its own.
            tell: called with a sentence for each node that is left out.
        """
        self._task, self._unfit, self._recycle = task, unfit, recycle
        self._address, self._stop, self._tell = address, stop, tell
        self._places = dict[str, _Place]()
        self._left_out = dict[str, str]()  # name of a node -> why
        self._numbers = 0
        self._running = dict[int, tuple[Any, str]]()  # job and node of a task
        self._losses = Counter[str]()  # of jobs, by id
        self._heard = time.monotonic()
        self._folder = Path(tempfile.mkdtemp(prefix="sumo_adv-"))
        self._spawn(driver)
        try:
            self._connected()
        except BaseException:
            self.close()
            raise

    @property
    def processors(self) -> int:
        """Of all nodes that are not left out."""
        return sum(place.node.processors for place in self._places.values() if place.fit is not False)

    def put(self, sent: Any) -> int:
        """The key of a value in Ray's store."""
        self._numbers += 1
        self._send(Put(self._numbers, sent))
        return self._numbers

    def run(
        self,
        jobs: Iterable[Any],
        needs: int,
        sent: Callable[[], int],
        keep: Callable[[Any, Any], Done],
        lost: Callable[[Any, str, str], Done],
        told: Callable[[Any, Done], None],
    ) -> None:
        """Each job; ``told`` of what ``keep`` makes of its task's result, or ``lost`` of its loss (job, why, text).

        needs: the key of what nodes are checked with. sent: that of what tasks get that begin from now on.

        Raises SumoAdvError: the cluster is lost, or a job cannot be run anywhere. UsageError: no node is fit.
        """
        waiting = deque(jobs)
        while not self._stop.now:
            self._assign(waiting, needs, sent)
            at_work = any(job is not CHECK for job, _ in self._running.values())
            if not at_work and (self._stop.drain or not waiting):
                break
            for message in self._messages():
                self._hear(message, waiting, keep, lost, told)
            self._refuse_if_all_are_unfit(waiting)

    def close(self) -> None:
        """Leave the cluster; what still runs there is ended by Ray."""
        self._send(None)
        self._process.join(RAY_CLOSE_TIMEOUT_S if self._places else 0.0)  # where it has not connected it hears nothing
        with suppress(OSError, AttributeError):
            os.killpg(self._process.pid or 0, signal.SIGKILL)
        self._process.kill()
        self._process.join()
        self._connection.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    # -- the process that speaks to Ray -------------------------------------------------------------------------

    def _spawn(self, driver: Callable[[Connection, str, Path], None]) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, other_end = context.Pipe()
        self._process = context.Process(target=driver, args=(other_end, self._address, self._folder))
        quiet = {name: value for name, value in SINGLE_THREAD_VARIABLES.items() if name not in os.environ}
        with environment(quiet), deferred_interrupts():
            self._process.start()
        other_end.close()

    def _send(self, command: Put | Start | None) -> None:
        with suppress(OSError):  # it is gone: found by ``_messages``
            self._connection.send(command)

    def _connected(self) -> None:
        """Wait for the cluster's nodes, or for Ctrl-C. Raises UsageError."""
        until, limit = time.monotonic() + RAY_START_TIMEOUT_S, RAY_START_TIMEOUT_S
        while not self._stop.drain:
            if time.monotonic() > until:
                raise self._no_cluster(f"no answer within {limit:g} s")
            if not self._connection.poll(POLL_INTERVAL_S):
                continue
            try:
                message = self._connection.recv()
            except (EOFError, OSError):
                raise self._no_cluster(self._last_words()) from None
            if isinstance(message, JobRefused):
                raise self._no_cluster(message.why)
            if isinstance(message, Nodes):
                self._look(message)
                return
            until, limit = time.monotonic() + CLUSTER_TIMEOUT_S, CLUSTER_TIMEOUT_S

    def _no_cluster(self, why: str) -> UsageError:
        if "not installed" in why:
            return UsageError(f"--ray needs Ray. {why}.")
        return UsageError(f"No Ray cluster answers at {self._address} ({why}); see ray start.")

    def _messages(self) -> Iterator[Any]:
        """What has come. Raises SumoAdvError where the process has died, or the cluster is silent."""
        if not self._connection.poll(POLL_INTERVAL_S):
            if time.monotonic() - self._heard > CLUSTER_SILENCE_TIMEOUT_S:
                raise self._cluster_lost(f"silent for {CLUSTER_SILENCE_TIMEOUT_S:g} s")
            return
        while self._connection.poll():
            try:
                yield self._connection.recv()
            except (EOFError, OSError):
                raise self._cluster_lost(self._last_words()) from None
            self._heard = time.monotonic()

    def _cluster_lost(self, why: str) -> SumoAdvError:
        return SumoAdvError(
            f"The Ray cluster at {self._address} was lost ({why}). What was finished is kept: give the same command "
            "again when the cluster is back."
        )

    def _last_words(self) -> str:
        """The first sentence of the last line that Ray has printed, without its place in Ray."""
        text = ""
        with suppress(OSError):
            text = (self._folder / LOG).read_text(errors="replace")
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        return (
            LOG_LINE_ORIGIN.sub("", lines[-1]).partition(". ")[0][:200].rstrip(".")
            if lines
            else "Ray ended without a word"
        )

    # -- jobs and nodes -----------------------------------------------------------------------------------------

    def _look(self, nodes: Nodes) -> None:
        """Forget nodes that are gone. Tasks that they had come back as lost."""
        self._heard = time.monotonic()
        alive = {node.id: node for node in nodes.alive}
        for gone in self._places.keys() - alive.keys():
            del self._places[gone]
        for name, node in alive.items():
            self._places.setdefault(name, _Place(node))

    def _assign(self, waiting: deque[Any], needs: int, sent: Callable[[], int]) -> None:
        """Check new nodes, and give jobs to free processors."""
        if self._stop.drain:
            return
        for place in self._places.values():
            if place.fit is None and place.busy == 0:
                self._start(place, CHECK, self._unfit, (needs,))
        while waiting:
            free = [p for p in self._places.values() if p.fit and p.busy < p.node.processors]
            if not free:
                return
            place = max(free, key=lambda p: p.node.processors - p.busy)
            job = waiting.popleft()
            self._start(place, job, self._task, (sent(),), job)

    def _start(
        self, place: _Place, job: Any, function: Callable[..., Any], keys: tuple[int, ...], *arguments: Any
    ) -> None:
        self._numbers += 1
        place.busy += 1
        self._running[self._numbers] = job, place.node.id
        self._send(Start(self._numbers, place.node.id, function, keys, arguments, self._recycle))

    def _hear(
        self, message: Any, waiting: deque[Any], keep: Callable[[Any, Any], Done],
        lost: Callable[[Any, str, str], Done], told: Callable[[Any, Done], None],
    ) -> None:  # fmt: skip
        if isinstance(message, Nodes):
            self._look(message)
            return
        job, node = self._running.pop(message.number)
        place = self._places.get(node)
        if place is not None:
            place.busy -= 1
        if job is CHECK:
            self._checked(place, message)
        elif isinstance(message, JobResult):
            told(job, keep(job, message.value))
        elif isinstance(message, Raised):
            if not isinstance(message.error, UsageError):
                raise message.error
            self._leave_out(place, str(message.error))
            waiting.appendleft(job)
        else:
            self._losses[job.id] += 1
            if self._losses[job.id] <= MAX_LOSSES_PER_JOB:
                waiting.appendleft(job)
            else:
                told(job, lost(job, f"Its worker or node was lost {MAX_LOSSES_PER_JOB + 1} times.", message.text))

    def _checked(self, place: _Place | None, message: JobResult | Raised | Lost) -> None:
        if place is None or isinstance(message, Lost):  # looked at again, if it is still there
            return
        why = str(message.value if isinstance(message, JobResult) else message.error)
        place.fit = True
        if why:
            self._leave_out(place, why)

    def _leave_out(self, place: _Place | None, why: str) -> None:
        if place is None or place.fit is False:
            return
        place.fit = False
        reason = why.strip().rstrip(".")
        if self._left_out.get(place.node.name) != reason:
            self._left_out[place.node.name] = reason
            self._tell(f"The node {place.node.name} is left out: {reason}.")

    def _refuse_if_all_are_unfit(self, waiting: deque[Any]) -> None:
        if waiting and not self._running and self._places and all(p.fit is False for p in self._places.values()):
            reasons = "; ".join(f"{name}: {why}" for name, why in self._left_out.items())
            raise UsageError(f"No node of the Ray cluster at {self._address} can be used ({reasons}).")


def processors_of(address: str) -> int:
    """The processors of a cluster. Raises UsageError."""
    pool = RayPool(_nothing, _fit, 1, address, Stop())
    try:
        return max(1, pool.processors)
    finally:
        pool.close()


def _nothing(sent: Any, job: Any) -> None:
    return None


def _fit(needs: Any) -> str:
    return ""
