"""The record of one run, filled in while it goes on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from sumo_adv.agents.agents import Agents
from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, Ending, Intent
from sumo_adv.episode.refinement import Refinement
from sumo_adv.episode.task import FoundEncounter, Prefix, Task
from sumo_adv.simulation.inputs import RunInput


@dataclass(slots=True)
class Episode:
    """The record of one run."""

    source: RunInput
    settings: Settings
    task: Task
    ending: Ending = Ending.SIMULATION_FAILED
    reason: str = ""
    found: FoundEncounter | None = None
    intents: Sequence[Intent] = ()
    intent: Intent | None = None
    refinement: Refinement = field(default_factory=Refinement)
    prefix: Prefix | None = None
    lanes: Sequence[Any] = ()
    forked: bool = False
    skips: int = 0  # encounters passed over because no intent reaches the ego, by prediction
    isolation: str = ""
    bank_hash: str = ""
    agents: Agents | None = None  # None in a replay
    bandit: list[Any] = field(default_factory=list)  # how the planners of each intent were ordered
    learnt: bool = False
    traceback: str = ""  # of a fault in sumo_adv
    notes: list[str] = field(default_factory=list)
    timing: dict[str, float] = field(default_factory=dict)

    @property
    def best(self) -> Attempt | None:
        """The attempt that counts."""
        k = self.refinement.best
        return None if k is None else self.refinement.attempts[k]
