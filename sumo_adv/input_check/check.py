"""The check of one input: what was read from it, and whether its traffic moves in this program as it does in SUMO."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from sumo_adv.config import Settings
from sumo_adv.episode.task import make_task
from sumo_adv.input_check.contents import contents_of, departures
from sumo_adv.input_check.motions import MotionComparison, compare_motions
from sumo_adv.input_check.sumo_alone import run_alone
from sumo_adv.input_check.worker import WatchWorker
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.inputs import RunInput
from sumo_adv.simulation.sumocfg import is_sumocfg, read_sumocfg
from sumo_adv.simulation.warnings_log import WarningKind, kinds_of


@dataclass(frozen=True, slots=True)
class InputCheck:
    """The result of the check of an input.

    Attributes:
        source: The input's file.
        contents: The number of elements that were read, by kind.
        notes: What was converted, left out, or is not kept.
        comparison: The comparison with the program ``sumo``; None if there is no simulation to compare with.
        own_step: The comparison with ``sumo`` at the step length of its own configuration; None if that is the step
            length of this program.
        classes: The number of vehicles and persons on foot, by SUMO's class.
        warnings: SUMO's warnings, by kind.
        not_inserted: Vehicles and persons that should have departed but appeared neither in this program nor in SUMO.
    """

    source: Path
    contents: Mapping[str, int]
    notes: tuple[str, ...]
    comparison: MotionComparison | None = None
    own_step: MotionComparison | None = None
    classes: Mapping[str, int] | None = None
    warnings: tuple[WarningKind, ...] = ()
    not_inserted: tuple[str, ...] = ()

    @property
    def same(self) -> bool:
        """Whether the traffic moves as in SUMO, or there is no traffic."""
        return self.comparison is None or self.comparison.same


def check_input(
    engine: Engine[WatchWorker], run_input: RunInput, settings: Settings, folder: Path, seconds: float
) -> InputCheck:
    """Check an input.

    Args:
        engine: The process that runs the simulation.
        run_input: The input.
        settings: The settings.
        folder: The folder for generated files.
        seconds: The time from the first departure that is simulated [s]; less if the input ends earlier.

    Raises:
        UsageError: The input cannot be run, or the program ``sumo`` is not installed.
        SimulationError: SUMO fails.
    """
    read = InputCheck(run_input.path, contents_of(run_input), run_input.notes)
    if run_input.playback is not None or not (run_input.routes or run_input.additional):
        return read
    task = make_task(run_input, settings, folder)
    spec = task.spec
    first, until = spec.recorded_from, min(task.end, spec.recorded_from + seconds)
    engine.log.begin_episode()
    watched = engine.call(WatchWorker.watch, spec, until)
    alone = run_alone(spec, run_input.path, spec.step_length, until, folder)
    own = read_sumocfg(run_input.path).sumo_step if is_sumocfg(run_input.path) else None
    beside = None
    if own is not None and own != spec.step_length:
        slow = run_alone(spec, run_input.path, own, until, folder)
        beside = compare_motions(watched.motions, slow.motions, spec.begin, (first, until), own)
    due = departures(run_input, spec.begin, until)
    here = task.own_names(engine.log.warnings())
    besides = [text for text in task.own_names(alone.warnings) if text not in here]
    return replace(
        read, comparison=compare_motions(watched.motions, alone.motions, spec.begin, (first, until), spec.step_length),
        own_step=beside, classes=watched.classes, warnings=kinds_of([*here, *besides]),
        not_inserted=tuple(sorted(due - watched.motions.keys() - alone.motions.keys())),
    )  # fmt: skip
