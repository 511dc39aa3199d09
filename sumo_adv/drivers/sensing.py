"""Sensors that err and answers that come late: wrappers of any driver.

The noise of a vehicle at a time depends only on the seeds, the vehicle's id and the time. It is therefore the same in
forks, in repeated runs and for two versions of a driver, whatever other vehicles there are.
"""

from __future__ import annotations

import math
import zlib
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sumo_adv.datatypes import VehicleState
from sumo_adv.drivers.protocol import Action, EgoController, LaneSpeed, Observation, Steer, Vehicle
from sumo_adv.drivers.timing import TimedEgo
from sumo_adv.drivers.wrapped import WrappedEgo
from sumo_adv.ego_sensing import EgoSensing
from sumo_adv.geometry import wrap

WHOLE_STEP = 1e-6  # -, share of a step: a time this near to whole steps counts as whole steps


class SensedEgo(WrappedEgo):
    """A driver that sees the other vehicles through sensors. It knows itself, the path and the road exactly."""

    def __init__(self, driver: EgoController, sensing: EgoSensing) -> None:
        super().__init__(driver)
        self._sensing, self._seed = sensing, 0
        self._past: deque[tuple[float, Sequence[VehicleState]]] = deque()

    def reset(self, seed: int) -> None:
        self._seed = seed
        self._past.clear()
        super().reset(seed)

    def act(self, observation: Observation) -> Action:
        return super().act(replace(observation, others=self._seen(observation)))

    def _seen(self, observation: Observation) -> tuple[VehicleState, ...]:
        """Return the vehicles as the sensors report them."""
        time, others = self._delayed(observation)
        reported = (self._reported(time, other) for other in others)
        ego, reach = observation.ego, self._sensing.range
        return tuple(
            each for each in reported
            if each is not None and (reach is None or math.hypot(each.x - ego.x, each.y - ego.y) <= reach)
        )  # fmt: skip

    def _delayed(self, observation: Observation) -> tuple[float, Sequence[VehicleState]]:
        """Return the time ``delay`` seconds ago [s], and the vehicles then; none if that is before the first step."""
        late = self._sensing.delay
        if not late:
            return observation.time, observation.others
        self._past.append((observation.time, observation.others))
        until = observation.time - late + WHOLE_STEP * observation.dt
        while len(self._past) > 1 and self._past[1][0] <= until:
            self._past.popleft()
        time, others = self._past[0]
        if time > until:
            return time, ()
        now = {other.id: other for other in observation.others}
        return time, [_as_it_was(other, now.get(other.id)) for other in others]

    def _reported(self, time: float, other: VehicleState) -> VehicleState | None:
        """Return a vehicle with the sensors' errors; None if they miss it."""
        sensing = self._sensing
        if not (sensing.position_noise or sensing.speed_noise or sensing.missed):
            return other
        words = (sensing.seed, self._seed, zlib.crc32(other.id.encode()), round(1000.0 * time))
        random = np.random.Generator(np.random.PCG64(np.random.SeedSequence(words)))
        missed, (x, y, speed) = random.random(), random.standard_normal(3).tolist()
        if missed < sensing.missed:
            return None
        return replace(
            other, x=other.x + sensing.position_noise * x, y=other.y + sensing.position_noise * y,
            speed=max(other.speed + sensing.speed_noise * speed, 0.0),
        )  # fmt: skip


def _as_it_was(then: VehicleState, now: VehicleState | None) -> VehicleState:
    """Return a vehicle as it was.

    A ``Vehicle`` tells more than its motion. These attributes exist only for the present one, so they are taken from
    it.
    """
    if not isinstance(then, Vehicle):
        return then
    return replace(then, senses=now.senses if isinstance(now, Vehicle) else None)


@dataclass(frozen=True, slots=True)
class _Answer:
    """An answer of the driver.

    Attributes:
        action: The action.
        asked: The ego's state when the driver was asked.
        due: When the action takes effect [s].
    """

    action: Action
    asked: VehicleState
    due: float


class LateEgo(WrappedEgo):
    """A driver whose answers take effect later. Until its first answer does, SUMO drives.

    A ``Pose`` counts as the change of speed and heading that it asks for, because the controls of the car are late.
    """

    def __init__(self, driver: TimedEgo, latency: float | None) -> None:
        """Wrap a driver.

        Args:
            driver: The driver, with its answers timed.
            latency: How late its answers take effect [s]; None = as long as the driver's answer took. In that case, the
                driver is not asked again while it is busy.
        """
        super().__init__(driver)
        self._timed, self._latency = driver, latency
        self._took: dict[int, float] = {}  # how long an answer took, by time [ms]: the same if the run is repeated
        self._waiting: deque[_Answer] = deque()
        self._holds: _Answer | None = None

    def reset(self, seed: int) -> None:
        self._waiting.clear()
        self._holds = None
        super().reset(seed)

    def act(self, observation: Observation) -> Action:
        time, tolerance = observation.time, WHOLE_STEP * observation.dt
        if self._latency is not None or not self._waiting or self._waiting[-1].due <= time + tolerance:
            action = super().act(observation)
            self._waiting.append(_Answer(action, observation.ego, time + self._late(time, observation.dt)))
        while self._waiting and self._waiting[0].due <= time + tolerance:
            self._holds = self._waiting.popleft()
        return None if self._holds is None else _from(self._holds, observation)

    def _late(self, time: float, dt: float) -> float:
        """Return by how much the answer of this time is late [s]: whole steps."""
        took = self._latency
        if took is None:
            took = self._took.setdefault(round(1000.0 * time), self._timed.last)
        return round(took / dt) * dt


def _from(answer: _Answer, observation: Observation) -> Action:
    """Return an answer as it takes effect now."""
    action, then, now = answer.action, answer.asked, observation.ego
    if action is None or isinstance(action, Steer | LaneSpeed) or then is now:
        return action
    speed = max(now.speed + action.speed - then.speed, 0.0)
    moved = math.hypot(action.x - then.x, action.y - then.y)
    slip = wrap(math.atan2(action.y - then.y, action.x - then.x) - then.heading) if moved else 0.0
    far = (now.speed + speed) / 2 * observation.dt
    direction = now.heading + slip
    heading = wrap(now.heading + action.heading - then.heading)
    x, y = now.x + far * math.cos(direction), now.y + far * math.sin(direction)
    return replace(action, x=x, y=y, heading=heading, speed=speed)
