"""One attempt: from the trigger on, the adversary is driven by a planner against the real ego.

Every ``replan`` steps the planner is asked with what the ego really does; between, f_traj leads the adversary towards
the endpoint and its pose is injected step by step.  Or a motion given in advance is driven as it stands.  The attempt
ends at the first contact of the two, when they have parted, or at the time limit.
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
from sumo_adv.metrics.boxes import overlaps
from sumo_adv.planners.adversary_batch import AdversaryBatch
from sumo_adv.planners.answers import Answer, AskOne, local_endpoint
from sumo_adv.planners.follower import Follower
from sumo_adv.planners.trajectory import Goal, Motion, PathRow, Scalar, advance, one_of, pose, release, steer
from sumo_adv.simulation.simulation import Pose
from sumo_adv.situation import Situation

PARTED = 90.0  # m between bumpers: nothing will come of it any more
CLEAR = 1e-3  # m: further apart along an axis, boxes need no exact test
CONTINUED = 4.0  # s the adversary's plan is followed beyond a contact, for the judge

LEFT_LINE = 1.0  # m: further off a planner's trajectory is worth a word to the modifier


@dataclass(frozen=True, slots=True)
class Driven:
    """How an attempt went. ``message``: why the planner failed, or what was done to its trajectories; ``beyond``: the
    adversary's planned motion after the contact."""

    ending: str  # contact | passed | time_limit | ego_left | planner_failed
    message: str
    beyond: Track | None


class AdversaryController(Protocol):
    """A BV that somebody leads. ``message``: what was done to what its planner wanted."""

    situation: Situation
    name: str

    @property
    def message(self) -> str: ...

    @property
    def acceleration(self) -> float:
        """Of the step that was advanced last [m/s2]."""
        ...

    def replan(self, now: float, ego: tuple[float, float, float, float], ask: AskOne) -> str | None:
        """Look at the ego: x, y, speed, acceleration; ``now`` s since the takeover. A sentence if that failed."""
        ...

    def advance(self) -> Pose:
        """One step on; where it is then."""
        ...


class PrescribedAdversary:
    """A BV on a motion given in advance, and straight on at its last speed beyond its end; it asks nobody."""

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
    """One BV that is led along its ways by a planner's endpoints, or by its own trajectories to them."""

    def __init__(self, situation: Situation, name: str, limits: Limits) -> None:
        self.situation, self.name, self.limits = situation, name, limits
        self.ground = AdversaryBatch([situation], [name])
        many = self.ground.begin()
        self.motion = one_of(many, 0)
        self.goal = Goal(self.motion.s + 3 * self.motion.v, self.motion.d, self.motion.v, 3.0)
        self.last: Mapping[str, float] | None = None
        self._follower: Follower | None = None
        self._remarks: dict[str, str] = {}
        self._farthest = 0.0
        self._cap = situation.targets[name].fastest
        self._ego_station = 0.0
        self._asked: tuple[float, float] | None = None  # when the planner was asked last [s], and the ego's speed then

    @property
    def road(self) -> PathRow:
        """The way it is on."""
        return self.ground.road(0)

    @property
    def message(self) -> str:
        """What was done to the planner's own trajectories, the first time of each kind; empty if nothing was."""
        self._note_distance()
        return " ".join(self._remarks.values())

    @property
    def acceleration(self) -> float:
        """Of the step that was advanced last [m/s2]."""
        return self.motion.a

    def replan(self, now: float, ego: tuple[float, float, float, float], ask: AskOne) -> str | None:
        """Ask the planner; ``now`` s since the trigger, ``ego``: x, y, speed, acceleration. A sentence if it failed."""
        s, d = self.situation.ego_path.project(ego[0], ego[1], near=self._ego_station, reach=25.0)
        self._ego_station = s
        array = tuple(np.array([q]) for q in (s, d, ego[2], self._mean_acceleration(now, ego[2], ego[3])))
        many = _many(self.motion)
        observation = self.ground.observe(many, now, array, [self.last])[0]  # type: ignore[arg-type]
        answer = ask(observation)
        if isinstance(answer, str):
            return answer
        self.last = local_endpoint(self.situation, answer.endpoint)
        before = Goal(*(np.array([q]) for q in self.goal))
        self.goal = Goal(*(float(q[0]) for q in self.ground.aim(many, [answer.endpoint], before)))
        self._built_in()
        self._own(answer, many, now)
        return None

    def _mean_acceleration(self, now: float, speed: float, acceleration: float) -> float:
        """The ego's [m/s2] since it was last asked: drivers between two minds brake and speed up in turns."""
        asked, self._asked = self._asked, (now, speed)
        return acceleration if asked is None or now <= asked[0] else (speed - asked[1]) / (now - asked[0])

    def _built_in(self) -> None:
        """Towards the goal by the built-in f_traj."""
        self._note_distance()
        motion = release(self.motion) if self._follower is not None else self.motion
        self._follower = None
        self.motion = steer(Scalar, motion, self.goal, self.road.at(motion.s)[3])

    def _own(self, answer: Answer, many: Motion, now: float) -> None:
        """AdversaryController by the planner's own trajectory from now on, where there is a usable one."""
        remark, kind = answer.remark, "refused"
        if answer.trajectory is not None:
            try:
                self._follower = self.ground.follower(0, many, answer.trajectory)
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
        """One step on; where it is then."""
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
    fields: list[Any] = [tuple(np.array([q]) for q in f) if isinstance(f, tuple) else np.array([f]) for f in motion]
    return Motion(*fields)


