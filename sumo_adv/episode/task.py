"""What the front and the engine exchange: the task, the encounter, the results of attempts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sumo_adv.config import Settings
from sumo_adv.datatypes import Ending, Role, Verdict
from sumo_adv.episode.attempt import Driven
from sumo_adv.simulation.inputs import EgoRoute
from sumo_adv.simulation.network import Drivable
from sumo_adv.simulation.playback_spec import PlaybackSpec
from sumo_adv.simulation.simulation import SimulationSpec, Snapshot
from sumo_adv.situation import Situation


@dataclass(frozen=True, slots=True)
class Task:
    """What the engine is opened with. ``ego``: an id, a route to insert it on, or None to choose one. Times in s."""

    spec: SimulationSpec
    settings: Settings
    ego: str | EgoRoute | None
    ego_base_type: str | None
    ego_driver: str
    ego_parameters: Mapping[str, Any]
    only: tuple[str, ...]
    trigger: float | None
    warm_up: float
    end: float
    playback: PlaybackSpec | None = None

    def roles(self, ego: str, adversary: str | None = None) -> dict[str, Role]:
        """The roles of all vehicles but background vehicles."""
        obstacles = frozenset[str]() if self.playback is None else self.playback.obstacles
        others = {} if adversary is None else {adversary: Role.ADVERSARY}
        return {**dict.fromkeys(obstacles, Role.OBSTACLE), **others, ego: Role.EGO}


@dataclass(frozen=True, slots=True)
class FoundEncounter:
    """An encounter: its ego and time [s], the ranking, a situation for each delay [s], and the baseline."""

    ego: str
    time: float
    ranking: tuple[tuple[str, str, float], ...]  # id, relation, risk
    situations: Mapping[float, Situation]
    baseline: Sequence[Snapshot]  # the states without an attack, from the trigger on; empty if only foreseen
    passed_over: tuple[str, ...]
    drivable: Drivable
    sizes: Mapping[str, tuple[float, float]]
    area: tuple[float, float, float]  # x, y, radius [m] of the circle in which ``drivable`` is known
    last: bool = False  # no other encounter comes

    @property
    def first(self) -> Situation:
        """The situation of the least delay."""
        return self.situations[min(self.situations)]


@dataclass(frozen=True, slots=True)
class NoEncounter:
    """Why there is no encounter."""

    ending: Ending
    reason: str


@dataclass(frozen=True, slots=True)
class AttemptResult:
    """The result of one attempt; ``start`` [s]: the takeover of the adversary, ``snapshots``: from the trigger on."""

    driven: Driven
    verdict: Verdict | None
    start: float
    snapshots: Sequence[Snapshot] = field(repr=False, default=())
    sizes: Mapping[str, tuple[float, float]] = field(repr=False, default_factory=dict)


@dataclass(frozen=True, slots=True)
class Prefix:
    """The simulation from its start to the trigger, and the sizes of all vehicles."""

    snapshots: Sequence[Snapshot]
    sizes: Mapping[str, tuple[float, float]]
