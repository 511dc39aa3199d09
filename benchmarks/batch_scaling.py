"""What many episodes cost: by a plain loop, by a loop with everything warm, and by ``batch`` on one and two workers.

    python benchmarks/batch_scaling.py [SCENARIO ...] [--episodes 24] [--pairs 3] [--ways warm,one,two,apart]

All do the same episodes in each pair, in an order of ways that turns from pair to pair.  *plain*: what a script would
say, a new engine for each episode; *warm*: one sandbox and one engine process for all, in this process; *one*, *two*: a
batch on N workers, their start included; *apart*: the warm loop in two processes that share a queue and nothing
else: what two workers can come to on this machine.

Bounds: two workers over one at least 0.9 of what two loops apart come to, one worker at most 10 % slower than the warm
loop (medians of the pairs).  Both count from the time that all workers have finished an episode until the first finds
nothing to do.  How many times as fast: the time that one worker took for the episodes finished in between, over the
time they took now.  *cores*: processors that were busy meanwhile, with whatever (Linux; at rest it shows what two
workers leave idle).
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from sumo_adv.app import batch_parts, open_agents
from sumo_adv.campaigns.campaign import Orders, run_batch
from sumo_adv.campaigns.local import WorkerPace
from sumo_adv.campaigns.plan import CampaignPlan, make_plan
from sumo_adv.campaigns.results import EpisodeJob, Learn, Row, WorkerSetup
from sumo_adv.campaigns.worker import Runner
from sumo_adv.config import load_settings
from sumo_adv.episode.engine import episode_worker
from sumo_adv.episode.loop import run_episode
from sumo_adv.episode.task import make_task
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.report.folder import write_run
from sumo_adv.report.staging import staged
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.inputs import load_input

BANK = Path(__file__).resolve().parent.parent / "memory_bank.sqlite"
SCENARIOS = ("motorway_cut_in_left", "leader_two_lanes", "oncoming_country_road", "neighbour_ahead_left")
SCALING, OVERHEAD = 0.9, 1.10


@dataclass(frozen=True, slots=True)
class Took:
    """When the episodes of a way finished. ``finished``: job id -> s from the way's begin, in order; ``begin``,
    ``end``: between them all workers were busy [s]; ``cores``: processors busy in the meantime."""

    finished: Mapping[str, float]
    begin: float
    end: float
    cores: float

    @property
    def whole(self) -> float:
        """From the first instruction to the last episode [s]."""
        return max(self.finished.values())

    @property
    def counted(self) -> list[str]:
        """Jobs that finished while all were busy."""
        return [job for job, time in self.finished.items() if self.begin < time <= self.end]

    @property
    def steady(self) -> float:
        """s an episode while all were busy."""
        return (self.end - self.begin) / len(self.counted)

    def costs(self) -> dict[str, float]:
        """What each episode but the first took, of a way that does one at a time [s]."""
        times = list(self.finished.values())
        return {job: after - before for job, (before, after) in zip(self.counted, pairwise(times), strict=True)}


class Clock:
    """A watcher that notes when episodes finish."""

    def __init__(self) -> None:
        self.began = time.perf_counter()
        self.finishes: dict[str, float] = {}
        self.busy = [busy()]

    def begin(self, total: int, before: Sequence[Row]) -> None:
        """Nothing."""

    def finished(self, job: EpisodeJob, row: Row | None = None) -> None:
        """Now."""
        self.finishes[job.id] = time.perf_counter() - self.began
        self.busy.append(busy())

    def stopping(self, now: bool) -> None:
        """Nothing."""

    def took(self, workers: int) -> Took:
        """The notes of ``workers`` workers that share the episodes."""
        times = list(self.finishes.values())
        first, last = workers - 1, len(times) - workers
        cores = (self.busy[last + 1] - self.busy[first + 1]) / (times[last] - times[first])
        return Took(self.finishes, times[first], times[last], cores)


def busy() -> float:
    """Seconds that the machine's processors were busy since it started, all together; nan where that is not known."""
    try:
        ticks = [int(word) for word in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]]
    except OSError:
        return math.nan
    return (sum(ticks[:8]) - ticks[3] - ticks[4]) / os.sysconf("SC_CLK_TCK")


