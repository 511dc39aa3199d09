"""Run cases one after another in one process, in which sandbox, engine and imports stay warm.

Each case is measured, and judged against the expectation of the ego.
"""

from __future__ import annotations

import tempfile
import time
import traceback
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import TypeAdapter

from sumo_adv.campaigns.results import Done
from sumo_adv.campaigns.worker import share
from sumo_adv.config import Settings, Until, forget_environment, load_settings
from sumo_adv.datatypes import Attempt, Level, Track
from sumo_adv.episode.encounter_finder import EncounterFinder
from sumo_adv.episode.engine import EpisodeEngine
from sumo_adv.episode.loop import given_attack
from sumo_adv.episode.run import EncounterRecord, Run
from sumo_adv.episode.task import FoundEncounter, Task, make_task
from sumo_adv.episode.warm import WarmProcesses
from sumo_adv.errors import SumoAdvError
from sumo_adv.files import is_storage_error, scratch_prefix
from sumo_adv.metrics.contact import first_other_contact
from sumo_adv.metrics.severity import NEAR_TOUCH_DELTA_V_M_S, is_near_touch
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.regression.at_trigger import AtTrigger
from sumo_adv.regression.attack import Arrived, attack
from sumo_adv.regression.case import Expectation, KeptCase, read_case
from sumo_adv.report.folder import all_sizes, write_run
from sumo_adv.report.staging import staged
from sumo_adv.simulation.tracks import tracks_of

NO_CONCERN_TTC_S = 4.0  # larger TTCs are no danger to a driver (Minderhoud and Bovy 2001), so they are not compared
TTC_TOLERANCE_S = 0.1  # a step of the simulation; a smaller loss of TTC is not worse
DELTA_V_TOLERANCE_M_S = NEAR_TOUCH_DELTA_V_M_S  # a smaller increase of delta-v is not worse
CONCERN_DISTANCE_M, CONCERN_TTC_S = (
    5.0,
    3.0,
)  # an attack that stays above both was no danger, so it says nothing about the driver
INPUTS = "inputs"  # folder beside the runs with networks and demand, each content once


class CaseResult(StrEnum):
    """How a case ended. Only ``PASS`` passes; those in ``UNTESTED`` say nothing about the ego."""

    PASS = "pass"
    FAIL = "fail"
    NO_ENCOUNTER = "no encounter"  # the ego never reached the trigger's situation
    NOT_REACHED = "not reached"  # the attack, once a collision, no longer comes near the ego
    INVALID = "invalid"  # the adversary would have to move as no car can, or its planner failed
    ERROR = "error"  # the ego's driver or the simulation failed


LevelName = Literal["none", "critical", "collision", "valid", "strict", "serious"]
UNTESTED = (CaseResult.NO_ENCOUNTER, CaseResult.NOT_REACHED, CaseResult.INVALID)


