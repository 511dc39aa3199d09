"""The one adapter over SUMO: libsumo in this process, or a SUMO of its own over TraCI (the functions are the same).

SUMO's poses (front bumper, degrees clockwise from north) exist in this file alone; all other code sees box centres and
headings in rad counter-clockwise from +x.  Facts about SUMO that shape the calls are measured ones: a moved vehicle
needs ``setSpeedMode, setSpeed, moveToXY(keepRoute=2)`` in this order and in every step, or its speed is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from sumo_adv.datatypes import DriverModel, VehicleState
from sumo_adv.errors import SimulationError, UsageError
from sumo_adv.geometry import Pose, wrap
from sumo_adv.simulation.arrivals import ArrivalPlace, arrival, arrival_attributes
from sumo_adv.simulation.given_options import HOME, VARIABLE, check
from sumo_adv.simulation.permissions import CYCLES, EVERYWHERE, MOTOR, ON_FOOT, is_carriageway
from sumo_adv.simulation.programs import load_libsumo
from sumo_adv.simulation.remote import RawState, Remote
from sumo_adv.simulation.sumo_options import DEFAULTS, FORCED
from sumo_adv.simulation.watch import LOAD_LIMIT_S, STEP_LIMIT_S, sumo_at_work

S = TypeVar("S", bound=VehicleState)
KEEP_ROUTE = 2  # moveToXY places exactly and rewrites the route where it must
PERSON = "person:"
"""Before the id of a ``<person>``: SUMO lets a person and a vehicle have one id."""
FASTEST_PERSON, PERSON_JUMPS = 10.5, 1.0  # m/s, SUMO's highest speed of a person; m beyond it that are a jump
LANELESS = CYCLES | ON_FOOT
"""Classes that many lanes of cars do not allow. SUMO has a moved vehicle on no lane where its class may not be, and its
drivers then drive through it (measured). So a moved one gets the class of a car; ``vehicle_class`` tells its own. In
the step after that, drivers in the lane beside brake for it (measured, 0.3 to 0.5 m/s)."""
SEARCHED = 10.0  # m around a pose in which moveToXY looks for a lane: its own 100 m cost seven times as much
FREE_SPEED_MODE, SUMO_SPEED_MODE = 32, 31
HEEDING_SPEED_MODE = 24  # any speed, and lights and right of way still count in what SUMO's driver would do
LANE_HABITS = ("lcStrategic", "lcCooperative", "lcSpeedGain", "lcKeepRight")  # stay as the demand gives them
INVALID = -1e9  # SUMO's coordinates of a vehicle that is nowhere are about -2**30


def check_nameable(file: Path) -> None:
    """Raises UsageError for a file that SUMO cannot be told: it reads UTF-8, parts its lists at commas and semicolons,
    and would read another file where it puts in a variable of the environment or the home."""
    name = str(file)
    if not name.isprintable() or {",", ";"} & set(name) or VARIABLE in name or name.startswith(HOME):
        raise UsageError(
            f"SUMO cannot be told the file {name!r}: rename it, or its folder, to a name in UTF-8 without commas, "
            f"semicolons, control characters and '{VARIABLE}', and without '{HOME}' at its start."
        )


def heading_of(angle_deg: float) -> float:
    """SUMO's angle as a heading in (-pi, pi]."""
    return wrap(math.radians(90.0 - angle_deg))


def angle_deg_of(heading: float) -> float:
    """A heading as SUMO's angle in [0, 360)."""
    return (90.0 - math.degrees(heading)) % 360.0


def pose_of(raw: RawState, length: float) -> tuple[float, float, float]:
    """x, y [m] of the centre of a vehicle's box and its heading [rad]; SUMO's position is the front bumper's."""
    heading, back = heading_of(raw[2]), length / 2
    return raw[0] - back * math.cos(heading), raw[1] - back * math.sin(heading), heading


def raw_of(x: float, y: float, heading: float, speed: float, length: float) -> RawState:
    """A box that SUMO does not know, as SUMO would say it: off every lane."""
    front = length / 2
    return (x + front * math.cos(heading), y + front * math.sin(heading), angle_deg_of(heading), speed, "")


