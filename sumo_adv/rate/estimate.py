"""An estimate from its plan to its rates: pilot runs, the proposal learnt from them, runs, and the sums.

OUT/plan.json      the plan of the estimate
OUT/blocks/ID.json the records of 20 runs each; a finished block is not run again
OUT/rate.json      the result

A rate is a ratio of sums over runs: weighted crashes by weighted exposure. Its interval is that of Fay and Feuer (1997)
for a weighted sum of rare events: gamma quantiles with the mean and the variance of the sum. The upper quantile counts
one more event of the largest weight. The variance is the sum of the squared weights, plus a term for uneven exposures
of the runs. With equal weights and exposures, the interval is the exact one of a Poisson count (Garwood 1936). It is
never negative and, unlike the normal interval, it has the nominal coverage when there are few crashes with uneven
weights.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from sumo_adv.campaigns.campaign import CampaignWatcher, Workers, stopping
from sumo_adv.campaigns.local import LocalWorkers, Stop, WorkerPace
from sumo_adv.campaigns.results import Done
from sumo_adv.datatypes import Floats, Level
from sumo_adv.errors import UsageError
from sumo_adv.files import held, json_text, refuse_links, scratch_prefix, sentences, write_text
from sumo_adv.metrics.statistics import CONFIDENCE_LEVEL
from sumo_adv.parsing import read_json, read_object
from sumo_adv.rate.blocks import (
    MAX_EGO_WAIT_S,
    RUNS_PER_BLOCK,
    Block,
    BlockRunner,
    ClusterBlocks,
    RatePlan,
    refuse_block,
)
from sumo_adv.rate.proposal import ERROR_KINDS, MAX_WEIGHT, Counts, ErrorProposal, chances, learnt, pilot_proposal
from sumo_adv.rate.run import RateRecord
from sumo_adv.report.outcome import versions

ENOUGH_CRASHES = 10  # the weights of fewer crashes do not tell how large unseen ones are
RATE_PLAN_FILE, RATE_FILE, RATE_LOCK_FILE = "plan.json", "rate.json", "rate.lock"
BLOCK_DEADLINE_S = 600.0
MAX_BLOCKS_PER_WORKER = 200  # a worker process is replaced after this many blocks
CONTACT_EVENT = "contact"
RATED_LEVELS = (CONTACT_EVENT, *(str(level) for level in Level if level >= Level.COLLISION))


@dataclass(frozen=True, slots=True)
class Rate:
    """A rate with its interval, per unit of exposure.

    Attributes:
        value: The estimate.
        low: The lower limit of the interval.
        high: The upper limit of the interval.
        crashes: The number of crashes in the runs.
        effective: The number of crashes of equal weight with the same information (Kish 1965).
        largest_share: The share of the estimate that comes from the crash with the largest weight; None without a
            crash.
        plain_runs: The number of runs of the model itself that give the same variance; None without a crash.
    """

    value: float
    low: float
    high: float
    crashes: int
    effective: float
    largest_share: float | None
    plain_runs: float | None

    @property
    def half_width(self) -> float | None:
        """Half the interval divided by the estimate; None without a crash."""
        return (self.high - self.low) / (2 * self.value) if self.value > 0 else None


def measure_rate(weights: Floats, exposure: Floats, most_weight: float = 1.0) -> Rate:
    """Estimate the rate of crashes.

    Args:
        weights: The weight of each run at its crash, ``(runs,)``; 0 without a crash.
        exposure: The weighted exposure of each run in any unit, ``(runs,)``.
        most_weight: The largest possible weight of a crash. The upper limit uses it unless there are
            ``ENOUGH_CRASHES``.
    """
    total, over = float(weights.sum()), float(exposure.sum())
    seen = int((weights > 0).sum())
    if over <= 0.0:
        return Rate(math.nan, 0.0, math.inf, seen, 0.0, None, None)
    tail = (1 - CONFIDENCE_LEVEL) / 2
    if not seen:
        return Rate(0.0, 0.0, float(gammaincinv(1.0, 1 - tail)) * most_weight / over, 0, 0.0, None, None)
    square, seen_largest = float((weights**2).sum()), float(weights.max())
    largest = seen_largest if seen >= ENOUGH_CRASHES else most_weight
    variance = square + (total / over) ** 2 * float(((exposure - exposure.mean()) ** 2).sum())
    low = _quantile(total, variance, tail)
    high = _quantile(total + largest, variance + largest**2, 1 - tail)
    plain_runs = len(weights) * total / variance
    share = seen_largest / total
    return Rate(total / over, low / over, high / over, seen, total**2 / square, share, plain_runs)


def _quantile(mean: float, variance: float, share: float) -> float:
    """Return a quantile of the gamma distribution with this mean and variance."""
    return float(gammaincinv(mean**2 / variance, share)) * variance / mean


def effective_runs(weights: Floats) -> float:
    """Return the number of runs of equal weight with the same information as the weighted runs (Kish 1965).

    Args:
        weights: The weight of each run, ``(runs,)``.
    """
    return float(weights.sum() ** 2 / (weights**2).sum())


@dataclass(frozen=True, slots=True)
class RateEstimate:
    """The rates of an estimate.

    Attributes:
        plan: The plan of the estimate.
        runs: The number of runs, without pilot runs.
        per_hour: The rate per hour, by level.
        per_km: The rate per km, by level.
        by_error: The share of each error of the other driver in the estimate of collisions.
        effective_runs: The number of runs of equal weight with the same information.
        hours: The time that the ego drove, including pilot runs [h].
        km: The distance that the ego drove, including pilot runs [km].
        plain_km: The distance that the ego would drive in runs of the model with the same information on collisions
            [km]; None without a collision.
    """

    plan: RatePlan
    runs: int
    per_hour: Mapping[str, Rate]
    per_km: Mapping[str, Rate]
    by_error: Mapping[str, float]
    effective_runs: float
    hours: float
    km: float
    plain_km: float | None

    def document(self) -> dict[str, Any]:
        """Return the content of ``rate.json``."""

        def plain(found: Rate) -> dict[str, Any]:
            return {
                "rate": found.value, "low": found.low, "high": found.high, "half_width": found.half_width,
                "crashes": found.crashes, "effective_crashes": found.effective,
                "largest_share": found.largest_share, "plain_runs": found.plain_runs,
            }  # fmt: skip

        return {
            "input": str(self.plan.source), "ego": self.plan.ego, "errors": self.plan.factor, "plain": self.plan.plain,
            "seed": self.plan.seed, "runs": self.runs, "pilot": 0 if self.plan.plain else self.plan.pilot,
            "effective_runs": self.effective_runs, "hours": self.hours, "km": self.km, "plain_km": self.plain_km,
            "levels": {
                name: {"per_hour": plain(self.per_hour[name]), "per_km": plain(self.per_km[name])}
                for name in RATED_LEVELS
            },
            "by_error": dict(self.by_error),
        }  # fmt: skip


def estimated(plan: RatePlan, records: Sequence[RateRecord], pilot: Sequence[RateRecord] = ()) -> RateEstimate:
    """Compute the rates from the records of all runs.

    Args:
        plan: The plan of the estimate.
        records: The records of the runs.
        pilot: The records of the pilot runs, which count only for time and distance.
    """
    weight, hours, km = (_column(records, name) for name in ("weight", "weighted_hours", "weighted_km"))
    most = 1.0 if plan.plain else MAX_WEIGHT
    reached = {CONTACT_EVENT: [r.contact for r in records]}
    for name in RATED_LEVELS[1:]:
        least = Level[name.upper()]
        reached[name] = [r.contact and Level[r.level.upper()] >= least for r in records]
    per_hour = {name: measure_rate(weight * np.array(flags), hours, most) for name, flags in reached.items()}
    per_km = {name: measure_rate(weight * np.array(flags), km, most) for name, flags in reached.items()}
    collided = weight * np.array(reached["collision"])
    errors = np.array([r.error or "none" for r in records])
    total, seen = float(collided.sum()), np.unique(errors[collided > 0])
    by_error = {str(name): float(collided[errors == name].sum()) / total for name in seen}
    plain_runs = per_hour["collision"].plain_runs
    driven = [*records, *pilot]
    return RateEstimate(
        plan, len(records), per_hour, per_km, by_error, effective_runs(weight), float(_column(driven, "hours").sum()),
        float(_column(driven, "km").sum()), None if plain_runs is None else plain_runs * float(km.mean()),
    )  # fmt: skip


def _column(records: Sequence[RateRecord], name: str) -> Floats:
    """Return a field of all records, ``(runs,)``."""
    return np.array([getattr(r, name) for r in records], float)


@dataclass
class Estimation:
    """Runs the missing blocks of an estimate in its folder.

    Attributes:
        plan: The plan of the estimate.
        out: The folder of the estimate.
        workers: The number of processes.
        watcher: Shows the progress, and stops the estimate.
        ray: The address of a Ray cluster; None runs on this machine.
    """

    plan: RatePlan
    out: Path
    workers: int
    watcher: CampaignWatcher
    ray: str | None = None

    def run(self, runs: int) -> RateEstimate | None:
        """Compute the estimate from at least ``runs`` runs, in whole blocks.

        Args:
            runs: The minimum number of runs.

        Returns:
            The estimate; None if the user stopped it.

        Raises:
            UsageError: The input or the driver is wrong, no run has an ego, the folder belongs to another estimate or
                cannot be written, or there is no such cluster.
            SimulationError: A block of runs failed twice.
        """
        with sentences(self.out), TemporaryDirectory(prefix=scratch_prefix()) as scratch:
            self.plan.task(Path(scratch))
            refuse_links(self.out)
            (self.out / "blocks").mkdir(parents=True, exist_ok=True)
            with held(self.out / RATE_LOCK_FILE) as alone:
                if not alone:
                    raise UsageError(f"Another estimate writes into {self.out}; wait for it, or give another --out.")
                self._keep_plan()
                return self._run(runs, Path(scratch))

    def _keep_plan(self) -> None:
        """Write the plan; raise UsageError if the folder has another one."""
        file, document = self.out / RATE_PLAN_FILE, json.loads(json_text(self.plan.document()))
        if file.exists():
            before = read_object(file, "The plan of the estimate")
            changed = [key for key in document if before.get(key) != document[key]]
            if changed:
                raise UsageError(
                    f"{self.out} holds runs of another {' and '.join(changed)}, which cannot go into one estimate; "
                    "give another --out."
                )
        write_text(file, json_text(document, 1))

    def _run(self, runs: int, scratch: Path) -> RateEstimate | None:
        """Run the phases, and write the result."""
        plan = self.plan
        stop = Stop()
        with stopping(self.watcher, stop), closing(self._pool(scratch, stop)) as pool:
            starts, pilot = None, list[dict[str, Any]]()
            if not plan.plain:
                measured = self._blocks("pilot", plan.pilot, pilot_proposal(len(ERROR_KINDS)), pool)
                if measured is None:
                    return None
                pilot = measured
                starts = learnt(counts_of(pilot), chances(plan.factor))
            blocks = self._blocks("plain" if plan.plain else "runs", runs, starts, pool)
        if blocks is None:
            return None
        result = estimated(plan, records_of(blocks), records_of(pilot))
        write_text(self.out / RATE_FILE, json_text(result.document(), 1))
        return result

    def _pool(self, scratch: Path, stop: Stop) -> Workers:
        """Return the workers, on this machine or on a cluster."""
        pace = WorkerPace(self.workers, BLOCK_DEADLINE_S, MAX_BLOCKS_PER_WORKER)
        if self.ray is None:
            return LocalWorkers(self.plan, pace, scratch, refuse_block, stop, BlockRunner)
        return ClusterBlocks(self.plan, pace, self.ray, versions(), stop)

    def _blocks(
        self, phase: str, runs: int, proposal: ErrorProposal | None, pool: Workers
    ) -> list[dict[str, Any]] | None:
        """Return the blocks of a phase, after running those that are missing; None if the user stopped it."""
        starts = None if proposal is None else proposal.starts.tolist()
        jobs = [Block(phase, first, starts) for first in range(0, runs, RUNS_PER_BLOCK)]
        files = {job.id: self.out / "blocks" / f"{job.id}.json" for job in jobs}
        by_id = {name: block for name, file in files.items() if (block := read_block(file)) is not None}
        self.watcher.begin(len(jobs), list(by_id.values()))

        def keep(job: Any, done: Done) -> None:
            by_id[job.id] = dict(done.row or {})
            write_text(files[job.id], json_text(by_id[job.id]))
            self.watcher.finished(job, by_id[job.id])

        if missing := [job for job in jobs if job.id not in by_id]:
            pool.run(missing, keep)
        if len(by_id) < len(jobs):
            return None
        blocks = [by_id[job.id] for job in jobs]
        if not any(record.hours for record in records_of(blocks)):
            raise UsageError(
                f"In none of the runs was there an ego within {MAX_EGO_WAIT_S:g} s after the warm-up; "
                "give more --density, or an input with an ego that departs earlier."
            )
        return blocks


def read_block(file: Path) -> dict[str, Any] | None:
    """Read a finished block.

    Args:
        file: The path of the file.

    Returns:
        The block; None if the file is missing or damaged.
    """
    try:
        block = read_json(file)
        records_of([block])
        counts_of([block])
        return dict(block)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def records_of(blocks: Sequence[Mapping[str, Any]]) -> list[RateRecord]:
    """Return the records of the runs of blocks.

    Args:
        blocks: The finished blocks.
    """
    return [RateRecord(**row) for block in blocks for row in block["records"]]


def counts_of(blocks: Sequence[Mapping[str, Any]]) -> list[Counts]:
    """Return the counts of the pilot runs of blocks.

    Args:
        blocks: The finished blocks.
    """
    return [Counts(*(np.array(table, float) for table in run)) for block in blocks for run in block["counts"]]
