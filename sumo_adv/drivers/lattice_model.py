"""The lattice driver as it is predicted: many egos at once, in the frame of their unattacked paths.

Each ego expects its adversaries and no other vehicle.  It follows its unattacked profile until one of them disturbs it.
Left out are bends (the profile contains them), all other vehicles, and what happened before the attack began.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sumo_adv.datatypes import DriverModel, Floats
from sumo_adv.drivers.bicycle import WHEELBASE
from sumo_adv.drivers.lattice import (
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
from sumo_adv.drivers.lattice_frame import Others, Poses, expect, kept_drift, smoothed
from sumo_adv.drivers.scenes import Scenes
from sumo_adv.drivers.sumo_driven import Idm

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
