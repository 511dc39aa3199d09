"""What an estimate is of, all of it in ``plan.json``; and its blocks of runs, here or on a Ray cluster.

The runs of a block follow each other in one process: SUMO is loaded once and loaded again for each run. On a cluster
each block is a task. Its worker runs the block in a watched process of its own, as on one machine, and sends the
records back. Inputs are found on the nodes under the same paths (a shared file system) or are shipped ones; their
content is compared with the plan's.
"""

from __future__ import annotations

import atexit
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, Self

import numpy as np

from sumo_adv.campaigns.cluster import Needs, desk_folder, unfit
from sumo_adv.campaigns.local import LocalWorkers, Stop, WorkerPace
from sumo_adv.campaigns.plan import files_hash
from sumo_adv.campaigns.ray_pool import RayPool
from sumo_adv.campaigns.results import Done
from sumo_adv.config import forget_environment, load_settings
from sumo_adv.drivers.registry import trusted_driver
from sumo_adv.drivers.tested import make_tested_ego
from sumo_adv.episode.drive import Drive, ego_type_file
from sumo_adv.episode.encounter_search import INSERTED_EGO, EncounterSearch
from sumo_adv.episode.task import Task, make_task, refuse_density
from sumo_adv.errors import SimulationError, UsageError
from sumo_adv.files import scratch_prefix
from sumo_adv.rate.proposal import ERRORS_PER_HOUR, ErrorProposal, chances
from sumo_adv.rate.run import RateRecord, RateRun
from sumo_adv.simulation.demand import generate_flows
from sumo_adv.simulation.inputs import EgoRoute, load_input
from sumo_adv.simulation.network import read_network
from sumo_adv.simulation.scan import scan_demand

RATE_SCHEMA = 1
MAX_EGO_WAIT_S = 60.0  # after the warm-up within which the ego must come
RUNS_PER_BLOCK = 20
PHASES = ("pilot", "runs", "plain")
_workers: list[LocalWorkers] = []  # of this Ray worker process: one, from its first block on


@dataclass(frozen=True, slots=True)
class RatePlan:
    """An estimate. source: as the command line names it; ego None = as the input says, else idm; density: departures a
    minute of generated traffic; warm_up, duration [s]: of a run; factor: of all error rates; pilot: number of runs."""

    source: Path
    ego: str | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict)
    density: float | None = None
    warm_up: float = 20.0
    duration: float = 60.0
    factor: float = 1.0
    pilot: int = 200
    plain: bool = False
    seed: int = 0

    def task(self, folder: Path) -> Task:
        """What SUMO is started with; traffic is generated into ``folder`` if the input has none.

        Raises UsageError: the input cannot be read, or is a recording; there is no such ego.
        """
        run_input = load_input(self.source)
        if run_input.playback is not None:
            raise UsageError(f"{self.source} plays a recording, where vehicles do not react; give a network.")
        refuse_density(run_input, self.density)
        driven = any(scan.vehicles or scan.flows for scan in map(scan_demand, run_input.additional))
        if not run_input.routes and not driven:
            end = self.warm_up + MAX_EGO_WAIT_S + self.duration
            density = run_input.density if self.density is None else self.density
            flows = generate_flows(run_input.network, folder / "flows.rou.xml", density=density, end=end)
            run_input = replace(run_input, routes=(flows,), begin=0.0)
        ego = trusted_driver(self.ego, run_input.ego_controller, run_input.path)
        chosen = {} if ego is None else {"ego": ego}
        settings = load_settings(None, **chosen, ego_parameters=dict(self.parameters), seed=self.seed)
        task = make_task(run_input, settings, folder)
        make_tested_ego(task.ego_driver, task.ego_parameters, settings)
        return task

    def content(self) -> str:
        """The SHA-256 of all files of the input. Raises UsageError or OSError."""
        files = load_input(self.source).files
        return sha256(b"".join(sha256(file.read_bytes()).digest() for file in files)).hexdigest()

    def document(self) -> dict[str, Any]:
        """The plan as JSON, with the content of the input and the rates of the model."""
        return {
            "schema": RATE_SCHEMA, **asdict(self), "source": str(self.source), "parameters": dict(self.parameters),
            "content": self.content(), "errors_per_hour": {str(kind): value for kind, value in ERRORS_PER_HOUR.items()},
        }  # fmt: skip


@dataclass(frozen=True, slots=True)
class Block:
    """Runs ``first`` to ``first + BLOCK - 1`` of a phase. starts: the proposal's table; None = from the model."""

    phase: str
    first: int
    starts: Sequence[Sequence[float]] | None

    @property
    def id(self) -> str:
        """The name of its file."""
        return f"{self.phase}-{self.first}"

    @property
    def words(self) -> str:
        """The block for people."""
        return f"{self.phase} {self.first} to {self.first + RUNS_PER_BLOCK - 1}"


