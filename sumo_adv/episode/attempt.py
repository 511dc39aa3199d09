"""One attempt: from the trigger on, a planner drives the adversary against the real ego.

Every ``replan`` steps the planner gets the ego's real state and returns an endpoint. In between f_traj leads the
adversary towards that endpoint, and its pose is injected at every step. An adversary may also follow a motion that is
given in advance. The attempt ends at the first contact of the two, when they have parted, or at the time limit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from sumo_adv.datatypes import Boxes, Limits, PrescribedMotion, Proposal, Role, Track, VehicleState
from sumo_adv.episode.drive import Drive
from sumo_adv.errors import PlannerResultError
from sumo_adv.geometry import Pose
from sumo_adv.metrics.boxes import overlaps
from sumo_adv.planners.adversary_batch import AdversaryBatch
from sumo_adv.planners.answers import Answer, AskOne, local_endpoint
from sumo_adv.planners.follower import Follower
from sumo_adv.planners.trajectory import Goal, Motion, PathRow, Scalar, advance, one_of, pose, release, steer
from sumo_adv.situation import Situation

PARTED = 90.0  # m between centres: further apart, and still parting, the two will not meet any more
CLEAR = 1e-3  # m: boxes with a larger gap along an axis need no exact test
CONTINUED = 4.0  # s beyond a contact for which the adversary's plan is continued, for the judge
LEFT_LINE = 1.0  # m: a larger distance from a planner's own trajectory is reported to the modifier


@dataclass(frozen=True, slots=True)
class Driven:
    """How an attempt went. ``message``: why the planner or SUMO failed, or how its trajectories were changed;
    ``beyond``: the adversary's planned motion after the contact."""

    ending: str  # contact | passed | time_limit | ego_left | planner_failed | crashed
    message: str
    beyond: Track | None


class AdversaryController(Protocol):
    """Drives one adversary. ``message``: why the planner failed, or how its trajectories were changed."""

    situation: Situation
    name: str

    @property
    def message(self) -> str: ...

    @property
    def acceleration(self) -> float:
        """That of the last step [m/s2]."""
        ...

    def replan(self, now: float, ego: tuple[float, float, float, float], ask: AskOne) -> str | None:
        """Plan anew for the ego's x, y, speed, acceleration, ``now`` s after the takeover. A sentence if it failed."""
        ...

    def advance(self) -> Pose:
        """The pose after one more step."""
        ...


class PrescribedAdversary:
    """An adversary on a motion given in advance. After its end it goes straight on at its last speed."""

    message = ""

    def __init__(self, situation: Situation, name: str, course: PrescribedMotion) -> None:
        self.situation, self.name, self._course = situation, name, course
        self._steps, self._speed, self.acceleration = 0, situation.targets[name].state.speed, 0.0

    def replan(self, now: float, ego: tuple[float, float, float, float], ask: AskOne) -> str | None:
        """Nothing."""
        return None

    def advance(self) -> Pose:
        """The next pose."""
        c, dt = self._course, self.situation.dt
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
    """An adversary that a planner leads along its ways, by endpoints or by its own trajectories."""

    def __init__(self, situation: Situation, name: str, limits: Limits) -> None:
        self.situation, self.name, self.limits = situation, name, limits
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

    def replan(self, now: float, ego: tuple[float, float, float, float], ask: AskOne) -> str | None:
        """Ask the planner. ``now``: s after the takeover; ``ego``: x, y, speed, acceleration. A sentence on failure."""
        s, d = self.situation.baseline.path.project(ego[0], ego[1], near=self._ego_station, reach=25.0)
        self._ego_station = s
        array = tuple(np.array([q]) for q in (s, d, ego[2], self._mean_acceleration(now, ego[2], ego[3])))
        batch = _many(self.motion)
        observation = self.ground.observe(batch, now, array, [self.last])[0]  # type: ignore[arg-type]
        answer = ask(observation)
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


def leader(situation: Situation, proposal: Proposal, limits: Limits) -> AdversaryController:
    """The controller of a proposal's adversary."""
    if proposal.course is not None:
        return PrescribedAdversary(situation, proposal.bv, proposal.course)
    return PlannedAdversary(situation, proposal.bv, limits)


def attack(drive: Drive, adversary: AdversaryController, ask: AskOne, *, steps: int, replan: int) -> Driven:
    """Drive the adversary against the ego for at most ``steps`` steps. The drive records the states."""
    assert drive.ego is not None
    ego_id, bv, dt, apart = drive.ego, adversary.name, adversary.situation.dt, math.inf
    for k in range(steps):
        if ego_id not in drive.snapshot.raw or bv not in drive.snapshot.raw:
            return Driven("ego_left" if ego_id not in drive.snapshot.raw else "passed", adversary.message, None)
        if k % replan == 0:
            ego = drive.state(ego_id)
            failure = adversary.replan(k * dt, (ego.x, ego.y, ego.speed, ego.acceleration), ask)
            if failure is not None:
                return Driven("planner_failed", failure, None)
        drive.tick({bv: adversary.advance()})
        before, apart = apart, _apart(drive, ego_id, bv)
        if apart == 0.0:
            return Driven("contact", adversary.message, _beyond(drive, adversary))
        if apart > PARTED and apart > before:
            return Driven("passed", adversary.message, None)
    return Driven("time_limit", adversary.message, None)


def _apart(drive: Drive, ego: str, bv: str) -> float:
    """Distance of the two centres [m]; exactly 0 only if the boxes overlap."""
    raw = drive.snapshot.raw
    if ego not in raw or bv not in raw:
        return math.inf
    a, b = drive.state(ego), drive.state(bv)
    apart = math.hypot(a.x - b.x, a.y - b.y)
    if apart > (math.hypot(a.length, a.width) + math.hypot(b.length, b.width)) / 2 or _surely_apart(a, b):
        return apart
    return 0.0 if bool(overlaps(_box(a), _box(b))) else max(apart, 1e-9)


def _box(v: VehicleState) -> Boxes:
    return Boxes(np.array(v.x), np.array(v.y), np.array(v.heading), np.array(v.speed), v.length, v.width)


def _surely_apart(a: VehicleState, b: VehicleState) -> bool:
    """Whether an axis of ``a`` separates the boxes by ``CLEAR``. The exact test costs six times as much."""
    dx, dy, c, s = b.x - a.x, b.y - a.y, math.cos(a.heading), math.sin(a.heading)
    turn = b.heading - a.heading
    along, across = abs(math.cos(turn)), abs(math.sin(turn))
    return (
        abs(c * dx + s * dy) > (a.length + b.length * along + b.width * across) / 2 + CLEAR
        or abs(c * dy - s * dx) > (a.width + b.length * across + b.width * along) / 2 + CLEAR
    )


def _beyond(drive: Drive, adversary: AdversaryController) -> Track:
    """The adversary's plan for the next ``CONTINUED`` seconds, outside the simulation."""
    bv, dt, start = adversary.name, adversary.situation.dt, drive.now
    rows: list[tuple[float, ...]] = []
    for k in range(round(CONTINUED / dt)):
        p = adversary.advance()
        rows.append((start + (k + 1) * dt, p.x, p.y, p.heading, p.speed, adversary.acceleration))
    time, x, y, heading, speed, acceleration = np.array(rows).T
    length, width = drive.simulation.fleet.sizes[bv]
    return Track(bv, Role.ADVERSARY, time, x, y, heading, speed, acceleration, length, width)
