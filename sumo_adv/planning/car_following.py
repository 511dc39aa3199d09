"""Speeds that SUMO's drivers want a step on: free, behind a leader, before a place to stop at.

Krauss after ``MSCFModel_Krauss`` (Krauß 1998), all others after ``MSCFModel_IDM`` (Treiber, Hennecke and Helbing 2000).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats


class CarFollowing:
    """A driver's ``model``: kind, acceleration, deceleration [m/s2], tau [s], min_gap [m], speed [m/s]."""

    def __init__(self, model: Mapping[str, Any], dt: float) -> None:
        self.krauss = model["kind"] == "krauss"
        self.acceleration, self.deceleration = float(model["acceleration"]), float(model["deceleration"])
        self.tau, self.min_gap, self.most = (
            float(model["tau"]),
            float(model["min_gap"]),
            max(float(model["speed"]), 1.0),
        )
        self._dt = dt

    def free(self, v: Floats) -> Floats:
        """With nobody before it at speeds ``v`` [m/s], ``(n,)``."""
        a = self.acceleration if self.krauss else self.acceleration * (1 - (v / self.most) ** 4)
        return np.asarray(np.maximum(v + a * self._dt, 0.0))

    def behind(self, v: Floats, gap: Floats, leader: Floats) -> Floats:
        """Behind leaders at speeds ``leader`` [m/s] and bumper gaps [m], ``(n,)``."""
        if self.krauss:
            room = gap - self.min_gap  # less than none: it brakes harder than for a leader that is near
            return self._safe(room, leader * leader, self.tau)
        wish = self.min_gap + np.maximum(0.0, v * self.tau + v * (v - leader) / self._twice_root())
        return self._idm(v, wish, gap)

    def stopping(self, v: Floats, room: Floats) -> Floats:
        """``room`` metres before the place to stop at, ``(n,)``; no headway is kept to it (``stopSpeed``)."""
        if self.krauss:
            return self._safe(np.maximum(room, 0.0), 0.0, self._dt)
        wish = v * self.tau + v * v / self._twice_root()
        return np.where(room < 0.01, 0.0, self._idm(v, wish, room))

    def _safe(self, room: Floats, square: Floats | float, tau: float) -> Floats:
        bt = self.deceleration * tau
        return np.asarray(-bt + np.sqrt(np.maximum(bt * bt + square + 2 * self.deceleration * room, 0.0)))

    def _idm(self, v: Floats, wish: Floats, gap: Floats) -> Floats:
        a = self.acceleration * (1 - (v / self.most) ** 4 - (wish / np.maximum(gap, 0.1)) ** 2)
        return np.maximum(v + a * self._dt, 0.0)

    def _twice_root(self) -> float:
        return float(2 * np.sqrt(self.acceleration * self.deceleration))
