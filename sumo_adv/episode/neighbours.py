"""Neighbours of an attack: the same attack with slightly other numbers, or a little earlier or later.

A search can find a collision that only just happens. Neighbours that are simulated tell whether it holds (a robust
optimum; Beyer and Sendhoff 2007, "Robust optimization").
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from random import Random

import numpy as np

from sumo_adv.datatypes import Attempt, Floats, PrescribedMotion, Proposal
from sumo_adv.episode.task import AttemptResult
from sumo_adv.search.sampling import moved

NUMBERS, SPREAD = 4, 0.05  # neighbours with other numbers, and by which share of their ranges at most
SHIFT = 0.2  # s by which the adversary comes to the contact earlier in one more neighbour, and later in another
ENOUGH = 4  # neighbours that succeed too, of all six, make an attack robust
EASED = 1.0  # s over which the clock takes its new rate, so that the speed does not jump at the takeover


@dataclass(frozen=True, slots=True)
class Robustness:
    """How many neighbours of an attack succeed, too."""

    held: int
    of: int

    @property
    def enough(self) -> bool:
        """Whether the attack is robust."""
        return self.held >= ENOUGH


def neighbours(attempt: Attempt, result: AttemptResult, random: Random, dt: float) -> list[Proposal]:
    """Some with other numbers, led by their planners; then an earlier and a later one, along the recorded motion.
    ``dt``: step of the simulation [s]."""
    p, contact = attempt.proposal, attempt.verdict.contact_time
    near = [moved(p, lambda: random.uniform(-SPREAD, SPREAD)) for _ in range(NUMBERS)]
    if contact is None or contact - result.start <= SHIFT:
        return near
    course, left = recorded_course(attempt, result, dt), contact - result.start
    return near + [replace(p, course=retimed(course, left / (left + late), dt)) for late in (-SHIFT, SHIFT)]


def recorded_course(attempt: Attempt, result: AttemptResult, dt: float) -> PrescribedMotion:
    """The adversary's motion from the takeover on, as recorded and as planned for after it."""
    bv = attempt.proposal.bv
    parts = [result.tracks(dt, bv)[bv].between(result.start + dt / 100, np.inf)]
    if bv in result.driven.beyond:
        parts.append(result.driven.beyond[bv])
    x, y, heading, speed = (np.concatenate([getattr(t, n) for t in parts]) for n in ("x", "y", "heading", "speed"))
    return PrescribedMotion(x, y, heading, speed)


def retimed(course: PrescribedMotion, rate: float, dt: float) -> PrescribedMotion:
    """The same path with a clock of another ``rate`` (1: as it was), which it takes over ``EASED`` s. States are ``dt``
    [s] apart; where the recorded motion ends, the adversary goes on at its last speed."""
    times = dt * np.arange(1, len(course.x) + 1)
    eased = np.minimum(times, EASED)
    clock = times + (rate - 1.0) * (eased**2 / (2 * EASED) + times - eased)
    pace = 1.0 + (rate - 1.0) * eased / EASED
    beyond = np.maximum(clock - times[-1], 0.0) * course.speed[-1]

    def at(values: Floats) -> Floats:
        return np.asarray(np.interp(clock, times, values))

    heading = np.unwrap(course.heading)
    x = at(course.x) + beyond * np.cos(heading[-1])
    y = at(course.y) + beyond * np.sin(heading[-1])
    return PrescribedMotion(x, y, at(heading), at(course.speed) * pace)
