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
"""An acceleration [m/s2]: a number, or 1 to ``MAX_KNOTS`` knots (time since the takeover [s], acceleration [m/s2]).
It is linear between knots and constant outside them."""
MAX_KNOTS = 4
MPH_M_S = 0.44704  # one mile per hour


class Role(StrEnum):
    """The role of a vehicle in a run."""

    EGO = "ego"
    ADVERSARY = "adversary"
    BACKGROUND = "background"
    OBSTACLE = "obstacle"


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of an adversary's motion. The defaults are those of a passenger car; settings can change them."""

    braking: float = 8.0  # m/s2, positive
    acceleration: float = 4.0  # m/s2
    lateral: float = 4.0  # m/s2
    curvature: float = 0.2  # 1/m
    jerk: float = 12.0  # m/s3, longitudinal


def acceleration_at(acceleration: Acceleration, time: float) -> float:
    """Evaluate an acceleration at a time.

    Args:
        acceleration: The acceleration.
        time: The time since the takeover [s].

    Returns:
        The acceleration at that time [m/s2].
    """
    if not isinstance(acceleration, tuple):
        return float(acceleration)
    times, values = zip(*acceleration, strict=True)
    return float(np.interp(time, times, values))


def acceleration_of(value: Any, limits: Limits | None = None) -> Acceleration:
    """Read an acceleration from decoded JSON.

    Args:
        value: A number, or a list of [time, acceleration] pairs.
        limits: The limits that each value must respect; None if there are none.

    Raises:
        ValueError: The value has another form, or exceeds the limits. The message is a sentence.
    """
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
    """Convert an acceleration to data for JSON: a number, or a list of [time, acceleration] pairs."""
    return [list(k) for k in acceleration] if isinstance(acceleration, tuple) else acceleration


@dataclass(frozen=True, slots=True)
class Boxes:
    """Oriented, moving boxes.

    All arrays broadcast against one another. Common shapes are ``(time,)`` and ``(n, time)``.

    Attributes:
        x: The x position of the centre [m].
        y: The y position of the centre [m].
        heading: The heading [rad].
        speed: The speed along the heading [m/s].
        length: The length [m].
        width: The width [m].
        z: The height of the road under the box [m]; a number if the network is flat (see ``geometry.same_layer``).
    """

    x: Floats
    y: Floats
    heading: Floats
    speed: Floats
    length: Floats | float
    width: Floats | float
    z: Floats | float = 0.0


@dataclass(frozen=True, slots=True)
class Track:
    """One vehicle's motion on a regular time grid. Arrays have the shape ``(n,)``.

    Attributes:
        id: The vehicle's id.
        role: The vehicle's role.
        time: The times [s].
        x: The x position of the box centre [m].
        y: The y position of the box centre [m].
        heading: The heading [rad].
        speed: The speed [m/s].
        acceleration: The acceleration [m/s2].
        length: The vehicle's length [m].
        width: The vehicle's width [m].
        lane: SUMO's lane ids; an id is '' if the vehicle is on no lane.
        z: The height of the road [m]; a number if the network is flat.
    """

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
        """Return the track as boxes over time."""
        return Boxes(self.x, self.y, self.heading, self.speed, self.length, self.width, self.z)

    def between(self, start: float, end: float) -> Track:
        """Return the part with ``start <= time <= end``, with half a millisecond of tolerance."""
        return self.picked(np.flatnonzero((self.time >= start - 5e-4) & (self.time <= end + 5e-4)))

    def picked(self, keep: Ints) -> Track:
        """Return the states at the indices ``keep``."""
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
    """The surroundings of the ego when an attack may begin.

    Attributes:
        road: The class of the road; None off the network.
        limit: The speed limit [m/s]; None off the network.
        speed: The ego's speed [m/s].
        vehicles_near: The number of vehicles within 70 m of the ego.
        geometry: The geometry of the road; None off the network and ahead of a junction at which paths cross.
    """

    road: RoadClass | None
    limit: float | None
    speed: float
    vehicles_near: int
    geometry: RoadGeometry | None = None


@dataclass(frozen=True, slots=True)
class VehicleState:
    """The state of one vehicle at one time.

    Attributes:
        id: The vehicle's id.
        x: The x position of the box centre [m].
        y: The y position of the box centre [m].
        heading: The heading [rad].
        speed: The speed [m/s].
        acceleration: The acceleration [m/s2].
        length: The vehicle's length [m].
        width: The vehicle's width [m].
        lane: The id of SUMO's lane.
        z: The height of the road under the vehicle [m].
    """

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
    """The model that predicts the ego's driver: its rules and its car-following parameters.

    Attributes:
        kind: The rules: ``krauss``, ``idm``, ``eidm``, ``careful`` or ``replay``.
        acceleration: The maximum acceleration [m/s2].
        deceleration: The deceleration [m/s2], positive.
        tau: The headway [s].
        min_gap: The gap at standstill [m].
        speed: The desired speed [m/s].
        known: Whether the model is known; False if it is an assumption.
        hardest_braking: The hardest braking [m/s2], positive.
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
    """An adversary's motion that is given in advance: one pose per step, from the step after the takeover on.

    Attributes:
        x: The x positions of the box centre [m], ``(n,)``.
        y: The y positions of the box centre [m], ``(n,)``.
        heading: The headings [rad], ``(n,)``.
        speed: The speeds [m/s], ``(n,)``.
    """

    x: Floats
    y: Floats
    heading: Floats
    speed: Floats


@dataclass(frozen=True, slots=True)
class ObservedMotion:
    """The ego's motion in an attempt, one value per step from the takeover on.

    Attributes:
        s: The stations on the ego's path [m], ``(n,)``.
        d: The offsets from the path [m], left positive, ``(n,)``.
        v: The speeds [m/s], ``(n,)``.
        seen: The number of steps that were observed. The remaining steps assume a constant speed.
    """

    s: Floats
    d: Floats
    v: Floats
    seen: int = 0
