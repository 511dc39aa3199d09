"""Does the interval of a crash rate cover plain Monte Carlo? Many estimates of one scene, each with another seed.

    python benchmarks/rate/coverage.py benchmarks/rate/crossing.toml --errors 3 --out runs/coverage

Makes the estimates, then the plain runs, and prints the table. Hours of one core; the same command again goes on.
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
from sumo_adv.rate.blocks import BLOCK, Block, BlockRunner
from sumo_adv.rate.estimate import Estimation, counts_of, estimated, records_of
from sumo_adv.rate.estimator import rate
from sumo_adv.rate.model import KINDS, chances
from sumo_adv.rate.plan import RatePlan
from sumo_adv.rate.proposal import Proposal, learnt, pilot_proposal


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
    parser.add_argument("--plain-runs", type=int, default=320_000)
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
    print("\n".join(table(estimates, plain.document())))


def repetition(plan: RatePlan, runs: int, out: Path) -> dict[str, Any]:
    """The document of one estimate, made in this process unless its file is there."""
    file = out / f"{plan.ego}-{plan.factor:g}-{plan.pilot}-{runs}-{plan.seed}.json"
    if file.exists():
        return dict(json.loads(file.read_text(encoding="utf-8")))
    with BlockRunner(plan) as runner:

        def blocks(phase: str, number: int, proposal: Proposal) -> list[dict[str, Any]]:
            jobs = [Block(phase, first, proposal.starts.tolist()) for first in range(0, number, BLOCK)]
            return [dict(runner.run(job, last=True).row or {}) for job in jobs]

        pilot = blocks("pilot", plan.pilot, pilot_proposal(len(KINDS)))
        found = blocks("runs", runs, learnt(counts_of(pilot), chances(plan.factor)))
    document = estimated(plan, records_of(found), records_of(pilot)).document()
    write_text(file, json_text(document, 1))
    return document


def table(estimates: Sequence[Mapping[str, Any]], plain: Mapping[str, Any]) -> list[str]:
    """What the intervals cover, and how far the ego drove for them. All rates are of collisions in 1000 h."""
    value, low, high, half = (_column(estimates, name) * unit for name, unit in UNITS.items())
    truth = plain["levels"]["collision"]["per_hour"]
    there, least, most = (truth[name] * 1000.0 for name in ("rate", "low", "high"))
    mean, error = float(value.mean()), float(value.std(ddof=1) / np.sqrt(len(value)))
    n = len(value)
    covers = int(((low <= there) & (there <= high)).sum())
    own = int(((low <= mean) & (mean <= high)).sum())
    overlaps = int(((low <= most) & (least <= high)).sum())
    driven = float(np.mean([each["km"] for each in estimates]))
    wanted = float(np.median(half))
    needed = crashes_for(wanted) / truth["crashes"] * plain["km"]
    apart = (mean - there) / float(np.hypot(error, there / np.sqrt(truth["crashes"])))
    per_run = truth["crashes"] / plain["runs"]
    spread, as_said = value.std(ddof=1) / mean, wanted / norm.ppf(0.975)
    expected = shifted(as_said, there / mean - 1.0)
    return [
        f"plain      {plain['runs']} runs, {truth['crashes']} collisions, {per_run:.2g} a run: "
        f"{there:.4g} ({least:.4g}-{most:.4g}) in 1000 h, half width {truth['half_width']:.0%}, {plain['km']:.0f} km",
        f"estimates  {n} of {estimates[0]['pilot']} + {estimates[0]['runs']} runs: mean {mean:.4g}, standard error "
        f"{error:.2g} ({apart:+.1f} standard errors from plain), median half width {wanted:.0%}, {driven:.1f} km each",
        f"covered    plain's value {covers} of {n}, plain's interval {overlaps} of {n}, their own mean {own} of {n}",
        f"           expected of exact intervals, with plain's value where it is: {expected:.0%}",
        f"spread     of the values {spread:.0%}, as the half widths say {as_said:.0%}",
        f"km         plain needs {needed:.0f} for that half width: {needed / driven:.0f} times as many",
    ]


UNITS = {"rate": 1000.0, "low": 1000.0, "high": 1000.0, "half_width": 1.0}


def _column(estimates: Sequence[Mapping[str, Any]], name: str) -> Floats:
    return np.array([each["levels"]["collision"]["per_hour"][name] or np.inf for each in estimates], float)


def crashes_for(half_width: float) -> float:
    """How many crashes plain runs need to see for a half width."""
    counts = np.arange(1, 2000)
    halves = [rate(np.ones(count), np.ones(count)).half_width or np.inf for count in counts]
    return float(np.interp(-half_width, -np.array(halves), counts))


def shifted(spread: float, shift: float) -> float:
    """How often a normal interval of 95 % covers a value that is off by ``shift`` of the true one."""
    z, off = float(norm.ppf(0.975)), shift / spread
    return float(norm.cdf(z - off) - norm.cdf(-z - off))


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
