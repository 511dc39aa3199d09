"""Runs cases one after another in one process: sandbox, engine and imports stay warm."""

from __future__ import annotations

import tempfile
import time
import traceback
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from sumo_adv.campaigns.results import OUTCOME, Done
from sumo_adv.campaigns.worker import share
from sumo_adv.config import Settings, Until, forget_environment, load_settings
from sumo_adv.datatypes import Attempt, Ending, Intent
from sumo_adv.episode.episode import Episode
from sumo_adv.episode.loop import attack_once
from sumo_adv.episode.planned_encounter import seek
from sumo_adv.episode.task import FoundEncounter, Task, make_task
from sumo_adv.episode.warm import WarmEngine, WarmSandboxes
from sumo_adv.errors import SumoAdvError
from sumo_adv.files import is_storage_error
from sumo_adv.metrics.contact import first_other_contact
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.regression.case import Case, read_case
from sumo_adv.regression.measured import Measured
from sumo_adv.report.folder import all_sizes, write_run
from sumo_adv.report.staging import staged
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.tracks import tracks_of

INPUTS = "inputs"  # beside the runs: networks and demand, each content once


@dataclass(frozen=True, slots=True)
class CaseJob:
    """A case to run. ``id``: its name."""

    id: str
    folder: Path


@dataclass(frozen=True, slots=True)
class Setup:
    """What each worker needs. ``runs``: where the folders of the runs go; ``ego``: the driver under test."""

    runs: Path
    ego: str


class CaseRunner:
    """Holds what stays warm; a context manager."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._engine = WarmEngine()
        self._sandboxes = WarmSandboxes()
        forget_environment()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._engine.close()
        self._sandboxes.close()

    def run(self, job: CaseJob, *, last: bool) -> Done:
        """One case, and the folder of its run in its place. A driver that breaks is what the case came to.

        Raises OSError: nothing can be written.
        """
        began = time.perf_counter()
        try:
            measured = self._run(read_case(job.folder))
        except Exception as error:
            if is_storage_error(error):
                raise
            reason = str(error) if isinstance(error, SumoAdvError) else f"{type(error).__name__}: {error}"
            measured = Measured(job.id, self._setup.ego, broken=reason)
            text = traceback.format_exc()
        else:
            text = ""
        return Done(job.id, asdict(replace(measured, seconds=time.perf_counter() - began)), text=text)

    def _run(self, case: Case) -> Measured:
        settings = settings_for(case, self._setup.ego)
        with tempfile.TemporaryDirectory(prefix="sumo_adv-") as scratch:
            task = task_for(case, settings, Path(scratch))
            sandbox = self._sandboxes.of(settings)
            with self._engine.episode() as engine:
                episode, missed = run_case(case, settings, task, engine, sandbox)
            if missed:
                return Measured(case.name, settings.ego, broken=missed, missed=True)
            with staged(self._setup.runs / case.name, force=True, marker=OUTCOME) as folder:
                outcome = write_run(folder, episode, figure=False)
                share(folder.stage / INPUTS, self._setup.runs.parent / INPUTS)
                folder.keep(force=True)
        return measure(case, episode, outcome)


def settings_for(case: Case, ego: str) -> Settings:
    """The settings of a case with another driver. The case's parameters of the ego are those of the driver it was kept
    with. Raises UsageError."""
    source = case.source
    parameters = dict(source.ego_parameters) if ego == source.ego_controller else {}
    options = {"horizon": source.horizon, **case.settings, "ego": ego, "ego_parameters": parameters, "end": source.end}
    members = len(case.proposal.members)
    return load_settings(None, **options, until=Until.COLLISION, attempts=1, adversaries=members, learn="off")


def task_for(case: Case, settings: Settings, scratch: Path) -> Task:
    """What the engine is opened with. Raises UsageError."""
    source = replace(case.source, ego_parameters={})
    task = make_task(source, settings, scratch)
    return replace(task, driven_from=case.ego_driven_from, driven_before=case.ego_before, delay=case.proposal.delay)


def run_case(case: Case, settings: Settings, task: Task, engine: Engine, sandbox: Sandbox) -> tuple[Episode, str]:
    """Drive to the trigger and attack as the case says; and why there was no encounter, or empty.

    Raises SumoAdvError: the driver or the simulation broke.
    """
    p = case.proposal
    episode = Episode(replace(case.source, name=case.name), settings, task)
    episode.intent = Intent(p.bv, p.label, "", "", p.acceleration, "a kept case")
    encounter = seek(episode, engine, lambda *_: None)
    if encounter is None:
        return episode, episode.reason
    why = _elsewhere(case, encounter)
    if why:
        episode.ending, episode.reason, episode.found = Ending.NO_ENCOUNTER, why, None
        return episode, why
    attack_once(episode, engine, sandbox, encounter, p)
    episode.isolation = sandbox.isolation
    return episode, ""


def _elsewhere(case: Case, encounter: FoundEncounter) -> str:
    """Why the encounter is another than the case's, or empty."""
    p, when = case.proposal, f"At the trigger, {encounter.time:g} s,"
    relations = {name: relation for name, relation, _ in encounter.ranking}
    for bv, relation in case.relations.items():
        if relations.get(bv) != relation:
            return f"{when} '{bv}' is {relations.get(bv, 'nowhere near')} and not {relation} to the ego."
    situation = encounter.situations.get(p.delay)
    for bv in p.bvs:
        if situation is None or bv not in situation.targets:
            return f"{p.delay:g} s after the trigger '{bv}' or the ego is gone."
    return ""


def measure(case: Case, episode: Episode, outcome: Mapping[str, Any]) -> Measured:
    """What the attempt of a case came to, from the episode and its ``outcome.json``."""
    best, verdict = episode.best, outcome["outcome"]
    assert best is not None
    cause = verdict["cause"] or {}
    return Measured(
        case.name, episode.settings.ego, level=verdict["level"], collided=verdict["collided"],
        rear_end=verdict["rear_end"], failed_gates=tuple(verdict["failed_gates"]), min_ttc=verdict["min_ttc"],
        delta_v=verdict["delta_v"], severity=verdict["severity"], contact_time=verdict["contact_time"],
        preventable_by=tuple(verdict["preventable_by"] or ()), touched=_touched(episode, best),
        planner=best.message if best.ending == "planner_failed" else "", cause=cause.get("kind"),
        cause_sentence=cause.get("sentence", ""),
    )  # fmt: skip


def _touched(episode: Episode, best: Attempt) -> str | None:
    """Another vehicle or object that the ego ran into before the end of the attempt."""
    encounter, prefix = episode.found, episode.prefix
    assert encounter is not None and prefix is not None
    snapshots = [*prefix.snapshots[-1:], *episode.refinement.results[0].snapshots]
    tracks = {t.id: t for t in tracks_of(snapshots, all_sizes(episode), {}, episode.settings.step_length)}
    ego = tracks.pop(encounter.ego, None)
    tracks.pop(best.proposal.bv, None)
    end = np.inf if best.verdict.contact_time is None else best.verdict.contact_time
    if ego is None:
        return None
    touched = first_other_contact(ego.between(-np.inf, end), list(tracks.values()), encounter.time)
    return None if touched is None else touched[0]
