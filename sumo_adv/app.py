"""Composition: builds an episode, and the parts of a batch and of a benchmark, from settings.

The commands and the Python interface call these functions. Imports stand inside the functions, so that a command loads
only what it needs. The functions of ``batch_parts`` and ``bench_parts`` go to other processes, which import them by
name.
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
    """The input at ``path``. A Waymo record or a CommonRoad scenario is converted, or taken from the cache.

    record: the id, or the place from 0, of the record to take from such a file (default: the first).
    Raises SumoAdvError for what cannot be read or converted.
    """
    from sumo_adv.simulation.inputs import WaymoSource, is_commonroad, load_input

    commonroad = is_commonroad(path)
    waymo = ".tfrecord" in path.name.lower() and path.is_file()
    if record is not None and not waymo:
        raise UsageError(f"--record chooses among the records of a TFRecord file, which {path} is not.")
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
    """The bank of the paper's seven intents that comes with the program."""
    from sumo_adv.simulation.inputs import data_folder

    return data_folder("memory_bank.sqlite")


def open_bank(path: Path | None, *, make: bool = False) -> MemoryBank:
    """The bank at ``path``, by default the user's own. The user's own bank starts as a copy of the shipped one.

    make: make the bank at ``path`` in the same way if it does not exist. Raises BankError.
    """
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.memory.store import default_bank_path

    if path is not None and not make and not path.exists():
        raise BankError(f"There is no memory bank at {path}; check the path given with --memory.")
    return MemoryBank.open(path or default_bank_path(), seed_from=shipped_bank())


def known_intents(bank: MemoryBank) -> list[LibraryEntry]:
    """The intents that a run may name, without planners: the bank's, those of pedestrians and cyclists, and those that
    the built-in expert composes."""
    from sumo_adv.datatypes import LibraryEntry
    from sumo_adv.episode.memory_access import unprotected_library
    from sumo_adv.search.intents import NEW_INTENTS

    known = [(r.label, r.description, r.applies) for r in bank.intents() if r.status == "active"]
    known += [(e.label, e.description, e.applies) for e in unprotected_library()]
    known += [(label, description, (word,)) for word, (label, description, _) in NEW_INTENTS.items()]
    labels = dict.fromkeys(label for label, _, _ in known)
    return [LibraryEntry(*next(k for k in known if k[0] == label), ()) for label in labels]


def open_for_run(settings: Settings) -> MemoryBank:
    """The bank of a run's settings; made from the shipped bank if it does not exist. Raises BankError."""
    return open_bank(settings.memory, make=True)


def check_intents(variants: Sequence[Mapping[str, Any]], bank: Path) -> None:
    """Check that the intents which settings name are known to the bank, before any episode runs.

    variants: settings as data. A bank that does not exist will be made from the shipped one.
    Raises UsageError with the known intents.
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
    """The sandbox in which planners run."""
    from sumo_adv.planners.sandbox import Sandbox

    return Sandbox(bubblewrap=settings.bubblewrap)


@contextmanager
def open_agents(settings: Settings, sandbox: Sandbox, record: Path | None = None) -> Iterator[Agents]:
    """The agents; every exchange with their models is written to the file ``record``. Raises UsageError."""
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
    """The prompts that come with the program."""
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

    stage: the folder in which the models' answers are recorded; scratch: the folder for generated demand, which the
    episode needs until it is written; played: called when the episode ends, before its processes end. ego: the driver
    where it is a class or an object from Python.

    Raises UsageError or BankError for wrong use, also for ``ask`` without a model. Any other failure is the episode's
    ending.
    """
    settings = _with_request(settings)
    with new_engine() as engine:  # first: it loads its modules while this process loads others
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
    """The settings with the words of ``ask`` checked. Raises UsageError, also where no model can read them."""
    if settings.ask is None:
        return settings
    from sumo_adv.words.request import checked_words, needs_model

    words = checked_words(settings.ask)
    if settings.player("analyzer") is None:
        raise needs_model("An attack asked for in words", words)
    return settings.model_copy(update={"ask": words})


def replay(recorded: RecordedRun) -> Run:
    """Repeat the attempt that a manifest records."""
    from sumo_adv.episode.loop import replay_episode

    with new_sandbox(recorded.settings) as sandbox, new_engine() as engine:
        return replay_episode(
            recorded.run_input, recorded.settings, recorded.task, engine, sandbox, recorded.proposal, recorded.skips
        )


def minimise(recorded: RecordedRun, settings: Settings, tell: Callable[[str, Any], None]) -> Run:
    """Make the attack that a manifest records as mild as the level ``settings.until`` allows. Raises UsageError."""
    from sumo_adv.episode.minimise import minimise_episode

    task = replace(recorded.task, settings=settings)
    with new_sandbox(settings) as sandbox, new_engine() as engine:
        return minimise_episode(
            recorded.run_input, settings, task, engine, sandbox, recorded.proposal, recorded.skips, tell
        )


