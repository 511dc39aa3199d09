"""Vehicles, how they move and are predicted to move, and the roads that they are on."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]
Acceleration = float | tuple[tuple[float, float], ...]
"""m/s2: a number, or 1 to ``MAX_KNOTS`` knots (s since the takeover, m/s2); linear between, constant outside."""
MAX_KNOTS = 4
MPH_M_S = 0.44704  # one mile per hour


class Role(StrEnum):
    """What a vehicle is in a run."""

    EGO = "ego"
    ADVERSARY = "adversary"
    BACKGROUND = "background"
    OBSTACLE = "obstacle"


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of an adversary's motion: those of a passenger car. Settings can change them."""

    braking: float = 8.0  # m/s2, positive
    acceleration: float = 4.0  # m/s2
    lateral: float = 4.0  # m/s2
    curvature: float = 0.2  # 1/m
    jerk: float = 12.0  # m/s3, longitudinal


def acceleration_at(acceleration: Acceleration, time: float) -> float:
    """The number [m/s2] that holds ``time`` [s] after the takeover."""
    if not isinstance(acceleration, tuple):
        return float(acceleration)
    times, values = zip(*acceleration, strict=True)
    return float(np.interp(time, times, values))


def acceleration_of(value: Any, limits: Limits | None = None) -> Acceleration:
    """An acceleration from what JSON holds: a number or a list of [time, m/s2]. Raises ValueError: it is neither, or
    beyond the limits where they are given; with a sentence."""
    knots = value if isinstance(value, list | tuple) else [[0.0, value]]
    if not 1 <= len(knots) <= MAX_KNOTS or not all(isinstance(k, list | tuple) and len(k) == 2 for k in knots):
        raise ValueError(f"acceleration must be a number or 1 to {MAX_KNOTS} knots [time, acceleration].")
    if not all(isinstance(n, int | float) and not isinstance(n, bool) and abs(n) < 1e6 for k in knots for n in k):
        raise ValueError("acceleration must be made of finite numbers.")
    times = [k[0] for k in knots]
    if times[0] < 0 or sorted(set(times)) != times:
        raise ValueError("The times of the acceleration knots must be 0 or more, and ascending.")
    if limits is not None:
        low, high = -limits.braking, limits.acceleration
        worst = next((k[1] for k in knots if not low <= k[1] <= high), None)
        if worst is not None:
            raise ValueError(f"The acceleration {worst:g} m/s2 is beyond the limits, {low:g} to {high:g}.")
    return tuple((float(t), float(a)) for t, a in knots) if isinstance(value, list | tuple) else float(value)


def plain_acceleration(acceleration: Acceleration) -> float | list[list[float]]:
    """An acceleration as JSON has it: a number or a list of [time, m/s2]."""
    return [list(k) for k in acceleration] if isinstance(acceleration, tuple) else acceleration


@dataclass(frozen=True, slots=True)
class Boxes:
    """Oriented, moving boxes. All arrays broadcast against one another (any shape, often ``(time,)`` or ``(n, time)``).
    x, y: centre [m]; heading [rad]; speed [m/s] along the heading; length, width [m]; z: height of the road under it
    [m], a number where all is flat (see ``geometry.same_layer``)."""

    x: Floats
    y: Floats
    heading: Floats
    speed: Floats
    length: Floats | float
    width: Floats | float
    z: Floats | float = 0.0


