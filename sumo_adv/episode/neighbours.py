"""Neighbours of an attack: the same attack against an ego that arrives differently, or with other parameter values.

A search can find a collision that only just happens. Neighbours that are simulated show whether it holds (a robust
optimum; Beyer and Sendhoff 2007, "Robust optimization"). They vary what a new version of the ego's driver would vary:
when the ego arrives, and how fast. In each neighbour, the adversary plans against the ego.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from random import Random

import numpy as np

from sumo_adv.datatypes import Arrival, Attempt, Floats, Level, PrescribedMotion, Proposal, Verdict
from sumo_adv.episode.task import AttemptResult
from sumo_adv.goal import Goal
from sumo_adv.search.sampling import moved

EARLIER_S = 0.3  # s by which the ego arrives earlier in one neighbour, and later in another
FASTER_SHARE = 0.05  # share by which the ego is faster in one neighbour, and slower in another
OTHER_NUMBERS_NEIGHBOURS = 2  # neighbours with other parameter values
NUMBER_SPREAD_SHARE = 0.05  # maximum change of a parameter's value, as a share of its range
MIN_NEIGHBOURS_HELD = 4  # minimum number of six neighbours in which a robust attack holds
CLOCK_EASING_S = 1.0  # s over which the clock reaches its new rate, so that the speed does not jump at the takeover


@dataclass(frozen=True, slots=True)
class Robustness:
    """In how many neighbours an attack holds.

    Attributes:
        held: The number of neighbours in which it holds.
        of: The number of neighbours that were simulated.
    """

    held: int
    of: int

    @property
    def enough(self) -> bool:
        """Whether the attack is robust: it holds in two thirds of its neighbours."""
        return self.of > 0 and 6 * self.held >= MIN_NEIGHBOURS_HELD * self.of


def holds(verdict: Verdict, goal: Goal) -> bool:
    """Return whether an attack holds in a neighbour: it meets the goal, or is valid if the goal is a higher level.

    Args:
        verdict: The verdict on the neighbour.
        goal: What an attempt must reach.
    """
    return goal.met(verdict) or (goal.level > Level.VALID and verdict.level >= Level.VALID)


def neighbours(
    attempt: Attempt, result: AttemptResult, random: Random, dt: float, *, displaces: bool
) -> list[Proposal]:
    """Return the neighbours of an attempt that collided or came near.

    Args:
        attempt: The attempt.
        result: What was recorded of it.
        random: Draws the other parameter values.
        dt: The step of the simulation [s].
        displaces: Whether the ego can be made to arrive differently. Otherwise, the adversary's recorded motion comes
            earlier and later if the attempt collided late enough.
    """
    p, contact = attempt.proposal, attempt.verdict.contact_time

    def drawn(count: int) -> list[Proposal]:
        return [moved(p, lambda: random.uniform(-NUMBER_SPREAD_SHARE, NUMBER_SPREAD_SHARE)) for _ in range(count)]

    if displaces:
        arrivals = (
            Arrival(EARLIER_S),
            Arrival(-EARLIER_S),
            Arrival(pace=1.0 + FASTER_SHARE),
            Arrival(pace=1.0 - FASTER_SHARE),
        )
        return [replace(p, arrival=arrival) for arrival in arrivals] + drawn(OTHER_NUMBERS_NEIGHBOURS)
    if contact is None or contact - result.start <= EARLIER_S:
        return drawn(2 * OTHER_NUMBERS_NEIGHBOURS)
    course, left = recorded_course(attempt, result, dt), contact - result.start
    return [replace(p, course=retimed(course, left / (left + late), dt)) for late in (-EARLIER_S, EARLIER_S)] + drawn(
        2 * OTHER_NUMBERS_NEIGHBOURS
    )


def recorded_course(attempt: Attempt, result: AttemptResult, dt: float) -> PrescribedMotion:
    """Return the adversary's motion from the takeover on, as recorded and then as planned for the time after it.

    Args:
        attempt: The attempt.
        result: What was recorded of it.
        dt: The step of the simulation [s].
    """
    bv = attempt.proposal.bv
    parts = [result.tracks(dt, bv)[bv].between(result.start + dt / 2, np.inf)]
    if bv in result.driven.beyond:
        parts.append(result.driven.beyond[bv])
    x, y, heading, speed = (np.concatenate([getattr(t, n) for t in parts]) for n in ("x", "y", "heading", "speed"))
    return PrescribedMotion(x, y, heading, speed)


def retimed(course: PrescribedMotion, rate: float, dt: float) -> PrescribedMotion:
    """Return a motion along the same path with a faster or slower clock.

    Beyond the end of the motion, the adversary goes on at its last speed.

    Args:
        course: The motion, with states ``dt`` apart.
        rate: The new rate of the clock, which is reached over ``CLOCK_EASING_S``; 1 keeps the motion [-].
        dt: The step [s].
    """
    times = dt * np.arange(1, len(course.x) + 1)
    eased = np.minimum(times, CLOCK_EASING_S)
    clock = times + (rate - 1.0) * (eased**2 / (2 * CLOCK_EASING_S) + times - eased)
    pace = 1.0 + (rate - 1.0) * eased / CLOCK_EASING_S
    beyond = np.maximum(clock - times[-1], 0.0) * course.speed[-1]

    def at(values: Floats) -> Floats:
        return np.asarray(np.interp(clock, times, values))

    heading = np.unwrap(course.heading)
    x = at(course.x) + beyond * np.cos(heading[-1])
    y = at(course.y) + beyond * np.sin(heading[-1])
    return PrescribedMotion(x, y, at(heading), at(course.speed) * pace)
