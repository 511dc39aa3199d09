"""The check of one driver: which scenarios it drives, how often it drives each, and the findings.

``run`` attacks the ego of a scenario, which usually has the right of way. In the check, the driver often drives another
vehicle of the scenario, because it should turn, wait and give way.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from sumo_adv.config import Settings
from sumo_adv.driver_check.drive import CheckWorker, UnattackedDrive
from sumo_adv.driver_check.findings import (
    AnswerTimes,
    DriverFinding,
    FindingKind,
    answer_times,
    find_faults,
    first_separation,
    travelled,
)
from sumo_adv.episode.task import Task, make_task
from sumo_adv.errors import UsageError
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.inputs import RunInput, data_folder, load_input

CHECK_SCENARIOS = (
    ("check/stop_and_go", "ego"),  # follows, stops behind a leader, continues; traffic in the other direction
    ("motorway_cut_in_left", "ego"),  # a motorway with traffic beside it
    ("onramp_cut_in", "ego"),  # passes an on-ramp from which others merge
    ("oncoming_in_bend", "ego"),  # a bend with traffic in the other direction
    ("priority_straight_from_left", "from_north"),  # gives way, then crosses
    ("priority_left_turn_oncoming", "turning"),  # turns left through traffic that has priority
    ("t_junction_left_from_stem", "from_south"),  # turns left from the minor road
    ("t_junction_left_from_stem", "south_second"),  # turns right from the minor road
    ("signals_red_light", "red_south"),  # waits for a light, then continues
    ("signals_left_turn", "turning"),  # turns left at a light through traffic that has green as well
    ("allway_stop_from_right", "ego"),  # all must stop
    ("roundabout_entry", "entering"),  # enters a roundabout and goes half around
)
"""Shipped scenarios, each with the vehicle that the driver drives."""
# From the beginning of a scenario; in that time, SUMO's drivers wait for the light and pass it
DRIVE_DURATION_S = 45.0
# A clock is set forward by 9973 steps, a prime number, so that no plan's length divides it
CLOCK_SHIFT_S = 997.3
REPEATED_DRIVE_TOLERANCE_M = 1e-6  # largest difference between repeated drives
# A drive with another clock may differ more: larger numbers are rounded differently, which can change a decision
SHIFTED_DRIVE_TOLERANCE_M = 1.0


def twelve() -> tuple[RunInput, ...]:
    """Load the twelve inputs of the check. Each is named ``scenario:vehicle``.

    Raises:
        UsageError: Shipped files are missing.
    """
    return tuple(shipped_drive(scenario, vehicle) for scenario, vehicle in CHECK_SCENARIOS)


def shipped_drive(scenario: str, vehicle: str) -> RunInput:
    """Load a shipped scenario with another vehicle as the ego.

    Args:
        scenario: The scenario's path in the folder ``scenarios``, without extension.
        vehicle: The id of the vehicle that the driver drives.

    Raises:
        UsageError: Shipped files are missing.
    """
    run_input = load_input(data_folder("scenarios") / f"{scenario}.toml")
    return replace(run_input, name=f"{run_input.name}:{vehicle}", ego=vehicle)


def by_name(name: str) -> RunInput | None:
    """Load one of the twelve inputs by its name in the table.

    Args:
        name: ``scenario:vehicle``, or the scenario alone if it is in a subfolder of ``scenarios``. Other shipped
            scenarios have inputs of their own under that name.

    Returns:
        The input; None if there is none of that name.

    Raises:
        UsageError: Shipped files are missing.
    """
    for scenario, vehicle in CHECK_SCENARIOS:
        own = Path(scenario).name
        if name == f"{own}:{vehicle}" or (name == own != scenario):
            return shipped_drive(scenario, vehicle)
    return None


@dataclass(frozen=True, slots=True)
class Checked:
    """The check of one scenario.

    Attributes:
        scenario: The input's name.
        seconds: How long the driver drove [s].
        metres: How far the driver drove [m].
        idm_metres: How far SUMO's IDM drove [m].
        findings: The findings.
    """

    scenario: str
    seconds: float
    metres: float
    idm_metres: float
    findings: tuple[DriverFinding, ...]


@dataclass(frozen=True, slots=True)
class DriverCheck:
    """The result of the check of one driver.

    Attributes:
        ego: The driver.
        scenarios: The scenarios that were driven.
        times: How long the driver's answers take; None if SUMO drives.
        stopped: Whether Ctrl-C ended the check before the last scenario.
    """

    ego: str
    scenarios: tuple[Checked, ...]
    times: AnswerTimes | None = field(compare=False)
    stopped: bool = False

    @property
    def kinds(self) -> tuple[FindingKind, ...]:
        """The kinds of the findings in all scenarios, in the order of ``FindingKind``."""
        present = {finding.kind for checked in self.scenarios for finding in checked.findings}
        return tuple(kind for kind in FindingKind if kind in present)


def check_driver(
    engine: Engine[CheckWorker],
    inputs: Sequence[RunInput],
    settings: Settings,
    folder: Path,
    *,
    seconds: float = DRIVE_DURATION_S,
    tell: Callable[[Checked], None] = lambda checked: None,
) -> DriverCheck:
    """Drive ``settings.ego`` unattacked through the inputs.

    Ctrl-C ends the check, which then returns the scenarios that are finished.

    Args:
        engine: The process that drives.
        inputs: The scenarios.
        settings: The settings.
        folder: The folder for generated demand.
        seconds: The duration of each drive [s].
        tell: Called with each scenario as soon as it is finished.

    Raises:
        UsageError: The driver cannot be created, or an input is a recording.
        SimulationError: SUMO does not start, or the driver ended the process.
    """
    checked, drives = list[Checked](), list[UnattackedDrive]()
    try:
        for k, given in enumerate(inputs):
            task = _task(given, settings, folder / str(k), seconds)
            if task.ego is None:
                task = replace(task, ego=engine.call(CheckWorker.choose, task))
            drive, result = _check(engine, task, given.name)
            checked.append(result)
            drives.append(drive)
            tell(result)
    except KeyboardInterrupt:
        return DriverCheck(settings.ego, tuple(checked), answer_times(drives), stopped=True)
    return DriverCheck(settings.ego, tuple(checked), answer_times(drives))


def _task(run_input: RunInput, settings: Settings, folder: Path, seconds: float) -> Task:
    if run_input.playback is not None:
        raise UsageError(f"{run_input.path} plays a recording; the check needs a scenario with traffic of SUMO's.")
    folder.mkdir()
    task = make_task(run_input, settings, folder)
    return replace(task, end=task.spec.recorded_from + seconds)


def _check(engine: Engine[CheckWorker], task: Task, name: str) -> tuple[UnattackedDrive, Checked]:
    idm = engine.call(CheckWorker.drive, replace(task, ego_driver="idm", ego_parameters={}))
    first = engine.call(CheckWorker.drive, task)
    findings = find_faults(first, idm)
    if not first.failure:
        findings += _repeated(engine, task, first)
    seconds = float(first.ego.time[-1] - first.ego.time[0])
    return first, Checked(name, seconds, travelled(first.ego), travelled(idm.ego), tuple(findings))


def _repeated(engine: Engine[CheckWorker], task: Task, first: UnattackedDrive) -> list[DriverFinding]:
    """Drive once more with the same object and another clock. If that differs, find the reason with further drives."""
    later = engine.call(CheckWorker.drive, task, fresh=False, later=CLOCK_SHIFT_S)
    if later.failure:
        words = f"only if its clock is {CLOCK_SHIFT_S:g} s ahead: {later.failure}"
        return [DriverFinding(FindingKind.TIME_BASE, float(later.ego.time[-1]), words)]
    when, far = first_separation(first.ego, later.ego, REPEATED_DRIVE_TOLERANCE_M)
    if math.isinf(when):
        return []
    new = engine.call(CheckWorker.drive, task)
    again = engine.call(CheckWorker.drive, task, fresh=False)
    subjects = (FindingKind.RANDOM, new, "two drives"), (FindingKind.RESET, again, "the drives before and after it")
    for kind, drive, subject in subjects:
        since, most = first_separation(first.ego, drive.ego, REPEATED_DRIVE_TOLERANCE_M)
        if math.isfinite(since):
            return [DriverFinding(kind, since, f"{subject} are {_far(most)} apart")]
    when, far = first_separation(first.ego, later.ego, SHIFTED_DRIVE_TOLERANCE_M)
    words = f"with a clock {CLOCK_SHIFT_S:g} s ahead, {_far(far)} off"
    return [] if math.isinf(when) else [DriverFinding(FindingKind.TIME_BASE, when, words)]


def _far(metres: float) -> str:
    return "in their ends" if math.isinf(metres) else f"up to {metres:.3g} m"
