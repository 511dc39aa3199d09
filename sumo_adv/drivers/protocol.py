"""The protocol of an ego controller: what it gets, what it may answer, and what it can ask of the engine.

Before each step of the simulation, ``act`` gets an ``Observation``. Its answer, an ``Action``, says how the ego moves
during that step, from ``time`` to ``time + dt``. With its attribute ``wishes``, a controller asks for more
(``Wishes``).

Distances called *ahead* are metres along the ego's path from the centre of its box; its front bumper is nearer by half
its length. Points are in the world frame [m].
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
    """Tells more about a vehicle, by its id, in one step. The attributes of ``Vehicle`` come from here."""

    def kind(self, vehicle: str) -> str: ...

    def yaw_rate(self, vehicle: str) -> float: ...

    def indicator(self, vehicle: str) -> str | None: ...

    def brake_light(self, vehicle: str) -> bool: ...

    def visible(self, vehicle: str) -> bool: ...


@dataclass(frozen=True)
class Vehicle(VehicleState):
    """Another vehicle: its motion, and more that a driver can see.

    In a run, the attributes below are computed when they are first read. Without ``senses``, as in tests of your own,
    they have the values of a visible passenger car that goes straight on.

    Attributes:
        senses: The source of the attributes below; the engine sets it.
    """

    senses: Senses | None = field(default=None, repr=False, compare=False)

    @cached_property
    def kind(self) -> str:
        """SUMO's vehicle class: ``passenger``, ``truck``, ``bus``, ``bicycle``, ``pedestrian`` and others.

        ``obstacle`` is any other object of a recording or a scenario.
        """
        return "passenger" if self.senses is None else self.senses.kind(self.id)

    @cached_property
    def yaw_rate(self) -> float:
        """Change of the vehicle's heading in the last step [rad/s], left positive."""
        return 0.0 if self.senses is None else self.senses.yaw_rate(self.id)

    @cached_property
    def indicator(self) -> str | None:
        """``left`` or ``right`` while the vehicle indicates that direction; otherwise None."""
        return None if self.senses is None else self.senses.indicator(self.id)

    @cached_property
    def brake_light(self) -> bool:
        """Whether the vehicle's brake lights are on."""
        return False if self.senses is None else self.senses.brake_light(self.id)

    @cached_property
    def visible(self) -> bool:
        """Whether a line from the ego's centre to the vehicle's centre or a corner passes through no other vehicle."""
        return True if self.senses is None else self.senses.visible(self.id)


@dataclass(frozen=True, slots=True, eq=False)
class Lane:
    """One lane for vehicles or cycles. Two lanes are equal only if they are the same object.

    Attributes:
        id: SUMO's id of the lane.
        centre: Points of the centre line ``(n, 2)`` [m], in the lane's direction of travel.
        width: Width [m].
        limit: Posted speed limit [m/s].
        relation: How the lane lies to the ego's path. ``route``: the path follows it. ``crossing``: it crosses the path
            or joins it on a junction. Other lanes are sorted by their direction at the place nearest to the path:
            ``beside`` (within 45 degrees of the path's), ``oncoming`` (within 45 degrees of the opposite) or
            ``crossing``.
        left: Id of the next lane to the left on the same edge; None if there is none.
        right: Id of the next lane to the right on the same edge; None if there is none.
        junction: Whether the lane lies within a junction.
        allowed: Whether a vehicle of the ego's class may use the lane now. A car sees a bus lane, but may not use it.
        successors: Ids of the lanes after it. Through junctions, they follow lane by lane. They can be lanes that are
            too far away to be in ``Road.lanes``.
        predecessors: Ids of the lanes before it, in the same way.
        opposite_left: Id of the lane of the opposite direction that shares the left boundary; None if there is none.
        opposite_right: Id of the lane of the opposite direction that shares the right boundary; None if there is none.
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
        """Whether the ego's path follows the lane."""
        return self.relation == "route"


