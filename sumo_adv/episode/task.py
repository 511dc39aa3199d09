"""What the front and the engine exchange: the task, the encounter, the results of attempts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sumo_adv.config import Settings, reachable
from sumo_adv.datatypes import Ending, RoadPlace, Role, Track, Verdict
from sumo_adv.drivers.protocol import DriverInside
from sumo_adv.drivers.registry import GivenEgo
from sumo_adv.episode.attempt import Driven
from sumo_adv.episode.drive import EgoActions
from sumo_adv.errors import UsageError
from sumo_adv.simulation.demand import generate_demand
from sumo_adv.simulation.inputs import EgoRoute, RunInput
from sumo_adv.simulation.network import Drivable
from sumo_adv.simulation.playback_spec import PlaybackSpec, with_background
from sumo_adv.simulation.scan import first_departure, scan_demand, silent_copies
from sumo_adv.simulation.simulation_spec import SimulationSpec
from sumo_adv.simulation.sumo_options import DEFAULTS, refuse
from sumo_adv.simulation.sumo_states import Snapshot
from sumo_adv.simulation.tracks import tracks_of
from sumo_adv.simulation.warnings_log import with_names
from sumo_adv.situation import Situation


@dataclass(frozen=True, slots=True)
class Task:
    """What the engine is opened with. ``ego``: an id, a route to insert it on, or None to choose one. Times in s.

    ego_driver: its name; ego_given: the driver itself where it was given as a class or an object.
    driven_from: the earliest time at which the driver takes over the ego, None = as soon as the ego is there.
    driven_before: vehicles that it drives before, with the times at which it takes over and releases each.
    delay: the only delay after the trigger at which an attack may begin; None = those of ``delays``.
    copies: the user's file by the copy that SUMO reads instead.
    only: the vehicles that may be adversaries; colliders: those that may be the collider. Empty means all.
    """

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
    ego_given: GivenEgo | None = field(default=None, repr=False)
    driven_from: float | None = None
    driven_before: Sequence[tuple[str, float, float]] = ()
    delay: float | None = None
    colliders: tuple[str, ...] = ()
    copies: Mapping[str, str] = field(default_factory=dict)

    def own_names(self, warnings: Sequence[str]) -> tuple[str, ...]:
        """SUMO's warnings with the names of the user's files instead of those of copies."""
        return tuple(with_names(text, self.copies) for text in warnings)

    def roles(self, ego: str, *adversaries: str) -> dict[str, Role]:
        """The roles of all vehicles but background vehicles."""
        obstacles = frozenset[str]() if self.playback is None else self.playback.obstacles
        return {
            **dict.fromkeys(obstacles, Role.OBSTACLE), **dict.fromkeys(adversaries, Role.ADVERSARY), ego: Role.EGO
        }  # fmt: skip


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
    place: RoadPlace | None = None  # what surrounds the ego
    driven_from: float | None = None  # when the ego's driver took over [s]; None where a program of its own drives
    driven_before: Sequence[tuple[str, float, float]] = ()  # what it drove before: id, from and until [s]
    beside: tuple[str, ...] = ()  # recorded vehicles that SUMO crashes on: boxes beside it

    @property
    def first(self) -> Situation:
        """The situation of the least delay."""
        return self.situations[min(self.situations)]

    def half_lane(self, start: float) -> float:
        """Half the width of the ego's lane [m] when an attack begins that takes over at ``start`` [s]."""
        delay = max((d for d in self.situations if self.time + d <= start + 1e-6), default=min(self.situations))
        return self.situations[delay].road.lane_width / 2


@dataclass(frozen=True, slots=True)
class NoEncounter:
    ending: Ending
    reason: str


@dataclass(frozen=True, slots=True)
class AttemptResult:
    """The result of one attempt; ``start`` [s]: the takeover of the adversary, ``snapshots``: from the trigger on.
    actions: the answers of the ego's driver since it took over; None where a program of its own drives it. inside: what
    it showed of its inside since it took over."""

    driven: Driven
    verdict: Verdict | None
    start: float
    snapshots: Sequence[Snapshot] = field(repr=False, default=())
    sizes: Mapping[str, tuple[float, float]] = field(repr=False, default_factory=dict)
    actions: EgoActions | None = None
    inside: Sequence[DriverInside] = field(repr=False, default=())

    def tracks(self, step: float, *only: str) -> dict[str, Track]:
        """The recorded motions by id, of these vehicles or of all; ``step``: of the simulation [s]."""
        return {t.id: t for t in tracks_of(self.snapshots, self.sizes, {}, step, only or None)}


