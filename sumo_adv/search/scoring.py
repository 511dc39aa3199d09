"""Predicted rollouts judged by the verdict's own functions, and their scores.

The lower the score, the better. A predicted collision scores by the level that it reaches (``predicted_level.py``) and
by how much there is to spare. Collisions that prove nothing, misses, infeasible motions, contacts with a third party
and rear-ends follow in this order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sumo_adv.datatypes import Bools, Boxes, Floats, Level, Limits, Prediction, Proposal, Role
from sumo_adv.drivers.third_parties import braking
from sumo_adv.metrics.boxes import between_steps, gap, on_grid, overlaps, pick, sweep, touching
from sumo_adv.metrics.contact import rear_end
from sumo_adv.metrics.criticality import ttc
from sumo_adv.metrics.gates import CLOCK_SLACK, kinematic_gates, near_pairs, off_road, third_party
from sumo_adv.metrics.levels import SERIOUS_DELTA_V
from sumo_adv.search.novelty import TRACE_STEP
from sumo_adv.search.predicted_level import Danger, danger_of, some_rows, some_steps
from sumo_adv.search.rollouts import Rollouts, Touch
from sumo_adv.search.settings import ScoreSettings
from sumo_adv.simulation.network import Drivable
from sumo_adv.situation import Situation

GENTLY = 1.0  # m/s2: gentler braking does not count
ROAD_INSET = 0.05  # m; the judge's 0.15 would leave no room for the error of a prediction
ROAD_STRIDE = 4  # steps between two tests of the corners, which are slow; off the road a vehicle stays for longer
LEAST_STEPS = 3  # before a contact, for a hazard to show


def judge_all(
    situation: Situation, proposals: Sequence[Proposal], rollouts: Rollouts, drivable: Drivable, limits: Limits,
    weights: ScoreSettings,
) -> list[tuple[float, Prediction]]:  # fmt: skip
    """The score and the prediction of each rollout, row by row."""
    n, steps = rollouts.ego[0].shape
    brakes = _brakes(rollouts.adversary[3], situation.dt)
    lengths = np.array([[situation.targets[p.bv].state.length] for p in proposals])
    widths = np.array([[situation.targets[p.bv].state.width] for p in proposals])
    ego = Boxes(*rollouts.ego, situation.ego.length, situation.ego.width)
    adversary = Boxes(*rollouts.adversary, lengths, widths)
    contact = _first(touching(ego, adversary))
    hit = contact < min(steps, situation.left + 1)
    smaller = Boxes(*rollouts.adversary, lengths - weights.graze, widths - weights.graze)
    firm = np.asarray(touching(ego, smaller).any(axis=1))
    end = int(min(steps - 1, situation.left))
    last = np.minimum(contact, end)
    end_time, at_contact = _ends(ego, adversary, last, hit, rollouts.time)
    judged = (rollouts.time > 0) & (rollouts.time <= end_time[:, None] + CLOCK_SLACK)  # the first state is SUMO's own
    before = np.array([situation.targets[p.bv].state.acceleration for p in proposals])
    third = _third_party(situation, proposals, adversary, rollouts.time, end_time)
    leaves = _leaves_road(adversary, judged, drivable)
    beyond = _beyond_limits(adversary, before, rollouts.time, judged, limits)
    rear = hit & rear_end(*at_contact)
    least, nearest, nearest_step = _least(ego, adversary, last)
    good = np.flatnonzero(hit & ~third & ~leaves & ~beyond & ~rear & (contact >= LEAST_STEPS))
    missed = weights.miss_by_ttc * np.minimum(least, 10.0) + weights.miss_by_gap * np.minimum(nearest, 30.0)
    score = np.where(hit, weights.no_warning, weights.miss + missed)
    score = np.where(leaves, weights.off_road, np.where(beyond, weights.beyond_limits, score))
    score = np.where(third, weights.third_party, np.where(rear, weights.rear_end, score))
    found: dict[int, int] = {}
    danger = None
    if len(good):
        names = [proposals[k].bv for k in good.tolist()]
        own, foe = (some_rows(b, good) for b in (ego, adversary))
        meeting = tuple(pick(b, good) for b in at_contact)
        danger = danger_of(situation, names, own, foe, last[good], meeting, drivable, weights)  # type: ignore[arg-type]
        score[good] = _score(danger, firm[good], weights)
        found = {int(k): i for i, k in enumerate(good)}
    closest = np.where(hit, last, nearest_step)
    predictions = []
    for k in range(n):
        made = Prediction(
            hit=bool(hit[k]), min_ttc=0.0 if hit[k] else float(least[k]), gap=float(nearest[k]),
            time=float(last[k] * situation.dt), spare=float((end - last[k]) * situation.dt),
            braking=float(brakes[k, : max(int(last[k]), 1)].mean()), third_party=bool(third[k]),
            off_road=bool(leaves[k]), beyond_limits=bool(beyond[k]),
            level=Level.COLLISION if hit[k] and not (third[k] or leaves[k] or beyond[k] or rear[k]) else Level.NONE,
            trace=_trace(adversary, k, int(closest[k]), situation.dt), closest=float(closest[k] * situation.dt),
        )  # fmt: skip
        if danger is not None and k in found:
            made = _with_danger(made, danger, found[k])
        predictions.append((float(score[k]), made))
    return predictions


def _with_danger(made: Prediction, danger: Danger, row: int) -> Prediction:
    return replace(
        made, level=Level(int(danger.level[row])), warning=float(danger.warning[row]),
        delta_v=float(danger.delta_v[row]), human=bool(danger.human[row]), careful=bool(danger.careful[row]),
        manoeuvre=bool(danger.manoeuvre[row]), side=danger.sides[row],
        acceleration=float(danger.acceleration[row]),
    )  # fmt: skip


def _trace(adversary: Boxes, row: int, until: int, dt: float) -> tuple[tuple[float, float], ...]:
    """Where the adversary is every ``TRACE_STEP`` [s], x and y [m], up to a step."""
    steps = slice(0, until + 1, max(1, round(TRACE_STEP / dt)))
    x, y = np.round(adversary.x[row, steps], 2).tolist(), np.round(adversary.y[row, steps], 2).tolist()
    return tuple(zip(x, y, strict=True))


def _brakes(speed: Floats, dt: float) -> Bools:
    """Whether it brakes by more than ``GENTLY``, step by step."""
    return np.asarray(np.diff(speed, axis=1) / dt < -GENTLY)


def touch_of(situations: Mapping[float, Situation], proposals: Sequence[Proposal]) -> Touch:
    """A function that tells whether the ego and the BVs of these candidates touch."""
    states = [situations[p.delay].targets[p.bv].state for p in proposals]
    length, width = np.array([s.length for s in states]), np.array([s.width for s in states])
    mine = next(iter(situations.values())).ego
    reach = (np.hypot(length, width) + np.hypot(mine.length, mine.width)) / 2

    def touch(ego: Floats, adversary: Floats, rows: Bools) -> Bools:
        found = np.asarray(rows & (np.hypot(ego[0] - adversary[0], ego[1] - adversary[1]) < reach))
        k = np.flatnonzero(found)
        if len(k):
            (ax, ay, ah, av), (bx, by, bh, bv) = ego[:, k], adversary[:, k]
            one = Boxes(ax, ay, ah, av, mine.length, mine.width)
            found[k] = overlaps(one, Boxes(bx, by, bh, bv, length[k], width[k]))
        return found

    return touch


def _first(holds: Bools) -> Any:
    return np.where(holds.any(axis=1), holds.argmax(axis=1), holds.shape[1])


def _score(danger: Danger, firm: Bools, weights: ScoreSettings) -> Floats:
    """By the level, and within a level by what is missing to the next: winners at the edge do not survive noise."""
    warned = np.clip(danger.warning / weights.warned_enough, 0.0, 1.0)
    hard = np.clip(danger.delta_v / SERIOUS_DELTA_V, 0.0, 1.0)
    harder = np.clip(danger.delta_v / SERIOUS_DELTA_V - 1.0, 0.0, 1.0)
    spare = weights.not_late * ~danger.late + weights.not_hard * (1.0 - harder)
    to_serious = weights.to_delta_v * (1.0 - hard) + weights.not_human * ~danger.human + weights.not_late * ~danger.late
    to_strict = weights.to_warning * (1.0 - warned) + weights.to_delta_v_early * (1.0 - hard)
    to_valid = np.where(danger.warning > 0, weights.to_warning * (1.0 - warned), weights.no_warning - weights.collision)
    levels = (Level.SERIOUS, Level.STRICT, Level.VALID)
    bases = (weights.serious, weights.strict, weights.valid)
    score = weights.collision + to_valid
    for level, base, rest in zip(levels, bases, (spare, to_serious, to_strict), strict=True):
        score = np.where(danger.level == level, base + rest, score)
    return np.asarray(score + np.where(firm, 0.0, weights.grazes))


def _ends(ego: Boxes, adversary: Boxes, last: Any, hit: Bools, time: Floats) -> tuple[Floats, tuple[Boxes, Boxes]]:
    """When each rollout ends ``(n,)`` [s], and both boxes ``(n,)`` then.

    That is the exact first contact, which lies in the step to ``last`` ``(n,)``, or ``last`` without a hit.
    """
    before = np.maximum(last - 1, 0)
    steps = (np.arange(len(last))[:, None], np.stack([before, last], axis=1))
    share = np.where(hit, np.minimum(sweep(pick(ego, steps), pick(adversary, steps))[:, 0], 1.0), 1.0)
    at_contact = between_steps(ego, last, share), between_steps(adversary, last, share)
    return time[before] + share * (time[last] - time[before]), at_contact


def _least(ego: Boxes, adversary: Boxes, last: Any) -> tuple[Floats, Floats, Any]:
    """Least TTC [s], least box distance [m] up to the contact, and the step at which the centres are nearest; every
    third step."""
    steps = np.arange(0, ego.x.shape[1], 3)
    shown = (np.arange(len(last))[:, None], steps[None, :])
    a, b = pick(ego, shown), pick(adversary, shown)
    before = steps[None, :] <= last[:, None]
    centres = np.where(before, np.hypot(a.x - b.x, a.y - b.y), np.inf)
    at = (np.arange(len(last)), centres.argmin(axis=1))
    least = np.where(before, ttc(a, b), np.inf).min(axis=1)
    return least, np.asarray(gap(pick(a, at), pick(b, at))), steps[at[1]]


def _third_party(
    situation: Situation, proposals: Sequence[Proposal], adversary: Boxes, time: Floats, end: Floats
) -> Bools:
    """Whether the adversary touches another vehicle before ``end`` ``(n,)`` [s], also if that vehicle brakes for it."""
    tracks = situation.traffic.others
    touched = np.zeros(len(proposals), bool)
    if not tracks:
        return touched
    around, driven = on_grid(tracks, np.asarray(situation.time + time)), slice(1, None)
    mine, theirs, when = some_steps(adversary, driven), some_steps(around, driven), time[driven]
    rows, others = near_pairs(mine, theirs, when, end)
    is_other = np.array([t.id for t in tracks])[others] != np.array([p.bv for p in proposals])[rows]
    rows, others = rows[is_other], others[is_other]
    meets = third_party(some_rows(mine, rows), some_rows(theirs, others), when, end[rows])
    rows, others = rows[meets], others[meets]
    reacts = np.array([situation.traffic.reacting and t.role is not Role.OBSTACLE for t in tracks])[others]
    touched[rows[~reacts]] = True
    rows, others = rows[reacts], others[reacts]
    if len(rows):
        steps = slice(0, int(np.searchsorted(time, end[rows].max())) + 1)
        mine = some_steps(some_rows(adversary, rows), steps)
        braked = braking(some_rows(around, others), mine, situation.road.lane_width, situation.dt)
        meets = third_party(some_steps(mine, driven), some_steps(braked, driven), time[steps][driven], end[rows])
        touched[rows[meets]] = True
    return touched


def _leaves_road(adversary: Boxes, judged: Bools, drivable: Drivable) -> Bools:
    """Whether a corner leaves the carriageway at the first driven step or every fourth after it, ``(n,)``."""
    looked_at = judged & (np.arange(judged.shape[1]) % ROAD_STRIDE == 1)
    return np.asarray(off_road(adversary, looked_at, drivable, ROAD_INSET).any(axis=1))


def _beyond_limits(adversary: Boxes, before: Floats, time: Floats, judged: Bools, limits: Limits) -> Bools:
    """Whether a kinematic gate fails ``(n,)``; ``before``: the acceleration at the trigger ``(n,)`` [m/s2]."""
    change = np.diff(adversary.speed, axis=1) / np.diff(time)
    acceleration = np.concatenate([before[:, None], change], axis=1)
    broken = kinematic_gates(adversary, acceleration, time, limits)
    return np.asarray((np.any(list(broken.values()), axis=0) & judged).any(axis=1))
