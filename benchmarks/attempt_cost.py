"""What an attempt costs by fork and by load-and-repeat, a prediction search, and the sandbox's calls.

``python benchmarks/attempt_cost.py [INPUT ...]``; about ten seconds an input.  Two engines hold the same encounter, one
that forks and another that may not.  The same attempt runs on them in turn (A B A B ...), the whole way a run takes it:
engine, planner asked every 0.5 s (ours where the attempt runs, any other in a fresh sandbox session), verdict.
Load-and-repeat costs more the later the trigger is and the more vehicles there are; a fork costs the pages that the
child writes to.  The third line has two forks at once, as a run has them after its first attempt.  Both ways must give
the same states: else status 1.

At the end the first attempts of a search that predicts nothing, one after the other, on a road with about 20 vehicles:
attempts without a contact, and attempts with a contact and its level, must cost no more than ``BOUND`` in the median.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from sumo_adv.config import Settings, load_settings
from sumo_adv.datatypes import LibraryEntry, Proposal
from sumo_adv.episode.assessment import AttemptRunner
from sumo_adv.episode.engine import EpisodeCalls, EpisodeEngine, episode_worker
from sumo_adv.episode.memory_access import read_library
from sumo_adv.episode.task import AttemptResult, FoundEncounter, make_task
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.records import SceneSignature
from sumo_adv.planners.adversary_batch import AdversaryBatch
from sumo_adv.planners.answers import PlannerObservation
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.sessions import Roads, Sessions
from sumo_adv.search.prediction import Predictor
from sumo_adv.search.search import AttackSearch
from sumo_adv.search.settings import SearchSettings
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.inputs import RunInput, data_folder, load_input

INPUTS = ("motorway_cut_in_left", "priority_straight_from_left", "roundabout")
BATCH = 100  # planner calls sent at once
ROAD, DENSITY, FIRST = "straight_4lane", 250.0, 60  # with about 20 vehicles; attempts of a search
KINDS = ("without a contact", "with a contact and its level")
BOUND = 100.0  # ms, median


def seconds(work: Callable[[], object]) -> float:
    """How long one call takes [s]."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def spread(name: str, values: Sequence[float], unit: str) -> str:
    """A line: least, median, largest."""
    return f"  {name:42s} {min(values):9.2f} {statistics.median(values):9.2f} {max(values):9.2f}  {unit}"


def library() -> list[LibraryEntry]:
    """The shipped bank's intents and planners; the bank itself is not touched."""
    with (
        tempfile.TemporaryDirectory(prefix="sumo_adv-") as folder,
        MemoryBank.open(Path(folder) / "bank.sqlite", seed_from=data_folder("memory_bank.sqlite")) as bank,
    ):
        return read_library(bank, SceneSignature("straight", "neighbour", {}, "idm"), seed=0, situations={})[0]


def encounter(engine: EpisodeEngine, run_input: RunInput, settings: Settings, folder: Path) -> FoundEncounter:
    """Bring an engine to the scenario's trigger."""
    engine.call(EpisodeCalls.open, make_task(run_input, settings, folder))
    outcome = engine.call(EpisodeCalls.seek)
    if not isinstance(outcome, FoundEncounter):
        raise SystemExit(f"{run_input.name}: {outcome.reason}")
    return outcome


def search(
    sandbox: Sandbox, settings: Settings, encounter: FoundEncounter, entries: Sequence[LibraryEntry]
) -> tuple[Proposal, int, float]:
    """The best proposal of a prediction search, how many were predicted, seconds."""
    predictor = Predictor(sandbox, settings, encounter.drivable, encounter.situations)
    weights, made = SearchSettings(proposals=settings.proposals, share=settings.per_planner), list[AttackSearch]()
    took = seconds(
        lambda: made.append(AttackSearch(predictor, encounter.situations, entries, weights, seed=settings.seed))
    )
    return min(made[0].pool, key=lambda p: p.score), predictor.count, took


def states(result: AttemptResult) -> list[tuple[float, dict[str, Any]]]:
    """Everything SUMO said from the trigger on, to compare."""
    return [(s.time, dict(s.raw)) for s in result.snapshots]


def calls(sandbox: Sandbox, encounter: FoundEncounter, proposal: Proposal, runs: int) -> list[str]:
    """Lines on a session, a call, and a call in a batch."""
    situation = encounter.situations[proposal.delay]
    adversary = AdversaryBatch([situation], [proposal.bv])
    start = adversary.begin()
    nothing = start.s * 0.0
    ego = (nothing, nothing, nothing + situation.ego.speed, nothing + situation.ego.acceleration)
    observation: PlannerObservation = adversary.observe(start, 0.0, ego, [None])[0]
    opened, single, batched = [], [], []
    for _ in range(runs):
        began = time.perf_counter()
        with Sessions(sandbox, Roads(encounter.situations), [proposal], 0) as sessions:
            opened.append(time.perf_counter() - began)
            single.append(seconds(lambda: sessions.answer(proposal, observation)))
            many = [proposal] * BATCH
            batched.append(seconds(lambda: sessions.answers(many, range(BATCH), [observation] * BATCH)) / BATCH)  # noqa: B023
    return [
        spread("sandbox: a fresh session with its planner", [1e3 * t for t in opened], "ms"),
        spread("sandbox: a call", [1e3 * t for t in single], "ms"),
        spread(f"sandbox: a call in a batch of {BATCH}", [1e6 * t for t in batched], "us"),
    ]


