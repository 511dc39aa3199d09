"""The lattice driver as it is foreseen: many of them at once, in the frame of the ego's path.

The rules are those of ``lattice_controller.py`` for the adversary alone: where it is expected, what ordinary driving
would do, which candidate is the cheapest (``lattice_choice.py``), and how pedals and wheel carry its beginning out.
There the path is the engine's and boxes stand in the world; here stations and offsets stand for both. Left out are
bends (the unattacked profile has them), all others, and what the driver saw before the attack began.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sumo_adv.datatypes import Bools, DriverModel, Floats
from sumo_adv.drivers.lattice_choice import Chosen, Room, Seen, State, choose, in_conflict
from sumo_adv.drivers.scenes import Scenes

HORIZON, STEP = 4.0, 0.2  # s, how far it plans and between compared times
BRAKING, LATERAL, MAX_STEERING, WHEELBASE = 8.0, 6.5, 0.6, 2.8  # m/s2, m/s2, rad, m
EASING, EASED, SETTING_OFF, KEEPING = 3.0, -2.0, 1.0, 2.0  # m/s3, m/s2, m/s, 1/s
LOOK, LEAST_LOOK = 0.2, 2.0  # s, m
DRIFT_RATE, DRIFT_TIME, SLOWING = 0.15, 2.5, 0.5  # m/s, s, m/s2
ALONG, STOPPING_SHORT, SMOOTHING, ASIDE = np.pi / 4, 3.0, 0.5, 12.0  # rad, m/s2, -, m
NEARBY, NOWHERE = 15.0, 1e6  # m: farther than that, and what both go in its horizon, nobody matters; off any road
NOTICED, MOVED = 0.05, 0.02  # m/s in a step, m and m/s: less is still as unattacked, and on the lane's centre
TIMES = STEP * np.arange(round(HORIZON / STEP) + 1.0)


class Others(NamedTuple):
    """What was seen of the adversaries a step ago, ``(n,)``: station, offset, heading, yaw rate, speed."""

    s: Floats
    d: Floats
    heading: Floats
    rate: Floats
    speed: Floats


class LatticeDrivers:
    """One lattice driver against each adversary of a length and width [m], ``(n,)``.

    ``d``: offset [m] from the path, ``turn``: heading against it [rad], both ``(n,)``; ``disturbed``: who does not
    follow its unattacked profile any more.
    """

    def __init__(self, scenes: Scenes, length: Floats, width: Floats, model: DriverModel) -> None:
        n = len(length)
        self._scenes, self._length, self._width = scenes, length, width
        self._accel, self._decel = model.acceleration, model.deceleration
        self._tau, self._min_gap = model.tau, model.min_gap
        self._most = max(model.speed, 1.0)
        self._ego = (scenes.ego.length, scenes.ego.width)
        self._room = Room.of(scenes)
        self._before: Others | None = None
        self.d, self.turn, self._slip, self._target, self._left, self._second = (np.zeros(n) for _ in range(6))
        self._a = scenes.each(lambda s: s.profile_a[0])
        self._ordinary = np.zeros(n)
        self.disturbed = np.zeros(n, bool)

    def step(
        self, now: float, ego: tuple[Floats, Floats], adversary: tuple[Floats, Floats, Floats], speed: Floats,
        advised: Floats,
    ) -> tuple[Floats, Floats]:  # fmt: skip
        """Stations and speeds a step on, of egos at ``ego`` (the same); ``adversary``: station, offset, heading of box
        centres; ``advised``: the speeds [m/s] that SUMO's driver would have, inf where it has no reason."""
        (s, v), dt = ego, self._scenes.dt
        seen = self._expected(s, v, adversary, speed)
        cap = np.where(np.isfinite(advised), (advised - v) / dt, np.inf)
        cap = np.where(v > SETTING_OFF, np.minimum(cap, np.maximum(self._ordinary, EASED) + EASING * dt), cap)
        next_s, next_v = self._scenes.profile_now(now + dt)
        reference = self._reference(now, s, v, seen, cap)
        self.disturbed |= v + reference[:, 0] * dt < next_v - NOTICED
        state = State(s, v, self._a, reference, self.d, v * np.sin(self.turn + self._slip), self._second,
                      self._target, self._left)  # fmt: skip
        moved = np.maximum(np.maximum(np.abs(self.d), np.abs(self._target)), np.abs(state.rate)) > MOVED
        rows = np.flatnonzero(moved | in_conflict(state, seen, self._ego, TIMES))
        a, aim, limits = reference[:, 0].copy(), np.zeros(len(s)), (self._most, self._accel, BRAKING)
        self._target, self._left, self._second = np.zeros(len(s)), np.zeros(len(s)), np.zeros(len(s))
        ahead = np.maximum(LOOK * v, LEAST_LOOK)
        if len(rows):
            found = choose(state.of(rows), seen.of(rows), self._ego, self._room.of_rows(rows), limits, TIMES)
            a[rows] = np.where(found.pace == 0, a[rows], found.acceleration)
            self._keep(rows, found, dt)
            aim[rows] = found.offset_after(ahead[rows], s[rows], TIMES)
            self.disturbed[rows] |= (found.pace > 0) | (found.target != 0.0)
        return self._carry_out(s, v, np.where(self.disturbed, a, (next_v - v) / dt), aim, ahead, next_s, reference)

    def _keep(self, rows: Any, found: Chosen, dt: float) -> None:
        self._target[rows], self._left[rows] = found.target, found.duration - dt
        self._second[rows] = found.second

    def _expected(self, s: Floats, v: Floats, adversary: tuple[Floats, Floats, Floats], speed: Floats) -> Seen:
        """Where the adversaries are expected, far off where they do not matter."""
        (at, d, h), dt = adversary, self._scenes.dt
        new = self._before is None
        b = self._before or Others(at, d, h, np.zeros(len(s)), speed)
        turned = np.remainder(h - b.heading + np.pi, 2 * np.pi) - np.pi
        rate = b.rate if new else b.rate + SMOOTHING * (turned / dt - b.rate)
        drift = speed * np.sin(h) if new else (d - b.d) / dt
        self._before = Others(at, d, h, rate, speed)
        way = _travelled(speed, (speed - b.speed) / dt, TIMES)
        along = (np.abs(np.sin(h)) < np.sin(ALONG)) & (np.abs(d) < ASIDE)
        there, beside, turn = _going_on(self._before, along, np.where(np.abs(drift) < DRIFT_RATE, 0.0, drift), way)
        cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
        long, wide = self._length[:, None], self._width[:, None]
        half_s, half_d = (cos * long + sin * wide) / 2, (sin * long + cos * wide) / 2
        lane = np.abs(d - self.d) < half_d[:, 0] + self._ego[1] / 2 + 0.3
        behind = (at + half_s[:, 0] < s - self._ego[0] / 2) & lane & (np.cos(h) > 0)
        matters = ~behind & (along | ~self._yields(d, h, speed, half_d[:, 0]))
        matters &= np.abs(at - s) < NEARBY + HORIZON * (speed + v)
        return Seen(np.where(matters[:, None], there, NOWHERE), beside, half_s, half_d, speed * np.cos(h))

    def _yields(self, d: Floats, h: Floats, speed: Floats, half_d: Floats) -> Bools:
        """On a crossing course, and still able to stop short of the path."""
        towards = -np.sign(d) * speed * np.sin(h)
        side = np.abs(d) - half_d - self._ego[1] / 2
        room = side * speed / np.maximum(towards, 1e-6)
        return np.asarray((side > 0) & (towards > 0) & (room >= speed * speed / (2 * STOPPING_SHORT)))

    def _reference(self, now: float, s: Floats, v: Floats, seen: Seen, cap: Floats) -> Floats:
        """Accelerations [m/s2] of ordinary driving by time, ``(n, time)``: by the profile, behind who is expected."""
        rear = seen.s - seen.half_s
        inside = np.abs(seen.d - self.d[:, None]) < seen.half_d + self._ego[1] / 2 + 0.1
        inside &= (seen.s[:, :1] > s[:, None]) & (seen.speed > -0.5)[:, None]
        rear = np.where(inside, rear, np.inf)
        leader = np.where(inside, np.maximum(seen.speed, 0.0)[:, None], 0.0)
        wanted = self._wanted(now, s, v)
        found, place, root = np.empty_like(rear), s + self._ego[0] / 2, 2 * np.sqrt(self._accel * self._decel)
        for k in range(len(TIMES)):
            free = self._free(v, wanted[:, k])
            wish = self._min_gap + np.maximum(0.0, v * self._tau + v * (v - leader[:, k]) / root)
            gap = np.maximum(rear[:, k] - place, 0.1)
            held = self._accel * (1.0 - (v / self._most) ** 4 - (wish / gap) ** 2)
            a = np.minimum(np.minimum(free, np.where(np.isfinite(gap), held, np.inf)), cap)
            found[:, k] = a = np.minimum(np.maximum(a, np.maximum(-BRAKING, -v / STEP)), self._accel)
            place = place + np.maximum(v * STEP + a * STEP * STEP / 2, 0.0)
            v = np.maximum(v + a * STEP, 0.0)
            cap = np.where(cap < 0.0, cap, np.inf)
        return found

    def _free(self, v: Floats, wanted: Floats) -> Floats:
        """Acceleration [m/s2] with nobody ahead: along the profile, and once disturbed as IDM towards its speed."""
        most = np.maximum(wanted, 0.5)
        alone = np.where(v <= most, self._accel * (1.0 - (v / most) ** 4), (most - v) * KEEPING)
        return np.where(self.disturbed, alone, (wanted - v) / STEP)

    def _wanted(self, now: float, s: Floats, v: Floats) -> Floats:
        """The speed [m/s] that it would have a compared time later with nobody in its way, ``(n, time)``."""
        _, profile = self._scenes.profile(now + TIMES + STEP)
        if not self.disturbed.any():
            return profile
        ahead = np.stack([self._scenes.pace(s + v * t) for t in TIMES], axis=1)
        return np.where(self.disturbed[:, None], np.maximum(ahead, profile[:, :1]), profile)

    def _carry_out(
        self, s: Floats, v: Floats, a: Floats, aim: Floats, ahead: Floats, next_s: Floats, reference: Floats
    ) -> tuple[Floats, Floats]:
        """A step of the bicycle's pedals and wheel."""
        dt = self._scenes.dt
        angle = np.arctan2(aim - self.d, ahead) - self.turn
        grip = np.arcsin(np.minimum(1.0, LATERAL * WHEELBASE / (2 * np.maximum(v, 1.0) ** 2)))
        slip = np.clip(angle / (1 + ahead / WHEELBASE), -grip, grip)
        wheel = np.clip(np.arctan(2 * np.tan(slip)), -MAX_STEERING, MAX_STEERING)
        slip = np.arctan(np.tan(wheel) / 2)
        speed = np.maximum(v + a * dt, 0.0)
        way = (v + speed) / 2 * dt
        turned = np.cos(slip) * np.tan(wheel) / WHEELBASE * way
        direction = self.turn + slip + turned / 2
        moved = way * np.cos(direction)
        self.d = self.d + way * np.sin(direction)
        self.turn, self._slip = self.turn + turned, slip
        self._a, self._ordinary = np.maximum(a, -v / dt), np.where(self.disturbed, reference[:, 0], np.maximum(a, 0.0))
        return np.where(self.disturbed, s + moved, next_s), speed


