"""What an ego controller gets, what it may answer, and what it asks of the engine by attributes of its class.

Before each step of the simulation, ``act`` gets an ``Observation``. Its answer says how the ego moves during that step,
from ``time`` to ``time + dt``.

All distances called *ahead* are metres along the ego's path from the centre of its box; its front bumper is half its
length nearer. Points are in the world frame [m].
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Protocol, TypeAlias

from sumo_adv.datatypes import DriverModel, Floats, VehicleState
from sumo_adv.errors import UsageError
from sumo_adv.geometry import Pose, wrap


class Senses(Protocol):
    """What tells more of a vehicle, by its id, in one step."""

    def kind(self, vehicle: str) -> str: ...

    def yaw_rate(self, vehicle: str) -> float: ...

    def indicator(self, vehicle: str) -> str | None: ...

    def brake_light(self, vehicle: str) -> bool: ...

    def visible(self, vehicle: str) -> bool: ...


@dataclass(frozen=True)
class Vehicle(VehicleState):
    """Another vehicle. In a run the attributes below are worked out when they are first read.

    Without ``senses`` (in tests of your own) they have the values of a visible passenger car that goes straight on.
    """

    senses: Senses | None = field(default=None, repr=False, compare=False)

    @cached_property
    def kind(self) -> str:
        """SUMO's vehicle class (``passenger``, ``truck``, ``bus``, ``bicycle``, ``pedestrian`` ...); ``obstacle`` for
        another object of a recording or a scenario."""
        return "passenger" if self.senses is None else self.senses.kind(self.id)

    @cached_property
    def yaw_rate(self) -> float:
        """Change of its heading in the last step [rad/s], left positive."""
        return 0.0 if self.senses is None else self.senses.yaw_rate(self.id)

    @cached_property
    def indicator(self) -> str | None:
        """``left`` or ``right`` while it indicates one, else None."""
        return None if self.senses is None else self.senses.indicator(self.id)

    @cached_property
    def brake_light(self) -> bool:
        """Whether its brake lights are on."""
        return False if self.senses is None else self.senses.brake_light(self.id)

    @cached_property
    def visible(self) -> bool:
        """Whether a line from the ego's centre to its centre or one of its corners passes through no other vehicle."""
        return True if self.senses is None else self.senses.visible(self.id)


@dataclass(frozen=True, slots=True, eq=False)
class Lane:
    """One lane for vehicles or cycles. Equal only to itself.

    centre: ``(n, 2)`` in its direction of travel; width [m]; limit: the posted one [m/s].
    relation: ``route`` (the ego's path follows it), ``crossing`` (it crosses the path or joins it on a junction), else
    by its direction where it is nearest to the path: ``beside`` (within 45 degrees of the path's), ``oncoming`` (within
    45 degrees of the opposite) or ``crossing``.
    left, right: ids of the next lanes of the same edge, None if there is none. junction: it lies within a junction.
    allowed: a vehicle of the ego's class may use it now; a bus lane is told to a car, and is not for it.
    successors, predecessors: ids of the lanes after and before it, through junctions lane by lane; also those too far
    away to be told. opposite_left, opposite_right: id of the lane of the opposite direction that shares its left or
    right boundary, None if there is none.
    """

    id: str
    centre: Floats
    width: float
    limit: float
    relation: str
    left: str | None = None
    right: str | None = None
    junction: bool = False
    allowed: bool = True
    successors: tuple[str, ...] = ()
    predecessors: tuple[str, ...] = ()
    opposite_left: str | None = None
    opposite_right: str | None = None

    @property
    def on_route(self) -> bool:
        """Whether the ego's path follows it."""
        return self.relation == "route"


@dataclass(frozen=True, slots=True)
class SpeedLimit:
    """A posted speed limit [m/s] that holds from ``ahead`` [m] on (negative: it holds already)."""

    ahead: float
    speed: float


