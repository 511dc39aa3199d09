"""Where time goes in an encounter: the front's seconds by part, under Python's profiler.

``python benchmarks/profile_encounter.py [--suite suite81] [--every 9] [--ego idm]``: every ninth encounter with the
built-in expert until a valid collision, nothing learnt; one to three minutes.  The profiler's own cost is in the
seconds (the ratio of a run without it is printed), so read the shares.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from sumo_adv.agents.agents import Agents
from sumo_adv.app import load
from sumo_adv.benchmark.nouns import Case
from sumo_adv.benchmark.suites import load_suite
from sumo_adv.config import load_settings
from sumo_adv.drivers.prediction import PredictedEgos
from sumo_adv.episode.assessment import AttemptRunner
from sumo_adv.episode.loop import run_episode
from sumo_adv.episode.task import make_task
from sumo_adv.episode.warm import WarmEngine
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.planners.adversary_batch import AdversaryBatch
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.sessions import Sessions
from sumo_adv.search import rollouts
from sumo_adv.search.prediction import Predictor
from sumo_adv.search.scoring import judge_all
from sumo_adv.simulation.inputs import data_folder

PARTS: dict[str, Callable[..., object]] = {
    "predictions, all": Predictor.score,
    "  sandbox sessions opened": Sessions.__enter__,
    "  planners' observations": AdversaryBatch.observe,
    "  planners asked": Sessions.answers,
    "  goals on the ways": AdversaryBatch.aim,
    "  egos foreseen": PredictedEgos.step,
    "  adversaries moved": rollouts._advance,
    "  rollouts judged": judge_all,
    "attempts in SUMO": AttemptRunner.attempt,
}
"""What is counted; those set in are parts of the predictions."""


def run(cases: Sequence[Case], ego: str, engine: WarmEngine, sandbox: Sandbox) -> None:
    """The encounters, one after the other."""
    for case in cases:
        source = load(case.path, case.record)
        settings = load_settings(None, ego=ego, until="valid", learn="off", horizon=source.horizon)
        with (
            tempfile.TemporaryDirectory(prefix="sumo_adv-") as folder,
            MemoryBank.open(data_folder("memory_bank.sqlite"), read_only=True) as bank,
            engine.episode() as opened,
        ):
            task = make_task(source, settings, Path(folder))
            run_episode(source, settings, task, opened, Agents(settings, sandbox), bank, lambda *_: None)


def seconds_of(stats: pstats.Stats, part: Callable[..., object]) -> float:
    """Cumulative seconds of a function."""
    code = part.__code__
    return float(stats.stats.get((code.co_filename, code.co_firstlineno, code.co_name), (0, 0, 0, 0.0))[3])  # type: ignore[attr-defined]


def main() -> None:
    """Print the parts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--suite", default="suite81")
    parser.add_argument("--every", type=int, default=9, help="take every Nth encounter")
    parser.add_argument("--ego", default="idm")
    given = parser.parse_args()
    cases = load_suite(given.suite).cases[:: given.every]
    engine, profile = WarmEngine(), cProfile.Profile()
    with Sandbox() as sandbox:
        run(cases[:1], given.ego, engine, sandbox)  # everything is warm
        began = time.perf_counter()
        run(cases, given.ego, engine, sandbox)
        plain = time.perf_counter() - began
        began = time.perf_counter()
        profile.runcall(run, cases, given.ego, engine, sandbox)
        whole = time.perf_counter() - began
    engine.close()
    stats = pstats.Stats(profile)
    print(f"{len(cases)} encounters of {given.suite} against {given.ego}: {plain / len(cases):.2f} s each")
    print(f"under the profiler {whole / plain:.2f} times as long; of these {whole:.1f} s:")
    for name, part in PARTS.items():
        took = seconds_of(stats, part)
        print(f"  {name:28s} {took:6.2f} s  {took / whole:5.0%}")


if __name__ == "__main__":
    main()
