"""One attempt: from the trigger on, adversaries are driven against the real ego, step by step.

In each step, an adversary goes where its controller leads it, or where the caller places it. All poses are injected at
once. A controller follows a motion given in advance, or a planner. Every ``replan`` steps, the planner gets the ego's
real state and returns an endpoint. In between, f_traj leads the adversary towards it. The attempt ends at the first
contact of the ego with an adversary, when all adversaries have parted from the ego or left, when the ego has left, at
the time limit, or if a planner fails. ``attack`` runs a whole attempt; an environment makes its steps one by one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sumo_adv.datatypes import Boxes, Limits, PrescribedMotion, Proposal, Role, Track, VehicleState
from sumo_adv.drivers import Action
from sumo_adv.episode.drive import Drive
from sumo_adv.errors import PlannerResultError
from sumo_adv.geometry import Pose
from sumo_adv.metrics.boxes import overlaps
from sumo_adv.metrics.gates import CLOCK_SLACK_S
from sumo_adv.planners.adversary_batch import AdversaryBatch
from sumo_adv.planners.answers import Answer, AskOne, remembered
from sumo_adv.planners.follower import Follower
from sumo_adv.planners.trajectory import (
    Motion,
    PathEndpoint,
    PathRow,
    Scalar,
    advance,
    one_of,
    pose,
    release,
    steer,
    straight_on,
)
from sumo_adv.situation import Situation

# -- controllers ----------------------------------------------------------------------------------------------------

TRAJECTORY_DEVIATION_M = 1.0  # m; a larger distance from a planner's own trajectory is reported to the modifier


class PrescribedAdversary:
    """An adversary on a motion given in advance. After the end of the motion, it goes straight on at its last speed."""

    message = ""

    def __init__(self, situation: Situation, name: str, course: PrescribedMotion) -> None:
        """Start at the beginning of the motion.

        Args:
            situation: The situation at the takeover.
            name: The adversary's id.
            course: The motion.
        """
        self._course, self._dt = course, situation.dt
        self._steps, self._speed, self.acceleration = 0, situation.targets[name].state.speed, 0.0

    def replan(self, now: float, ego: tuple[float, float, float, float]) -> str | None:
        """Do nothing, and never fail."""
        return None

    def advance(self) -> Pose:
        """Return the pose after one more step."""
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

    While it waits for its start, it goes straight on.

    Attributes:
        situation: The situation at the takeover.
        limits: The limits of the adversary's motion.
        ground: The adversary on its ways, as a batch of one.
        motion: The present motion along the way.
        goal: The endpoint that f_traj drives towards, on the way.
        last: The planner's last endpoint in the local frame; None before the first.
    """

    def __init__(self, situation: Situation, name: str, limits: Limits, ask: AskOne, wait: float = 0.0) -> None:
        """Start from the motion at the takeover.

        Args:
            situation: The situation at the takeover.
            name: The adversary's id.
            limits: The limits of the adversary's motion.
            ask: Asks the planner.
            wait: How long after the takeover the planner is asked for the first time [s].
        """
        self.situation, self.limits = situation, limits
        self._ask, self._wait = ask, wait
        self.ground = AdversaryBatch([situation], [name], [wait])
        self.motion = one_of(self.ground.begin(), 0)
        self.goal = straight_on(self.motion)
        self.last: Mapping[str, float] | None = None
        self._follower: Follower | None = None
        self._remarks: dict[str, str] = {}
        self._farthest = 0.0
        self._cap = situation.targets[name].fastest
        self._ego_station = 0.0
        self._hard = True  # whether the adversary may brake harder than people usually do
        self._planned: tuple[float, float] | None = None  # last planning [s], and the ego's speed then [m/s]

    @property
    def road(self) -> PathRow:
        """The way that the adversary is on."""
        return self.ground.road(0)

    @property
    def message(self) -> str:
        """How the planner's own trajectories were changed or refused, the first of each kind; empty if none was."""
        self._note_distance()
        return " ".join(self._remarks.values())

    @property
    def acceleration(self) -> float:
        """The acceleration of the last step [m/s2]."""
        return self.motion.a

    def replan(self, now: float, ego: tuple[float, float, float, float]) -> str | None:
        """Ask the planner for the next endpoint or trajectory.

        Args:
            now: The time since the takeover [s].
            ego: The ego's x [m], y [m], speed [m/s] and acceleration [m/s2].

        Returns:
            None, or why the planner failed, as a sentence.
        """
        if now < self._wait - CLOCK_SLACK_S:
            self.goal = straight_on(self.motion)
            return None
        s, d = self.situation.baseline.path.project(ego[0], ego[1], near=self._ego_station, reach=25.0)
        self._ego_station = s
        array = tuple(np.array([q]) for q in (s, d, ego[2], self._mean_acceleration(now, ego[2], ego[3])))
        batch = _many(self.motion)
        self._hard = bool(self.ground.may_brake_hard(batch)[0])
        observation = self.ground.observe(batch, now, array, [self.last])[0]  # type: ignore[arg-type]
        answer = self._ask(observation)
        if isinstance(answer, str):
            return answer
        self.last = remembered(self.situation, answer)
        before = PathEndpoint(*(np.array([q]) for q in self.goal))
        self.goal = PathEndpoint(*(float(q[0]) for q in self.ground.aim(batch, [answer.endpoint], before)))
        self._built_in()
        self._follow(answer, batch, now)
        return None

    def _mean_acceleration(self, now: float, speed: float, acceleration: float) -> float:
        """Return the ego's mean acceleration since the last planning [m/s2]; some drivers alternate between pedals."""
        before, self._planned = self._planned, (now, speed)
        return acceleration if before is None or now <= before[0] else (speed - before[1]) / (now - before[0])

    def _built_in(self) -> None:
        """Steer towards the goal with the built-in f_traj."""
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
        """Note how far the adversary was from the planner's own trajectory."""
        if self._follower is not None:
            self._farthest = max(self._farthest, self._follower.farthest)
        if self._farthest > TRAJECTORY_DEVIATION_M:
            self._remarks["left"] = f"It was up to {self._farthest:.1f} m from where trajectory() had it."

    def advance(self) -> Pose:
        """Return the pose after one more step."""
        dt = self.situation.dt
        if self._follower is not None and self._follower.over:
            self._built_in()
        if self._follower is not None:
            self.motion = self._follower.advance(self.motion, self.road, self.limits, self._cap, self._hard)
        else:
            self.motion = advance(Scalar, self.motion, self.goal, self.road, self.limits, self._cap, dt, self._hard)
        goal = self.goal
        self.goal = PathEndpoint(goal.s, goal.d, goal.v, goal.time - dt)
        x, y, h = pose(Scalar, self.motion, self.road)
        return Pose(x, y, h, self.motion.v)


