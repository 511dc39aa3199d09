"""A reference driver that watches the traffic online: the vehicles in sight, in the frame of the ego's path.

``Watcher`` is one reference driver in one ego. The controller ``careful`` and the reference drivers that drive in the
loop (``episode/references.py``) use it, so all of them see the same path, lane width, history and vehicles.
``CarefulDrivers`` (``careful.py``) describes many predicted egos with the same ``WatchingEgos`` and
``WatchedVehicles``. ``view_of`` turns them into the reference driver's ``View``.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Boxes, Floats, VehicleState
from sumo_adv.drivers.protocol import Observation, Vehicle
from sumo_adv.geometry import wrap_below_pi
from sumo_adv.metrics.reference import Braker
from sumo_adv.metrics.reference.sight import in_reach
from sumo_adv.metrics.reference.view import YAW_RATE_SPAN_S, EgoPaths, View, is_same_direction
from sumo_adv.road_users import is_unprotected

HALF_LANE_M = 1.6  # half of SUMO's default lane, if the lane is not known
SIGHT_S = 5.0  # vehicles that can meet the ego in this time at both speeds are watched
MIN_SIGHT_M = 20.0
PATH_SPACING_M = 2.0  # between the points of a path
STRAIGHT_PATH_M = 150.0  # length of the path if the engine gives none
PastPose = tuple[float, float, float]  # x, y [m], heading [rad]


@dataclass(frozen=True, slots=True)
class WatchingEgos:
    """N egos on their paths. Arrays are ``(N, 1)``.

    Attributes:
        station: Station on the path [m].
        speed: Speed [m/s].
        acceleration: Acceleration [m/s2].
        length: Length of all egos [m].
        width: Width of all egos [m].
    """

    station: Floats
    speed: Floats
    acceleration: Floats
    length: float
    width: float


@dataclass(frozen=True, slots=True)
class WatchedVehicles:
    """The M vehicles that each ego watches. Arrays are ``(N, M)``; box centres are in the frame of the ego's path.

    Attributes:
        station: Station on the path [m].
        offset: Offset from the path [m, left positive].
        heading: Heading against the path [rad].
        speed: Speed [m/s].
        sideways: Change of the offset over the last step [m/s].
        acceleration: Acceleration [m/s2].
        yaw_rate: Mean yaw rate over the last ``YAW_RATE_SPAN_S`` seconds [rad/s].
        length: Length [m].
        width: Width [m].
    """

    station: Floats
    offset: Floats
    heading: Floats
    speed: Floats
    sideways: Floats
    acceleration: Floats
    yaw_rate: Floats
    length: Floats
    width: Floats


def view_of(egos: WatchingEgos, others: WatchedVehicles, lane_half_width: Floats | float) -> View:
    """Return the view of the reference driver in each ego.

    Args:
        egos: The egos.
        others: The vehicles that they watch.
        lane_half_width: Half the width of the ego's lane [m].
    """
    cos, sin = np.abs(np.cos(others.heading)), np.abs(np.sin(others.heading))
    half_along = (cos * others.length + sin * others.width) / 2
    half_across = (sin * others.length + cos * others.width) / 2
    away, side = others.station - egos.station, np.where(others.offset >= 0, 1.0, -1.0)
    near_edge = np.abs(others.offset) - half_across
    side_gap = near_edge - egos.width / 2
    return View(
        ahead=away > 0,
        away=away,
        left=others.offset,
        heading=others.heading,
        same_direction=is_same_direction(others.heading),
        gap=np.abs(away) - half_along - egos.length / 2,
        side_gap=side_gap,
        in_corridor=side_gap <= 0.0,
        near_edge=near_edge,
        speed=others.speed,
        along=others.speed * np.cos(others.heading),
        towards=-side * others.sideways,
        crossing=-side * others.speed * np.sin(others.heading),
        acceleration=others.acceleration,
        yaw_rate=others.yaw_rate,
        length=others.length,
        width=others.width,
        ego_speed=egos.speed,
        ego_acceleration=egos.acceleration,
        ego_length=egos.length,
        ego_width=egos.width,
        lane_half_width=lane_half_width,
    )


def braked_speed(drivers: Braker, egos: WatchingEgos, view: View, dt: float) -> Floats:
    """Advance drivers by a step and return the speeds to which they brake.

    Args:
        drivers: The drivers.
        egos: The egos.
        view: What they see.
        dt: Step [s].

    Returns:
        The speed at the end of the step ``(N,)`` [m/s]; inf if the driver does not brake.
    """
    acceleration = drivers.step(view)
    speed = np.maximum(egos.speed[:, 0] + np.nan_to_num(acceleration) * dt, 0.0)
    return np.where(np.isnan(acceleration), np.inf, speed)


class Watcher:
    """One reference driver in one ego. It remembers the vehicles that it watches and their past poses."""

    def __init__(self, driver: type[Braker], dt: float) -> None:
        """Start without any memory.

        Args:
            driver: The class of the reference driver.
            dt: Step of the simulation [s].
        """
        self._driver, self._dt = driver((1, 0), dt), dt
        self._watched: list[str] = []
        self._past: dict[str, deque[PastPose]] = {}

    @property
    def watched(self) -> Sequence[str]:
        """Ids of the vehicles that are watched now, in the order of the driver's columns."""
        return self._watched

    @property
    def driver(self) -> Braker:
        """The reference driver."""
        return self._driver

    def speed(
        self, ego: VehicleState, others: Sequence[VehicleState], path: EgoPaths, lane_half_width: float,
        sight: float = math.inf,
    ) -> float:  # fmt: skip
        """Look at the traffic of one step.

        Args:
            ego: The ego's state now.
            others: The other vehicles near it. The ego itself and hidden road users are left out.
            path: The ego's path, of one ego.
            lane_half_width: Half the width of the ego's lane [m].
            sight: How far ahead along the path the road lets the driver see [m].

        Returns:
            The speed to which the driver brakes within this step [m/s]; ``inf`` if it does not brake.
        """
        near = [o for o in others if o.id != ego.id and _in_sight(ego, o) and _is_noticed(o)]
        seen = [o for o, reached in zip(near, in_reach(path, ego, near, sight), strict=True) if reached]
        column = {name: k for k, name in enumerate(self._watched)}
        self._driver.watch(np.array([column.get(o.id, -1) for o in seen], dtype=np.intp))
        self._watched = [o.id for o in seen]
        self._remember(seen)
        station, _, _ = path.locate(np.array([[ego.x]]), np.array([[ego.y]]))
        speed, acceleration = np.array([[ego.speed]]), np.array([[ego.acceleration]])
        egos = WatchingEgos(station, speed, acceleration, ego.length, ego.width)
        view = view_of(egos, self._located(path, seen), lane_half_width)
        return float(braked_speed(self._driver, egos, view, self._dt)[0])

    def _remember(self, others: Sequence[VehicleState]) -> None:
        """Append the present poses and forget vehicles out of sight."""
        steps = max(1, round(YAW_RATE_SPAN_S / self._dt)) + 1
        self._past = {o.id: self._past.get(o.id, deque(maxlen=steps)) for o in others}
        for vehicle in others:
            self._past[vehicle.id].append((vehicle.x, vehicle.y, vehicle.heading))

    def _located(self, path: EgoPaths, others: Sequence[VehicleState]) -> WatchedVehicles:
        """Return the vehicles in the frame of the path, ``(1, M)``."""
        states = np.array([(o.x, o.y, o.heading, o.speed, o.acceleration, o.length, o.width) for o in others])
        x, y, heading, speed, acceleration, length, width = states.reshape(-1, 7).T[:, None, :]
        past = [self._past[o.id] for o in others]
        x_before, y_before, _ = np.array([p[max(len(p) - 2, 0)] for p in past]).reshape(-1, 3).T[:, None, :]
        first_heading = np.array([p[0][2] for p in past])[None, :]
        span = np.array([max(len(p) - 1, 1) * self._dt for p in past])[None, :]
        station, offset, direction = path.locate(x, y)
        sideways = ((y - y_before) * np.cos(direction) - (x - x_before) * np.sin(direction)) / self._dt
        return WatchedVehicles(
            station, offset, wrap_below_pi(heading - direction), speed, sideways, acceleration,
            wrap_below_pi(heading - first_heading) / span, length, width,
        )  # fmt: skip


