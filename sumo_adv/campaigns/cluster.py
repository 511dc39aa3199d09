"""The same batch on a Ray cluster: a task an episode, whose worker runs it in a watched process of its own as on one
machine, and sends the run's folder back. Results and bank are written here alone.

Inputs are found on the nodes under the same paths (a shared file system) or are shipped ones; their content is compared
with the plan's.
"""

from __future__ import annotations

import atexit
import io
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from sumo_adv.campaigns.inputs import hash_of
from sumo_adv.campaigns.learning import lessons_of, teach
from sumo_adv.campaigns.local import LocalWorkers, Pace, Stop
from sumo_adv.campaigns.nouns import Done, Job, Learn, Setup
from sumo_adv.campaigns.ray_pool import RayPool, desk_folder
from sumo_adv.campaigns.results import LEARNT, OUTCOME, read_row, write_failure
from sumo_adv.campaigns.store import Store
from sumo_adv.campaigns.worker import share
from sumo_adv.errors import SumoAdvError
from sumo_adv.files import sentences
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.simulation.inputs import is_commonroad, load_input


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
        """Each job, ``told`` of each that is finished. Raises SumoAdvError."""
        self._pool.run(jobs, lambda: self._sent, self._keep, self._store.fail, told)

    def close(self) -> None:
        """Leave the cluster; what still runs there is ended by Ray."""
        self._pool.close()

    def _keep(self, job: Job, result: tuple[bytes, int]) -> Done:
        """Put a run's folder in its place, and with ``Learn.DURING`` what was learnt into the bank."""
        data, size = result
        with self._setup.parts.staged(self._setup.runs / job.id, force=True, marker=OUTCOME) as folder:
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
        with tempfile.TemporaryDirectory(prefix="sumo_adv-") as folder, sentences(self._setup.bank):
            place = Store(Path(folder), self._setup.parts.staged)
            place.snapshot(self._setup.bank)
            data = place.bank.read_bytes()
        learn = Learn.OFF if self._setup.learn is Learn.OFF else Learn.AFTER  # nodes collect, and never write
        return self._pool.put(Sent(replace(self._setup, learn=learn), self._pace, data, self._edition))


# -- on a node ---------------------------------------------------------------------------------------------------------


@dataclass
class _Desk:
    """What a Ray worker process keeps from episode to episode."""

    folder: Path
    workers: LocalWorkers
    edition: int = 0


_desks: list[_Desk] = []


def episode(sent: Sent, job: Job) -> tuple[bytes, int]:
    """One episode on this node: its folder as a zip file, and its bytes without inputs."""
    desk = _desk(sent)
    runs = desk.folder / "runs"
    wrong = wrong_content(job.input.source, job.input.content, job.input.record)
    results: list[Done] = []
    if wrong:
        results.append(_fail(runs, job, wrong, ""))
    else:
        desk.workers.run([job], lambda _, done: results.append(done))
    place = runs / job.id
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as packed:
        for file in sorted(p for p in place.rglob("*") if p.is_file()):
            packed.write(file, file.relative_to(place).as_posix())
    shutil.rmtree(place)
    return data.getvalue(), results[0].bytes


def _desk(sent: Sent) -> _Desk:
    """The desk of this process, with the bank as it was sent."""
    if not _desks:
        folder = desk_folder()
        (folder / "runs").mkdir()
        setup = replace(sent.setup, runs=folder / "runs", bank=folder / "bank.sqlite")
        pace = replace(sent.pace, workers=1)
        workers = LocalWorkers(setup, pace, folder, lambda job, why, text: _fail(setup.runs, job, why, text), Stop())
        _desks.append(_Desk(folder, workers))
        atexit.register(workers.close)
    desk = _desks[0]
    if desk.edition != sent.edition:
        part = desk.folder / "bank.part"
        part.write_bytes(sent.bank)
        part.replace(desk.folder / "bank.sqlite")
        desk.edition = sent.edition
    return desk


def _fail(runs: Path, job: Job, why: str, text: str) -> Done:
    for left in runs.glob(f".{job.id}*"):
        shutil.rmtree(left, ignore_errors=True)
    (runs / job.id).mkdir(exist_ok=True)
    return Done(job.id, write_failure(runs / job.id, job, why, text))


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