@dataclass(frozen=True, slots=True)
class Track:
    """One vehicle's motion on a regular time grid. Arrays are ``(n,)``. time [s]; x, y box centre [m]; heading [rad];
    speed [m/s]; acceleration [m/s2]; lane: SUMO lane ids ('' = off); z: height of the road [m], a number where all is
    flat."""

    id: str
    role: Role
    time: Floats
    x: Floats
    y: Floats
    heading: Floats
    speed: Floats
    acceleration: Floats
    length: float
    width: float
    lane: tuple[str, ...] = ()
    z: Floats | float = 0.0

    def boxes(self) -> Boxes:
        """The track as boxes over time."""
        return Boxes(self.x, self.y, self.heading, self.speed, self.length, self.width, self.z)

    def between(self, start: float, end: float) -> Track:
        """The part with ``start <= time <= end`` (with half a millisecond of slack)."""
        return self.picked(np.flatnonzero((self.time >= start - 5e-4) & (self.time <= end + 5e-4)))

    def picked(self, keep: Ints) -> Track:
        """The states at these places."""
        lane = tuple(self.lane[i] for i in keep) if self.lane else ()
        return Track(
            self.id, self.role, self.time[keep], self.x[keep], self.y[keep], self.heading[keep], self.speed[keep],
            self.acceleration[keep], self.length, self.width, lane,
            self.z[keep] if isinstance(self.z, np.ndarray) else self.z,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class LaneStrip:
    """One lane as a strip of ground.

    Attributes:
        shape: Its centreline in the direction of traffic, ``(n, 2)``, or ``(n, 3)`` with heights [m].
        width: Its width [m].
        internal: Whether it is inside a junction.
    """

    shape: Floats
    width: float
    internal: bool


class RoadClass(StrEnum):
    """Where the ego is when an attack may begin; ``episode/encounter_detector.py`` has the rules."""

    MOTORWAY = "motorway"
    RURAL = "rural"
    URBAN = "urban"
    JUNCTION = "junction"


class RoadGeometry(StrEnum):
    """Whether other roads join or leave the ego's; the road geometries of ISO 34502."""

    MAIN = "main roadway"
    MERGE = "merge zone"
    DEPARTURE = "departure zone"


@dataclass(frozen=True, slots=True)
class RoadPlace:
    """What surrounds the ego when an attack may begin. road: None off the network. limit: the speed limit [m/s], None
    off the network. speed: the ego's [m/s]. vehicles_near: how many vehicles are within 70 m of it. geometry: None off
    the network and before a junction at which ways cross."""

    road: RoadClass | None
    limit: float | None
    speed: float
    vehicles_near: int
    geometry: RoadGeometry | None = None


@dataclass(frozen=True, slots=True)
class VehicleState:
    """One vehicle at one time. x, y box centre [m]; heading [rad]; speed [m/s]; acceleration [m/s2]; z: height of the
    road under it [m]."""

    id: str
    x: float
    y: float
    heading: float
    speed: float
    acceleration: float
    length: float
    width: float
    lane: str
    z: float = 0.0


@dataclass(frozen=True, slots=True)
class DriverModel:
    """How the ego's driver is predicted: which rules it follows, and the numbers of its car following.

    kind: ``krauss``, ``idm``, ``eidm``, ``careful`` or ``replay``. acceleration, deceleration, hardest_braking: all
    positive [m/s2]; tau: headway [s]; min_gap: gap at standstill [m]; speed: desired speed [m/s]. known: False if the
    model is an assumption.
    """

    kind: str
    acceleration: float
    deceleration: float
    tau: float
    min_gap: float
    speed: float
    known: bool = True
    hardest_braking: float = 9.0  # SUMO's emergencyDecel of cars


@dataclass(frozen=True, slots=True)
class PrescribedMotion:
    """An adversary's motion given in advance: its box centre, one pose a step from the step after the takeover on. x, y
    [m]; heading [rad]; speed [m/s]: arrays ``(n,)``."""

    x: Floats
    y: Floats
    heading: Floats
    speed: Floats


@dataclass(frozen=True, slots=True)
class ObservedMotion:
    """How the ego went in an attempt: station on its path [m], offset from it [m, left positive] and speed [m/s] by
    step from the takeover, ``(n,)``. ``seen``: the number of steps that were seen, the rest is at an even speed."""

    s: Floats
    d: Floats
    v: Floats
    seen: int = 0