def leader(situation: Situation, proposal: Proposal, limits: Limits) -> AdversaryController:
    """Who leads the BV of a proposal."""
    if proposal.course is not None:
        return PrescribedAdversary(situation, proposal.bv, proposal.course)
    return PlannedAdversary(situation, proposal.bv, limits)


def attack(drive: Drive, adversary: AdversaryController, ask: AskOne, *, steps: int, replan: int) -> Driven:
    """Drive the adversary against the ego for at most ``steps`` steps; the drive records everything."""
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
    """Distance of the two bumpers [m]; exactly 0 only where the boxes overlap."""
    raw = drive.snapshot.raw
    if ego not in raw or bv not in raw:
        return math.inf
    apart = math.hypot(raw[ego][0] - raw[bv][0], raw[ego][1] - raw[bv][1])
    if apart > sum(math.hypot(*drive.simulation.fleet.sizes[name]) for name in (ego, bv)):
        return apart  # no point of a box is further from its front bumper than its diagonal
    a, b = drive.state(ego), drive.state(bv)
    if _surely_apart(a, b):
        return apart
    return 0.0 if bool(overlaps(_box(a), _box(b))) else max(apart, 1e-9)


def _box(v: VehicleState) -> Boxes:
    return Boxes(np.array(v.x), np.array(v.y), np.array(v.heading), np.array(v.speed), v.length, v.width)


def _surely_apart(a: VehicleState, b: VehicleState) -> bool:
    """Whether one of a's own axes parts the boxes by ``CLEAR``; the exact test costs six times as much."""
    dx, dy, c, s = b.x - a.x, b.y - a.y, math.cos(a.heading), math.sin(a.heading)
    turn = b.heading - a.heading
    along, across = abs(math.cos(turn)), abs(math.sin(turn))
    return (
        abs(c * dx + s * dy) > (a.length + b.length * along + b.width * across) / 2 + CLEAR
        or abs(c * dy - s * dx) > (a.width + b.length * across + b.width * along) / 2 + CLEAR
    )


def _beyond(drive: Drive, adversary: AdversaryController) -> Track:
    """The plan followed on for ``CONTINUED`` seconds, without the simulation."""
    bv, dt, now = adversary.name, adversary.situation.dt, drive.now
    rows: list[tuple[float, ...]] = []
    for k in range(round(CONTINUED / dt)):
        p = adversary.advance()
        rows.append((now + (k + 1) * dt, p.x, p.y, p.heading, p.speed, adversary.acceleration))
    time, x, y, heading, speed, acceleration = np.array(rows).T
    length, width = drive.simulation.fleet.sizes[bv]
    return Track(bv, Role.ADVERSARY, time, x, y, heading, speed, acceleration, length, width)