def check_driver(
    inputs: Sequence[RunInput] | None, settings: Settings, tell: Callable[[Checked], None], seconds: float | None = None
) -> DriverCheck:
    """Drive ``settings.ego`` unattacked through the inputs (default: the twelve of ``driver_check``).

    tell: called with each scenario as soon as it is done. seconds: how long each is driven [s].
    Raises UsageError or SimulationError.
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
    """Compare an input's traffic without an attack with the program ``sumo`` over ``seconds`` [s], and count what was
    read of it. Raises UsageError or SimulationError."""
    from sumo_adv.input_check import WatchWorker, check_input
    from sumo_adv.simulation.engine import Engine
    from sumo_adv.simulation.processes import deferred_interrupts

    with _without_main(), deferred_interrupts():
        engine = Engine(WatchWorker, slots=0)
    with engine, tempfile.TemporaryDirectory(prefix="sumo_adv-") as scratch:
        return check_input(engine, run_input, settings, Path(scratch), seconds)


_idle: list[tuple[WarmEngine, Finalize]] = []  # with what ends it where this process ends before
_of_parents: list[tuple[WarmEngine, Finalize]] = []  # in a fork of a user's process: neither used nor ended


def _leave_to_parent() -> None:
    _of_parents.extend(_idle)
    _idle.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_to_parent)


@contextmanager
def new_engine() -> Iterator[EpisodeEngine]:
    """An engine process that does not run the user's script again, and that no Ctrl-C reaches while it starts. It stays
    for the next run of this process, which so begins a second sooner."""
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
    if _idle:  # that of a run beside this one
        warm.close()
    else:
        _idle.append((warm, Finalize(None, warm.close, exitpriority=1)))


@contextmanager
def _without_main() -> Iterator[None]:
    """Start processes that do not import the main module.

    A spawned process imports the main module unless that has no file. Without that import scripts need no guard
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
    """The functions that a batch's workers need."""
    from sumo_adv.campaigns.results import CampaignParts
    from sumo_adv.report.folder import write_run
    from sumo_adv.report.outcome import MODEL_FILE
    from sumo_adv.report.staging import staged

    return CampaignParts(load, record_contents, open_agents, staged, write_run, MODEL_FILE)


def run_campaign(plan: CampaignPlan, orders: Orders, watcher: CampaignWatcher, *, states: bool = False) -> Summary:
    """Run what is missing of a batch's plan, and write its table; with ``states`` also ``states.parquet``.

    The workers do not run the user's script again. Raises UsageError, BankError or SumoAdvError.
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
    """The processors of the Ray cluster at ``address``. Raises UsageError."""
    from sumo_adv.campaigns.ray_pool import processors_of

    with _without_main():
        return processors_of(address)


def _write_states(folder: Path, names: Sequence[str]) -> None:
    """Write ``states.parquet`` of a batch; packed runs are unpacked for it, one at a time."""
    from sumo_adv.files import sentences
    from sumo_adv.report.read import write_states_parquet

    def runs() -> Iterator[tuple[str, Path]]:
        for name in names:
            there = folder / "runs" / name
            yield from ((name, run) for run in ([there] if there.is_dir() else unpacked(folder, [name])))

    with sentences(folder):
        write_states_parquet(folder / "states.parquet", runs())


def unpacked(folder: Path, names: Iterable[str]) -> Iterator[Path]:
    """Packed runs of a batch, each in a folder that is there until the next one. Raises UsageError or SumoAdvError."""
    from sumo_adv.campaigns.store import unpack_runs
    from sumo_adv.report.staging import staged

    for name in names:
        with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as scratch:
            yield unpack_runs(folder, [name], Path(scratch), staged)[0]


def estimate_rate(
    plan: RatePlan, out: Path, runs: int, workers: int | None, watcher: CampaignWatcher, ray: str | None
) -> RateEstimate | None:
    """Estimate a crash rate in the folder ``out``; None if it was stopped. The workers do not run the user's script
    again. workers: None = one a core; ray: address of a Ray cluster. Raises UsageError or SimulationError."""
    from sumo_adv.rate.estimate import Estimation

    with _without_main():
        return Estimation(plan, out, workers or os.cpu_count() or 1, watcher, ray).run(runs)


def record_contents(path: Path) -> Iterator[tuple[str, str] | str]:
    """For each Waymo record in a file its id and the hash of its content, or a sentence on what is wrong with it.

    Raises UsageError.
    """
    from sumo_adv.womd.reader import read_records

    wrong: list[str] = []
    for record in read_records(path, told=lambda error: wrong.append(str(error))):
        yield from wrong
        wrong.clear()
        yield record.scenario_id, record.content
    yield from wrong


def bench_parts() -> BenchParts:
    """The functions that a benchmark's workers need."""
    from sumo_adv.benchmark.jobs import BenchParts

    return BenchParts(load, open_agents, full_outcome, keep_run, draw_example)


def full_outcome(run: Run) -> dict[str, Any]:
    """Return the content of ``outcome.json`` for a run. Nothing is written."""
    from sumo_adv.report.folder import full_outcome
    from sumo_adv.report.verdicts import findings_on

    best = run.best
    return full_outcome(run, best, None if best is None else findings_on(run, best))


def keep_run(target: Path, run: Run, exchanges: Path | None = None) -> None:
    """Write the whole folder of a run, with the file of a model's ``exchanges``. Raises UsageError."""
    from sumo_adv.report.folder import write_run
    from sumo_adv.report.outcome import MODEL_FILE
    from sumo_adv.report.staging import staged

    with staged(target, force=True, inside=True) as folder:
        write_run(folder, run)
        if exchanges is not None and exchanges.exists():
            shutil.copyfile(exchanges, folder.stage / MODEL_FILE)
        folder.keep(force=True)


def draw_example(target: Path, run: Run) -> None:
    """Draw the encounter without and with the attack, as ``figure`` does. Raises UsageError."""
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