@dataclass(frozen=True, slots=True)
class CaseMeasurements:
    """The measurements of a case.

    The verdict is that of the attempt that counts. A value that never occurs is None.

    Attributes:
        case: The name of the case.
        ego: The driver under test.
        broken: Why nothing was measured; empty if something was.
        missed: Whether nothing was measured because there was no encounter.
        level: The level by the verdict.
        collided: Whether ego and adversary collided.
        rear_end: Whether the adversary ran into the ego's rear.
        failed_gates: The gates that failed.
        min_ttc: The minimum TTC [s].
        delta_v: The ego's delta-v [m/s].
        severity: The severity by the verdict.
        impact_speed: The speed at which a pedestrian, a cyclist or a motorcyclist is hit [m/s].
        fault: The party at fault for the contact: ``ego`` or ``adversary``.
        contact_time: The time of the contact [s].
        preventable_by: The reference drivers that avoid the collision.
        touched: Another vehicle or object that the ego ran into, in any attempt.
        planner: Why the adversary's planner failed; empty if it did not.
        seconds: The time that the case took [s].
        cause: The kind of cause of a contact or near miss.
        cause_sentence: The cause in words.
        arrived: The ego and the adversary when the attack began.
        otherwise: How that differs from the kept case, in words; empty if it does not.
        attempts: The number of attempts.
        near: Whether an attempt came near the ego.
        min_distance: The minimum distance [m].
        progress: How far the ego drove from the start of the attack to the contact or the end [m].
        jerk: The ego's largest jerk in that time [m/s3].
        time_to_end: The duration of that time [s].
    """

    case: str
    ego: str
    broken: str = ""
    missed: bool = False
    level: LevelName = "none"
    collided: bool = False
    rear_end: bool = False
    failed_gates: tuple[str, ...] = ()
    min_ttc: float | None = None
    delta_v: float | None = None
    severity: str | None = None
    impact_speed: float | None = None
    fault: str | None = None
    contact_time: float | None = None
    preventable_by: tuple[str, ...] = ()
    touched: str | None = None
    planner: str = ""
    seconds: float = 0.0
    cause: str | None = None
    cause_sentence: str = ""
    arrived: AtTrigger | None = None
    otherwise: str = ""
    attempts: int = 1
    near: bool = True
    min_distance: float | None = None
    progress: float | None = None
    jerk: float | None = None
    time_to_end: float | None = None

    @property
    def compared_ttc(self) -> float:
        """The minimum TTC, capped at ``NO_CONCERN_TTC_S`` [s]."""
        return NO_CONCERN_TTC_S if self.min_ttc is None else min(self.min_ttc, NO_CONCERN_TTC_S)


@dataclass(frozen=True, slots=True)
class JudgedCase:
    """A case with its result.

    Attributes:
        measured: The measurements.
        result: The result.
        why: The reason, in a sentence.
        before: The same case in the baseline; None without one.
    """

    measured: CaseMeasurements
    result: CaseResult
    why: str
    before: CaseMeasurements | None = None

    @property
    def sentence(self) -> str:
        """The reason and, if the case fails, the cause."""
        cause = self.measured.cause_sentence if self.result is CaseResult.FAIL and self.measured.touched is None else ""
        return " ".join(filter(None, (self.why, cause)))

    def row(self) -> dict[str, Any]:
        """Return the row of the JSON file."""
        return {"result": str(self.result), "why": self.why, **asdict(self.measured)}


def judged(case: KeptCase, measured: CaseMeasurements, before: CaseMeasurements | None) -> JudgedCase:
    """Judge whether a case meets what is expected of the ego.

    Args:
        case: The kept case.
        measured: The measurements.
        before: The measurements in the baseline; None without one.
    """
    m = measured
    if m.missed:
        return JudgedCase(m, CaseResult.NO_ENCOUNTER, m.broken, before)
    if m.broken:
        return JudgedCase(m, CaseResult.ERROR, m.broken, before)
    if m.planner:
        return JudgedCase(m, CaseResult.INVALID, f"The adversary's planner failed: {m.planner}", before)
    if m.touched is not None:
        return JudgedCase(m, CaseResult.FAIL, f"The ego ran into {m.touched}.", before)
    if m.collided and m.failed_gates:
        gates = ", ".join(m.failed_gates)
        return JudgedCase(
            m, CaseResult.INVALID, f"The adversary collides, but no car can drive like that ({gates}).", before
        )
    remark = "The adversary runs into the ego's back, which is not held against the ego." if m.rear_end else ""
    why = _broken_expectation(case.expect, m, before)
    if not why and m.failed_gates and case.expect.of_near_misses:
        gates = ", ".join(m.failed_gates)
        return JudgedCase(m, CaseResult.INVALID, f"No car can drive as the adversary does ({gates}).", before)
    if not why and not m.near and case.level >= Level.COLLISION:
        return JudgedCase(m, CaseResult.NOT_REACHED, _far(m), before)
    return JudgedCase(m, CaseResult.FAIL if why else CaseResult.PASS, why or remark, before)


