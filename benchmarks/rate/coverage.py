"""Does the interval of a crash rate cover plain Monte Carlo? Many estimates of one scene, each with another seed.

    python benchmarks/rate/coverage.py benchmarks/rate/crossing.toml --errors 3 --out runs/coverage

Makes the estimates, then the plain runs, and prints the table. An hour of one core; the same command again goes on.

Plain runs are compared twice: those of ``sumo-adv rate --plain``, and ten times as many, of which only those are driven
in which an error can begin. Whether one can is known from a run's seed: its decisions draw random numbers one after
another, and an error begins only where one is below the sum of the model's probabilities.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

from sumo_adv.datatypes import Floats
from sumo_adv.files import json_text, write_text
from sumo_adv.rate.blocks import RUNS_PER_BLOCK, Block, BlockRunner, RatePlan, seed_of
from sumo_adv.rate.estimate import Estimation, Rate, RateEstimate, counts_of, estimated, measure_rate, records_of
from sumo_adv.rate.proposal import DECISION_INTERVAL_S, ERROR_KINDS, ErrorProposal, chances, learnt, pilot_proposal

CHUNK = 800_000  # plain runs in a file


def main() -> None:
    """Make what is missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--ego", default="idm")
    parser.add_argument("--errors", type=float, default=1.0)
    parser.add_argument("--duration", type=float, default=6.0)
    parser.add_argument("--runs", type=int, default=640)
    parser.add_argument("--pilot", type=int, default=60)
    parser.add_argument("--repetitions", type=int, default=100)
    parser.add_argument("--plain-runs", type=int, default=160_000)
    parser.add_argument("--thinned-runs", type=int, default=2 * CHUNK, help="plain runs, driven if an error can begin")
    parser.add_argument("--others", type=int, default=3, help="vehicles of the scene beside the ego")
    parser.add_argument("--workers", type=int, default=1, help="for the plain runs")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    plan = RatePlan(args.scene, args.ego, duration=args.duration, factor=args.errors)
    args.out.mkdir(parents=True, exist_ok=True)
    estimates = [
        repetition(replace(plan, pilot=args.pilot, seed=seed), args.runs, args.out) for seed in range(args.repetitions)
    ]
    plain = Estimation(replace(plan, plain=True), args.out / "plain", args.workers, Silent()).run(args.plain_runs)
    if plain is None or not plain.per_hour["collision"].crashes:
        parser.exit(1, "The plain runs were stopped, or none of them crashed: there is nothing to compare with.\n")
    print("\n".join(table(estimates, plain)))
    parts = range(0, args.thinned_runs, CHUNK)
    crashes = sum(thinned(replace(plan, plain=True), first, CHUNK, args.others, args.out) for first in parts)
    driven = len(parts) * CHUNK
    hours = driven * plain.hours / plain.runs
    thinned_rate = measure_rate(np.ones(crashes), np.full(crashes, hours / crashes))
    same = thinned(replace(plan, plain=True), 0, plain.runs, args.others, args.out)
    print(f"thinned    {driven} plain runs, {crashes} collisions ({same} in the first {plain.runs}):")
    print("\n".join(covered(estimates, thinned_rate)))
    half = float(np.median(_column(estimates, "half_width")))
    needed = crashes_for(half) / crashes * driven * plain.km / plain.runs
    times = needed / float(np.mean([each["km"] for each in estimates]))
    print(f"km         for a half width of {half:.0%} plain needs {needed:.0f}: {times:.0f} times as many")


def thinned(plan: RatePlan, first: int, runs: int, others: int, out: Path) -> int:
    """How many of ``runs`` plain runs end in a collision. Only those are driven in which an error can begin."""
    file = out / f"thinned-{plan.ego}-{plan.factor:g}-{first}-{runs}.json"
    if file.exists():
        return int(json.loads(file.read_text(encoding="utf-8")))
    most, draws = float(chances(plan.factor).sum()), round(plan.duration / DECISION_INTERVAL_S) * others
    crashes, block = 0, Block("plain", 0, None)
    with BlockRunner(plan) as runner:
        for number in range(first, first + runs):
            drawn = np.random.default_rng([seed_of(plan.seed, "plain", number), 1]).random(draws)
            if drawn.min() < most:
                crashes += runner.one(block, number)[1].level != "none"
    write_text(file, json_text(crashes))
    return crashes


