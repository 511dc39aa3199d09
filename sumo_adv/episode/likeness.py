"""How unlike the log an attack is: the adversary's speeds and accelerations against its own logged ones."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from sumo_adv.datatypes import Attempt
from sumo_adv.episode.task import AttemptResult
from sumo_adv.metrics.realism import wasserstein
from sumo_adv.simulation.recording import tracks_of
from sumo_adv.simulation.simulation import Snapshot

SPEED, ACCELERATION = 5.0, 2.0  # m/s and m/s2: distances of the distributions that weigh the same


def unlikeness(
    attempt: Attempt,
    result: AttemptResult,
    log: Sequence[Snapshot],
    sizes: Mapping[str, tuple[float, float]],
    dt: float,
) -> float:
    """The sum of the Wasserstein-1 distances of both distributions from the start to the contact, in shares of
    ``SPEED`` and ``ACCELERATION``; ``inf`` where the log has no such motion.

    log: the states without an attack, and sizes [m] of its vehicles. dt: step of the simulation [s].
    """
    bv, contact = attempt.proposal.bv, attempt.verdict.contact_time
    end = math.inf if contact is None else contact
    driven = tracks_of(result.snapshots, result.sizes, {}, dt, (bv,))
    logged = tracks_of(log, sizes, {}, dt, (bv,))
    if not driven or not logged:
        return math.inf
    attacking, own = driven[0].between(result.start + dt / 2, end), logged[0].between(result.start + dt / 2, end)
    if not len(attacking.time) or not len(own.time):
        return math.inf
    return wasserstein(attacking.speed, own.speed) / SPEED + (
        wasserstein(attacking.acceleration, own.acceleration) / ACCELERATION
    )
