"""Adapter for SUMO, either libsumo in this process or a separate SUMO process over TraCI. Both offer the same
functions.
"""

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
FASTEST_PERSON_M_S = 10.5  # the highest speed of a person in SUMO
PERSON_JUMP_M = 1.0  # farther than it can walk in a step: it has jumped
LANE_HABITS = ("lcStrategic", "lcCooperative", "lcSpeedGain", "lcKeepRight")  # kept as the demand sets them
ROUTE_ONLY_LANE_CHANGES = 1537  # SUMO's bits: strategic ones, with safe gaps also for those that are asked for
INVALID_M = -1e9  # SUMO gives about -2**30 as the coordinates of a vehicle that is not on the network


class Simulation:
    """One running SUMO simulation.

    Without ``remote``, it holds the only libsumo of this process. A second one at the same time is refused. With
    ``remote``, it holds one end of a separate SUMO process that was started from ``spec``.

    Attributes:
        spec: What SUMO was started with.
        unrouted: Ids of vehicles that another program moves freely.
        remote: The connection to a separate SUMO process; None with libsumo.
        api: libsumo or the TraCI connection, for calls that this class does not offer.
        errors: The exceptions that ``api`` raises.
        fleet: What SUMO says once about each vehicle and person.
        moved: The vehicles that this program moves.
    """

    _running: Simulation | None = None

    def __init__(self, spec: SimulationSpec, remote: Remote | None = None) -> None:
        """Start libsumo, or use a remote SUMO.

        Args:
            spec: What SUMO is started with.
            remote: The connection to a separate SUMO process; None starts libsumo.

        Raises:
            SimulationError: A simulation already runs in this process, or SUMO refused to start.
        """
        self.spec = spec
        self.unrouted: frozenset[str] = frozenset()  # vehicles that another program moves freely
        self.remote = remote  # the connection to a separate SUMO process; None with libsumo
        self._now = math.nan  # time [s]; nan if SUMO has not been asked since its last step
        self._walked: dict[str, tuple[float, float]] = {}  # last place of each person on foot
        self._limits: dict[str, float] = {}  # speed limit by lane in this step [m/s]
        self._closed: dict[str, Collection[str]] = {}  # classes that may not use a lane in this step
        self.api: Any  # libsumo or the TraCI connection
        self.errors: tuple[type[Exception], ...]  # exceptions that ``api`` raises
        if remote is not None:
            import traci

            self.api = remote.connection
            self.errors = (traci.TraCIException, traci.FatalTraCIError, OSError)
        else:
            self._start()
        self.fleet = Fleet(self.api)
        self.moved = MovedVehicles(self.api, self.errors, self.fleet)

    def _start(self) -> None:
        """Start libsumo in this process."""
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
        """Run the steps before the first departure."""
        if self.spec.empty_steps:
            try:
                self.api.simulationStep(self.spec.recorded_from)
            except self.errors as error:
                raise SimulationError(f"SUMO failed in a step ({' '.join(str(error).split())}).") from error

    def reload(self) -> None:
        """Load the same simulation from its beginning.

        The result is bit-identical if the same commands follow.

        Raises:
            SimulationError: Other programs are connected to this SUMO, or SUMO could not load the simulation.
        """
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
        """End the simulation. The process may start another one afterwards."""
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
        """Advance the simulation by one ``step_length``.

        Raises:
            SimulationError: SUMO failed.
        """
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
        """Return the present states of all vehicles and persons."""
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
        """Return the states that the separate SUMO process reported after the last step."""
        raw = {name: state for name, state in remote.read().items() if state[0] > INVALID_M}
        for name in raw.keys() - self.fleet.sizes.keys():
            self.fleet.measure(name)
        self.moved.after_step(raw)
        self._add_persons(raw, remote.persons)
        return Snapshot(remote.time, raw)

    def _add_persons(self, raw: dict[str, RawState], persons: Mapping[str, RawState]) -> None:
        """Add the persons on foot.

        A person that has jumped over a junction is left out for this step, because it has touched nothing on its way.

        Args:
            raw: The states by id, to which the persons are added.
            persons: The state of each person by SUMO's id; the vehicle that it rides in takes the place of the lane.
        """
        before, self._walked = self._walked, {}
        reach = PERSON_JUMP_M + FASTEST_PERSON_M_S * self.spec.step_length
        for person, (x, y, angle, speed, ride) in persons.items():
            name = PERSON + person
            if ride or x <= INVALID_M or name in raw:  # in ``raw``: it attacks as a vehicle from this step on
                continue
            if name not in self.fleet.sizes:
                self.fleet.add_person(person)
            self._walked[name] = (x, y)
            if math.dist((x, y), before.get(name, (x, y))) < reach:
                raw[name] = (x, y, angle, speed, "")

    def state(self, snapshot: Snapshot, vehicle: str, acceleration: float = 0.0) -> VehicleState:
        """Return one vehicle of a snapshot as a box.

        Args:
            snapshot: The states of all vehicles.
            vehicle: The id of the vehicle.
            acceleration: Its acceleration [m/s2], which a snapshot does not hold.

        Returns:
            The state; the pose is the centre of the box and its heading.

        Raises:
            KeyError: The vehicle is not in the snapshot.
        """
        return self.state_as(VehicleState, snapshot, vehicle, acceleration)

    def state_as(
        self, make: Callable[..., S], snapshot: Snapshot, vehicle: str, acceleration: float, *more: Any
    ) -> S:  # fmt: skip
        """Return one vehicle of a snapshot as an instance of another class.

        Args:
            make: The class; it takes the arguments of ``VehicleState`` and then ``more``.
            snapshot: The states of all vehicles.
            vehicle: The id of the vehicle.
            acceleration: Its acceleration [m/s2].
            *more: Further arguments of ``make``.

        Returns:
            The state.

        Raises:
            KeyError: The vehicle is not in the snapshot.
        """
        raw, (length, width) = snapshot.raw[vehicle], self.fleet.sizes[vehicle]
        z = snapshot.heights.get(vehicle, 0.0)
        return make(vehicle, *pose_of(raw, length), raw[3], acceleration, length, width, raw[4], z, *more)

    def expected(self) -> int:
        """Return the number of vehicles that are on the road or still to depart."""
        return int(self.api.simulation.getMinExpectedNumber())

    def route(self, vehicle: str) -> tuple[tuple[str, ...], int]:
        """Return a vehicle's edges and the index of the present one.

        Returns:
            The edges and the index; no edges and 0 if the route is unknown (``unrouted``).
        """
        if vehicle in self.unrouted:
            return (), 0
        return tuple(self.api.vehicle.getRoute(vehicle)), int(self.api.vehicle.getRouteIndex(vehicle))

    def ahead(self, vehicle: str) -> tuple[str, ...]:
        """Return a vehicle's edges from the present one on."""
        edges, at = self.route(vehicle)
        return edges[max(at, 0) :]

    def lane_position(self, vehicle: str) -> float:
        """Return SUMO's position of the front bumper on the present lane [m].

        ``Lane.station_of`` converts it to metres along the road.
        """
        if self.remote is not None and vehicle in self.remote.lane_positions:
            return self.remote.lane_positions[vehicle]
        return float(self.api.vehicle.getLanePosition(vehicle))

    def lane_limit(self, lane: str) -> float:
        """Return the present speed limit of a lane [m/s]; variable signs and other programs can change it."""
        if lane not in self._limits:
            self._limits[lane] = float(self.api.lane.getMaxSpeed(lane))
        return self._limits[lane]

    def closed(self, lane: str, kind: str) -> bool:
        """Return whether vehicles of a class may not use a lane now; rerouters and other programs can close lanes."""
        if lane not in self._closed:
            self._closed[lane] = self.api.lane.getDisallowed(lane)
        return kind in self._closed[lane]

    def arrival(self, vehicle: str, route: Sequence[str]) -> ArrivalPlace | None:
        """Return where SUMO removes a vehicle.

        Args:
            vehicle: The id of the vehicle.
            route: All edges of its route; empty if unknown.

        Returns:
            The place, or None if the route is unknown.
        """
        if not route:
            return None
        if vehicle not in self.fleet.arrivals:
            self.fleet.arrivals[vehicle] = arrival_attributes(self.api, vehicle)
        return arrival(self.fleet.arrivals[vehicle], route, self.api)

    def lane_of(self, snapshot: Snapshot, name: str) -> str:
        """Return the lane of a vehicle or person.

        Args:
            snapshot: A snapshot that was just read.
            name: The vehicle or person.

        Returns:
            The id of the lane; empty off all lanes.
        """
        if name in self.fleet.persons:
            return str(self.api.person.getLaneID(name.removeprefix(PERSON)))
        return snapshot.raw[name][4]

    def vehicle_class(self, vehicle: str) -> str:
        """Return SUMO's vClass of a vehicle. SUMO is asked once for each vehicle."""
        return self.fleet.vehicle_class(vehicle)

    def model(self, vehicle: str) -> DriverModel:
        """Return an IDM driver with the vehicle's car-following parameters in SUMO, marked as not known."""
        v = self.api.vehicle
        return DriverModel(
            "idm", v.getAccel(vehicle), self._deceleration(vehicle), v.getTau(vehicle), v.getMinGap(vehicle),
            v.getAllowedSpeed(vehicle), known=False,
            hardest_braking=v.getEmergencyDecel(vehicle),
        )  # fmt: skip

    def signals(self, vehicle: str) -> list[tuple[str, float, str]]:
        """Return the traffic lights ahead of a vehicle as (id, distance [m], state letter)."""
        return [(t[0], t[2], t[3]) for t in self.api.vehicle.getNextTLS(vehicle)]

    def limit(self, vehicle: str, lane: str | None = None) -> float:
        """Return the highest speed that a vehicle's driver wants to drive [m/s].

        Args:
            vehicle: The id of the vehicle.
            lane: The lane on which it would drive; None means its present one.

        Returns:
            The speed [m/s].
        """
        v = self.api.vehicle
        if lane is None:
            return float(v.getAllowedSpeed(vehicle))
        return float(min(v.getMaxSpeed(vehicle), self.lane_limit(lane) * v.getSpeedFactor(vehicle)))

    def reachable(self, vehicle: str, speed: float) -> float:
        """Return the highest speed that SUMO allows a vehicle after the next step [m/s].

        No vehicle and no stop line is assumed ahead.

        Args:
            vehicle: The id of the vehicle.
            speed: Its present speed [m/s].

        Returns:
            The speed [m/s].
        """
        fastest = speed + float(self.api.vehicle.getAccel(vehicle)) * self.spec.step_length
        return min(fastest, self.limit(vehicle))

    def advised(self, vehicle: str) -> float:
        """Return the speed that SUMO's driver would have had after the last step [m/s].

        The speed is at most the one that was asked for.
        """
        return float(self.api.vehicle.getSpeedWithoutTraCI(vehicle))

    def stood(self, vehicle: str) -> float:
        """Return for how long a vehicle has been slower than 0.1 m/s [s]."""
        return float(self.api.vehicle.getWaitingTime(vehicle))

    def light(self, name: str) -> str:
        """Return the state of a traffic light, one letter for each connection that it controls."""
        return str(self.api.trafficlight.getRedYellowGreenState(name))

    def lamps(self, vehicle: str) -> int:
        """Return the lamps of a vehicle that are on, as bits: right indicator 1, left indicator 2, brake light 8."""
        return int(self.api.vehicle.getSignals(vehicle))

    # -- driving ------------------------------------------------------------------------------------------------

    def inject(self, poses: Mapping[str, Pose], heeding: str | None = None) -> None:
        """Put vehicles at poses, for the next step only. The poses are visible after that step.

        Args:
            poses: The pose of each vehicle by id.
            heeding: A vehicle whose ``advised`` speed takes lights and right of way into account.

        Raises:
            SimulationError: SUMO does not know a vehicle, or could not place it.
        """
        self.moved.inject(poses, heeding)

    def set_speed(self, vehicle: str, speed: float | None) -> None:
        """Ask for a speed, which SUMO lowers to the one that it considers safe.

        The vehicle brakes at most as hard as in an emergency. SUMO limits braking to ``decel``, so ``decel`` is set to
        the emergency deceleration while a speed is asked for. The limit also applies to SUMO's safe speed, which would
        otherwise stop the vehicle within one step.

        Args:
            vehicle: The id of the vehicle.
            speed: The speed [m/s]; None returns control of the speed to SUMO.
        """
        v = self.api.vehicle
        braking = self._deceleration(vehicle) if speed is None else v.getEmergencyDecel(vehicle)
        if v.getDecel(vehicle) != braking:
            v.setDecel(vehicle, braking)
        v.setSpeedMode(vehicle, SUMO_SPEED_MODE)
        v.setSpeed(vehicle, -1.0 if speed is None else max(0.0, speed))

    def _deceleration(self, vehicle: str) -> float:
        """Return a vehicle's ``decel`` while no speed is asked for [m/s2]."""
        v = self.api.vehicle
        present = float(v.getDecel(vehicle))
        if present != v.getEmergencyDecel(vehicle):
            return present
        return float(self.api.vehicletype.getDecel(self.own_type(vehicle)))

    def strengthen(self, vehicle: str, braking: float) -> None:
        """Allow a vehicle to brake at ``braking`` [m/s2] while a speed is asked for, even if its type cannot."""
        v = self.api.vehicle
        if v.getEmergencyDecel(vehicle) < braking:
            v.setEmergencyDecel(vehicle, braking)

    def change_lane(self, vehicle: str, lane: int) -> None:
        """Ask SUMO's driver to change to the lane with this index within 3 s."""
        self.api.vehicle.changeLane(vehicle, lane, 3.0)

    def hold_lane(self, vehicle: str) -> None:
        """Have a vehicle change lanes only where it is asked to, and where its route needs it."""
        self.api.vehicle.setLaneChangeMode(vehicle, ROUTE_ONLY_LANE_CHANGES)

    def cap_speed(self, vehicle: str, speed: float | None) -> None:
        """Have a vehicle drive at most this fast [m/s], with its own ``decel``; None ends that."""
        self.api.vehicle.setSpeed(vehicle, -1.0 if speed is None else speed)

    def set_top_speed(self, vehicle: str, speed: float) -> None:
        """Make a vehicle's driver aim for this speed [m/s] where the limit allows it."""
        self.api.vehicle.setMaxSpeed(vehicle, speed)

    def set_speed_factor(self, vehicle: str, factor: float) -> None:
        """Make a vehicle's driver aim for this share of the speed limit."""
        self.api.vehicle.setSpeedFactor(vehicle, factor)

    def set_route(self, vehicle: str, edges: Sequence[str]) -> None:
        """Give a vehicle the remaining edges of its route, the present one first."""
        self.api.vehicle.setRoute(vehicle, list(edges))

    def own_type(self, vehicle: str) -> str:
        """Return a vehicle's vType, even if some of its values were changed for this vehicle only."""
        return str(self.api.vehicle.getTypeID(vehicle)).removesuffix(f"@{vehicle}")

    def set_type(self, vehicle: str, type_id: str, otherwise: str = "", *, keeps_factor: bool = True) -> None:
        """Give a vehicle another driver, which is a vType of an additional file.

        The vehicle keeps its class, size, highest speed and lane-changing habits.

        Args:
            vehicle: The id of the vehicle.
            type_id: The vType.
            otherwise: The vType to use if SUMO has none called ``type_id``; empty: ``type_id`` must exist.
            keeps_factor: Whether the vehicle keeps its factor of the speed limit. It applies only if SUMO has
                ``type_id``.
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
        """Insert a vehicle with its own route.

        Args:
            vehicle: The id of the vehicle.
            edges: The edges of its route.
            type_id: Its vType.
            depart: Further arguments of TraCI's ``vehicle.add``, such as ``departPos``.
            route: A name for the route. A vehicle that departs again needs a new one.

        Raises:
            SimulationError: SUMO could not insert the vehicle.
        """
        name = route or f"{vehicle}.route"
        try:
            self.api.route.add(name, list(edges))
            self.api.vehicle.add(vehicle, name, type_id, **depart)
        except self.errors as error:
            raise SimulationError(f"SUMO could not insert vehicle '{vehicle}' ({error}).") from error
