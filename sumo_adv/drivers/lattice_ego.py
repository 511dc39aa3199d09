"""The lattice driver as an ego, which brakes and swerves, and as it is predicted.

In every step it takes the cheapest of its candidates (``lattice_candidates.py``) on the frame of its route path, and
carries out the beginning of it with the bicycle model (``protocol.py``).  Without danger it drives as IDM behind the
vehicle ahead, slower in bends and where SUMO's own driver would be (``Road.advised``: lights and right of way).

``LatticeDrivers`` predicts many egos at once, in the frame of their unattacked paths.  Each ego expects its adversaries
and no other vehicle.  It follows its unattacked profile until one of them disturbs it.  Left out are bends (the profile
contains them), all other vehicles, and what happened before the attack began.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sumo_adv.datatypes import DriverModel, Floats, VehicleState
from sumo_adv.drivers.lattice import (
    SLOWEST,
    STEP,
    Cruise,
    Egos,
    Expected,
    LatticeSettings,
    Memory,
    Size,
    eased,
    look_ahead,
    reference,
    steering,
)
from sumo_adv.drivers.lattice_candidates import Space, choose, in_conflict
from sumo_adv.drivers.lattice_frame import Others, Poses, RoadFrame, Watch, expect, kept_drift, others_on, smoothed
from sumo_adv.drivers.protocol import WHEELBASE, Action, Observation, Road, Steer, Wishes
from sumo_adv.drivers.sumo_driven import Idm, sumo_type
from sumo_adv.drivers.sumo_rules import Scenes
from sumo_adv.errors import UsageError
from sumo_adv.geometry import wrap

HELD = -3.0  # m/s2 at a line where it must wait
SLOW, AT_LINE = 1.0, 12.5  # m/s, m from its centre: slower and nearer than this it stands at a line, without advice
OWN = ("horizon", "braking", "lateral")  # settings that SUMO does not know


class LatticeEgo:
    """State: the frame of the path, where other vehicles were, and what the ego began in the last step."""

    name = "lattice"
    forkable = True
    needs_observation = True

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        """``parameters``: horizon, braking, lateral of ``LatticeSettings``, visible_only (False) of ``Wishes``, and
        those of IDM. Raises UsageError."""
        others = dict(parameters or {})
        visible_only = others.pop("visible_only", False)
        if not isinstance(visible_only, bool):
            raise UsageError(f"The ego 'lattice' needs 'visible_only' to be true or false, not {visible_only!r}.")
        self.wishes = Wishes(needs_road=True, visible_only=visible_only)
        own = {name: others.pop(name) for name in OWN if name in others}
        for name, value in own.items():
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0.5 <= value <= 20.0:
                raise UsageError(f"The ego 'lattice' needs {name!r} to be a number from 0.5 to 20, not {value!r}.")
        self.sumo_type: Mapping[str, str] = sumo_type("idm", others)
        idm = Idm(**{name: float(value) for name, value in self.sumo_type.items() if name != "carFollowModel"})
        self.settings = LatticeSettings(**{name: float(value) for name, value in own.items()}, idm=idm)
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Forget everything; the seed is not needed."""
        self._watch = Watch()
        self._points: Sequence[tuple[float, float]] | None = None
        self._frame: RoadFrame | None = None
        self._memory: Memory | None = None
        self._speed, self._asked = 0.0, 0.0  # m/s, before the last step, and asked for after it
        self._cruising: float | None = None

    def model_of(self, numbers: DriverModel) -> DriverModel:
        """Predicted by ``LatticeDrivers``; SUMO's lane rules do not hold for it."""
        return replace(numbers, kind=self.name, known=True, hardest_braking=self.settings.braking)

    def act(self, observation: Observation) -> Action:
        """Pedals and wheel for the step; None (SUMO drives) without a path, and where the route leaves the network."""
        ego, dt, settings = observation.ego, observation.dt, self.settings
        moving = self._watch.look(observation.time, observation.others)
        frame = self._framed(observation)
        if frame is None or (observation.road is not None and observation.road.leaves):
            return None
        if self._memory is None:
            acceleration, self._speed, self._asked = np.array([ego.acceleration]), ego.speed, ego.speed
            self._memory = Memory.first(acceleration, acceleration)
        memory, size = self._memory, Size(ego.length, ego.width)
        place = frame.locate(ego)
        egos = memory.egos(*(np.array([q]) for q in (*place, ego.speed)))
        others = expect(others_on(frame, ego, observation.others, moving), egos, size, settings.times, frame.project)
        road = observation.road or Road(self._free_speed(ego))
        space = Space.between(np.array([road.width / 2]), [road.sides], np.array([road.until]), ego.width)
        ordinary = self._reference(frame, egos, size, others, road, dt)
        chosen = choose(
            egos, size, ordinary, np.array([road.limit]), others, space, settings, dt, lambda s: frame.bend(s)[0]
        )
        ahead = look_ahead(egos.speed)
        x, y, _ = frame.path.at(egos.s + ahead, chosen.offset_after(ahead))
        angle = wrap(math.atan2(y[0] - ego.y, x[0] - ego.x) - ego.heading)
        wheel, slip = steering(np.array([angle]), ahead, egos.speed, settings.lateral)
        pedal = float(chosen.acceleration[0])
        self._speed, self._asked = ego.speed, max(0.0, ego.speed + pedal * dt)
        self._memory = Memory(
            np.maximum(chosen.acceleration, -egos.speed / dt), ordinary[:, 0], slip, chosen.target,
            chosen.duration - dt, chosen.second,
        )  # fmt: skip
        return Steer(pedal, float(wheel[0]))

    def _framed(self, observation: Observation) -> RoadFrame | None:
        """The frame of the present path, else the last one; the target offset is carried over to a new one."""
        if observation.path is None or observation.path is self._points:
            return self._frame
        frame = RoadFrame(observation.path)
        if self._frame is not None and self._memory is not None:
            shift = frame.locate(observation.ego)[1] - self._frame.locate(observation.ego)[1]
            self._memory = self._memory._replace(target=self._memory.target + shift)
        self._points, self._frame = observation.path, frame
        return frame

    def _free_speed(self, ego: VehicleState) -> float:
        """Without a road: the ego's first speed [m/s]."""
        if self._cruising is None:
            self._cruising = max(ego.speed, 1.0)
        return self._cruising

    def _reference(
        self, frame: RoadFrame, egos: Egos, size: Size, others: Expected, road: Road, dt: float
    ) -> Floats:  # fmt: skip
        """Accelerations [m/s2] of ordinary driving, ``(1, time)``."""
        assert self._memory is not None
        times, v = self.settings.times, egos.speed[:, None]
        bends = frame.bend(egos.s[:, None] + size.length / 2 + np.maximum(v, 1.0) * times)[1]
        speed = np.maximum(np.minimum(road.limit, bends), SLOWEST)
        cap = eased(np.array([self._advice(road, float(egos.speed[0]), dt)]), egos.speed, self._memory.reference, dt)
        return reference(egos, size, others, Cruise(speed, speed, np.zeros(1, bool)), cap, self.settings)

    def _advice(self, road: Road, speed: float, dt: float) -> float:
        """The maximum acceleration [m/s2] by SUMO's driver, if it was slower than the ego asked for or may not go."""
        if road.advised is None:
            at_line = speed < SLOW and bool(road.stop_lines) and road.stop_lines[0].ahead < AT_LINE
            return HELD if at_line and road.must_wait else math.inf
        if road.advised > self._asked - 1e-3:
            return math.inf
        return (road.advised - self._speed) / dt