@dataclass(frozen=True, slots=True)
class SpeedLimit:
    """A posted speed limit.

    Attributes:
        ahead: Where the limit begins [m]; negative if it holds already.
        speed: The limit [m/s].
    """

    ahead: float
    speed: float


@dataclass(frozen=True, slots=True)
class StopLine:
    """A line before or on a junction at which the ego's path has a traffic light or must give way.

    Attributes:
        ahead: Distance to the line [m].
        signal: ``green``, ``yellow`` or ``red``; None if there is no light or it is off.
        sign: ``yield`` or ``stop`` if the ego must give way while the light, if there is one, lets it go; otherwise
            None.
        must_wait: Whether the ego must not pass the line now (``docs/ego.md`` has the rule).
    """

    ahead: float
    signal: str | None = None
    sign: str | None = None
    must_wait: bool = False


@dataclass(frozen=True, slots=True)
class Conflict:
    """A place on a junction at which the ego's path meets another lane.

    Attributes:
        ahead: Distance to the place [m].
        lane: Id of the other lane.
        x: Where the place is [m].
        y: Where the place is [m].
        ego_yields: Whether vehicles on the other lane go first, by the signs and lights as they are now.
        joins: Whether the other lane ends there, in the lane that the ego enters. Otherwise, it crosses that lane.
    """

    ahead: float
    lane: str
    x: float
    y: float
    ego_yields: bool
    joins: bool


@dataclass(frozen=True)
class Road:
    """The road at the ego.

    In a run, an attribute is computed when it is first read in a step. An attribute that is not read costs nothing.

    Attributes:
        limit: Maximum speed of the ego's SUMO type here [m/s]: the posted limit times ``speedFactor``, at most
            ``maxSpeed``.
        sides: Centres of the lanes beside the ego's lane that lead the same way, as offsets from the ego's lane
            [m, left positive]. A lane that the ego's class may not use now is left out.
        until: For how many metres ahead ``sides`` holds [m].
        width: Width of the ego's lane [m].
        advised: The speed that SUMO's driver would have chosen in the last step [m/s], considering lights, right of way
            and leaders. It is at most the speed that the controller asked for. It is given only with ``needs_road`` and
            answers of type ``Steer``, and is None while the ego stands at a line.
        leaves: Whether SUMO will remove the ego within a few metres, at its ``arrivalPos`` or the end of its route.
        lanes: All lanes for motor vehicles or cycles within 120 m of the ego. ``Lane.allowed`` says whether the ego may
            use a lane now. The object stays the same until the ego has gone 10 m, its route changes, a limit changes or
            a lane closes.
        edges: Boundary of the paved ground within 120 m, lines ``(n, 2)`` [m]. The object stays the same until the ego
            has gone 10 m or its route changes.
        limits: Speed limits on the path within 120 m, nearest first, as they are now.
        stop_lines: Stop lines on the path within 120 m, nearest first.
        conflicts: Conflicts on the path within 120 m, nearest first.
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
    """What the driver sees at one time.

    ``path``, ``road`` and each ``Vehicle`` must be read in the ``act`` that got them. Later, an attribute that has not
    been read yet is refused. The ego's lane is the lane of its route that is nearest to it, whatever lane SUMO assigns
    it to. ``lane_heading``, ``lane_offset``, ``path`` and ``road`` are None if they are not known, for example off the
    road.

    Attributes:
        time: Time of the simulation [s].
        dt: Length of the step to come [s].
        ego: The ego's state, box centre in the world frame.
        others: Vehicles within 120 m, box centres in the world frame; in a run, each is a ``Vehicle``.
        lane_heading: Heading of the ego's lane at the ego [rad].
        lane_offset: Offset of the ego's centre from the centre of its lane [m, left positive].
        path: Points (x, y) on the centre line of the ego's lane and of its route [m], from the ego, or a few metres
            before it, to at least 60 m ahead.
        road: The map at the ego.
        wanted_lane: SUMO's index of the lane that the scenario wants the ego to change to now, as in ``LaneSpeed``;
            None without such a demand.
        wanted_speed: The speed that the scenario wants the ego to have now, at most [m/s]; it falls at 2 m/s2 before a
            stop, and is 0 while the ego is to stand. None without such a demand.
        sight: How far ahead along its path the road lets the ego see [m], as before a crest; inf without a limit.
    """

    time: float
    dt: float
    ego: VehicleState
    others: Sequence[VehicleState]
    lane_heading: float | None = None
    lane_offset: float | None = None
    path: Sequence[tuple[float, float]] | None = None
    road: Road | None = None
    wanted_lane: int | None = None
    wanted_speed: float | None = None
    sight: float = math.inf


Points: TypeAlias = Sequence[tuple[float, float]]
"""Points (x, y) in the world frame [m]."""


@dataclass(frozen=True, slots=True)
class Steer:
    """An action of the pedals and the wheel.

    Attributes:
        acceleration: Acceleration of the car [m/s2].
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
    """An action that leaves lane keeping to SUMO.

    SUMO goes slower than asked if its rules demand it (safe distance, red light). The ego can brake harder than its
    vType's ``decel``, up to ``emergencyDecel``. While a speed is asked for, SUMO's own rules may use
    ``emergencyDecel``, too.

    Attributes:
        lane: SUMO's index of the lane to change to, counted from the right, in left-hand traffic from the left. None
            keeps the lane.
        speed: Speed after the step [m/s].
        plan: As in ``Steer``.
        notes: As in ``Steer``.
    """

    lane: int | None
    speed: float
    plan: Points | None = None
    notes: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class PlannedPose(Pose):
    """A ``Pose`` with the driver's plan.

    Attributes:
        plan: As in ``Steer``.
        notes: As in ``Steer``.
    """

    plan: Points | None = None
    notes: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DriverInside:
    """A driver's inner state at one answer, as far as it showed it.

    Attributes:
        time: When the driver was asked [s].
        plan: Where the driver planned to go; empty if it did not say.
        notes: The driver's numbers by name.
    """

    time: float
    plan: Points = ()
    notes: Mapping[str, float] = field(default_factory=dict)


