"""JRC's Fuzzy Safety Model: a driver that anticipates, and brakes comfortably before it has to brake hard.

Source: Mattas et al. 2020, "Fuzzy Surrogate Safety Metrics for real-time assessment of rear-end collision risk", and
2022, "Driver models for the definition of safety requirements of automated vehicles in international regulations";
performance model 2 of UN R157 (01 series).

Lateral check: a vehicle beside the ego's corridor matters if its rear is ahead of the ego's front, it moves towards
the ego, the ego is faster, and side_gap / v_lateral < (gap + both lengths) / closing speed + 0.1 s.  A vehicle in the
corridor always matters.  Longitudinal check: the proactive (PFS) and the critical (CFS) fuzzy metrics, in [0, 1].
Reaction: 0.75 s after the risk shows, CFS * (6 - 4) + 4 m/s2 where CFS > 0, else PFS * 4 m/s2; braking changes by at
most 12.65 m/s3.

Where the papers leave room: the delay runs while the risk lasts, and once the driver brakes it follows the risk
without a further delay.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.metrics.reference.brakers import Delay
from sumo_adv.metrics.reference.view import View

REACTION = 0.75  # s
COMFORTABLE, MOST = 4.0, 6.0  # m/s2 of the ego
LEADER = 7.0  # m/s2, the most that the other brakes
STANDING_GAP = 2.0  # m between two vehicles that stand
LATERAL_SLACK = 0.1  # s
JERK = 12.65  # m/s3


def proactive(gap: Floats, ego: Floats, other: Floats) -> Floats:
    """PFS: 1 where even braking at most would not do if the other brakes at most, 0 where comfortable braking does."""
    stopping = ego * REACTION - other**2 / (2 * LEADER)
    safe = stopping + ego**2 / (2 * COMFORTABLE) + STANDING_GAP
    return _between(gap, stopping + ego**2 / (2 * MOST), safe)


def critical(gap: Floats, ego: Floats, other: Floats, acceleration: Floats) -> Floats:
    """CFS: 1 where braking at most would not do if the other keeps its speed, 0 where comfortable braking does."""
    held = np.maximum(acceleration, -COMFORTABLE)
    after = np.maximum(ego + held * REACTION, 0.0)
    nearer = ((ego + after) / 2 - other) * REACTION
    closing = np.maximum(after - other, 0.0)
    degree = _between(gap, nearer + closing**2 / (2 * MOST), nearer + closing**2 / (2 * COMFORTABLE))
    stopping = (ego - other) ** 2 / (2 * np.maximum(np.abs(held), 1e-9))
    degree = np.where(after <= other, np.where(gap <= stopping, 1.0, 0.0), degree)
    return np.where(ego > other, degree, 0.0)


def _between(gap: Floats, unsafe: Floats, safe: Floats) -> Floats:
    """1 at most at ``unsafe``, 0 from ``safe`` on, linear between."""
    span = np.maximum(safe - unsafe, 1e-9)
    return np.clip((safe - gap) / span, 0.0, 1.0)


class Fsm:
    """N drivers that watch M vehicles each."""

    name: ClassVar[str] = "fsm"
    source: ClassVar[str] = "Mattas et al. 2020, 2022; UN R157, performance model 2"

    def __init__(self, shape: tuple[int, int], dt: float) -> None:
        self._dt = dt
        self._delay = Delay((shape[0],), REACTION, dt)
        self._braking = np.zeros(shape[0])
        self._alarmed = np.zeros(shape[0], bool)

    @property
    def alarmed(self) -> Bools:
        """Whether a risk has shown to the driver, ``(N,)``."""
        return self._alarmed

    def step(self, view: View) -> Floats:
        """The acceleration [m/s2] over the step to come, ``(N,)``; NaN where the driver does not brake."""
        matters = view.same_direction & view.ahead & (view.in_corridor | self._moves_in(view))
        ego, leader = view.ego_speed + 0.0 * view.along, np.maximum(view.along, 0.0)
        gap = np.maximum(view.gap, 0.0)
        gap = np.where(matters, gap, 1e9)
        cfs = critical(gap, ego, leader, view.ego_acceleration + 0.0 * leader)
        pfs = proactive(gap, ego, leader)
        braking = np.where(cfs > 0.0, cfs * (MOST - COMFORTABLE) + COMFORTABLE, pfs * COMFORTABLE)
        braking = np.where(matters, braking, 0.0).max(axis=1, initial=0.0)
        risk = braking > 0.0
        self._alarmed |= risk
        acts = self._delay.step(risk) > -1e-9
        change = JERK * self._dt
        target = np.where(acts, braking, 0.0)
        self._braking = np.clip(target, self._braking - change, self._braking + change)
        return np.where(self._braking > 1e-9, -self._braking, np.nan)

    @staticmethod
    def _moves_in(view: View) -> Bools:
        """The lateral check."""
        sideways = view.towards > 1e-9
        across = view.side_gap / np.where(sideways, view.towards, 1.0)
        closing = view.closing
        lengths = view.gap + view.ego_length + view.length
        along = lengths / np.where(closing > 1e-9, closing, 1.0)
        return (view.gap > 0.0) & sideways & (closing > 1e-9) & (across < along + LATERAL_SLACK)
