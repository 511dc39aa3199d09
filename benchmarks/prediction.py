"""How well egos are foreseen: random attacks predicted and then simulated.

``python benchmarks/prediction.py [--ego EGO] [--attacks N] [INPUT ...]``; two to six seconds an encounter with 20
attacks.  Draws of the applicable ones (vehicle, intent, mode, numbers) are predicted as the expert has it predicted,
and attempted in SUMO.  Printed of each input, and of all: attacks, in how many the prediction said rightly whether the
two touch, in how many it said rightly whether that is valid, and for how many seconds the ego stayed within ``APART``
metres of where it was expected (to the end of the attempt at most), least, mean, largest.
"""

from __future__ import annotations

import argparse
import random
import statistics
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path as File
from typing import NamedTuple

import numpy as np
from attempt_cost import library

from sumo_adv.config import load_settings
from sumo_adv.datatypes import LibraryEntry, ObservedMotion, Proposal
from sumo_adv.episode.assessment import AttemptRunner, observed_motion
from sumo_adv.episode.engine import EpisodeCalls, episode_worker
from sumo_adv.episode.task import FoundEncounter, make_task
from sumo_adv.geometry import Path
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.search.prediction import Predictor
from sumo_adv.search.rollouts import Rollouts
from sumo_adv.search.sampling import templates_of
from sumo_adv.search.settings import SearchSettings
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.inputs import load_input

INPUTS = ("motorway_cut_in_left", "priority_straight_from_left", "t_junction_left_from_stem")
APART = 1.0  # m


class Compared(NamedTuple):
    """What was predicted of one attack and what came: whether the contact, whether the verdict was foreseen, and for
    how many s the ego was."""

    touch: bool
    valid: bool
    near: float


def attacks(encounter: FoundEncounter, entries: Sequence[LibraryEntry], count: int, seed: int) -> list[Proposal]:
    """``count`` of them, over all that applies round robin, with drawn numbers."""
    draw = random.Random(seed)
    ways = templates_of(encounter.situations, entries)
    draw.shuffle(ways)
    return [ways[k % len(ways)].proposal(draw) for k in range(count)] if ways else []


def seconds_near(rollouts: Rollouts, row: int, course: ObservedMotion, path: Path, dt: float) -> float:
    """Seconds until the ego is ``APART`` from where it was expected, or the attempt is over."""
    count = min(course.seen, rollouts.ego[0].shape[1])
    x, y, _ = path.at(course.s[:count], 0.0)
    apart = np.hypot(rollouts.ego[0][row, :count] - x, rollouts.ego[1][row, :count] - y) > APART
    return float(np.argmax(apart) if apart.any() else count) * dt


def compare(name: str, ego: str, count: int, seed: int, entries: Sequence[LibraryEntry]) -> list[Compared]:
    """Predict and attempt ``count`` attacks on one input's encounter."""
    run_input = load_input(File(name))
    settings = load_settings(None, ego=ego, horizon=run_input.horizon, seed=seed)
    with ExitStack() as stack:
        folder = File(stack.enter_context(tempfile.TemporaryDirectory(prefix="sumo_adv-")))
        sandbox, engine = stack.enter_context(Sandbox()), stack.enter_context(Engine(episode_worker))
        engine.call(EpisodeCalls.open, make_task(run_input, settings, folder))
        encounter = engine.call(EpisodeCalls.seek, "")
        if not isinstance(encounter, FoundEncounter):
            print(f"  {run_input.name}: {encounter.reason}")
            return []
        drawn = attacks(encounter, entries, count, seed)
        if not drawn:
            print(f"  {run_input.name}: nothing applies")
            return []
        predictor = Predictor(sandbox, settings, encounter.drivable, encounter.situations)
        expected, rollouts = predictor.score(drawn), predictor.rolled(drawn)
        runner = AttemptRunner(engine, sandbox, encounter, seed)
        came = [result for proposal in drawn for result in runner.attempt([proposal])]
    rows = []
    for k, (proposal, result) in enumerate(zip(expected, came, strict=True)):
        course = observed_motion(result, encounter, proposal.delay, settings)
        if course is None or result.verdict is None:
            continue
        path = encounter.situations[proposal.delay].baseline.path
        near = seconds_near(rollouts, k, course, path, settings.step_length)
        collides = proposal.prediction is not None and proposal.prediction.hit
        counts = proposal.score < SearchSettings().avoidable
        rows.append(Compared(collides == result.verdict.collided, counts == bool(result.verdict.valid), near))
    print(line(run_input.name, rows), flush=True)
    return rows


def line(name: str, rows: Sequence[Compared]) -> str:
    """One input's figures, or those of all."""
    if not rows:
        return f"  {name:34s} {0:6d}"
    near = sorted(r.near for r in rows)
    touch, valid = (sum(getattr(r, field) for r in rows) / len(rows) for field in ("touch", "valid"))
    spread = f"{near[0]:8.1f} {statistics.mean(near):8.1f} {near[-1]:8.1f}"
    return f"  {name:34s} {len(rows):6d} {touch:8.2f} {valid:8.2f} {spread}"


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("inputs", nargs="*", default=list(INPUTS), help="inputs as of run")
    parser.add_argument("--ego", default="idm", help="as of run")
    parser.add_argument("--attacks", type=int, default=20, help="an input")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    entries = library()
    print(f"  {given.ego:34s} {'number':>6s} {'touch':>8s} {'valid':>8s} {'s: min':>8s} {'mean':>8s} {'max':>8s}")
    rows = [r for name in given.inputs for r in compare(name, given.ego, given.attacks, given.seed, entries)]
    print(line("all", rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