def _many(motion: Motion) -> Motion:
    """Turn the motion of one vehicle into a batch of one."""
    fields: list[Any] = [tuple(np.array([q]) for q in f) if isinstance(f, tuple) else np.array([f]) for f in motion]
    return Motion(*fields)


AdversaryController = PlannedAdversary | PrescribedAdversary
"""A controller drives one adversary. ``message`` says how the planner's trajectories were changed. ``acceleration`` is
that of the last step [m/s2]. ``replan`` plans again for the ego's x, y, speed and acceleration at ``now`` [s] after the
takeover, and returns a sentence if the planner failed. ``advance`` returns the pose after one more step."""


def controller_of(situation: Situation, proposal: Proposal, limits: Limits, ask: AskOne) -> AdversaryController:
    """Return the controller of a proposal's adversary.

    Args:
        situation: The situation at the takeover.
        proposal: The proposal of this adversary.
        limits: The limits of its motion.
        ask: Asks the proposal's planner.
    """
    if proposal.course is not None:
        return PrescribedAdversary(situation, proposal.bv, proposal.course)
    return PlannedAdversary(situation, proposal.bv, limits, ask, proposal.wait)


# -- the attempt ----------------------------------------------------------------------------------------------------

PARTED_DISTANCE_M = 90.0  # m between centres; vehicles that are farther apart and still parting will not meet
PLAN_AFTER_CONTACT_S = 4.0  # s after a contact over which the adversary's plan is continued for the verdict