def _far(m: CaseMeasurements) -> str:
    """Say that an attack did not come near the ego, so that the case tests nothing."""
    arrives = f"The ego arrives {m.otherwise}" if m.otherwise else "The ego arrives as in the kept case"
    tries = f"{m.attempts} attempts" if m.attempts > 1 else "the attack"
    stays = "" if m.min_distance is None else f": it stays {m.min_distance:.0f} m away"
    return f"{arrives}, and {tries} did not come near the ego{stays}."


def _broken_expectation(expect: Expectation, m: CaseMeasurements, before: CaseMeasurements | None) -> str:
    """Say which expectation does not hold; empty if all hold."""
    if expect.level is not None and Level[m.level.upper()] >= expect.level:
        return f"The attack reaches {m.level}{_contact(m)}; it must stay below {expect.avoid}."
    counts = not m.rear_end and not m.failed_gates
    if expect.min_ttc is not None and counts and m.min_ttc is not None and m.min_ttc <= expect.min_ttc:
        return f"The minimum TTC is {m.min_ttc:.2f} s; it must stay above {expect.min_ttc:g} s."
    return _worse(m, before) if expect.no_worse else ""


def _contact(m: CaseMeasurements) -> str:
    """Say in brackets whether a contact is a near-touch, and which party is at fault; empty without a contact."""
    if not m.collided:
        return ""
    near = m.delta_v is not None and is_near_touch(m.delta_v, m.impact_speed)
    words = [*(["a near-touch"] if near else []), *([f"fault: {m.fault}"] if m.fault else [])]
    return f" ({', '.join(words)})" if words else ""


def _worse(measured: CaseMeasurements, before: CaseMeasurements | None) -> str:
    """Say why a case is worse than in the baseline; empty if it is not.

    A baseline that failed, missed the encounter or had an impossible adversary counts as not hit.
    """
    before = before or CaseMeasurements(measured.case, "")
    hit, hit_before = (m.collided and not m.rear_end and not m.failed_gates for m in (measured, before))
    if hit and not hit_before:
        return "The ego is hit, and was not in the baseline."
    if hit:
        harder = (measured.delta_v or 0.0) - (before.delta_v or 0.0)
        return f"The ego is hit {harder:.1f} m/s harder than in the baseline." if harder > DELTA_V_TOLERANCE_M_S else ""
    if before.broken or hit_before or measured.rear_end or measured.failed_gates:
        return ""
    lost = before.compared_ttc - measured.compared_ttc
    return f"The minimum TTC is {lost:.2f} s lower than in the baseline." if lost > TTC_TOLERANCE_S else ""


MEASURED = TypeAdapter(CaseMeasurements)


def measured_of(row: Mapping[str, Any]) -> CaseMeasurements:
    """Return a measurement from a row of the JSON file; other keys are ignored.

    Args:
        row: The row.

    Raises:
        ValidationError: The row has a wrong value.
    """
    return MEASURED.validate_python(row)


@dataclass(frozen=True, slots=True)
class CaseJob:
    """A case to run.

    Attributes:
        id: The name of the case.
        folder: Its folder.
    """

    id: str
    folder: Path


@dataclass(frozen=True, slots=True)
class SuiteSetup:
    """What each worker needs.

    Attributes:
        runs: The folder for the folders of the runs.
        ego: The driver under test.
        attempts: The maximum number of attempts of a case.
    """

    runs: Path
    ego: str
    attempts: int = 1