Action: TypeAlias = Steer | LaneSpeed | Pose | None
"""What ``act`` returns: the ego's motion, or its ``Pose`` after the step. None leaves this step to SUMO."""


class EgoController(Protocol):
    """The driver under test.

    A driver may also have an attribute ``wishes`` (``Wishes``) and a method ``model_of`` (see the function
    ``model_of``).
    """

    @property
    def name(self) -> str:
        """What reports call the driver."""
        ...

    @property
    def forkable(self) -> bool:
        """Whether ``os.fork`` copies the driver completely, because it holds no thread, socket or device."""
        ...

    @property
    def sumo_type(self) -> Mapping[str, str]:
        """vType attributes, as SUMO spells them. SUMO uses them when the controller does not drive."""
        ...

    @property
    def needs_observation(self) -> bool:
        """Whether the driver needs observations. If not, ``act`` is never called."""
        ...

    def reset(self, seed: int) -> None:
        """Forget everything, because a run begins.

        Args:
            seed: Seed of the run, for drivers that draw random numbers.
        """
        ...

    def act(self, observation: Observation) -> Action:
        """Return the action for the step that begins at ``observation.time``.

        Args:
            observation: What the driver sees now.

        Returns:
            The ego's motion in this step; None leaves it to SUMO.
        """
        ...


def model_of(driver: Any, numbers: DriverModel) -> DriverModel:
    """Return the model by which a driver is predicted.

    Args:
        driver: The driver. If it has a method ``model_of(numbers)``, its result is used.
        numbers: The model of an unknown driver, with the ego's car-following numbers in SUMO (``Simulation.model``).

    Returns:
        The driver's own model, or ``numbers`` if it has no such method.
    """
    own = getattr(driver, "model_of", None)
    return numbers if own is None else own(numbers)


