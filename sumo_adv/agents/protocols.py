"""The parts a language model or the built-in expert can play, and what they need from others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from sumo_adv.datatypes import Attempt, Intent, LibraryEntry, Planner
from sumo_adv.situation import Situation


class Analyzer(Protocol):
    """The paper's g: which vehicle could do what to be most dangerous."""

    name: str

    def analyze(self, situations: Mapping[float, Situation], library: Sequence[LibraryEntry]) -> list[Intent]:
        """Intents of the library, or new ones, most dangerous first; empty if nobody can reach the ego."""
        ...


class Generator(Protocol):
    """Writes a planner for an intent the bank does not know."""

    name: str

    def generate(
        self, intent: Intent, situation: Situation | None, examples: Sequence[LibraryEntry]
    ) -> tuple[Planner, ...]:
        """Its planners, one for each mode; none if it cannot write one."""
        ...


class Modifier(Protocol):
    """Changes a planner that has not been critical from what its attempts showed."""

    name: str

    def modify(self, planner: Planner, attempts: Sequence[Attempt], description: str = "") -> Planner | None:
        """A changed planner whose ``parent`` is the old one's hash, or None if there is nothing to change.

        ``description``: of the planner's intent.
        """
        ...
