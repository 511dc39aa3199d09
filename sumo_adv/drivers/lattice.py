"""The lattice driver's settings, and its rules for one step: ordinary driving, and the wheel.

The driver lays candidate motions along its path (``lattice_candidates.py``), predicts other vehicles on it
(``lattice_frame.py``) and carries out the beginning of the cheapest candidate. It perceives at once and exactly, and
does not know the intentions of others. The rules hold for ``n`` egos at once. ``lattice_ego.py`` drives one ego in SUMO
by them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.drivers.protocol import MAX_STEERING_RAD, WHEELBASE_M
from sumo_adv.drivers.sumo_driven import Idm

COMPARED_STEP_S = 0.2  # between the compared times
BRAKE_RELEASE_M_S3, RELEASED_ACCELERATION_M_S2 = 3.0, -2.0  # how fast it releases the brake, and from where
SETTING_OFF_SPEED_M_S = 1.0  # at lower speeds, the brake is released at once
SLOWING_RATE_1_S = 2.0  # how fast it slows down to a lower desired speed
MIN_DESIRED_SPEED_M_S = 0.5  # the lowest desired speed
STEERING_LOOK_AHEAD_S, MIN_STEERING_LOOK_AHEAD_M = 0.2, 2.0  # how far ahead the wheel aims
LEADER_WIDTH_MARGIN_M = 0.1  # added to the width of the ego's way


@dataclass(frozen=True, slots=True)
class LatticeSettings:
    """The driver's own settings, and those of IDM for ordinary driving.

    Attributes:
        horizon: How far ahead it plans [s].
        braking: Deceleration of its emergency brake [m/s2].
        lateral: Maximum lateral acceleration that its wheel asks for [m/s2].
        idm: Parameters of IDM.
    """

    horizon: float = 4.0
    braking: float = 8.0
    lateral: float = 6.5
    idm: Idm = field(default_factory=Idm)

    @property
    def times(self) -> Floats:
        """The compared times from now ``(time,)`` [s]."""
        return COMPARED_STEP_S * np.arange(round(self.horizon / COMPARED_STEP_S) + 1.0)


class Size(NamedTuple):
    """Length and width of all egos [m]."""

    length: float
    width: float


class LatticeEgos(NamedTuple):
    """Egos on their paths. Arrays are ``(n,)``.

    Attributes:
        s: Station of the box centre [m].
        d: Offset of the box centre from the path [m, left positive].
        speed: Speed [m/s].
        acceleration: Acceleration [m/s2].
        rate: First derivative of the offset [m/s].
        second: Second derivative of the offset [m/s2].
        target: Target offset of the present lateral move [m].
        left: Remaining time of the present lateral move [s].
    """

    s: Floats
    d: Floats
    speed: Floats
    acceleration: Floats
    rate: Floats
    second: Floats
    target: Floats
    left: Floats


class Expected(NamedTuple):
    """Expected boxes of ``m`` vehicles for each ego, along the axes of its path.

    Attributes:
        s: Stations of the centres ``(n, m, time)`` [m]; ``inf`` if the vehicle does not matter to the ego.
        d: Offsets of the centres ``(n, m, time)`` [m].
        half_s: Half extents along the path ``(n, m, time)`` [m].
        half_d: Half extents across the path ``(n, m, time)`` [m].
        speed: Speeds along the path ``(n, m)`` [m/s].
    """

    s: Floats
    d: Floats
    half_s: Floats
    half_d: Floats
    speed: Floats


class Memory(NamedTuple):
    """What egos keep from one step to the next. Arrays are ``(n,)``.

    Attributes:
        acceleration: Acceleration [m/s2].
        reference: Acceleration of ordinary driving [m/s2].
        slip: Slip angle [rad].
        target: Target offset of the lateral move [m].
        left: Remaining time of the lateral move [s].
        second: Second derivative of the offset [m/s2].
    """

    acceleration: Floats
    reference: Floats
    slip: Floats
    target: Floats
    left: Floats
    second: Floats

    @staticmethod
    def first(acceleration: Floats, reference: Floats) -> Memory:
        """Return the memory before the first step: on the centre, the wheel straight."""
        return Memory(acceleration, reference, *(np.zeros(len(acceleration)) for _ in range(4)))

    def egos(self, s: Floats, d: Floats, turn: Floats, speed: Floats) -> LatticeEgos:
        """Return the egos that have this memory.

        Args:
            s: Stations [m].
            d: Offsets [m].
            turn: Headings against the path [rad].
            speed: Speeds [m/s].
        """
        rate = speed * np.sin(turn + self.slip)
        return LatticeEgos(s, d, speed, self.acceleration, rate, self.second, self.target, self.left)


def reference(
    egos: LatticeEgos, size: Size, others: Expected, desired: Floats, cap: Floats, settings: LatticeSettings
) -> Floats:
    """Compute the accelerations of ordinary driving (IDM behind the expected leader).

    Args:
        egos: The egos.
        size: Their size.
        others: The expected vehicles.
        desired: Speeds on a free road ``(n, time)`` [m/s].
        cap: Maximum acceleration now ``(n,)`` [m/s2]. A cap below 0 holds for all times, another one only for the first
            time.
        settings: The driver's settings.

    Returns:
        The accelerations by time ``(n, time)`` [m/s2].
    """
    idm = settings.idm
    rear, pace = _leader(egos, size, others, len(settings.times))
    v, front, root = egos.speed, egos.s + size.length / 2, 2 * np.sqrt(idm.accel * idm.decel)
    result = np.empty_like(rear)
    for k in range(rear.shape[1]):
        free_road = _free(v, np.maximum(desired[:, k], MIN_DESIRED_SPEED_M_S), idm)
        wish = idm.minGap + np.maximum(0.0, v * idm.tau + v * (v - pace[:, k]) / root)
        gap = np.maximum(rear[:, k] - front, 0.1)
        held = idm.accel * (_free(v, desired[:, k], idm) - (wish / gap) ** 2)
        a = np.minimum(np.minimum(idm.accel * free_road, np.where(np.isfinite(gap), held, np.inf)), cap)
        result[:, k] = a = np.minimum(np.maximum(a, np.maximum(-settings.braking, -v / COMPARED_STEP_S)), idm.accel)
        front = front + np.maximum(v * COMPARED_STEP_S + a * COMPARED_STEP_S * COMPARED_STEP_S / 2, 0.0)
        v = np.maximum(v + a * COMPARED_STEP_S, 0.0)
        cap = np.where(cap < 0.0, cap, np.inf)
    return result


def eased(cap: Floats, speed: Floats, before: Floats, dt: float) -> Floats:
    """Lower a cap so that the brake is released gradually.

    Args:
        cap: Maximum acceleration [m/s2].
        speed: Speed [m/s].
        before: Acceleration of ordinary driving one step ago [m/s2].
        dt: Step [s].

    Returns:
        The lower cap [m/s2].
    """
    gradual = np.maximum(before, RELEASED_ACCELERATION_M_S2) + BRAKE_RELEASE_M_S3 * dt
    return np.where(speed > SETTING_OFF_SPEED_M_S, np.minimum(cap, gradual), cap)


def look_ahead(speed: Floats) -> Floats:
    """Return how far ahead the wheel aims [m], at a speed [m/s]."""
    return np.maximum(STEERING_LOOK_AHEAD_S * speed, MIN_STEERING_LOOK_AHEAD_M)


def steering(angle: Floats, ahead: Floats, speed: Floats, lateral: float) -> tuple[Floats, Floats]:
    """Compute the wheel angle that leads to a point.

    Args:
        angle: Direction to the point against the heading [rad].
        ahead: Distance of the point [m].
        speed: Speed [m/s].
        lateral: Maximum lateral acceleration [m/s2].

    Returns:
        The wheel angle [rad] and the slip angle [rad].
    """
    grip = np.arcsin(np.minimum(1.0, lateral * WHEELBASE_M / (2 * np.maximum(speed, 1.0) ** 2)))
    slip = np.clip(angle / (1 + ahead / WHEELBASE_M), -grip, grip)
    wheel = np.clip(np.arctan(2 * np.tan(slip)), -MAX_STEERING_RAD, MAX_STEERING_RAD)
    return wheel, np.arctan(np.tan(wheel) / 2)


def _free(v: Floats, desired: Floats, idm: Idm) -> Floats:
    """Return the free-road term of IDM, as a share of its acceleration.

    Above the desired speed, the vehicle slows down to it.
    """
    return np.where(v <= desired, 1.0 - (v / desired) ** idm.delta, (desired - v) * SLOWING_RATE_1_S / idm.accel)


def _leader(egos: LatticeEgos, size: Size, others: Expected, count: int) -> tuple[Floats, Floats]:
    """Return the station and the speed of the nearest rear end ahead in the ego's way, ``(n, time)``.

    They are ``inf`` and 0 if there is none.
    """
    n, m = others.speed.shape
    if m == 0:
        return np.full((n, count), np.inf), np.zeros((n, count))
    inside = np.abs(others.d - egos.d[:, None, None]) < others.half_d + size.width / 2 + LEADER_WIDTH_MARGIN_M
    inside &= ((others.s[:, :, 0] > egos.s[:, None]) & (others.speed > -0.5))[:, :, None]
    rears = np.where(inside, others.s - others.half_s, np.inf)
    nearest = rears.argmin(axis=1)
    return rears.min(axis=1), np.take_along_axis(np.maximum(others.speed, 0.0), nearest, axis=1)
