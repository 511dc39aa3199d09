"""Speeds that SUMO's drivers want after the next step: alone, behind a leader, before a place where they stop.

Krauss follows ``MSCFModel_Krauss`` (Krauß 1998); all other drivers follow ``MSCFModel_IDM`` (Treiber, Hennecke and
Helbing 2000). Speeds are in m/s and gaps in m; arrays are ``(n,)`` or any shape that broadcasts.
"""

from __future__ import annotations

import numpy as np

from sumo_adv.datatypes import DriverModel, Floats

AMPLIFIED = 1.2  # -, in an emergency Krauss's driver brakes harder than necessary by this factor
NUMERICAL = 0.001  # SUMO's NUMERICAL_EPS


class CarFollowing:
    """The car following of a driver model in steps of ``dt`` [s]."""

    def __init__(self, model: DriverModel, dt: float) -> None:
        self.krauss = model.kind == "krauss"
        self.acceleration, self.deceleration = model.acceleration, model.deceleration
        self._hardest = model.hardest_braking
        self.tau, self.min_gap, self.desired_speed = model.tau, model.min_gap, max(model.speed, 1.0)
        self._dt = dt
        self._twice_root = float(2 * np.sqrt(self.acceleration * self.deceleration))

    def free(self, v: Floats) -> Floats:
        """The speed after the step without a leader, from a speed ``v``."""
        a = self.acceleration if self.krauss else self.acceleration * (1 - (v / self.desired_speed) ** 4)
        return np.asarray(np.maximum(v + a * self._dt, 0.0))

    def behind(self, v: Floats, gap: Floats, leader: Floats) -> Floats:
        """The speed behind leaders at speeds ``leader``; ``gap``: between the bumpers."""
        if self.krauss:
            return self._safe_behind(v, gap - self.min_gap, leader)
        desired_gap = self.min_gap + np.maximum(0.0, v * self.tau + v * (v - leader) / self._twice_root)
        return self._idm(v, desired_gap, gap)

    def stopping(self, v: Floats, room: Floats) -> Floats:
        """The speed ``room`` metres before the place where the driver stops, without a headway (``stopSpeed``)."""
        if self.krauss:
            return self._safe(room, self._dt)
        desired_gap = v * self.tau + v * v / self._twice_root
        return np.where(room < 0.01, 0.0, self._idm(v, desired_gap, room))

    def _safe(self, room: Floats, headway: float) -> Floats:
        """The speed from which even braking in steps ends within ``room`` [m] (``maximumSafeStopSpeedEuler``)."""
        b, dt, t, usable = self.deceleration * self._dt, self._dt, headway, np.maximum(room - NUMERICAL, 0.0)
        root = np.sqrt(np.maximum(dt * dt + 4.0 * (dt * (2.0 * usable / b - t) + t * t), 0.0))
        n = np.floor(0.5 - (t - root / 2.0) / dt)
        distance = 0.5 * n * (n - 1.0) * b * dt + n * b * t
        return np.asarray(np.where(room < NUMERICAL, 0.0, n * b + (usable - distance) / (n * dt + t)))

    def _braking(self, v: Floats) -> Floats:
        return brake_gap(v, self.deceleration, self._dt)

    def _safe_behind(self, v: Floats, room: Floats, leader: Floats) -> Floats:
        """Krauss's safe speed (``maximumSafeFollowSpeed``). Where comfortable braking is not enough, the driver brakes
        harder than necessary by ``AMPLIFIED``."""
        dt = self._dt
        safe = self._safe(np.maximum(room, 0.0) + self._braking(leader), self.tau)
        safe = np.where(room >= 0.0, safe, v - self._hardest * dt)
        hard = (v - safe) / dt
        if not (hard > self.deceleration + NUMERICAL).any():
            return safe
        usable = np.maximum(room, NUMERICAL)
        needed = 0.5 * v * v / (usable + 0.5 * leader * leader / self.deceleration)
        needed = np.where(needed <= self.deceleration, needed, 0.5 * (v * v - leader * leader) / usable)
        needed = np.minimum(
            np.maximum(AMPLIFIED * np.where(room > 0.0, needed, self._hardest), self.deceleration), hard
        )
        return np.where(hard > self.deceleration + NUMERICAL, np.maximum(v - needed * dt, 0.0), safe)

    def _idm(self, v: Floats, desired_gap: Floats, gap: Floats) -> Floats:
        a = self.acceleration * (1 - (v / self.desired_speed) ** 4 - (desired_gap / np.maximum(gap, 0.1)) ** 2)
        return np.maximum(v + a * self._dt, 0.0)


def brake_gap(v: Floats, deceleration: float, dt: float) -> Floats:
    """The distance [m] to a standstill from speeds ``v`` with even braking in steps of ``dt`` s (``brakeGapEuler``)."""
    b = deceleration * dt
    steps = np.floor(v / b)
    return dt * (steps * v - b * steps * (steps + 1.0) / 2.0)
