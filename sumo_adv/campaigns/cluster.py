"""The same batch on a Ray cluster: a task an episode, whose worker runs it in a watched process of its own as on one
machine, and sends the run's folder back. Results and bank are written here alone.

As many tasks run at a time as the cluster has processors. What a lost node or worker was at is Ray's to try again,
``LOSSES`` times. Inputs are found on the nodes under the same paths (a shared file system) or are shipped ones; their
content is compared with the plan's.
"""

from __future__ import annotations

import atexit
import io
import logging
import os
import shutil
import socket
import sys
import tempfile
import time
import zipfile
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from sumo_adv.campaigns.local import LocalWorkers, Pace, Stop
from sumo_adv.campaigns.plan import hash_of
from sumo_adv.campaigns.results import LEARNT, Done, Job, Learn, Setup, read_row
from sumo_adv.campaigns.store import Store
from sumo_adv.campaigns.worker import lessons_of, share, teach
from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.files import scratch_prefix, sentences
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.simulation.inputs import is_commonroad, load_input

LOSSES = 5  # times that Ray tries a job again after its worker or node was lost
JOIN_SECONDS = 60.0  # for a node to say its versions
LOST_SECONDS = 10.0  # for Ray to say that a node is lost which did not answer
KNOCK_SECONDS = 10.0
DESK = "sumo_adv-ray-"  # folders of Ray workers, with their process ids
TICK = 0.5  # s


class RayPool:
    """Runs ``task(sent, job)`` on the cluster for each job; ``sent`` is put into Ray's store once (``put``).

    Raises UsageError: Ray is not installed, no cluster at ``address``, another version on a node.
    """

    def __init__(
        self, task: Callable[..., Any], pace: Pace, address: str, versions: Mapping[str, str], stop: Stop
    ) -> None:
        self._stop = stop
        self._aside = redirect_stdout(sys.stderr)  # where Ray tells of lost workers and nodes: it prints to stdout
        self._ray = connect(address)
        self._aside.__enter__()
        try:
            check_nodes(self._ray, versions)
            self._task = self._ray.remote(num_cpus=1, max_retries=LOSSES, max_calls=pace.recycle)(task)
        except BaseException:
            self.close()
            raise

    def put(self, sent: Any) -> Any:
        """What every task needs, as a reference to Ray's store."""
        return self._ray.put(sent)

    def run(
        self,
        jobs: Iterable[Any],
        sent: Callable[[], Any],
        keep: Callable[[Any, Any], Done],
        lost: Callable[[Any, str, str], Done],
        told: Callable[[Any, Done], None],
    ) -> None:
        """Each job; ``told`` of what ``keep`` makes of its task's result, or ``lost`` of its loss (job, why, text).

        sent: the reference that tasks get which begin from now on. Raises SumoAdvError.
        """
        waiting, running = deque(jobs), dict[Any, Any]()
        while not self._stop.now:
            while waiting and len(running) < self._places() and not self._stop.drain:
                job = waiting.popleft()
                running[self._task.remote(sent(), job)] = job
            if not running:
                break
            for ready in self._ray.wait(list(running), timeout=TICK)[0]:
                job = running.pop(ready)
                told(job, self._result(job, ready, keep, lost))

    def close(self) -> None:
        self._ray.shutdown()
        self._aside.__exit__(None, None, None)

    def _places(self) -> int:
        return max(1, int(self._ray.cluster_resources().get("CPU", 0)))

    def _result(
        self, job: Any, ready: Any, keep: Callable[[Any, Any], Done], lost: Callable[[Any, str, str], Done]
    ) -> Done:
        try:
            result = self._ray.get(ready)
        except self._ray.exceptions.RayTaskError as error:
            cause = error.cause
            raise cause if isinstance(cause, SumoAdvError) else SumoAdvError(f"A node failed ({cause}).") from error
        except self._ray.exceptions.RayError as error:
            return lost(job, f"Its worker or node was lost {LOSSES + 1} times.", str(error))
        return keep(job, result)


