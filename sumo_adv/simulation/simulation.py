"""The one adapter over SUMO: libsumo in this process, or a SUMO of its own over TraCI (the functions are the same)."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, TypeVar

from sumo_adv.datatypes import DriverModel, VehicleState
from sumo_adv.errors import SimulationError
from sumo_adv.geometry import Pose
from sumo_adv.simulation.arrivals import ArrivalPlace, arrival, arrival_attributes
from sumo_adv.simulation.moved_vehicles import SUMO_SPEED_MODE, MovedVehicles
from sumo_adv.simulation.programs import load_libsumo
from sumo_adv.simulation.remote import Remote
from sumo_adv.simulation.simulation_spec import SimulationSpec
from sumo_adv.simulation.sumo_states import PERSON, Fleet, RawState, Snapshot, pose_of
from sumo_adv.simulation.watch import LOAD_LIMIT_S, STEP_LIMIT_S, sumo_at_work

S = TypeVar("S", bound=VehicleState)
FASTEST_PERSON_M_S = 10.5  # SUMO's highest speed of a person
PERSON_JUMP_M = 1.0  # beyond what it walks in a step: it has jumped
LANE_HABITS = ("lcStrategic", "lcCooperative", "lcSpeedGain", "lcKeepRight")  # stay as the demand gives them
INVALID_M = -1e9  # SUMO's coordinates of a vehicle that is nowhere are about -2**30


class Simulation:
    """Holds the only libsumo of this process (a second one at the same time is refused), or one end of a ``remote``
    SUMO, which was started from ``spec``."""

    _running: Simulation | None = None

    def __init__(self, spec: SimulationSpec, remote: Remote | None = None) -> None:
        self.spec = spec
        self.unrouted: frozenset[str] = frozenset()  # vehicles that another program moves freely
        self.remote = remote  # the other end, where SUMO is a program of its own
        self._now = math.nan  # s; nan: not asked of SUMO since its last step
        self._walked: dict[str, tuple[float, float]] = {}  # where the persons on foot are
        self._limits: dict[str, float] = {}  # of lanes in this step [m/s],
        self._closed: dict[str, Collection[str]] = {}  # and the classes that may not use them
        self.api: Any  # libsumo or the connection itself, for what only ``stage.py`` asks of it
        self.errors: tuple[type[Exception], ...]  # what ``api`` raises
        if remote is not None:
            import traci

            self.api = remote.connection
            self.errors = (traci.TraCIException, traci.FatalTraCIError, OSError)
        else:
            self._start()
        self.fleet = Fleet(self.api)
        self.moved = MovedVehicles(self.api, self.errors, self.fleet)

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
        self.moved.forget()
        self._walked = {}
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
        self.moved.before_step()
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
                self.fleet.measure(v)
            x, y = position(v)
            if x > INVALID_M:
                raw[v] = (x, y, angle(v), speed(v), lane(v))
        self.moved.after_step(raw)
        person = self.api.person
        self._add_persons(raw, {
            p: (*person.getPosition(p), person.getAngle(p), person.getSpeed(p), person.getVehicle(p))
            for p in person.getIDList()
        })  # fmt: skip
        return Snapshot(self.time, raw)

    def _read_remote(self, remote: Remote) -> Snapshot:
        raw = {name: state for name, state in remote.read().items() if state[0] > INVALID_M}
        for name in raw.keys() - self.fleet.sizes.keys():
            self.fleet.measure(name)
        self.moved.after_step(raw)
        self._add_persons(raw, remote.persons)
        return Snapshot(remote.time, raw)

    def _add_persons(self, raw: dict[str, RawState], persons: Mapping[str, RawState]) -> None:
        """Add the persons on foot. ``persons``: by SUMO's id, with the vehicle that they ride in instead of a lane. A
        person that has jumped over a junction is left out for this step: it has touched nothing on its way."""
        before, self._walked = self._walked, {}
        reach = PERSON_JUMP_M + FASTEST_PERSON_M_S * self.spec.step_length
        for person, (x, y, angle, speed, ride) in persons.items():
            name = PERSON + person
            if ride or x <= INVALID_M or name in raw:  # in ``raw``: it attacks as a vehicle since this step
                continue
            if name not in self.fleet.sizes:
                self.fleet.add_person(person)
            self._walked[name] = (x, y)
            if math.dist((x, y), before.get(name, (x, y))) < reach:
                raw[name] = (x, y, angle, speed, "")

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
        return self.fleet.vehicle_class(vehicle)

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
        self.moved.inject(poses, heeding)

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
