"""Define the types of the benchmark: an encounter of a suite, what an opponent sees and answers, a cell of a table."""

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
"""The name of the row of unattacked runs."""
CRITICAL_TTC_S = 1.0
"""An unattacked run with at most this minimum TTC is critical by itself. It is the default of ``--critical-ttc``."""
MIN_TTC_CAP_S = 10.0
"""Larger minimum TTCs count as this value, and so does the minimum TTC of a motion that does not count."""

Cell = Mapping[str, Any]
"""The outcome of one case, ego, row and seed. ``docs/benchmark.md`` lists its keys."""


@dataclass(frozen=True, slots=True)
class SuiteCase:
    """One encounter of a suite.

    Attributes:
        name: The name.
        path: The input.
        record: The id of a Waymo record in ``path``; None for other inputs.
        kind: The kind of encounter.
        group: One of ``GROUPS``.
        labels: The most dangerous intents according to an oracle or to people, by ego and criterion: ``{"idm":
            {"collision": (..), "valid": (..)}}``.
    """

    name: str
    path: Path
    record: str | None
    kind: str
    group: str
    labels: Mapping[str, Mapping[str, tuple[str, ...]]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Suite:
    """A frozen list of encounters.

    Attributes:
        name: The name.
        version: The version.
        cases: The encounters.
        content: The SHA-256 of all its files.
    """

    name: str
    version: str
    cases: tuple[SuiteCase, ...]
    content: str


@dataclass(frozen=True, slots=True)
class Encounter:
    """What an opponent sees of an encounter.

    Attributes:
        situations: A situation for each delay [s] after the trigger at which an attack may begin.
        library: The intents and planners.
        drivable: The drivable area.
        settings: The settings of the row.
        seed: The seed.
        network: The net.xml, for more of the road than the situations have.
    """

    situations: Mapping[float, Situation]
    library: Sequence[LibraryEntry]
    drivable: Drivable
    settings: Settings
    seed: int
    network: Path


class Opponent(Protocol):
    """Makes attacks. It is asked for attacks until one succeeds or the budget is used up."""

    name: str

    def begin(self, encounter: Encounter) -> None:
        """Begin an encounter.

        Each encounter has a new opponent, so nothing is kept from other encounters.

        Args:
            encounter: The encounter.
        """
        ...

    def propose(self, tried: Sequence[Attempt]) -> Proposal | None:
        """Return the next attack.

        Args:
            tried: The attempts so far, with the verdicts of the gates.

        Returns:
            The attack, or None if nothing is left to try.
        """
        ...


def course_proposal(row: str, bv: str, delay: float, course: PrescribedMotion) -> Proposal:
    """Make an attack from a motion that is given in advance.

    Args:
        row: The name of the row.
        bv: The adversary, one of the encounter's targets.
        delay: The start of the motion, a delay of the encounter [s].
        course: The motion.

    Returns:
        The candidate.
    """
    return Proposal(bv, row, Planner(row, "course", "", (), row), {}, 0.0, delay, by=row, course=course)


def counts(verdict: Mapping[str, Any]) -> bool:
    """Return ``Verdict.counts`` of a stored verdict: whether it is feasible and not rear-end."""
    return bool(verdict.get("feasible")) and not verdict.get("rear_end")