def connect(address: str) -> Any:
    try:
        import ray
    except ImportError as error:
        raise UsageError("--ray needs Ray, which is not installed: pip install 'sumo-adv[ray]'.") from error
    try:
        _knock(address)
        ray.init(address=address, log_to_driver=False, configure_logging=True, logging_level=logging.ERROR)
    except Exception as error:
        reason = str(error).strip().splitlines()[0].rstrip(".") if str(error).strip() else type(error).__name__
        raise UsageError(f"No Ray cluster answers at {address} ({reason}); see ray start.") from error
    return ray


def _knock(address: str) -> None:
    """Raises OSError if no server listens at HOST:PORT: Ray itself would go on trying for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host, int(port)), KNOCK_SECONDS).close()


def check_nodes(ray: Any, versions: Mapping[str, str]) -> None:
    """Raises UsageError if a node has other versions of what takes part in the numbers."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    alive = [node for node in ray.nodes() if node["Alive"] and node["Resources"].get("CPU", 0) >= 1]
    if not alive:
        raise UsageError("The Ray cluster has no node with a processor.")
    task = ray.remote(num_cpus=1, max_retries=LOSSES)(node_versions)
    for node in alive:
        strategy = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
        name = node["NodeManagerHostname"]
        try:
            installed = ray.get(task.options(scheduling_strategy=strategy).remote(list(versions)), timeout=JOIN_SECONDS)
        except ray.exceptions.RayError as error:
            if _gone(ray, node["NodeID"]):
                continue
            raise UsageError(f"The node {name} cannot run sumo_adv ({_first_line(error)}).") from error
        differing = [f"{k} {installed.get(k)} there, {v} here" for k, v in versions.items() if installed.get(k) != v]
        if differing:
            raise UsageError(f"The node {name} has other versions: {'; '.join(differing)}; install the same on all.")


def _gone(ray: Any, node_id: str) -> bool:
    """Whether a node that did not answer was lost. Ray may notice a killed node only some seconds later."""
    until = time.monotonic() + LOST_SECONDS
    while any(node["NodeID"] == node_id and node["Alive"] for node in ray.nodes()):
        if time.monotonic() > until:
            return False
        time.sleep(TICK)
    return True


def _first_line(error: BaseException) -> str:
    lines = [line for line in str(error).splitlines() if line.strip()]
    return lines[-1].strip() if lines else type(error).__name__


# -- versions and folders of a node ------------------------------------------------------------------------------------


def node_versions(names: Iterable[str]) -> dict[str, str]:
    """What this node has of what takes part in the numbers: ``sumo_adv``, ``python``, and packages."""
    import platform
    from importlib import metadata

    import sumo_adv

    versions = {"sumo_adv": sumo_adv.__version__, "python": platform.python_version()}
    for name in set(names) - set(versions):
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions


