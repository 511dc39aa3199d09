"""Find encounters and run attempts in the engine process of an episode.

The worker has no model, no sandbox and no bank.

The baseline and all attempts branch off at the trigger. If the system, the settings and the ego's driver allow it, a
branch is a fork, which is bit-identical and takes milliseconds. Otherwise, the branch runs in place. The simulation is
then loaded again, and the same commands are repeated up to the trigger.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy.ma  # noqa: F401 - np.unique imports it, which would take each fork 10 ms

from sumo_adv.datatypes import Boxes, Ending, LaneStrip, Preventability, Proposal
from sumo_adv.drivers.tested import make_tested_ego
from sumo_adv.drivers.timing import DriverTime, TimedEgo
from sumo_adv.episode.attempt import Driven
from sumo_adv.episode.drive import Drive, ego_type_file
from sumo_adv.episode.encounter_builder import (
    ENDANGERS,
    MIN_EGO_STAY_S,
    UnattackedMotion,
    build_encounter,
    nearest_ones,
)
from sumo_adv.episode.encounter_detector import COOL_DOWN_S, LOOK_INTERVAL_S, RankedVehicle
from sumo_adv.episode.encounter_search import EncounterSearch
from sumo_adv.episode.engine import Director, EpisodeCalls, PlannerQuestion
from sumo_adv.episode.open_encounter import OpenEncounter
from sumo_adv.episode.references import manoeuvre_plan
from sumo_adv.episode.task import AttemptResult, FoundEncounter, NoEncounter, Prefix, Task
from sumo_adv.episode.verdict import own_reference
from sumo_adv.errors import DriverError, ran_out_of_memory
from sumo_adv.files import scratch_prefix
from sumo_adv.metrics.preventability import AVOIDS, COLLIDES, preventability
from sumo_adv.metrics.reference import COMPETENT, MANOEUVRE, REFERENCE_DRIVERS
from sumo_adv.planners.answers import AskOne, PlannerObservation
from sumo_adv.planners.sessions import ask_trusted
from sumo_adv.simulation.engine_log import aside
from sumo_adv.simulation.forks import can_fork, in_forks
from sumo_adv.simulation.network import RoadMap, read_network
from sumo_adv.simulation.playback import Playback
from sumo_adv.simulation.playback_rehearsal import put_unplayable_beside
from sumo_adv.simulation.scan import silent_copies
from sumo_adv.simulation.signals import LightsNear
from sumo_adv.simulation.sumo_states import Snapshot
from sumo_adv.simulation.tracks import tracks_of


@dataclass(frozen=True, slots=True)
class UnattackedBranch:
    """What a branch without an attack recorded.

    Attributes:
        snapshots: The states from the trigger on.
        sizes: Length and width of the vehicles by id [m].
        looks: The vehicles that could attack, by time after the trigger [s], every ``LOOK_INTERVAL_S``; empty if
            nothing is played back, or if the trigger is given.
    """

    snapshots: list[Snapshot]
    sizes: dict[str, tuple[float, float]]
    looks: dict[float, list[RankedVehicle]]


class EpisodeWorker(EpisodeCalls):
    """Holds the simulation of one episode. ``EpisodeCalls`` documents the methods."""

    def __init__(self, slots: Sequence[Connection]) -> None:
        """Start without a simulation.

        Args:
            slots: Connections to the front, one for each attempt that may run at the same time.
        """
        self._slots = slots
        self._folder: tempfile.TemporaryDirectory[str]
        self._road: RoadMap
        self._passed: list[str] = []
        self._encounter: OpenEncounter
        self._timed: TimedEgo | None = None  # times the answers of the ego's driver
        self._unattacked_seconds = 0.0
        self._moved = False  # whether a branch ran in place, so that the simulation must be loaded again

    # -- commands -----------------------------------------------------------------------------------------------

    def open(self, task: Task) -> None:
        self._task = task
        self._settings = task.settings
        controller, self._timed = make_tested_ego(task.ego_driver, task.ego_parameters, task.settings, task.ego_given)
        self._road = read_network(task.spec.network)
        self._folder = tempfile.TemporaryDirectory(prefix=scratch_prefix())
        folder = Path(self._folder.name)
        given = task.spec
        files = (given.network, *given.routes, *given.additional)
        network, *silent = silent_copies(files, folder)  # files from run folders of others may name outputs
        routes, additional = silent[: len(given.routes)], silent[len(given.routes) :]
        additional.append(ego_type_file(controller, folder, silent))
        spec = replace(given, network=network, routes=tuple(routes), additional=tuple(additional))
        self._drive = Drive(
            spec, controller, task.settings.seed, playback=self._playback(task), deadline=task.settings.ego_deadline
        )
        lights = LightsNear(self._road)
        self._drive.lights = lights if len(lights) else None
        self._forks = task.settings.fork and can_fork() and controller.forkable
        self._put_beside_what_sumo_crashes_on()
        self._search = EncounterSearch(self._drive, self._road, task)

    def _playback(self, task: Task) -> Playback | None:
        if task.playback is None:
            return None
        ego = task.ego if isinstance(task.ego, str) else None
        return Playback(
            task.playback, self._road, begin=task.spec.begin, step=task.spec.step_length, ego=ego, warm_up=task.warm_up
        )

    def _put_beside_what_sumo_crashes_on(self) -> None:
        """Rehearse a recording in forks, and play back as boxes the vehicles on which SUMO crashes."""
        drive = self._drive
        if drive.playback is None or not drive.recorded() or not (self._settings.fork and can_fork()):
            return
        if put_unplayable_beside(drive.playback, self._task.ego, self._rehearse):
            with aside():
                drive.rewind(0)

    def _rehearse(self, end: float) -> None:
        self._drive.rewind(0)
        while self._drive.now < end:
            self._drive.tick()

    def forks(self) -> bool:
        return self._forks

    def driver_time(self) -> DriverTime | None:
        return None if self._timed is None else self._timed.time

    def seek(self, passed_over: str = "", within: float = math.inf) -> FoundEncounter | NoEncounter:
        passed, ends_at = self._passed, time.perf_counter() + within
        if passed_over:
            passed.append(f"{self._encounter.found.time:.1f} s ({passed_over})")
            self._at_trigger()
            self._search.leave([name for name, _, _ in self._encounter.found.ranking])
            self._cool_down()
        while True:
            ranking = self._search.until_encounter(ends_at)
            if isinstance(ranking, NoEncounter):
                if passed:
                    return NoEncounter(ranking.ending, f"{ranking.reason} Passed over: {'; '.join(passed)}.")
                return ranking
            why = self._survey(ranking)
            if not why:
                return self._encounter.found
            passed.append(f"{self._drive.now:.1f} s ({why})")
            if self._search.nearly_over():  # the rest of the recording was examined as a whole
                return NoEncounter(Ending.NO_ENCOUNTER, f"In the rest of the recording {why}. Try another --ego-id.")
            if self._task.trigger is not None:
                near = nearest_ones(self._drive) if why.endswith(ENDANGERS) else ""
                return NoEncounter(Ending.NO_ENCOUNTER, f"At the trigger given, {self._task.trigger:g} s, {why}{near}.")
            self._cool_down()

    def _cool_down(self) -> None:
        for _ in range(self._drive.within(self._settings.steps(COOL_DOWN_S))):
            self._drive.tick()

    def unattacked_seconds(self) -> float:
        return self._unattacked_seconds

    def prefix(self) -> Prefix:
        self._at_trigger()
        return Prefix(self._drive.recording.snapshots[: self._trigger_step], dict(self._drive.simulation.fleet.sizes))

    def lanes(self, x: float, y: float, radius: float) -> list[LaneStrip]:
        return self._road.strips(x, y, radius)

    def attempts(self, plans: Sequence[Proposal]) -> list[AttemptResult]:
        results: list[AttemptResult] = []
        for first in range(0, len(plans), len(self._slots)):
            batch = list(enumerate(plans))[first : first + len(self._slots)]
            works = [self._work(k, p, slot) for (k, p), slot in zip(batch, self._slots, strict=False)]
            results += self._branch(works, self._crashed)
        return results

    def _crashed(self, why: str) -> AttemptResult:
        return AttemptResult(Driven("crashed", why), None, self._encounter.found.time)

    def references(
        self, proposal: Proposal, result: AttemptResult, known: Mapping[str, str], all_drivers: bool
    ) -> Preventability | None:
        self._at_trigger()
        verdict, case = result.verdict, self._encounter.case(proposal, result)
        if case is None or verdict is None or verdict.contact_time is None or not verdict.counts:
            return None
        kinematic = preventability(case, verdict.contact_time, driver=own_reference(self._drive))
        avoiding = [name for name in REFERENCE_DRIVERS if kinematic.answers.get(name) == AVOIDS]
        first = [name for name in avoiding if name == "cc_human"]
        others = [name for name in avoiding if name in COMPETENT and name not in first]
        in_loop = dict(known)
        for wanted in (avoiding,) if all_drivers else (first, others):
            names = [name for name in wanted if name not in in_loop]
            if not names or (AVOIDS in in_loop.values() and not all_drivers):
                continue
            plan = manoeuvre_plan(case, verdict.contact_time) if MANOEUVRE in names else None
            asked = [name for name in names if name != MANOEUVRE or plan is not None]
            answers = self._in_loop(proposal, asked, plan, case.lane_half_width)
            in_loop |= dict.fromkeys(names, COLLIDES) | answers
        return replace(kinematic, in_loop={name: in_loop[name] for name in REFERENCE_DRIVERS if name in in_loop})

    def _in_loop(self, proposal: Proposal, names: Sequence[str], plan: Boxes | None, half: float) -> dict[str, str]:
        """Return by driver ``AVOIDS`` or ``COLLIDES``, as it drives in the loop.

        A driver with which SUMO dies or the tested driver fails shows no way out, so it counts as ``COLLIDES``.
        """
        answers: dict[str, str] = {}
        for first in range(0, len(names), len(self._slots)):
            batch = names[first : first + len(self._slots)]
            works = [
                partial(
                    self._avoids, proposal, self._asks(REFERENCE_DRIVERS.index(name), proposal, slot), name,
                    plan if name == MANOEUVRE else None, half,
                )
                for name, slot in zip(batch, self._slots, strict=False)
            ]  # fmt: skip
            avoid = self._branch(works, lambda why: False)
            answers |= {name: AVOIDS if good else COLLIDES for name, good in zip(batch, avoid, strict=True)}
        return answers

    def _avoids(
        self, proposal: Proposal, asks: Sequence[AskOne], name: str, plan: Boxes | None, half: float
    ) -> bool:  # fmt: skip
        """Return whether a reference driver avoids the collision; not if the driver fails or uses up the memory."""
        try:
            with self._within_memory():
                return self._encounter.avoids(proposal, asks, name, plan, half)
        except DriverError:
            return False

    def directed_attempt(self, prepare: Director) -> None:
        dialogue, questions = self._slots[:2]

        def ask_front(observation: PlannerObservation) -> Any:
            questions.send(observation)
            return questions.recv()

        work = prepare(self._encounter, dialogue, ask_front)
        if self._forks:
            in_forks([work], memory=self._settings.attempt_memory)  # the front's messages cannot be repeated
        else:
            self._branch([work])

    # -- branching ----------------------------------------------------------------------------------------------

    def _branch(self, works: Sequence[Callable[[], Any]], lost: Callable[[str], Any] | None = None) -> list[Any]:
        """Do each piece of work from the trigger on, in forks if possible, and return the results.

        ``lost`` makes the result of a fork that died (``in_forks``).
        """
        if self._forks:
            forgone = None if lost is None else partial(_lost_in_no_time, lost)
            timed = in_forks(
                [self._in_own_time(w) for w in works], self._reloaded, forgone, self._settings.attempt_memory
            )
            for _, spent in timed:
                if self._timed is not None:
                    self._timed.add(spent)
            return [value for value, _ in timed]
        results = []
        for work in works:
            self._at_trigger()
            self._moved = True
            with aside():
                results.append(work())
        self._at_trigger()
        return results

    def _in_own_time(self, work: Callable[[], Any]) -> Callable[[], tuple[Any, DriverTime]]:
        """Make a fork's work also return the time that the driver's answers took in the fork."""

        def timed() -> tuple[Any, DriverTime]:
            if self._timed is None:
                return work(), DriverTime()
            self._timed.start_over()
            return work(), self._timed.time

        return timed

    def _reloaded(self, work: Callable[[], Any]) -> Callable[[], Any]:
        """Make a piece of work load the simulation again first, because SUMO may have crashed in a fork."""

        def again() -> Any:
            self._drive.rewind(self._trigger_step)
            return work()

        return again

    def _at_trigger(self) -> None:
        """Load the simulation again up to the trigger if a branch ran in place."""
        if self._moved:
            self._moved = False
            with aside():
                self._drive.rewind(self._trigger_step)

    # -- the baseline -------------------------------------------------------------------------------------------

    def _survey(self, ranking: Sequence[RankedVehicle]) -> str:
        """Simulate on without an attack, and describe the encounter; return why it is passed over, or an empty text."""
        self._trigger_step, self._drive.until = len(self._drive.recording.snapshots), math.inf
        given = self._task.delay is not None  # the verdict on a given attack judges later danger
        built = build_encounter(
            self._drive, self._road, self._settings, ranking, self._baseline, passed_over=self._passed,
            checked=MIN_EGO_STAY_S + self._settings.step_length if given else math.inf, delay=self._task.delay,
        )  # fmt: skip
        if isinstance(built, str):
            return built
        encounter, baseline = built
        drive = self._drive
        found = replace(
            encounter, driven_from=drive.driven_from, driven_before=drive.driven_before,
            last=self._search.nearly_over(), beside=() if drive.playback is None else drive.playback.beside,
            sight=None if drive.way is None else drive.way.limits(drive),
        )  # fmt: skip
        self._encounter = OpenEncounter(
            drive, found, self._settings, self._road, self._trigger_step, baseline.tracks[found.ego]
        )
        return ""

    def _baseline(self, seconds: float) -> UnattackedMotion:
        drive, settings = self._drive, self._settings
        before = drive.recording.snapshots[-settings.steps(settings.history) - 1 :]
        began = time.perf_counter()
        branch: UnattackedBranch = self._branch([partial(self._unattacked, settings.steps(seconds))])[0]
        self._unattacked_seconds += time.perf_counter() - began
        tracks = tracks_of([*before, *branch.snapshots], branch.sizes, drive.roles(), settings.step_length)
        return UnattackedMotion({t.id: t for t in tracks}, branch.snapshots, branch.sizes, branch.looks)

    def _unattacked(self, steps: int) -> UnattackedBranch:
        """Simulate on without an attack.

        In a recording, the branch ends when the ego leaves, because nothing can be attacked after that.
        """
        drive, settings, looks = self._drive, self._settings, dict[float, list[RankedVehicle]]()
        detector, every = self._search.watch(), settings.steps(LOOK_INTERVAL_S)
        with self._within_memory():
            for step in range(drive.within(steps)):
                if drive.recorded() and drive.ego not in drive.snapshot.raw:
                    break
                if drive.recorded() and self._task.trigger is None and step % every == 0:
                    looks[round(step * settings.step_length, 6)] = detector.rank(drive)
                drive.tick()
        snapshots = drive.recording.snapshots[self._trigger_step :]
        return UnattackedBranch(snapshots, dict(drive.simulation.fleet.sizes), looks)

    @contextmanager
    def _within_memory(self) -> Iterator[None]:
        """Raise DriverError if a fork has used up its memory."""
        try:
            yield
        except Exception as error:
            if not (self._forks and self._settings.attempt_memory and ran_out_of_memory(error)):
                raise
            raise DriverError(
                f"The memory of an attempt, {self._settings.attempt_memory:g} MiB, was used up with the ego's driver "
                f"{self._drive.controller.name!r} in {self._drive.where()}: look for a leak in it, or raise the "
                "setting attempt_memory."
            ) from error

    # -- attempts -----------------------------------------------------------------------------------------------

    def _work(self, index: int, proposal: Proposal, slot: Connection) -> Callable[[], AttemptResult]:
        return partial(self._try, proposal, self._asks(index, proposal, slot))

    def _asks(self, index: int, proposal: Proposal, slot: Connection) -> list[AskOne]:
        """Return what asks the planners of a proposal's adversaries.

        Call it before the fork, because a planner's source is read only once.
        """
        situation = self._encounter.situation_for(proposal)

        def ask_front(member: int, observation: PlannerObservation) -> Any:
            slot.send(PlannerQuestion(index, member, observation))
            return slot.recv()

        return [ask_trusted(p, situation, partial(ask_front, member)) for member, p in enumerate(proposal.members)]

    def _try(self, proposal: Proposal, asks: Sequence[AskOne]) -> AttemptResult:
        """Run an attempt; it counts as crashed if the ego's driver fails or uses up the memory."""
        try:
            with self._within_memory():
                return self._encounter.attempt(proposal, asks)
        except DriverError as error:
            return self._crashed(str(error))


def _lost_in_no_time(lost: Callable[[str], Any], why: str) -> tuple[Any, DriverTime]:
    """Make the result of a fork that died; the time of its driver is unknown and counts as zero."""
    return lost(why), DriverTime()
