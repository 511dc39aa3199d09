"""The record of one run, filled in while it goes on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from sumo_adv.agents.agents import Agents
from sumo_adv.asked import Asked
from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, Ending, Intent, LaneStrip, Level
from sumo_adv.episode.refinement import Refinement
from sumo_adv.episode.task import FoundEncounter, Prefix, Task
from sumo_adv.search.supports import Cast
from sumo_adv.simulation.inputs import RunInput


@dataclass(frozen=True, slots=True)
class Tried:
    """An encounter that was attacked without success: its time [s], ego, attempts, best level, and why it ended."""

    time: float
    ego: str
    made: Sequence[Attempt]
    level: Level
    reason: str

    @property
    def attempts(self) -> int:
        return len(self.made)


@dataclass(slots=True)
class Episode:
    source: RunInput
    settings: Settings
    task: Task
    ending: Ending = Ending.SIMULATION_FAILED
    reason: str = ""
    found: FoundEncounter | None = None
    intents: Sequence[Intent] = ()
    intent: Intent | None = None
    casts: Sequence[Cast] = ()  # compositions that a model proposed
    asked: Asked | None = None  # what must be true of the attack
    words: str = ""  # in which it was asked for
    declined: str = ""  # why what was asked for cannot be played in the last encounter
    refinement: Refinement = field(default_factory=Refinement)
    prefix: Prefix | None = None
    lanes: Sequence[LaneStrip] = ()
    known_labels: frozenset[str] = frozenset()  # of intents that the bank had
    forked: bool = False
    skips: int = 0  # encounters passed over because no intent reaches the ego, by prediction
    tried: list[Tried] = field(default_factory=list)  # encounters that were attacked before, without success
    stopped: Mapping[str, int] = field(default_factory=dict)  # calls that ran into a limit, by the planner's hash
    isolation: str = ""
    bank_hash: str = ""
    agents: Agents | None = None  # None in a replay
    bandit: list[Any] = field(default_factory=list)  # how the planners of each intent were ordered
    learnt: bool = False
    bank_change: str = ""  # what the bank has learnt that changes the next run, in a sentence
    traceback: str = ""  # of a fault in sumo_adv
    warnings: Sequence[str] = ()  # SUMO's, but for attempts
    notes: list[str] = field(default_factory=list)
    timing: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """The attempts are judged by the goal of the settings."""
        self.refinement.goal = self.settings.goal
        self.asked, self.words = self.source.asked, self.source.words

    def of_attempt(self, index: int) -> Episode:
        """The same episode, in which another attempt counts."""
        other = replace(self.refinement, chosen=index)
        episode = replace(self, refinement=other, timing=dict(self.timing))
        episode.keep_intent()
        return episode

    def leave(self) -> Episode:
        """Note the encounter as tried and begin with an empty record for the next one. Returns what is left behind."""
        left, best = replace(self, timing=dict(self.timing)), self.best
        assert self.found is not None
        level = Level.NONE if best is None else best.verdict.level
        self.tried.append(Tried(self.found.time, self.found.ego, tuple(self.refinement.attempts), level, self.reason))
        self.refinement, self.skips = Refinement(goal=self.settings.goal), self.skips + 1
        self.intents, self.intent, self.casts, self.bandit = (), None, (), []
        self.ending, self.reason = Ending.SIMULATION_FAILED, ""
        return left

    def back_to(self, left: Episode) -> None:
        """Let an earlier encounter count, because no later one came to more."""
        for name in ("ending", "reason", "found", "intents", "intent", "casts", "refinement", "prefix", "lanes",
                     "known_labels", "skips", "bandit"):  # fmt: skip
            setattr(self, name, getattr(left, name))

    def keep_intent(self) -> None:
        """Take the intent of the attempt that counts, as the analyzer ranked it; without attempts, the first one."""
        best = self.best
        if best is None:
            self.intent = self.intents[0]
            return
        p = best.proposal
        same = [i for i in self.intents if i.label == p.label]
        intent = next((i for i in same if i.bv == p.bv), same[0] if same else self.intents[0])
        source = "memory" if p.label in self.known_labels else "generated"
        self.intent = replace(intent, bv=p.bv, acceleration=p.acceleration, source=source)

    @property
    def best(self) -> Attempt | None:
        """The attempt that counts."""
        k = self.refinement.best
        return None if k is None else self.refinement.attempts[k]