def repetition(plan: RatePlan, runs: int, out: Path) -> dict[str, Any]:
    """The document of one estimate, made in this process unless its file is there."""
    file = out / f"{plan.ego}-{plan.factor:g}-{plan.pilot}-{runs}-{plan.seed}.json"
    if file.exists():
        return dict(json.loads(file.read_text(encoding="utf-8")))
    with BlockRunner(plan) as runner:

        def blocks(phase: str, number: int, proposal: ErrorProposal) -> list[dict[str, Any]]:
            jobs = [Block(phase, first, proposal.starts.tolist()) for first in range(0, number, RUNS_PER_BLOCK)]
            return [dict(runner.run(job, last=True).row or {}) for job in jobs]

        pilot = blocks("pilot", plan.pilot, pilot_proposal(len(ERROR_KINDS)))
        rows = blocks("runs", runs, learnt(counts_of(pilot), chances(plan.factor)))
    document = estimated(plan, records_of(rows), records_of(pilot)).document()
    write_text(file, json_text(document, 1))
    return document


def table(estimates: Sequence[Mapping[str, Any]], plain: RateEstimate) -> list[str]:
    """The estimates against plain runs, and how far the ego drove for each. Rates are of collisions in 1000 h."""
    truth = plain.per_hour["collision"]
    value, half = _column(estimates, "rate"), _column(estimates, "half_width")
    driven, median_half = float(np.mean([each["km"] for each in estimates])), float(np.median(half))
    spread, as_said = value.std(ddof=1) / value.mean(), median_half / norm.ppf(0.975)
    return [
        f"estimates  {len(value)} of {estimates[0]['pilot']} + {estimates[0]['runs']} runs: mean "
        f"{value.mean() * 1e3:.4g}, standard error {1e3 * value.std(ddof=1) / len(value) ** 0.5:.2g}, "
        f"median half width {median_half:.0%}, {driven:.1f} km each",
        f"spread     of their values {spread:.0%}, as the half widths say {as_said:.0%}",
        f"plain      {plain.runs} runs, {truth.crashes} collisions, {truth.crashes / plain.runs:.2g} a run, "
        f"{plain.km:.0f} km",
        *covered(estimates, truth),
    ]


def covered(estimates: Sequence[Mapping[str, Any]], truth: Rate) -> list[str]:
    """How many of the intervals cover the value of plain runs, their interval, and the mean of all estimates."""
    value, low, high = (_column(estimates, name) for name in ("rate", "low", "high"))
    mean, error = float(value.mean()), float(value.std(ddof=1) / np.sqrt(len(value)))
    covers = int(((low <= truth.value) & (truth.value <= high)).sum())
    overlaps = int(((low <= truth.high) & (truth.low <= high)).sum())
    own = int(((low <= mean) & (mean <= high)).sum())
    apart = (mean - truth.value) / float(np.hypot(error, truth.value / np.sqrt(truth.crashes)))
    return [
        f"           {truth.value * 1e3:.4g} ({truth.low * 1e3:.4g}-{truth.high * 1e3:.4g}) in 1000 h, half width "
        f"{truth.half_width:.0%}; the mean of the estimates is {apart:+.1f} standard errors from it",
        f"           of {len(value)} intervals {covers} cover that value, {overlaps} its interval, {own} their mean",
    ]


def _column(estimates: Sequence[Mapping[str, Any]], name: str) -> Floats:
    return np.array([each["levels"]["collision"]["per_hour"][name] or np.inf for each in estimates], float)


def crashes_for(half_width: float) -> float:
    """How many crashes plain runs need to see for a half width."""
    counts = np.arange(1, 2000)
    halves = [measure_rate(np.ones(count), np.ones(count)).half_width or np.inf for count in counts]
    return float(np.interp(-half_width, -np.array(halves), counts))


class Silent:
    """Shows nothing."""

    def begin(self, total: int, before: Sequence[Any]) -> None:
        """A phase."""

    def finished(self, job: Any, row: Any) -> None:
        """A block."""

    def stopping(self, now: bool) -> None:
        """Ctrl-C."""


if __name__ == "__main__":
    main()
