"""Build an episode, and the parts of a batch and of a benchmark, from settings.

The commands and the Python interface call these functions. Functions import what they use when they are called, so that
a command loads only what it needs. The functions of ``batch_parts`` and ``bench_parts`` are sent to other processes,
which import them by name.
"""

from __future__ import annotations

import atexit
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from sumo_adv.errors import BankError, UsageError
from sumo_adv.files import scratch_prefix

if TYPE_CHECKING:
    from multiprocessing.util import Finalize

    from sumo_adv.agents.agents import Agents
    from sumo_adv.benchmark.jobs import BenchParts
    from sumo_adv.campaigns.campaign import CampaignWatcher, Orders, Summary
    from sumo_adv.campaigns.plan import CampaignPlan
    from sumo_adv.campaigns.results import CampaignParts
    from sumo_adv.config import Settings
    from sumo_adv.datatypes import LibraryEntry
    from sumo_adv.driver_check import Checked, DriverCheck
    from sumo_adv.drivers.registry import GivenEgo
    from sumo_adv.episode.engine import EpisodeEngine
    from sumo_adv.episode.run import Run
    from sumo_adv.episode.warm import WarmEngine
    from sumo_adv.input_check import InputCheck
    from sumo_adv.llm.chat import ChatModel
    from sumo_adv.llm.prompts import Prompts
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.planners.sandbox import Sandbox
    from sumo_adv.rate.blocks import RatePlan
    from sumo_adv.rate.estimate import RateEstimate
    from sumo_adv.report.manifest import RecordedRun
    from sumo_adv.simulation.inputs import RunInput

# -- the input and the memory bank --------------------------------------------------------------------------------


def load(path: Path, record: str | None) -> RunInput:
    """Load an input. A Waymo record or a CommonRoad scenario is converted, or taken from the cache.

    Args:
        path: The path or the shipped name of the input.
        record: The record to take from a TFRecord file: its id, or its place from 0; None takes the first.

    Returns:
        The input.

    Raises:
        SumoAdvError: The input cannot be read or converted.
    """
    from sumo_adv.simulation.inputs import WaymoSource, is_commonroad, load_input

    commonroad = is_commonroad(path)
    waymo = ".tfrecord" in path.name.lower() and path.is_file()
    if record is not None and not waymo:
        raise UsageError(f"--record chooses a record of a TFRecord file, and {path} is not one: leave it out.")
    if not waymo and not commonroad:
        return load_input(path)
    from sumo_adv.womd.commonroad import read_commonroad
    from sumo_adv.womd.convert import conversion
    from sumo_adv.womd.reader import choice_of, find_record

    chosen = read_commonroad(path) if commonroad else find_record(path, choice_of(record))
    stack = ExitStack()  # a conversion that cannot be cached is removed at exit
    atexit.register(stack.close)
    made = stack.enter_context(conversion(chosen, traffic=False))
    origin = WaymoSource(path.absolute(), chosen.scenario_id, chosen.content) if waymo else None
    run_input = load_input(made.scenario)
    files = (path.absolute(),) if commonroad else run_input.files
    return replace(
        run_input, name=chosen.scenario_id, files=files, waymo=origin, notes=(*run_input.notes, *chosen.notes)
    )  # fmt: skip


def shipped_bank() -> Path:
    """Return the path of the bank that comes with the program, with the paper's seven intents."""
    from sumo_adv.simulation.inputs import data_folder

    return data_folder("memory_bank.sqlite")


def open_bank(path: Path | None, *, make: bool = False) -> MemoryBank:
    """Open a memory bank. The user's own bank starts as a copy of the shipped one.

    Args:
        path: The bank; None for the user's own.
        make: Whether a missing bank at ``path`` is made as a copy of the shipped one, too.

    Returns:
        The open bank.

    Raises:
        BankError: The bank does not exist or cannot be opened.
    """
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.memory.store import default_bank_path

    if path is not None and not make and not path.exists():
        raise BankError(f"There is no memory bank at {path}; check the path given with --memory.")
    return MemoryBank.open(path or default_bank_path(), seed_from=shipped_bank())


