"""Define what the front and the engine exchange: the task, the encounter, and the results of attempts."""

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
from sumo_adv.ego_way import EgoMove, SightStretch
from sumo_adv.episode.attempt import Driven
from sumo_adv.episode.drive import EgoActions
from sumo_adv.errors import UsageError
from sumo_adv.metrics.reference.sight import SightLimits
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
    """What the engine simulates.

    Attributes:
        spec: How SUMO is started.
        settings: The run's settings.
        ego: The ego's id, the route on which an ego is inserted, or None to choose an ego.
        ego_base_type: The vehicle type of an inserted ego; None means SUMO's default type.
        ego_driver: The name of the ego's driver.
        ego_parameters: The parameters of the driver.
        only: The ids of the vehicles that may be adversaries; empty means all.
        trigger: The time of the trigger [s]; None to search for encounters.
        warm_up: The time after the ego's insertion during which no trigger is sought [s]. If the engine chooses the
            ego, it chooses none during this time after the start.
        end: The end of the simulation [s].
        playback: The recording that is played back; None if there is none.
        ego_given: The driver, if it was given as a class or an object; otherwise None.
        driven_from: The earliest time at which the driver takes over the ego [s]; None means as soon as the ego is
            there.
        driven_before: The vehicles that the driver drives before the ego: id, takeover [s] and release [s].
        delay: The only delay after the trigger at which an attack may begin [s]; None means those of
            ``settings.delays``.
        colliders: The ids of the vehicles that may be the collider; empty means all.
        copies: The user's file by the copy that SUMO reads instead.
        moves: The ego's own moves.
        sight: The stretches of the ego's way from which it sees less far.
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
    moves: tuple[EgoMove, ...] = ()
    sight: tuple[SightStretch, ...] = ()

    def own_names(self, warnings: Sequence[str]) -> tuple[str, ...]:
        """Replace the names of copies in SUMO's warnings by those of the user's files.

        Args:
            warnings: The warnings.
        """
        return tuple(with_names(text, self.copies) for text in warnings)

    def roles(self, ego: str, *adversaries: str) -> dict[str, Role]:
        """Return the roles of the ego, the adversaries and recorded obstacles by id.

        Args:
            ego: The ego's id.
            adversaries: The ids of the adversaries.
        """
        obstacles = frozenset[str]() if self.playback is None else self.playback.obstacles
        return {
            **dict.fromkeys(obstacles, Role.OBSTACLE), **dict.fromkeys(adversaries, Role.ADVERSARY), ego: Role.EGO
        }  # fmt: skip


@dataclass(frozen=True, slots=True)
class FoundEncounter:
    """An encounter in which an attack may begin.

    Attributes:
        ego: The ego's id.
        time: The time of the trigger [s].
        ranking: The vehicles that could attack, highest risk first: id, relation and risk.
        situations: The situation by delay of the attack after the trigger [s].
        baseline: The states without an attack, from the trigger on; empty if they were predicted and not simulated.
        passed_over: Why earlier encounters were passed over.
        drivable: The area that vehicles may drive on.
        sizes: Length and width of the vehicles by id [m].
        area: The circle in which ``drivable`` is known: x, y and radius [m].
        last: Whether no other encounter follows.
        place: What surrounds the ego; None if this was not determined.
        driven_from: The time at which the ego's driver took over [s]; None if a client of ``serve`` drives the ego.
        driven_before: The vehicles that the driver drove before the ego: id, takeover [s] and release [s].
        beside: The recorded vehicles on which SUMO crashes. They are played back as boxes beside SUMO.
        sight: How far the ego sees along its way; None without a limit.
    """

    ego: str
    time: float
    ranking: tuple[tuple[str, str, float], ...]
    situations: Mapping[float, Situation]
    baseline: Sequence[Snapshot]
    passed_over: tuple[str, ...]
    drivable: Drivable
    sizes: Mapping[str, tuple[float, float]]
    area: tuple[float, float, float]
    last: bool = False
    place: RoadPlace | None = None
    driven_from: float | None = None
    driven_before: Sequence[tuple[str, float, float]] = ()
    beside: tuple[str, ...] = ()
    sight: SightLimits | None = None

    @property
    def first(self) -> Situation:
        """The situation with the smallest delay."""
        return self.situations[min(self.situations)]

    def half_lane(self, start: float) -> float:
        """Return half the width of the ego's lane at the start of an attack [m].

        Args:
            start: The time of the takeover [s].
        """
        delay = max((d for d in self.situations if self.time + d <= start + 1e-6), default=min(self.situations))
        return self.situations[delay].road.lane_width / 2


@dataclass(frozen=True, slots=True)
class NoEncounter:
    """Why the engine found no encounter.

    Attributes:
        ending: How the search ended.
        reason: Why, as a sentence.
    """

    ending: Ending
    reason: str


@dataclass(frozen=True, slots=True)
class AttemptResult:
    """The result of one attempt.

    Attributes:
        driven: How the attempt went.
        verdict: The verdict on the attempt; None if it could not be judged.
        start: The time at which the adversaries were taken over [s]; the trigger if the attempt crashed.
        snapshots: The states from the trigger on; empty if they were not kept.
        sizes: Length and width of the vehicles by id [m].
        actions: What the ego's driver answered since it took over; None if a client of ``serve`` drives the ego, or if
            the attempt crashed.
        inside: What the driver showed of its inside since it took over.
    """

    driven: Driven
    verdict: Verdict | None
    start: float
    snapshots: Sequence[Snapshot] = field(repr=False, default=())
    sizes: Mapping[str, tuple[float, float]] = field(repr=False, default_factory=dict)
    actions: EgoActions | None = None
    inside: Sequence[DriverInside] = field(repr=False, default=())

    def tracks(self, step: float, *only: str) -> dict[str, Track]:
        """Return the recorded motions by id.

        Args:
            step: The step of the simulation [s].
            only: The ids of the vehicles; without ids, all vehicles.
        """
        return {t.id: t for t in tracks_of(self.snapshots, self.sizes, {}, step, only or None)}


@dataclass(frozen=True, slots=True)
class Prefix:
    """The simulation before an encounter.

    Attributes:
        snapshots: The states from the start to the trigger.
        sizes: Length and width of all vehicles by id [m].
    """

    snapshots: Sequence[Snapshot]
    sizes: Mapping[str, tuple[float, float]]


def refuse_density(run_input: RunInput, density: float | None) -> None:
    """Refuse a density of generated traffic for an input that has its own traffic.

    Args:
        run_input: The input.
        density: The density; None if none is given.

    Raises:
        UsageError: A density is given, and the input has its own traffic.
    """
    logged = run_input.playback is not None and run_input.playback.tracks is not None
    if density is not None and (run_input.routes or logged or _drives(run_input)):
        raise UsageError(
            f"{run_input.path} brings its own traffic, so --density {density:g} would have no effect: leave it out, or "
            "give the network alone."
        )


def _drives(run_input: RunInput) -> bool:
    """Return whether additional files of an input define vehicles or flows."""
    return any(scan.vehicles or scan.flows for scan in map(scan_demand, run_input.additional))


def make_task(run_input: RunInput, settings: Settings, folder: Path) -> Task:
    """Make the engine's task for an input.

    If the input has no traffic, traffic is generated into ``folder``. Files that name other files for SUMO to read or
    write are copied into ``folder`` without those names.

    Args:
        run_input: The input.
        settings: The run's settings.
        folder: Where files are written.

    Returns:
        The task.

    Raises:
        UsageError: The level, the density, the background, SUMO's options, the end or the trigger does not fit, or a
            file is damaged or missing.
    """
    if not reachable(settings):
        raise UsageError(
            f"--until {settings.until} cannot be reached against the ego 'careful': strict means that this very driver "
            "avoids the collision; use --until valid."
        )
    refuse_density(run_input, settings.density)
    if settings.ego_id is not None and settings.ego_id != run_input.ego and (run_input.moves or run_input.sight):
        raise UsageError(f"The moves and sight of {run_input.path} are those of its own ego: leave --ego-id out.")
    _check_attackers(run_input, settings)
    routes = run_input.routes
    playback = with_background(run_input.playback, settings.background, replayed=settings.ego == "replay")
    begin = settings.begin if settings.begin is not None else run_input.begin
    driven = _drives(run_input)
    first = first_departure((*routes, *run_input.additional), begin or 0.0) if routes or driven else 0.0
    begin = first if begin is None else begin
    first = max(begin, first)
    end = settings.end if settings.end is not None else run_input.end
    end = min(end, first + settings.search) if end is not None and settings.end is None else end
    end = first + settings.search if end is None else end
    if playback is not None and (playback.follows_log or settings.ego == "replay"):
        end = min(end, playback.end)  # the log ends here
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
        _adversaries(colliders, run_input.supports, settings.adversaries, together=bool(run_input.attackers)),
        None if trigger == "auto" else float(trigger), run_input.warm_up, end, playback,
        colliders=colliders, copies=copies, moves=run_input.moves, sight=run_input.sight,
    )  # fmt: skip


def empty_steps(begin: float, first: float, step: float) -> int:
    """Count the whole steps of a simulation before the first departure, less one.

    Args:
        begin: The begin of the simulation [s].
        first: The time of the first departure [s].
        step: The step of the simulation [s].

    Returns:
        The number of steps.
    """
    return max(0, math.floor((first - begin) / step) - 1)


def _check_attackers(run_input: RunInput, settings: Settings) -> None:
    """Check that all attackers that an input names can attack together."""
    count = len(run_input.attackers)
    if count and settings.adversary:
        raise UsageError(f"{run_input.path} says which {count} vehicles attack: leave out --adversary.")
    if count and settings.ask:
        raise UsageError(f"{run_input.path} says what its {count} attackers do: leave out --ask.")
    if count > settings.adversaries:
        raise UsageError(f"In {run_input.path} {count} vehicles attack together: give --adversaries {count} or more.")


def _adversaries(
    colliders: tuple[str, ...], supports: tuple[str, ...], most: int, *, together: bool
) -> tuple[str, ...]:  # fmt: skip
    """Return the vehicles that may be adversaries; empty means all.

    If several adversaries are allowed and no supports are named, any vehicle may be a support. If the scene says which
    vehicles attack together, no other vehicle may.
    """
    if most == 1 or not colliders or (together and not supports):
        return colliders
    return (*colliders, *(name for name in supports if name not in colliders)) if supports else ()
