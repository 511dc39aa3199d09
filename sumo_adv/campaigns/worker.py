"""Run episodes one after another in one process.

Sandbox, engine and imports stay warm. Nothing else of one episode is left for the next. Lessons are collected, and
written into the bank at the end in the plan's order.
"""

from __future__ import annotations

import json
import math
import os
import tempfile
import time
import traceback
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sumo_adv.campaigns.results import (
    LEARNT_FILE,
    TRACEBACK_FILE,
    Done,
    EpisodeJob,
    Learn,
    Row,
    WorkerSetup,
    keep_failure,
    result_row,
)
from sumo_adv.config import Settings, forget_environment, load_settings
from sumo_adv.datatypes import Ending, Parameter, Planner
from sumo_adv.drivers.registry import trusted_driver
from sumo_adv.episode.clock import PartsClock
from sumo_adv.episode.loop import run_episode
from sumo_adv.episode.run import Run
from sumo_adv.episode.task import make_task
from sumo_adv.episode.warm import WarmProcesses
from sumo_adv.errors import BankError, SumoAdvError, UsageError, fault_sentence
from sumo_adv.files import FULL, StorageError, is_storage_error, scratch_prefix
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.records import (
    Composition,
    Evidence,
    IntentRecord,
    SceneSignature,
    composition_of,
    plain_composition,
)
from sumo_adv.parsing import parse_json
from sumo_adv.simulation.inputs import RunInput, own_simulation
from sumo_adv.simulation.processes import check_parent


@dataclass(frozen=True, slots=True)
class Lesson:
    """Evidence of an episode, with the intent and the planner that it needs; they are None if the bank has them."""

    evidence: Evidence
    intent: IntentRecord | None
    planner: Planner | None


@dataclass(frozen=True, slots=True)
class CompositionLesson:
    """The results of attempts with a composition.

    Attributes:
        composition: The composition.
        attempts: Whether each attempt succeeded.
    """

    composition: Composition
    attempts: tuple[bool, ...]


Lessons = Lesson | CompositionLesson


class Collector(MemoryBank):
    """A bank that only reads. What would be recorded in it is appended to ``lessons``."""

    lessons: list[Lessons]

    def record(self, evidence: Evidence, *, intent: IntentRecord | None = None, planner: Planner | None = None) -> None:
        """Collect evidence; see :class:`MemoryBank`."""
        self.lessons.append(Lesson(evidence, intent, planner))

    def record_composition(self, composition: Composition, attempts: Sequence[bool]) -> bool:
        """Collect attempts with a composition; return whether the bank has it, or would have it now."""
        self.lessons.append(CompositionLesson(composition, tuple(attempts)))
        return any(attempts) or composition.key in self.settings(composition.key)


def as_text(lessons: Iterable[Lessons]) -> str:
    """Format lessons as JSON; an infinite TTC is null."""
    return json.dumps([_plain(lesson) for lesson in lessons], indent=1, ensure_ascii=False, allow_nan=False)


def _plain(lesson: Lessons) -> dict[str, Any]:
    if isinstance(lesson, CompositionLesson):
        return {"composition": plain_composition(lesson.composition), "attempts": lesson.attempts}
    plain = asdict(lesson)
    if plain["evidence"]["min_ttc"] == float("inf"):
        plain["evidence"]["min_ttc"] = None
    return plain


def lessons_of(text: str, what: str) -> list[Lessons]:
    """Read lessons that ``as_text`` wrote.

    Args:
        text: The JSON.
        what: What errors call the text.

    Returns:
        The lessons.

    Raises:
        UsageError: The text is damaged.
    """
    try:
        return [_lesson(entry) for entry in parse_json(text)]
    except (ValueError, LookupError, TypeError, AttributeError, BankError) as error:
        reason = f"{type(error).__name__}: {error}"[:300]
        raise UsageError(f"{what} is damaged ({reason}); delete the run's folder to rerun it.") from error


