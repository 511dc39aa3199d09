"""Drivers that are wrong on purpose: the adapter of ``examples/bring_a_planner`` with one mistake each, and others."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import numpy as np
from adapter import BroughtPlanner  # type: ignore[import-not-found]

from sumo_adv import LaneSpeed, Observation, Pose


class AbsoluteTime(BroughtPlanner):
    """Reads its plan at the simulation's time instead of the time since the plan was made."""

    def since_plan(self, now: float) -> float:
        """The mistake."""
        return now


class Degrees(BroughtPlanner):
    """Answers with a heading in degrees."""

    def pose(self, state: object) -> Pose:
        """The mistake."""
        right = super().pose(state)
        return replace(right, heading=math.degrees(right.heading))


class FrontBumper(BroughtPlanner):
    """Takes the point of a pose for the front bumper; its car is 4.8 m long."""

    def pose(self, state: object) -> Pose:
        """The mistake."""
        right = super().pose(state)
        return replace(right, x=right.x + 2.4 * math.cos(right.heading), y=right.y + 2.4 * math.sin(right.heading))


class NoLines(BroughtPlanner):
    """Sees neither vehicles nor stop lines."""

    def leaders(self, seen: Observation) -> list[tuple[float, float]]:
        """The mistake."""
        return []


class OtherSide(BroughtPlanner):
    """Takes the y axis to point the other way, on a road along x: its path is the lane of the oncoming traffic."""

    def joined(self, path: np.ndarray) -> np.ndarray:
        """The mistake."""
        return super().joined(path * (1.0, -1.0))


class PlanByClock:
    """A speed planned over the time since the start, read at the simulation's time. In scenarios that begin at 0 both
    are the same, so that nothing else gives it away."""

    def reset(self, seed: int) -> None:
        """There is nothing to forget."""

    def act(self, seen: Observation) -> LaneSpeed:
        """From 6 m/s on, 0.5 m/s more each second, up to 15 m/s."""
        return LaneSpeed(None, min(6.0 + 0.5 * seen.time, 15.0))


class Stands(PlanByClock):
    """Stops and never goes on."""

    def act(self, seen: Observation) -> LaneSpeed:
        """Always 0."""
        return LaneSpeed(None, 0.0)


class Slow(PlanByClock):
    """Takes km/h for m/s."""

    def act(self, seen: Observation) -> LaneSpeed:
        """50 km/h divided by 3.6 twice."""
        return LaneSpeed(None, 50.0 / 3.6 / 3.6)


class Remembers(PlanByClock):
    """Counts its steps, also across ``reset``."""

    def __init__(self) -> None:
        self.steps = 0

    def act(self, seen: Observation) -> LaneSpeed:
        """Faster with each step."""
        self.steps += 1
        return LaneSpeed(None, 8.0 + 0.01 * self.steps)


class Dices(PlanByClock):
    """Uses random numbers that no seed repeats."""

    def act(self, seen: Observation) -> LaneSpeed:
        """8 to 9 m/s."""
        return LaneSpeed(None, 8.0 + random.SystemRandom().random())


class Fails(PlanByClock):
    """Raises at 2 s."""

    def act(self, seen: Observation) -> LaneSpeed:
        """Fails when it is time."""
        if seen.time > 2.0:
            raise RuntimeError("no route")
        return LaneSpeed(None, 8.0)
