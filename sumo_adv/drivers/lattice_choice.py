"""Which candidate a lattice driver takes: those of ``drivers/lattice_sample.py`` at the prices of
``lattice_cost.py``, for many drivers with one other vehicle each.

Arrays are ``(n, time)`` for drivers, ``(n, along, time)`` and ``(n, aside, time)`` for candidates.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.drivers.scenes import Scenes
from sumo_adv.geometry import quintics

DURATIONS = (1.2, 2.0, 3.0)  # s, of a move sideways
STEPS_ASIDE = (-1.5, -1.0, -0.5, 0.5, 1.0, 1.5)  # m from the lane's centre
BRAKES = (2.0, 4.0)  # m/s2
RAMP = 20.0  # m/s3
CONTACT, CONTACT_SOON, CONTACT_FADES = 1000.0, 1.5, 0.8  # -, s, s
NEAR, NEAR_FADES = 60.0, 1.5  # 1/s, s
CLOSE = 6.0  # 1/s
CONTACT_MARGIN = (0.3, 0.15)  # m along, m across
NEAR_MARGIN = (1.0, 0.3)
CLOSE_MARGIN, CLOSE_HEADWAY = (1.5, 0.6), 0.2  # m, s
OFF_ROAD = 800.0  # 1/m
SLOWER, FASTER = 0.5, 4.0  # 1/(m/s)2
BRAKING, JERK_ASIDE, ACCELERATION_ASIDE = 0.2, 0.02, 0.05
ASIDE, STRAYING, CHANGE = 0.5, 4.0, 0.5  # 1/m2
OTHER_LANE = 8.0
SLOPE, STEEP = 0.3, 20.0  # -, (s/m)2
GRIP, SLIDING = 8.5, 40.0  # m/s2, 1/(m/s2)


class Seen(NamedTuple):
    """Where the other is expected: centres s, d and half extents [m], ``(n, time)``; speed along [m/s], ``(n,)``."""

    s: Floats
    d: Floats
    half_s: Floats
    half_d: Floats
    speed: Floats

    def of(self, rows: Any) -> Seen:
        """Those of some drivers."""
        return Seen(*(q[rows] for q in self))


class State(NamedTuple):
    """Drivers: station s, speed v, acceleration a, offset d and its rate and second derivative, the aim [m] of the
    move under way and what is left of it [s], each ``(n,)``; reference [m/s2], ``(n, time)``."""

    s: Floats
    v: Floats
    a: Floats
    reference: Floats
    d: Floats
    rate: Floats
    second: Floats
    target: Floats
    left: Floats

    def of(self, rows: Any) -> State:
        """Some of them."""
        return State(*(q[rows] for q in self))


class Room(NamedTuple):
    """Where drivers may be: offsets [m] to aim at, half the lane's width, right and left edge with the lanes beside it,
    and the station up to which these are there."""

    offsets: Floats
    half: Floats
    right: Floats
    left: Floats
    until: Floats

    @staticmethod
    def of(scenes: Scenes) -> Room:
        """That of the egos of scenes; the aims are those of the first."""
        half = scenes.each(lambda s: s.lane_width) / 2
        beside = [[o for o, kind in s.ego_sides if kind == "same"] for s in scenes.of]
        right = np.array([min((0.0, *sides)) for sides in beside]) - half
        left = np.array([max((0.0, *sides)) for sides in beside]) + half
        width = scenes.ego.width
        steps = [d for d in STEPS_ASIDE if right[0] + width / 2 <= d <= left[0] - width / 2]
        until = scenes.each(lambda s: s.junction)
        return Room(np.array([0.0, *steps, *beside[0]]), half, right, left, until)

    def of_rows(self, rows: Any) -> Room:
        """That of some drivers."""
        return Room(self.offsets, *(q[rows] for q in self[1:]))


class Chosen(NamedTuple):
    """The cheapest candidates, ``(n,)``: which one along (0 is the reference); acceleration [m/s2] and second
    derivative of the offset [m/s2] a step on; aim [m] and duration [s] of the move; stations and offsets by time."""

    pace: Any
    acceleration: Floats
    second: Floats
    target: Floats
    duration: Floats
    s: Floats
    d: Floats

    def offset_after(self, ahead: Floats, s: Floats, times: Floats) -> Floats:
        """The offsets [m] where they are ``ahead`` [m] of stations ``s``."""
        late = self.s - s[:, None] + 1e-6 * times >= ahead[:, None]
        k = np.where(late.any(axis=1), np.maximum(late.argmax(axis=1), 1), len(times) - 1)
        rows = np.arange(len(s))
        before, after = self.s[rows, k - 1] - s, self.s[rows, k] - s
        w = np.clip((ahead - before) / np.maximum(after - before, 1e-6), 0.0, 1.0)
        return np.asarray(self.d[rows, k - 1] * (1 - w) + self.d[rows, k] * w)


class _Along(NamedTuple):
    s: Floats
    v: Floats
    a: Floats


class _Aside(NamedTuple):
    d: Floats
    rate: Floats
    second: Floats
    target: Floats
    duration: Floats
    jerk: Floats


def in_conflict(state: State, seen: Seen, ego: tuple[float, float], times: Floats) -> Bools:
    """Who comes close to the other by its reference on the lane's centre; ``ego``: length and width [m]."""
    on = _rolled(state, state.reference[:, None], times)
    apart_s, apart_d = np.abs(seen.s - on.s[:, 0]) - seen.half_s - ego[0] / 2, np.abs(seen.d) - seen.half_d - ego[1] / 2
    long = CLOSE_MARGIN[0] + CLOSE_HEADWAY * on.v[:, 0]
    return np.asarray(((apart_s < long) & (apart_d < CLOSE_MARGIN[1])).any(axis=1))