def correct_speeds(raw: dict[str, RawState], given: Mapping[str, float]) -> None:
    """Give each vehicle that was moved in the last step the speed that was asked for.

    Measured with SUMO 1.28: a vehicle that comes back on a lane from beside it has its speed a step late, and one that
    enters a junction's internal lane can have speed 0 for one step. Its position is exact in both cases.
    """
    for vehicle in given.keys() & raw.keys():
        raw[vehicle] = (*raw[vehicle][:3], given[vehicle], raw[vehicle][4])


@dataclass(frozen=True, slots=True)
class SimulationSpec:
    """What SUMO is started with. Times in s; options: by SUMO's long names, those that this program does not force.

    empty_steps: from the begin, in which nothing has departed yet: SUMO makes them, and nothing is recorded.

    Raises UsageError: an option may not be given, its value is not of its type, or a file cannot be named to SUMO.
    """

    network: Path
    routes: tuple[Path, ...]
    additional: tuple[Path, ...]
    begin: float
    seed: int
    step_length: float = 0.1
    options: Mapping[str, str] = field(default_factory=lambda: dict(DEFAULTS))
    empty_steps: int = 0

    @property
    def recorded_from(self) -> float:
        """The time [s] from which states are recorded."""
        return round(self.begin + self.empty_steps * self.step_length, 6)

    def __post_init__(self) -> None:
        check(self.options)
        for file in (self.network, *self.routes, *self.additional):
            check_nameable(file)

    @property
    def all_options(self) -> dict[str, str]:
        """The options of SUMO, with those that this program forces."""
        return {**self.options, **FORCED}

    def arguments(self) -> list[str]:
        """The command line without the program's name."""
        files = {"net-file": (self.network,), "route-files": self.routes, "additional-files": self.additional}
        named = {name: ",".join(map(str, paths)) for name, paths in files.items() if paths}
        times = {"begin": repr(self.begin), "step-length": repr(self.step_length), "seed": str(self.seed)}
        return [f"--{name}={value}" for name, value in {**named, **times, **self.all_options}.items()]


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Everything SUMO said after one step. ``raw``: vehicle id -> bumper pose, speed, lane; also ``person:ID`` of each
    person on foot: the middle of its front, its speed, and no lane.

    lights: by id the states of the traffic lights near the ego, where they are recorded. heights: by id those of the
    road under all vehicles and persons [m], where roads have heights.
    """

    time: float
    raw: Mapping[str, RawState]
    lights: Mapping[str, str] = field(default_factory=dict)
    heights: Mapping[str, float] = field(default_factory=dict)


@dataclass(slots=True)
class Fleet:
    """Sizes (length, width in m) and vClasses of the vehicles and persons seen, and attributes of where a vehicle
    leaves, asked of SUMO once each. persons: those of them that are SUMO's persons, and no vehicles."""

    sizes: dict[str, tuple[float, float]] = field(default_factory=dict)
    classes: dict[str, str] = field(default_factory=dict)
    arrivals: dict[str, Mapping[str, str]] = field(default_factory=dict)
    persons: set[str] = field(default_factory=set)

    def forget(self, keep: Collection[str]) -> None:
        """Drop all but these: what a simulation that goes on for hours needs."""
        self.sizes = {name: size for name, size in self.sizes.items() if name in keep}
        self.classes = {name: kind for name, kind in self.classes.items() if name in keep}
        self.arrivals = {name: known for name, known in self.arrivals.items() if name in keep}
        self.persons.intersection_update(keep)


