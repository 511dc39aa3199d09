"""Run the jobs of a bench in one process, in which sandbox, engine and imports stay warm."""

from __future__ import annotations

import tempfile
import threading
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sumo_adv.benchmark.arena import Arena, motion_of, robustness, unattacked
from sumo_adv.benchmark.jobs import BenchJob, BenchSetup, bank_of, cell_path, example_path, method_of, slug
from sumo_adv.benchmark.nouns import RAW, Cell
from sumo_adv.benchmark.rows import make_row
from sumo_adv.campaigns.results import Done
from sumo_adv.config import Settings, forget_environment, load_settings, reachable
from sumo_adv.datatypes import Ending
from sumo_adv.episode.run import Run
from sumo_adv.episode.task import make_task
from sumo_adv.episode.warm import WarmEngine, WarmProcesses, WarmSandboxes
from sumo_adv.errors import BankError, SumoAdvError, UsageError, fault_sentence
from sumo_adv.files import is_storage_error, json_text, scratch_prefix, storage_error, write_text
from sumo_adv.llm.chat import Ledger
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.simulation.inputs import RunInput
from sumo_adv.simulation.processes import check_parent

NOTE_PERIOD_S = 0.5  # time between two notes


def note_of(folder: Path, job: BenchJob, row: str) -> Path:
    """Return the file in which the process of a row notes its wait."""
    return folder / f"{slug(f'{job.ego} {job.case.name} {row}')}.waited"


@contextmanager
def noted(ledger: Ledger, note: Path) -> Iterator[None]:
    """Write to a file how long the ledger's questions have been open [s], as long as the context lasts.

    Args:
        ledger: The ledger.
        note: The file.
    """
    over = threading.Event()

    def write() -> None:
        while not over.wait(NOTE_PERIOD_S):
            if waited := ledger.waited_so_far():
                with suppress(OSError):  # a full disk is reported when results are written
                    write_text(note, repr(waited))

    writer = threading.Thread(target=write, name="waits", daemon=True)
    writer.start()
    try:
        yield
    finally:
        over.set()
        writer.join()


def waited(note: Path) -> float:
    """Read how long a row has waited so far [s]; 0 if nothing is noted."""
    try:
        return float(note.read_text())
    except (OSError, ValueError):
        return 0.0


CELL_SCHEMA = 1


def missing_rows(setup: BenchSetup, job: BenchJob) -> tuple[str, ...]:
    """Return the rows of a job that have no cell."""
    return tuple(r for r in job.rows if not cell_path(setup.folder, job.ego, job.case.name, r).exists())