def main() -> int:
    """Measure and print; 1 if a bound is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenarios", nargs="*", default=SCENARIOS)
    parser.add_argument("--episodes", type=int, default=24)
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--proposals", type=int, default=120)
    parser.add_argument("--ways", default="plain,warm,one,two,apart")
    args = parser.parse_args()
    settings = {"attempts": 1, "proposals": args.proposals}
    table = {"inputs": list(args.scenarios), "seeds": -(-args.episodes // len(args.scenarios)), "settings": settings}
    plan = make_plan(table, Path(), "The plan", batch_parts())
    all_ways: list[Callable[[CampaignPlan, Path], Took]] = [plain, warm, one, two, apart]
    ways = [way for way in all_ways if way.__name__ in args.ways.split(",")]
    results: dict[str, list[Took]] = {way.__name__: [] for way in ways}
    for k in range(args.pairs):
        for way in ways[k % len(ways) :] + ways[: k % len(ways)]:
            with tempfile.TemporaryDirectory() as folder:
                results[way.__name__].append(way(plan, Path(folder)))
    show(results, len(plan.jobs), args.pairs)
    return judge(results)


def show(results: Mapping[str, Sequence[Took]], episodes: int, pairs: int) -> None:
    """A row for each way."""
    print(f"{episodes} episodes, {pairs} pairs; ms an episode: low, median, high of the whole | steady median | cores")
    for name, took in results.items():
        whole = sorted(1e3 * each.whole / episodes for each in took)
        steady = statistics.median(1e3 * each.steady for each in took)
        cores = statistics.median(each.cores for each in took)
        print(
            f"{name:6s} {whole[0]:8.0f} {statistics.median(whole):8.0f} {whole[-1]:8.0f} | {steady:8.0f} | {cores:5.2f}"
        )


def judge(results: Mapping[str, Sequence[Took]]) -> int:
    """Print how the ways compare; 1 if a bound is missed."""
    missed, faster = False, dict[str, float]()
    for name in ("two", "apart"):
        if {"one", name} <= set(results):
            faster[name] = statistics.median(speed(a, b) for a, b in zip(results["one"], results[name], strict=True))
            print(f"{name} over one: {faster[name]:.2f} times as fast")
    if len(faster) == 2:
        print(f"two over apart: {faster['two'] / faster['apart']:.2f} (bound {SCALING})")
        missed |= faster["two"] < SCALING * faster["apart"]
    if {"one", "warm"} <= set(results):
        overhead = statistics.median(a.steady / b.steady for a, b in zip(results["one"], results["warm"], strict=True))
        print(f"one over the warm loop: {100 * (overhead - 1):+.1f} % an episode (bound {100 * (OVERHEAD - 1):.0f} %)")
        missed |= overhead > OVERHEAD
    if {"one", "plain"} <= set(results):
        against = statistics.median(a.whole / b.whole for a, b in zip(results["one"], results["plain"], strict=True))
        print(f"one over the plain loop, start included: {100 * (against - 1):+.1f} %")
    return int(missed)


def speed(one: Took, other: Took) -> float:
    """How many times as fast: the time that ``one`` took for the other's counted episodes, over what they took now."""
    costs = one.costs()
    usual = statistics.median(costs.values())  # of the first one: its beginning is not known
    return sum(costs.get(job, usual) for job in other.counted) / (other.end - other.begin)


def plain(plan: CampaignPlan, folder: Path) -> Took:
    """A script's loop."""
    clock = Clock()
    with Sandbox() as sandbox, MemoryBank.open(BANK, read_only=True) as bank:
        for job in plan.jobs:
            run_input = load_input(job.input.path)
            settings = load_settings(None, seed=job.seed, learn="off", **plan.variants[0])
            with (
                tempfile.TemporaryDirectory() as scratch, staged(folder / job.id, force=False) as place,
                open_agents(settings, sandbox) as cast, Engine(episode_worker) as engine,
            ):  # fmt: skip
                task = make_task(run_input, settings, Path(scratch))
                run = run_episode(run_input, settings, task, engine, cast, bank, lambda *_: None)
                write_run(place, run, figure=False)
                place.keep(force=False)
            clock.finished(job)
    return clock.took(1)


def warm(plan: CampaignPlan, folder: Path) -> Took:
    """One sandbox, one engine process."""
    clock = Clock()
    (folder / "runs").mkdir()
    with Runner(_setup(plan, folder)) as runner:
        for job in plan.jobs:
            runner.run(job, last=True)
            clock.finished(job)
    return clock.took(1)


def apart(plan: CampaignPlan, folder: Path) -> Took:
    """The warm loop in two processes."""
    context = multiprocessing.get_context("spawn")
    clock, waiting, finishes = Clock(), context.Queue(), context.Queue()
    (folder / "runs").mkdir()
    loops = [context.Process(target=_loop, args=(_setup(plan, folder), waiting, finishes)) for _ in range(2)]
    for job in (*plan.jobs, *(None for _ in loops)):
        waiting.put(job)
    for loop in loops:
        loop.start()
    for _ in plan.jobs:
        clock.finished(finishes.get())
    for loop in loops:
        loop.join()
    return clock.took(len(loops))


def _loop(setup: WorkerSetup, waiting: Any, finishes: Any) -> None:
    with Runner(setup) as runner:
        while (job := waiting.get()) is not None:
            runner.run(job, last=True)
            finishes.put(job)


def _setup(plan: CampaignPlan, folder: Path) -> WorkerSetup:
    return WorkerSetup(folder / "runs", BANK, Learn.OFF, plan.variants, False, batch_parts())


def one(plan: CampaignPlan, folder: Path) -> Took:
    """``batch --workers 1``."""
    return _batch(plan, folder, 1)


def two(plan: CampaignPlan, folder: Path) -> Took:
    """``batch --workers 2``."""
    return _batch(plan, folder, 2)


def _batch(plan: CampaignPlan, folder: Path, workers: int) -> Took:
    clock = Clock()
    orders = Orders(folder / "out", BANK, {}, WorkerPace(workers, 600.0, 1000))
    summary = run_batch(plan, orders, batch_parts(), clock)
    assert len(summary.rows) == len(plan.jobs)
    return clock.took(workers)


if __name__ == "__main__":
    sys.exit(main())
