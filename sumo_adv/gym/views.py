"""What an agent observes: numbers on its own vehicle, its way, and the vehicles near it, in its vehicle's frame.

``docs/gym.md`` has the table of all numbers. A dictionary has them in SI units. A vector has the same numbers, one
after the other, each divided by its largest possible value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sumo_adv.datatypes import VehicleState
from sumo_adv.drivers import LaneSpeed, Observation
from sumo_adv.drivers.careful import CarefulEgo
from sumo_adv.geometry import Path, stations
from sumo_adv.situation import Target

ViewNumbers = NDArray[np.float32]
AgentView = dict[str, ViewNumbers]
"""``own`` (9,), ``path`` (10, 2), ``vehicles`` (n, 13).

An ego's view may have ``danger`` (2,), and an adversary's has ``ego`` (13,).
"""

SIGHT_M = 120.0  # range of a driver's sight
MAX_VIEWED_SPEED_M_S = 60.0
OWN_MAXIMA = (MAX_VIEWED_SPEED_M_S, 15.0, 10.0, 1.0, 1.0, MAX_VIEWED_SPEED_M_S, 1.0, 1.0, SIGHT_M)
"""The largest values of an agent's own numbers.

They are speed, acceleration, offset from the way, sine and cosine of the heading relative to the way, speed limit,
whether there is a lane to the left, whether there is a lane to the right, and the distance to the next line at which
the agent must wait (``SIGHT_M`` without one), in SI units.
"""
OTHER_MAXIMA = (
    1.0,
    SIGHT_M,
    SIGHT_M,
    1.0,
    1.0,
    MAX_VIEWED_SPEED_M_S,
    30.0,
    5.0,
    MAX_VIEWED_SPEED_M_S,
    MAX_VIEWED_SPEED_M_S,
    SIGHT_M,
    30.0,
    2.0,
)
"""The largest values of another vehicle's numbers.

