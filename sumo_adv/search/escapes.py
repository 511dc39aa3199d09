"""How an ego escapes from a collider, and what a support has to do against it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sumo_adv.datatypes import Duty, ObservedMotion, Proposal
from sumo_adv.search.rollouts import Rollouts
from sumo_adv.situation import Situation

ASIDE = 0.4  # m from its path, from which on the ego has swerved
BEHIND = 5.0  # m from centre to centre along the ego's path, from which on a vehicle is behind it
SLOWER = 0.5  # m/s below its unattacked speed, from which on it has braked


def against(offset: float, speed: float, unattacked: float) -> tuple[Duty, ...]:
    """What a support has to do against an escape: an offset from the ego's path [m, left positive], and a speed
    compared with the unattacked one [m/s]."""
    if offset > ASIDE:
        return (Duty.BLOCK_LEFT,)
    if offset < -ASIDE:
        return (Duty.BLOCK_RIGHT,)
    return (Duty.SLOW, Duty.HIDE) if speed < unattacked - SLOWER else ()


def predicted_escapes(
    situations: Mapping[float, Situation], proposals: Sequence[Proposal], rollouts: Rollouts
) -> list[tuple[Duty, ...]]:
    """What supports have to do so that each candidate succeeds, by its rollout.

    Where a third party is in the collider's way, it is to make room. Where the ego does not react and the collider
    stays behind it, a support has to hold the ego up; there is nothing to do where the collider does not stay behind.
    """
    x, y, _, v = rollouts.ego
    steps = np.hypot(x - rollouts.adversary[0], y - rollouts.adversary[1]).argmin(axis=1).tolist()
    duties = list[tuple[Duty, ...]]()
    for row, (p, k) in enumerate(zip(proposals, steps, strict=True)):
        if p.prediction is not None and p.prediction.third_party:
            duties.append((Duty.OPEN,))
            continue
        baseline = situations[p.delay].baseline
        station, offset = baseline.path.project(float(x[row, k]), float(y[row, k]))
        escape = against(offset, float(v[row, k]), float(baseline.v[min(k, len(baseline.v) - 1)]))
        behind, _ = baseline.path.project(*(float(q[row, k]) for q in rollouts.adversary[:2]))
        duties.append(escape or ((Duty.SLOW,) if behind < station - BEHIND else ()))
    return duties


def observed_escape(situation: Situation, motion: ObservedMotion) -> tuple[Duty, ...]:
    """The same for an attempt, by the ego's motion in it: its widest swerve, else its hardest braking."""
    seen = slice(0, max(motion.seen, 1))
    offset = motion.d[seen]
    widest = float(offset[np.abs(offset).argmax()])
    baseline = situation.baseline.v
    count = min(len(motion.v[seen]), len(baseline))
    slower = int((motion.v[:count] - baseline[:count]).argmin())
    return against(widest, float(motion.v[slower]), float(baseline[slower]))
