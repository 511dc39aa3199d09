"""Rollouts of many candidates at once: predicted adversaries and egos on the planners' own answers, in numpy.

A rollout is not an attempt: it never counts, and only decides which candidates are tried. The egos are those of
``drivers``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sumo_adv.datatypes import Bools, Floats, Limits, Proposal
from sumo_adv.drivers.prediction import PredictedEgos
from sumo_adv.errors import PlannerResultError
from sumo_adv.metrics.gates import CLOCK_SLACK_S
from sumo_adv.planners.adversary_batch import AdversaryBatch
from sumo_adv.planners.answers import Answer, PlannerObservation, remembered
from sumo_adv.planners.follower import Follower
from sumo_adv.planners.trajectory import (
    Batch,
    Motion,
    PathEndpoint,
    advance,
    one_of,
    pose,
    put_back,
    release,
    steer,
    straight_on,
)
from sumo_adv.situation import Situation

Ask = Callable[[Sequence[int], Sequence[PlannerObservation]], Sequence[Answer | None]]
Touch = Callable[[Floats, Floats, Bools], Bools]
"""Takes egos and colliders (x, y, heading, speed: each ``(4, n)``) and the rows to check ``(n,)``; returns which rows
touch, ``(n,)``.
"""
Motions = tuple[Floats, Floats, Floats, Floats]
"""The x [m], y [m], heading [rad] and speed [m/s] of several vehicles, each ``(n, steps)``."""


@dataclass(frozen=True, slots=True)
class Rollouts:
    """Predicted motions. Row k is candidate k.

    Attributes:
        time: The time since the start of the attack [s], ``(steps,)``.
        ego: The egos.
        adversary: The colliders.
        disturbed: Whether the attack disturbed the ego.
        supports: The first supports of all candidates, then their second ones.
    """

    time: Floats
    ego: Motions
    adversary: Motions
    disturbed: Bools
    supports: tuple[Motions, ...] = ()


def predict(
    situations: Mapping[float, Situation], proposals: Sequence[Proposal], ask: Ask, *, limits: Limits, steps: int,
    replan: int, touch: Touch | None = None, to_the_end: bool = False,
) -> Rollouts:  # fmt: skip
    """Roll out candidates.

    All candidates have the same number of supports. The rows are those of :func:`lined_up`, so that the cost grows with
    the number of adversaries.

    The planners of a candidate are not called again once the ego and the collider have touched. The adversaries then
    follow their last plans, as in an attempt. Once all candidates have touched, the egos continue at constant speed.

    Args:
        situations: By delay [s], the situation at which a candidate's attack begins.
        proposals: The candidates.
        ask: Takes rows and observations, and returns the answers of the planners of these rows. The answer is None if a
            planner fails, and for all other rows.
        limits: The limits of all adversaries.
        steps: The number of steps.
        replan: The number of steps between two calls of the planners.
        touch: Tells which egos and colliders touch; None if contacts do not matter.
        to_the_end: Whether the egos' drivers keep driving after a contact instead of continuing at constant speed.

    Returns:
        The predicted motions.
    """
    members, n = lined_up(proposals), len(proposals)
    waits, each = np.array([p.wait for p in members]), len(members) // n
    ground = AdversaryBatch([situations[p.delay] for p in members], [p.bv for p in members], waits.tolist())
    scenes, dt = ground.scenes, ground.scenes.dt
    width = np.array([t.state.width for t in ground.targets])
    motion, egos = ground.begin(), PredictedEgos(scenes, ground.length, width, each)
    goal = straight_on(motion)
    last: list[Mapping[str, float] | None] = [None] * len(members)
    adversary, ego = np.empty((steps, 4, len(members))), np.empty((steps, 4, n))
    followers: dict[int, Follower] = {}
    over, driven, speed_before = np.zeros(n, bool), -1, egos.v
    hard = np.zeros(len(members), bool)
    for k in range(steps):
        moment = k * dt
        if k % replan == 0 and not over.all():
            waiting = moment < waits - CLOCK_SLACK_S
            if waiting.any():
                on = straight_on(motion)
                goal = PathEndpoint(*(np.where(waiting, new, old) for new, old in zip(on, goal, strict=True)))
            rows = np.flatnonzero(np.tile(~over, each) & ~waiting).tolist()
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
    """List the adversaries of candidates: all colliders, then all first supports, and so on.

    Args:
        proposals: The candidates, which all have the same number of supports.
    """
    return [p for rank in zip(*(p.members for p in proposals), strict=True) for p in rank]


def _replan(
    ground: AdversaryBatch, motion: Motion, ego: tuple[Floats, Floats, Floats, Floats], goal: PathEndpoint,
    last: list[Mapping[str, float] | None], followers: dict[int, Follower], now: float, rows: Sequence[int], ask: Ask,
) -> tuple[PathEndpoint, Motion]:  # fmt: skip
    """Call the planners of the given rows, and aim their adversaries at the answers."""
    observations = ground.observe(motion, now, ego, last, rows)
    answers = ask(rows, observations)
    for k in rows:
        answer = answers[k]
        last[k] = None if answer is None else remembered(ground.scenes.of[k], answer)
    goal = ground.aim(motion, [None if a is None else a.endpoint for a in answers], goal)
    before = motion
    motion = _steer(ground, motion, goal, [k for k in followers if answers[k] is not None])
    for k, answer in enumerate(answers):
        if answer is not None:
            followers.pop(k, None)
        if answer is not None and answer.trajectory is not None:
            try:
                followers[k] = ground.follower(k, before, answer.trajectory)
            except PlannerResultError:  # reported by the attempt; the built-in f_traj leads, here and there
                continue
            motion = put_back(motion, [k], [followers[k].begin(one_of(motion, k))])
    return goal, motion


def _steer(ground: AdversaryBatch, motion: Motion, goal: PathEndpoint, released: Sequence[int]) -> Motion:
    """Aim all adversaries at their goals; those of ``released`` were led by a trajectory until now."""
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
    """Advance one step, by the built-in f_traj or along the planner's own trajectory."""
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