def refuse_block(job: Block, why: str, text: str) -> Done:
    """What becomes of a block that cannot be run. Raises SimulationError."""
    raise SimulationError(f"The block of runs '{job.words}' cannot be run. {why}")


def seed_of(seed: int, phase: str, number: int) -> int:
    """The seed of a run, for SUMO and for its errors."""
    return int(np.random.SeedSequence([seed, PHASES.index(phase), number]).generate_state(1)[0] >> 1)


class BlockRunner:
    """Holds the simulation; a context manager. Raises UsageError or SimulationError."""

    def __init__(self, plan: RatePlan) -> None:
        forget_environment()
        self._plan = plan
        self._scratch = tempfile.TemporaryDirectory(prefix=scratch_prefix())
        folder = Path(self._scratch.name)
        self._task = task = plan.task(folder)
        controller, _ = make_tested_ego(task.ego_driver, task.ego_parameters, task.settings)
        spec = task.spec
        types = ego_type_file(controller, folder, (*spec.routes, *spec.additional))
        spec = replace(spec, additional=(*spec.additional, types), seed=0)
        self._drive = Drive(spec, controller, 0, deadline=task.settings.ego_deadline)
        EncounterSearch(self._drive, read_network(spec.network), task)  # what the driver sees; an ego with a route

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._drive.simulation.close()
        self._scratch.cleanup()

    def run(self, job: Block, *, last: bool) -> Done:
        """The records of a block, and of a pilot what it counted."""
        runs = [self.one(job, number) for number in range(job.first, job.first + RUNS_PER_BLOCK)]
        counts = [run.counts for run, _ in runs if job.phase == "pilot"]
        counted = [[array.tolist() for array in (c.chances, c.starts, c.crashes)] for c in counts]
        return Done(job.id, {"records": [asdict(record) for _, record in runs], "counts": counted})

    def one(self, job: Block, number: int) -> tuple[RateRun, RateRecord]:
        """One run of a block."""
        plan, task = self._plan, self._task
        seed = seed_of(plan.seed, job.phase, number)
        self._drive.restart(seed)
        proposal = None if job.starts is None else ErrorProposal(np.array(job.starts))
        run = RateRun(self._drive, chances(plan.factor), proposal, seed, pilot=job.phase == "pilot")
        ego = INSERTED_EGO if isinstance(task.ego, EgoRoute) else task.ego
        start = task.spec.recorded_from + (plan.warm_up if ego is None else 0.0)
        return run, run.until(ego, start, start + MAX_EGO_WAIT_S + plan.duration, plan.duration)


@dataclass(frozen=True, slots=True)
class RateNodeContent:
    """What a node needs for all blocks."""

    plan: RatePlan
    pace: WorkerPace
    content: str


class ClusterBlocks:
    """Runs blocks as Ray tasks. Raises UsageError as ``RayPool`` does."""

    def __init__(self, plan: RatePlan, pace: WorkerPace, address: str, versions: Mapping[str, str], stop: Stop) -> None:
        source = plan.source.absolute() if plan.source.is_file() else plan.source  # nodes work in other folders
        inputs = ((source, files_hash(load_input(plan.source).files), None),)
        needs = Needs(versions, inputs, () if plan.ego is None else (plan.ego,))
        self._pool = RayPool(block, unfit, pace.recycle, address, stop)
        self._needs = self._pool.put(needs)
        self._sent = self._pool.put(
            RateNodeContent(replace(plan, source=source), replace(pace, workers=1), plan.content())
        )

    def run(self, jobs: Iterable[Any], told: Callable[[Any, Done], None]) -> None:
        """Each block, ``told`` of each that is finished. Raises SumoAdvError."""
        self._pool.run(jobs, self._needs, lambda: self._sent, lambda _, done: done, refuse_block, told)

    def close(self) -> None:
        """Leave the cluster; what still runs there is ended by Ray."""
        self._pool.close()


# -- on a node ---------------------------------------------------------------------------------------------------------


def block(sent: RateNodeContent, job: Block) -> Done:
    """One block on this node. Raises UsageError: the input is another one here; SimulationError: it failed twice."""
    if not _workers:
        try:
            same = sent.plan.content() == sent.content
        except (UsageError, OSError) as error:
            raise UsageError(f"On a node: {error}") from error
        if not same:
            fault = f"On a node {sent.plan.source} has another content than here"
            raise UsageError(f"{fault}; give all nodes the same files.")
        workers = LocalWorkers(sent.plan, sent.pace, desk_folder(), refuse_block, Stop(), BlockRunner)
        atexit.register(workers.close)
        _workers.append(workers)
    results: list[Done] = []
    _workers[0].run([job], lambda _, done: results.append(done))
    return results[0]