@dataclass(frozen=True, slots=True)
class StopLine:
    """A line before or on a junction at which the ego's path has a traffic light, or has to give way.

    ahead: to the line [m]. signal: ``green``, ``yellow``, ``red``, or None if there is no light or it is off.
    sign: ``yield`` or ``stop`` where the ego has to give way while the light, if there is one, lets it go; else None.
    must_wait: the ego must not pass the line now (``docs/ego.md`` has the rule).
    """

    ahead: float
    signal: str | None = None
    sign: str | None = None
    must_wait: bool = False


@dataclass(frozen=True, slots=True)
class Conflict:
    """A place on a junction where the ego's path meets another lane.

    ahead [m]; lane: id of the other lane; x, y [m]; ego_yields: vehicles that come on it go first, by signs and lights
    now. joins: the other lane ends there in the lane that the ego enters, else it crosses.
    """

    ahead: float
    lane: str
    x: float
    y: float
    ego_yields: bool
    joins: bool


@dataclass(frozen=True)
class Road:
    """The road at the ego. In a run an attribute is worked out when it is first read in a step, and costs nothing else.

    limit: the fastest that the ego's SUMO type goes here [m/s]: the posted limit times ``speedFactor``, at most
    ``maxSpeed``. sides: centres of the lanes beside the ego's that lead the same way, as offsets from its lane
    [m, left positive], for the next ``until`` metres. width: of the ego's lane [m].
    leaves: SUMO will remove the ego within a few metres, at its ``arrivalPos`` or the end of its route.

    lanes: all lanes for motor vehicles or cycles within 120 m of the ego; ``allowed`` says whether the ego may use it
    now. edges: the boundary of the paved ground within 120 m, lines ``(n, 2)``. limits, stop_lines, conflicts: on the
    path within 120 m, nearest first. ``lanes`` and ``edges`` stay the same objects until the ego has gone 10 m or its
    route changes; ``lanes`` is made again where a limit changes or a lane closes, too. Limits are those of now. A lane
    that the ego's class may not use now is not in ``sides``.

    advised: with ``needs_road`` and ``Steer`` alone: the speed [m/s] that SUMO's driver would have chosen in the last
    step, with regard to lights, right of way and leaders; at most the speed that the controller asked for. None while
    the ego stands at a line.
    """

    limit: float
    sides: tuple[float, ...] = ()
    until: float = 0.0
    width: float = 3.2
    advised: float | None = None
    leaves: bool = False
    lanes: tuple[Lane, ...] = ()
    edges: tuple[Floats, ...] = ()
    limits: tuple[SpeedLimit, ...] = ()
    stop_lines: tuple[StopLine, ...] = ()
    conflicts: tuple[Conflict, ...] = ()

    @property
    def must_wait(self) -> bool:
        """Whether the ego must not pass the next stop line now."""
        return bool(self.stop_lines) and self.stop_lines[0].must_wait


@dataclass(frozen=True, slots=True)
class Observation:
    """What the driver sees at ``time`` [s, of the simulation]; the step to come lasts ``dt`` [s].

    others: vehicles within 120 m, box centres in the world frame; in a run each is a ``Vehicle``. The ego's lane is the
    one of its route that is nearest to it, whatever lane SUMO takes it to be on. lane_heading: of that lane at the ego
    [rad]. lane_offset: of the ego's centre from the lane's centre [m, left positive]. path: points [m] on the
    centreline of that lane and of the route, from the ego (or a few metres before) to at least 60 m ahead. road: the
    map at the ego. These four are None where they are not known, as off the road. ``path``, ``road`` and
    each ``Vehicle`` must be read in the ``act`` that got them: later what was not read yet is refused.
    """

    time: float
    dt: float
    ego: VehicleState
    others: Sequence[VehicleState]
    lane_heading: float | None = None
    lane_offset: float | None = None
    path: Sequence[tuple[float, float]] | None = None
    road: Road | None = None


Points: TypeAlias = Sequence[tuple[float, float]]
"""(x, y) [m] in the world frame."""