They are whether the vehicle exists, metres ahead, metres to the left, cosine and sine of the heading, speed, length,
width, velocity relative to the agent's ahead and to the left, metres ahead along the agent's way, metres to the left of
the agent's way, and how fast the vehicle approaches [1/s], as the share of the distance per second.
"""
DANGER_MAXIMA = (1.0, 10.0)
"""The largest values of whether a careful driver sees a danger, and how hard it brakes now [m/s2]."""
SIGNED_OWN, SIGNED_OTHER = (1, 2, 3, 4), (1, 2, 3, 4, 8, 9, 10, 11, 12)  # columns that may be negative
PATH_POINTS_M = tuple(5.0 * k for k in range(1, 11))  # the stations of the points of the way
SAME_POINT_M = 1e-3  # nearer points of a way count as one, such as at its end


@dataclass(frozen=True, slots=True)
class Viewing:
    """What views hold.

    Attributes:
        vehicles: The number of other vehicles.
        vector: Whether a view is one vector instead of a dictionary.
        danger: Whether the ego observes what the reference driver ``cc_human`` would call a danger.
    """

    vehicles: int = 8
    vector: bool = True
    danger: bool = False

    def space(self, *, adversary: bool) -> spaces.Space[Any]:
        """Return the space of an agent's observations.

        Args:
            adversary: Whether the agent drives the adversary.
        """
        absent = {"danger"} if adversary else {"ego"} if self.danger else {"ego", "danger"}
        names = [name for name in _LARGEST if name not in absent]
        rows = {"path": len(PATH_POINTS_M), "vehicles": self.vehicles}
        lows, highs = (
            {name: np.tile(table[name], (rows[name], 1)) if name in rows else table[name] for name in names}
            for table in (_SMALLEST, _LARGEST)
        )
        if not self.vector:
            return spaces.Dict({name: spaces.Box(lows[name], highs[name], dtype=np.float32) for name in names})
        low = np.concatenate([(lows[name] / highs[name]).ravel() for name in names])
        return spaces.Box(low, np.ones_like(low), dtype=np.float32)

    def given(self, view: AgentView) -> AgentView | ViewNumbers:
        """Return a view as the agent gets it.

        Args:
            view: The view.
        """
        if not self.vector:
            return {name: values.copy() for name, values in view.items()}
        return np.concatenate([(values / _LARGEST[name]).ravel() for name, values in view.items()])


_COLUMNS: Mapping[str, tuple[Sequence[float], Sequence[int]]] = {  # largest values, and columns that may be negative
    "own": (OWN_MAXIMA, SIGNED_OWN), "danger": (DANGER_MAXIMA, ()), "path": ((SIGHT_M, SIGHT_M), (0, 1)),
    "ego": (OTHER_MAXIMA, SIGNED_OTHER),
    "vehicles": (OTHER_MAXIMA, SIGNED_OTHER),
}  # fmt: skip
_LARGEST: Mapping[str, ViewNumbers] = {name: np.array(largest, np.float32) for name, (largest, _) in _COLUMNS.items()}
_SMALLEST: Mapping[str, ViewNumbers] = {
    name: np.array([-v if k in signed else 0.0 for k, v in enumerate(largest)], np.float32)
    for name, (largest, signed) in _COLUMNS.items()
}


class AgentWatch:
    """The careful driver as a passenger: it watches every step of the simulation and does not drive."""

    def __init__(self) -> None:
        """Start without having seen anything."""
        self._driver, self._braking = CarefulEgo(), 0.0

    def step(self, seen: Observation) -> None:
        """Watch a step.

        Args:
            seen: What the ego's driver sees.
        """
        action = self._driver.act(seen)
        speed = action.speed if isinstance(action, LaneSpeed) else None
        self._braking = 0.0 if speed is None else (seen.ego.speed - speed) / seen.dt

    @property
    def danger(self) -> tuple[float, float]:
        """The numbers of ``DANGER_MAXIMA``."""
        return float(bool(self._driver.dangers)), self._braking


def view_of_ego(seen: Observation, vehicles: int, watch: AgentWatch | None = None) -> AgentView:
    """Return what the ego observes.

    Args:
        seen: What its driver sees.
        vehicles: The number of other vehicles.
        watch: The careful driver, which has watched this step and those before; None leaves ``danger`` out.
    """
    me, road = seen.ego, seen.road
    turned = 0.0 if seen.lane_heading is None else me.heading - seen.lane_heading
    offset = 0.0 if seen.lane_offset is None else seen.lane_offset
    limit, left, right, stop = MAX_VIEWED_SPEED_M_S, False, False, SIGHT_M
    if road is not None:
        limit = road.limit
        left, right = any(side > 0 for side in road.sides), any(side < 0 for side in road.sides)
        stop = next((line.ahead for line in road.stop_lines if line.must_wait), SIGHT_M)
    own = (me.speed, me.acceleration, offset, math.sin(turned), math.cos(turned), limit, left, right, stop)
    points = None if seen.path is None else np.asarray(seen.path)
    path = _in_frame(me, _onward(me, points))
    danger = {} if watch is None else {"danger": watch.danger}
    return _bounded({"own": own, **danger, "path": path, "vehicles": _nearest(me, path, seen.others, vehicles)})


class ViewOfAdversary:
    """What the adversary observes.

    Its way is its unattacked way or, if that is unknown, the first one. It sees the ego apart from other vehicles.
    """

    def __init__(self, target: Target, vehicles: int) -> None:
        """Start at the beginning of the attack.

        Args:
            target: The adversary.
            vehicles: The number of other vehicles.
        """
        self._target, self._vehicles = target, vehicles
        self.way: Path = target.ways[target.unattacked or 0].path
        self.station, self.offset = target.station, target.offset

    def __call__(self, me: VehicleState, ego: VehicleState, others: Sequence[VehicleState]) -> AgentView:
        """Return what the adversary observes.

        Args:
            me: The adversary's state.
            ego: The ego's state.
            others: The states of other vehicles.
        """
        self.station, self.offset = self.way.project(me.x, me.y, near=self.station)
        x, y, heading = self.way.at(self.station + np.array([0.0, *PATH_POINTS_M]))
        turned = me.heading - float(heading[0])
        sides = [side for side, way in self._target.sides if way == "same"]
        left, right = any(side > 0 for side in sides), any(side < 0 for side in sides)
        own = (
            me.speed, me.acceleration, self.offset, math.sin(turned), math.cos(turned), self._target.fastest, left,
            right, SIGHT_M,
        )  # fmt: skip
        path = _in_frame(me, np.column_stack([x, y])[1:])
        return _bounded({
            "own": own, "path": path, "ego": _rows(me, path, [ego])[0],
            "vehicles": _nearest(me, path, others, self._vehicles),
        })  # fmt: skip


def _bounded(view: dict[str, Any]) -> AgentView:
    """Clip numbers to the bounds of their space."""
    return {
        name: np.clip(np.asarray(values, np.float32), _SMALLEST[name], _LARGEST[name]) for name, values in view.items()
    }


def _onward(me: VehicleState, points: NDArray[Any] | None) -> NDArray[Any]:
    """Return the points of the ego's path at ``PATH_POINTS_M``; straight on without a path."""
    ahead = np.array(PATH_POINTS_M)
    straight = np.column_stack([me.x + ahead * math.cos(me.heading), me.y + ahead * math.sin(me.heading)])
    if points is None or len(points) < 2:
        return straight
    here = int(np.argmin((points[:, 0] - me.x) ** 2 + (points[:, 1] - me.y) ** 2))
    station = stations(points[here:, 0], points[here:, 1])
    if len(station) < 2:
        return straight
    return np.column_stack([np.interp(ahead, station, points[here:, k]) for k in (0, 1)])


