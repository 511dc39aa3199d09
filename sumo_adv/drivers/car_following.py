"""Speeds that SUMO's drivers want a step on: free, behind a leader, before a place to stop at.

Krauss after ``MSCFModel_Krauss`` (Krauß 1998), all others after ``MSCFModel_IDM`` (Treiber, Hennecke and Helbing 2000).
"""

from __future__ import annotations

import numpy as np

from sumo_adv.datatypes import DriverModel, Floats

EMERGENCY, AMPLIFIED = 9.0, 1.2  # m/s2, SUMO's emergencyDecel of our drivers; how much more than is needed they brake
# SUMO's DEFAULT_VEHTYPE (m/s2, s, m), with a speed [m/s] that nobody exceeds
DEFAULT_DRIVER = DriverModel("krauss", acceleration=2.6, deceleration=4.5, tau=1.0, min_gap=2.5, speed=60.0)
NUMERICAL = 0.001  # SUMO's NUMERICAL_EPS
EXACT = ("krauss", "idm", "careful")  # drivers whose following is known as SUMO has it


def exact(model: DriverModel) -> bool:
    """Whether a driver's following is known exactly; not where nobody knows which driver it is."""
    return model.kind in EXACT and model.known


class CarFollowing:
    """A driver's ``model``: kind, acceleration, deceleration [m/s2], tau [s], min_gap [m], speed [m/s]."""

    def __init__(self, model: DriverModel, dt: float) -> None:
        self.krauss = model.kind == "krauss"
        self.acceleration, self.deceleration = model.acceleration, model.deceleration
        self.tau, self.min_gap, self.most = model.tau, model.min_gap, max(model.speed, 1.0)
        self._dt = dt

    def free(self, v: Floats) -> Floats:
        """With nobody before it at speeds ``v`` [m/s], ``(n,)``."""
        a = self.acceleration if self.krauss else self.acceleration * (1 - (v / self.most) ** 4)
        return np.asarray(np.maximum(v + a * self._dt, 0.0))

    def behind(self, v: Floats, gap: Floats, leader: Floats) -> Floats:
        """Behind leaders at speeds ``leader`` [m/s] and bumper gaps [m], ``(n,)``."""
        if self.krauss:
            return self._safe_behind(v, gap - self.min_gap, leader)
        wish = self.min_gap + np.maximum(0.0, v * self.tau + v * (v - leader) / self._twice_root())
        return self._idm(v, wish, gap)

    def staying_behind(self, v: Floats, gap: Floats, leader: Floats) -> Floats:
        """Behind one in the lane to the left, as drivers reckon while they think of changing lanes: without
        emergencies, braking gently, and not for one who is beside and faster (measured); inf where not at all."""
        if self.krauss:
            wanted = self._safe(gap - self.min_gap + self._standstill(leader), self.tau)
        else:
            wanted = self.behind(v, gap, leader)
        wanted = np.where((leader < v) | (gap >= self.min_gap), wanted, np.inf)
        return np.maximum(wanted, v - self.deceleration * self._dt)

    def stopping(self, v: Floats, room: Floats) -> Floats:
        """``room`` metres before the place to stop at, ``(n,)``; no headway is kept to it (``stopSpeed``)."""
        if self.krauss:
            return self._safe(room, self._dt)
        wish = v * self.tau + v * v / self._twice_root()
        return np.where(room < 0.01, 0.0, self._idm(v, wish, room))

    def _safe(self, room: Floats, headway: float) -> Floats:
        """The speed that stops within ``room`` [m], braking evenly step by step (``maximumSafeStopSpeedEuler``)."""
        b, dt, t, some = self.deceleration * self._dt, self._dt, headway, np.maximum(room - NUMERICAL, 0.0)
        root = np.sqrt(np.maximum(dt * dt + 4.0 * (dt * (2.0 * some / b - t) + t * t), 0.0))
        n = np.floor(0.5 - (t - root / 2.0) / dt)
        way = 0.5 * n * (n - 1.0) * b * dt + n * b * t
        return np.asarray(np.where(room < NUMERICAL, 0.0, n * b + (some - way) / (n * dt + t)))

    def _standstill(self, v: Floats) -> Floats:
        """Metres to a standstill, braking step by step (``brakeGapEuler``)."""
        b = self.deceleration * self._dt
        steps = np.floor(v / b)
        return self._dt * (steps * v - b * steps * (steps + 1.0) / 2.0)

    def _safe_behind(self, v: Floats, room: Floats, leader: Floats) -> Floats:
        """Krauss's safe speed (``maximumSafeFollowSpeed``): where braking evenly does not do, it brakes somewhat harder
        than would do."""
        dt = self._dt
        safe = self._safe(np.maximum(room, 0.0) + self._standstill(leader), self.tau)
        safe = np.where(room >= 0.0, safe, v - EMERGENCY * dt)
        hard = (v - safe) / dt
        if not (hard > self.deceleration + NUMERICAL).any():
            return safe
        some = np.maximum(room, NUMERICAL)
        needed = 0.5 * v * v / (some + 0.5 * leader * leader / self.deceleration)
        needed = np.where(needed <= self.deceleration, needed, 0.5 * (v * v - leader * leader) / some)
        needed = np.minimum(np.maximum(AMPLIFIED * np.where(room > 0.0, needed, EMERGENCY), self.deceleration), hard)
        return np.where(hard > self.deceleration + NUMERICAL, np.maximum(v - needed * dt, 0.0), safe)

    def _idm(self, v: Floats, wish: Floats, gap: Floats) -> Floats:
        a = self.acceleration * (1 - (v / self.most) ** 4 - (wish / np.maximum(gap, 0.1)) ** 2)
        return np.maximum(v + a * self._dt, 0.0)

    def _twice_root(self) -> float:
        return float(2 * np.sqrt(self.acceleration * self.deceleration))