def _going_on(others: Others, along: Bools, drift: Floats, way: Floats) -> tuple[Floats, Floats, Floats]:
    """Stations, offsets and headings after ``way`` [m]: of those ``along`` the path with their ``drift`` [m/s], where
    one that comes the same way into its middle stays there; of all others on the circles that they are on."""
    h, d = others.heading[:, None], others.d[:, None]
    moved = d + drift[:, None] * np.minimum(TIMES, DRIFT_TIME)
    moved = np.where((moved * d < 0) & (np.cos(h) > 0), 0.0, moved)
    bend = np.where(others.speed > 0.5, others.rate / np.maximum(others.speed, 0.5), 0.0)[:, None]
    arc = np.where(along[:, None], 0.0, np.clip(bend * way, -np.pi / 2, np.pi / 2))
    chord, direction = way * np.sinc(arc / (2 * np.pi)), h + arc / 2
    offset = np.where(along[:, None], moved, d + chord * np.sin(direction))
    return others.s[:, None] + chord * np.cos(direction), offset, h + arc


def _travelled(v: Floats, a: Floats, times: Floats) -> Floats:
    """Metres at ``times``: those that brake go on braking, to standstill; all others keep their speed."""
    braking = np.where(a < -SLOWING, a, 0.0)[:, None]
    until = np.where(braking < 0, v[:, None] / np.maximum(-braking, 1e-6), np.inf)
    t = np.minimum(times, until)
    return np.asarray(v[:, None] * t + braking / 2 * t * t)