NOTICED = 0.05  # m/s in a step: a smaller difference from the profile is no disturbance
MOVED = 0.02  # m and m/s: less is still on the lane's centre


class LatticeDrivers:
    """``n`` lattice drivers against adversaries of a length and width [m], ``(N,)``: one each, or the first ones of all
    egos, then their second ones.

    ``d``: offset [m] from the path, ``turn``: heading against it [rad], ``disturbed``: whether the ego has left its
    unattacked profile; all ``(n,)``.
    """

    def __init__(self, scenes: Scenes, length: Floats, width: Floats, model: DriverModel) -> None:
        n = len(scenes.of)
        self._scenes, self._length, self._width = scenes, _by_ego(length, n), _by_ego(width, n)
        idm = Idm(tau=model.tau, accel=model.acceleration, decel=model.deceleration, minGap=model.min_gap)
        usual, self._fastest = LatticeSettings(idm=idm), np.full(n, max(model.speed, 1.0))
        self._settings = replace(usual, braking=min(usual.braking, model.hardest_braking))
        self._size = Size(scenes.ego.length, scenes.ego.width)
        sides = [[offset for offset, kind in s.road.sides if kind == "same"] for s in scenes.of]
        half, self._until = scenes.each(lambda s: s.road.lane_width) / 2, scenes.each(lambda s: s.road.junction)
        self._space = Space.between(half, sides, self._until, self._size.width)
        self._before: Others | None = None
        self._memory = Memory.first(scenes.each(lambda s: s.baseline.a[0]), np.zeros(n))
        self.d, self.turn, self.disturbed = np.zeros(n), np.zeros(n), np.zeros(n, bool)

    def step(
        self, now: float, ego: tuple[Floats, Floats], adversary: Poses, speed: Floats, advised: Floats
    ) -> tuple[Floats, Floats]:
        """Stations and speeds of the egos, ``(n,)``, after a step. ``ego``: the same now; ``adversary``: station,
        offset, heading of box centres; ``advised``: speed [m/s] of SUMO's driver after it, inf if it has no reason."""
        (s, v), dt, settings, size = ego, self._scenes.dt, self._settings, self._size
        egos = self._memory.egos(s, self.d, self.turn, v)
        others = self._expected(egos, adversary, speed)
        cap = eased(np.where(np.isfinite(advised), (advised - v) / dt, np.inf), v, self._memory.reference, dt)
        next_s, next_v = self._scenes.profile_now(now + dt)
        ordinary = reference(egos, size, others, self._cruise(now, s, v), cap, settings)
        self.disturbed |= v + ordinary[:, 0] * dt < next_v - NOTICED
        moved = np.maximum(np.maximum(np.abs(self.d), np.abs(egos.target)), np.abs(egos.rate)) > MOVED
        # the other egos keep to their reference on the centre, which costs least there
        rows = np.flatnonzero(moved | in_conflict(egos, size, ordinary, others))
        a, (aim, target, left, second) = ordinary[:, 0].copy(), np.zeros((4, len(s)))
        ahead = look_ahead(v)
        if len(rows):
            space = self._space._replace(until=self._until - s).of(rows)
            chosen = choose(
                egos.of(rows), size, ordinary[rows], self._fastest[rows], others.of(rows), space, settings, dt
            )
            a[rows], aim[rows] = chosen.acceleration, chosen.offset_after(ahead[rows])
            target[rows], left[rows], second[rows] = chosen.target, chosen.duration - dt, chosen.second
            self.disturbed[rows] |= (chosen.along > 0) | (chosen.target != 0.0)
        a = np.where(self.disturbed, a, (next_v - v) / dt)
        slip, way, speed = self._steer(v, a, aim, ahead)
        before = np.where(self.disturbed, ordinary[:, 0], np.maximum(a, 0.0))
        self._memory = Memory(np.maximum(a, -v / dt), before, slip, target, left, second)
        return np.where(self.disturbed, s + way, next_s), speed

    def _expected(self, egos: Egos, adversary: Poses, speed: Floats) -> Expected:
        """Where the adversaries are expected."""
        before, dt = self._before, self._scenes.dt
        s, d, h, v = (_by_ego(q, len(egos.s)) for q in (*adversary, speed))
        if before is None:
            drift, yaw_rate, acceleration = v * np.sin(h), np.zeros_like(s), np.zeros_like(s)
        else:
            drift, acceleration = (d - before.place[1]) / dt, (v - before.speed) / dt
            yaw_rate = smoothed(before.yaw_rate, h - before.place[2], dt)
        self._before = Others(
            (s, d, h), (s, d, h), v, acceleration, kept_drift(drift), yaw_rate, np.abs(s - egos.s[:, None]),
            self._length, self._width,
        )  # fmt: skip
        return expect(self._before, egos, self._size, self._settings.times)

    def _cruise(self, now: float, s: Floats, v: Floats) -> Cruise:
        """The speeds of the unattacked profiles by time; those of disturbed egos by station."""
        times = self._settings.times
        _, profile = self._scenes.profile(now + times + STEP)
        if self.disturbed.any():
            ahead = np.stack([self._scenes.pace(s + v * t) for t in times], axis=1)
            profile = np.where(self.disturbed[:, None], np.maximum(ahead, profile[:, :1]), profile)
        return Cruise(profile, np.broadcast_to(self._fastest[:, None], profile.shape), ~self.disturbed)

    def _steer(self, v: Floats, a: Floats, aim: Floats, ahead: Floats) -> tuple[Floats, Floats, Floats]:
        """Slip [rad], metres along the path and speed [m/s] after a step of the bicycle towards offsets ``aim``."""
        dt = self._scenes.dt
        angle = np.arctan2(aim - self.d, ahead) - self.turn
        wheel, slip = steering(angle, ahead, v, self._settings.lateral)
        speed = np.maximum(v + a * dt, 0.0)
        way = (v + speed) / 2 * dt
        turned = np.cos(slip) * np.tan(wheel) / WHEELBASE * way
        direction = self.turn + slip + turned / 2
        self.d, self.turn = self.d + way * np.sin(direction), self.turn + turned
        return slip, way * np.cos(direction), speed


def _by_ego(values: Floats, n: int) -> Floats:
    """What is said of the adversaries ``(N,)``, in a row for each ego ``(n, N / n)``."""
    return values.reshape(-1, n).T
