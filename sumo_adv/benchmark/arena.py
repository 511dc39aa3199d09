"""Open one encounter of a suite once, and attack it with one row after another.

All rows have the same trigger, unattacked run, budget and stop rule, and the same choice of the attempt that counts. If
a scenario leaves the trigger open, the shipped library chooses it.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from random import Random
from typing import Any

import numpy as np

from sumo_adv.agents.agents import Agents
from sumo_adv.benchmark.nouns import Encounter, Opponent
from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, Ending, Level, Proposal, Role, Track
from sumo_adv.episode.assessment import AttemptRunner, attempt_of, checked, runner_of
from sumo_adv.episode.attempt import Driven
from sumo_adv.episode.encounter_finder import EncounterFinder
from sumo_adv.episode.engine import EpisodeCalls, EpisodeEngine
from sumo_adv.episode.loop import decide, model_ending, pursue
from sumo_adv.episode.memory_access import read_library, signature
from sumo_adv.episode.neighbours import Robustness, holds, neighbours
from sumo_adv.episode.prepared_encounter import prepare
from sumo_adv.episode.refinement import Refinement, settle_best
from sumo_adv.episode.run import EncounterRecord, Run, Stop, seconds_by_part
from sumo_adv.episode.task import AttemptResult, FoundEncounter, Task
from sumo_adv.errors import ModelError, SandboxError, SimulationError, SumoAdvError
from sumo_adv.goal import Goal
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.metrics.boxes import on_grid
from sumo_adv.metrics.criticality import ttc
from sumo_adv.metrics.further import PAPER_EPSILON_M
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.simulation.inputs import RunInput
from sumo_adv.simulation.tracks import tracks_of


class Arena:
    """An open encounter, which one row after another attacks.

    Attributes:
        settings: The settings of this bench's attacking rows.
        unattacked: The run without an attack, as far as it goes; its ``best`` is None if there is no encounter.
    """

    def __init__(
        self, run_input: RunInput, settings: Settings, task: Task, engine: EpisodeEngine, sandbox: Sandbox,
        bank: MemoryBank, common: Settings,
    ) -> None:  # fmt: skip
        """Open the encounter.

        Args:
            run_input: The input.
            settings: The settings of the rows that attack.
            task: The task.
            engine: The simulation.
            sandbox: Runs planners.
            bank: The memory bank.
            common: The settings of all rows. They choose the encounter if the trigger is open.

        Raises:
            SumoAdvError: The input or a setting is wrong. A failed simulation is recorded in ``unattacked`` instead.
        """
        self.engine, self.sandbox, self.settings = engine, sandbox, settings
        finder, began = EncounterFinder(run_input, common, task, engine, lambda *_: None), time.perf_counter()
        try:
            if task.trigger is not None:
                finder.seek()
            else:
                finder.find_attackable(sandbox, bank)
        except SumoAdvError as error:
            if error.exit_status == 2:
                raise
            finder.break_off(Stop(Ending.SIMULATION_FAILED, str(error), failed=True))
        opened = time.perf_counter() - began
        self._started = {**finder.clock.seconds, "opened": opened}
        records = [record for record in finder.records if record.passed_over or finder.stop is None]
        spent = seconds_by_part(self._started, *(record.timing for record in records))
        self.unattacked = replace(
            finder.run(bank_hash=bank.content_hash()), settings=settings,
            records=tuple(replace(record, goal=settings.goal) for record in records),
            timing={**spent, "total": opened},
        )  # fmt: skip

    @property
    def found(self) -> FoundEncounter | None:
        """The encounter; None if there is none."""
        best = self.unattacked.best
        return None if best is None else best.found

    def by_program(self, bank: MemoryBank, agents: Agents) -> Run:
        """Run the program's own attacks.

        Args:
            bank: The memory bank.
            agents: The agents.

        Returns:
            The run of the row.
        """
        opened, settings = self.unattacked, self.settings
        run = replace(opened, agents=agents, bank_hash=bank.content_hash())
        if opened.best is None:
            return run
        clock, kept = _Clock(), [opened.best]
        try:
            prepared = prepare(opened.best.found, opened.run_input, settings, opened.task, self.sandbox, bank, agents)
            decision = decide(opened.best, prepared, settings, agents, bank, kept.append)
            if decision.library is not None:
                runner = runner_of(self.engine, self.sandbox, prepared.found, settings)
                pursue(decision, runner, settings, agents, bank, clock.tell, kept.append)
        except ModelError as error:
            kept.append(replace(kept[-1], ending=model_ending(error), reason=str(error)))
        isolation = self.sandbox.isolation if kept[-1].attacked else ""
        return self._attacked(replace(run, isolation=isolation), kept[-1], clock, {"waited": agents.ledger.waited})

    def by_opponent(self, opponent: Opponent, bank: MemoryBank) -> Run:
        """Run an opponent's attacks until one succeeds or its budget is used up.

        Args:
            opponent: The opponent. If it has a true attribute ``exhaustive``, it attacks until it proposes nothing
                more.
            bank: The memory bank.

        Returns:
            The run of the row.

        Raises:
            SimulationError: The simulation was lost, and with it what other rows need.
        """
        record, settings = self.unattacked.best, self.settings
        if record is None:
            return self.unattacked
        encounter, done = record.found, Refinement(goal=settings.goal)
        clock, runner = _Clock(), runner_of(self.engine, self.sandbox, encounter, settings)
        exhaustive = bool(getattr(opponent, "exhaustive", False))
        try:
            opponent.begin(self.encounter(encounter, bank))
            while exhaustive or (len(done.attempts) < settings.attempts and clock.seconds < settings.seconds):
                proposal = opponent.propose(tuple(done.attempts))
                if proposal is None:
                    done.reason = "Nothing was left to try."
                    break
                result = self._result(proposal, encounter, runner)
                attempt = attempt_of(len(done.attempts), "opponent", proposal, result, encounter, settings)
                done.attempts.append(checked(attempt, result, runner, done.goal, done.level))
                done.results.append(result)
                clock.tell("attempt", done.attempts[-1])
                if done.goal.met(done.attempts[-1].verdict):
                    done.ending = Ending.GOAL_MET
                    if not exhaustive:
                        break
            settle_best(done, runner)
        except SandboxError as error:
            done.ending, done.reason = Ending.PLANNER_FAILED, str(error)
        return self._attacked(self.unattacked, done.recorded(record), clock, {})

    def _attacked(self, run: Run, record: EncounterRecord, clock: _Clock, waited: Mapping[str, float]) -> Run:
        """Return a run with the record of the attacks in its last encounter, and with the times of a row."""
        records = (*run.records[:-1], record)
        spent = seconds_by_part(self._started, *(each.timing for each in records))
        return replace(run, records=records, timing={**spent, **clock.timing(self._started["opened"]), **waited})

    def _result(self, proposal: Proposal, encounter: FoundEncounter, runner: AttemptRunner) -> AttemptResult:
        """Simulate an attempt.

        A fork may be lost to a crash of SUMO itself (a vehicle far off its lanes); then the attempt failed. Without
        forks, the simulation is lost, too. Raise SimulationError in that case.
        """
        try:
            return next(runner.attempt([proposal]))
        except SimulationError as error:
            if not self.unattacked.forked or self._lost():
                raise
            failed = Driven("planner_failed", str(error))
            return AttemptResult(failed, None, encounter.situations[proposal.delay].time)

    def _lost(self) -> bool:
        """Return whether the simulation itself is gone, and not only a fork of it."""
        try:
            return not self.engine.call(EpisodeCalls.forks)
        except SimulationError:
            return True

    def encounter(self, found: FoundEncounter, bank: MemoryBank) -> Encounter:
        """Return what an opponent sees of an encounter."""
        settings, first, task = self.settings, found.first, self.unattacked.task
        scene = signature(first, first.target_list()[0].state.id, task.ego_driver)
        library, _ = read_library(bank, scene, settings.seed, found.situations)
        return Encounter(found.situations, library, found.drivable, settings, settings.seed, task.spec.network)


class _Clock:
    """Measures the time of a row, and the time to its first attempts of high levels."""

    def __init__(self) -> None:
        self._began = time.perf_counter()
        self._first: dict[Level, float] = {}

    def tell(self, what: str, value: Any) -> None:
        if isinstance(value, Attempt):
            for level in (Level.VALID, Level.STRICT, Level.SERIOUS):
                if value.verdict.level >= level:
                    self._first.setdefault(level, self.seconds)

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._began

    def timing(self, opened: float) -> dict[str, float]:
        """Return the times since the encounter [s] (``row``, ``first_valid``, ...); ``total`` includes the opening."""
        row = self.seconds
        return {"row": row, **{f"first_{level}": first for level, first in self._first.items()}, "total": opened + row}


# -- whether the attempt that counts is robust


def robustness(run: Run, engine: EpisodeEngine, sandbox: Sandbox) -> dict[str, Any] | None:
    """Simulate neighbours of the attempt that counts (``episode/neighbours.py``).

    Args:
        run: The run.
        engine: The simulation.
        sandbox: Runs planners.

    Returns:
        The number of neighbours that are valid, their number, and whether that is robust. None if the attempt is not
            valid.
    """
    record, settings = run.best, run.settings
    best = None if record is None else record.best
    if record is None or best is None or best.verdict.level < Level.VALID:
        return None
    seen, found = record.robustness, record.found
    if seen is None:
        result = record.results[best.index]
        runner = runner_of(engine, sandbox, found, settings)
        near = neighbours(best, result, Random(settings.seed), settings.step_length, displaces=runner.displaces)
        again = [attempt_of(0, "again", p, r, found, settings) for p, r in zip(near, runner.attempt(near), strict=True)]
        seen = Robustness(sum(holds(a.verdict, Goal(Level.VALID)) for a in again), len(again))
    return {"valid": seen.held, "of": seen.of, "robust": seen.enough}


# -- what a cell keeps of motion


TRAFFIC_RADIUS_M = 60.0  # traffic for comparison is within this distance of the ego's mean position
MAX_MOTION_SAMPLES = 2000  # samples of a quantity that a cell keeps


def unattacked(run: Run) -> dict[str, Any] | None:
    """Summarise the unattacked run as an outcome: the ego and the nearest vehicle of the shortlist.

    The time from the trigger on counts.

    Args:
        run: The run.

    Returns:
        The outcome; None if there is no encounter.
    """
    if run.best is None:
        return None
    encounter, tracks = run.best.found, _raw(run, run.best)
    ego = tracks[encounter.ego].between(encounter.time, encounter.time + run.settings.duration)
    others = [tracks[n].between(encounter.time, float(ego.time[-1])) for n, _, _ in encounter.ranking if n in tracks]
    others = [t for t in others if len(t.time) > 1]
    least, apart = np.inf, np.inf
    if others:
        me, them = on_grid([ego], ego.time), on_grid(others, ego.time)
        least = float(np.nanmin(ttc(me, them), initial=np.inf))
        apart = float(np.nanmin(np.hypot(them.x - me.x, them.y - me.y), initial=np.inf))
    return {
        "min_ttc": _number(least), "collided": least == 0.0, "critical": least <= run.settings.critical_ttc,
        "feasible": True, "rear_end": False, "valid": None, "strict": None, "failed_gates": [],
        "paper_centre_distance": {
            "minimum": _number(apart), "epsilon": PAPER_EPSILON_M, "within": apart <= PAPER_EPSILON_M
        },
    }  # fmt: skip


def motion_of(run: Run) -> dict[str, Any]:
    """Return speeds [m/s] and accelerations [m/s2], step by step.

    They are those of the adversary of the attempt that counts up to the contact, and of the unattacked traffic near the
    ego in the same window.

    Args:
        run: The run.

    Returns:
        The samples by ``adversary`` and ``raw``, then by ``speed`` and ``acceleration``; empty without an attempt.
    """
    record, step = run.best, run.settings.step_length
    best = None if record is None else record.best
    if record is None or best is None or record.prefix is None:
        return {}
    result, prefix = record.results[best.index], record.prefix
    sizes = {**prefix.sizes, **result.sizes}
    own = tracks_of([*prefix.snapshots[-2:], *result.snapshots], sizes, {}, step, [best.proposal.bv])
    contact = best.verdict.contact_time
    start = result.start + step / 2
    moved = [t.between(start, np.inf if contact is None else contact) for t in own]
    end = max((float(t.time[-1]) for t in moved if len(t.time)), default=start)
    return {"adversary": _samples(moved), "raw": _samples(_near(run, record, start, end))}


def _raw(run: Run, record: EncounterRecord) -> dict[str, Track]:
    """Return the tracks of the unattacked run, by id."""
    before = record.prefix.snapshots[-2:] if record.prefix is not None else []
    sizes = {**(record.prefix.sizes if record.prefix is not None else {}), **record.found.sizes}
    roles, step = run.task.roles(record.found.ego), run.settings.step_length
    return {t.id: t for t in tracks_of([*before, *record.found.baseline], sizes, roles, step)}


def _near(run: Run, record: EncounterRecord, start: float, end: float) -> list[Track]:
    """Return the unattacked traffic near the ego within a window."""
    tracks = _raw(run, record)
    ego = tracks[record.found.ego].between(start, end)
    if not len(ego.time):
        return []
    x, y = float(ego.x.mean()), float(ego.y.mean())
    window = [t.between(start, end) for t in tracks.values() if t.role is Role.BACKGROUND]
    return [t for t in window if len(t.time) and float(np.hypot(t.x - x, t.y - y).min()) < TRAFFIC_RADIUS_M]


def _samples(tracks: Sequence[Track]) -> dict[str, list[float]]:
    """Return at most ``MAX_MOTION_SAMPLES`` samples of each quantity."""
    samples: dict[str, list[float]] = {}
    for name in ("speed", "acceleration"):
        values = np.concatenate([getattr(t, name) for t in tracks]) if tracks else np.empty(0)
        stride = max(1, -(-len(values) // MAX_MOTION_SAMPLES))
        samples[name] = [round(float(v), 2) for v in values[::stride]]
    return samples


def _number(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None
