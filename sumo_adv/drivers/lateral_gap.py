"""How SUMO's drivers make room within their lane for a vehicle beside them.

After ``keepLatGap``, ``checkBlocking`` and ``computeSpeedLat`` of ``MSLCM_SL2015``. When they apply was measured on
2,000 random attacks (careful, idm, krauss):

- The ego makes no room for a vehicle that was never in its lane.
- For a vehicle that was in the lane before, it makes room while the vehicle is beside it with a side over the line.
  Condition: the vehicle's side has a lane of the same direction.
- The vehicle's place counts in strips of ``SUBLANE``. If the ego overlaps the strip so far that it cannot leave it in
  one step, it keeps its place. So it does while the vehicle's front is in its lane.
- If there are lanes on both sides, it makes room to the right only if it does not overlap the strip.

SUMO moves the middle of the front bumper sideways. The rear follows it like a trailer.
"""

from __future__ import annotations

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.drivers.car_following import NUMERICAL, brake_gap
from sumo_adv.drivers.scenes import Scenes

SUBLANE = 0.8  # m, SUMO's lateral resolution (simulation/simulation.py)
GAP = 0.6  # m, SUMO's minGapLat
LATERAL_SPEED = 1.0  # m/s, SUMO's maxSpeedLat
LATERAL_ACCELERATION = 1.0  # m/s2, SUMO's lcAccelLat: to move over and to stop moving


class LateralGap:
    """Egos ``(n,)`` beside adversaries of a length and width [m], ``(N,)``: one each, or the first ones of all egos,
    then their second ones. An ego makes room for the nearest of those that were in its lane.

    front: offsets of the middle of the front bumpers [m]; d: offsets of the centres [m]; turn: headings against the
    path [rad]. All are ``(n,)``.
    """

    def __init__(self, scenes: Scenes, length: Floats, width: Floats) -> None:
        self._dt, self._length, self._width, self._ego = scenes.dt, length, width, scenes.ego
        self._half_lane = scenes.each(lambda s: s.road.lane_width) / 2
        self._room = np.maximum(self._half_lane - scenes.ego.width / 2, 0.0)
        self._has_left, self._has_right = scenes.has_lane(1), scenes.has_lane(-1)
        self._min_gap = scenes.driver.min_gap
        self.front, self.d, self.turn, self._speed = np.zeros((4, len(self._half_lane)))

    def step(self, ahead: Floats, front_d: Floats, was_inside: Bools, v: Floats) -> None:
        """Advance the egos by a step.

        ahead: from the ego's centre to the adversary's along the path after the step [m]; front_d: offset of the
        adversary's front [m]; was_inside: whether that front has been in the ego's lane; v: speeds of the egos after
        the step [m/s] ``(n,)``. The others are ``(N,)``.
        """
        length, width = self._length, self._width
        if len(ahead) > len(v):
            of_ego = np.where(was_inside, np.abs(ahead), np.inf).reshape(-1, len(v)).argmin(axis=0)
            row = of_ego * len(v) + np.arange(len(v))
            ahead, front_d, was_inside, length, width = (q[row] for q in (ahead, front_d, was_inside, length, width))
        left, near_side = front_d > 0.0, np.abs(front_d) - width / 2
        inside, partly = np.abs(front_d) <= self._half_lane, was_inside & (near_side < self._half_lane)
        half, ego_half = length / 2, self._ego.length / 2
        beside = np.where(ahead + half > ego_half, ahead < half + ego_half + self._min_gap, ahead + half > 0.0)
        makes_room = partly & ~inside & beside & np.where(left, self._has_left, self._has_right)
        if not makes_room.any() and not self.front.any() and not self.d.any():
            return
        edge = np.where(left, near_side, -near_side) + self._half_lane  # from the right edge of the lane
        strip = np.floor(edge / SUBLANE) * SUBLANE + np.where(left, 0.0, SUBLANE) - self._half_lane
        overlap = self._ego.width / 2 - np.abs(strip - self.front)
        makes_room &= ~left | ~self._has_right | (overlap < 0.0)
        stays = partly & (inside | (overlap > LATERAL_SPEED * self._dt + NUMERICAL))
        needed = np.clip(self._ego.width / 2 + GAP - np.abs(strip), 0.0, self._room)
        shift = np.where(makes_room, np.where(left, -needed, needed), 0.0) - self.front
        self._speed = np.where(stays, 0.0, lateral_speed(self._speed, shift, self._dt))
        sine = 2.0 * (self.front - self.d) / self._ego.length
        rear = 2.0 * self.d - self.front + v * self._dt * sine
        self.front = self.front + self._speed * self._dt
        self.d = (self.front + rear) / 2
        self.turn = np.arcsin(2.0 * (self.front - self.d) / self._ego.length)


def lateral_speed(speed: Floats, wanted: Floats, dt: float) -> Floats:
    """The lateral speed [m/s] of SUMO's drivers for the next step, to get ``wanted`` metres to the left.

    They accelerate as long as they can then still stop there with even braking (``computeSpeedLat``).
    """
    side, change = np.where(wanted >= 0.0, 1.0, -1.0), LATERAL_ACCELERATION * dt
    towards, distance = side * speed, np.abs(wanted)
    faster, slower = np.minimum(towards + change, LATERAL_SPEED), np.maximum(towards - change, 0.0)
    arrives = ((slower == 0.0) | (faster <= 0.0)) & (slower <= distance / dt) & (distance / dt <= faster)

    def stops(at: Floats) -> Bools:
        return np.asarray(at * dt + brake_gap(at, LATERAL_ACCELERATION, dt) < distance + NUMERICAL)

    kept = np.where(stops(towards), towards, slower)
    on = np.where((towards < 0.0) | stops(faster), faster, kept)
    return np.asarray(side * np.where(arrives, distance / dt, on))
