"""Where the processor time of attempts goes: a sampled profile of all processes, as shares by part.

``python benchmarks/profile_attempts.py [--ego cautious_ego:CautiousEgo] [--attempts 150]``: the first attempts of a
search that predicts nothing, on a road with about 20 vehicles. With ``--suite smoke [--every 9]``: every ninth
encounter of a suite instead, with the built-in expert until a valid collision, predictions included; nothing is learnt.

Every millisecond of its processor time, each process (the front, the engine and the engine's forks) writes its stack
and the processor time since its last sample to a file. A part's share counts all samples with its function on the
stack. SUMO's time counts as that of the call that waits for it. ``--stacks FILE`` keeps the samples, one line each, for
a flame graph.
"""

from __future__ import annotations

import argparse
import os
import resource
import signal
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from types import CodeType, FrameType

from sumo_adv.agents.agents import Agents
from sumo_adv.app import load
from sumo_adv.benchmark.suites import load_suite
from sumo_adv.config import load_settings
from sumo_adv.drivers.careful import CarefulEgo
from sumo_adv.drivers.lattice_ego import LatticeEgo
from sumo_adv.drivers.prediction import PredictedEgos
from sumo_adv.drivers.registry import UserEgo
from sumo_adv.episode import attempt, verdict
from sumo_adv.episode.assessment import AttemptRunner
from sumo_adv.episode.attempt import OngoingAttempt
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.engine import EpisodeCalls, EpisodeEngine
from sumo_adv.episode.loop import run_episode
from sumo_adv.episode.memory_access import read_library
from sumo_adv.episode.open_encounter import OpenEncounter
from sumo_adv.episode.references import PlannedEgo, ReferenceEgo
from sumo_adv.episode.surroundings import Surroundings
from sumo_adv.episode.task import AttemptResult, NoEncounter, make_task
from sumo_adv.episode.worker import EpisodeWorker
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.records import SceneSignature
from sumo_adv.metrics.reference import counterfactual
from sumo_adv.metrics.verdict import judge_attempt
from sumo_adv.planners.adversary_batch import AdversaryBatch
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.sessions import Sessions
from sumo_adv.search import rollouts
from sumo_adv.search.prediction import Predictor
from sumo_adv.search.scoring import judge_all
from sumo_adv.search.search import AttackSearch
from sumo_adv.search.settings import SearchSettings
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.forks import in_forks
from sumo_adv.simulation.inputs import data_folder, load_input
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.tracks import tracks_of

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
ROAD, DENSITY_PER_KM, DURATION_S = "straight_4lane", 250.0, 8.0  # about 20 vehicles
GENERATION = 8  # attempts after which the search looks at their verdicts
SAMPLED_EVERY_S = 1e-3
MOST_FRAMES = 60

Part = str | tuple[Callable[..., object], ...]
PARTS: tuple[tuple[str, Part], ...] = (
    ("front", "front"),
    ("  predictions, all", (Predictor.score,)),
    ("    sandbox sessions opened", (Sessions.__enter__,)),
    ("    planners' observations", (AdversaryBatch.observe,)),
    ("    planners asked", (Sessions.answers,)),
    ("    goals on the ways", (AdversaryBatch.aim,)),
    ("    egos foreseen", (PredictedEgos.step,)),
    ("    adversaries moved", (rollouts._advance,)),
    ("    rollouts judged", (judge_all,)),
    ("  attempts requested", (AttemptRunner.attempt,)),
    ("engine", "engine"),
    ("  forks made and read", (in_forks,)),
    ("forks of the engine", "fork"),
    ("  go on to the start", (OpenEncounter._begin,)),
    ("  driving", (attempt.attack,)),
    ("    ego's turn", (Drive._let_ego_act,)),
    ("      observation", (Drive.observation,)),
    ("        surroundings", (Surroundings.__call__,)),
    ("      the driver's act", (UserEgo.act, CarefulEgo.act, LatticeEgo.act, ReferenceEgo.act, PlannedEgo.act)),
    ("      speed asked for", (Simulation.set_speed,)),
    ("    planning again", (OngoingAttempt._plan,)),
    ("    adversaries led", (OngoingAttempt._led,)),
    ("    poses injected", (Simulation.inject,)),
    ("    SUMO's step", (Simulation.step,)),
    ("    states read", (Simulation.read,)),
    ("    distances", (attempt.apart_of,)),
    ("  verdict", (verdict.verdict_on,)),
    ("    motions recorded", (tracks_of,)),
    ("    gates, contact and level", (judge_attempt,)),
    ("      reference roll-outs", (counterfactual.driver_outcomes,)),
)
"""What is counted: a process, or functions in the process above them. A part that is indented is of the one above."""


