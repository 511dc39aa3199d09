"""Many attacks at once against a predicted ego: numpy rollouts on the planners' own answers.

A prediction is not an attempt: it is never counted, and only orders what is tried. The ego follows its unattacked
profile until the adversary counts as its leader and a safe speed falls below the profile; from then on its driver's
model drives (Krauss's safe speed, IDM, the careful driver's brake), never a steering.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sumo_adv.datatypes import Bools, Endpoint, Floats, Limits, Proposal
from sumo_adv.errors import PlannerResultError
from sumo_adv.planning.follow import Follower
from sumo_adv.planning.forecast import profile_at
from sumo_adv.planning.ground import Ground
from sumo_adv.planning.trajectory import Batch, Goal, Motion, advance, one_of, pose, put_back, release, steer
from sumo_adv.situation import Situation

Told = tuple[dict[str, Any], dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Answer:
    """What a planner answers, in the world: ``trajectory`` (n, 4: x, y, heading, speed, a step apart, the first a step
    from now) or None where the built-in f_traj is to be used; ``remark``: why a trajectory was refused."""

    endpoint: Endpoint
    trajectory: Floats | None = None
    remark: str = ""


Ask = Callable[[Sequence[int], Sequence[Told]], Sequence[Answer | None]]

SUBLANE = 0.8  # m, the lateral resolution that SUMO runs with (world/simulation.py)
WANDERS = 0.1  # m, by which a driver of SUMO's leaves the middle of its lane now and then
ACROSS = (0.9, 2.2)  # rad: a vehicle at such an angle is no leader
EMERGENCY = 9.0  # m/s2, SUMO's emergencyDecel of our drivers
CAREFUL_DELAY, CAREFUL_BRAKE, CAREFUL_RAMP = 1.15, 7.59, 0.6  # s, m/s2, s: UN R157
SEEN_SHIFT = 0.375  # m: UN R157, lateral movement that can be perceived


@dataclass(frozen=True, slots=True)
class Rollouts:
    """Predicted motions. ``ego`` and ``adversary``: x, y, heading, speed, each ``(n, steps)``; row k is proposal k."""

    time: Floats
    ego: tuple[Floats, Floats, Floats, Floats]
    adversary: tuple[Floats, Floats, Floats, Floats]
    disturbed: Bools


class PredictedEgos:
    """Copies of the ego along its path, one against each adversary of a length and width [m], ``(n,)``."""

    def __init__(self, situation: Situation, length: Floats, width: Floats) -> None:
        self.situation, self._length, self._width = situation, length, width
        n = len(length)
        self.model: Mapping[str, Any] = situation.ego_model
        self.s = np.full(n, situation.profile_s[0])
        self.v = np.full(n, situation.profile_v[0])
        self.a = np.full(n, situation.profile_a[0])
        self.disturbed = np.zeros(n, bool)
        self._was_inside = np.zeros(n, bool)
        self._edges = seen_edges(situation.lane_width, situation.ego.width)
        self._furthest = np.zeros(n)
        self._seen_at = np.full(n, np.inf)

    def step(self, now: float, adversary: tuple[Floats, Floats, Floats], speed: Floats) -> None:
        """One step against adversaries at station, offset, heading (ego path's frame, box centres)."""
        sit, dt = self.situation, self.situation.dt
        next_s, next_v = (float(q[0]) for q in profile_at(sit, np.array([now + dt])))
        if self.model["kind"] == "replay":
            self.s, self.a, self.v = self.s * 0 + next_s, self.s * 0 + (next_v - self.v) / dt, self.s * 0 + next_v
            return
        (s, d, h), length = adversary, self._length
        front_s, front_d = s + length / 2 * np.cos(h), d + length / 2 * np.sin(h)
        across = (np.abs(h) > ACROSS[0]) & (np.abs(h) < ACROSS[1])
        leads = self._in_lane(front_d) & (front_s > self.s + sit.ego.length / 2) & ~across
        gap = s - self.s - (length + sit.ego.length) / 2
        pace = np.maximum(np.interp(self.s, sit.profile_s, sit.profile_v), next_v)
        free = np.where(self.disturbed, np.minimum(self.v + self.model["acceleration"] * dt, pace), next_v)
        bound = np.where(leads, self._following(gap, speed), np.inf)
        bound = np.minimum(bound, self._careful(now, d, speed, s))
        self.disturbed |= bound < next_v - 0.05
        v = np.where(self.disturbed, np.maximum(np.minimum(free, bound), self.v - EMERGENCY * dt), next_v)
        v = np.maximum(v, 0.0)
        self.a = (v - self.v) / dt
        self.s = np.where(self.disturbed, self.s + v * dt, next_s)
        self.v = v

    def _in_lane(self, front_d: Floats) -> Bools:
        """Whether SUMO's driver has the adversary in its lane: its front's centre is within the lane's lines; or, once
        it has been there (SUMO then keeps it in both lanes), its side is within the strips that the ego takes up."""
        inside = np.abs(front_d) < self.situation.lane_width / 2
        (left, right), half = self._edges, self._width / 2
        partly = (front_d - half < left) & (front_d + half > -right)
        self._was_inside |= inside
        return inside | (self._was_inside & partly)

    def _following(self, gap: Floats, leader: Floats) -> Floats:
        """The speed [m/s] the driver wants behind a leader at a bumper gap [m]."""
        m, dt = self.model, self.situation.dt
        b, tau = m["deceleration"], m["tau"]
        if m["kind"] == "krauss":
            room = np.maximum(gap - m["min_gap"], 0.0)
            return -b * tau + np.sqrt(b * b * tau * tau + leader * leader + 2 * b * room)
        a, v = m["acceleration"], self.v
        wish = m["min_gap"] + np.maximum(0.0, v * tau + v * (v - leader) / (2 * np.sqrt(a * b)))
        acceleration = a * (1 - (v / max(m["speed"], 1.0)) ** 4 - (wish / np.maximum(gap, 0.1)) ** 2)
        return np.maximum(v + acceleration * dt, 0.0)

    def _careful(self, now: float, d: Floats, speed: Floats, s: Floats) -> Floats:
        """The careful driver's bound: brakes 1.15 s after the adversary has come 0.375 m closer."""
        if self.model["kind"] != "careful":
            return np.full(len(d), np.inf)
        self._furthest = np.maximum(self._furthest, np.abs(d))
        near = np.abs(s - self.s) < np.maximum(3.0 * np.abs(self.v - speed * 0.5), 30.0)
        seen = (np.abs(d) < self._furthest - SEEN_SHIFT) & near
        self._seen_at = np.minimum(self._seen_at, np.where(seen, now, np.inf))
        since = now - self._seen_at - CAREFUL_DELAY
        brake = CAREFUL_BRAKE * np.clip(since / CAREFUL_RAMP, 0.0, 1.0)
        return np.where(since > 0, np.maximum(self.v - brake * self.situation.dt, 0.0), np.inf)


def seen_edges(lane: float, width: float) -> tuple[float, float]:
    """How far to the left and to the right [m] of the middle of its lane a driver of this width looks for leaders:
    SUMO's strips of ``SUBLANE``, counted from the lane's right edge, that the ego is in as it wanders a little."""
    wide = width + 2 * WANDERS
    right = max(0, math.floor((lane - wide) / 2 / SUBLANE)) * SUBLANE
    left = min(lane, (math.floor((lane + wide) / 2 / SUBLANE) + 1) * SUBLANE)
    return left - lane / 2, lane / 2 - right


def predict(
    situation: Situation, proposals: Sequence[Proposal], ask: Ask, *, limits: Limits, steps: int, replan: int
) -> Rollouts:
    """Roll all proposals out for ``steps`` steps, asking the planners every ``replan`` steps.

    ``ask(rows, told)`` answers for the proposals ``rows``, None where a planner fails.
    """
    n, dt = len(proposals), situation.dt
    ground = Ground(situation, [p.bv for p in proposals])
    width = np.array([situation.targets[p.bv].state.width for p in proposals])
    motion, egos = ground.begin(), PredictedEgos(situation, ground.length, width)
    goal = Goal(motion.s + motion.v * 3.0, motion.d, motion.v, motion.v * 0 + 3.0)
    last: list[Mapping[str, float] | None] = [None] * n
    adversary, ego = np.empty((4, n, steps)), np.empty((4, n, steps))
    followers: dict[int, Follower] = {}
    for k in range(steps):
        now = k * dt
        if k % replan == 0:
            goal, motion = _replan(ground, motion, egos, goal, last, followers, now, ask)
        adversary[:, :, k] = (*pose(Batch, motion, ground.rows), motion.v)
        ego[:, :, k] = (*situation.ego_path.at(egos.s), egos.v)
        egos.step(now, ground.relative(motion), motion.v)
        motion = _advance(ground, motion, goal, followers, limits)
        goal = goal._replace(time=goal.time - dt)
    x, y, h, v = ego
    return Rollouts(np.arange(steps) * dt, (x, y, h, v), tuple(adversary), egos.disturbed)  # type: ignore[arg-type]


def _replan(
    ground: Ground, motion: Motion, egos: PredictedEgos, goal: Goal, last: list[Mapping[str, float] | None],
    followers: dict[int, Follower], now: float, ask: Ask,
) -> tuple[Goal, Motion]:  # fmt: skip
    told = ground.tell(motion, now, (egos.s, egos.s * 0.0, egos.v, egos.a), last)
    answers = ask(range(len(told)), told)
    for k, answer in enumerate(answers):
        last[k] = None if answer is None else local_endpoint(ground.situation, answer.endpoint)
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


def _steer(ground: Ground, motion: Motion, goal: Goal, released: Sequence[int]) -> Motion:
    """Aim all at their goals; those of ``released`` were led by a trajectory until now."""
    if released:
        motion = put_back(motion, released, [release(one_of(motion, k)) for k in released])
    return steer(Batch, motion, goal, ground.rows.at(motion.s)[3])


def _advance(ground: Ground, motion: Motion, goal: Goal, followers: dict[int, Follower], limits: Limits) -> Motion:
    """One step on, by the built-in f_traj or after the planner's own trajectory."""
    over = [k for k, f in followers.items() if f.over]
    if over:
        motion = _steer(ground, motion, goal, over)
        for k in over:
            del followers[k]
    moved = advance(Batch, motion, goal, ground.rows, limits, ground.cap, ground.situation.dt)
    if not followers:
        return moved
    ones = [f.advance(one_of(motion, k), ground.road(k), limits, float(ground.cap[k])) for k, f in followers.items()]
    return put_back(moved, list(followers), ones)


def local_endpoint(situation: Situation, end: Endpoint) -> dict[str, float]:
    """An endpoint as the planner gave it, in the frame of the ego at the trigger."""
    x, y, h = situation.frame.to_local(end.x, end.y, end.heading)
    return {"x": x, "y": y, "heading": h, "speed": end.speed, "time": end.time}


def world_endpoint(situation: Situation, end: Mapping[str, float]) -> Endpoint:
    """A planner's answer in the world."""
    x, y, h = situation.frame.to_world(end["x"], end["y"], end["heading"])
    return Endpoint(x, y, h, end["speed"], end["time"])