WHEELBASE_M = 2.8
MAX_STEERING_RAD = 0.6  # front wheel angle to either side
MAX_BRAKING_M_S2 = 9.0  # equal to SUMO's emergency deceleration
MAX_ACCELERATION_M_S2 = 4.0


@dataclass(frozen=True, slots=True)
class Bicycle:
    """The numbers of a car for the bicycle model.

    Attributes:
        wheelbase: Wheelbase [m].
        max_steering: Maximum angle of the front wheels to either side [rad].
        max_braking: Maximum deceleration [m/s2], positive.
        max_acceleration: Maximum acceleration [m/s2].
        rear_axle: Distance from the box centre back to the rear axle [m]; None = half of the wheelbase.
    """

    wheelbase: float = WHEELBASE_M
    max_steering: float = MAX_STEERING_RAD
    max_braking: float = MAX_BRAKING_M_S2
    max_acceleration: float = MAX_ACCELERATION_M_S2
    rear_axle: float | None = None


DEFAULT_BICYCLE = Bicycle()


def apply_steer(state: VehicleState, steer: Steer, dt: float, bicycle: Bicycle = DEFAULT_BICYCLE) -> VehicleState:
    """Move a vehicle by a ``Steer`` action, limited to what the ``bicycle`` can do.

    The kinematic bicycle model (Polack et al. 2017; Rajamani 2012, section 2.2, with l_r = r). Its reference point is
    the box centre, which lies r in front of the rear axle. For a steering angle d and a wheelbase L:

        slip       b = atan(r tan(d) / L)          angle between velocity and heading
        curvature  k = cos(b) tan(d) / L           of the centre's path
        travelled  s = v dt + a dt^2 / 2           up to standstill, never backwards
        heading   += k s
        position  += s sinc(k s / 2) (cos, sin)(heading + b + k s / 2)

    The result is exact for constant a and d: the centre runs along a circular arc.

    Args:
        state: The vehicle before the step, box centre.
        steer: The action.
        dt: Step [s].
        bicycle: The car's numbers.

    Returns:
        The vehicle after the step. Its speed is that of the box centre; its acceleration is the mean over the step.
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


MAX_PATH_AHEAD_M = 1000.0  # the longest path that a driver may ask for
STEERING_LIMIT_RAD = math.pi / 2  # at this steering angle the bicycle would turn on the spot


@dataclass(frozen=True, slots=True)
class Wishes:
    """What a controller asks of the engine.

    Attributes:
        needs_road: Whether the driver needs SUMO's advice, ``Road.advised``.
        visible_only: Whether ``others`` has only the vehicles in line of sight.
        sees_buildings: Whether buildings block the view.
        bicycle: The car that ``Steer`` moves.
        path_ahead: How far ahead ``path`` reaches at least [m]; None means 80 m.
        makes_moves: Whether a ``LaneSpeed`` of the driver already makes the ego's moves. Otherwise SUMO carries them
            out.
    """

    needs_road: bool = False
    visible_only: bool = False
    sees_buildings: bool = False
    bicycle: Bicycle = DEFAULT_BICYCLE
    path_ahead: float | None = None
    makes_moves: bool = False


def wishes_of(controller: Any) -> Wishes:
    """Return a controller's ``wishes``; without any, the default."""
    wishes = getattr(controller, "wishes", None)
    return wishes if isinstance(wishes, Wishes) else Wishes()


def read_wishes(driver: Any, spec: str) -> Wishes:
    """Read the wishes of a user's driver from attributes that are named as in ``Wishes`` and ``Bicycle``.

    Args:
        driver: The user's driver.
        spec: What messages call the driver.

    Raises:
        UsageError: A number of the bicycle is not finite or not above zero, the steering angle is 90 degrees or more,
            or ``path_ahead`` is out of range.
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
    reach = None if ahead is None else float(ahead)
    return Wishes(**flags, bicycle=Bicycle(**numbers), path_ahead=reach, makes_moves=True)
