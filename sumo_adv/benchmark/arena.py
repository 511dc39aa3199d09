"""One encounter of a suite, opened once, and attacked by row after row.

Every row gets the same trigger, the same unattacked run, the same budget, the same stop rule and the same choice of the
attempt that counts.  Where a scenario leaves the trigger open, the shipped library chooses it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from random import Random
from typing import Any

import numpy as np

from sumo_adv.agents.agents import Agents
from sumo_adv.benchmark.nouns import Encounter, Opponent
from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, Ending, Level, Proposal, Role, Track
from sumo_adv.episode.assessment import AttemptRunner, attempt_of, checked, runner_of
from sumo_adv.episode.attempt import Driven
from sumo_adv.episode.engine import EpisodeCalls, EpisodeEngine
from sumo_adv.episode.episode import Episode
from sumo_adv.episode.loop import decide, model_ending, pursue
from sumo_adv.episode.memory_access import read_library, signature
from sumo_adv.episode.neighbours import Robustness, holds, neighbours
from sumo_adv.episode.planned_encounter import find_attackable, seek, with_predictions
from sumo_adv.episode.refinement import settle_best
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
    """An open encounter. ``episode``: as far as it goes without an attack; its ``found`` is None if there is none.

    ``common``: the settings of all rows, by which an encounter is chosen where the trigger is open; ``settings``: those
    of its own rows that attack.
    """

    def __init__(
        self, source: RunInput, settings: Settings, task: Task, engine: EpisodeEngine, sandbox: Sandbox,
        bank: MemoryBank, common: Settings,
    ) -> None:  # fmt: skip
        self.engine, self.sandbox = engine, sandbox
        self.episode = Episode(source, common, task, bank_hash=bank.content_hash())
        began = time.perf_counter()
        try:
            if task.trigger is not None:
                seek(self.episode, engine, lambda *_: None)
            else:
                planned = find_attackable(self.episode, engine, sandbox, bank, lambda *_: None)
                self.episode.found = None if planned is None else planned.found
        except SumoAdvError as error:
            if error.exit_status == 2:
                raise
            self.episode.ending, self.episode.reason = Ending.SIMULATION_FAILED, str(error)
            self.episode.found = None
        self.episode.settings = settings
        self.episode.timing["opened"] = time.perf_counter() - began

    @property
    def found(self) -> FoundEncounter | None:
        return self.episode.found

    def fresh(self, agents: Agents | None = None) -> Episode:
        e = self.episode
        return Episode(
            e.source, e.settings, e.task, e.ending, e.reason, e.found, prefix=e.prefix, lanes=e.lanes,
            forked=e.forked, skips=e.skips, bank_hash=e.bank_hash, agents=agents,
            timing={**e.timing, "total": e.timing["opened"]},
        )  # fmt: skip

    def by_program(self, bank: MemoryBank, agents: Agents) -> Episode:
        episode = self.fresh(agents)
        episode.bank_hash = bank.content_hash()
        if episode.found is None:
            return episode
        clock = _Clock()
        try:
            planned = with_predictions(episode, episode.found, self.sandbox, bank)
            entries = decide(episode, planned, agents, bank)
            if entries is not None:
                runner = runner_of(self.engine, self.sandbox, planned.found, episode.settings)
                pursue(episode, planned, entries, runner, agents, bank, clock.tell)
        except ModelError as error:
            episode.ending, episode.reason = model_ending(error), str(error)
        clock.stop(episode)
        episode.timing["waited"] = agents.ledger.waited
        return episode

    def by_opponent(self, opponent: Opponent, bank: MemoryBank) -> Episode:
        """An opponent's attacks, until success or until its budget is used up.

        Raises:
            SimulationError: the simulation was lost, and with it what other rows need.
        """
        episode = self.fresh()
        encounter, settings, done = episode.found, episode.settings, episode.refinement
        if encounter is None:
            return episode
        clock, runner = _Clock(), runner_of(self.engine, self.sandbox, encounter, settings)
        exhaustive = bool(getattr(opponent, "exhaustive", False))
        episode.ending, episode.reason = Ending.ATTEMPTS_EXHAUSTED, ""
        try:
            opponent.begin(self.encounter(encounter, bank))
            while exhaustive or (len(done.attempts) < settings.attempts and clock.seconds < settings.seconds):
                proposal = opponent.propose(tuple(done.attempts))
                if proposal is None:
                    episode.reason = "Nothing was left to try."
                    break
                result = self._result(proposal, encounter, runner)
                attempt = attempt_of(len(done.attempts), "opponent", proposal, result, encounter, settings)
                done.attempts.append(checked(attempt, result, runner, done.goal, done.level))
                done.results.append(result)
                clock.tell("attempt", done.attempts[-1])
                if done.goal.met(done.attempts[-1].verdict):
                    episode.ending = Ending.CRITICAL
                    if not exhaustive:
                        break
            settle_best(done, runner)
        except SandboxError as error:
            episode.ending, episode.reason = Ending.PLANNER_FAILED, str(error)
        clock.stop(episode)
        return episode

    def _result(self, proposal: Proposal, encounter: FoundEncounter, runner: AttemptRunner) -> AttemptResult:
        """What an attempt came to. A fork that SUMO's own crash took (a vehicle far off its lanes) is an attempt that
        failed; where there are no forks the simulation is lost with it. Raises SimulationError."""
        try:
            return next(runner.attempt([proposal]))
        except SimulationError as error:
            if not self.episode.forked or self._lost():
                raise
            failed = Driven("planner_failed", str(error))
            return AttemptResult(failed, None, encounter.situations[proposal.delay].time)

    def _lost(self) -> bool:
        """Whether the simulation itself is gone, and not only a fork of it."""
        try:
            return not self.engine.call(EpisodeCalls.forks)
        except SimulationError:
            return True

    def encounter(self, found: FoundEncounter, bank: MemoryBank) -> Encounter:
        settings, first = self.episode.settings, found.first
        scene = signature(first, first.target_list()[0].state.id, self.episode.task.ego_driver)
        library, _ = read_library(bank, scene, settings.seed, found.situations)
        network = self.episode.task.spec.network
        return Encounter(found.situations, library, found.drivable, settings, settings.seed, network)


class _Clock:
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

    def stop(self, episode: Episode) -> None:
        """Into the episode's timing: ``row``, ``first_valid`` and so on (from the encounter on), ``total``."""
        row = self.seconds
        episode.timing["row"] = row
        episode.timing |= {f"first_{level}": seconds for level, seconds in self._first.items()}
        episode.timing["total"] = episode.timing.get("opened", 0.0) + row