@dataclass(frozen=True, slots=True)
class Driven:
    """How an attempt went.

    Attributes:
        ending: How it ended.
        message: Why the planner or SUMO failed, or how the planner's trajectories were changed.
        beyond: By adversary, its planned motion after the contact; empty without a contact.
    """

    ending: str  # contact | passed | time_limit | ego_left | planner_failed | crashed
    message: str = ""
    beyond: Mapping[str, Track] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Command:
    """What happens in one step of an attempt.

    Attributes:
        poses: The pose after the step, by adversary. The controllers of the other adversaries decide.
        ego: What the ego does; None lets its driver decide.
    """

    poses: Mapping[str, Pose] = field(default_factory=dict)
    ego: Action = None


@dataclass(frozen=True, slots=True)
class AttemptState:
    """The state of an attempt after a step.

    Attributes:
        steps: The number of steps so far.
        apart: By adversary, the distance of its centre from the ego's [m]. It is 0 only if their boxes overlap, and inf
            if one of the two is gone.
        driven: How the attempt went; None before its end.
    """

    steps: int
    apart: Mapping[str, float]
    driven: Driven | None = None


class OngoingAttempt:
    """Drives adversaries against the ego. The drive records the states.

    Attributes:
        state: The state after the last step.
    """

    def __init__(
        self, drive: Drive, adversaries: Mapping[str, AdversaryController | None], *, steps: int, replan: int
    ) -> None:
        """Begin an attempt at the present state of the drive.

        Args:
            drive: The simulation with the ego.
            adversaries: The controller of each adversary by id. An adversary with None goes straight on unless a
                command places it.
            steps: The maximum number of steps.
            replan: The number of steps from one planning to the next.
        """
        assert drive.ego is not None
        self._drive, self._ego, self._adversaries = drive, drive.ego, dict(adversaries)
        self._steps, self._replan, self._dt = steps, replan, drive.recording.step_length
        ended = self._ended("time_limit") if steps <= 0 else None
        self.state = AttemptState(0, dict.fromkeys(self._adversaries, math.inf), ended)

    def step(self, command: Command | None = None) -> AttemptState:
        """Make one step.

        Args:
            command: What happens in the step; None lets all controllers decide.

        Returns:
            The state after the step.
        """
        assert self.state.driven is None, "the attempt has ended"
        self.state = self._stepped(command or Command())
        return self.state

    def _stepped(self, command: Command) -> AttemptState:
        drive, before = self._drive, self.state
        there = [name for name in self._adversaries if name in drive.snapshot.raw]
        if self._ego not in drive.snapshot.raw or not there:
            gone = "passed" if self._ego in drive.snapshot.raw else "ego_left"
            return AttemptState(before.steps, before.apart, self._ended(gone))
        led = [name for name in there if name not in command.poses]
        if before.steps % self._replan == 0:
            failure = self._plan(led, before.steps * self._dt)
            if failure is not None:
                return AttemptState(before.steps, before.apart, Driven("planner_failed", failure))
        poses = {name: command.poses[name] if name in command.poses else self._led(name) for name in there}
        drive.tick(poses, command.ego)
        apart = {name: apart_of(drive, self._ego, name) for name in self._adversaries}
        steps = before.steps + 1
        return AttemptState(steps, apart, self._outcome(steps, before.apart, apart))

    def _plan(self, names: list[str], now: float) -> str | None:
        """Have controllers plan again, ``now`` [s] after the takeover; return a sentence if one failed."""
        ego = self._drive.state(self._ego)
        for name in names:
            controller = self._adversaries[name]
            if controller is None:
                continue
            failure = controller.replan(now, (ego.x, ego.y, ego.speed, ego.acceleration))
            if failure is not None:
                return failure
        return None

    def _led(self, name: str) -> Pose:
        """Return the pose to which an adversary's controller leads it; without a controller, go straight on."""
        controller = self._adversaries[name]
        return _straight_on(self._drive.state(name), self._dt) if controller is None else controller.advance()

    def _outcome(self, steps: int, before: Mapping[str, float], apart: Mapping[str, float]) -> Driven | None:
        """Return how the attempt went if it has ended: by contact, parting, an ego that left, or the time limit."""
        if 0.0 in apart.values():
            return self._ended("contact")
        if self._ego not in self._drive.snapshot.raw:
            return self._ended("ego_left")
        if all(far > PARTED_DISTANCE_M and far > before[name] for name, far in apart.items()):
            return self._ended("passed")
        return self._ended("time_limit") if steps >= self._steps else None

    def _ended(self, ending: str) -> Driven:
        messages = [c.message for c in self._adversaries.values() if c is not None]
        message = " ".join(words for words in messages if words)
        there = [name for name in self._adversaries if name in self._drive.snapshot.raw] if ending == "contact" else []
        return Driven(ending, message, {name: self._beyond(name) for name in there})

    def _beyond(self, name: str) -> Track:
        """Return the adversary's plan for the next ``PLAN_AFTER_CONTACT_S`` seconds, outside the simulation."""
        controller, dt, start = self._adversaries[name], self._dt, self._drive.now
        state = self._drive.state(name)
        rows: list[tuple[float, ...]] = []
        for k in range(round(PLAN_AFTER_CONTACT_S / dt)):
            p = _straight_on(state, (k + 1) * dt) if controller is None else controller.advance()
            acceleration = 0.0 if controller is None else controller.acceleration
            rows.append((start + (k + 1) * dt, p.x, p.y, p.heading, p.speed, acceleration))
        time, x, y, heading, speed, accelerations = np.array(rows).T
        size = state.length, state.width
        return Track(name, Role.ADVERSARY, time, x, y, heading, speed, accelerations, *size, z=state.z)


