"""How SUMO's drivers make room within their lane for one who was in it, left it and comes back in beside them.

After ``MSLCM_SL2015::keepLatGap``, and measured on 2,000 random attacks (careful, idm, krauss): a vehicle that never
was in the ego's lane is not made room for until it is in it; one that was is, from the moment its side is over the line
beside the ego, if a lane of the same direction is on its side (on the left: on no other). Its place counts in strips of
``SUBLANE``; where such a strip overlaps the ego's own width by more than ``OVERLAP`` the ego stays where it is.
"""

from __future__ import annotations

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.drivers.scenes import Scenes

SUBLANE = 0.8  # m, the lateral resolution that SUMO runs with (simulation/simulation.py)
GAP = 0.6  # m, SUMO's minGapLat
OVERLAP = 0.125  # m (measured: between 0.1 and 0.15)
RATE, ACCELERATION, SLOWING = 1.5, 0.57, 3.0  # 1/s, m/s2, m/s2: how fast it moves over


class LateralGap:
    """Offsets ``d`` [m] of egos against adversaries of a length and width [m], ``(n,)``."""

    def __init__(self, scenes: Scenes, length: Floats, width: Floats) -> None:
        self._dt, self._length, self._width, self._ego = scenes.dt, length, width, scenes.ego
        self._lane = scenes.each(lambda s: s.lane_width)
        self._room = np.maximum(self._lane - scenes.ego.width, 0.0) / 2
        left, right = scenes.has_lane(1), scenes.has_lane(-1)
        self._may = left & ~right, right
        self._gap = scenes.driver.min_gap
        self.d, self._rate = np.zeros(len(length)), np.zeros(len(length))

    def step(self, ahead: Floats, front_d: Floats, was_inside: Bools) -> None:
        """One step on: the adversaries' centres are ``ahead`` [m] of the egos', their fronts at offsets ``front_d``
        [m]; ``was_inside``: whose front has been in the ego's lane; all ``(n,)``."""
        left = front_d > 0.0
        near = np.abs(front_d) - self._width / 2
        comes = was_inside & (near < self._lane / 2) & (np.abs(front_d) > self._lane / 2)
        half, mine = self._length / 2, self._ego.length / 2
        comes &= np.where(ahead + half > mine, ahead < half + mine + self._gap, ahead + half > 0.0)
        comes &= np.where(left, *self._may)
        if not comes.any() and not self.d.any():
            return
        edge = np.where(left, near, -near) + self._lane / 2  # from the right edge of the lane
        strip = np.floor(edge / SUBLANE) * SUBLANE + np.where(left, 0.0, SUBLANE) - self._lane / 2
        needed = self._ego.width / 2 + GAP - np.abs(strip)
        over = np.where(left, -1.0, 1.0) * np.clip(needed, 0.0, self._room)
        back = np.where(was_inside & (np.abs(front_d) <= self._lane / 2), self.d, 0.0)  # behind a leader it stays
        blocked = self._ego.width / 2 - np.abs(strip - self.d) > OVERLAP
        over = np.where(blocked, self.d, over)
        wanted = RATE * (np.where(comes, over, back) - self.d)
        more = ACCELERATION * self._dt
        less = np.maximum(more, np.minimum(SLOWING * self._dt, np.abs(self._rate)))
        down, up = np.where(self._rate > 0.0, less, more), np.where(self._rate < 0.0, less, more)
        self._rate = np.clip(wanted, self._rate - down, self._rate + up)
        self.d = self.d + self._rate * self._dt