# -- sampling -------------------------------------------------------------------------------------------------------


class Sampler:
    """Writes the stacks of this process and its forks to a file."""

    def __init__(self, file: Path, process: str) -> None:
        self._file = os.open(file, os.O_WRONLY | os.O_APPEND)
        self._process, self._names = process, dict[CodeType, str]()
        self._counted = time.process_time()
        signal.signal(signal.SIGPROF, self._sample)
        signal.siginterrupt(signal.SIGPROF, False)  # SUMO reads files
        os.register_at_fork(after_in_child=self._in_fork)
        self._start()

    def _start(self) -> None:
        signal.setitimer(signal.ITIMER_PROF, SAMPLED_EVERY_S, SAMPLED_EVERY_S)

    def _in_fork(self) -> None:
        self._process, self._counted = "fork", 0.0
        self._start()

    def _sample(self, _: int, frame: FrameType | None) -> None:
        spent, names = time.process_time() - self._counted, list[str]()
        while frame is not None and len(names) < MOST_FRAMES:
            code = frame.f_code
            if code not in self._names:
                self._names[code] = name_of(code)
            names.append(self._names[code])
            frame = frame.f_back
        ended = resource.getrusage(resource.RUSAGE_CHILDREN)
        line = f"{self._process};{';'.join(reversed(names))} {spent:.6f} {ended.ru_utime + ended.ru_stime:.6f}\n"
        os.write(self._file, line.encode())
        self._counted = time.process_time()  # the sampler's own time counts for no part


def name_of(code: CodeType) -> str:
    """A function's name with its module's, without blanks and semicolons."""
    return f"{Path(code.co_filename).stem}.{code.co_qualname}".replace(" ", "_").replace(";", "_")


def sampled_worker(file: Path, slots: list[Connection]) -> EpisodeWorker:
    """The worker of an engine process that is sampled."""
    Sampler(file, "engine")
    return EpisodeWorker(slots)


# -- what is profiled -----------------------------------------------------------------------------------------------


def first_attempts(count: int, ego: str, engine: EpisodeEngine, sandbox: Sandbox, begin: Callable[[], None]) -> str:
    """Make the first attempts of a search; ``begin`` is called before the first one. A line on what was done."""
    run_input = load_input(Path(ROAD))
    settings = load_settings(None, ego=ego, duration=DURATION_S, density=DENSITY_PER_KM)
    with (
        tempfile.TemporaryDirectory(prefix="sumo_adv-") as folder,
        MemoryBank.open(data_folder("memory_bank.sqlite"), read_only=True) as bank,
    ):
        engine.call(EpisodeCalls.open, make_task(run_input, settings, Path(folder)))
        found = engine.call(EpisodeCalls.seek)
        if isinstance(found, NoEncounter):
            raise SystemExit(found.reason)
        entries = read_library(bank, SceneSignature("straight", "neighbour", {}, ego), seed=0, situations={})[0]
        predictor = Predictor(sandbox, settings, found.drivable, found.situations)
        search = AttackSearch(
            predictor, found.situations, entries, SearchSettings(share=count), seed=settings.seed, predicts=False
        )
        runner, results = AttemptRunner(engine, sandbox, found, settings.seed), list[AttemptResult]()
        begin()
        while len(results) < count and (proposals := search.propose(min(GENERATION, count - len(results)))):
            for proposal, result in zip(proposals, runner.attempt(proposals), strict=True):
                results.append(result)
                if result.verdict is not None:
                    search.observe(proposal, None, result.verdict)
    contacts = sum(r.verdict is not None and r.verdict.collided for r in results)
    steps, vehicles = sum(len(r.snapshots) for r in results), len(results[0].snapshots[0].raw)
    return f"{len(results)} attempts on {ROAD} against {ego}: {contacts} contacts, {steps} steps, {vehicles} vehicles"