def choose(
    state: State, seen: Seen, ego: tuple[float, float], room: Room, limits: tuple[float, float, float], times: Floats
) -> Chosen:
    """The cheapest candidates. ``limits``: the fastest it goes [m/s], acceleration and emergency brake [m/s2]."""
    on, off = _along(state, limits, times), _aside(state, room, times)
    total = _comfort(off, state, room)[:, None] + _pace(on)[:, :, None] + _off_road(off, on, ego, room, state, times)
    total = total + _manners(on, off) + _meetings(on, off, seen, ego, times)
    n, most = len(state.s), total.shape[2]
    best = total.reshape(n, -1).argmin(axis=1)
    rows, pace, side = np.arange(n), best // most, best % most
    pedal, second = on.a[rows, pace], off.second[rows, side]
    return Chosen(
        pace, (pedal[:, 0] + pedal[:, 1]) / 2, (second[:, 0] + second[:, 1]) / 2, off.target[rows, side],
        off.duration[rows, side], on.s[rows, pace], off.d[rows, side],
    )  # fmt: skip


def _along(state: State, limits: tuple[float, float, float], times: Floats) -> _Along:
    wanted, acceleration, emergency = limits
    n = len(state.v)
    aims = np.empty((n, 5))
    aims[:, 0], aims[:, 1] = 0.0, np.where(state.v < wanted, acceleration, 0.0)
    aims[:, 2:] = [*(-b for b in BRAKES), -emergency]
    a = state.a[:, None, None]
    ramped = a + np.clip(aims[:, :, None] - a, -RAMP * times, RAMP * times)
    found = _rolled(state, np.concatenate([state.reference[:, None], ramped], axis=1), times)
    most = np.maximum(wanted, state.v)[:, None]
    faster = found.v[:, 2] > most
    if faster.any():
        found.v[:, 2] = np.minimum(found.v[:, 2], most)
        found.s[:, 2] = state.s[:, None] + _summed(found.v[:, 2], times)
    return found


def _rolled(state: State, pedals: Floats, times: Floats) -> _Along:
    speed = np.maximum(state.v[:, None, None] + _summed(pedals, times), 0.0)
    return _Along(state.s[:, None, None] + _summed(speed, times), speed, pedals)


def _summed(values: Floats, times: Floats) -> Floats:
    """Their integral by time, by trapezia, 0 at first."""
    found = np.zeros_like(values)
    np.cumsum((values[..., 1:] + values[..., :-1]) * ((times[1] - times[0]) / 2), axis=-1, out=found[..., 1:])
    return found


def _aside(state: State, room: Room, times: Floats) -> _Aside:
    n, aims = len(state.d), room.offsets
    target, duration = np.empty((n, 3 * len(aims) + 1)), np.empty((n, 3 * len(aims) + 1))
    target[:, :-1], duration[:, :-1] = np.repeat(aims, len(DURATIONS)), np.tile(DURATIONS, len(aims))
    target[:, -1], duration[:, -1] = state.target, np.maximum(state.left, 0.5)
    start = (state.d[:, None], state.rate[:, None], state.second[:, None])
    d, rate, second, jerk = quintics(start, target, duration, times)
    return _Aside(d, rate, second, target, duration, jerk)


