"""The careful and competent human driver of UN Regulation No. 157: one rule set, driven and predicted.

When a danger shows, and how the driver brakes, are the rules of the reference driver ``cc_human``
(``metrics/reference/cc_human.py``). Until then one of SUMO's drivers drives. The careful driver does not steer.

- ``CarefulEgo`` drives the ego: one driver that watches all vehicles in sight, in the frame of the engine's path.
- ``CarefulDrivers`` predicts it: N drivers that watch one adversary each, in the frame of the ego's unattacked path.
  It leaves out other vehicles, and what the driver saw before the attack. Yaw rates are relative to the path, which
  makes a difference on bends.

Both describe boxes by ``Egos`` and ``Others``; ``view_of`` makes the reference driver's ``View`` of them.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sumo_adv.datatypes import Boxes, DriverModel, Floats, VehicleState
from sumo_adv.drivers.protocol import Action, LaneSpeed, Observation, Vehicle
from sumo_adv.drivers.sumo_driven import MODELS, known_model, sumo_type
from sumo_adv.errors import UsageError
from sumo_adv.geometry import wrap_below_pi
from sumo_adv.metrics.reference.cc_human import CcHuman
from sumo_adv.metrics.reference.view import HISTORY, EgoPaths, View
from sumo_adv.road_users import is_unprotected

HALF_LANE = 1.6  # m, half of SUMO's default lane
SIGHT = 5.0  # s of driving at both speeds within which a vehicle is watched
LEAST_SIGHT = 20.0  # m
SPACING = 2.0  # m between the points of a path
AHEAD = 150.0  # m, length of the straight path where the engine does not give one
PastPose = tuple[float, float, float]  # x, y [m], heading [rad]


@dataclass(frozen=True, slots=True)
class Egos:
    """N egos on their paths: station [m], speed [m/s], acceleration [m/s2], each ``(N, 1)``; size [m]."""

    station: Floats
    speed: Floats
    acceleration: Floats
    length: float
    width: float


@dataclass(frozen=True, slots=True)
class Others:
    """The M vehicles that each ego watches, box centres in the frame of the ego's path, arrays ``(N, M)``.

    station, offset [m, left positive]; heading against the path [rad]; speed [m/s]; sideways: change of the offset over
    the last step [m/s]; acceleration [m/s2]; yaw_rate: mean over the last ``HISTORY`` seconds [rad/s]; size [m].
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


def view_of(egos: Egos, others: Others) -> View:
    """The view of the reference driver in each ego, on a lane of ``HALF_LANE``."""
    cos, sin = np.abs(np.cos(others.heading)), np.abs(np.sin(others.heading))
    half_along = (cos * others.length + sin * others.width) / 2
    half_across = (sin * others.length + cos * others.width) / 2
    away, side = others.station - egos.station, np.where(others.offset >= 0, 1.0, -1.0)
    near_edge = np.abs(others.offset) - half_across
    return View(
        ahead=away > 0,
        away=away,
        left=others.offset,
        heading=others.heading,
        gap=np.abs(away) - half_along - egos.length / 2,
        side_gap=near_edge - egos.width / 2,
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
        lane_half_width=HALF_LANE,
    )


def braked_speed(drivers: CcHuman, egos: Egos, others: Others, dt: float) -> Floats:
    """The speed [m/s] to which each driver brakes within the step of ``dt`` [s], ``(N,)``; inf if it does not brake."""
    acceleration = drivers.step(view_of(egos, others))
    speed = np.maximum(egos.speed[:, 0] + np.nan_to_num(acceleration) * dt, 0.0)
    return np.where(np.isnan(acceleration), np.inf, speed)