def encounters(
    suite: str, every: int, ego: str, engine: EpisodeEngine, sandbox: Sandbox, begin: Callable[[], None]
) -> str:
    """Attack encounters of a suite, as ``first_attempts`` does."""
    cases, done = load_suite(suite).cases[::every], 0
    begin()
    for case in cases:
        run_input = load(case.path, case.record)
        settings = load_settings(None, ego=ego, until="valid", learn="off", horizon=run_input.horizon)
        with (
            tempfile.TemporaryDirectory(prefix="sumo_adv-") as folder,
            MemoryBank.open(data_folder("memory_bank.sqlite"), read_only=True) as bank,
        ):
            task = make_task(run_input, settings, Path(folder))
            run = run_episode(run_input, settings, task, engine, Agents(settings, sandbox), bank, _silent)
            done += sum(len(record.attempts) for record in run.records)
    return f"{len(cases)} encounters of {suite} against {ego}: {done} attempts"


def _silent(*_: object) -> None:
    """Take no note of a run's progress."""


# -- the table ------------------------------------------------------------------------------------------------------


def read_samples(file: Path) -> tuple[Mapping[frozenset[str], float], float]:
    """Seconds by the names on the stack, and the seconds of forks after their last samples."""
    seconds, ended = defaultdict[frozenset[str], float](float), list[float]()
    for line in file.read_text().splitlines():
        stack, spent, children = line.rsplit(" ", 2)
        names = stack.split(";")
        seconds[frozenset(names)] += float(spent)
        ended += [float(children)] if names[0] == "engine" else []
    forks = sum(s for names, s in seconds.items() if "fork" in names)
    return seconds, max(0.0, ended[-1] - ended[0] - forks) if ended else 0.0


def table(seconds: Mapping[frozenset[str], float], unsampled: float) -> list[str]:
    """A line for each part: seconds and share."""
    whole, rows, process = sum(seconds.values()) + unsampled, list[str](), ""
    for title, part in PARTS:
        process = part if isinstance(part, str) else process
        functions = {part} if isinstance(part, str) else {name_of(each.__code__) for each in part}
        took = sum(s for names, s in seconds.items() if process in names and not functions.isdisjoint(names))
        took += unsampled if part == "fork" else 0.0
        rows += [f"  {title:32s} {took:8.2f} s {took / whole:6.1%}"] if took or isinstance(part, str) else []
        if part == "fork":
            rows.append(f"  {'  begin and end of the process':32s} {unsampled:8.2f} s {unsampled / whole:6.1%}")
    return [*rows, f"  {'all':32s} {whole:8.2f} s"]


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ego", default="cautious_ego:CautiousEgo", help="the ego's driver (default: the example's)")
    parser.add_argument("--attempts", type=int, default=150, help="how many attempts are made")
    parser.add_argument("--suite", help="attack encounters of this suite instead")
    parser.add_argument("--every", type=int, default=9, help="take every Nth encounter of the suite")
    parser.add_argument("--stacks", type=Path, help="keep the samples in this file")
    given = parser.parse_args()
    sys.path.insert(0, str(EXAMPLES))
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="sumo_adv-")))
        samples = folder / "samples" if given.stacks is None else given.stacks
        samples.write_text("")
        engine = stack.enter_context(Engine(partial(sampled_worker, samples)))
        sandbox = stack.enter_context(Sandbox())

        def begin() -> None:
            samples.write_text("")
            Sampler(samples, "front")

        try:
            if given.suite is None:
                done = first_attempts(given.attempts, given.ego, engine, sandbox, begin)
            else:
                done = encounters(given.suite, given.every, given.ego, engine, sandbox, begin)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
        seconds, unsampled = read_samples(samples)
    print(done)
    print("\n".join(table(seconds, unsampled)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