class CaseRunner(WarmProcesses):
    """Runs cases with warm processes. Use it in a ``with`` statement."""

    def __init__(self, setup: SuiteSetup) -> None:
        """Start without processes.

        Args:
            setup: What each worker needs.
        """
        self._setup = setup
        super().__init__()
        forget_environment()

    def run(self, job: CaseJob, *, last: bool) -> Done:
        """Run one case, and write the folder of its run. A driver that fails is a result of the case.

        Args:
            job: The case.
            last: Ignored.

        Raises:
            OSError: The folder cannot be written.
        """
        began = time.perf_counter()
        text = ""
        try:
            measured = self._run(read_case(job.folder))
        except Exception as error:
            if is_storage_error(error):
                raise
            reason = str(error) if isinstance(error, SumoAdvError) else f"{type(error).__name__}: {error}"
            measured = CaseMeasurements(job.id, self._setup.ego, broken=reason)
            text = traceback.format_exc()
        return Done(job.id, asdict(replace(measured, seconds=time.perf_counter() - began)), text=text)

    def _run(self, case: KeptCase) -> CaseMeasurements:
        """Run a case, write its folder and measure it."""
        settings = settings_for(case, self._setup.ego)
        with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as scratch:
            task = task_for(case, settings, Path(scratch))
            sandbox = self._sandboxes.of(settings)
            with self._engine.episode() as engine:
                came = run_case(case, settings, task, engine, sandbox, self._setup.attempts)
            if isinstance(came, str):
                return CaseMeasurements(case.name, settings.ego, broken=came, missed=True)
            run, arrived = came
            with staged(self._setup.runs / case.name, force=True, inside=True) as folder:
                outcome = write_run(folder, run, figure=False)
                share(folder.stage / INPUTS, self._setup.runs.parent / INPUTS)
                folder.keep(force=True)
        return measure(case, run, arrived, outcome)


def settings_for(case: KeptCase, ego: str) -> Settings:
    """Return the settings of a case with another driver.

    The case's parameters of the ego apply only to the driver that it was kept with.

    Args:
        case: The kept case.
        ego: The driver under test.

    Raises:
        UsageError: A setting is wrong.
    """
    run_input = case.run_input
    parameters = dict(run_input.ego_parameters) if ego == run_input.ego_controller else {}
    options = {
        "horizon": run_input.horizon,
        **case.settings,
        "ego": ego,
        "ego_parameters": parameters,
        "end": run_input.end,
    }
    members = len(case.proposal.members)
    return load_settings(None, **options, until=Until.COLLISION, attempts=1, adversaries=members, learn="off")


def task_for(case: KeptCase, settings: Settings, scratch: Path) -> Task:
    """Return the task that the engine is opened with.

    Args:
        case: The kept case.
        settings: The settings of the run.
        scratch: A folder for temporary files.

    Raises:
        UsageError: The input is wrong.
    """
    run_input = replace(case.run_input, ego_parameters={})
    task = make_task(run_input, settings, scratch)
    return replace(task, driven_from=case.ego_driven_from, driven_before=case.ego_before, delay=case.proposal.delay)


def run_case(
    case: KeptCase, settings: Settings, task: Task, engine: EpisodeEngine, sandbox: Sandbox, attempts: int
) -> tuple[Run, Arrived] | str:
    """Drive to the trigger, and attack as the case says.

    Args:
        case: The kept case.
        settings: The settings of the run.
        task: The task of the engine.
        engine: Simulates the encounter and the attempts.
        sandbox: Runs planners.
        attempts: The maximum number of attempts.

    Returns:
        The run and how the ego arrived, or a sentence that says why there was no encounter.

    Raises:
        SumoAdvError: The driver or the simulation failed.
    """
    run_input = replace(case.run_input, name=case.name)
    finder = EncounterFinder(run_input, settings, task, engine, lambda *_: None)
    record = finder.seek()
    if record is None:
        return "" if finder.stop is None else finder.stop.reason
    if why := elsewhere(case, record.found):
        return why
    done, arrived = attack(case, settings, engine, sandbox, record.found, attempts)
    finder.keep(given_attack(done.recorded(record), case.proposal, "a kept case"))
    return finder.run(isolation=sandbox.isolation), arrived


def elsewhere(case: KeptCase, encounter: FoundEncounter) -> str:
    """Say why an encounter is not the one of the case.

    Args:
        case: The kept case.
        encounter: The encounter.

    Returns:
        The reason; empty if it is the same encounter.
    """
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


