"""Vehicles that this program puts at poses, in each step anew.

Facts about SUMO that shape the calls are measured ones: a moved vehicle needs ``setSpeedMode, setSpeed,
moveToXY(keepRoute=2)`` in this order and in every step, or its speed is wrong.
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

KEEP_ROUTE = 2  # moveToXY places exactly and rewrites the route where it must
LANELESS = CYCLES | ON_FOOT
"""Classes that many lanes of cars do not allow. SUMO has a moved vehicle on no lane where its class may not be, and its
drivers then drive through it (measured). So a moved one gets the class of a car; ``vehicle_class`` tells its own. In
the step after that, drivers in the lane beside brake for it (measured, 0.3 to 0.5 m/s)."""
LANE_SEARCH_RADIUS_M = 10.0  # in which moveToXY looks for a lane: its own 100 m cost seven times as much
FREE_SPEED_MODE, SUMO_SPEED_MODE = 32, 31
HEEDING_SPEED_MODE = 24  # any speed, and lights and right of way still count in what SUMO's driver would do


class MovedVehicles:
    """The vehicles of one simulation that are moved."""

    def __init__(self, api: Any, errors: tuple[type[Exception], ...], fleet: Fleet) -> None:
        """``api``: libsumo, or a connection with the same functions; ``errors``: what it raises."""
        self._api, self._errors, self._fleet = api, errors, fleet
        self._as_cars: set[str] = set()  # moved pedestrians and cyclists, which SUMO takes for cars
        self.forget()

    def forget(self) -> None:
        """Move none, as at the beginning of a simulation."""
        self._next: dict[str, float] = {}  # speeds [m/s] of the vehicles that are moved in the next step,
        self._last: dict[str, float] = {}  # and that were moved in the last one
        self._on: dict[str, str] = {}  # lanes of the vehicles that were moved in the last step
        self._trespassing: set[str] = set()  # moved vehicles on lanes that are not for their class
        self._as_cars = set()

    def before_step(self) -> None:
        """Give those that are moved no more their own class back. Call it before each step."""
        for name in self._trespassing - self._next.keys():
            self._trespassing.discard(name)
            with suppress(*self._errors):  # it may be gone
                self._api.vehicle.setVehicleClass(name, self._fleet.vehicle_class(name))
        self._last, self._next = self._next, {}

    def after_step(self, raw: dict[str, RawState]) -> None:
        """Correct the speeds of those that were moved in the step that ``raw`` was read after."""
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
        """Give a vehicle that is moved no more its own class back."""
        if vehicle in self._as_cars:
            self._as_cars.discard(vehicle)
            self._api.vehicle.setVehicleClass(vehicle, self._fleet.vehicle_class(vehicle))

    def _let_trespass(self, vehicle: str, pose: Pose) -> None:
        """Have SUMO place a moved vehicle on a lane for motor vehicles that its class may not use.

        Measured with SUMO 1.28: it has a car that is moved onto a bus lane on no lane, and a bus there drives through
        the car. With the class ``ignoring`` the car is on the lane, and the bus brakes for it.
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
        """Whether some lane is for motor vehicles, but not for those of every class. It saves others 1 ms a look."""
        lanes = self._api.lane
        return any(
            is_carriageway(classes) and not classes.issuperset(MOTOR - {EVERYWHERE})
            for classes in (frozenset(lanes.getAllowed(name)) for name in lanes.getIDList())
        )

    def _lane_allows(self, lane: str, vclass: str) -> bool:
        classes = self._api.lane.getAllowed(lane)  # nothing where every class may use it
        return not classes or vclass in classes
