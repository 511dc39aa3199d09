"""Run a batch on a Ray cluster.

Each episode is a Ray task. The task's worker runs the episode in a watched process of its own, as on one machine, and
sends the run's folder back. Only this side writes results and the bank.

An input is found on a node under the same path (on a shared file system), or it is a shipped one. A node gets no
episode if it lacks an input or the ego's driver, or if it has an input with other content or other versions
(``unfit``).
"""

from __future__ import annotations

import atexit
import io
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from sumo_adv.campaigns.local import LocalWorkers, Stop, WorkerPace
from sumo_adv.campaigns.plan import files_hash
from sumo_adv.campaigns.ray_pool import RayPool
from sumo_adv.campaigns.results import LEARNT_FILE, Done, EpisodeJob, Learn, WorkerSetup, read_row
from sumo_adv.campaigns.store import Store
from sumo_adv.campaigns.worker import lessons_of, share, teach
from sumo_adv.drivers.registry import check_name, find_class
from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.files import scratch_prefix, sentences
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.simulation.inputs import is_commonroad, load_input

DESK = "sumo_adv-ray-"  # prefix of Ray workers' folders; their process ids follow


# -- what a node needs ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Needs:
    """What a node must have.

    Attributes:
        versions: The versions of the packages that affect the numbers.
        inputs: The path, content and record of each input.
        egos: The names of drivers.
    """

    versions: Mapping[str, str]
    inputs: tuple[tuple[Path, str, str | None], ...]
    egos: tuple[str, ...]

    @classmethod
    def of(cls, jobs: Iterable[EpisodeJob], versions: Mapping[str, str]) -> Needs:
        """Collect what jobs need.

        Inputs that cannot be read here either are left out. Their episodes fail with the reason, and no node is to
        blame.

        Args:
            jobs: The jobs.
            versions: The versions of the packages that affect the numbers.

        Returns:
            The needs.
        """
        jobs = list(jobs)
        inputs = dict.fromkeys((job.input.path, job.input.content, job.input.record) for job in jobs)
        egos = dict.fromkeys(job.ego for job in jobs if job.ego is not None)
        return cls(versions, tuple(each for each in inputs if not wrong_content(*each)), tuple(egos))


def unfit(needs: Needs) -> str:
    """Check this node.

    Args:
        needs: What the node must have.

    Returns:
        Why the node cannot run the episodes; '' if it can.
    """
    installed = node_versions(list(needs.versions))
    differing = [f"{k} {installed.get(k)} there, {v} here" for k, v in needs.versions.items() if installed.get(k) != v]
    if differing:
        return f"it has other versions: {'; '.join(differing)}; install the same versions on all nodes"
    for ego in needs.egos:
        try:
            find_class("ego", ego) if ":" in ego else check_name(ego)
        except UsageError as error:
            return str(error)
    return next((wrong for each in needs.inputs if (wrong := wrong_content(*each))), "")


def node_versions(names: Iterable[str]) -> dict[str, str]:
    """Return the versions on this node that affect the numbers: ``sumo_adv``, ``python``, and the named packages."""
    import platform
    from importlib import metadata

    import sumo_adv

    versions = {"sumo_adv": sumo_adv.__version__, "python": platform.python_version()}
    for name in set(names) - set(versions):
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions


REMOVER = """\
import os, shutil, sys
if os.fork():
    os._exit(0)
os.setsid()
sys.stdin.read()
shutil.rmtree(sys.argv[1], ignore_errors=True)
"""


_removers: list[subprocess.Popen[bytes]] = []


def desk_folder() -> Path:
    """Create a folder for this Ray worker process.

    The folder is removed when the process ends, however it ends. Ray kills its workers with their children, so the
    process that waits for the end is not a child of the worker.

    Returns:
        The folder.
    """
    folder = Path(tempfile.mkdtemp(prefix=f"{DESK}{os.getpid()}-"))
    command = [sys.executable, "-c", REMOVER, str(folder)]
    remover = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _removers.append(remover)  # its pipe must stay open
    return folder


# -- here -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class NodeContent:
    """What a node needs for all episodes.

    Attributes:
        setup: The workers' setup.
        pace: How the work is done.
        bank: The bank's snapshot.
        edition: The number of the snapshot.
    """

    setup: WorkerSetup
    pace: WorkerPace
    bank: bytes
    edition: int