def desk_folder() -> Path:
    """A folder for this Ray worker process, removed when it ends; those of killed ones are removed now."""
    if Path("/proc/self").exists():
        for left in Path(tempfile.gettempdir()).glob(f"{DESK}*"):
            if not Path(f"/proc/{left.name.removeprefix(DESK).partition('-')[0]}").exists():
                shutil.rmtree(left, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=f"{DESK}{os.getpid()}-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@dataclass(frozen=True, slots=True)
class Sent:
    """What a node needs for all episodes; ``edition`` of the bank's snapshot."""

    setup: Setup
    pace: Pace
    bank: bytes
    edition: int


class ClusterWorkers:
    """Runs jobs as Ray tasks. Raises UsageError as ``RayPool`` does."""

    def __init__(
        self, setup: Setup, pace: Pace, address: str, versions: Mapping[str, str], store: Store, stop: Stop
    ) -> None:
        self._setup, self._pace, self._store = setup, pace, store
        self._pool = RayPool(episode, pace, address, versions, stop)
        self._edition = 0
        try:
            self._sent = self._send()
        except BaseException:
            self.close()
            raise

    def run(self, jobs: Iterable[Job], told: Callable[[Job, Done], None]) -> None:
        self._pool.run(jobs, lambda: self._sent, self._keep, self._store.fail, told)

    def close(self) -> None:
        self._pool.close()

    def _keep(self, job: Job, result: tuple[bytes, int]) -> Done:
        """Put a run's folder in its place, and with ``Learn.DURING`` what was learnt into the bank."""
        data, size = result
        with self._setup.parts.staged(self._setup.runs / job.id, force=True, inside=True) as folder:
            with zipfile.ZipFile(io.BytesIO(data)) as packed:
                packed.extractall(folder.stage)
            share(folder.stage / "inputs", self._setup.runs.parent / "inputs")
            folder.keep(force=True)
        kept = self._setup.runs / job.id
        if self._setup.learn is Learn.DURING and (kept / LEARNT).exists():
            with MemoryBank.open(self._setup.bank) as bank:
                if teach(bank, lessons_of((kept / LEARNT).read_text(encoding="utf-8"), f"The file {kept / LEARNT}")):
                    self._sent = self._send()
        return Done(job.id, read_row(kept), size)

    def _send(self) -> Any:
        """A snapshot of the bank to the nodes; episodes that begin from now on read it."""
        self._edition += 1
        with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as folder, sentences(self._setup.bank):
            place = Store(Path(folder), self._setup.parts.staged)
            place.snapshot(self._setup.bank)
            data = place.bank.read_bytes()
        learn = Learn.OFF if self._setup.learn is Learn.OFF else Learn.AFTER  # nodes collect, and never write
        return self._pool.put(Sent(replace(self._setup, learn=learn), self._pace, data, self._edition))


# -- on a node ---------------------------------------------------------------------------------------------------------


@dataclass
class _Desk:
    """What a Ray worker process keeps from episode to episode."""

    store: Store
    workers: LocalWorkers
    edition: int = 0


_desks: list[_Desk] = []


def episode(sent: Sent, job: Job) -> tuple[bytes, int]:
    """One episode on this node: its folder as a zip file, and its bytes without inputs."""
    desk = _desk(sent)
    wrong = wrong_content(job.input.source, job.input.content, job.input.record)
    results: list[Done] = []
    if wrong:
        results.append(desk.store.fail(job, wrong, ""))
    else:
        desk.workers.run([job], lambda _, done: results.append(done))
    place = desk.store.runs / job.id
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as packed:
        for file in sorted(p for p in place.rglob("*") if p.is_file()):
            packed.write(file, file.relative_to(place).as_posix())
    shutil.rmtree(place)
    return data.getvalue(), results[0].bytes


def _desk(sent: Sent) -> _Desk:
    """The desk of this process, with the bank as it was sent."""
    if not _desks:
        store = Store(desk_folder(), sent.setup.parts.staged)
        store.runs.mkdir()
        setup = replace(sent.setup, runs=store.runs, bank=store.bank)
        workers = LocalWorkers(setup, replace(sent.pace, workers=1), store.folder, store.fail, Stop())
        _desks.append(_Desk(store, workers))
        atexit.register(workers.close)
    desk = _desks[0]
    if desk.edition != sent.edition:
        part = desk.store.folder / "bank.part"
        part.write_bytes(sent.bank)
        part.replace(desk.store.bank)
        desk.edition = sent.edition
    return desk


@lru_cache(maxsize=10_000)
def wrong_content(source: Path, content: str, record: str | None) -> str:
    """Why an input on this node is not the plan's, '' if it is. Records are compared by their ids alone."""
    if record is not None:
        return "" if source.is_file() else f"There is no file {source} on this node."
    try:
        files = (source,) if is_commonroad(source) else load_input(source).files
        same = hash_of(files) == content
    except (SumoAdvError, OSError) as error:
        return f"On this node: {error}"
    return "" if same else f"On this node {source} has another content than in the plan."