def measure(name: str, pairs: int, proposals: int, entries: Sequence[LibraryEntry]) -> bool:
    """Print one scenario's lines; whether both ways gave the same states and verdict."""
    run_input = load_input(Path(name))
    base: dict[str, Any] = {"ego": run_input.ego_controller, "horizon": run_input.horizon, "proposals": proposals}
    ways = [load_settings(None, **base, fork=fork) for fork in (True, False)]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="sumo_adv-")))
        sandbox = stack.enter_context(Sandbox())
        engines = [stack.enter_context(Engine(episode_worker)) for _ in ways]
        encounters = [encounter(e, run_input, s, folder) for e, s in zip(engines, ways, strict=True)]
        best, count, searched = search(sandbox, ways[0], encounters[0], entries)
        runners = [AttemptRunner(e, sandbox, f, ways[0].seed) for e, f in zip(engines, encounters, strict=True)]
        results = [next(runner.attempt([best])) for runner in runners]
        took: list[list[float]] = [[], []]
        twice = []
        for _ in range(pairs):
            for times, runner in zip(took, runners, strict=True):
                times.append(seconds(lambda: list(runner.attempt([best]))))  # noqa: B023 - called at once
            twice.append(seconds(lambda: list(runners[0].attempt([best, best]))) / 2)
        lines = calls(sandbox, encounters[0], best, max(3, pairs))
    same = states(results[0]) == states(results[1]) and results[0].verdict == results[1].verdict
    shares = [b / a for a, b in zip(*took, strict=True)]
    fork, load = ([1e3 * t for t in times] for times in took)
    start = f"{encounters[0].time:.1f} s"
    attempt = f"{best.label}/{best.planner.mode}, {len(results[0].snapshots)} steps"
    print(f"{run_input.name}, trigger {start}, {len(results[0].sizes)} vehicles so far: {attempt}")
    print(f"  same states and verdict both ways: {'yes' if same else 'NO'}")
    print(spread("attempt by fork", fork, "ms"))
    print(spread("attempt by load and repeat", load, "ms"))
    print(spread("two by fork at once, each", [1e3 * t for t in twice], "ms"))
    print(spread("load and repeat over fork, pair by pair", shares, ""))
    print(f"  prediction search, {count} proposals: {searched:.2f} s")
    print("\n".join(lines), flush=True)
    return same


def first_attempts(entries: Sequence[LibraryEntry]) -> bool:
    """Print what the first attempts of a search cost; whether the bounds hold."""
    run_input = load_input(Path(ROAD))
    settings = load_settings(None, ego="idm", duration=8.0, density=DENSITY)
    took: dict[str, list[float]] = {name: [] for name in KINDS}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="sumo_adv-")))
        sandbox, engine = stack.enter_context(Sandbox()), stack.enter_context(Engine(episode_worker))
        found = encounter(engine, run_input, settings, folder)
        predictor = Predictor(sandbox, settings, found.drivable, found.situations)
        weights = SearchSettings(share=FIRST)
        search = AttackSearch(predictor, found.situations, entries, weights, seed=settings.seed, predicts=False)
        runner, vehicles = AttemptRunner(engine, sandbox, found, settings.seed), 0
        for proposal in search.propose(FIRST):
            began = time.perf_counter()
            (result,) = runner.attempt([proposal])
            cost = 1e3 * (time.perf_counter() - began)
            vehicles = max(vehicles, len(result.snapshots[0].raw) if len(result.snapshots) else 0)
            collided = result.verdict is not None and result.verdict.collided
            took["with a contact and its level" if collided else "without a contact"].append(cost)
    print(f"{ROAD}, {vehicles} vehicles, {settings.duration:g} s at most: the first {FIRST} attempts of a search")
    good = True
    for name, costs in took.items():
        if costs:
            print(spread(f"{len(costs)} {name}", costs, "ms"))
            good &= statistics.median(costs) <= BOUND
    return good


def main() -> int:
    """Print the lines of each scenario; 1 if an expectation does not hold."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("inputs", nargs="*", default=list(INPUTS), help="inputs as of run")
    parser.add_argument("--pairs", type=int, default=9, help="counted pairs of attempts")
    parser.add_argument("--proposals", type=int, default=120, help="size of the prediction search")
    given = parser.parse_args()
    entries = library()
    print(f"  {'':42s} {'min':>9s} {'median':>9s} {'max':>9s}")
    good = [measure(name, given.pairs, given.proposals, entries) for name in given.inputs]
    return int(not all([*good, first_attempts(entries)]))


if __name__ == "__main__":
    sys.exit(main())