# -- whether the attempt that counts is robust


def robustness(episode: Episode, engine: EpisodeEngine, sandbox: Sandbox) -> dict[str, Any] | None:
    """In how many neighbours the attempt that counts holds (``episode/neighbours.py``); None if it is not valid."""
    best, done, found = episode.best, episode.refinement, episode.found
    if best is None or found is None or best.verdict.level < Level.VALID:
        return None
    seen = done.robustness
    if seen is None:
        settings, result = episode.settings, done.results[best.index]
        runner = runner_of(engine, sandbox, found, settings)
        near = neighbours(best, result, Random(settings.seed), settings.step_length, displaces=runner.displaces)
        again = [attempt_of(0, "again", p, r, found, settings) for p, r in zip(near, runner.attempt(near), strict=True)]
        seen = Robustness(sum(holds(a.verdict, Goal(Level.VALID)) for a in again), len(again))
    return {"valid": seen.held, "of": seen.of, "robust": seen.enough}


# -- what a cell keeps of motion


TRAFFIC_RADIUS_M = 60.0  # m from the ego's middle: traffic for comparison
MAX_MOTION_SAMPLES = 2000  # numbers of a kind that a cell keeps


def unattacked(episode: Episode) -> dict[str, Any] | None:
    """The raw run as an outcome: the ego and the vehicle of the shortlist that comes nearest, from the trigger on."""
    encounter = episode.found
    if encounter is None:
        return None
    tracks = _raw(episode, encounter)
    ego = tracks[encounter.ego].between(encounter.time, encounter.time + episode.settings.duration)
    others = [tracks[n].between(encounter.time, float(ego.time[-1])) for n, _, _ in encounter.ranking if n in tracks]
    others = [t for t in others if len(t.time) > 1]
    least, apart = np.inf, np.inf
    if others:
        me, them = on_grid([ego], ego.time), on_grid(others, ego.time)
        least = float(np.nanmin(ttc(me, them), initial=np.inf))
        apart = float(np.nanmin(np.hypot(them.x - me.x, them.y - me.y), initial=np.inf))
    return {
        "min_ttc": _number(least), "collided": least == 0.0, "critical": least <= episode.settings.critical_ttc,
        "feasible": True, "rear_end": False, "valid": None, "strict": None, "failed_gates": [],
        "paper_centre_distance": {
            "minimum": _number(apart), "epsilon": PAPER_EPSILON_M, "within": apart <= PAPER_EPSILON_M
        },
    }  # fmt: skip


def motion_of(episode: Episode) -> dict[str, Any]:
    """Speeds [m/s] and accelerations [m/s2], step by step: of the adversary of the attempt that counts up to the
    contact, and of the unattacked traffic near the ego in the same window. Empty without an attempt."""
    encounter, best, k, prefix = episode.found, episode.best, episode.refinement.best, episode.prefix
    if encounter is None or best is None or k is None or prefix is None:
        return {}
    result, step = episode.refinement.results[k], episode.settings.step_length
    sizes = {**prefix.sizes, **result.sizes}
    own = tracks_of([*prefix.snapshots[-2:], *result.snapshots], sizes, {}, step, [best.proposal.bv])
    contact = best.verdict.contact_time
    start = result.start + step / 2
    moved = [t.between(start, np.inf if contact is None else contact) for t in own]
    end = max((float(t.time[-1]) for t in moved if len(t.time)), default=start)
    return {"adversary": _samples(moved), "raw": _samples(_near(episode, encounter, start, end))}


def _raw(episode: Episode, encounter: FoundEncounter) -> dict[str, Track]:
    before = episode.prefix.snapshots[-2:] if episode.prefix is not None else []
    sizes = {**(episode.prefix.sizes if episode.prefix is not None else {}), **encounter.sizes}
    tracks = tracks_of(
        [*before, *encounter.baseline], sizes, episode.task.roles(encounter.ego), episode.settings.step_length
    )
    return {t.id: t for t in tracks}


def _near(episode: Episode, encounter: FoundEncounter, start: float, end: float) -> list[Track]:
    tracks = _raw(episode, encounter)
    ego = tracks[encounter.ego].between(start, end)
    if not len(ego.time):
        return []
    x, y = float(ego.x.mean()), float(ego.y.mean())
    window = [t.between(start, end) for t in tracks.values() if t.role is Role.BACKGROUND]
    return [t for t in window if len(t.time) and float(np.hypot(t.x - x, t.y - y).min()) < TRAFFIC_RADIUS_M]


def _samples(tracks: Sequence[Track]) -> dict[str, list[float]]:
    samples: dict[str, list[float]] = {}
    for name in ("speed", "acceleration"):
        values = np.concatenate([getattr(t, name) for t in tracks]) if tracks else np.empty(0)
        stride = max(1, -(-len(values) // MAX_MOTION_SAMPLES))
        samples[name] = [round(float(v), 2) for v in values[::stride]]
    return samples


def _number(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None
