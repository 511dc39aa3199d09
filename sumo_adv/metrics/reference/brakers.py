"""The protocol of reference drivers that brake, and what their rules share."""

from __future__ import annotations

from typing import ClassVar, Protocol

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.metrics.reference.view import View

RAMP = 0.6  # s until full braking, UN R157
FULL_BRAKING = 0.774 * 9.81  # m/s2, UN R157


def speed_lost(pressed: Floats) -> Floats:
    """What braking has taken [m/s] ``pressed`` [s] after it began; 0 before."""
    pressed = np.maximum(pressed, 0.0)
    rising = np.minimum(pressed, RAMP)
    return np.asarray(FULL_BRAKING * (rising**2 / (2.0 * RAMP) + pressed - rising))


class Braker(Protocol):
    """N drivers that watch M vehicles each, in steps of ``dt`` [s]; their state is what they have seen."""

    name: ClassVar[str]
    source: ClassVar[str]

    def __init__(self, shape: tuple[int, int], dt: float) -> None: ...

    def step(self, view: View) -> Floats:
        """The acceleration [m/s2] over the step to come, ``(N,)``; NaN where the driver does not act."""
        ...

    @property
    def alarmed(self) -> Bools:
        """Whether a danger has shown to the driver, now or before, ``(N,)``."""
        ...


def needed_braking(speed: Floats, gap: Floats, leader_speed: Floats, leader_acceleration: Floats) -> Floats:
    """Constant deceleration [m/s2] that just avoids running into a leader ``gap`` [m] ahead; ``inf`` without a gap.

    The larger of c^2 / (2 gap) at a closing speed c, and, behind a braking leader, of stopping where it stops.
    """
    room = np.maximum(gap, 1e-6)
    needed = np.maximum(speed - leader_speed, 0.0) ** 2 / (2.0 * room)
    brakes = leader_acceleration < -0.5
    if brakes.any():
        standstill = np.maximum(leader_speed, 0.0) ** 2 / (2.0 * np.maximum(-leader_acceleration, 0.5))
        needed = np.where(brakes, np.maximum(needed, speed**2 / (2.0 * (room + standstill))), needed)
    return np.where(gap > 0.0, needed, np.where(speed > 0.0, np.inf, 0.0))


class Delay:
    """Something that takes effect a fixed time [s] after its cause, and ends with it; ``(N, ...)``."""

    def __init__(self, shape: tuple[int, ...], seconds: float, dt: float) -> None:
        self._since = np.full(shape, np.inf)
        self._now, self._seconds, self._dt = 0.0, seconds, dt

    def step(self, cause: Bools) -> Floats:
        """Seconds [s] for which the effect has lasted, negative before it, ``-inf`` without a cause."""
        self._since = np.where(cause, np.minimum(self._since, self._now), np.inf)
        lasted = np.where(cause, self._now - self._since - self._seconds, -np.inf)
        self._now += self._dt
        return np.where(np.isfinite(lasted), np.round(lasted, 9), lasted)