def _lesson(entry: dict[str, Any]) -> Lessons:
    if "composition" in entry:
        attempts = tuple(entry["attempts"])
        if not all(isinstance(succeeded, bool) for succeeded in attempts):
            raise ValueError("the attempts with a composition must be true or false")
        return CompositionLesson(composition_of(entry["composition"]), attempts)
    intent, planner = entry["intent"], entry["planner"]
    if planner is not None:
        planner = Planner(**{**planner, "parameters": tuple(Parameter(**each) for each in planner["parameters"])})
    if intent is not None:
        intent = IntentRecord(**{**intent, "applies": tuple(intent["applies"])})
    return Lesson(_evidence(entry["evidence"]), intent, planner)


def _evidence(e: dict[str, Any]) -> Evidence:
    acceleration = e["acceleration"]
    knots = tuple((float(t), float(a)) for t, a in acceleration) if isinstance(acceleration, list) else acceleration
    never = e["min_ttc"] is None
    return Evidence(**{
        **e, "scene": SceneSignature(**e["scene"]), "acceleration": knots,
        "min_ttc": float("inf") if never else e["min_ttc"],
    })  # fmt: skip


def teach(bank: MemoryBank, lessons: Iterable[Lessons]) -> int:
    """Write lessons into a bank, in their order. Evidence that the bank has is skipped.

    Evidence is written before compositions. So this function may be interrupted during the evidence and repeated.

    Args:
        bank: The bank.
        lessons: The lessons.

    Returns:
        The number of pieces written.

    Raises:
        BankError: The bank cannot be written.
    """
    held = {_key(e) for e in bank.evidence()}
    written = 0
    later = list[CompositionLesson]()
    for lesson in lessons:
        if not isinstance(lesson, Lesson):
            later.append(lesson)
            continue
        if (key := _key(lesson.evidence)) in held:
            continue
        held.add(key)
        in_bank = lesson.planner is None or any(
            p.hash == lesson.planner.hash for p in bank.planners(lesson.evidence.label)
        )
        bank.record(lesson.evidence, intent=lesson.intent, planner=None if in_bank else lesson.planner)
        written += 1
    for lesson in later:
        written += bank.record_composition(lesson.composition, lesson.attempts)
    return written


def _key(evidence: Evidence) -> str:
    """Return a text that identifies evidence, whenever it was created."""
    return json.dumps({**asdict(evidence), "created": ""}, sort_keys=True)


# -- running