def _comfort(off: _Aside, state: State, room: Room) -> Floats:
    here = np.abs(off.target) < room.half[:, None]
    away = np.where(here, ASIDE * off.target**2 + STRAYING * (off.d**2).mean(axis=2), OTHER_LANE)
    change = CHANGE * np.minimum((off.target - state.target[:, None]) ** 2, 4.0)
    return np.asarray(away + change + JERK_ASIDE * off.jerk + ACCELERATION_ASIDE * (off.second**2).mean(axis=2))


def _pace(on: _Along) -> Floats:
    slower, faster = np.maximum(on.v[:, :1] - on.v, 0.0), np.maximum(on.v - on.v[:, :1], 0.0)
    braking = BRAKING * np.minimum(on.a, 0.0) ** 2
    braking[:, 0] = 0.0  # what the reference itself brakes is no choice
    return np.asarray((SLOWER * slower**2 + FASTER * faster**2 + braking).mean(axis=2))


def _off_road(off: _Aside, on: _Along, ego: tuple[float, float], room: Room, state: State, times: Floats) -> Floats:
    """By the metres that the box sticks out over the road's edges, more than it does now; ``(n, 1, aside)``."""
    there = state.v[:, None] * times < (room.until - state.s)[:, None]
    right = np.where(there, room.right[:, None], -room.half[:, None])[:, None]
    left = np.where(there, room.left[:, None], room.half[:, None])[:, None]
    corner = ego[1] / 2 + ego[0] / 2 * np.minimum(np.abs(off.rate) / np.maximum(on.v[:, :1], 3.0), 0.4)
    out = np.maximum(np.maximum(off.d + corner - left, right - off.d + corner), 0.0)
    return np.asarray(OFF_ROAD * np.maximum(out.max(axis=2) - out[:, :, 0], 0.0))[:, None]


def _manners(on: _Along, off: _Aside) -> Floats:
    """Beyond what a car can do: sideways without going on, and beyond the friction circle; ``(n, along, aside)``."""
    slope = (np.abs(off.rate)[:, None] - (SLOPE * on.v + 0.1)[:, :, None]).max(axis=3)
    moving = (on.v > 0.5)[:, :, None]
    square = np.where(moving, (off.second**2)[:, None] + (on.a**2)[:, :, None], 0.0).max(axis=3)
    return np.asarray(STEEP * np.maximum(slope, 0.0) ** 2 + SLIDING * np.maximum(np.sqrt(square) - GRIP, 0.0))


def _meetings(on: _Along, off: _Aside, seen: Seen, ego: tuple[float, float], times: Floats) -> Floats:
    apart_s = np.abs(seen.s[:, None] - on.s) - seen.half_s[:, None] - ego[0] / 2
    turned = np.minimum(np.abs(off.rate) / np.maximum(on.v[:, :1], 3.0), 0.4)
    apart_d = np.abs(seen.d[:, None] - off.d) - seen.half_d[:, None] - ego[1] / 2 - turned * ego[0] / 2
    bits = 1 << np.arange(len(times))  # a bit for each time at which they overlap
    along, across = (apart_s < CONTACT_MARGIN[0]) @ bits, (apart_d < CONTACT_MARGIN[1]) @ bits
    both = np.bitwise_and(along[:, :, None], across[:, None])
    first = np.log2(np.maximum(np.bitwise_and(both, np.negative(both)), 1)).astype(np.intp)
    pace = np.take_along_axis(on.v, first, axis=2)
    weight = CONTACT * np.exp(-np.maximum(times[first] - CONTACT_SOON, 0.0) / CONTACT_FADES) * (0.5 + pace / 20.0)
    fades = np.exp(-times / NEAR_FADES) * (times[1] - times[0])
    near = ((apart_s < NEAR_MARGIN[0]) * (NEAR * fades)) @ (apart_d < NEAR_MARGIN[1]).transpose(0, 2, 1)
    long = CLOSE_MARGIN[0] + CLOSE_HEADWAY * on.v
    close = ((apart_s < long) * (CLOSE * fades)) @ (apart_d < CLOSE_MARGIN[1]).transpose(0, 2, 1)
    return np.where(both != 0, weight, 0.0) + near + close