class Bencher(WarmProcesses):
    """Runs jobs, and holds what stays warm between them; a context manager."""

    def __init__(self, given: tuple[BenchSetup, Path]) -> None:
        """Start the warm processes.

        Args:
            given: The setup, and the folder for temporary files.
        """
        self._setup, self.scratch = given
        super().__init__()
        self._began = time.perf_counter()  # when the current row began
        tempfile.tempdir = str(self.scratch)
        forget_environment()

    def run(self, job: BenchJob, *, last: bool) -> Done:
        """Make the missing cells of a job.

        A row that breaks becomes a failed cell, and the rows after it begin with new processes.

        Args:
            job: The job.
            last: Not used.

        Returns:
            The outcome, without a row.

        Raises:
            SumoAdvError: The library cannot be read, or the results cannot be written.
            EOFError: The table's process has ended.
        """
        left = list(missing_rows(self._setup, job))
        while left:
            self._began = time.perf_counter()
            try:
                self._run(job, left)
            except Exception as error:
                if isinstance(error, OSError) and is_storage_error(error):
                    raise storage_error(error, self._setup.folder) from error
                if isinstance(error, BankError) or is_storage_error(error):
                    raise
                ours = isinstance(error, SumoAdvError)
                sentence = str(error) if ours else f"{fault_sentence(error)}\n{traceback.format_exc()}"
                self.close()
                self._engine, self._sandboxes = WarmEngine(), WarmSandboxes()
                if left:
                    seconds = time.perf_counter() - self._began
                    self._keep(failure(self._setup, job, left.pop(0), sentence, seconds))
        return Done(job.id, None)

    def _keep(self, cell: Cell) -> None:
        check_parent()
        keep_cell(self._setup.folder, cell)

    def _run(self, job: BenchJob, left: list[str]) -> None:
        """Write the cells of the rows in ``left``, and remove each row from the list when it is done."""
        run_input = self._setup.parts.load(job.case.path, job.case.record)
        brought = run_input.settings(("until",))
        settings, common = (self._settings(job, brought, own) for own in (job.settings, {}))
        with (
            tempfile.TemporaryDirectory(prefix=scratch_prefix()) as scratch,
            MemoryBank.open(self._setup.bank, read_only=True) as bank,
        ):
            if job.shift:
                moved = self._shifted(job.shift, run_input, common, bank, Path(scratch))
                settings = settings.model_copy(update={"trigger": moved})
            task = make_task(run_input, settings, Path(scratch))
            with self._engine.episode() as engine:
                arena = Arena(run_input, settings, task, engine, self._sandboxes.of(settings), bank, common)
                while left:
                    self._keep(self._cell(job, left[0], arena, bank, Path(scratch)))
                    left.pop(0)
                    self._began = time.perf_counter()
            if arena.found is None and arena.unattacked.ending is Ending.SIMULATION_FAILED:
                self._engine.close()

    def _settings(self, job: BenchJob, brought: Mapping[str, Any], own: Mapping[str, Any]) -> Settings:
        """Return the settings that the input brings, overridden by the table's and then by a row's ``own``."""
        table = {**brought, **self._setup.settings, **own}
        learn = "off" if job.place is None else "on"
        given = {**table, "ego": job.ego, "seed": job.seed, "learn": learn}
        settings = load_settings(None, **given)
        return settings if reachable(settings) else load_settings(None, **{**given, "until": "valid"})

    def _shifted(
        self, shift: float, run_input: RunInput, common: Settings, bank: MemoryBank, scratch: Path
    ) -> float | None:
        """Return the trigger [s], ``shift`` after that of the other rows; None if these find no encounter.

        If the scenario leaves the trigger open, it is the found time, and the result is not before the begin of the
        simulation.
        """
        if run_input.trigger != "auto":
            return float(run_input.trigger) + shift
        task = make_task(run_input, common, scratch)
        with self._engine.episode() as engine:
            encounter = Arena(run_input, common, task, engine, self._sandboxes.of(common), bank, common).found
        return None if encounter is None else max(task.spec.begin, encounter.time + shift)

    def _cell(self, job: BenchJob, row: str, arena: Arena, bank: MemoryBank, scratch: Path) -> Cell:
        method = method_of(row)
        if method is None:
            return self._filled(job, row, arena.by_opponent(make_row(row), bank), arena)
        if method.name == RAW:
            return self._unattacked(job, row, arena)
        if arena.found is None:
            return self._filled(job, row, arena.unattacked, arena)
        settings = arena.settings
        exchanges = scratch / f"{slug(row)}.jsonl"
        with (
            bank_of(method, job, self._setup, bank, scratch) as own,
            self._setup.parts.open_agents(settings, arena.sandbox, exchanges) as agents,
            noted(agents.ledger, note_of(self.scratch, job, row)),
        ):
            return self._filled(job, row, arena.by_program(own, agents), arena, exchanges)

    def _filled(self, job: BenchJob, row: str, run: Run, arena: Arena, exchanges: Path | None = None) -> Cell:
        """Make the cell of a row that attacked, or could not; ``exchanges`` is the file of a model's exchanges."""
        outcome = self._setup.parts.full_outcome(run)
        kept = ("ending", "reason", "raw", "attempts", "best", "outcome", "realism", "intent", "intents", "timing")
        timing = {k: round(v, 4) for k, v in run.timing.items()}
        intent, recall = outcome["intent"], None
        if intent is not None:
            recall = "generated" if intent.get("source") == "generated" else "hit"  # hit: the bank had the intent
        cell = head(self._setup, job, row) | {k: outcome[k] for k in (*kept, "llm", "agents", "trigger_time")}
        if self._setup.keep_runs and run.best is not None:
            folder = self._setup.folder / "runs" / slug(job.ego) / slug(job.case.name) / slug(row)
            self._setup.parts.keep_run(folder, run, exchanges)
        if job.case.name in self._setup.examples and run.best is not None and run.best.attempts:
            with suppress(UsageError):  # a picture that cannot be drawn does not fail the row
                self._setup.parts.draw_example(example_path(self._setup.folder, job.ego, job.case.name, row), run)
        return cell | {
            "timing": timing, "robust": robustness(run, arena.engine, arena.sandbox),
            "recall": recall, "motion": motion_of(run), "bank_hash": run.bank_hash,
            "encounter": outcome["encounter"],
            "driver_known": None if run.best is None else run.best.found.first.baseline.model.known,
        }  # fmt: skip

    def _unattacked(self, job: BenchJob, row: str, arena: Arena) -> Cell:
        """Make the cell of the unattacked row."""
        run, raw = arena.unattacked, unattacked(arena.unattacked)
        cell = _empty(self._setup, job, row, str(run.ending), run.reason, run.timing)
        if raw is None:
            return cell
        return cell | {"ending": "attempts_exhausted", "reason": "The row raw has no attack.", "outcome": raw}


def head(setup: BenchSetup, job: BenchJob, row: str) -> dict[str, Any]:
    """Return the keys that identify a cell."""
    case = job.case
    return {
        "schema": CELL_SCHEMA, "suite": setup.suite, "case": case.name, "kind": case.kind, "group": case.group,
        "ego": job.ego, "row": row, "seed": job.seed,
    }  # fmt: skip


def _empty(
    setup: BenchSetup, job: BenchJob, row: str, ending: str, why: str, timing: Mapping[str, float]
) -> dict[str, Any]:
    """Make the cell of a row that made no attempt."""
    return head(setup, job, row) | {
        "ending": ending, "reason": why, "raw": None, "attempts": [], "best": None, "outcome": None, "realism": {},
        "intent": None, "recall": None, "motion": {}, "timing": {k: round(v, 4) for k, v in timing.items()}, "llm": {},
    }  # fmt: skip


def failure(setup: BenchSetup, job: BenchJob, row: str, why: str, seconds: float) -> Cell:
    """Make the cell of a row that broke.

    Args:
        setup: The setup.
        job: The job.
        row: The row.
        why: The reason.
        seconds: The time since the previous row was done [s].

    Returns:
        The cell.
    """
    return _empty(setup, job, row, str(Ending.SIMULATION_FAILED), why, {"total": seconds, "row": seconds})


def keep_cell(folder: Path, cell: Cell) -> None:
    """Write a cell, whole or not at all. Raise OSError if that fails."""
    target = cell_path(folder, cell["ego"], cell["case"], cell["row"])
    target.parent.mkdir(parents=True, exist_ok=True)
    write_text(target, json_text(cell))