def attack(
    drive: Drive, adversaries: Mapping[str, AdversaryController], *, steps: int, replan: int, ego: Pose | None = None
) -> Driven:  # fmt: skip
    """Run a whole attempt, in which controllers lead the adversaries and the ego's driver drives the ego.

    Args:
        drive: The simulation with the ego, at the start of the attack.
        adversaries: The controller of each adversary by id.
        steps: The maximum number of steps.
        replan: The number of steps from one planning to the next.
        ego: The pose at which the ego is placed in the first step; None lets its driver act.

    Returns:
        How the attempt went.
    """
    attempt = OngoingAttempt(drive, adversaries, steps=steps, replan=replan)
    if ego is not None and attempt.state.driven is None:
        attempt.step(Command(ego=ego))
        drive.give_back()
    while (driven := attempt.state.driven) is None:
        attempt.step()
    return driven


def _straight_on(v: VehicleState, seconds: float) -> Pose:
    """Return the pose of a vehicle after some seconds at constant speed and heading."""
    far = v.speed * seconds
    return Pose(v.x + far * math.cos(v.heading), v.y + far * math.sin(v.heading), v.heading, v.speed)


def apart_of(drive: Drive, one: str, other: str) -> float:
    """Return the distance of the centres of two vehicles [m].

    It is exactly 0 only if the boxes overlap, and inf if one of the vehicles is gone.

    Args:
        drive: The simulation.
        one: The id of one vehicle.
        other: The id of the other vehicle.
    """
    raw = drive.snapshot.raw
    if one not in raw or other not in raw:
        return math.inf
    a, b = drive.state(one), drive.state(other)
    apart = math.hypot(a.x - b.x, a.y - b.y)
    if apart > (math.hypot(a.length, a.width) + math.hypot(b.length, b.width)) / 2:
        return apart
    return 0.0 if bool(overlaps(box_of(a), box_of(b))) else max(apart, 1e-9)


def box_of(v: VehicleState) -> Boxes:
    """Return the box of a vehicle as 0-d arrays."""
    return Boxes(np.array(v.x), np.array(v.y), np.array(v.heading), np.array(v.speed), v.length, v.width, v.z)