class Runner(WarmProcesses):
    """Runs episodes, and holds what stays warm between them; a context manager."""

    def __init__(self, setup: WorkerSetup) -> None:
        """Start the warm processes; the bank is opened with the first episode."""
        self._setup, self._parts = setup, setup.parts
        super().__init__()
        self._opened: MemoryBank | None = None
        self._stamp = 0
        forget_environment()

    def close(self) -> None:
        """End the warm processes and close the bank."""
        try:
            super().close()
        finally:
            if self._opened is not None:
                self._opened.close()

    def renew(self, setup: WorkerSetup) -> None:
        """Go on with the episodes of another batch."""
        if self._opened is not None:
            self._opened.close()
        self._setup, self._parts, self._opened, self._stamp = setup, setup.parts, None, 0

    def run(self, job: EpisodeJob, *, last: bool) -> Done:
        """Run one episode and put its folder in its place.

        Args:
            job: The episode.
            last: Whether this is the last try. Before that, a failed simulation is not kept.

        Returns:
            The outcome.

        Raises:
            StorageError: The disk is full, or the results may not be written.
            UsageError: The results may not be written.
            BankError: The bank cannot be opened or written.
            EOFError: The campaign's process has ended, so nothing is kept: the scratch folder may be gone by now.
        """
        try:
            return self._run(job, last=last)
        except (StorageError, BankError):
            raise
        except Exception as error:
            if is_storage_error(error):
                raise
            check_parent()
            reason = str(error) if isinstance(error, SumoAdvError) else fault_sentence(error)
            return keep_failure(self._parts.staged, self._setup.runs, job, reason, traceback.format_exc())

    def _run(self, job: EpisodeJob, *, last: bool) -> Done:
        clock = PartsClock()
        with clock.part("input"):
            run_input = self._parts.load(job.input.path, job.input.record)
        settings = self.settings(job, run_input)
        with (
            tempfile.TemporaryDirectory(prefix=scratch_prefix()) as scratch,
            self._parts.staged(self._setup.runs / job.id, force=True, inside=True) as folder,
        ):
            with clock.part("input"):
                task = make_task(run_input, settings, Path(scratch))
            bank = self._bank()
            recorded = folder.stage / self._parts.model_file
            with (
                self._parts.open_agents(settings, self._sandboxes.of(settings), recorded) as agents,
                self._engine.episode() as engine,
            ):
                until = self._setup.until
                within = math.inf if until is None else until - time.time()
                run = run_episode(run_input, settings, task, engine, agents, bank, lambda *_: None, clock, within)
                log = engine.log.said() if run.ending is Ending.SIMULATION_FAILED else ""
            if run.ending is Ending.SIMULATION_FAILED:
                self._engine.close()
                if not last:
                    return Done(job.id, None, again=run.reason, text=run.traceback or log)
            result = self._parts.write_run(folder, run, figure=self._setup.figures)
            row, size = self._finished(job, folder.stage, run, result, bank, log)
            check_parent()
            folder.keep(force=True)
        return Done(job.id, row, size)

    def settings(self, job: EpisodeJob, run_input: RunInput) -> Settings:
        """Combine the settings of an episode: the plan's and, if it does not set them, the input's."""
        ego = trusted_driver(job.ego, run_input.ego_controller, run_input.path)
        return load_settings(None, **{
            **own_simulation(run_input), **run_input.settings(("until",)), **self._setup.variants[job.variant],
            "ego": ego, "seed": job.seed, "memory": self._setup.bank,
            "learn": "off" if self._setup.learn is Learn.OFF else "on",
        })  # fmt: skip

    def _bank(self) -> MemoryBank:
        """Return the bank as this episode sees it."""
        learn = self._setup.learn
        if (stamp := self._setup.bank.stat().st_mtime_ns) != self._stamp and learn is not Learn.DURING:
            if self._opened is not None:  # on a cluster, a newer snapshot may have arrived
                self._opened.close()
                self._opened = None
            self._stamp = stamp
        if self._opened is None:
            kind = Collector if learn is Learn.AFTER else MemoryBank
            self._opened = kind.open(self._setup.bank, read_only=learn is not Learn.DURING)
        elif learn is Learn.DURING:
            self._opened.refresh()
        if isinstance(self._opened, Collector):
            self._opened.lessons = []
        return self._opened

    def _finished(
        self, job: EpisodeJob, stage: Path, run: Run, result: Mapping[str, Any], bank: MemoryBank, log: str
    ) -> tuple[Row, int]:
        """Add the batch's files to a run's folder; return the row, and the folder's bytes without the shared inputs."""
        if isinstance(bank, Collector) and bank.lessons:
            (stage / LEARNT_FILE).write_text(as_text(bank.lessons), encoding="utf-8")
        text = run.traceback or log
        if text:
            (stage / TRACEBACK_FILE).write_text(text, encoding="utf-8")
        size = sum(p.stat().st_size for p in stage.iterdir() if p.is_file())
        share(stage / "inputs", self._setup.runs.parent / "inputs")
        return result_row(job.id, result, bool(text)), size


def share(folder: Path, shared: Path) -> None:
    """Replace files by hard links to equal files in a shared folder. New files are added to the shared folder.

    If the file system has no links, the files stay as they are.

    Args:
        folder: The folder. The names of its files begin with a hash of their content.
        shared: The shared folder.

    Raises:
        OSError: The disk is full.
    """
    try:
        shared.mkdir(exist_ok=True)
        for file in folder.iterdir():
            kept = shared / file.name
            try:
                os.link(file, kept)
            except FileExistsError:
                linked = file.with_name(f".{file.name}")
                os.link(kept, linked)
                linked.replace(file)
    except OSError as error:
        if error.errno in FULL:
            raise