def measure(case: KeptCase, run: Run, arrived: Arrived, outcome: Mapping[str, Any]) -> CaseMeasurements:
    """Return the measurements of a case, from the attempt that counts.

    Args:
        case: The kept case.
        run: The run.
        arrived: How the ego arrived.
        outcome: The content of ``outcome.json``.
    """
    verdict, record = outcome["outcome"], run.best
    best = None if record is None else record.best
    assert record is not None and best is not None
    crashed = next((attempt for attempt in record.attempts if attempt.ending == "crashed"), None)
    if crashed is not None:
        return CaseMeasurements(case.name, run.settings.ego, broken=crashed.message)
    cause = verdict["cause"] or {}
    step = run.settings.step_length
    ego = _tracks(record, best, step).get(record.found.ego)
    drive = _Drive() if ego is None else _drive(ego, best)
    touched = (_touched(record, attempt, step) for attempt in record.attempts)
    return CaseMeasurements(
        case.name, run.settings.ego, level=verdict["level"], collided=verdict["collided"],
        rear_end=verdict["rear_end"], failed_gates=tuple(verdict["failed_gates"]), min_ttc=verdict["min_ttc"],
        delta_v=verdict["delta_v"], severity=verdict["severity"], impact_speed=verdict["impact_speed"],
        fault=verdict["fault"], contact_time=verdict["contact_time"],
        preventable_by=tuple(verdict["preventable_by"] or ()),
        touched=next(filter(None, touched), None),
        planner=best.message if best.ending == "planner_failed" else "", cause=cause.get("kind"),
        cause_sentence=cause.get("sentence", ""), arrived=arrived.situation, otherwise=arrived.otherwise,
        attempts=len(record.attempts), near=any(map(_near, record.attempts)), min_distance=verdict["min_distance"],
        progress=drive.progress, jerk=drive.jerk, time_to_end=drive.time_to_end,
    )  # fmt: skip


def _near(attempt: Attempt) -> bool:
    """Return whether an attempt was a danger to the ego."""
    v = attempt.verdict
    return v.collided or v.min_distance <= CONCERN_DISTANCE_M or v.min_ttc <= CONCERN_TTC_S


def _tracks(record: EncounterRecord, attempt: Attempt, step: float) -> dict[str, Track]:
    """Return the motions in an attempt, by id, from the trigger to the contact or the end."""
    assert record.prefix is not None
    snapshots = [*record.prefix.snapshots[-1:], *record.results[attempt.index].snapshots]
    end = np.inf if attempt.verdict.contact_time is None else attempt.verdict.contact_time
    tracks = tracks_of(snapshots, all_sizes(record), {}, step)
    return {t.id: t.between(-np.inf, end) for t in tracks}


class _Drive(NamedTuple):
    """How the ego drove from the start of the attack on [m, m/s3, s]; None if it was gone at once."""

    progress: float | None = None
    jerk: float | None = None
    time_to_end: float | None = None


def _drive(ego: Track, best: Attempt) -> _Drive:
    """Measure how the ego drove in the attempt that counts, so that a driver that creeps or jerks shows."""
    t = ego.between(best.trigger_time, np.inf)
    if len(t.time) < 2:
        return _Drive()
    progress = float(np.hypot(np.diff(t.x), np.diff(t.y)).sum())
    jerk = float(np.abs(np.diff(t.acceleration) / np.diff(t.time)).max())
    return _Drive(round(progress, 2), round(jerk, 2), round(float(t.time[-1] - t.time[0]), 2))


def _touched(record: EncounterRecord, attempt: Attempt, step: float) -> str | None:
    """Return another vehicle or object that the ego ran into before the end of an attempt."""
    tracks = _tracks(record, attempt, step)
    ego = tracks.pop(record.found.ego, None)
    others = [track for name, track in tracks.items() if name != attempt.proposal.bv]
    touched = None if ego is None else first_other_contact(ego, others, record.found.time)
    return None if touched is None else touched[0]