class ClusterWorkers:
    """Runs jobs as Ray tasks."""

    def __init__(
        self, setup: WorkerSetup, pace: WorkerPace, address: str, versions: Mapping[str, str], store: Store, stop: Stop
    ) -> None:
        """Connect to the cluster and send the bank's snapshot.

        Args:
            setup: The workers' setup.
            pace: How the work is done.
            address: The cluster's address.
            versions: The versions that nodes must have.
            store: The folder of the results.
            stop: The state of Ctrl-C.

        Raises:
            UsageError: Ray is not installed, or no cluster answers.
        """
        self._setup, self._pace, self._store, self._versions = setup, pace, store, versions
        self._pool = RayPool(episode, unfit, pace.recycle, address, stop)
        self._edition = 0
        try:
            self._sent = self._send()
        except BaseException:
            self.close()
            raise

    def run(self, jobs: Sequence[EpisodeJob], told: Callable[[EpisodeJob, Done], None]) -> None:
        """Run all jobs; see :class:`Workers`."""
        needs = self._pool.put(Needs.of(jobs, self._versions))
        self._pool.run(jobs, needs, lambda: self._sent, self._keep, self._store.fail, told)

    def close(self) -> None:
        """Leave the cluster."""
        self._pool.close()

    def _keep(self, job: EpisodeJob, result: tuple[bytes, int]) -> Done:
        """Put a run's folder in its place; with ``Learn.DURING``, also write its lessons into the bank."""
        data, size = result
        with self._setup.parts.staged(self._setup.runs / job.id, force=True, inside=True) as folder:
            with zipfile.ZipFile(io.BytesIO(data)) as packed:
                packed.extractall(folder.stage)
            share(folder.stage / "inputs", self._setup.runs.parent / "inputs")
            folder.keep(force=True)
        kept = self._setup.runs / job.id
        if self._setup.learn is Learn.DURING and (kept / LEARNT_FILE).exists():
            with MemoryBank.open(self._setup.bank) as bank:
                if teach(
                    bank, lessons_of((kept / LEARNT_FILE).read_text(encoding="utf-8"), f"The file {kept / LEARNT_FILE}")
                ):
                    self._sent = self._send()
        return Done(job.id, read_row(kept), size)

    def _send(self) -> int:
        """Send a snapshot of the bank to the nodes; episodes that begin afterwards read it."""
        self._edition += 1
        with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as folder, sentences(self._setup.bank):
            place = Store(Path(folder), self._setup.parts.staged)
            place.snapshot(self._setup.bank)
            data = place.bank.read_bytes()
        learn = Learn.OFF if self._setup.learn is Learn.OFF else Learn.AFTER  # nodes collect, and never write
        return self._pool.put(NodeContent(replace(self._setup, learn=learn), self._pace, data, self._edition))


# -- on a node --------------------------------------------------------------------------------------------------------


@dataclass
class _Desk:
    """What a Ray worker process keeps from episode to episode."""

    store: Store
    workers: LocalWorkers
    edition: int = 0


_desks: list[_Desk] = []


def episode(sent: NodeContent, job: EpisodeJob) -> tuple[bytes, int]:
    """Run one episode on this node.

    Args:
        sent: What the node needs for all episodes.
        job: The episode.

    Returns:
        The run's folder as a zip file, and its size in bytes without inputs.
    """
    desk = _desk(sent)
    results: list[Done] = []
    desk.workers.run([job], lambda _, done: results.append(done))
    place = desk.store.runs / job.id
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as packed:
        for file in sorted(p for p in place.rglob("*") if p.is_file()):
            packed.write(file, file.relative_to(place).as_posix())
    shutil.rmtree(place)
    return data.getvalue(), results[0].bytes


def _desk(sent: NodeContent) -> _Desk:
    """Return the desk of this process, with the snapshot of the bank that was sent."""
    if not _desks:
        store = Store(desk_folder(), sent.setup.parts.staged)
        store.runs.mkdir()
        setup = replace(sent.setup, runs=store.runs, bank=store.bank)
        workers = LocalWorkers(setup, replace(sent.pace, workers=1, until=None), store.folder, store.fail, Stop())
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
def wrong_content(path: Path, content: str, record: str | None) -> str:
    """Compare an input on this node with the plan's. A record's file only needs to exist, its content is not compared.

    Args:
        path: The input.
        content: The hash that the plan has.
        record: The id of a Waymo record; None for other inputs.

    Returns:
        Why the input differs; '' if it does not.
    """
    if record is not None:
        return "" if path.is_file() else f"There is no file {path} on this node."
    try:
        files = (path,) if is_commonroad(path) else load_input(path).files
        same = files_hash(files) == content
    except (SumoAdvError, OSError) as error:
        return f"On this node: {error}"
    return (
        "" if same else f"On this node, the content of {path} differs from the plan; copy the same file to all nodes."
    )
