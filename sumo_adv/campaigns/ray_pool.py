"""Run jobs on the nodes of a Ray cluster. Each node is checked before its first job, and left out if it is unfit.

A node runs as many jobs at a time as it has processors. A job whose worker or node was lost is tried again,
``MAX_LOSSES_PER_JOB`` times. A job on a node that turns out to be unfit is run elsewhere. A process of its own talks to
Ray (``ray_driver.py``). If that process hangs or dies, this one reports it and ends in order.
"""

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

MAX_LOSSES_PER_JOB = 5  # retries of a job whose worker or node was lost
RAY_START_TIMEOUT_S = 60.0  # for Python to start and to import Ray
CLUSTER_TIMEOUT_S = 10.0  # for the cluster to answer
CLUSTER_SILENCE_TIMEOUT_S = 90.0  # without a message of the cluster; Ray itself gives up its head after 60 s
RAY_CLOSE_TIMEOUT_S = 5.0  # for Ray to leave the cluster
LOG_LINE_ORIGIN = re.compile(r"^\[[^\]]*\] *(\S+:\d+: )?")  # at the beginning of a line of Ray's log
CHECK = "check"  # the job that marks a node's check


@dataclass
class _Place:
    """A node, whether it is fit (None: not checked yet), and the number of its jobs."""

    node: Node
    fit: bool | None = None
    busy: int = 0


class RayPool:
    """Runs ``task(sent, job)`` on the cluster for each job; ``sent`` is put into Ray's store once (``put``)."""

    def __init__(
        self, task: Callable[..., Any], unfit: Callable[[Any], str], recycle: int, address: str, stop: Stop, *,
        driver: Callable[[Connection, str, Path], None] = ray_driver.serve_jobs,
        tell: Callable[[str], None] = lambda sentence: print(f"sumo-adv: {sentence}", file=sys.stderr, flush=True),
    ) -> None:  # fmt: skip
        """Connect, which takes some seconds.

        Args:
            task: Runs one job on a node.
            unfit: Runs on each node before its first job, with the requirements that ``run`` gives. Returns why the
                node cannot be used, or '' if it can.
            recycle: The number of jobs after which a worker process of a node is replaced.
            address: The cluster's address.
            stop: The state of Ctrl-C. If it is pressed before the cluster answers, the pool has no nodes.
            driver: Talks to Ray, in a process of its own.
            tell: Called with a sentence for each node that is left out.

        Raises:
            UsageError: Ray is not installed, or no cluster at ``address`` answers within ``CLUSTER_TIMEOUT_S``.
        """
        self._task, self._unfit, self._recycle = task, unfit, recycle
        self._address, self._stop, self._tell = address, stop, tell
        self._places = dict[str, _Place]()
        self._left_out = dict[str, str]()  # name of a node -> reason
        self._numbers = 0
        self._running = dict[int, tuple[Any, str]]()  # job and node of a task
        self._losses = Counter[str]()  # losses of jobs, by id
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
        """The number of processors of all nodes that are not left out."""
        return sum(place.node.processors for place in self._places.values() if place.fit is not False)

    def put(self, sent: Any) -> int:
        """Put a value into Ray's store.

        Args:
            sent: The value.

        Returns:
            The key of the value.
        """
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
        """Run all jobs.

        Args:
            jobs: The jobs.
            needs: The key of the value that nodes are checked with.
            sent: Returns the key of the value that tasks get; called for each task when it begins.
            keep: Makes the outcome of a job from the result of its task.
            lost: Makes the outcome of a job that was lost too often, from the job, the reason and a text.
            told: Called with each job that is finished and its outcome.

        Raises:
            SumoAdvError: The cluster is lost, or a job cannot be run anywhere.
            UsageError: No node is fit.
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
        """Leave the cluster; Ray ends what still runs there."""
        self._send(None)
        self._process.join(RAY_CLOSE_TIMEOUT_S if self._places else 0.0)  # before it has connected, it receives nothing
        with suppress(OSError, AttributeError):
            os.killpg(self._process.pid or 0, signal.SIGKILL)
        self._process.kill()
        self._process.join()
        self._connection.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    # -- the process that speaks to Ray -------------------------------------------------------------------------

    def _spawn(self, driver: Callable[[Connection, str, Path], None]) -> None:
        """Start the process that talks to Ray."""
        context = multiprocessing.get_context("spawn")
        self._connection, other_end = context.Pipe()
        self._process = context.Process(target=driver, args=(other_end, self._address, self._folder))
        quiet = {name: value for name, value in SINGLE_THREAD_VARIABLES.items() if name not in os.environ}
        with environment(quiet), deferred_interrupts():
            self._process.start()
        other_end.close()

    def _send(self, command: Put | Start | None) -> None:
        with suppress(OSError):  # it is gone, which ``_messages`` finds
            self._connection.send(command)

    def _connected(self) -> None:
        """Wait for the cluster's nodes or for Ctrl-C. Raise UsageError if no cluster answers."""
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
        """Yield the messages that arrived. Raise SumoAdvError if the process has died or the cluster is silent."""
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
            f"The Ray cluster at {self._address} was lost ({why}). Finished work is kept: rerun the same command "
            "when the cluster is back."
        )

    def _last_words(self) -> str:
        """Return the first sentence of the last line that Ray printed, without its origin in Ray's code."""
        text = ""
        with suppress(OSError):
            text = (self._folder / LOG).read_text(errors="replace")
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        return (
            LOG_LINE_ORIGIN.sub("", lines[-1]).partition(". ")[0][:200].rstrip(".")
            if lines
            else "Ray ended without a message"
        )

    # -- jobs and nodes -----------------------------------------------------------------------------------------

    def _look(self, nodes: Nodes) -> None:
        """Update the nodes. Those that are gone are forgotten; their tasks are reported as lost."""
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
        """Send a task to a node."""
        self._numbers += 1
        place.busy += 1
        self._running[self._numbers] = job, place.node.id
        self._send(Start(self._numbers, place.node.id, function, keys, arguments, self._recycle))

    def _hear(
        self, message: Any, waiting: deque[Any], keep: Callable[[Any, Any], Done],
        lost: Callable[[Any, str, str], Done], told: Callable[[Any, Done], None],
    ) -> None:  # fmt: skip
        """Handle a message about the nodes or about a task."""
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
        """Handle the result of a node's check; a lost check is repeated if the node still exists."""
        if place is None or isinstance(message, Lost):  # checked again if it still exists
            return
        why = str(message.value if isinstance(message, JobResult) else message.error)
        place.fit = True
        if why:
            self._leave_out(place, why)

    def _leave_out(self, place: _Place | None, why: str) -> None:
        """Leave out a node, and report it once for each reason."""
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
    """Return the number of processors of a cluster, at least 1. Raise UsageError if no cluster answers."""
    pool = RayPool(_nothing, _fit, 1, address, Stop())
    try:
        return max(1, pool.processors)
    finally:
        pool.close()


def _nothing(sent: Any, job: Any) -> None:
    return None


def _fit(needs: Any) -> str:
    return ""