@dataclass(frozen=True, slots=True)
class Steer:
    """Pedals and wheel.

    Attributes:
        acceleration: Of the car [m/s2].
        steering: Angle of the front wheels [rad, left positive].
        plan: Where the driver plans to go from here, for pages and exports. It changes nothing in the simulation.
        notes: Numbers by name that a person wants to see beside the motion, such as costs.
    """

    acceleration: float
    steering: float
    plan: Points | None = None
    notes: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class LaneSpeed:
    """SUMO keeps the lane. ``lane``: the lane to change to (SUMO's index: from the right, in left-hand traffic from the
    left; None = stay); ``speed``: after the step [m/s].

    SUMO goes slower than asked where its rules demand it (safe distance, red light). The ego can brake harder than its
    vType's ``decel``, up to ``emergencyDecel``. While a speed is asked for, SUMO's own rules may use
    ``emergencyDecel``, too. ``plan`` and ``notes`` are those of ``Steer``.
    """

    lane: int | None
    speed: float
    plan: Points | None = None
    notes: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class PlannedPose(Pose):
    """A ``Pose`` with what the driver planned; ``plan`` and ``notes`` are those of ``Steer``."""

    plan: Points | None = None
    notes: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DriverInside:
    """What a driver showed of its inside with one answer.

    Attributes:
        time: When it was asked [s].
        plan: Where it planned to go; empty if it did not say.
        notes: Its numbers by name.
    """

    time: float
    plan: Points = ()
    notes: Mapping[str, float] = field(default_factory=dict)


Action: TypeAlias = Steer | LaneSpeed | Pose | None
"""What ``act`` returns: the ego's motion, or its ``Pose`` after the step. None leaves this step to SUMO."""


class EgoController(Protocol):
    """The driver under test.

    A driver may also have ``wishes`` (``Wishes``) and ``model_of`` (see the function ``model_of``).
    """

    @property
    def name(self) -> str:
        """What reports call it."""
        ...

    @property
    def forkable(self) -> bool:
        """Whether ``os.fork`` copies it whole, because it holds no thread, socket or device."""
        ...

    @property
    def sumo_type(self) -> Mapping[str, str]:
        """vType attributes, as SUMO spells them. SUMO drives with them where the controller does not."""
        ...

    @property
    def needs_observation(self) -> bool:
        """If False, ``act`` is never called."""
        ...

    def reset(self, seed: int) -> None:
        """Forget everything; a run begins."""
        ...

    def act(self, observation: Observation) -> Action:
        """The action for the step that begins at ``observation.time``."""
        ...


def model_of(driver: Any, numbers: DriverModel) -> DriverModel:
    """How a driver is predicted: its own ``model_of(numbers)``, or ``numbers`` if it has no such method.

    ``numbers``: an unknown driver with the ego's car-following numbers in SUMO (``Simulation.model``).
    """
    own = getattr(driver, "model_of", None)
    return numbers if own is None else own(numbers)


WHEELBASE_M = 2.8
MAX_STEERING_RAD = 0.6  # front wheel angle to either side
MAX_BRAKING_M_S2 = 9.0  # as SUMO's emergency deceleration
MAX_ACCELERATION_M_S2 = 4.0


@dataclass(frozen=True, slots=True)
class Bicycle:
    """A car's numbers. wheelbase [m]; rear_axle: from the box centre back to the rear axle [m], None = half of the
    wheelbase; max_steering: front wheel angle to either side [rad]; max_braking, max_acceleration [m/s2], positive."""

    wheelbase: float = WHEELBASE_M
    max_steering: float = MAX_STEERING_RAD
    max_braking: float = MAX_BRAKING_M_S2
    max_acceleration: float = MAX_ACCELERATION_M_S2
    rear_axle: float | None = None


DEFAULT_BICYCLE = Bicycle()


