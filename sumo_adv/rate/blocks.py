"""The plan of an estimate, which ``plan.json`` records; and its blocks of runs, on this machine or on a Ray cluster.

The runs of a block follow each other in one process, in which SUMO is loaded once and reloaded for each run. On a
cluster, each block is a task. Its worker runs the block in a watched process of its own, as on one machine, and sends
the records back. Inputs are found on the nodes under the same paths (a shared file system), or are shipped ones. Their
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
from sumo_adv.simulation.inputs import EgoRoute, load_input, own_simulation
from sumo_adv.simulation.network import read_network
from sumo_adv.simulation.scan import scan_demand

RATE_SCHEMA = 1
MAX_EGO_WAIT_S = 60.0  # the ego must appear within this time after the warm-up
RUNS_PER_BLOCK = 20
PHASES = ("pilot", "runs", "plain")
_workers: list[LocalWorkers] = []  # those of this Ray worker process: one, from its first block on


@dataclass(frozen=True, slots=True)
class RatePlan:
    """The plan of an estimate.

    Attributes:
        source: The input, as given on the command line.
        ego: The driver of the ego. None takes that of the input, or idm if it names none.
        parameters: The parameters of the driver.
        density: The departures per minute of generated traffic; None takes that of the input.
        warm_up: The warm-up of a run [s].
        duration: The duration of a run [s].
        factor: The factor of all error rates.
        pilot: The number of pilot runs.
        plain: Whether all runs are drawn from the model, without pilot runs.
        seed: The seed of the estimate.
    """

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
        """Return the task that SUMO is started with.

        Args:
            folder: The folder for generated traffic, which an input without traffic needs.

        Raises:
            UsageError: The input cannot be read or is a recording, or there is no such driver.
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
        brought = {**own_simulation(run_input), **run_input.settings(("until",))}
        own = {"ego_parameters": dict(self.parameters), "seed": self.seed}
        settings = load_settings(None, **{**brought, **chosen, **own})
        task = make_task(run_input, settings, folder)
        make_tested_ego(task.ego_driver, task.ego_parameters, settings)
        return task

    def content(self) -> str:
        """Return the SHA-256 of all files of the input.

        Raises:
            UsageError: The input cannot be read.
            OSError: A file cannot be read.
        """
        files = load_input(self.source).files
        return sha256(b"".join(sha256(file.read_bytes()).digest() for file in files)).hexdigest()

    def document(self) -> dict[str, Any]:
        """Return the plan as JSON, with the content of the input and the rates of the model."""
        return {
            "schema": RATE_SCHEMA, **asdict(self), "source": str(self.source), "parameters": dict(self.parameters),
            "content": self.content(), "errors_per_hour": {str(kind): value for kind, value in ERRORS_PER_HOUR.items()},
        }  # fmt: skip


@dataclass(frozen=True, slots=True)
class Block:
    """A block of ``RUNS_PER_BLOCK`` consecutive runs of a phase.

    Attributes:
        phase: The phase, one of ``PHASES``.
        first: The number of the first run.
        starts: The table of the proposal; None draws from the model.
    """

    phase: str
    first: int
    starts: Sequence[Sequence[float]] | None

    @property
    def id(self) -> str:
        """The name of its file."""
        return f"{self.phase}-{self.first}"

    @property
    def words(self) -> str:
        """The block in words, for messages."""
        return f"{self.phase} {self.first} to {self.first + RUNS_PER_BLOCK - 1}"


def refuse_block(job: Block, why: str, text: str) -> Done:
    """Report a block that cannot be run.

    Args:
        job: The block.
        why: The reason, in a sentence.
        text: Ignored.

    Raises:
        SimulationError: Always.
    """
    raise SimulationError(f"The block of runs '{job.words}' cannot be run. {why}")


def seed_of(seed: int, phase: str, number: int) -> int:
    """Return the seed of a run, for SUMO and for its errors.

    Args:
        seed: The seed of the estimate.
        phase: The phase of the run.
        number: The number of the run.
    """
    return int(np.random.SeedSequence([seed, PHASES.index(phase), number]).generate_state(1)[0] >> 1)


