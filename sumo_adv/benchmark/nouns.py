"""The nouns of the benchmark: an encounter of a suite, what an opponent sees of it and answers, the rows of a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, LibraryEntry, Planner, PrescribedMotion, Proposal
from sumo_adv.simulation.network import Drivable
from sumo_adv.situation import Situation

GROUPS = ("straight", "intersection")
RAW = "raw"
"""The row of unattacked runs."""
CRITICAL_TTC_S = 1.0
"""An unattacked run with a min TTC of at most this is critical by itself; the default of ``--critical-ttc``."""
MIN_TTC_CAP_S = 10.0
"""What a larger min TTC counts as, and that of a motion that does not count."""

Cell = Mapping[str, Any]
"""The outcome of a case x ego x row x seed; ``docs/benchmark.md`` lists its keys."""


@dataclass(frozen=True, slots=True)
class SuiteCase:
    """One encounter of a suite. ``record``: the id of a Waymo record in ``path``; ``labels``: what an oracle or people
    hold to be the most dangerous intents, by ego and criterion: ``{"idm": {"collision": (..), "valid": (..)}}``."""

    name: str
    path: Path
    record: str | None
    kind: str
    group: str
    labels: Mapping[str, Mapping[str, tuple[str, ...]]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Suite:
    """A frozen list of encounters. ``content``: SHA-256 over all its files."""

    name: str
    version: str
    cases: tuple[SuiteCase, ...]
    content: str


@dataclass(frozen=True, slots=True)
class Encounter:
    """What an opponent sees: a situation for each delay [s] after the trigger at which an attack may begin.

    network: the net.xml, for more of the road than the situations hold.
    """

    situations: Mapping[float, Situation]
    library: Sequence[LibraryEntry]
    drivable: Drivable
    settings: Settings
    seed: int
    network: Path


class Opponent(Protocol):
    """Makes attacks. It is asked until one succeeds or the budget is used up."""

    name: str

    def begin(self, encounter: Encounter) -> None:
        """A new encounter. Each has an opponent of its own, made anew: nothing is kept of others."""
        ...

    def propose(self, tried: Sequence[Attempt]) -> Proposal | None:
        """The next attack, from the attempts so far with their gate verdicts; None if nothing is left to try."""
        ...


def course_proposal(row: str, bv: str, delay: float, course: PrescribedMotion) -> Proposal:
    """An attack that is a motion given in advance. ``delay`` [s]: of the encounter; ``bv``: one of its targets."""
    return Proposal(bv, row, Planner(row, "course", "", (), row), {}, 0.0, delay, by=row, course=course)


def counts(verdict: Mapping[str, Any]) -> bool:
    """``Verdict.counts`` of a stored verdict: feasible and not rear-end."""
    return bool(verdict.get("feasible")) and not verdict.get("rear_end")
