"""One attempt: from the trigger on, adversaries are driven against the real ego, step by step.

In each step an adversary goes where its controller leads it, or where the caller puts it; all poses are injected at
once. The attempt ends at the first contact of the ego with an adversary, when they have all parted, or at the time
limit. ``attack`` runs a whole attempt; an environment makes its steps one by one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from sumo_adv.datatypes import Boxes, Role, Track, VehicleState
from sumo_adv.drivers import Action
from sumo_adv.episode.controllers import AdversaryController
from sumo_adv.episode.drive import Drive
from sumo_adv.geometry import Pose
from sumo_adv.metrics.boxes import overlaps

PARTED = 90.0  # m between centres: further apart, and still parting, the two will not meet any more
CLEAR = 1e-3  # m: boxes with a larger gap along an axis need no exact test
CONTINUED = 4.0  # s beyond a contact for which the adversary's plan is continued, for the judge


@dataclass(frozen=True, slots=True)
class Driven:
    """How an attempt went. ``message``: why the planner or SUMO failed, or how its trajectories were changed;
    ``beyond``: by adversary its planned motion after the contact, empty without a contact."""

    ending: str  # contact | passed | time_limit | ego_left | planner_failed | crashed
    message: str = ""
    beyond: Mapping[str, Track] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Command:
    """What is to happen in one step.

    poses: by adversary, where it is after the step; the controllers of the others decide. ego: what the ego does; None:
    its driver decides.
    """

    poses: Mapping[str, Pose] = field(default_factory=dict)
    ego: Action = None


@dataclass(frozen=True, slots=True)
class AttemptState:
    """Where an attempt stands after a step.

    steps: made so far. apart: by adversary the distance [m] of its centre from the ego's; 0 only if their boxes
    overlap, inf where one of the two is gone. touching: pairs of ids, of the ego and adversaries, with overlapping
    boxes. driven: how the attempt went; None while it goes on.
    """

    steps: int
    apart: Mapping[str, float]
    touching: tuple[tuple[str, str], ...] = ()
    driven: Driven | None = None


class OngoingAttempt:
    """Drives ``adversaries`` against the ego for at most ``steps`` steps. The drive records the states.

    adversaries: by id what drives each; one with None goes straight on unless a command says otherwise. replan: steps
    from one planning to the next.
    """

    def __init__(
        self, drive: Drive, adversaries: Mapping[str, AdversaryController | None], *, steps: int, replan: int
    ) -> None:
        assert drive.ego is not None
        self._drive, self._ego, self._adversaries = drive, drive.ego, dict(adversaries)
        self._steps, self._replan, self._dt = steps, replan, drive.recording.step_length
        ended = self._ended("time_limit") if steps <= 0 else None
        self.state = AttemptState(0, dict.fromkeys(self._adversaries, math.inf), driven=ended)

    def step(self, command: Command | None = None) -> AttemptState:
        """Make one step and return where the attempt stands. Without a command all controllers decide."""
        assert self.state.driven is None, "the attempt has ended"
        self.state = self._stepped(command or Command())
        return self.state

    def _stepped(self, command: Command) -> AttemptState:
        drive, before = self._drive, self.state
        there = [name for name in self._adversaries if name in drive.snapshot.raw]
        if self._ego not in drive.snapshot.raw or not there:
            gone = "passed" if self._ego in drive.snapshot.raw else "ego_left"
            return AttemptState(before.steps, before.apart, driven=self._ended(gone))
        led = [name for name in there if name not in command.poses]
        if before.steps % self._replan == 0:
            failure = self._plan(led, before.steps * self._dt)
            if failure is not None:
                return AttemptState(before.steps, before.apart, driven=Driven("planner_failed", failure))
        poses = {name: command.poses[name] if name in command.poses else self._led(name) for name in there}
        drive.tick(poses, command.ego)
        apart = {name: apart_of(drive, self._ego, name) for name in self._adversaries}
        steps, touching = before.steps + 1, self._touching(apart)
        return AttemptState(steps, apart, touching, self._outcome(steps, before.apart, apart))

    def _plan(self, names: list[str], now: float) -> str | None:
        """Have controllers plan anew, ``now`` s after the takeover. A sentence if one failed."""
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
        """Where an adversary's controller leads it; straight on without one."""
        controller = self._adversaries[name]
        return _straight_on(self._drive.state(name), self._dt) if controller is None else controller.advance()

    def _touching(self, apart: Mapping[str, float]) -> tuple[tuple[str, str], ...]:
        hit = [(self._ego, name) for name in apart if apart[name] == 0.0]
        return (*hit, *((a, b) for a, b in combinations(apart, 2) if apart_of(self._drive, a, b) == 0.0))

    def _outcome(self, steps: int, before: Mapping[str, float], apart: Mapping[str, float]) -> Driven | None:
        if 0.0 in apart.values():
            return self._ended("contact")
        if all(far > PARTED and far > before[name] for name, far in apart.items()):
            return self._ended("passed")
        return self._ended("time_limit") if steps >= self._steps else None

    def _ended(self, ending: str) -> Driven:
        messages = [c.message for c in self._adversaries.values() if c is not None]
        message = " ".join(words for words in messages if words)
        beyond = {name: self._beyond(name) for name in self._adversaries if ending == "contact" and self._here(name)}
        return Driven(ending, message, beyond)

    def _here(self, name: str) -> bool:
        return name in self._drive.snapshot.raw

    def _beyond(self, name: str) -> Track:
        """The adversary's plan for the next ``CONTINUED`` seconds, outside the simulation."""
        controller, dt, start = self._adversaries[name], self._dt, self._drive.now
        state = self._drive.state(name)
        rows: list[tuple[float, ...]] = []
        for k in range(round(CONTINUED / dt)):
            p = _straight_on(state, (k + 1) * dt) if controller is None else controller.advance()
            acceleration = 0.0 if controller is None else controller.acceleration
            rows.append((start + (k + 1) * dt, p.x, p.y, p.heading, p.speed, acceleration))
        time, x, y, heading, speed, accelerations = np.array(rows).T
        return Track(name, Role.ADVERSARY, time, x, y, heading, speed, accelerations, state.length, state.width)


def attack(drive: Drive, adversaries: Mapping[str, AdversaryController], *, steps: int, replan: int) -> Driven:
    """A whole attempt in which controllers lead the adversaries and the ego's driver drives the ego."""
    attempt = OngoingAttempt(drive, adversaries, steps=steps, replan=replan)
    while (driven := attempt.state.driven) is None:
        attempt.step()
    return driven


def _straight_on(v: VehicleState, seconds: float) -> Pose:
    """Where a vehicle is that goes on as it goes."""
    far = v.speed * seconds
    return Pose(v.x + far * math.cos(v.heading), v.y + far * math.sin(v.heading), v.heading, v.speed)


def apart_of(drive: Drive, one: str, other: str) -> float:
    """Distance of the two centres [m]; exactly 0 only if the boxes overlap, inf where one of them is gone."""
    raw = drive.snapshot.raw
    if one not in raw or other not in raw:
        return math.inf
    a, b = drive.state(one), drive.state(other)
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
