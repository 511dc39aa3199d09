"""One encounter of a suite, opened once, and attacked by row after row.

Every row gets the same trigger, the same unattacked run, the same budget, the same stop rule and the same choice of the
attempt that counts.  Where a scenario leaves the trigger open, the shipped library chooses it.
"""

from __future__ import annotations

import time
from typing import Any

from sumo_adv.agents.agents import Agents
from sumo_adv.benchmark.nouns import Encounter, Opponent
from sumo_adv.benchmark.perturbed import robustness_of
from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, Ending, Level, Proposal
from sumo_adv.episode.assessment import AttemptRunner, StepwiseRunner, attempt_of, checked
from sumo_adv.episode.attempt import Driven
from sumo_adv.episode.episode import Episode
from sumo_adv.episode.loop import decide, model_ending, pursue
from sumo_adv.episode.memory_access import read_library, signature
from sumo_adv.episode.planned_encounter import find_attackable, seek, with_predictions
from sumo_adv.episode.refinement import settle_best
from sumo_adv.episode.task import AttemptResult, FoundEncounter, Task
from sumo_adv.errors import ModelError, SandboxError, SimulationError, SumoAdvError
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.inputs import RunInput


def _silent(*_: object) -> None:
    """No observer."""


class Arena:
    """An open encounter. ``episode``: as far as it goes without an attack; its ``found`` is None if there is none.

    ``common``: the settings of all rows, by which an encounter is chosen where the trigger is open; ``settings``: those
    of its own rows that attack.
    """

    def __init__(
        self, source: RunInput, settings: Settings, task: Task, engine: Engine, sandbox: Sandbox, bank: MemoryBank,
        common: Settings,
    ) -> None:  # fmt: skip
        self.engine, self.sandbox = engine, sandbox
        self.episode = Episode(source, common, task, bank_hash=bank.content_hash())
        began = time.perf_counter()
        try:
            if task.trigger is not None:
                seek(self.episode, engine, _silent)
            else:
                planned = find_attackable(self.episode, engine, sandbox, bank, _silent)
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
        """The encounter."""
        return self.episode.found

    def fresh(self, agents: Agents | None = None) -> Episode:
        """An episode at the trigger of this encounter."""
        e = self.episode
        return Episode(
            e.source, e.settings, e.task, e.ending, e.reason, e.found, prefix=e.prefix, lanes=e.lanes,
            forked=e.forked, skips=e.skips, bank_hash=e.bank_hash, agents=agents,
            timing={**e.timing, "total": e.timing["opened"]},
        )  # fmt: skip

    def by_program(self, bank: MemoryBank, agents: Agents) -> Episode:
        """The program's own loop, from the analyzer on, with the library of ``bank``."""
        episode = self.fresh(agents)
        episode.bank_hash = bank.content_hash()
        if episode.found is None:
            return episode
        clock = _Clock()
        try:
            planned = with_predictions(episode, episode.found, self.sandbox, bank)
            entries = decide(episode, planned, agents, bank)
            if entries is not None:
                runner = AttemptRunner(self.engine, self.sandbox, planned.found, episode.settings.seed)
                tries = StepwiseRunner(runner, self.engine.at_once)
                pursue(episode, planned, entries, tries, agents, bank, clock.tell)
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
        clock = _Clock()
        exhaustive = bool(getattr(opponent, "exhaustive", False))
        episode.ending, episode.reason = Ending.ATTEMPTS_EXHAUSTED, ""
        try:
            opponent.begin(self.encounter(encounter, bank))
            while exhaustive or (len(done.attempts) < settings.attempts and clock.seconds < settings.seconds):
                if not self._one(opponent, episode, encounter, clock):
                    break
                if done.goal.met(done.attempts[-1].verdict):
                    episode.ending = Ending.CRITICAL
                    if not exhaustive:
                        break
            settle_best(done, self._brain(encounter))
        except SandboxError as error:
            episode.ending, episode.reason = Ending.PLANNER_FAILED, str(error)
        clock.stop(episode)
        return episode

    def robustness(self, episode: Episode) -> dict[str, Any] | None:
        """How the attempt that counts fares with other timing; see ``robustness_of``."""
        if episode.found is None:
            return None
        return robustness_of(episode, self._brain(episode.found), episode.settings.seed)

    def _one(self, opponent: Opponent, episode: Episode, encounter: FoundEncounter, clock: _Clock) -> bool:
        done = episode.refinement
        proposal = opponent.propose(tuple(done.attempts))
        if proposal is None:
            episode.reason = "Nothing was left to try."
            return False
        result = self._result(proposal, encounter)
        attempt = attempt_of(len(done.attempts), "opponent", proposal, result, encounter, episode.settings)
        attempt = checked(attempt, result, self._brain(encounter), episode.refinement.goal)
        done.attempts.append(attempt)
        done.results.append(result)
        clock.tell("attempt", attempt)
        return True

    def _result(self, proposal: Proposal, encounter: FoundEncounter) -> AttemptResult:
        """What an attempt came to. A fork that SUMO's own crash took (a vehicle far off its lanes) is an attempt that
        failed; where there are no forks the simulation is lost with it. Raises SimulationError."""
        try:
            return self._brain(encounter).attempt([proposal])[0]
        except SimulationError as error:
            if not self.episode.forked or self._lost():
                raise
            failed = Driven("planner_failed", str(error))
            return AttemptResult(failed, None, encounter.situations[proposal.delay].time)

    def _brain(self, encounter: FoundEncounter) -> AttemptRunner:
        return AttemptRunner(self.engine, self.sandbox, encounter, self.episode.settings.seed)

    def _lost(self) -> bool:
        """Whether the simulation itself is gone, and not only a fork of it."""
        try:
            return not self.engine.request("forks")
        except SimulationError:
            return True

    def encounter(self, found: FoundEncounter, bank: MemoryBank) -> Encounter:
        """What an opponent sees."""
        settings, first = self.episode.settings, found.first
        scene = signature(first, first.target_list()[0].state.id, self.episode.task.ego_driver)
        library, _ = read_library(bank, scene, settings.seed, found.situations)
        network = self.episode.task.spec.network
        return Encounter(found.situations, library, found.drivable, settings, settings.seed, network)


class _Clock:
    """Seconds of a row, and until its first attempt of each level."""

    def __init__(self) -> None:
        self._began = time.perf_counter()
        self._first: dict[Level, float] = {}

    def tell(self, what: str, value: Any) -> None:
        """Hears of every attempt."""
        if isinstance(value, Attempt):
            for level in (Level.VALID, Level.STRICT, Level.SERIOUS):
                if value.verdict.level >= level:
                    self._first.setdefault(level, self.seconds)

    @property
    def seconds(self) -> float:
        """Since it was started."""
        return time.perf_counter() - self._began

    def stop(self, episode: Episode) -> None:
        """Into the episode's timing: ``row``, ``first_valid`` and so on (from the encounter on), ``total``."""
        row = self.seconds
        episode.timing["row"] = row
        episode.timing |= {f"first_{level}": seconds for level, seconds in self._first.items()}
        episode.timing["total"] = episode.timing.get("opened", 0.0) + row
