"""Find the encounters of a run one after another, and keep their records during the run."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from sumo_adv.agents.agents import Agents
from sumo_adv.config import Settings
from sumo_adv.datatypes import Ending
from sumo_adv.drivers.timing import DriverTime
from sumo_adv.episode.clock import PartsClock
from sumo_adv.episode.engine import EpisodeCalls, EpisodeEngine
from sumo_adv.episode.memory_access import selected
from sumo_adv.episode.prepared_encounter import PreparedEncounter, prepare
from sumo_adv.episode.run import EncounterRecord, Request, Run, Stop, best_record, seconds_by_part
from sumo_adv.episode.task import FoundEncounter, NoEncounter, Task
from sumo_adv.errors import SumoAdvError
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.simulation.inputs import RunInput

MAX_PASSED_OVER = 6  # maximum number of encounters that are passed over because no candidate is predicted to collide
OUT_OF_REACH = "no intent reaches the ego, by prediction"
Tell = Callable[[str, Any], None]
"""Is called with the name of an event and its data, to show progress.

The events are ``("encounter", FoundEncounter)``, ``("intents", ...)`` with the intents, and ``("attempt", Attempt)``.
"""


class EncounterFinder:
    """Finds the encounters of a run one after another, and keeps their records during the run.

    Attributes:
        records: The records so far. The last one is that of the current encounter.
        stop: Why the run ended outside an encounter; None if it did not.
        forked: Whether attempts are forks of the simulation; False before the first call of ``seek``.
        stopped: How many calls of each planner ran into a limit in predictions, by the planner's hash.
        ends_at: When the run should end, as ``time.perf_counter()`` [s].
        clock: The time of the parts that belong to no record: the work before the finder was created, the start, the
            search for encounters, and the runs without an attack.
    """

    def __init__(
        self,
        run_input: RunInput,
        settings: Settings,
        task: Task,
        engine: EpisodeEngine,
        tell: Tell,
        clock: PartsClock | None = None,
        ends_at: float = math.inf,
    ) -> None:
        """Prepare to find encounters; nothing is simulated yet.

        Args:
            run_input: The input.
            settings: The run's settings.
            task: What is simulated.
            engine: The engine process.
            tell: Called with each encounter.
            clock: The time that was spent on the run before; None if there is none.
            ends_at: When the run should end, as ``time.perf_counter()`` [s].
        """
        self.ends_at = ends_at
        self._run_input, self._settings, self._task = run_input, settings, task
        self._engine, self._tell, self._began = engine, tell, time.perf_counter()
        self.clock = clock or PartsClock()
        self._before = sum(self.clock.seconds.values())  # s
        self._unattacked, self._started = 0.0, False
        self.records: list[EncounterRecord] = []
        self.stop: Stop | None = None
        self.forked = False
        self.stopped: Mapping[str, int] = {}

    def seek(self) -> EncounterRecord | None:
        """Find the next encounter. The first call also starts the simulation.

        Returns:
            The record of the encounter; None if there is none (``stop`` says why).
        """
        engine, before = self._engine, self._unattacked
        if not self.records:
            with self.clock.part("start"):
                engine.call(EpisodeCalls.open, self._task)
                self.forked, self._started = engine.call(EpisodeCalls.forks), True
        with self.clock.part("seek"):
            left = self.records[-1].left if self.records else ""
            found = engine.call(EpisodeCalls.seek, left, self.ends_at - time.perf_counter())
            self._unattacked = engine.call(EpisodeCalls.unattacked_seconds)
            if isinstance(found, FoundEncounter):
                prefix, lanes = engine.call(EpisodeCalls.prefix), engine.call(EpisodeCalls.lanes, *found.area)
        self.clock.move(self._unattacked - before, "seek", "unattacked")
        if isinstance(found, NoEncounter):
            self.stop = Stop(found.ending, found.reason)
            return None
        record = EncounterRecord(found, self._settings.goal, prefix, lanes, Request.of(self._run_input))
        self.records.append(record)
        self._tell("encounter", found)
        return record

    def driver_time(self) -> DriverTime | None:
        """Return how long the driver's answers took so far.

        Returns:
            The time; None if SUMO drives the ego, or if the engine has not started, is lost or cannot answer now.
        """
        engine = self._engine
        if not self._started or engine.lost or engine.asked or engine.talks:
            return None
        try:
            return engine.call(EpisodeCalls.driver_time)
        except SumoAdvError:
            return None

    def find_attackable(
        self, sandbox: Sandbox, bank: MemoryBank, agents: Agents | None = None, *, any_candidate: bool = False
    ) -> PreparedEncounter | None:
        """Find the next encounter in which a candidate is predicted to reach the ego.

        Encounters without such a candidate are passed over. The encounter is returned even without such a candidate if
        it is the last one of a recording, if the trigger is given, or if ``MAX_PASSED_OVER`` encounters came before it.

        Args:
            sandbox: Runs the planners.
            bank: The memory bank.
            agents: The analyzer, generator and modifier; None if there are none.
            any_candidate: Whether an encounter with any candidate is enough, because attempts will be varied until one
                collides.

        Returns:
            The encounter, whose record is the last one; None if there is none (``stop`` says why).

        Raises:
            UsageError: The settings name an intent that the bank does not know.
        """
        # refuses misspelt names before anything is simulated
        selected(self._settings, bank, self._run_input.intents, self._run_input.scripts)
        while (record := self.seek()) is not None:
            prepared = prepare(
                record.found, self._run_input, self._settings, self._task, sandbox, bank, agents, stopped=self.stopped
            )
            self.stopped = prepared.predictor.stopped
            reaches = prepared.reaches or (any_candidate and bool(prepared.search))
            given = self._task.trigger is not None
            if reaches or record.found.last or given or len(self.records) > MAX_PASSED_OVER:
                return prepared
            self.keep(self.records[-1].took(prepared.timing))
            self.leave(OUT_OF_REACH)
        return None

    def keep(self, record: EncounterRecord) -> None:
        """Replace the record of the current encounter.

        Args:
            record: The new record.
        """
        self.records[-1] = record

    def leave(self, why: str) -> None:
        """Leave the current encounter, so that ``seek`` looks for the next one.

        Only the best record so far keeps its recorded states, which are large.

        Args:
            why: Why the encounter is left.
        """
        record = replace(self.records[-1], left=why)
        if not record.attacked:
            record = replace(record, ending=Ending.NO_ENCOUNTER, reason=record.reason or why)
        self.records[-1] = record
        best = best_record(self.records)
        self.records = [r if r is best else r.without_states() for r in self.records]

    def break_off(self, stop: Stop) -> None:
        """Note why the run ended early. A current encounter that was not left gets the same ending.

        Args:
            stop: The ending and its reason.
        """
        self.stop = stop
        if self.records and not self.records[-1].left:
            self.keep(replace(self.records[-1], ending=stop.ending, reason=stop.reason))

    def run(self, agents: Agents | None = None, *, isolation: str = "", bank_hash: str = "") -> Run:
        """Return the run with the records so far, SUMO's warnings and the time of each part.

        The total time includes the time of ``clock`` from before the finder was created.

        Args:
            agents: The analyzer, generator and modifier; None if the run had none.
            isolation: How planners were isolated from this machine; empty if none ran.
            bank_hash: The hash of the bank's content before the run; empty if the run had no bank.
        """
        spent = seconds_by_part(self.clock.seconds, *(record.timing for record in self.records))
        total = self._before + time.perf_counter() - self._began
        return Run(
            self._run_input, self._settings, self._task, tuple(self.records), self.stop, self.forked, agents, isolation,
            bank_hash, self._task.own_names(self._engine.log.warnings()),
            {**spent, "other": total - sum(spent.values()), "total": total}, self.driver_time(),
        )  # fmt: skip
