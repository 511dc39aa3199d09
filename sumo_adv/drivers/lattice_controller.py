"""A lattice planner of our own, which brakes and swerves.

In every step it lays candidates over the frame of its route path (``lattice_sample.py``), predicts the others there
(``lattice_frame.py``), and carries out the beginning of the cheapest candidate (``lattice_cost.py``) with the bicycle
model (``bicycle.py``).  Unprovoked it follows a reference: IDM behind whoever is ahead, slower where SUMO's own driver
would be (``Road.advised``: lights and right of way), and in bends.  It perceives at once and exactly, and knows nothing
of what others intend.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from sumo_adv.datatypes import DriverModel, Floats, VehicleState
from sumo_adv.drivers.bicycle import MAX_STEERING
from sumo_adv.drivers.lattice_cost import Body, costs
from sumo_adv.drivers.lattice_frame import Others, RoadFrame, Watch, predict
from sumo_adv.drivers.lattice_sample import Along, Aside, along, aside, offsets_in
from sumo_adv.drivers.protocol import Action, Observation, Road, Steer
from sumo_adv.drivers.sumo_driven import sumo_type
from sumo_adv.errors import UsageError
from sumo_adv.geometry import wrap

WHEELBASE = 2.8  # m, as ``bicycle.py``
STEP = 0.2  # s between compared times
EASING, EASED = 3.0, -2.0  # m/s3, m/s2: how fast braking is let go of, and from where on
LOOK, LEAST_LOOK = 0.2, 2.0  # s, m: how far ahead the wheel aims
SETTING_OFF = 1.0  # m/s, slower there is no easing
HELD = -3.0  # m/s2 at a line where it must wait
KEEPING = 2.0  # 1/s, how fast it comes down to a speed that it is above


@dataclass(frozen=True, slots=True)
class LatticeSettings:
    """Its own settings; those of IDM are named as in SUMO's vType."""

    horizon: float = 4.0  # s, how far it plans
    braking: float = 8.0  # m/s2, its emergency brake
    lateral: float = 6.5  # m/s2, the most its wheel asks for


@dataclass(frozen=True, slots=True)
class Intended:
    """What it did in the step before, and what it is about to do."""

    speed: float  # m/s before that step
    asked: float  # m/s after it
    acceleration: float
    reference: float  # m/s2
    slip: float  # rad
    target: float  # m
    left: float  # s of the move sideways
    second: float  # m/s2, sideways


