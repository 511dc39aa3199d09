"""Rollouts of many candidates at once: predicted adversaries and egos on the planners' own answers, in numpy.

A rollout is not an attempt: it never counts, and only decides what is tried. The egos are those of ``drivers``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sumo_adv.datatypes import Bools, Floats, Limits, Proposal
from sumo_adv.drivers.prediction import PredictedEgos
from sumo_adv.errors import PlannerResultError
from sumo_adv.planners.adversary_batch import AdversaryBatch
from sumo_adv.planners.answers import Answer, PlannerObservation, local_endpoint
from sumo_adv.planners.follower import Follower
from sumo_adv.planners.trajectory import Batch, Motion, PathEndpoint, advance, one_of, pose, put_back, release, steer
from sumo_adv.situation import Situation

Ask = Callable[[Sequence[int], Sequence[PlannerObservation]], Sequence[Answer | None]]
Touch = Callable[[Floats, Floats, Bools], Bools]
"""Whether egos and colliders (x, y, heading, speed: ``(4, n)``) touch, of the rows given, ``(n,)``."""
Motions = tuple[Floats, Floats, Floats, Floats]
"""x, y, heading, speed, each ``(n, steps)``."""


@dataclass(frozen=True, slots=True)
class Rollouts:
    """Predicted motions; row k is candidate k. ``adversary``: the colliders; ``supports``: the first supports of all
    candidates, then their second ones."""

    time: Floats
    ego: Motions
    adversary: Motions
    disturbed: Bools
    supports: tuple[Motions, ...] = ()


def predict(
    situations: Mapping[float, Situation], proposals: Sequence[Proposal], ask: Ask, *, limits: Limits, steps: int,
    replan: int, touch: Touch | None = None, to_the_end: bool = False,
) -> Rollouts:  # fmt: skip
    """Roll all candidates out for ``steps`` steps; their planners are asked every ``replan`` steps.

    All candidates have the same number of supports. The rows are those of :func:`lined_up`, so that the cost grows with
    the number of adversaries.

    situations: by delay [s], the moment at which a candidate's attack begins. ask(rows, observations): the answers of
    the planners of ``rows``, None where a planner fails, and for all other rows.
    A candidate is asked no more once ego and collider have touched: the adversaries then follow
    their last plans, as in an attempt. Once that holds for all, the egos go on at constant speed; ``to_the_end``: by
    their drivers.
    """
    members, n = lined_up(proposals), len(proposals)
    ground, each = AdversaryBatch([situations[p.delay] for p in members], [p.bv for p in members]), len(members) // n
    scenes, dt = ground.scenes, ground.scenes.dt
    width = np.array([t.state.width for t in ground.targets])
    motion, egos = ground.begin(), PredictedEgos(scenes, ground.length, width, each)
    goal = PathEndpoint(motion.s + motion.v * 3.0, motion.d, motion.v, motion.v * 0 + 3.0)
    last: list[Mapping[str, float] | None] = [None] * len(members)
    adversary, ego = np.empty((steps, 4, len(members))), np.empty((steps, 4, n))
    followers: dict[int, Follower] = {}
    over, driven, speed_before = np.zeros(n, bool), -1, egos.v
    hard = np.zeros(len(members), bool)
    for k in range(steps):
        moment = k * dt
        if k % replan == 0 and not over.all():
            rows = np.flatnonzero(np.tile(~over, each)).tolist()
            mean = egos.a if k == 0 else (egos.v - speed_before) / (replan * dt)  # as in an attempt
            own = tuple(np.tile(q, each) for q in (egos.s, np.zeros(n), egos.v, mean))
            goal, motion = _replan(ground, motion, own, goal, last, followers, moment, rows, ask)  # type: ignore[arg-type]
            speed_before, hard = egos.v, ground.may_brake_hard(motion)
        adversary[k] = (*pose(Batch, motion, ground.rows), motion.v)
        if to_the_end or not over.all():
            ego[k] = egos.pose()
            driven = k
            if touch is not None:
                over |= touch(ego[k], adversary[k, :, :n], ~over)
            if egos.reacts:
                egos.step(moment, ground.relative(motion), motion.v, ground.at_junction(motion))
            else:
                egos.step_alone(moment)
        motion = _advance(ground, motion, goal, followers, limits, hard)
        goal = goal._replace(time=goal.time - dt)
    ego[driven + 1 :] = egos.onwards(steps - driven - 1).transpose(2, 0, 1)
    ego_motions, adversary_motions = (np.ascontiguousarray(q.transpose(1, 2, 0)) for q in (ego, adversary))
    parts: list[Any] = [tuple(adversary_motions[:, first : first + n]) for first in range(0, len(members), n)]
    own_motions: Any = tuple(ego_motions)
    time = np.asarray(np.arange(steps) * dt, float)
    return Rollouts(time, own_motions, parts[0], egos.disturbed, tuple(parts[1:]))


def lined_up(proposals: Sequence[Proposal]) -> list[Proposal]:
    """The adversaries of candidates that have the same number each: all colliders, all first supports, and so on."""
    return [p for rank in zip(*(p.members for p in proposals), strict=True) for p in rank]


def _replan(
    ground: AdversaryBatch, motion: Motion, ego: tuple[Floats, Floats, Floats, Floats], goal: PathEndpoint,
    last: list[Mapping[str, float] | None], followers: dict[int, Follower], now: float, rows: Sequence[int], ask: Ask,
) -> tuple[PathEndpoint, Motion]:  # fmt: skip
    observations = ground.observe(motion, now, ego, last, rows)
    answers = ask(rows, observations)
    for k in rows:
        answer = answers[k]
        last[k] = None if answer is None else local_endpoint(ground.scenes.of[k], answer.endpoint)
    goal = ground.aim(motion, [None if a is None else a.endpoint for a in answers], goal)
    before = motion
    motion = _steer(ground, motion, goal, [k for k in followers if answers[k] is not None])
    for k, answer in enumerate(answers):
        if answer is not None:
            followers.pop(k, None)
        if answer is not None and answer.trajectory is not None:
            try:
                followers[k] = ground.follower(k, before, answer.trajectory)
            except PlannerResultError:  # said in the attempt; here as there the built-in f_traj leads it
                continue
            motion = put_back(motion, [k], [followers[k].begin(one_of(motion, k))])
    return goal, motion


def _steer(ground: AdversaryBatch, motion: Motion, goal: PathEndpoint, released: Sequence[int]) -> Motion:
    """Aim all at their goals; those of ``released`` were led by a trajectory until now."""
    if released:
        motion = put_back(motion, released, [release(one_of(motion, k)) for k in released])
    return steer(Batch, motion, goal, ground.rows.at(motion.s)[3])


def _advance(
    ground: AdversaryBatch,
    motion: Motion,
    goal: PathEndpoint,
    followers: dict[int, Follower],
    limits: Limits,
    hard: Bools,
) -> Motion:
    """One step on, by the built-in f_traj or after the planner's own trajectory."""
    over = [k for k, f in followers.items() if f.over]
    if over:
        motion = _steer(ground, motion, goal, over)
        for k in over:
            del followers[k]
    moved = advance(Batch, motion, goal, ground.rows, limits, ground.cap, ground.scenes.dt, hard)
    if not followers:
        return moved
    ones = [
        f.advance(one_of(motion, k), ground.road(k), limits, float(ground.cap[k]), bool(hard[k]))
        for k, f in followers.items()
    ]
    return put_back(moved, list(followers), ones)
