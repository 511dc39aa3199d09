"""The three agents as protocols. A language model can play each of them, the built-in expert the first two."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from sumo_adv.agents.feedback import AttemptReport, RepairScene
from sumo_adv.agents.modifier import Change
from sumo_adv.datatypes import Intent, LibraryEntry, Planner
from sumo_adv.situation import Situation


class Analyzer(Protocol):
    """The paper's g: chooses adversaries and their intents. Implemented by ModelAnalyzer and ExpertAnalyzer."""

    def analyze(self, situations: Mapping[float, Situation], library: Sequence[LibraryEntry]) -> list[Intent]:
        """Intents of the library or new ones, most dangerous first; empty if no vehicle can reach the ego.

        situations: by start time after the trigger [s]. Raises ModelError.
        """
        ...


class Generator(Protocol):
    """Writes planners for an intent that the bank lacks. Implemented by ModelGenerator and ExpertGenerator."""

    def generate(
        self, intent: Intent, situation: Situation | None, examples: Sequence[LibraryEntry]
    ) -> tuple[Planner, ...]:
        """One planner per mode; empty if the agent cannot write one. Raises ModelError.

        situation: None for an intent that is written from its description alone.
        examples: entries of similar intents, nearest first.
        """
        ...


class Modifier(Protocol):
    """Changes how an intent is carried out, after attempts that did not reach the level. Implemented by ModelModifier
    alone.

    The built-in expert has no modifier: the search itself tries other parameters, modes, vehicles and start times.
    """

    def modify(self, planner: Planner, reports: Sequence[AttemptReport], scene: RepairScene) -> Change:
        """The change to try next; ``reports``: of the attempts with this planner. Raises ModelError."""
        ...