class LatticeEgo:
    """State: the frame of the path, where others were, what it intends."""

    name = "lattice"
    forkable = True
    needs_observation = True
    needs_road = True

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        """``parameters``: those of ``LatticeSettings`` and of IDM. Raises UsageError."""
        own = dict(parameters or {})
        known = {f.name: own.pop(f.name) for f in fields(LatticeSettings) if f.name in own}
        for name, value in known.items():
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0.5 <= value <= 20.0:
                raise UsageError(f"The ego 'lattice' needs {name!r} to be a number from 0.5 to 20, not {value!r}.")
        self.settings = LatticeSettings(**{name: float(value) for name, value in known.items()})
        self.sumo_type: Mapping[str, str] = sumo_type("idm", own)
        self._idm = {name: float(value) for name, value in self.sumo_type.items() if name != "carFollowModel"}
        self._times: Floats = STEP * np.arange(round(self.settings.horizon / STEP) + 1.0)
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Nothing seen, nothing intended; the seed is not needed."""
        self._watch = Watch()
        self._points: Sequence[tuple[float, float]] | None = None
        self._frame: RoadFrame | None = None
        self._before: Intended | None = None
        self._wanted: float | None = None

    def model_of(self, numbers: DriverModel) -> DriverModel:
        """Predicted by ``lattice_model.py``; SUMO's lane rules do not hold for it."""
        return replace(numbers, kind=self.name, known=True)

    def act(self, observation: Observation) -> Action:
        """Pedals and wheel for the step; None (SUMO drives) until it is told a path, and out of the network."""
        ego, times = observation.ego, self._times
        moving = self._watch.look(observation.time, observation.others)
        frame = self._framed(observation)
        if frame is None or (observation.road is not None and observation.road.leaves):
            return None
        before = self._before or _at_ease(ego)
        s, d, turn = frame.locate(ego)
        others = predict(frame, ego, (s, d), observation.others, moving, times)
        road = observation.road or Road(self._free_speed(ego))
        reference = self._reference(frame, ego, (s, d), others, road, before, observation.dt)
        acceleration = self._idm["accel"]
        on = along(
            s, ego.speed, before.acceleration, reference, road.limit, acceleration, self.settings.braking, times
        )  # fmt: skip
        rate = ego.speed * math.sin(turn + before.slip)
        half = road.width / 2
        room = (min((0.0, *road.sides)) - half, max((0.0, *road.sides)) + half)
        offsets = offsets_in(room, ego.width, road.sides)
        off = aside((d, rate, before.second), offsets, (before.target, before.left), times)
        there = ego.speed * times < road.until
        body = Body(ego.length, ego.width, np.where(there, room[0], -half), np.where(there, room[1], half))
        bend, _ = frame.bend(on.s)
        price = costs(on, off, others, body, bend, before.target, half, times)
        pace, side = np.unravel_index(int(np.argmin(price)), price.shape)
        return self._carry_out(observation, frame, s, on, off, int(pace), int(side), float(reference[0]))

    def _framed(self, observation: Observation) -> RoadFrame | None:
        """The frame of the path told, else the last one; what was intended is carried over to a new one."""
        if observation.path is None or observation.path is self._points:
            return self._frame
        frame = RoadFrame(observation.path)
        if self._frame is not None and self._before is not None:
            shift = frame.locate(observation.ego)[1] - self._frame.locate(observation.ego)[1]
            b = self._before
            self._before = Intended(
                b.speed, b.asked, b.acceleration, b.reference, b.slip, b.target + shift, b.left, b.second
            )
        self._points, self._frame = observation.path, frame
        return frame

    def _free_speed(self, ego: VehicleState) -> float:
        """Without a road: the speed that it had when it was first asked."""
        if self._wanted is None:
            self._wanted = max(ego.speed, 1.0)
        return self._wanted

    def _reference(
        self, frame: RoadFrame, ego: VehicleState, at: tuple[float, float], others: Others, road: Road,
        before: Intended, dt: float,
    ) -> Floats:  # fmt: skip
        """Accelerations [m/s2] of ordinary driving by time, rolled out against the predicted leader."""
        idm, times = self._idm, self._times
        rear, pace = _leader(ego, at, others, len(times))
        cap = _advice(road, before, ego, dt)
        if ego.speed > SETTING_OFF:
            cap = min(cap, max(before.reference, EASED) + EASING * dt)
        v, s, found = ego.speed, at[0] + ego.length / 2, np.empty(len(times))
        _, bends = frame.bend(s + np.maximum(v, 1.0) * times)
        for k in range(len(times)):
            wanted = max(min(road.limit, bends[k]), 0.5)
            free = 1.0 - (v / wanted) ** idm["delta"] if v <= wanted else (wanted - v) * KEEPING / idm["accel"]
            gap = max(rear[k] - s, 0.1)
            closing = v * (v - pace[k]) / (2 * math.sqrt(idm["accel"] * idm["decel"]))
            wish = idm["minGap"] + max(0.0, v * idm["tau"] + closing)
            a = min(idm["accel"] * (free - (wish / gap) ** 2), cap)
            found[k] = a = min(max(a, -self.settings.braking, -v / STEP), idm["accel"])
            s, v = s + max(v * STEP + a * STEP * STEP / 2, 0.0), max(v + a * STEP, 0.0)
            cap = cap if cap < 0.0 else math.inf
        return found

    def _carry_out(
        self, observation: Observation, frame: RoadFrame, s: float, on: Along, off: Aside, pace: int, side: int,
        reference: float,
    ) -> Steer:  # fmt: skip
        """The beginning of one candidate with the bicycle's pedals and wheel."""
        ego, dt, times = observation.ego, observation.dt, self._times
        acceleration = reference if pace == 0 else float(np.interp(dt, times, on.a[pace]))
        ahead = max(LOOK * ego.speed, LEAST_LOOK)
        when = float(np.interp(s + ahead, on.s[pace] + 1e-6 * times, times))
        x, y, _ = frame.path.at(np.array(s + ahead), float(np.interp(when, times, off.d[side])))
        angle = wrap(math.atan2(float(y) - ego.y, float(x) - ego.x) - ego.heading)
        grip = math.asin(min(1.0, self.settings.lateral * WHEELBASE / (2 * max(ego.speed, 1.0) ** 2)))
        slip = min(max(angle / (1 + ahead / WHEELBASE), -grip), grip)
        wheel = min(max(math.atan(2 * math.tan(slip)), -MAX_STEERING), MAX_STEERING)
        self._before = Intended(
            speed=ego.speed,
            asked=max(0.0, ego.speed + acceleration * dt),
            acceleration=max(acceleration, -ego.speed / dt),
            reference=reference,
            slip=math.atan(math.tan(wheel) / 2),
            target=float(off.target[side]),
            left=float(off.duration[side]) - dt,
            second=float(np.interp(dt, times, off.second[side])),
        )
        return Steer(acceleration, wheel)


def _at_ease(ego: VehicleState) -> Intended:
    return Intended(ego.speed, ego.speed, ego.acceleration, ego.acceleration, 0.0, 0.0, 0.0, 0.0)


def _advice(road: Road, before: Intended, ego: VehicleState, dt: float) -> float:
    """The acceleration [m/s2] at most, by SUMO's driver: it was slower than the ego asked to be, or may not go."""
    if road.held:
        return HELD
    if road.advised is None or road.advised > before.asked - 1e-3:
        return math.inf
    return (road.advised - before.speed) / dt


def _leader(ego: VehicleState, at: tuple[float, float], others: Others, count: int) -> tuple[Floats, Floats]:
    """Station of the nearest rear ahead in the ego's way, and its speed, by time; ``inf`` and 0 where nobody is."""
    if others.s.shape[0] == 0:
        return np.full(count, math.inf), np.zeros(count)
    rears = others.s - others.half_s
    inside = np.abs(others.d - at[1]) < others.half_d + ego.width / 2 + 0.1
    inside &= (others.s[:, :1] > at[0]) & (others.speed > -0.5)[:, None]
    rears = np.where(inside, rears, math.inf)
    nearest = np.argmin(rears, axis=0)
    return rears[nearest, np.arange(count)], others.speed[nearest]