def known_intents(bank: MemoryBank) -> list[LibraryEntry]:
    """List the intents that a run may name, without planners.

    Args:
        bank: The bank.

    Returns:
        The bank's active intents, those of pedestrians and cyclists, and those that the built-in expert composes.
    """
    from sumo_adv.datatypes import LibraryEntry
    from sumo_adv.episode.memory_access import unprotected_library
    from sumo_adv.search.intents import NEW_INTENTS

    known = [(r.label, r.description, r.applies) for r in bank.intents() if r.status == "active"]
    known += [(e.label, e.description, e.applies) for e in unprotected_library()]
    known += [(label, description, (word,)) for word, (label, description, _) in NEW_INTENTS.items()]
    labels = dict.fromkeys(label for label, _, _ in known)
    return [LibraryEntry(*next(k for k in known if k[0] == label), ()) for label in labels]


def open_for_run(settings: Settings) -> MemoryBank:
    """Open the bank of a run's settings. A missing bank is made from the shipped one.

    Raises:
        BankError: The bank cannot be opened.
    """
    return open_bank(settings.memory, make=True)


def check_intents(variants: Sequence[Mapping[str, Any]], bank: Path) -> None:
    """Check that the bank knows the intents that settings name, before any episode runs.

    Args:
        variants: Settings as data.
        bank: The path of the bank. If it does not exist yet, the shipped bank is checked, which it will be made from.

    Raises:
        UsageError: An intent is unknown. The message lists the known ones.
    """
    from sumo_adv.config import load_settings
    from sumo_adv.episode.memory_access import selected
    from sumo_adv.memory.bank import MemoryBank

    named = [v for v in variants if v.get("intents") or v.get("exclude")]
    if named:
        with MemoryBank.open(bank if bank.exists() else shipped_bank(), read_only=True) as opened:
            for variant in named:
                selected(load_settings(None, intents=variant["intents"], exclude=variant["exclude"]), opened)


# -- analyzer, generator and modifier -----------------------------------------------------------------------------


def new_sandbox(settings: Settings) -> Sandbox:
    """Make the sandbox in which planners run."""
    from sumo_adv.planners.sandbox import Sandbox

    return Sandbox(bubblewrap=settings.bubblewrap)


@contextmanager
def open_agents(settings: Settings, sandbox: Sandbox, record: Path | None = None) -> Iterator[Agents]:
    """Open the agents of a run.

    Args:
        settings: The settings of the run.
        sandbox: Where planners are tried.
        record: The file to which every exchange with a model is written; None for no file.

    Yields:
        The agents.

    Raises:
        UsageError: A model has no server or no key.
        ModelError: The file cannot be written.
    """
    from sumo_adv.agents.agents import AGENT_ROLES, Agents
    from sumo_adv.llm.chat import Ledger

    names = {role: name for role in AGENT_ROLES if (name := settings.player(role)) is not None}
    if not names:
        yield Agents(settings, sandbox)
        return
    from sumo_adv.llm.client import open_model
    from sumo_adv.llm.recording import Recorder

    ledger = Ledger.for_settings(settings)
    by_name: dict[str, ChatModel] = {name: open_model(name, settings, ledger) for name in sorted(set(names.values()))}
    with ExitStack() as stack:
        if record is not None:
            recorder = stack.enter_context(Recorder(record, ", ".join(model.name for model in by_name.values())))
            by_name = {name: recorder.wrap(model) for name, model in by_name.items()}
        models = {role: by_name[name] for role, name in names.items()}
        yield Agents(settings, sandbox, models, ledger, shipped_prompts())


def shipped_prompts() -> Prompts:
    """Return the prompts that come with the program."""
    from sumo_adv.llm.prompts import Prompts
    from sumo_adv.simulation.inputs import data_folder

    return Prompts(data_folder("prompts"))


# -- an episode ---------------------------------------------------------------------------------------------------


