"""The Bezier rule: a cubic curve from the vehicle to where the ego will be.

Idea: the adversary's centre runs along a cubic Bezier curve; its control points are its own pose, where it would
be after a third of the time at its speed, where the ego will be after two thirds, and where the ego will be at the end,
evenly in the curve's parameter. Where the ego is a replay its future is known, and it is hit always (100 % raw
collisions); else it is taken to keep its speed along its path. The times ``ARRIVALS`` and the vehicles of the
shortlist, most dangerous first, are tried in turn, at every delay.
Limits: none of a car's are kept (acceleration, curvature, road, other vehicles), so most attacks are infeasible
and fails the gates: it shows why raw collision rates say nothing.
Citation: the rule-based baseline of CAT's published code (github.com/metadriverse/cat, ``adv_generator_rule.py``) for
Zhang, Peng, Li and Zhou 2023, "CAT: Closed-loop Adversarial Training for Safe End-to-End Driving", CoRL; there the
arrival is at three quarters of 8 s, the first here too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sumo_adv.benchmark.nouns import Encounter, course_proposal
from sumo_adv.datatypes import Attempt, Floats, PrescribedMotion, Proposal
from sumo_adv.drivers.sumo_rules import profile_at
from sumo_adv.situation import Situation, Target

ARRIVALS = (6.0, 4.0, 3.0, 8.0, 2.0)  # s after the takeover
STILL = 1e-3  # m a step: it has no direction


class Bezier:
    """Curves to the ego."""

    name = "bezier"

    def __init__(self) -> None:
        self._plans: list[tuple[float, str, float]] = []
        self._encounter: Encounter | None = None

    def begin(self, encounter: Encounter) -> None:
        """Which vehicle, when and how fast, in order."""
        self._encounter = encounter
        self._plans = [
            (delay, target.state.id, arrival)
            for delay in sorted(encounter.situations)
            for arrival in ARRIVALS
            for target in encounter.situations[delay].target_list()
        ]

    def propose(self, tried: Sequence[Attempt]) -> Proposal | None:
        """The next curve."""
        if self._encounter is None or len(tried) >= len(self._plans):
            return None
        delay, bv, arrival = self._plans[len(tried)]
        situation = self._encounter.situations[delay]
        return course_proposal(self.name, bv, delay, curve(situation, situation.targets[bv], arrival))


def curve(situation: Situation, target: Target, arrival: float) -> PrescribedMotion:
    """The motion of ``target`` that is at the ego's place ``arrival`` [s] after the takeover."""
    state, dt = target.state, situation.dt
    steps = max(round(arrival / dt), 1)
    (x2, x3), (y2, y3) = _ego_at(situation, np.array([2 / 3, 1.0]) * steps * dt)
    on = state.speed * steps * dt / 3
    x = _cubic(state.x, state.x + on * np.cos(state.heading), x2, x3, steps)
    y = _cubic(state.y, state.y + on * np.sin(state.heading), y2, y3, steps)
    dx, dy = np.diff(x), np.diff(y)
    moved = np.hypot(dx, dy)
    heading = np.where(moved > STILL, np.arctan2(dy, dx), state.heading)
    return PrescribedMotion(x[1:], y[1:], heading, moved / dt)


def _cubic(p0: float, p1: float, p2: float, p3: float, steps: int) -> Floats:
    """One coordinate of the curve at ``steps + 1`` even parameters."""
    u = np.linspace(0.0, 1.0, steps + 1)
    w = 1.0 - u
    return np.asarray(w**3 * p0 + 3 * u * w**2 * p1 + 3 * u**2 * w * p2 + u**3 * p3)


def _ego_at(situation: Situation, time: Floats) -> tuple[Floats, Floats]:
    """Where the ego is ``time`` s after the takeover: known of a replay, else along its path at its present speed."""
    if situation.baseline.model.kind == "replay":
        station, _ = profile_at(situation, time)
    else:
        station = situation.baseline.s[0] + situation.ego.speed * time
    x, y, _ = situation.baseline.path.at(station)
    return x, y