class CarefulEgo:
    """The controller. It remembers the vehicles it watches, their past poses, and its decisions."""

    name = "careful"
    reference = "cc_human"  # the reference driver that it is
    forkable = True
    needs_observation = True

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        """``parameters``: ``driver`` (krauss, idm or eidm; default idm) and that model's own. Raises UsageError."""
        own = dict(parameters or {})
        driver = own.pop("driver", "idm")
        if driver not in MODELS:
            raise UsageError(f"The ego 'careful' has no driver {driver!r}; choose one of {', '.join(MODELS)}.")
        self.sumo_type: Mapping[str, str] = sumo_type(driver, own)
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Forget all vehicles; the seed is not needed."""
        self._driver: CcHuman | None = None
        self._watched: list[str] = []
        self._past: dict[str, deque[PastPose]] = {}

    def model_of(self, numbers: DriverModel) -> DriverModel:
        """Predicted by ``CarefulDrivers``, with IDM's car following."""
        return known_model(self.name, numbers)

    @property
    def dangers(self) -> frozenset[str]:
        """The vehicles that are a danger now."""
        if self._driver is None or not self._watched:
            return frozenset()
        return frozenset(name for name, danger in zip(self._watched, self._driver.danger[0], strict=True) if danger)

    def act(self, observation: Observation) -> Action:
        """Brake if a danger has shown for long enough; else None."""
        ego, dt = observation.ego, observation.dt
        others = [o for o in observation.others if o.id != ego.id and _in_sight(ego, o) and is_noticed(o)]
        if self._driver is None:
            self._driver = CcHuman((1, 0), dt)
        column = {name: k for k, name in enumerate(self._watched)}
        self._driver.watch(np.array([column.get(o.id, -1) for o in others], dtype=np.intp))
        self._watched = [o.id for o in others]
        self._remember(others, dt)
        path = _path(observation)
        station, _, _ = path.locate(np.array([[ego.x]]), np.array([[ego.y]]))
        speed, acceleration = np.array([[ego.speed]]), np.array([[ego.acceleration]])
        egos = Egos(station, speed, acceleration, ego.length, ego.width)
        target = float(braked_speed(self._driver, egos, self._located(path, others, dt), dt)[0])
        return None if math.isinf(target) else LaneSpeed(None, target)

    def _remember(self, others: Sequence[VehicleState], dt: float) -> None:
        """Append the present poses; forget vehicles out of sight."""
        steps = max(1, round(HISTORY / dt)) + 1
        self._past = {o.id: self._past.get(o.id, deque(maxlen=steps)) for o in others}
        for vehicle in others:
            self._past[vehicle.id].append((vehicle.x, vehicle.y, vehicle.heading))

    def _located(self, path: EgoPaths, others: Sequence[VehicleState], dt: float) -> Others:
        """The vehicles in the frame of the path, ``(1, M)``."""
        states = np.array([(o.x, o.y, o.heading, o.speed, o.acceleration, o.length, o.width) for o in others])
        x, y, heading, speed, acceleration, length, width = states.reshape(-1, 7).T[:, None, :]
        past = [self._past[o.id] for o in others]
        x_before, y_before, _ = np.array([p[max(len(p) - 2, 0)] for p in past]).reshape(-1, 3).T[:, None, :]
        first_heading = np.array([p[0][2] for p in past])[None, :]
        span = np.array([max(len(p) - 1, 1) * dt for p in past])[None, :]
        station, offset, direction = path.locate(x, y)
        sideways = ((y - y_before) * np.cos(direction) - (x - x_before) * np.sin(direction)) / dt
        return Others(
            station, offset, wrap_below_pi(heading - direction), speed, sideways, acceleration,
            wrap_below_pi(heading - first_heading) / span, length, width,
        )  # fmt: skip


class CarefulDrivers:
    """N predicted drivers, each of which watches one adversary of a length and width [m], ``(N,)``."""

    def __init__(self, ego: tuple[float, float], length: Floats, width: Floats, dt: float) -> None:
        """``ego``: length and width [m]."""
        self._ego, self._length, self._width, self._dt = ego, length[:, None], width[:, None], dt
        self._history = max(1, round(HISTORY / dt))
        self._past: list[tuple[Floats, Floats, Floats]] = []  # offset, heading, speed of the last steps, (N, 1)
        self._drivers = CcHuman((len(length), 1), dt)

    def bound(
        self, ego: tuple[Floats, Floats, Floats], adversary: tuple[Floats, Floats, Floats], speed: Floats
    ) -> Floats:
        """The speeds [m/s] to which the drivers brake within this step, ``(N,)``; inf if they do not brake.

        ego: station, speed, acceleration. adversary: station, offset, heading of box centres in the frame of the ego's
        path; ``speed`` [m/s]. All are ``(N,)``.
        """
        station, offset, heading = (values[:, None] for values in adversary)
        v = speed[:, None]
        offset_before, _, v_before = self._past[-1] if self._past else (offset, heading, v)
        first_heading = self._past[0][1] if self._past else heading
        span = max(len(self._past), 1) * self._dt
        self._past = [*self._past, (offset, heading, v)][-self._history :]
        others = Others(
            station, offset, heading, v, (offset - offset_before) / self._dt, (v - v_before) / self._dt,
            wrap_below_pi(heading - first_heading) / span, self._length, self._width,
        )  # fmt: skip
        ego_station, ego_speed, ego_acceleration = (values[:, None] for values in ego)
        egos = Egos(ego_station, ego_speed, ego_acceleration, *self._ego)
        return braked_speed(self._drivers, egos, others, self._dt)


def _in_sight(ego: VehicleState, other: VehicleState) -> bool:
    """Whether the two can meet soon, in whatever direction they turn."""
    reach = LEAST_SIGHT + SIGHT * (ego.speed + other.speed)
    return abs(other.x - ego.x) < reach and abs(other.y - ego.y) < reach


def is_noticed(other: VehicleState) -> bool:
    """Whether a driver that watches can see another road user: not a pedestrian or cyclist that others hide."""
    return not (isinstance(other, Vehicle) and is_unprotected(other) and not other.visible)


def _path(observation: Observation) -> EgoPaths:
    """The engine's path of the ego, else a straight one."""
    ego = observation.ego
    points: Floats
    if observation.path is not None and len(observation.path) > 1:
        points = np.asarray(observation.path, dtype=np.float64).T
    else:
        heading = ego.heading if observation.lane_heading is None else observation.lane_heading
        ahead = np.array([0.0, AHEAD])
        points = np.stack([ego.x + ahead * np.cos(heading), ego.y + ahead * np.sin(heading)])
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=1)))])
    stations = np.linspace(0.0, length[-1], max(2, round(length[-1] / SPACING) + 1))
    points = np.stack([np.interp(stations, length, values) for values in points])
    dx, dy = np.diff(points[0]), np.diff(points[1])
    headings = np.arctan2(np.append(dy, dy[-1]), np.append(dx, dx[-1]))
    return EgoPaths(
        Boxes(points[0][None], points[1][None], headings[None], 0.0 * headings[None], ego.length, ego.width)
    )