def play(
    run_input: RunInput,
    settings: Settings,
    stage: Path,
    scratch: Path,
    tell: Callable[[str, Any], None],
    played: Callable[[], None] = lambda: None,
    ego: GivenEgo | None = None,
) -> Run:
    """Run one episode.

    Args:
        run_input: The input.
        settings: The settings of the run.
        stage: The folder in which the models' answers are recorded.
        scratch: The folder for generated demand. It is needed until the run is written.
        tell: Called with each event and its value.
        played: Called when the episode ends, before its processes end.
        ego: The driver if it is a class or an object from Python, otherwise None.

    Returns:
        The run. A failure other than wrong use is its ending.

    Raises:
        UsageError: A setting does not fit the input, or ``ask`` is set without a model.
        BankError: The bank cannot be opened.
    """
    settings = _with_request(settings)
    with new_engine() as engine:  # first, because it loads its modules while this process loads others
        from sumo_adv.episode.clock import PartsClock
        from sumo_adv.episode.loop import run_episode
        from sumo_adv.episode.task import make_task
        from sumo_adv.report.encounter_figure import load_matplotlib
        from sumo_adv.report.outcome import MODEL_FILE

        clock = PartsClock()
        with clock.part("start"):
            load_matplotlib()
        with clock.part("input"):
            task = replace(make_task(run_input, settings, scratch), ego_given=ego)
        with (
            open_for_run(settings) as bank,
            new_sandbox(settings) as sandbox,
            open_agents(settings, sandbox, stage / MODEL_FILE) as agents,
        ):
            run = run_episode(run_input, settings, task, engine, agents, bank, tell, clock)
            played()
    return run


def _with_request(settings: Settings) -> Settings:
    """Check the words of ``ask`` and return the settings with them.

    Raises:
        UsageError: The words are bad, or there is no model that can read them.
    """
    if settings.ask is None:
        return settings
    from sumo_adv.words.request import checked_words, needs_model

    words = checked_words(settings.ask)
    if settings.player("analyzer") is None:
        raise needs_model("An attack in words", words)
    return settings.model_copy(update={"ask": words})


def replay(recorded: RecordedRun) -> Run:
    """Repeat the attempt that a manifest records."""
    from sumo_adv.episode.loop import replay_episode

    with new_sandbox(recorded.settings) as sandbox, new_engine() as engine:
        return replay_episode(
            recorded.run_input, recorded.settings, recorded.task, engine, sandbox, recorded.proposal, recorded.skips
        )


def minimise(recorded: RecordedRun, settings: Settings, tell: Callable[[str, Any], None]) -> Run:
    """Make a recorded attack as mild as the level ``settings.until`` allows.

    Args:
        recorded: The run, as its manifest records it.
        settings: The settings of the search for milder variants.
        tell: Called with each event and its value.

    Returns:
        The run with the mildest variant.

    Raises:
        UsageError: The attack cannot be minimised.
    """
    from sumo_adv.episode.minimise import minimise_episode

    task = replace(recorded.task, settings=settings)
    with new_sandbox(settings) as sandbox, new_engine() as engine:
        return minimise_episode(
            recorded.run_input, settings, task, engine, sandbox, recorded.proposal, recorded.skips, tell
        )


def check_driver(
    inputs: Sequence[RunInput] | None, settings: Settings, tell: Callable[[Checked], None], seconds: float | None = None
) -> DriverCheck:
    """Drive ``settings.ego`` unattacked through inputs and report its faults.

    Args:
        inputs: The inputs; None for the twelve of ``driver_check``.
        settings: The settings, which name the driver.
        tell: Called with each scenario as soon as it is done.
        seconds: The time that each input is driven [s]; None for ``DRIVE_DURATION_S``.

    Returns:
        The findings.

    Raises:
        UsageError: The driver cannot be made, or an input is a recording.
        SimulationError: SUMO does not start, or the driver ended the process.
    """
    from sumo_adv.driver_check.check import DRIVE_DURATION_S, check_driver, twelve
    from sumo_adv.driver_check.drive import CheckWorker
    from sumo_adv.simulation.engine import Engine
    from sumo_adv.simulation.processes import deferred_interrupts

    with _without_main(), deferred_interrupts():
        engine = Engine(CheckWorker, slots=0)
    with engine, tempfile.TemporaryDirectory(prefix=scratch_prefix()) as scratch:
        driven = twelve() if inputs is None else inputs
        return check_driver(engine, driven, settings, Path(scratch), seconds=seconds or DRIVE_DURATION_S, tell=tell)


