"""What drives an adversary in an attempt: a planner that is asked again and again, or a motion given in advance.

Every ``replan`` steps a planner gets the ego's real state and returns an endpoint. In between f_traj leads the
adversary towards that endpoint.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from sumo_adv.datatypes import Limits, PrescribedMotion, Proposal
from sumo_adv.errors import PlannerResultError
from sumo_adv.geometry import Pose
from sumo_adv.planners.adversary_batch import AdversaryBatch
from sumo_adv.planners.answers import Answer, AskOne, local_endpoint
from sumo_adv.planners.follower import Follower
from sumo_adv.planners.trajectory import Goal, Motion, PathRow, Scalar, advance, one_of, pose, release, steer
from sumo_adv.situation import Situation

LEFT_LINE = 1.0  # m: a larger distance from a planner's own trajectory is reported to the modifier


class AdversaryController(Protocol):
    """Drives one adversary. ``message``: why the planner failed, or how its trajectories were changed."""

    @property
    def message(self) -> str: ...

    @property
    def acceleration(self) -> float:
        """That of the last step [m/s2]."""
        ...

    def replan(self, now: float, ego: tuple[float, float, float, float]) -> str | None:
        """Plan anew for the ego's x, y, speed, acceleration, ``now`` s after the takeover. A sentence if it failed."""
        ...

    def advance(self) -> Pose:
        """The pose after one more step."""
        ...


class PrescribedAdversary:
    """An adversary on a motion given in advance. After its end it goes straight on at its last speed."""

    message = ""

    def __init__(self, situation: Situation, name: str, course: PrescribedMotion) -> None:
        self._course, self._dt = course, situation.dt
        self._steps, self._speed, self.acceleration = 0, situation.targets[name].state.speed, 0.0

    def replan(self, now: float, ego: tuple[float, float, float, float]) -> str | None:
        """Nothing."""
        return None

    def advance(self) -> Pose:
        """The next pose."""
        c, dt = self._course, self._dt
        k = min(self._steps, len(c.x) - 1)
        on = (self._steps - k) * dt * float(c.speed[k])
        self._steps += 1
        before, self._speed = self._speed, float(c.speed[k])
        self.acceleration = (self._speed - before) / dt
        heading = float(c.heading[k])
        return Pose(
            float(c.x[k]) + on * math.cos(heading), float(c.y[k]) + on * math.sin(heading), heading, self._speed
        )


class PlannedAdversary:
    """An adversary that a planner leads along its ways, by endpoints or by its own trajectories.

    ``ask`` asks the planner.
    """

    def __init__(self, situation: Situation, name: str, limits: Limits, ask: AskOne) -> None:
        self.situation, self.limits = situation, limits
        self._ask = ask
        self.ground = AdversaryBatch([situation], [name])
        self.motion = one_of(self.ground.begin(), 0)
        self.goal = Goal(self.motion.s + 3 * self.motion.v, self.motion.d, self.motion.v, 3.0)
        self.last: Mapping[str, float] | None = None
        self._follower: Follower | None = None
        self._remarks: dict[str, str] = {}
        self._farthest = 0.0
        self._cap = situation.targets[name].fastest
        self._ego_station = 0.0
        self._planned: tuple[float, float] | None = None  # the last time of planning [s], and the ego's speed then

    @property
    def road(self) -> PathRow:
        """The way that the adversary is on."""
        return self.ground.road(0)

    @property
    def message(self) -> str:
        """How the planner's own trajectories were changed, the first change of each kind; empty without a change."""
        self._note_distance()
        return " ".join(self._remarks.values())

    @property
    def acceleration(self) -> float:
        """That of the last step [m/s2]."""
        return self.motion.a

    def replan(self, now: float, ego: tuple[float, float, float, float]) -> str | None:
        """Ask the planner. ``now``: s after the takeover; ``ego``: x, y, speed, acceleration. A sentence on failure."""
        s, d = self.situation.baseline.path.project(ego[0], ego[1], near=self._ego_station, reach=25.0)
        self._ego_station = s
        array = tuple(np.array([q]) for q in (s, d, ego[2], self._mean_acceleration(now, ego[2], ego[3])))
        batch = _many(self.motion)
        observation = self.ground.observe(batch, now, array, [self.last])[0]  # type: ignore[arg-type]
        answer = self._ask(observation)
        if isinstance(answer, str):
            return answer
        self.last = local_endpoint(self.situation, answer.endpoint)
        before = Goal(*(np.array([q]) for q in self.goal))
        self.goal = Goal(*(float(q[0]) for q in self.ground.aim(batch, [answer.endpoint], before)))
        self._built_in()
        self._follow(answer, batch, now)
        return None

    def _mean_acceleration(self, now: float, speed: float, acceleration: float) -> float:
        """The ego's mean since the last planning [m/s2]: some drivers brake and accelerate in turns."""
        before, self._planned = self._planned, (now, speed)
        return acceleration if before is None or now <= before[0] else (speed - before[1]) / (now - before[0])

    def _built_in(self) -> None:
        """Go towards the goal by the built-in f_traj."""
        self._note_distance()
        motion = release(self.motion) if self._follower is not None else self.motion
        self._follower = None
        self.motion = steer(Scalar, motion, self.goal, self.road.at(motion.s)[3])

    def _follow(self, answer: Answer, batch: Motion, now: float) -> None:
        """Follow the planner's own trajectory from now on, if it has a usable one."""
        remark, kind = answer.remark, "refused"
        if answer.trajectory is not None:
            try:
                self._follower = self.ground.follower(0, batch, answer.trajectory)
                self.motion = self._follower.begin(self.motion)
                kind, beyond = "limited", self._follower.line.beyond(self.limits, self._cap)
                remark = f"trajectory() was brought within the limits: it has {beyond}" if beyond else ""
            except PlannerResultError as error:
                remark = f"{error}, and the built-in one was driven"
        if remark:
            self._remarks.setdefault(kind, f"{now:.1f} s after the takeover: {remark}.")

    def _note_distance(self) -> None:
        if self._follower is not None:
            self._farthest = max(self._farthest, self._follower.farthest)
        if self._farthest > LEFT_LINE:
            self._remarks["left"] = f"It was up to {self._farthest:.1f} m from where trajectory() had it."

    def advance(self) -> Pose:
        """The pose after one more step."""
        dt = self.situation.dt
        if self._follower is not None and self._follower.over:
            self._built_in()
        if self._follower is not None:
            self.motion = self._follower.advance(self.motion, self.road, self.limits, self._cap)
        else:
            self.motion = advance(Scalar, self.motion, self.goal, self.road, self.limits, self._cap, dt)
        goal = self.goal
        self.goal = Goal(goal.s, goal.d, goal.v, goal.time - dt)
        x, y, h = pose(Scalar, self.motion, self.road)
        return Pose(x, y, h, self.motion.v)


def _many(motion: Motion) -> Motion:
    """A batch of one."""
    fields: list[Any] = [tuple(np.array([q]) for q in f) if isinstance(f, tuple) else np.array([f]) for f in motion]
    return Motion(*fields)


def controller_of(situation: Situation, proposal: Proposal, limits: Limits, ask: AskOne) -> AdversaryController:
    """The controller of a proposal's adversary; ``ask`` asks the proposal's planner."""
    if proposal.course is not None:
        return PrescribedAdversary(situation, proposal.bv, proposal.course)
    return PlannedAdversary(situation, proposal.bv, limits, ask)
