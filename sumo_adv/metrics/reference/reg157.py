"""UN R157's requirement for cut-ins: avoid each collision that braking at 6 m/s2 after 0.35 s avoids.

Source: UN Regulation No. 157, 5.2.5.2: the system avoids a collision with a vehicle that cuts in if the time to
collision at the moment of intrusion is more than v_rel / (2 * 6 m/s2) + 0.35 s; the vehicle has intruded once it is
0.3 m beyond the line of the ego's lane.

As a driver: once a slower vehicle ahead has intruded (or drives in the lane), braking at 6 m/s2 begins 0.35 s after
the time to collision is at most 2 s or, at high closing speeds, at most what the requirement takes.  Braking earlier
than that changes no outcome and would make the driver an alarmist.  Where the regulation leaves room: the braking is
there at once, without a ramp, and lasts until the ego is no longer faster.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.metrics.reference.brakers import Delay
from sumo_adv.metrics.reference.view import View

BRAKING = 6.0  # m/s2, UN R157
DELAY = 0.35  # s, UN R157
INTRUSION = 0.3  # m beyond the line, UN R157
SOON = 2.0  # s, time to collision


class Reg157:
    """N drivers that watch M vehicles each."""

    name: ClassVar[str] = "reg157"
    source: ClassVar[str] = "UN R157, 5.2.5.2"

    def __init__(self, shape: tuple[int, int], dt: float) -> None:
        self._dt = dt
        self._delay = Delay(shape, DELAY, dt)
        self._danger = np.zeros(shape, bool)
        self._alarmed = np.zeros(shape[0], bool)

    @property
    def alarmed(self) -> Bools:
        """Whether a danger has shown to the driver, ``(N,)``."""
        return self._alarmed

    def step(self, view: View) -> Floats:
        """The acceleration [m/s2] over the step to come, ``(N,)``; NaN where the driver does not brake."""
        intrudes = view.same_direction & view.ahead & (view.near_edge < view.lane_half_width - INTRUSION + 1e-9)
        faster = intrudes & (view.closing > 0.0)
        needed = view.closing / (2 * BRAKING) + DELAY + self._dt
        begins = faster & (view.gap > 0.0) & (view.time_to_reach <= np.maximum(SOON, needed))
        self._danger = (self._danger & faster) | begins
        self._alarmed |= self._danger.any(axis=1)
        lasted = self._delay.step(self._danger).max(axis=1, initial=-np.inf)
        part = np.clip((lasted + self._dt) / self._dt, 0.0, 1.0)  # of the step in which braking begins
        return np.where(part > 1e-9, -BRAKING * part, np.nan)
