"""Put vehicles at poses, once for each step.

Measurements of SUMO shape the calls: a moved vehicle needs ``setSpeedMode, setSpeed, moveToXY(keepRoute=2)`` in this
order and in every step. Otherwise its speed is wrong.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from functools import cached_property
from typing import Any

from sumo_adv.errors import SimulationError
from sumo_adv.geometry import Pose
from sumo_adv.simulation.permissions import CYCLES, EVERYWHERE, MOTOR, ON_FOOT, is_carriageway
from sumo_adv.simulation.sumo_states import Fleet, RawState, angle_deg_of, correct_speeds, front_of

KEEP_ROUTE = 2  # moveToXY places the vehicle exactly, and rewrites its route if necessary
LANELESS = CYCLES | ON_FOOT
"""Classes that many lanes for cars do not allow.

If a vehicle is moved to a place where its class is not allowed, SUMO puts it on no lane, and SUMO's drivers drive
through it (measured). Moved vehicles of these classes therefore get the class of a car; ``vehicle_class`` returns their
own. In the step after that, drivers in the neighbouring lane brake for it (measured, 0.3 to 0.5 m/s).
"""
LANE_SEARCH_RADIUS_M = 10.0  # in which moveToXY looks for a lane; its default of 100 m takes seven times as long
FREE_SPEED_MODE, SUMO_SPEED_MODE = 32, 31
HEEDING_SPEED_MODE = 24  # allows any speed, but what SUMO's driver would do still depends on lights and right of way


class MovedVehicles:
    """The vehicles of one simulation that this program moves."""

    def __init__(self, api: Any, errors: tuple[type[Exception], ...], fleet: Fleet) -> None:
        """Start without moved vehicles.

        Args:
            api: libsumo, or a connection with the same functions.
            errors: The exceptions that ``api`` raises.
            fleet: The sizes and classes of the vehicles.
        """
        self._api, self._errors, self._fleet = api, errors, fleet
        self._as_cars: set[str] = set()  # moved pedestrians and cyclists that have the class of a car in SUMO
        self.forget()

    def forget(self) -> None:
        """Forget all moved vehicles, as at the beginning of a simulation."""
        self._next: dict[str, float] = {}  # speeds of the vehicles that are moved in the next step [m/s]
        self._last: dict[str, float] = {}  # speeds of those that were moved in the last step [m/s]
        self._on: dict[str, str] = {}  # lanes of the vehicles that were moved in the last step
        self._trespassing: set[str] = set()  # moved vehicles on lanes that are not for their class
        self._as_cars = set()

    def before_step(self) -> None:
        """Restore the class of vehicles on foreign lanes that are no longer moved. Call it before each step."""
        for name in self._trespassing - self._next.keys():
            self._trespassing.discard(name)
            with suppress(*self._errors):  # it may be gone
                self._api.vehicle.setVehicleClass(name, self._fleet.vehicle_class(name))
        self._last, self._next = self._next, {}

    def after_step(self, raw: dict[str, RawState]) -> None:
        """Correct the speeds of the vehicles that were moved in the step after which ``raw`` was read."""
        correct_speeds(raw, self._last)
        self._on = {name: raw[name][4] for name in self._last if name in raw}

    def inject(self, poses: Mapping[str, Pose], heeding: str | None = None) -> None:
        """Put vehicles at poses; see ``Simulation.inject``."""
        vehicle, fleet = self._api.vehicle, self._fleet
        for name, pose in poses.items():
            try:
                if name not in fleet.sizes:
                    fleet.measure(name)
                if name not in self._as_cars and fleet.vehicle_class(name) in LANELESS:
                    vehicle.setVehicleClass(name, "passenger")
                    self._as_cars.add(name)
                self._let_trespass(name, pose)
                x, y = front_of(pose.x, pose.y, pose.heading, fleet.sizes[name][0])
                vehicle.setSpeedMode(name, HEEDING_SPEED_MODE if name == heeding else FREE_SPEED_MODE)
                vehicle.setSpeed(name, pose.speed)
                self._next[name] = pose.speed
                vehicle.moveToXY(name, "", -1, x, y, angle_deg_of(pose.heading), KEEP_ROUTE, LANE_SEARCH_RADIUS_M)
            except self._errors as error:
                raise SimulationError(f"SUMO could not move vehicle '{name}' ({error}).") from error

    def release(self, vehicle: str) -> None:
        """Restore the class of a pedestrian or cyclist that is no longer moved."""
        if vehicle in self._as_cars:
            self._as_cars.discard(vehicle)
            self._api.vehicle.setVehicleClass(vehicle, self._fleet.vehicle_class(vehicle))

    def _let_trespass(self, vehicle: str, pose: Pose) -> None:
        """Make SUMO place a moved vehicle on a lane for motor vehicles that its class may not use.

        Measured with SUMO 1.28: SUMO puts a car that is moved onto a bus lane on no lane, and a bus there drives
        through the car. With the class ``ignoring``, the car is on the lane, and the bus brakes for it.
        """
        lane, own = self._on.get(vehicle), self._fleet.vehicle_class(vehicle)
        if lane is None or own in LANELESS or not self._has_reserved_lanes:
            return
        if vehicle in self._trespassing and lane and self._lane_allows(lane, own):
            self._trespassing.discard(vehicle)
            self._api.vehicle.setVehicleClass(vehicle, own)
        elif lane == "" and vehicle not in self._trespassing:
            try:
                edge, _, index = self._api.simulation.convertRoad(pose.x, pose.y, False, EVERYWHERE)
            except self._errors:  # no lane is near
                return
            below = f"{edge}_{index}"
            if not self._lane_allows(below, own) and is_carriageway(self._api.lane.getAllowed(below)):
                self._trespassing.add(vehicle)
                self._api.vehicle.setVehicleClass(vehicle, EVERYWHERE)

    @cached_property
    def _has_reserved_lanes(self) -> bool:
        """Whether some lane is for motor vehicles, but not for all of their classes. Without one, 1 ms per look-up is
        saved.
        """
        lanes = self._api.lane
        return any(
            is_carriageway(classes) and not classes.issuperset(MOTOR - {EVERYWHERE})
            for classes in (frozenset(lanes.getAllowed(name)) for name in lanes.getIDList())
        )

    def _lane_allows(self, lane: str, vclass: str) -> bool:
        classes = self._api.lane.getAllowed(lane)  # empty if every class may use it
        return not classes or vclass in classes
