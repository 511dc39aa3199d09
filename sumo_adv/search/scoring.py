"""Scores of predicted rollouts, which are judged by the verdict's own functions.

The lower the score, the better. A predicted collision is scored by the level that it reaches (``predicted_level.py``)
and by its margin to the next level. Collisions that prove nothing, misses, infeasible motions, contacts with a third
party and rear-ends follow in this order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import combinations
from typing import Any

import numpy as np

from sumo_adv.datatypes import Bools, Boxes, Floats, Ints, Level, Limits, Prediction, Proposal, Role, Track
from sumo_adv.geometry import Path
from sumo_adv.goal import Goal
from sumo_adv.metrics.boxes import (
    between_steps,
    gap,
    half_diagonal,
    on_grid,
    overlaps,
    pick,
    some_steps,
    sweep,
    touching,
)
from sumo_adv.metrics.contact import rear_end
from sumo_adv.metrics.criticality import ttc
from sumo_adv.metrics.gates import CLOCK_SLACK_S, kinematic_gates, near_pairs, off_road, third_party
from sumo_adv.road_users import RoadUser, road_user, unprotected
from sumo_adv.search.predicted_level import Collisions, PredictedSeverity, danger_of, some_rows
from sumo_adv.search.rollouts import Motions, Rollouts, Touch
from sumo_adv.search.settings import MAX_COUNTED_DISTANCE_M, MAX_COUNTED_TTC_S, ScoreSettings
from sumo_adv.simulation.network import Drivable
from sumo_adv.situation import Situation, heights_along

UNCOUNTED_BRAKING_M_S2 = 1.0  # gentler braking does not count
ROAD_INSET_M = 0.05  # the judge's 0.15 m would leave no room for prediction errors
ROAD_CHECK_STRIDE = 4  # steps between two tests of the corners, which are slow; a vehicle stays off the road for longer
NO_TOUCH_DISTANCE_M = 5.0  # between boxes; up to 50 m/s, vehicles farther apart at every step do not touch in between
MIN_HAZARD_STEPS = 3  # minimum number of steps before a contact, so that a hazard can show


def judge_all(
    situations: Mapping[float, Situation], proposals: Sequence[Proposal], rollouts: Rollouts, drivable: Drivable,
    limits: Limits, weights: ScoreSettings,
) -> list[tuple[float, Prediction]]:  # fmt: skip
    """Score rollouts.

    Args:
        situations: The situations by delay after the trigger [s].
        proposals: The candidates.
        rollouts: Their predicted motions, row by row.
        drivable: Where vehicles can drive.
        limits: The limits of all adversaries.
        weights: How a prediction becomes a score.

    Returns:
        The score and the prediction of each candidate, in order.
    """
    seen = _look_at(situations, proposals, rollouts, drivable, limits)
    ttc_left, gap_left = np.minimum(seen.least, MAX_COUNTED_TTC_S), np.minimum(seen.nearest, MAX_COUNTED_DISTANCE_M)
    missed = weights.miss_by_ttc * ttc_left + weights.miss_by_gap * gap_left
    score = np.where(seen.hit, weights.no_warning, weights.miss + missed)
    score = np.where(seen.leaves, weights.off_road, np.where(seen.beyond, weights.beyond_limits, score))
    score = np.where(seen.third, weights.third_party, np.where(seen.rear, weights.rear_end, score))
    predictions = [_prediction(seen, k) for k in range(len(proposals))]
    rows = np.flatnonzero(seen.counts & (seen.contact >= MIN_HAZARD_STEPS))
    if len(rows):
        own, foe, *helpers = (some_rows(b, rows) for b in (seen.ego, seen.adversary, *seen.supports))
        ego_at, adversary_at = (pick(b, rows) for b in seen.at_contact)
        names = [proposals[k].bvs for k in rows.tolist()]
        begun = [situations[proposals[k].delay] for k in rows.tolist()]
        danger = danger_of(
            Collisions(begun, names, own, foe, seen.last[rows], (ego_at, adversary_at), helpers), drivable
        )
        score[rows] = _score(danger, weights)
        for i, k in enumerate(rows.tolist()):
            predictions[k] = _with_danger(predictions[k], danger, i)
    return list(zip(score.tolist(), predictions, strict=True))


@dataclass(frozen=True, slots=True)
class _Seen:
    """What rollouts show. Row k is candidate k.

    Attributes:
        ego: The egos, ``(n, steps)``.
        adversary: The colliders, ``(n, steps)``.
        dt: The step length [s].
        contact: The step of the first contact with the collider.
        hit: Whether there is a contact.
        last: The step of the contact, or the last judged step.
        at_contact: The boxes of the ego and the collider at that time, each ``(n,)``.
        third: Whether an adversary touches a third party, or a support touches the ego or another adversary.
        leaves: Whether an adversary leaves the road.
        beyond: Whether an adversary moves beyond the limits.
        rear: Whether the collider runs into the ego's rear.
        least: The minimum TTC [s].
        nearest: The distance when the centres are nearest [m].
        supports: The first supports of all candidates, then the second ones, each ``(n, steps)``.
    """

    ego: Boxes
    adversary: Boxes
    dt: float
    contact: Ints
    hit: Bools
    last: Ints
    at_contact: tuple[Boxes, Boxes]
    third: Bools
    leaves: Bools
    beyond: Bools
    rear: Bools
    least: Floats
    nearest: Floats
    supports: Sequence[Boxes] = ()

    @property
    def counts(self) -> Bools:
        """Which rows are collisions that nothing rules out."""
        return self.hit & ~(self.third | self.leaves | self.beyond | self.rear)


def _look_at(
    situations: Mapping[float, Situation], proposals: Sequence[Proposal], rollouts: Rollouts, drivable: Drivable,
    limits: Limits,
) -> _Seen:  # fmt: skip
    """Judge rollouts, without the level of their collisions."""
    steps, begun = rollouts.ego[0].shape[1], [situations[p.delay] for p in proposals]
    ego_state, dt, time = begun[0].ego, begun[0].dt, rollouts.time
    own = Boxes(*rollouts.ego, ego_state.length, ego_state.width)
    ego = _raised(own, [(situation.baseline.path,) for situation in begun])
    ranks = zip(*(p.members for p in proposals), strict=True)
    motions = (rollouts.adversary, *rollouts.supports)
    driven = [_driven(begun, members, motion) for members, motion in zip(ranks, motions, strict=True)]
    adversary, *supports = (boxes for boxes, _ in driven)
    left = np.array([situation.left for situation in begun])
    touches = touching(ego, adversary)
    contact: Any = np.where(touches.any(axis=1), touches.argmax(axis=1), steps)
    hit = contact < np.minimum(steps, left + 1)
    end = np.minimum(steps - 1, left).astype(np.intp)
    last = np.minimum(contact, end)
    end_time, at_contact = _ends(ego, adversary, last, hit, time)
    judged = (time > 0) & (time <= end_time[:, None] + CLOCK_SLACK_S)  # the first state is SUMO's own
    third, leaves, beyond = np.zeros((3, len(proposals)), bool)
    bvs = [p.bvs for p in proposals]
    for boxes, before in driven:
        third |= _third_party(begun, bvs, boxes, time, end_time)
        bound = judged & ~unprotected(boxes.length, boxes.width)  # vehicles that must stay on the carriageway
        looked_at = bound & (np.arange(steps) % ROAD_CHECK_STRIDE == 1)
        leaves |= off_road(boxes, looked_at, drivable, ROAD_INSET_M).any(axis=1)
        beyond |= _beyond_limits(boxes, before, time, judged, limits)
    for first, second in combinations((ego, adversary, *supports), 2):
        if second is not adversary:
            third |= _touch(first, second, time, end_time)
    least, nearest = _least(ego, adversary, last)
    return _Seen(
        ego, adversary, dt, contact, hit, last, at_contact, third, leaves, beyond, hit & rear_end(*at_contact),
        least, nearest, supports,
    )  # fmt: skip


def _driven(begun: Sequence[Situation], members: Sequence[Proposal], motions: Motions) -> tuple[Boxes, Floats]:
    """Return one adversary of each candidate: its motion, and its acceleration at the trigger [m/s2]."""
    states = [situation.targets[p.bv].state for situation, p in zip(begun, members, strict=True)]
    lengths, widths = np.array([[s.length] for s in states]), np.array([[s.width] for s in states])
    ways = [
        tuple(way.path for way in situation.targets[p.bv].ways)
        for situation, p in zip(begun, members, strict=True)
    ]  # fmt: skip
    return _raised(Boxes(*motions, lengths, widths), ways), np.array([s.acceleration for s in states])


def _raised(boxes: Boxes, paths: Sequence[tuple[Path, ...]]) -> Boxes:
    """Put boxes ``(n, steps)`` at the heights of the paths of their rows."""
    if not any(np.ndim(path.z) for row in paths for path in row):
        return boxes
    z = np.empty(boxes.x.shape)
    for row, along in enumerate(paths):
        z[row] = heights_along(along, boxes.x[row], boxes.y[row])
    return replace(boxes, z=z)


def _touch(one: Boxes, other: Boxes, time: Floats, end: Floats) -> Bools:
    """Return whether the two vehicles of a row touch before ``end`` ``(n,)`` [s], ``(n,)``."""
    reach = half_diagonal(one) + half_diagonal(other) + NO_TOUCH_DISTANCE_M
    rows = np.flatnonzero((np.hypot(one.x - other.x, one.y - other.y) < reach).any(axis=1))
    touched = np.zeros(len(end), bool)
    if len(rows):
        touched[rows] = third_party(some_rows(one, rows), some_rows(other, rows), time, end[rows])
    return touched


def _prediction(seen: _Seen, k: int) -> Prediction:
    """Return the prediction of row ``k``, without what ``danger_of`` adds."""
    hit, last, dt = bool(seen.hit[k]), int(seen.last[k]), seen.dt
    braking_share = (np.diff(seen.adversary.speed[k, : max(last, 1) + 1]) / dt < -UNCOUNTED_BRAKING_M_S2).mean()
    return Prediction(
        hit=hit, min_ttc=0.0 if hit else float(seen.least[k]), gap=float(seen.nearest[k]), time=last * dt,
        braking=float(braking_share), third_party=bool(seen.third[k]),
        off_road=bool(seen.leaves[k]), beyond_limits=bool(seen.beyond[k]),
        level=Level.COLLISION if seen.counts[k] else Level.NONE,
    )  # fmt: skip


def _with_danger(made: Prediction, danger: PredictedSeverity, row: int) -> Prediction:
    """Add the severity of a row to its prediction."""
    return replace(
        made, level=Level(int(danger.level[row])), warning=float(danger.warning[row]),
        delta_v=float(danger.delta_v[row]), human=bool(danger.human[row]), careful=bool(danger.careful[row]),
        manoeuvre=bool(danger.manoeuvre[row]), side=danger.sides[row],
        acceleration=float(danger.acceleration[row]),
    )  # fmt: skip


def touch_of(situations: Mapping[float, Situation], proposals: Sequence[Proposal]) -> Touch:
    """Return a function that tells whether the ego and the colliders of these candidates touch.

    Args:
        situations: The situations by delay after the trigger [s].
        proposals: The candidates.
    """
    states = [situations[p.delay].targets[p.bv].state for p in proposals]
    length, width = np.array([s.length for s in states]), np.array([s.width for s in states])
    ego_state = next(iter(situations.values())).ego
    reach = (np.hypot(length, width) + np.hypot(ego_state.length, ego_state.width)) / 2

    def touch(ego: Floats, adversary: Floats, rows: Bools) -> Bools:
        touched = np.asarray(rows & (np.hypot(ego[0] - adversary[0], ego[1] - adversary[1]) < reach))
        k = np.flatnonzero(touched)
        if len(k):
            (ax, ay, ah, av), (bx, by, bh, bv) = ego[:, k], adversary[:, k]
            ego_box = Boxes(ax, ay, ah, av, ego_state.length, ego_state.width)
            touched[k] = overlaps(ego_box, Boxes(bx, by, bh, bv, length[k], width[k]))
        return touched

    return touch


def _score(danger: PredictedSeverity, weights: ScoreSettings) -> Floats:
    """Score collisions by their level, and within a level by their shortfall from the next one.

    Collisions at the edge of a level would not survive noise.
    """
    warned = np.clip(danger.warning / weights.warned_enough, 0.0, 1.0)
    hard = np.clip(danger.hardness, 0.0, 1.0)
    to_serious = weights.to_delta_v * (1.0 - hard) + weights.not_human * ~danger.human
    to_strict = weights.to_warning * (1.0 - warned) + weights.to_delta_v_early * (1.0 - hard)
    to_valid = np.where(danger.warning > 0, weights.to_warning * (1.0 - warned), weights.no_warning - weights.collision)
    reached = [danger.level == level for level in (Level.SERIOUS, Level.STRICT, Level.VALID)]
    scores = [np.asarray(weights.serious), weights.strict + to_serious, weights.valid + to_strict]
    return np.select(reached, scores, weights.collision + to_valid)


def _ends(ego: Boxes, adversary: Boxes, last: Any, hit: Bools, time: Floats) -> tuple[Floats, tuple[Boxes, Boxes]]:
    """Return when each rollout ends ``(n,)`` [s], and both boxes ``(n,)`` then.

    A rollout ends at the exact first contact, which lies in the step to ``last`` ``(n,)``. Without a contact, it ends
    at ``last``.
    """
    before = np.maximum(last - 1, 0)
    steps = (np.arange(len(last))[:, None], np.stack([before, last], axis=1))
    share = np.where(hit, np.minimum(sweep(pick(ego, steps), pick(adversary, steps))[:, 0], 1.0), 1.0)
    at_contact = between_steps(ego, last, share), between_steps(adversary, last, share)
    return time[before] + share * (time[last] - time[before]), at_contact


def _least(ego: Boxes, adversary: Boxes, last: Any) -> tuple[Floats, Floats]:
    """Return the minimum TTC [s], and the box distance [m] when the centres are nearest, at every third step up to the
    contact.
    """
    steps = np.arange(0, ego.x.shape[1], 3)
    shown = (np.arange(len(last))[:, None], steps[None, :])
    a, b = pick(ego, shown), pick(adversary, shown)
    before = steps[None, :] <= last[:, None]
    centres = np.where(before, np.hypot(a.x - b.x, a.y - b.y), np.inf)
    at = (np.arange(len(last)), centres.argmin(axis=1))
    least = np.where(before, ttc(a, b), np.inf).min(axis=1)
    return least, np.asarray(gap(pick(a, at), pick(b, at)))


def _third_party(
    begun: Sequence[Situation], bvs: Sequence[tuple[str, ...]], adversary: Boxes, time: Floats, end: Floats
) -> Bools:
    """Return whether the adversary touches another vehicle before ``end`` ``(n,)`` [s].

    A reacting vehicle that is behind the adversary at first is assumed to brake in time.

    Args:
        begun: The situation of each row.
        bvs: The ids of all adversaries of each row, which are no third parties.
        adversary: One adversary of each row, ``(n, steps)``.
        time: The time since the start of the attack [s], ``(steps,)``.
        end: When each rollout ends [s], ``(n,)``.
    """
    touched, driven, when = np.zeros(len(bvs), bool), slice(1, None), time[1:]
    pairs = [
        _near_others(situation, begun, bvs, adversary, time, end) for situation in {id(s): s for s in begun}.values()
    ]
    rows = np.concatenate([own for own, _ in pairs])
    if not len(rows):
        return touched
    around = _joined([boxes for _, boxes in pairs])
    meets = third_party(some_steps(some_rows(adversary, rows), driven), some_steps(around, driven), when, end[rows])
    touched[rows[meets]] = True
    return touched


def _joined(parts: Sequence[Boxes]) -> Boxes:
    """Concatenate boxes ``(n, steps)`` along the rows."""
    x, y, heading, speed, length, width = (
        np.concatenate([getattr(b, f.name) for b in parts]) for f in fields(Boxes) if f.name != "z"
    )
    z = np.concatenate([np.broadcast_to(b.z, b.x.shape) for b in parts]) if any(np.ndim(b.z) for b in parts) else 0.0
    return Boxes(x, y, heading, speed, length, width, z)


def _near_others(
    situation: Situation, begun: Sequence[Situation], bvs: Sequence[tuple[str, ...]], adversary: Boxes, time: Floats,
    end: Floats,
) -> tuple[Ints, Boxes]:  # fmt: skip
    """Find pairs of an adversary and another vehicle that may touch, among the rows that begin in a situation.

    Vehicles that will brake are left out.

    Returns:
        The adversary's row and the other vehicle's motion ``(pairs, steps)``.
    """
    own = np.flatnonzero([s is situation for s in begun])
    tracks, driven = situation.traffic.others, slice(1, None)
    around = on_grid(tracks, np.asarray(situation.time + time))
    rows, others = near_pairs(
        some_steps(some_rows(adversary, own), driven), some_steps(around, driven), time[driven], end[own]
    )
    rows = own[rows]
    ids, ranks = np.array([t.id for t in tracks])[others], zip(*bvs, strict=True)
    counts = np.all([ids != np.array(rank)[rows] for rank in ranks], axis=0)
    reacts = np.array([situation.traffic.reacting and _brakes(t) for t in tracks], bool)[others]
    x, y, heading = (q[rows, 0] for q in (adversary.x, adversary.y, adversary.heading))
    ahead = (around.x[others, 0] - x) * np.cos(heading) + (around.y[others, 0] - y) * np.sin(heading)
    kept = counts & ~(reacts & (ahead < 0.0))
    return rows[kept], some_rows(around, others[kept])


def _brakes(track: Track) -> bool:
    """Return whether the track brakes for what is ahead; obstacles and pedestrians do not."""
    return track.role is not Role.OBSTACLE and road_user(track) is not RoadUser.PEDESTRIAN


def _beyond_limits(adversary: Boxes, before: Floats, time: Floats, judged: Bools, limits: Limits) -> Bools:
    """Return whether a kinematic gate fails ``(n,)``; ``before`` is the acceleration at the trigger ``(n,)`` [m/s2]."""
    change = np.diff(adversary.speed, axis=1) / np.diff(time)
    acceleration = np.concatenate([before[:, None], change], axis=1)
    broken = kinematic_gates(adversary, acceleration, time, limits)
    return np.asarray((np.any(list(broken.values()), axis=0) & judged).any(axis=1))


# -- goals that are more than a level -------------------------------------------------------------------------------


def goal_score(goal: Goal, score: float, made: Prediction, weights: ScoreSettings) -> float:
    """Score a prediction for the goal.

    A motion that fails whatever the ego does keeps its score. If a near miss is wanted, so does a contact that does not
    count, such as a run into the ego's rear.

    Args:
        goal: What an attack is meant to achieve.
        score: The score by the level alone.
        made: The prediction.
        weights: How a prediction becomes a score.
    """
    if goal.ttc is not None:
        spoilt = made.hopeless or (made.hit and made.level < Level.COLLISION)
        return score if spoilt else _near_miss(goal.ttc, made, weights)
    if goal.min_delta_v > 0 and made.level >= Level.COLLISION and made.delta_v < goal.min_delta_v:
        return weights.miss + weights.too_mild * (1.0 - made.delta_v / goal.min_delta_v)
    return score


def _near_miss(band: tuple[float, float], made: Prediction, weights: ScoreSettings) -> float:
    """Score a near miss.

    Within the band, the score improves towards the middle. Outside of it, the score improves towards the band. A
    contact is worst.
    """
    low, high = band
    if made.hit:
        return weights.miss + weights.miss_by_ttc * low + weights.contact
    if low <= made.min_ttc <= high:
        return weights.strict * abs(2.0 * made.min_ttc - low - high) / (high - low)
    off = low - made.min_ttc if made.min_ttc < low else min(made.min_ttc - high, MAX_COUNTED_TTC_S)
    far = weights.miss_by_gap * min(made.gap, MAX_COUNTED_DISTANCE_M) if made.min_ttc > high else 0.0
    return weights.miss + weights.miss_by_ttc * off + far
