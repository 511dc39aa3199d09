"""What many episodes cost: by a plain loop, by a loop with everything warm, and by ``batch`` on one and two workers.

    python benchmarks/batch_scaling.py [--episodes 24] [--pairs 3]

All four do the same episodes, one after another in each pair, in an order that turns from pair to pair.  *plain*: what
a script would say, a new engine for each episode; *warm*: one sandbox and one engine process for all, in this process;
*one*, *two*: a batch on so many workers, their start included.  Bounds: two workers at least 1.8 times as fast as one,
one worker at most 10 % slower than the warm loop (medians of the pairs, the start of the workers left out: *steady*).
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from sumo_adv.batch.campaign import Orders, run_batch
from sumo_adv.batch.local import Pace
from sumo_adv.batch.nouns import Job, Learn, Row, Setup
from sumo_adv.batch.plan import Plan, make_plan
from sumo_adv.batch.worker import Runner
from sumo_adv.cli.batch_parts import batch_parts
from sumo_adv.cli.models import cast_of
from sumo_adv.config import load_settings
from sumo_adv.episode.loop import make_task, run_episode
from sumo_adv.episode.worker import body
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.planning.sandbox import Sandbox
from sumo_adv.report.folder import staged, write_run
from sumo_adv.world.engine import Engine
from sumo_adv.world.inputs import load_input

BANK = Path(__file__).resolve().parent.parent / "memory_bank.sqlite"
SCENARIOS = ("motorway_cut_in_left", "leader_two_lanes", "oncoming_country_road", "neighbour_ahead_left")
SCALING, OVERHEAD = 1.8, 1.10


class Clock:
    """A watcher that notes when episodes finish."""

    def __init__(self) -> None:
        self.times: list[float] = []

    def begin(self, total: int, before: Sequence[Row]) -> None:
        """Nothing."""

    def finished(self, job: Job, row: Row) -> None:
        """Now."""
        self.times.append(time.perf_counter())

    def stopping(self, now: bool) -> None:
        """Nothing."""


def main() -> int:
    """Measure and print; 1 if a bound is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=24)
    parser.add_argument("--pairs", type=int, default=3)
    args = parser.parse_args()
    seeds = -(-args.episodes // len(SCENARIOS))
    table = {"inputs": list(SCENARIOS), "seeds": seeds, "settings": {"attempts": 1}}
    plan = make_plan(table, Path(), "The plan", batch_parts())
    ways: list[Callable[[Plan, Path], tuple[float, float]]] = [plain, warm, one, two]
    found: dict[str, list[tuple[float, float]]] = {way.__name__: [] for way in ways}
    for k in range(args.pairs):
        for way in ways[k % 4 :] + ways[: k % 4]:
            with tempfile.TemporaryDirectory() as folder:
                found[way.__name__].append(way(plan, Path(folder)))
    print(
        f"{len(plan.jobs)} episodes, {args.pairs} pairs; ms an episode: low, median, high of the whole | steady median"
    )
    for name, took in found.items():
        whole = sorted(1e3 * w / len(plan.jobs) for w, _ in took)
        steady = statistics.median(1e3 * s for _, s in took)
        print(f"{name:6s} {whole[0]:8.0f} {statistics.median(whole):8.0f} {whole[-1]:8.0f} | {steady:8.0f}")
    scaling = statistics.median(a[1] / b[1] for a, b in zip(found["one"], found["two"], strict=True))
    overhead = statistics.median(a[1] / b[1] for a, b in zip(found["one"], found["warm"], strict=True))
    against = statistics.median(a[0] / b[0] for a, b in zip(found["one"], found["plain"], strict=True))
    print(f"two workers over one: {scaling:.2f} times as fast (bound {SCALING})")
    print(
        f"one worker over the warm loop: {100 * (overhead - 1):+.1f} % an episode (bound {100 * (OVERHEAD - 1):.0f} %)"
    )
    print(f"one worker over the plain loop, start included: {100 * (against - 1):+.1f} %")
    return int(scaling < SCALING or overhead > OVERHEAD)


def steady(times: Sequence[float], at_once: int) -> float:
    """s an episode from the time that all workers had finished one."""
    return (times[-1] - times[at_once - 1]) / (len(times) - at_once)


def plain(plan: Plan, folder: Path) -> tuple[float, float]:
    """A script's loop."""
    times, began = [], time.perf_counter()
    with Sandbox() as sandbox, MemoryBank.open(BANK, read_only=True) as bank:
        for job in plan.jobs:
            given = load_input(job.input.source)
            settings = load_settings(None, seed=job.seed, learn="off", **plan.variants[0])
            with (
                tempfile.TemporaryDirectory() as scratch, staged(folder / job.id, force=False) as place,
                cast_of(settings, sandbox) as cast, Engine(body) as engine,
            ):  # fmt: skip
                task = make_task(given, settings, Path(scratch))
                episode = run_episode(given, settings, task, engine, cast, bank, lambda *_: None)
                write_run(place, episode, figure=False)
                place.keep(force=False)
            times.append(time.perf_counter())
    return times[-1] - began, steady(times, 1)


def warm(plan: Plan, folder: Path) -> tuple[float, float]:
    """One sandbox, one engine process."""
    times, began = [], time.perf_counter()
    (folder / "runs").mkdir()
    with Runner(Setup(folder / "runs", BANK, Learn.OFF, plan.variants, False, batch_parts())) as runner:
        for job in plan.jobs:
            runner.run(job, last=True)
            times.append(time.perf_counter())
    return times[-1] - began, steady(times, 1)


def one(plan: Plan, folder: Path) -> tuple[float, float]:
    """``batch --workers 1``."""
    return _batch(plan, folder, 1)


def two(plan: Plan, folder: Path) -> tuple[float, float]:
    """``batch --workers 2``."""
    return _batch(plan, folder, 2)


def _batch(plan: Plan, folder: Path, workers: int) -> tuple[float, float]:
    clock, began = Clock(), time.perf_counter()
    orders = Orders(folder / "out", BANK, {}, Pace(workers, 600.0, 1000))
    summary = run_batch(plan, orders, batch_parts(), clock)
    whole = time.perf_counter() - began
    assert len(summary.rows) == len(plan.jobs)
    with suppress(OSError):
        shutil.rmtree(folder / "out")
    return whole, steady(clock.times, workers)


if __name__ == "__main__":
    sys.exit(main())