def apply_steer(state: VehicleState, steer: Steer, dt: float, bicycle: Bicycle = DEFAULT_BICYCLE) -> VehicleState:
    """``state`` after ``dt`` [s] of ``steer``, which is limited to what the ``bicycle`` can do.

    The kinematic bicycle model (Polack et al. 2017; Rajamani 2012, section 2.2, with l_r = r). Its reference point is
    the box centre, which lies r in front of the rear axle. For a steering angle d and a wheelbase L:

        slip       b = atan(r tan(d) / L)          angle between velocity and heading
        curvature  k = cos(b) tan(d) / L           of the centre's path
        travelled  s = v dt + a dt^2 / 2           up to standstill, never backwards
        heading   += k s
        position  += s sinc(k s / 2) (cos, sin)(heading + b + k s / 2)

    which is exact for constant a and d: the centre runs along a circular arc. The speed is that of the box centre;
    ``acceleration`` of the answer is the mean over the step.
    """
    rear = bicycle.wheelbase / 2 if bicycle.rear_axle is None else bicycle.rear_axle
    steering = min(max(steer.steering, -bicycle.max_steering), bicycle.max_steering)
    acceleration = min(max(steer.acceleration, -bicycle.max_braking), bicycle.max_acceleration)
    speed = max(0.0, state.speed + acceleration * dt)
    travelled = state.speed * dt + 0.5 * acceleration * dt * dt
    if acceleration < 0 and speed == 0.0:
        travelled = state.speed**2 / (-2.0 * acceleration)
    slip = math.atan(rear / bicycle.wheelbase * math.tan(steering))
    turned = math.cos(slip) * math.tan(steering) / bicycle.wheelbase * travelled
    chord = travelled if turned == 0.0 else travelled * math.sin(turned / 2) / (turned / 2)
    direction = state.heading + slip + turned / 2
    return replace(
        state,
        x=state.x + chord * math.cos(direction),
        y=state.y + chord * math.sin(direction),
        heading=wrap(state.heading + turned),
        speed=speed,
        acceleration=(speed - state.speed) / dt,
    )


MAX_PATH_AHEAD_M = 1000.0  # of the path that a driver may ask for
STEERING_LIMIT_RAD = math.pi / 2  # at this steering angle the bicycle would turn on the spot


@dataclass(frozen=True, slots=True)
class Wishes:
    """needs_road: SUMO's advice, ``Road.advised``. visible_only: ``others`` has only the vehicles in line of sight.
    sees_buildings: buildings block the view. bicycle: the car that ``Steer`` moves. path_ahead: how far ahead ``path``
    reaches at least [m]; None: 80 m."""

    needs_road: bool = False
    visible_only: bool = False
    sees_buildings: bool = False
    bicycle: Bicycle = DEFAULT_BICYCLE
    path_ahead: float | None = None


def wishes_of(controller: Any) -> Wishes:
    """A controller's ``wishes``, by default none."""
    wishes = getattr(controller, "wishes", None)
    return wishes if isinstance(wishes, Wishes) else Wishes()


def read_wishes(driver: Any, spec: str) -> Wishes:
    """The wishes of a user's driver, by attributes of the names of ``Wishes`` and ``Bicycle``.

    Raises UsageError: a number of the bicycle that is not finite or not above zero, or a steering angle of 90 degrees.
    """
    numbers: dict[str, float] = {}
    for number in fields(Bicycle):
        value = getattr(driver, number.name, None)
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < math.inf:
            raise UsageError(f"The ego {spec!r} has {number.name} = {value!r}; it must be a finite number above zero.")
        numbers[number.name] = float(value)
    if numbers.get("max_steering", 0.0) >= STEERING_LIMIT_RAD:
        raise UsageError(
            f"The ego {spec!r} has max_steering = {numbers['max_steering']:g} rad; it must be below pi / 2."
        )
    flags = {name: bool(getattr(driver, name, False)) for name in ("needs_road", "visible_only", "sees_buildings")}
    ahead = getattr(driver, "path_ahead", None)
    if ahead is not None and (
        isinstance(ahead, bool) or not isinstance(ahead, int | float) or not 0.0 < ahead <= MAX_PATH_AHEAD_M
    ):
        raise UsageError(
            f"The ego {spec!r} has path_ahead = {ahead!r}; it must be a number of metres, above 0 and at most "
            f"{MAX_PATH_AHEAD_M:g}."
        )
    return Wishes(**flags, bicycle=Bicycle(**numbers), path_ahead=None if ahead is None else float(ahead))
