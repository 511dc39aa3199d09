"""Define what the engine process of an episode can be asked for: its calls, and what crosses between it and the front.

``worker.py:EpisodeWorker`` implements the methods of ``EpisodeCalls``. The front calls them as
``engine.call(EpisodeCalls.seek, "")``, and does not load the modules that only the engine process needs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Protocol, TypeAlias

from sumo_adv.datatypes import LaneStrip, Preventability, Proposal
from sumo_adv.drivers.timing import DriverTime
from sumo_adv.episode.task import AttemptResult, FoundEncounter, NoEncounter, Prefix, Task
from sumo_adv.planners.answers import AskOne, PlannerObservation
from sumo_adv.simulation.engine import Engine

if TYPE_CHECKING:
    from sumo_adv.episode.open_encounter import OpenEncounter


@dataclass(frozen=True, slots=True)
class PlannerQuestion:
    """A question of an attempt to a planner, which the front answers in its sandbox.

    Attributes:
        index: The index of the attempt among those of the call, or of the reference driver in ``REFERENCE_DRIVERS``.
        member: The index of the adversary among the proposal's members.
        observation: What the planner sees.
    """

    index: int
    member: int
    observation: PlannerObservation


Director: TypeAlias = "Callable[[OpenEncounter, Connection, AskOne], Callable[[], None]]"
"""Returns a function that makes an attempt which the front directs.

It gets the encounter at its trigger, the connection to the front, and a function that asks the planner of the attempt's
proposal in the front's sandbox. The front sends None at the end.
"""


class EpisodeCalls(Protocol):
    """The calls of an episode. ``open`` comes first, then ``seek``. The others concern the encounter that it finds."""

    def open(self, task: Task) -> None:
        """Start SUMO.

        Args:
            task: What to simulate.

        Raises:
            SimulationError: SUMO does not start.
            UsageError: The task cannot be run.
        """

    def forks(self) -> bool:
        """Return whether attempts run in forks. Otherwise the simulation is loaded again for each attempt."""

    def driver_time(self) -> DriverTime | None:
        """Return how long the driver's answers took so far, in all forks; None if SUMO drives the ego."""

    def seek(self, passed_over: str = "", within: float = math.inf) -> FoundEncounter | NoEncounter:
        """Simulate until an encounter with a harmless baseline begins, or until none can come.

        Args:
            passed_over: Why the last encounter is not attacked; empty at first.
            within: The time after which none is sought any more [s].

        Returns:
            The encounter, or why there is none.
        """

    def unattacked_seconds(self) -> float:
        """Return how long the runs without an attack took so far [s]."""

    def prefix(self) -> Prefix:
        """Return the simulation from its start to the trigger."""

    def lanes(self, x: float, y: float, radius: float) -> list[LaneStrip]:
        """Return all lanes near a place, for pictures.

        Args:
            x: The x of the place [m].
            y: The y of the place [m].
            radius: The distance from the place [m].
        """

    def attempts(self, plans: Sequence[Proposal]) -> list[AttemptResult]:
        """Simulate attempts from the trigger on.

        As many attempts run at the same time as there are slots. Questions to planners come as ``PlannerQuestion``. An
        attempt has the ending ``crashed`` if SUMO dies in it and again when it is repeated, or if the ego's driver does
        not let it end.

        Args:
            plans: The candidates.

        Returns:
            The results, in the order of ``plans``.
        """

    def references(
        self, proposal: Proposal, result: AttemptResult, known: Mapping[str, str], all_drivers: bool
    ) -> Preventability | None:
        """Return which reference drivers avoid the collision of an attempt, kinematically and in the loop.

        In the loop ``cc_human`` drives first. The others that make a collision valid drive only if ``cc_human`` fails.

        Args:
            proposal: The attempt's proposal.
            result: The attempt's result.
            known: The answers of reference drivers that have driven in the loop before. They do not drive again.
            all_drivers: Whether all reference drivers that avoid the collision kinematically drive in the loop.

        Returns:
            The answers; None if no collision counts, or if SUMO dies.
        """

    def directed_attempt(self, prepare: Director) -> None:
        """Simulate an attempt that the front directs, from the trigger on.

        The front sends its messages in the first slot, and answers the planner's questions in the second.

        Args:
            prepare: Is called before the fork. What it returns is called in the fork.
        """


EpisodeEngine: TypeAlias = Engine[EpisodeCalls]


def episode_worker(slots: list[Connection]) -> EpisodeCalls:
    """Make the worker of an episode, in its process.

    Args:
        slots: The connections of forks to the front.
    """
    from sumo_adv.episode.worker import EpisodeWorker

    return EpisodeWorker(slots)
