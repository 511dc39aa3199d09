"""Responsibility-Sensitive Safety as a driver: it keeps the safe distances and brakes when both are broken.

Source: Shalev-Shwartz, Shammah, Shashua 2017, "On a Formal Model of Safe and Scalable Self-driving Cars", definitions
1 (longitudinal), 6 (lateral) and 4 (proper response).  A situation is dangerous when the longitudinal and the lateral
distance are both unsafe; after the response time the driver brakes until it is safe again.

The paper gives no numbers.  These are those of the JRC's implementation (ec-jrc/JRC-FSM): both vehicles brake at
6 m/s2 in the safe distance, the other moves sideways with 1 m/s2, and the driver responds after 0.75 s with the braking
of UN R157's human driver, so that the drivers differ by their rules and not by their reaction.  The lateral part of the
proper response is left out: the driver does not steer, and its own way sideways is none.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.metrics.fault import Rss, lateral_way, longitudinal_safe_distance
from sumo_adv.metrics.reference.brakers import Delay, speed_lost
from sumo_adv.metrics.reference.view import View

NUMBERS = Rss(
    response=0.75, acceleration=3.0, braking=6.0, hard_braking=6.0, lateral_acceleration=1.0, lateral_braking=1.0
)  # fmt: skip
WOBBLE = 0.3  # m of lateral distance that is kept beyond RSS's own


class RssDriver:
    """N drivers that watch M vehicles each."""

    name: ClassVar[str] = "rss"
    source: ClassVar[str] = "Shalev-Shwartz, Shammah, Shashua 2017"

    def __init__(self, shape: tuple[int, int], dt: float) -> None:
        self._dt = dt
        self._delay = Delay(shape, NUMBERS.response, dt)
        self._alarmed = np.zeros(shape[0], bool)

    @property
    def alarmed(self) -> Bools:
        """Whether a danger has shown to the driver, ``(N,)``."""
        return self._alarmed

    def step(self, view: View) -> Floats:
        """The acceleration [m/s2] over the step to come, ``(N,)``; NaN where the driver does not brake."""
        along = np.maximum(view.along, 0.0)
        own = np.broadcast_to(view.ego_speed, along.shape)
        unsafe_along = view.gap < longitudinal_safe_distance(own, along, NUMBERS)
        unsafe_across = view.side_gap < WOBBLE + lateral_way(view.towards, NUMBERS)
        dangerous = view.same_direction & view.ahead & unsafe_along & unsafe_across
        self._alarmed |= dangerous.any(axis=1)
        lasted = self._delay.step(dangerous).max(axis=1, initial=-np.inf)
        lost = speed_lost(lasted + self._dt) - speed_lost(lasted)
        return np.where(lost > 1e-9, -lost / self._dt, np.nan)
