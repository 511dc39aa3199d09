"""An estimate from its plan to its rates: pilot runs, what they teach, runs, the sums.

OUT/plan.json      what the estimate is of
OUT/blocks/ID.json the records of 20 runs each; a finished block is not run again
OUT/rate.json      the result

A rate is a ratio of sums over runs, weighted crashes by weighted exposure. Its interval is that of Fay and Feuer (1997)
for a weighted sum of rare events: gamma quantiles with the mean and the variance of the sum, the upper one with one
more event of the largest weight. The variance is the sum of the squared weights, and what uneven exposures of the runs
add. With equal weights and exposures it is the exact interval of a Poisson count (Garwood 1936). It is never negative,
and unlike the normal interval it covers where few crashes with uneven weights were seen.
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

ENOUGH_CRASHES = 10  # crashes: the weights of fewer do not tell how large those are that were not seen
RATE_PLAN_FILE, RATE_FILE, RATE_LOCK_FILE = "plan.json", "rate.json", "rate.lock"
BLOCK_DEADLINE_S = 600.0
MAX_BLOCKS_PER_WORKER = 200  # after which it is replaced
CONTACT_EVENT = "contact"
RATED_LEVELS = (CONTACT_EVENT, *(str(level) for level in Level if level >= Level.COLLISION))


@dataclass(frozen=True, slots=True)
class Rate:
    """A rate with its interval, per unit of exposure.

    crashes: how many were seen. effective: how many of equal weight tell as much (Kish 1965). largest_share: of the
    estimate, that the crash with the largest weight has. plain_runs: how many runs of the model itself give the same
    variance. These are None without a crash.
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
        """Half the interval over the estimate; None without a crash."""
        return (self.high - self.low) / (2 * self.value) if self.value > 0 else None


def measure_rate(weights: Floats, exposure: Floats, most_weight: float = 1.0) -> Rate:
    """The rate of crashes.

    weights ``(runs,)``: the weight of each run that crashed, at the crash; 0 for others. exposure ``(runs,)``:
    weighted, in any unit. most_weight: that a crash can have; the upper limit rests on it unless ``ENOUGH_CRASHES``
    were seen."""
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
    """That of the gamma distribution with this mean and variance."""
    return float(gammaincinv(mean**2 / variance, share)) * variance / mean


def effective_runs(weights: Floats) -> float:
    """How many runs of equal weight the weighted runs are worth (Kish 1965)."""
    return float(weights.sum() ** 2 / (weights**2).sum())


@dataclass(frozen=True, slots=True)
class RateEstimate:
    """The rates of an estimate.

    per_hour, per_km: by level. by_error: by the error of the other driver, its share of the estimate of collisions.
    effective_runs: how many runs of equal weight the runs are worth. hours, km: that the ego drove, in pilot runs too.
    plain_km: how far it would drive in runs of the model that tell as much of collisions.
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
    """The rates from the records of all runs."""
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
    return np.array([getattr(r, name) for r in records], float)


@dataclass
class Estimation:
    """Runs what is missing of an estimate in its folder. ray: address of a Ray cluster, None = on this machine."""

    plan: RatePlan
    out: Path
    workers: int
    watcher: CampaignWatcher
    ray: str | None = None

    def run(self, runs: int) -> RateEstimate | None:
        """The estimate from at least ``runs`` runs, in whole blocks; None if it was stopped before.

        Raises:
            UsageError: the input or the ego is wrong, no run has an ego, the folder is of another estimate or cannot be
                written, or there is no such cluster;
            SimulationError: a block of runs failed twice.
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
        plan = self.plan
        with stopping(self.watcher) as stop, closing(self._pool(scratch, stop)) as pool:
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
        pace = WorkerPace(self.workers, BLOCK_DEADLINE_S, MAX_BLOCKS_PER_WORKER)
        if self.ray is None:
            return LocalWorkers(self.plan, pace, scratch, refuse_block, stop, BlockRunner)
        return ClusterBlocks(self.plan, pace, self.ray, versions(), stop)

    def _blocks(
        self, phase: str, runs: int, proposal: ErrorProposal | None, pool: Workers
    ) -> list[dict[str, Any]] | None:
        """The blocks of a phase, those that are missing run now; None if the user stopped it."""
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
    """A block that is finished; None if there is none, or it is damaged."""
    try:
        block = read_json(file)
        records_of([block])
        counts_of([block])
        return dict(block)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def records_of(blocks: Sequence[Mapping[str, Any]]) -> list[RateRecord]:
    """The runs of blocks."""
    return [RateRecord(**row) for block in blocks for row in block["records"]]


def counts_of(blocks: Sequence[Mapping[str, Any]]) -> list[Counts]:
    """What the pilot runs of blocks counted."""
    return [Counts(*(np.array(table, float) for table in run)) for block in blocks for run in block["counts"]]