def check_input(run_input: RunInput, settings: Settings, seconds: float) -> InputCheck:
    """Compare an input's traffic without an attack with the program ``sumo``, and count what was read of the input.

    Args:
        run_input: The input.
        settings: The settings of a run.
        seconds: The simulated time to compare [s].

    Returns:
        The comparison and the counts.

    Raises:
        UsageError: The input is bad.
        SimulationError: SUMO fails.
    """
    from sumo_adv.input_check import WatchWorker, check_input
    from sumo_adv.simulation.engine import Engine
    from sumo_adv.simulation.processes import deferred_interrupts

    with _without_main(), deferred_interrupts():
        engine = Engine(WatchWorker, slots=0)
    with engine, tempfile.TemporaryDirectory(prefix="sumo_adv-") as scratch:
        return check_input(engine, run_input, settings, Path(scratch), seconds)


_idle: list[tuple[WarmEngine, Finalize]] = []  # engines that wait for the next run, and what closes them at exit
_of_parents: list[tuple[WarmEngine, Finalize]] = []  # in a fork of a user's process: neither used nor closed


def _leave_to_parent() -> None:
    """Keep the engines of the parent process from being used or closed in a fork."""
    _of_parents.extend(_idle)
    _idle.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_to_parent)


@contextmanager
def new_engine() -> Iterator[EpisodeEngine]:
    """Open an engine process for an episode.

    The process does not run the user's script again, and Ctrl-C does not reach it while it starts. It is kept for the
    next run of this process, which then begins a second sooner.
    """
    from multiprocessing.util import Finalize

    from sumo_adv.episode.warm import WarmEngine
    from sumo_adv.simulation.engine import DEFAULT_SLOTS
    from sumo_adv.simulation.processes import deferred_interrupts

    try:
        warm, ending = _idle.pop()
    except IndexError:
        warm = WarmEngine(DEFAULT_SLOTS)
    else:
        ending.cancel()
    with ExitStack() as stack:
        with _without_main(), deferred_interrupts():
            engine = stack.enter_context(warm.episode())
        yield engine
    if _idle:  # another run ended while this one had its engine
        warm.close()
    else:
        _idle.append((warm, Finalize(None, warm.close, exitpriority=1)))


@contextmanager
def _without_main() -> Iterator[None]:
    """Start processes that do not import the main module.

    A spawned process imports the main module if that has a file. Without that import, scripts need no guard
    (``if __name__ == "__main__"``), and notebooks need no file.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


# -- what the workers of a batch and of a benchmark call ----------------------------------------------------------


def batch_parts() -> CampaignParts:
    """Return the functions that a batch's workers need."""
    from sumo_adv.campaigns.results import CampaignParts
    from sumo_adv.report.folder import write_run
    from sumo_adv.report.outcome import MODEL_FILE
    from sumo_adv.report.staging import staged

    return CampaignParts(load, record_contents, open_agents, staged, write_run, MODEL_FILE)


def run_campaign(plan: CampaignPlan, orders: Orders, watcher: CampaignWatcher, *, states: bool = False) -> Summary:
    """Run the missing episodes of a batch's plan and write its table. The workers do not run the user's script again.

    Args:
        plan: The plan.
        orders: How it is run.
        watcher: Is told about the episodes.
        states: Whether ``states.parquet`` is written as well.

    Returns:
        The summary of the batch.

    Raises:
        UsageError: The folder holds another plan's results, or a package is missing.
        BankError: The bank cannot be opened.
        SumoAdvError: No episode can be run.
    """
    from sumo_adv.campaigns.campaign import run_batch
    from sumo_adv.campaigns.results import check_parquet

    if states or orders.parquet:
        check_parquet()
    open_bank(orders.bank, make=True).close()
    with _without_main():
        summary = run_batch(plan, orders, batch_parts(), watcher)
    if states:
        _write_states(summary.folder, [str(row["id"]) for row in summary.rows])
    return summary


def cluster_processors(address: str) -> int:
    """Count the processors of a Ray cluster.

    Raises:
        UsageError: The cluster cannot be reached.
    """
    from sumo_adv.campaigns.ray_pool import processors_of

    with _without_main():
        return processors_of(address)


def _write_states(folder: Path, names: Sequence[str]) -> None:
    """Write ``states.parquet`` of a batch; unpack packed runs for it, one at a time."""
    from sumo_adv.files import sentences
    from sumo_adv.report.read import write_states_parquet

    def runs() -> Iterator[tuple[str, Path]]:
        for name in names:
            there = folder / "runs" / name
            yield from ((name, run) for run in ([there] if there.is_dir() else unpacked(folder, [name])))

    with sentences(folder):
        write_states_parquet(folder / "states.parquet", runs())