def path_of(observation: Observation, behind: Floats | None = None) -> EgoPaths:
    """Return the ego's path: that of the engine or, without one, a straight path.

    Args:
        observation: What the driver sees now.
        behind: Earlier positions of the ego ``(n, 2)`` [m]; the path begins with them.
    """
    ego = observation.ego
    points: Floats
    if observation.path is not None and len(observation.path) > 1:
        points = np.asarray(observation.path, dtype=np.float64).T
    else:
        heading = ego.heading if observation.lane_heading is None else observation.lane_heading
        ahead = np.array([0.0, STRAIGHT_PATH_M])
        points = np.stack([ego.x + ahead * np.cos(heading), ego.y + ahead * np.sin(heading)])
    if behind is not None and len(behind):
        to_path = points[:, :1] - behind.T
        direction = points[:, 1] - points[:, 0]
        before = (to_path.T @ direction) > np.hypot(*direction)  # more than 1 m before its first point
        points = np.concatenate([behind.T[:, before], points], axis=1)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=1)))])
    stations = np.linspace(0.0, length[-1], max(2, round(length[-1] / PATH_SPACING_M) + 1))
    points = np.stack([np.interp(stations, length, values) for values in points])
    dx, dy = np.diff(points[0]), np.diff(points[1])
    headings = np.arctan2(np.append(dy, dy[-1]), np.append(dx, dx[-1]))
    return EgoPaths(
        Boxes(points[0][None], points[1][None], headings[None], 0.0 * headings[None], ego.length, ego.width)
    )


def lane_half_width_of(observation: Observation) -> float:
    """Return half the width of the ego's lane [m]."""
    return HALF_LANE_M if observation.road is None else observation.road.width / 2


def _in_sight(ego: VehicleState, other: VehicleState) -> bool:
    """Return whether the two can meet soon, in whichever direction they turn."""
    reach = MIN_SIGHT_M + SIGHT_S * (ego.speed + other.speed)
    return abs(other.x - ego.x) < reach and abs(other.y - ego.y) < reach


def _is_noticed(other: VehicleState) -> bool:
    """Return whether a driver that watches can see another road user; others can hide pedestrians and cyclists."""
    return not (isinstance(other, Vehicle) and is_unprotected(other) and not other.visible)