class Simulation:
    """Holds the only libsumo of this process (a second one at the same time is refused), or one end of a ``remote``
    SUMO, which was started from ``spec``."""

    _running: Simulation | None = None

    def __init__(self, spec: SimulationSpec, remote: Remote | None = None) -> None:
        self.spec = spec
        self.fleet = Fleet()
        self.unrouted: frozenset[str] = frozenset()  # vehicles that another program moves freely
        self.remote = remote  # the other end, where SUMO is a program of its own
        self._asked: dict[str, float] = {}  # speeds [m/s] of the vehicles that are moved in the next step,
        self._given: dict[str, float] = {}  # and that were moved in the last one
        self._now = math.nan  # s; nan: not asked of SUMO since its last step
        self._walked: dict[str, tuple[float, float]] = {}  # where the persons on foot are
        self._limits: dict[str, float] = {}  # of lanes in this step [m/s],
        self._closed: dict[str, Collection[str]] = {}  # and the classes that may not use them
        self._as_cars: set[str] = set()  # moved pedestrians and cyclists, which SUMO takes for cars
        self._on: dict[str, str] = {}  # lanes of the vehicles that were moved in the last step
        self._trespassing: set[str] = set()  # moved vehicles on lanes that are not for their class
        self.api: Any  # libsumo or the connection itself, for what only ``stage.py`` asks of it
        self.errors: tuple[type[Exception], ...]  # what ``api`` raises
        if remote is not None:
            import traci

            self.api = remote.connection
            self.errors = (traci.TraCIException, traci.FatalTraCIError, OSError)
        else:
            self._start()

    def _start(self) -> None:
        if Simulation._running is not None:
            raise SimulationError("A simulation already runs in this process; close it first (libsumo has only one).")
        libsumo = load_libsumo()
        self.api = libsumo
        self.errors = (libsumo.TraCIException, libsumo.FatalTraCIError)
        try:
            with sumo_at_work("when it read its files", LOAD_LIMIT_S):
                libsumo.start(["sumo", *self.spec.arguments()])
        except libsumo.TraCIException as error:
            raise SimulationError(f"SUMO refused to start ({' '.join(str(error).split())}).") from error
        Simulation._running = self
        self._list = libsumo.vehicle.getIDList
        self._position = libsumo.vehicle.getPosition
        self._angle = libsumo.vehicle.getAngle
        self._speed = libsumo.vehicle.getSpeed
        self._lane = libsumo.vehicle.getLaneID
        self._pass_empty_steps()

    def _pass_empty_steps(self) -> None:
        """Make the steps before anything departs."""
        if self.spec.empty_steps:
            try:
                self.api.simulationStep(self.spec.recorded_from)
            except self.errors as error:
                raise SimulationError(f"SUMO failed in a step ({' '.join(str(error).split())}).") from error

    def reload(self) -> None:
        """Load the same simulation again from its beginning (bit-identical if the same commands follow)."""
        if self.remote is not None:
            raise SimulationError("A SUMO that others are connected to cannot be loaded again: start another.")
        self.fleet.forget(())
        self._asked, self._given, self._as_cars, self._walked = {}, {}, set(), {}
        self._on, self._trespassing = {}, set()
        self._limits, self._closed, self._now = {}, {}, math.nan
        try:
            with sumo_at_work("when it read its files again", LOAD_LIMIT_S):
                self.api.load(self.spec.arguments())
        except self.errors as error:
            raise SimulationError(f"SUMO could not load the simulation again ({error}).") from error
        self._pass_empty_steps()

    def close(self) -> None:
        """End the simulation; the process may start another."""
        if self.remote is not None:
            self.remote.close()
        if Simulation._running is self:
            Simulation._running = None
            self.api.close()

    # -- reading ------------------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        if self.remote is not None:
            return self.remote.time
        if math.isnan(self._now):
            self._now = round(float(self.api.simulation.getTime()), 6)
        return self._now

    def step(self) -> None:
        """One step of ``step_length``. Raises SimulationError: SUMO failed."""
        for name in self._trespassing - self._asked.keys():  # no longer moved
            self._trespassing.discard(name)
            with suppress(*self.errors):  # it may be gone
                self.api.vehicle.setVehicleClass(name, self.vehicle_class(name))
        self._given, self._asked = self._asked, {}
        self._limits.clear()
        self._closed.clear()
        self._now = math.nan
        if self.remote is not None:
            self.remote.step()
            return
        try:
            with sumo_at_work("in a step", STEP_LIMIT_S):
                self.api.simulationStep()
        except self.errors as error:
            raise SimulationError(f"SUMO failed in a step ({' '.join(str(error).split())}).") from error

    def read(self) -> Snapshot:
        """The present states of all vehicles and persons."""
        if self.remote is not None:
            return self._read_remote(self.remote)
        position, angle, speed, lane = self._position, self._angle, self._speed, self._lane
        sizes = self.fleet.sizes
        raw: dict[str, RawState] = {}
        for v in self._list():
            if v not in sizes:
                self._measure(v)
            x, y = position(v)
            if x > INVALID:
                raw[v] = (x, y, angle(v), speed(v), lane(v))
        correct_speeds(raw, self._given)
        self._on = {name: raw[name][4] for name in self._given if name in raw}
        person = self.api.person
        self._add_persons(raw, {
            p: (*person.getPosition(p), person.getAngle(p), person.getSpeed(p), person.getVehicle(p))
            for p in person.getIDList()
        })  # fmt: skip
        return Snapshot(self.time, raw)

    def _read_remote(self, remote: Remote) -> Snapshot:
        raw = {name: state for name, state in remote.read().items() if state[0] > INVALID}
        for name in raw.keys() - self.fleet.sizes.keys():
            self._measure(name)
        correct_speeds(raw, self._given)
        self._on = {name: raw[name][4] for name in self._given if name in raw}
        self._add_persons(raw, remote.persons)
        return Snapshot(remote.time, raw)

    def _add_persons(self, raw: dict[str, RawState], persons: Mapping[str, RawState]) -> None:
        """Add the persons on foot. ``persons``: by SUMO's id, with the vehicle that they ride in instead of a lane. A
        person that has jumped over a junction is left out for this step: it has touched nothing on its way."""
        before, self._walked = self._walked, {}
        reach = PERSON_JUMPS + FASTEST_PERSON * self.spec.step_length
        for person, (x, y, angle, speed, ride) in persons.items():
            name = PERSON + person
            if ride or x <= INVALID or name in raw:  # in ``raw``: it attacks as a vehicle since this step
                continue
            if name not in self.fleet.sizes:
                p = self.api.person
                self.fleet.sizes[name] = (p.getLength(person), p.getWidth(person))
                self.fleet.classes[name] = "pedestrian"
                self.fleet.persons.add(name)
            self._walked[name] = (x, y)
            if math.dist((x, y), before.get(name, (x, y))) < reach:
                raw[name] = (x, y, angle, speed, "")

    def _measure(self, vehicle: str) -> None:
        self.fleet.sizes[vehicle] = (self.api.vehicle.getLength(vehicle), self.api.vehicle.getWidth(vehicle))

    def state(self, snapshot: Snapshot, vehicle: str, acceleration: float = 0.0) -> VehicleState:
        """One vehicle of a snapshot as a box (KeyError if it is not there)."""
        return self.state_as(VehicleState, snapshot, vehicle, acceleration)

    def state_as(
        self, make: Callable[..., S], snapshot: Snapshot, vehicle: str, acceleration: float, *more: Any
    ) -> S:  # fmt: skip
        """The same as another class, which takes the arguments of ``VehicleState`` and then ``more``."""
        raw, (length, width) = snapshot.raw[vehicle], self.fleet.sizes[vehicle]
        z = snapshot.heights.get(vehicle, 0.0)
        return make(vehicle, *pose_of(raw, length), raw[3], acceleration, length, width, raw[4], z, *more)

    def expected(self) -> int:
        """Vehicles that are on the road or still to come."""
        return int(self.api.simulation.getMinExpectedNumber())

    def route(self, vehicle: str) -> tuple[tuple[str, ...], int]:
        """A vehicle's edges and the index of the present one; nothing where its way is unknown (``unrouted``)."""
        if vehicle in self.unrouted:
            return (), 0
        return tuple(self.api.vehicle.getRoute(vehicle)), int(self.api.vehicle.getRouteIndex(vehicle))

    def ahead(self, vehicle: str) -> tuple[str, ...]:
        """A vehicle's edges from the present one on."""
        edges, at = self.route(vehicle)
        return edges[max(at, 0) :]

    def lane_position(self, vehicle: str) -> float:
        """SUMO's position of the front bumper on the present lane [m]; ``Lane.station_of`` makes it metres of road."""
        if self.remote is not None and vehicle in self.remote.lane_positions:
            return self.remote.lane_positions[vehicle]
        return float(self.api.vehicle.getLanePosition(vehicle))

    def lane_limit(self, lane: str) -> float:
        """The speed limit of a lane now [m/s]; variable signs and other programs change it."""
        if lane not in self._limits:
            self._limits[lane] = float(self.api.lane.getMaxSpeed(lane))
        return self._limits[lane]

    def closed(self, lane: str, kind: str) -> bool:
        """Whether vehicles of a class may not use a lane now; rerouters and other programs close lanes."""
        if lane not in self._closed:
            self._closed[lane] = self.api.lane.getDisallowed(lane)
        return kind in self._closed[lane]

    def arrival(self, vehicle: str, route: Sequence[str]) -> ArrivalPlace | None:
        """Where SUMO takes a vehicle out that drives this whole route; None where it is unknown (empty)."""
        if not route:
            return None
        if vehicle not in self.fleet.arrivals:
            self.fleet.arrivals[vehicle] = arrival_attributes(self.api, vehicle)
        return arrival(self.fleet.arrivals[vehicle], route, self.api)

    def lane_of(self, snapshot: Snapshot, name: str) -> str:
        """The lane that a vehicle or person of a snapshot that was just read is on; empty off all lanes."""
        if name in self.fleet.persons:
            return str(self.api.person.getLaneID(name.removeprefix(PERSON)))
        return snapshot.raw[name][4]

    def vehicle_class(self, vehicle: str) -> str:
        """SUMO's vClass; asked once a vehicle."""
        kind = self.fleet.classes.get(vehicle)
        if kind is None:
            kind = self.fleet.classes[vehicle] = str(self.api.vehicle.getVehicleClass(vehicle))
        return kind

    def model(self, vehicle: str) -> DriverModel:
        """An unknown driver with the vehicle's car-following numbers in SUMO, predicted as IDM."""
        v = self.api.vehicle
        return DriverModel(
            "idm", v.getAccel(vehicle), self._deceleration(vehicle), v.getTau(vehicle), v.getMinGap(vehicle),
            v.getAllowedSpeed(vehicle), known=False,
            hardest_braking=v.getEmergencyDecel(vehicle),
        )  # fmt: skip

    def signals(self, vehicle: str) -> list[tuple[str, float, str]]:
        """Traffic lights ahead of a vehicle: (id, distance [m], state letter)."""
        return [(t[0], t[2], t[3]) for t in self.api.vehicle.getNextTLS(vehicle)]

    def limit(self, vehicle: str, lane: str | None = None) -> float:
        """The fastest its driver goes [m/s] where it is, or on another lane."""
        v = self.api.vehicle
        if lane is None:
            return float(v.getAllowedSpeed(vehicle))
        return float(min(v.getMaxSpeed(vehicle), self.lane_limit(lane) * v.getSpeedFactor(vehicle)))

    def reachable(self, vehicle: str, speed: float) -> float:
        """The highest speed [m/s] that SUMO lets a vehicle have after a step, with no vehicle and no line ahead."""
        fastest = speed + float(self.api.vehicle.getAccel(vehicle)) * self.spec.step_length
        return min(fastest, self.limit(vehicle))

    def advised(self, vehicle: str) -> float:
        """The speed [m/s] that SUMO's driver would have had after the last step, at most the one it was asked for."""
        return float(self.api.vehicle.getSpeedWithoutTraCI(vehicle))

    def stood(self, vehicle: str) -> float:
        """For how long a vehicle has been slower than 0.1 m/s [s]."""
        return float(self.api.vehicle.getWaitingTime(vehicle))

    def light(self, name: str) -> str:
        """The state of a traffic light, a letter for each connection that it controls."""
        return str(self.api.trafficlight.getRedYellowGreenState(name))

    def lamps(self, vehicle: str) -> int:
        """The lamps of a vehicle that are on, as bits: indicator right 1, left 2, brake light 8."""
        return int(self.api.vehicle.getSignals(vehicle))

    # -- driving ------------------------------------------------------------------------------------------------

    def inject(self, poses: Mapping[str, Pose], heeding: str | None = None) -> None:
        """Put vehicles at poses; visible after the next step, and for that step alone.

        heeding: the vehicle that gets an ``advised`` speed with lights and right of way.

        Raises SimulationError: SUMO does not know the vehicle, or could not place it.
        """
        vehicle = self.api.vehicle
        for name, pose in poses.items():
            try:
                if name not in self.fleet.sizes:
                    self._measure(name)
                if name not in self._as_cars and self.vehicle_class(name) in LANELESS:
                    vehicle.setVehicleClass(name, "passenger")
                    self._as_cars.add(name)
                self._let_trespass(name, pose)
                ahead = self.fleet.sizes[name][0] / 2
                x, y = pose.x + ahead * math.cos(pose.heading), pose.y + ahead * math.sin(pose.heading)
                vehicle.setSpeedMode(name, HEEDING_SPEED_MODE if name == heeding else FREE_SPEED_MODE)
                vehicle.setSpeed(name, pose.speed)
                self._asked[name] = pose.speed
                vehicle.moveToXY(name, "", -1, x, y, angle_deg_of(pose.heading), KEEP_ROUTE, SEARCHED)
            except self.errors as error:
                raise SimulationError(f"SUMO could not move vehicle '{name}' ({error}).") from error

    def _let_trespass(self, vehicle: str, pose: Pose) -> None:
        """Have SUMO place a moved vehicle on a lane for motor vehicles that its class may not use.

        Measured with SUMO 1.28: it has a car that is moved onto a bus lane on no lane, and a bus there drives through
        the car. With the class ``ignoring`` the car is on the lane, and the bus brakes for it.
        """
        lane, own = self._on.get(vehicle), self.vehicle_class(vehicle)
        if lane is None or own in LANELESS or not self._has_reserved_lanes:
            return
        if vehicle in self._trespassing and lane and self._lane_allows(lane, own):
            self._trespassing.discard(vehicle)
            self.api.vehicle.setVehicleClass(vehicle, own)
        elif lane == "" and vehicle not in self._trespassing:
            try:
                edge, _, index = self.api.simulation.convertRoad(pose.x, pose.y, False, EVERYWHERE)
            except self.errors:  # no lane is near
                return
            below = f"{edge}_{index}"
            if not self._lane_allows(below, own) and is_carriageway(self.api.lane.getAllowed(below)):
                self._trespassing.add(vehicle)
                self.api.vehicle.setVehicleClass(vehicle, EVERYWHERE)

    @cached_property
    def _has_reserved_lanes(self) -> bool:
        """Whether some lane is for motor vehicles, but not for those of every class. It saves others 1 ms a look."""
        lanes = self.api.lane
        return any(
            is_carriageway(classes) and not classes.issuperset(MOTOR - {EVERYWHERE})
            for classes in (frozenset(lanes.getAllowed(name)) for name in lanes.getIDList())
        )

    def _lane_allows(self, lane: str, vclass: str) -> bool:
        classes = self.api.lane.getAllowed(lane)  # nothing where every class may use it
        return not classes or vclass in classes

    def released(self, vehicle: str) -> None:
        """Give a vehicle that is moved no more its own class back."""
        if vehicle in self._as_cars:
            self._as_cars.discard(vehicle)
            self.api.vehicle.setVehicleClass(vehicle, self.vehicle_class(vehicle))

    def set_speed(self, vehicle: str, speed: float | None) -> None:
        """Ask for a speed [m/s], or the lower one which SUMO holds for safe; None gives the speed back to SUMO.

        It brakes at most as hard as in an emergency: SUMO clips at the ``decel``, which is the emergency's as long as a
        speed is asked for (also for what SUMO holds for safe); without clipping, its safe speed stops within a step.
        """
        v = self.api.vehicle
        braking = self._deceleration(vehicle) if speed is None else v.getEmergencyDecel(vehicle)
        if v.getDecel(vehicle) != braking:
            v.setDecel(vehicle, braking)
        v.setSpeedMode(vehicle, SUMO_SPEED_MODE)
        v.setSpeed(vehicle, -1.0 if speed is None else max(0.0, speed))

    def _deceleration(self, vehicle: str) -> float:
        """Its ``decel`` [m/s2] while no speed is asked for."""
        v = self.api.vehicle
        present = float(v.getDecel(vehicle))
        if present != v.getEmergencyDecel(vehicle):
            return present
        return float(self.api.vehicletype.getDecel(self.own_type(vehicle)))

    def strengthen(self, vehicle: str, braking: float) -> None:
        """Let a vehicle brake as hard as ``braking`` [m/s2] if a speed is asked for, also where its type cannot."""
        v = self.api.vehicle
        if v.getEmergencyDecel(vehicle) < braking:
            v.setEmergencyDecel(vehicle, braking)

    def change_lane(self, vehicle: str, lane: int) -> None:
        """Ask SUMO's driver to change to the lane of that index within 3 s."""
        self.api.vehicle.changeLane(vehicle, lane, 3.0)

    def set_speed_factor(self, vehicle: str, factor: float) -> None:
        """Have its driver go for this share of the speed limit."""
        self.api.vehicle.setSpeedFactor(vehicle, factor)

    def set_route(self, vehicle: str, edges: Sequence[str]) -> None:
        """Give a vehicle the edges that are left of its way, the present one first."""
        self.api.vehicle.setRoute(vehicle, list(edges))

    def own_type(self, vehicle: str) -> str:
        """The vType of a vehicle, also where some of its values were changed for the vehicle alone."""
        return str(self.api.vehicle.getTypeID(vehicle)).removesuffix(f"@{vehicle}")

    def set_type(self, vehicle: str, type_id: str, otherwise: str = "", *, keeps_factor: bool = True) -> None:
        """Give a vehicle another driver (a vType of an additional file); class, size, highest speed and lane-changing
        habits stay.

        Args:
            vehicle: its id.
            type_id: the vType; ``otherwise`` where SUMO has none of that name.
            keeps_factor: its own factor of the speed limit stays, too, where SUMO has that vType.
        """
        v, (length, width) = self.api.vehicle, self.fleet.sizes[vehicle]
        vclass, fastest, factor = self.vehicle_class(vehicle), v.getMaxSpeed(vehicle), v.getSpeedFactor(vehicle)
        habits = {n: v.getParameter(vehicle, f"laneChangeModel.{n}") for n in LANE_HABITS}
        known = not otherwise or type_id in self.api.vehicletype.getIDList()
        v.setType(vehicle, type_id if known else otherwise)
        for name, value in habits.items():
            v.setParameter(vehicle, f"laneChangeModel.{name}", value)
        v.setVehicleClass(vehicle, vclass)
        v.setLength(vehicle, length)
        v.setWidth(vehicle, width)
        v.setMaxSpeed(vehicle, fastest)
        if keeps_factor and known:
            v.setSpeedFactor(vehicle, factor)

    def add(self, vehicle: str, edges: Sequence[str], type_id: str, depart: Mapping[str, str], route: str = "") -> None:
        """Insert a vehicle with a route of its own, under a new name if it departs again."""
        name = route or f"{vehicle}.route"
        try:
            self.api.route.add(name, list(edges))
            self.api.vehicle.add(vehicle, name, type_id, **depart)
        except self.errors as error:
            raise SimulationError(f"SUMO could not insert vehicle '{vehicle}' ({error}).") from error