def unpacked(folder: Path, names: Iterable[str]) -> Iterator[Path]:
    """Unpack runs of a batch, one at a time.

    Args:
        folder: The folder of the batch.
        names: The ids of the packed runs.

    Yields:
        The folder of a run, which exists until the next one is taken.

    Raises:
        UsageError: There is no such run.
        SumoAdvError: A run cannot be unpacked.
    """
    from sumo_adv.campaigns.store import unpack_runs
    from sumo_adv.report.staging import staged

    for name in names:
        with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as scratch:
            yield unpack_runs(folder, [name], Path(scratch), staged)[0]


def estimate_rate(
    plan: RatePlan, out: Path, runs: int, workers: int | None, watcher: CampaignWatcher, ray: str | None
) -> RateEstimate | None:
    """Estimate a crash rate. The workers do not run the user's script again.

    Args:
        plan: The plan of the estimate.
        out: The folder of the runs.
        runs: The number of runs that the estimate uses.
        workers: The number of processes; None for one per core.
        watcher: Is told about the blocks of runs.
        ray: The address of a Ray cluster; None for this machine.

    Returns:
        The estimate; None if it was stopped.

    Raises:
        UsageError: The input is bad, or the folder holds the runs of another estimate.
        SimulationError: A run failed twice.
    """
    from sumo_adv.rate.estimate import Estimation

    with _without_main():
        return Estimation(plan, out, workers or os.cpu_count() or 1, watcher, ray).run(runs)


def record_contents(path: Path) -> Iterator[tuple[str, str] | str]:
    """Identify the Waymo records in a file.

    Args:
        path: The TFRecord file.

    Yields:
        The id and the hash of the content of each record; for a bad record a sentence on what is wrong with it.

    Raises:
        UsageError: The file cannot be read.
    """
    from sumo_adv.womd.reader import read_records

    wrong: list[str] = []
    for record in read_records(path, told=lambda error: wrong.append(str(error))):
        yield from wrong
        wrong.clear()
        yield record.scenario_id, record.content
    yield from wrong


def bench_parts() -> BenchParts:
    """Return the functions that a benchmark's workers need."""
    from sumo_adv.benchmark.jobs import BenchParts

    return BenchParts(load, open_agents, full_outcome, keep_run, draw_example)


def full_outcome(run: Run) -> dict[str, Any]:
    """Return the content of ``outcome.json`` for a run. Nothing is written."""
    from sumo_adv.report.folder import full_outcome
    from sumo_adv.report.verdicts import findings_on

    best = run.best
    return full_outcome(run, best, None if best is None else findings_on(run, best))


def keep_run(target: Path, run: Run, exchanges: Path | None = None) -> None:
    """Write the whole folder of a run.

    Args:
        target: The folder; an existing one is replaced.
        run: The run.
        exchanges: The file of the exchanges with a model, which is copied; None for no file.

    Raises:
        UsageError: The folder cannot be written.
    """
    from sumo_adv.report.folder import write_run
    from sumo_adv.report.outcome import MODEL_FILE
    from sumo_adv.report.staging import staged

    with staged(target, force=True, inside=True) as folder:
        write_run(folder, run)
        if exchanges is not None and exchanges.exists():
            shutil.copyfile(exchanges, folder.stage / MODEL_FILE)
        folder.keep(force=True)


def draw_example(target: Path, run: Run) -> None:
    """Draw the encounter without and with the attack, as ``sumo-adv figure`` does.

    Args:
        target: The PNG file to write.
        run: The run.

    Raises:
        UsageError: The run made no attempt, or the file cannot be written.
    """
    from sumo_adv.files import sentences
    from sumo_adv.report.figures import draw_paper, read_story, save
    from sumo_adv.report.folder import write_run
    from sumo_adv.report.staging import staged

    with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as scratch, sentences(target):
        with staged(Path(scratch) / "run", force=False) as folder:
            write_run(folder, run, figure=False)
            folder.keep(force=False)
        target.parent.mkdir(parents=True, exist_ok=True)
        save(draw_paper(read_story(folder.target)), target, "png")