def _in_frame(me: VehicleState, points: NDArray[Any]) -> NDArray[Any]:
    """Return points in the frame of a vehicle."""
    dx, dy, c, s = points[:, 0] - me.x, points[:, 1] - me.y, math.cos(me.heading), math.sin(me.heading)
    return np.column_stack([c * dx + s * dy, c * dy - s * dx])


def _nearest(me: VehicleState, path: NDArray[Any], others: Sequence[VehicleState], count: int) -> NDArray[Any]:
    """Return the rows of the nearest vehicles, with rows of zeros if there are fewer."""
    near = sorted(others, key=lambda v: (v.x - me.x) ** 2 + (v.y - me.y) ** 2)[:count]
    rows = np.zeros((count, len(OTHER_MAXIMA)))
    if near:
        rows[: len(near)] = _rows(me, path, near)
    return rows


def _rows(me: VehicleState, path: NDArray[Any], others: Sequence[VehicleState]) -> NDArray[Any]:
    """Return a row of ``OTHER_MAXIMA`` for each vehicle; ``path`` is the agent's way in its frame."""
    states = np.array([(v.x, v.y, v.heading, v.speed, v.length, v.width) for v in others])
    x, y = _in_frame(me, states[:, :2]).T
    turn, speed = states[:, 2] - me.heading, states[:, 3]
    cos, sin = np.cos(turn), np.sin(turn)
    ahead, left = speed * cos - me.speed, speed * sin
    along, aside = _beside(path, x, y)
    approach = -(x * ahead + y * left) / np.maximum(x**2 + y**2, 1.0)
    there = np.ones(len(states))
    return np.column_stack([there, x, y, cos, sin, speed, *states[:, 4:].T, ahead, left, along, aside, approach])


def _beside(path: NDArray[Any], x: NDArray[Any], y: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return where points are along a way and to the left of it [m]; the way goes straight on at both ends."""
    path = path[np.concatenate([[True], np.hypot(*np.diff(path, axis=0).T) > SAME_POINT_M])]
    if len(path) < 2:
        return x, y - path[0, 1]
    starts, steps = path[:-1], np.diff(path, axis=0)
    lengths = np.hypot(*steps.T)
    stations = PATH_POINTS_M[0] + np.concatenate([[0.0], np.cumsum(lengths[:-1])])
    c, s = (steps / lengths[:, None]).T
    dx, dy = x[:, None] - starts[:, 0], y[:, None] - starts[:, 1]
    along, aside = c * dx + s * dy, c * dy - s * dx
    low, high = np.zeros(len(lengths)), lengths.copy()
    low[0], high[-1] = -math.inf, math.inf
    off = np.hypot(along - np.clip(along, low, high), aside)
    rows, nearest = np.arange(len(x)), np.argmin(off, axis=1)
    return (stations + along)[rows, nearest], aside[rows, nearest]