@dataclass(frozen=True, slots=True)
class Prefix:
    """The simulation from its start to the trigger, and the sizes of all vehicles."""

    snapshots: Sequence[Snapshot]
    sizes: Mapping[str, tuple[float, float]]


def refuse_density(run_input: RunInput, density: float | None) -> None:
    """Raises UsageError if an input with traffic of its own is given a density of generated traffic."""
    logged = run_input.playback is not None and run_input.playback.tracks is not None
    if density is not None and (run_input.routes or logged or _drives(run_input)):
        raise UsageError(
            f"{run_input.path} brings its own traffic, so --density {density:g} would have no effect: leave it out, or "
            "give the network alone."
        )


def _drives(run_input: RunInput) -> bool:
    """Whether additional files of an input hold vehicles."""
    return any(scan.vehicles or scan.flows for scan in map(scan_demand, run_input.additional))


def make_task(run_input: RunInput, settings: Settings, folder: Path) -> Task:
    """The engine's task for an input; demand is generated into ``folder`` if the input has none.

    Files from which SUMO would write others are copied into ``folder`` without that.

    Raises UsageError: the level, the end or the trigger does not fit.
    """
    if not reachable(settings):
        raise UsageError(
            f"--until {settings.until} cannot be reached against the ego 'careful': strict means that this very driver "
            "avoids the collision; use --until valid."
        )
    refuse_density(run_input, settings.density)
    routes = run_input.routes
    playback = with_background(run_input.playback, settings.background, replayed=settings.ego == "replay")
    begin = settings.begin if settings.begin is not None else run_input.begin
    driven = _drives(run_input)
    first = first_departure((*routes, *run_input.additional)) if routes or driven else 0.0
    begin = first if begin is None else begin
    first = max(begin, first)
    end = settings.end if settings.end is not None else run_input.end
    end = min(end, first + settings.search) if end is not None and settings.end is None else end
    end = first + settings.search if end is None else end
    if playback is not None and (playback.follows_log or settings.ego == "replay"):
        end = min(end, playback.end)  # what comes after is not in the log
    logged = playback is not None and playback.tracks is not None
    if not routes and not driven and not logged:
        seed = settings.seed if run_input.demand_seed is None else run_input.demand_seed
        density = settings.density if settings.density is not None else run_input.density
        routes = (
            generate_demand(
                run_input.network, folder / "demand.rou.xml", seed=seed, density=density, begin=begin, end=end
            ),
        )
    refuse(settings.sumo_options)
    given = (run_input.network, *routes, *run_input.additional)
    network, *files = silent_copies(given, folder)
    copies = {str(copy): str(file) for copy, file in zip((network, *files), given, strict=True) if copy != file}
    if run_input.conversion is not None:
        copies[str(network)] = str(run_input.conversion.path)
    spec = SimulationSpec(
        network, tuple(files[: len(routes)]), tuple(files[len(routes) :]), begin, settings.seed, settings.step_length,
        {**(DEFAULTS if run_input.options is None else run_input.options), **settings.sumo_options},
        0 if logged or isinstance(run_input.ego, EgoRoute) else empty_steps(begin, first, settings.step_length),
    )  # fmt: skip
    trigger = settings.trigger if settings.trigger is not None else run_input.trigger
    if end <= begin:
        raise UsageError(f"The end, {end:g} s, is not after the begin, {begin:g} s; give a later --end.")
    if trigger != "auto" and not begin <= float(trigger) < end:
        raise UsageError(f"The trigger, {trigger:g} s, is not between begin, {begin:g} s, and end, {end:g} s.")
    colliders = (settings.adversary,) if settings.adversary else run_input.candidates
    own = dict(run_input.ego_parameters) if run_input.ego_controller in (None, settings.ego) else {}
    return Task(
        spec, settings, settings.ego_id or run_input.ego, run_input.ego_type, settings.ego,
        {**own, **settings.ego_parameters},
        _adversaries(colliders, run_input.supports, settings.adversaries),
        None if trigger == "auto" else float(trigger), run_input.warm_up, end, playback,
        colliders=colliders, copies=copies,
    )  # fmt: skip


def empty_steps(begin: float, first: float, step: float) -> int:
    """The whole steps [s] of a simulation from its begin to the last but one before anything departs, at ``first``
    [s]."""
    return max(0, math.floor((first - begin) / step) - 1)


def _adversaries(colliders: tuple[str, ...], supports: tuple[str, ...], most: int) -> tuple[str, ...]:
    """The vehicles that may be adversaries, empty for all: where supports are not named, any vehicle may be one."""
    if most == 1 or not colliders:
        return colliders
    return (*colliders, *(name for name in supports if name not in colliders)) if supports else ()
