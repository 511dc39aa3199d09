"""Robust winners: the same attack with its timing disturbed.

A search can find a collision that only just happens. So the adversary's recorded motion is driven again with other
timing, while ego and traffic react: once such that it arrives 0.4 s later, and five times with its clock faster or
slower by up to 10 %. An attack is robust if at least four of the six are valid.
"""

from __future__ import annotations

from dataclasses import replace
from random import Random
from typing import Any

import numpy as np

from sumo_adv.datatypes import Attempt, Floats, Level, PrescribedMotion
from sumo_adv.episode.assessment import attempt_of
from sumo_adv.episode.attempt_runner import AttemptRunner
from sumo_adv.episode.episode import Episode
from sumo_adv.episode.task import AttemptResult
from sumo_adv.simulation.recording import tracks_of

LATER = 0.4  # s by which the adversary arrives later
SCALED, RANGE = 5, 0.1  # motions with another clock, and by how much of its rate at most
EASED = 1.0  # s over which the clock takes its new rate, so that the speed does not jump at the takeover
ENOUGH = 4  # valid ones of all six that make an attack robust


def robustness_of(episode: Episode, runner: AttemptRunner, seed: int) -> dict[str, Any] | None:
    """How many of the disturbed motions of the attempt that counts are valid; None if that attempt is not valid."""
    best, done = episode.best, episode.refinement
    if best is None or best.verdict.level < Level.VALID or best.verdict.contact_time is None:
        return None
    assert episode.found is not None
    encounter, result, dt = episode.found, done.results[best.index], episode.settings.step_length
    course, contact = recorded_course(best, result, dt), best.verdict.contact_time - result.start
    rng = Random(seed)
    rates = [contact / (contact + LATER), *(1.0 + rng.uniform(-RANGE, RANGE) for _ in range(SCALED))]
    proposals = [replace(best.proposal, course=retimed(course, rate, dt)) for rate in rates]
    results = runner.attempt(proposals)
    again = [attempt_of(0, "again", p, r, encounter, episode.settings) for p, r in zip(proposals, results, strict=True)]
    valid = sum(a.verdict.level >= Level.VALID for a in again)
    return {"valid": valid, "of": len(again), "robust": valid >= ENOUGH}


def recorded_course(attempt: Attempt, result: AttemptResult, dt: float) -> PrescribedMotion:
    """The adversary's motion from the takeover on, as recorded and as planned for after it."""
    track = tracks_of(result.snapshots, result.sizes, {}, dt, (attempt.proposal.bv,))[0]
    parts = [track.between(result.start + dt / 100, np.inf)]
    if attempt.proposal.bv in result.driven.beyond:
        parts.append(result.driven.beyond[attempt.proposal.bv])
    x, y, heading, speed = (np.concatenate([getattr(t, n) for t in parts]) for n in ("x", "y", "heading", "speed"))
    return PrescribedMotion(x, y, heading, speed)


def retimed(course: PrescribedMotion, rate: float, dt: float) -> PrescribedMotion:
    """The same path with a clock of another ``rate`` (1: as it was), which it takes over ``EASED`` s.

    States are ``dt`` [s] apart; where the recorded motion ends, the adversary goes on at its last speed.
    """
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