class BlockRunner:
    """Runs blocks in one simulation. Use it in a ``with`` statement."""

    def __init__(self, plan: RatePlan) -> None:
        """Prepare the simulation.

        Args:
            plan: The plan of the estimate.

        Raises:
            UsageError: The input or the driver is wrong.
            SimulationError: SUMO fails.
        """
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
        EncounterSearch(self._drive, read_network(spec.network), task)  # sets what the driver sees and an ego's route

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._drive.simulation.close()
        self._scratch.cleanup()

    def run(self, job: Block, *, last: bool) -> Done:
        """Return the records of a block and, in a pilot, its counts.

        Args:
            job: The block.
            last: Ignored.
        """
        runs = [self.one(job, number) for number in range(job.first, job.first + RUNS_PER_BLOCK)]
        counts = [run.counts for run, _ in runs if job.phase == "pilot"]
        counted = [[array.tolist() for array in (c.chances, c.starts, c.crashes)] for c in counts]
        return Done(job.id, {"records": [asdict(record) for _, record in runs], "counts": counted})

    def one(self, job: Block, number: int) -> tuple[RateRun, RateRecord]:
        """Make one run of a block.

        Args:
            job: The block.
            number: The number of the run.

        Returns:
            The run and its record.
        """
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
    """What a node needs for all blocks.

    Attributes:
        plan: The plan of the estimate.
        pace: The pace of the node's worker.
        content: The SHA-256 of the input's files.
    """

    plan: RatePlan
    pace: WorkerPace
    content: str


class ClusterBlocks:
    """Runs blocks as Ray tasks."""

    def __init__(self, plan: RatePlan, pace: WorkerPace, address: str, versions: Mapping[str, str], stop: Stop) -> None:
        """Connect to a cluster.

        Args:
            plan: The plan of the estimate.
            pace: The pace of each worker.
            address: The address of the cluster.
            versions: The versions that the nodes must have.
            stop: Tells that the user stops the estimate.

        Raises:
            UsageError: As ``RayPool``.
        """
        source = plan.source.absolute() if plan.source.is_file() else plan.source  # nodes run in other folders
        inputs = ((source, files_hash(load_input(plan.source).files), None),)
        needs = Needs(versions, inputs, () if plan.ego is None else (plan.ego,))
        self._pool = RayPool(block, unfit, pace.recycle, address, stop)
        self._needs = self._pool.put(needs)
        self._sent = self._pool.put(
            RateNodeContent(replace(plan, source=source), replace(pace, workers=1), plan.content())
        )

    def run(self, jobs: Iterable[Any], told: Callable[[Any, Done], None]) -> None:
        """Run blocks.

        Args:
            jobs: The blocks.
            told: Called with each finished block and its result.

        Raises:
            SumoAdvError: A block cannot be run.
        """
        self._pool.run(jobs, self._needs, lambda: self._sent, lambda _, done: done, refuse_block, told)

    def close(self) -> None:
        """Leave the cluster. Ray ends the tasks that are still running."""
        self._pool.close()


# -- on a node ---------------------------------------------------------------------------------------------------------


def block(sent: RateNodeContent, job: Block) -> Done:
    """Run one block on this node.

    Args:
        sent: What the node needs.
        job: The block.

    Raises:
        UsageError: The input has another content on this node.
        SimulationError: The block failed twice.
    """
    if not _workers:
        try:
            same = sent.plan.content() == sent.content
        except (UsageError, OSError) as error:
            raise UsageError(f"On a node: {error}") from error
        if not same:
            fault = f"On a node, the content of {sent.plan.source} differs from here"
            raise UsageError(f"{fault}; give all nodes the same files.")
        workers = LocalWorkers(sent.plan, sent.pace, desk_folder(), refuse_block, Stop(), BlockRunner)
        atexit.register(workers.close)
        _workers.append(workers)
    results: list[Done] = []
    _workers[0].run([job], lambda _, done: results.append(done))
    return results[0]
