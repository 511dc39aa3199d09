"""How SUMO's drivers make room within their lane for a vehicle beside them.

After ``MSLCM_SL2015::keepLatGap``; the details were measured on 2,000 random attacks (careful, idm, krauss):

- The ego makes no room for a vehicle that was never in its lane, until the vehicle is in the lane.
- For a vehicle that was in the lane before, it makes room as soon as the vehicle's side is over the line beside the
  ego. Condition: the vehicle's side has a lane of the same direction; if this is the left side, the right has none.
- The vehicle's place counts in strips of ``SUBLANE``. If the strip overlaps the ego's width by more than ``OVERLAP``,
  the ego keeps its place.
"""

from __future__ import annotations

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.drivers.scenes import Scenes

SUBLANE = 0.8  # m, SUMO's lateral resolution (simulation/simulation.py)
GAP = 0.6  # m, SUMO's minGapLat
OVERLAP = 0.125  # m (measured: between 0.1 and 0.15)
RATE = 1.5  # 1/s, lateral speed per metre from the desired offset
ACCELERATION, DECELERATION = 0.57, 3.0  # m/s2, lateral


class LateralGap:
    """Offsets ``d`` [m] of egos beside adversaries of a length and width [m], ``(n,)``."""

    def __init__(self, scenes: Scenes, length: Floats, width: Floats) -> None:
        self._dt, self._length, self._width, self._ego = scenes.dt, length, width, scenes.ego
        self._lane = scenes.each(lambda s: s.road.lane_width)
        self._room = np.maximum(self._lane - scenes.ego.width, 0.0) / 2
        left, right = scenes.has_lane(1), scenes.has_lane(-1)
        self._makes_room_left, self._makes_room_right = left & ~right, right
        self._min_gap = scenes.driver.min_gap
        self.d, self._speed = np.zeros(len(length)), np.zeros(len(length))

    def step(self, ahead: Floats, front_d: Floats, was_inside: Bools) -> None:
        """Advance ``d`` by a step.

        ahead: from the ego's centre to the adversary's along the path [m]; front_d: offset of the adversary's front
        [m]; was_inside: whether that front has been in the ego's lane. All are ``(n,)``.
        """
        left = front_d > 0.0
        near_side = np.abs(front_d) - self._width / 2
        beside = was_inside & (near_side < self._lane / 2) & (np.abs(front_d) > self._lane / 2)
        half, ego_half = self._length / 2, self._ego.length / 2
        beside &= np.where(ahead + half > ego_half, ahead < half + ego_half + self._min_gap, ahead + half > 0.0)
        beside &= np.where(left, self._makes_room_left, self._makes_room_right)
        if not beside.any() and not self.d.any():
            return
        edge = np.where(left, near_side, -near_side) + self._lane / 2  # from the right edge of the lane
        strip = np.floor(edge / SUBLANE) * SUBLANE + np.where(left, 0.0, SUBLANE) - self._lane / 2
        needed = self._ego.width / 2 + GAP - np.abs(strip)
        away = np.where(left, -1.0, 1.0) * np.clip(needed, 0.0, self._room)
        overlaps = self._ego.width / 2 - np.abs(strip - self.d) > OVERLAP
        away = np.where(overlaps, self.d, away)
        otherwise = np.where(was_inside & (np.abs(front_d) <= self._lane / 2), self.d, 0.0)  # it stays behind a leader
        desired = RATE * (np.where(beside, away, otherwise) - self.d)
        faster = ACCELERATION * self._dt
        slower = np.maximum(faster, np.minimum(DECELERATION * self._dt, np.abs(self._speed)))
        down, up = np.where(self._speed > 0.0, slower, faster), np.where(self._speed < 0.0, slower, faster)
        self._speed = np.clip(desired, self._speed - down, self._speed + up)
        self.d = self.d + self._speed * self._dt
