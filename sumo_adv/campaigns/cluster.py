"""The same batch on a Ray cluster: a task an episode, whose worker runs it in a watched process of its own as on one
machine, and sends the run's folder back. Results and bank are written here alone.

Inputs are found on the nodes under the same paths (a shared file system) or are shipped ones. A node without one, with
another content, without the ego's driver, or with other versions gets no episode (``unfit``).
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

DESK = "sumo_adv-ray-"  # folders of Ray workers, with their process ids


# -- what a node needs ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Needs:
    """What a node must have. versions: of what takes part in the numbers; inputs: path, content and record of each;
    egos: drivers by name."""

    versions: Mapping[str, str]
    inputs: tuple[tuple[Path, str, str | None], ...]
    egos: tuple[str, ...]

    @classmethod
    def of(cls, jobs: Iterable[EpisodeJob], versions: Mapping[str, str]) -> Needs:
        """Those of jobs. Inputs that cannot be read here either are no node's fault: their episodes say so."""
        jobs = list(jobs)
        inputs = dict.fromkeys((job.input.path, job.input.content, job.input.record) for job in jobs)
        egos = dict.fromkeys(job.ego for job in jobs if job.ego is not None)
        return cls(versions, tuple(each for each in inputs if not wrong_content(*each)), tuple(egos))


def unfit(needs: Needs) -> str:
    """Why this node cannot run the episodes, '' if it can."""
    installed = node_versions(list(needs.versions))
    differing = [f"{k} {installed.get(k)} there, {v} here" for k, v in needs.versions.items() if installed.get(k) != v]
    if differing:
        return f"it has other versions: {'; '.join(differing)}; install the same on all"
    for ego in needs.egos:
        try:
            find_class("ego", ego) if ":" in ego else check_name(ego)
        except UsageError as error:
            return str(error)
    return next((wrong for each in needs.inputs if (wrong := wrong_content(*each))), "")


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
    """A folder for this Ray worker process. It is removed when the process ends, however that is: Ray kills its workers
    with their children, so a process that is no child of it waits for its end."""
    folder = Path(tempfile.mkdtemp(prefix=f"{DESK}{os.getpid()}-"))
    command = [sys.executable, "-c", REMOVER, str(folder)]
    remover = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _removers.append(remover)  # its pipe must stay open
    return folder


# -- here -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class NodeContent:
    """What a node needs for all episodes; ``edition`` of the bank's snapshot."""

    setup: WorkerSetup
    pace: WorkerPace
    bank: bytes
    edition: int


class ClusterWorkers:
    """Runs jobs as Ray tasks. Raises UsageError as ``RayPool`` does."""

    def __init__(
        self, setup: WorkerSetup, pace: WorkerPace, address: str, versions: Mapping[str, str], store: Store, stop: Stop
    ) -> None:
        self._setup, self._pace, self._store, self._versions = setup, pace, store, versions
        self._pool = RayPool(episode, unfit, pace.recycle, address, stop)
        self._edition = 0
        try:
            self._sent = self._send()
        except BaseException:
            self.close()
            raise

    def run(self, jobs: Sequence[EpisodeJob], told: Callable[[EpisodeJob, Done], None]) -> None:
        needs = self._pool.put(Needs.of(jobs, self._versions))
        self._pool.run(jobs, needs, lambda: self._sent, self._keep, self._store.fail, told)

    def close(self) -> None:
        self._pool.close()

    def _keep(self, job: EpisodeJob, result: tuple[bytes, int]) -> Done:
        """Put a run's folder in its place, and with ``Learn.DURING`` what was learnt into the bank."""
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
        """A snapshot of the bank to the nodes; episodes that begin from now on read it."""
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
    """One episode on this node: its folder as a zip file, and its bytes without inputs."""
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
def wrong_content(path: Path, content: str, record: str | None) -> str:
    """Why an input on this node is not the plan's, '' if it is. Records are compared by their ids alone."""
    if record is not None:
        return "" if path.is_file() else f"There is no file {path} on this node."
    try:
        files = (path,) if is_commonroad(path) else load_input(path).files
        same = files_hash(files) == content
    except (SumoAdvError, OSError) as error:
        return f"On this node: {error}"
    return "" if same else f"On this node {path} has another content than in the plan."
