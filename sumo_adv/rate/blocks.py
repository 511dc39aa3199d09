"""Blocks of runs, one after another in one process: SUMO is loaded once and loaded again for each run."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from sumo_adv.campaigns.results import Done
from sumo_adv.config import forget_environment
from sumo_adv.drivers import make_ego
from sumo_adv.episode.drive import Drive, ego_type_file
from sumo_adv.episode.encounter_search import INSERTED_EGO, EncounterSearch
from sumo_adv.errors import SimulationError
from sumo_adv.rate.model import chances
from sumo_adv.rate.plan import WAIT, RatePlan
from sumo_adv.rate.proposal import Proposal
from sumo_adv.rate.run import Record, Run
from sumo_adv.simulation.inputs import EgoRoute
from sumo_adv.simulation.network import read_network

BLOCK = 20  # runs
PHASES = ("pilot", "runs", "plain")


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
        return f"{self.phase} {self.first} to {self.first + BLOCK - 1}"


def failed(job: Block, why: str, text: str) -> Done:
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
        self._scratch = tempfile.TemporaryDirectory(prefix="sumo_adv-")
        folder = Path(self._scratch.name)
        self._task = task = plan.task(folder)
        controller = make_ego(task.ego_driver, task.ego_parameters)
        types = ego_type_file(controller, folder)
        spec = task.spec
        spec = replace(spec, additional=(*spec.additional, types), seed=0)
        self._drive = Drive(spec, controller, 0, deadline=task.settings.ego_deadline)
        EncounterSearch(self._drive, read_network(spec.network), task)  # what the driver sees; an ego with a route

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._drive.simulation.close()
        self._scratch.cleanup()

    def run(self, job: Block, *, last: bool) -> Done:
        """The records of a block, and of a pilot what it counted."""
        runs = [self.one(job, number) for number in range(job.first, job.first + BLOCK)]
        counts = [run.counts for run, _ in runs if job.phase == "pilot"]
        counted = [[array.tolist() for array in (c.chances, c.starts, c.crashes)] for c in counts]
        return Done(job.id, {"records": [asdict(record) for _, record in runs], "counts": counted})

    def one(self, job: Block, number: int) -> tuple[Run, Record]:
        """One run of a block."""
        plan, task = self._plan, self._task
        seed = seed_of(plan.seed, job.phase, number)
        self._drive.restart(seed)
        proposal = None if job.starts is None else Proposal(np.array(job.starts))
        run = Run(self._drive, chances(plan.factor), proposal, seed, pilot=job.phase == "pilot")
        ego = INSERTED_EGO if isinstance(task.ego, EgoRoute) else task.ego
        start = task.spec.begin + (plan.warm_up if ego is None else 0.0)
        return run, run.until(ego, start, start + WAIT + plan.duration, plan.duration)
