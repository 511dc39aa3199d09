"""Record a run and its encounters. The records are frozen, and the best one is the result of the run."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from sumo_adv.agents.agents import Agents
from sumo_adv.asked import Asked
from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, Ending, Intent, LaneStrip, Level
from sumo_adv.drivers.timing import DriverTime
from sumo_adv.episode.neighbours import Robustness
from sumo_adv.episode.order import best_index, rank
from sumo_adv.episode.task import AttemptResult, FoundEncounter, Prefix, Task
from sumo_adv.goal import Goal
from sumo_adv.script import Script
from sumo_adv.search.supports import Cast
from sumo_adv.simulation.inputs import RunInput
from sumo_adv.words.request import Reading


@dataclass(frozen=True, slots=True)
class Request:
    """The attack that was requested.

    Attributes:
        asked: What must be true of the attack; None if no attack was requested.
        words: The request in words; empty if there are none.
        declined: Why the request cannot be played in the encounter; empty if it can.
        attackers: What must be true of each of several attackers, by id; empty for one adversary.
        scripts: The scripts that a model gives to vehicles, as it reads the words.
    """

    asked: Asked | None = None
    words: str = ""
    declined: str = ""
    attackers: Mapping[str, Asked] = field(default_factory=dict)
    scripts: Sequence[Script] = ()

    @staticmethod
    def of(run_input: RunInput) -> Request:
        """Return the request that an input makes.

        Args:
            run_input: The input.
        """
        attackers = {each.id: each.asked for each in run_input.attackers}
        return Request(run_input.asked, run_input.words, attackers=attackers)


@dataclass(frozen=True, slots=True)
class EncounterRecord:
    """What a run found, tried and learnt in one encounter.

    Attributes:
        found: The encounter.
        goal: What an attempt must reach.
        prefix: The simulation up to the encounter; None if it was not kept.
        lanes: The lanes near the encounter.
        request: The request, as it was read in this encounter.
        intents: The intents, as the analyzer ranked them.
        casts: Compositions of several adversaries that a model proposed.
        bandit: How the planners of each intent were ordered, for the manifest.
        attacked: Whether attempts were started. They were not if the encounter was passed over.
        known_labels: Labels of the intents that the library had before the attempts.
        attempts: The attempts in order; ``results[k]`` belongs to ``attempts[k]``.
        results: The results of the attempts; empty if the recorded states were not kept.
        successes: Indices of the attempts that reached the goal, one of each kind.
        robust: By index of a success, in how many of its neighbours it holds.
        readings: By index of an attempt, what a model reads in its motion.
        first_success_seconds: Time from the start of the search to the first success [s]; None without a success.
        chosen: Index of the attempt that counts; None if the best attempt counts.
        ending: How the encounter ended; None if it has not ended.
        reason: Why it ended, as a sentence.
        left: Why the run moved on from this encounter; empty if it did not.
        learnt: Whether the bank has learnt a success.
        bank_change: What the bank has learnt that changes the next run, as a sentence; empty if nothing.
        notes: Sentences that the reader of the result should know.
        timing: How long each part took [s].
    """

    found: FoundEncounter
    goal: Goal = field(default_factory=Goal)
    prefix: Prefix | None = None
    lanes: Sequence[LaneStrip] = ()
    request: Request = field(default_factory=Request)
    intents: Sequence[Intent] = ()
    casts: Sequence[Cast] = ()
    bandit: Sequence[Any] = ()
    attacked: bool = False
    known_labels: frozenset[str] = frozenset()
    attempts: Sequence[Attempt] = ()
    results: Sequence[AttemptResult] = ()
    successes: Sequence[int] = ()
    robust: Mapping[int, Robustness] = field(default_factory=dict)
    readings: Mapping[int, Reading] = field(default_factory=dict)
    first_success_seconds: float | None = None
    chosen: int | None = None
    ending: Ending | None = None
    reason: str = ""
    left: str = ""
    learnt: bool = False
    bank_change: str = ""
    notes: Sequence[str] = ()
    timing: Mapping[str, float] = field(default_factory=dict)

    @property
    def best(self) -> Attempt | None:
        """The attempt that counts; None without attempts."""
        if self.chosen is not None:
            return self.attempts[self.chosen]
        k = best_index(self.attempts, self.goal, self.robust, asked=self.request.asked is not None)
        return None if k is None else self.attempts[k]

    @property
    def best_result(self) -> AttemptResult | None:
        """The result of the attempt that counts; None without attempts, or if the recorded states were not kept."""
        best = self.best
        return None if best is None or not self.results else self.results[best.index]

    @property
    def intent(self) -> Intent | None:
        """The intent of the attempt that counts, or the first intent without attempts; None if nothing attacked."""
        if not self.attacked or not self.intents:
            return None
        best = self.best
        if best is None:
            return self.intents[0]
        p = best.proposal
        same = [i for i in self.intents if i.label == p.label]
        intent = next((i for i in same if i.bv == p.bv), same[0] if same else self.intents[0])
        source = "memory" if p.label in self.known_labels else "generated"
        return replace(intent, bv=p.bv, acceleration=p.acceleration, source=source)

    @property
    def robustness(self) -> Robustness | None:
        """In how many neighbours the attempt that counts holds; None if no neighbour was tried."""
        best = self.best
        return None if best is None else self.robust.get(best.index)

    @property
    def level(self) -> Level:
        """The level of the attempt that counts."""
        best = self.best
        return Level.NONE if best is None else best.verdict.level

    @property
    def passed_over(self) -> bool:
        """Whether the run left the encounter without attacking in it."""
        return bool(self.left) and not self.attacked

    def of_attempt(self, index: int) -> EncounterRecord:
        """Return the record with another attempt as the one that counts.

        Args:
            index: The index of the attempt.
        """
        return replace(self, chosen=index)

    def took(self, seconds: Mapping[str, float]) -> EncounterRecord:
        """Return the record with more time counted.

        Args:
            seconds: The additional time by part [s].
        """
        return replace(self, timing=seconds_by_part(self.timing, seconds))

    def without_states(self) -> EncounterRecord:
        """Return the record without recorded states, which take a megabyte for each attempt."""
        return replace(self, found=replace(self.found, baseline=()), prefix=None, lanes=(), results=())


Keep = Callable[[EncounterRecord], None]
"""Is called with the record of an encounter whenever it has grown, so that nothing is lost if the run fails later."""


def forget(record: EncounterRecord) -> None:
    """Keep nothing. Use it if the record is not needed after a failure.

    Args:
        record: The record, which is ignored.
    """


@dataclass(frozen=True, slots=True)
class Stop:
    """Why a run ended outside an encounter.

    Attributes:
        ending: How the run ended.
        reason: Why, as a sentence.
        failed: True if a failure or an interruption ended the run. Then ``ending`` is the ending of the run, whatever
            the results of its encounters. False if there was no further encounter. Then ``ending`` is the ending of the
            run only if no encounter counts.
        traceback: The traceback of an unexpected error; empty otherwise.
    """

    ending: Ending
    reason: str
    failed: bool = False
    traceback: str = ""


@dataclass(frozen=True, slots=True)
class Run:
    """A run from its input to its encounters. All output of a run is a function of this object and its best record.

    Attributes:
        run_input: What the run started from.
        settings: The settings.
        task: What the engine was opened with.
        records: The encounters in order, including those that were passed over.
        stop: Why the run ended; None if it ended with its last encounter.
        forked: Whether attempts were forks of one simulation.
        agents: The analyzer, generator and modifier; None if the run had none.
        isolation: How planners were isolated from this machine; empty if none ran.
        bank_hash: The hash of the bank's content before the run; empty if the run had no bank.
        warnings: SUMO's warnings, except those of attempts.
        timing: How long each part took [s].
        driver_time: How long the answers of the ego's driver took; None if SUMO drove it, or the engine was lost.
    """

    run_input: RunInput
    settings: Settings
    task: Task
    records: Sequence[EncounterRecord] = ()
    stop: Stop | None = None
    forked: bool = False
    agents: Agents | None = None
    isolation: str = ""
    bank_hash: str = ""
    warnings: Sequence[str] = ()
    timing: Mapping[str, float] = field(default_factory=dict)
    driver_time: DriverTime | None = None

    @property
    def best(self) -> EncounterRecord | None:
        """The record that is the run's result; None if no encounter counts."""
        return best_record(self.records)

    @property
    def ending(self) -> Ending:
        """How the run ended."""
        return self._end[0]

    @property
    def reason(self) -> str:
        """Why the run ended, as a sentence."""
        return self._end[1]

    @property
    def _end(self) -> tuple[Ending, str]:
        best, stop = self.best, self.stop
        if stop is not None and (stop.failed or best is None):
            return stop.ending, stop.reason
        if best is None or best.ending is None:  # no ending was recorded, so the run counts as failed
            return Ending.SIMULATION_FAILED, ""
        return best.ending, best.reason

    @property
    def traceback(self) -> str:
        """The traceback of an unexpected error; empty otherwise."""
        return "" if self.stop is None else self.stop.traceback

    @property
    def request(self) -> Request:
        """The request of the best record; without one, of the last record; without records, of the input."""
        record = self.best or (self.records[-1] if self.records else None)
        return Request.of(self.run_input) if record is None else record.request

    @property
    def declined(self) -> bool:
        """Whether a request could not be played in some encounter, and nothing was attempted in any."""
        tried = any(record.attempts for record in self.records)
        return not tried and any(record.request.declined for record in self.records)

    def encounters_before(self, record: EncounterRecord | None) -> int:
        """Count the encounters that the run found before that of a record.

        Args:
            record: A record of this run; None counts all encounters.
        """
        return len(self.records) if record is None else [r.found.time for r in self.records].index(record.found.time)

    @property
    def learnt(self) -> bool:
        """Whether the bank has learnt a success."""
        return any(record.learnt for record in self.records)

    @property
    def bank_change(self) -> str:
        """The last change of the bank that changes the next run, as a sentence; empty if there is none."""
        return next((record.bank_change for record in reversed(self.records) if record.bank_change), "")

    @property
    def notes(self) -> list[str]:
        """The notes of the input and of all encounters."""
        return [*self.run_input.notes, *(note for record in self.records for note in record.notes)]


def best_record(records: Sequence[EncounterRecord]) -> EncounterRecord | None:
    """Return the record that is the result of a run.

    Encounters with a success come first. Within both groups, the best attempts are compared by ``rank``, and encounters
    without an attempt come last. The first encounter wins a tie. Encounters that were passed over do not count.

    Args:
        records: The records of the run, in order.

    Returns:
        The record; None if no encounter counts.
    """
    counting = [record for record in records if not record.passed_over]
    return min(counting, key=_order, default=None)


def _order(record: EncounterRecord) -> tuple[float, ...]:
    """Return a key that sorts records, the best one first."""
    best = record.best
    worth = (math.inf, 0.0) if best is None else rank(best.verdict)
    return (record.ending is not Ending.GOAL_MET, *worth)


def seconds_by_part(*timings: Mapping[str, float]) -> dict[str, float]:
    """Add up the time of each part.

    Args:
        timings: Mappings from the name of a part to its time [s].

    Returns:
        The total time by part [s].
    """
    parts: dict[str, float] = {}
    for timing in timings:
        for part, seconds in timing.items():
            parts[part] = parts.get(part, 0.0) + seconds
    return parts
