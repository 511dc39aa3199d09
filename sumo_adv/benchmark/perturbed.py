"""Robust winners: the same attack with its timing disturbed.

A search can find a collision that only just happens. So the adversary's recorded motion is driven again with other
timing, while ego and traffic react: once such that it arrives 0.4 s later, and five times with its clock faster or
slower by up to 10 %. An attack is robust if at least four of the six are valid.
"""

from __future__ import annotations

from dataclasses import replace
from random import Random
from typing import Any

from sumo_adv.datatypes import Level
from sumo_adv.episode.assessment import AttemptRunner, attempt_of
from sumo_adv.episode.episode import Episode
from sumo_adv.episode.neighbours import recorded_course, retimed

LATER = 0.4  # s by which the adversary arrives later
SCALED, RANGE = 5, 0.1  # motions with another clock, and by how much of its rate at most
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
