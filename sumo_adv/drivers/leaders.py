"""Leaders of the ego other than the adversary: other vehicles ahead of it in its lane.

Each keeps its unattacked motion, or follows the adversary if the adversary is ahead of it in its lane. Vehicles behind
such a follower brake, too.

Also the places where the adversary was the unattacked ego's leader and held it up. The ego's unattacked speed is no
limit there: if the adversary speeds up or leaves, the ego accelerates.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.drivers.car_following import DEFAULT_DRIVER, EMERGENCY, CarFollowing, exact
from sumo_adv.drivers.scenes import Scenes
from sumo_adv.situation import Situation

HELD_UP = 0.02  # m/s: if the ego is at most this much faster than its rule allows behind a leader, that one limits it
ALONG = 0.9  # rad: a vehicle at a larger angle to the ego's path crosses, and is no leader
BRAKES = -0.3  # m/s2: if an ego brakes harder than this after it was held up, the reason is another one
FAR = 1e6  # m: the place of absent vehicles
IN_SIGHT = 100.0  # m
LATE = 0.05  # m behind its unattacked place, from which on a vehicle counts as disturbed
NOTICED = 0.005  # m/s below the unattacked speed after a step, from which on a vehicle no longer moves as unattacked
JAM = 60.0 / 3.6  # m/s: slower drivers overtake on the right (SUMO's ``congested``)


class Leaders:
    """Leaders of ``n`` egos against adversaries with names and lengths [m], ``(N,)``: one each, or the first ones of
    all egos, then their second ones. They drive as Krauss's drivers."""

    def __init__(self, scenes: Scenes, names: Sequence[str], length: Floats, driver: CarFollowing) -> None:
        """``driver``: the car following of the ego."""
        n = len(scenes.of)
        keys = [(id(s), tuple(names[k::n])) for k, s in enumerate(scenes.of)]
        first = {key: k for k, key in reversed(list(enumerate(keys)))}
        group = {key: g for g, key in enumerate(first)}
        self._group = np.array([group[key] for key in keys], np.intp)  # same situation and adversaries
        self._ego_half, self._ego_driver, self._dt = scenes.ego.length / 2, driver, scenes.dt
        self._driver = CarFollowing(DEFAULT_DRIVER, scenes.dt)
        cases = [(scenes.of[k], names[k::n]) for k in first.values()]
        held_up = [np.any([_held_up_by(s, name, driver) for name in those], axis=0) for s, those in cases]
        self._held_up = [
            (np.flatnonzero(self._group == g), s.baseline.s, held)
            for g, ((s, _), held) in enumerate(zip(cases, held_up, strict=True))
            if held.any()
        ]
        others = [[o for o in s.traffic.ahead if o.id not in those] for s, those in cases]
        steps, count = max(len(s.baseline.s) for s, _ in cases), max(map(len, others))
        self._unattacked = np.full((3, len(cases), count, steps), FAR)  # station, offset, speed
        lengths = np.zeros((len(cases), count))
        for g in range(len(cases)):
            for m, vehicle in enumerate(others[g]):
                values = np.stack([vehicle.s, vehicle.d, vehicle.speed])
                present = np.isfinite(vehicle.s) & (np.abs(vehicle.heading) < ALONG)
                self._unattacked[:, g, m, : len(vehicle.s)] = np.where(present, values, FAR)
                lengths[g, m] = vehicle.length
        self._adversary_half, self._half = length / 2, lengths[self._group] / 2
        self._lane = scenes.each(lambda s: s.road.lane_width)[:, None]
        self._react = scenes.each(lambda s: float(s.traffic.reacting))[:, None] > 0.0
        self._lag, self._v = np.zeros((2, len(keys), count))  # m behind the unattacked motion, and speeds with a lag
        speeds = np.where(self._unattacked[2] < FAR, self._unattacked[2], 0.0)
        self._top_speed = speeds.max(axis=2, initial=0.0)[self._group]
        self._ignores_lane_rules = scenes.driver.ignores_sumo_lane_rules

    def held_up(self, station: Floats) -> Bools:
        """Whether the adversary held the unattacked ego up at stations ``(n,)`` [m]."""
        at_station = np.zeros(len(station), bool)
        for rows, stations, held in self._held_up:
            k = np.searchsorted(stations, station[rows], side="right") - 1
            at_station[rows] = held[np.clip(k, 0, len(held) - 1)]
        return at_station

    def step(self, now: float, adversary: Floats, front_d: Floats, speed: Floats) -> None:
        """Advance the leaders by a step.

        adversary: stations of the adversaries [m]; front_d: offsets of their fronts [m]; speed [m/s]; all ``(N,)``.
        """
        if not self._lag.shape[1]:
            return
        dt = self._dt
        unattacked, d, pace = self._unattacked_at(now)
        s, v = unattacked - self._lag, np.where(self._lag > 0.0, self._v, pace)
        bound, n = np.full(s.shape, np.inf), len(s)
        for k in range(0, len(adversary), n):  # the first adversaries, then the second ones
            place, half = (adversary[k : k + n], front_d[k : k + n]), self._adversary_half[k : k + n]
            bound = np.minimum(bound, self._behind(s, d, v, (*place, speed[k : k + n], half)))
        for k in np.flatnonzero(self._lag.any(axis=0)).tolist():
            lagging = np.where(self._lag[:, k] > 0.0, s[:, k], -FAR)
            bound = np.minimum(bound, self._behind(s, d, v, (lagging, d[:, k], v[:, k], self._half[:, k])))
        next_s, _, next_v = self._unattacked_at(now + dt)
        disturbed = (self._lag > 0.0) | (bound < next_v - NOTICED)
        if not disturbed.any():
            return
        free = np.minimum(v + self._driver.acceleration * dt, self._top_speed)
        v = np.maximum(np.minimum(bound, free), v - EMERGENCY * dt)
        self._lag = np.where(disturbed, np.maximum(next_s - s - v * dt, 0.0), 0.0)
        self._v = np.maximum(v, 0.0)

    def bound(self, now: float, s: Floats, v: Floats, disturbed: Bools) -> Floats:
        """The highest speed [m/s] of egos at stations ``s`` with speeds ``v`` behind the nearest leader; inf without.

        Leaders with unattacked motion count only for ``disturbed`` egos. All are ``(n,)``.
        """
        if not self._lag.shape[1] or not (disturbed.any() or self._lag.any()):
            return np.full(len(s), np.inf)
        unattacked, d, pace = self._unattacked_at(now)
        counts = disturbed[:, None] | (self._lag > LATE)
        centre = unattacked - self._lag
        ahead = counts & (centre > s[:, None]) & (centre < s[:, None] + FAR / 2)
        speed = np.where(self._lag > 0.0, self._v, pace)
        gap = centre - self._half - s[:, None] - self._ego_half
        inside = ahead & (np.abs(d) < self._lane / 2)
        bound = _behind_nearest(v, np.where(inside, gap, np.inf), speed, self._ego_driver.behind)
        left = ahead & (d >= self._lane / 2) & (d < 1.5 * self._lane) & (self._lag > LATE)
        if self._ignores_lane_rules or not left.any():
            return bound
        left_bound = _behind_nearest(v, np.where(left, gap, np.inf), speed, self._ego_driver.staying_behind)
        return np.where(v > JAM, np.minimum(bound, left_bound), bound)

    def _behind(self, s: Floats, d: Floats, v: Floats, vehicle: tuple[Floats, Floats, Floats, Floats]) -> Floats:
        """The highest speeds [m/s] of leaders behind a vehicle in their lane or in the lane to the left, ``(n, m)``.

        vehicle: station, offset, speed, half its length, each ``(n,)``.
        """
        station, offset, speed, half = (q[:, None] for q in vehicle)
        away, across = station - s, offset - d
        near = (away > 0.0) & (away < IN_SIGHT) & self._react
        follows = near & (np.abs(across) < self._lane / 2)
        left = near & (across >= self._lane / 2) & (across < 1.5 * self._lane) & (v > JAM)
        if not (follows | left).any():
            return np.full(s.shape, np.inf)
        gap = np.where(near, away - half - self._half, IN_SIGHT)
        speed = np.broadcast_to(speed, gap.shape)
        bound = np.where(follows, self._driver.behind(v, gap, speed), np.inf)
        return np.where(left, self._driver.staying_behind(v, gap, speed), bound) if left.any() else bound

    def _unattacked_at(self, now: float) -> Floats:
        """Station, offset, speed of the unattacked vehicles, ``(3, n, m)``."""
        k = min(round(now / self._dt), self._unattacked.shape[3] - 1)
        return self._unattacked[:, :, :, k][:, self._group]


def _behind_nearest(
    v: Floats, gap: Floats, speed: Floats, follow: Callable[[Floats, Floats, Floats], Floats]
) -> Floats:
    """``follow`` behind the nearest vehicles, by gaps [m] and speeds ``(n, m)``; inf where all gaps are."""
    nearest, rows = gap.argmin(axis=1), np.arange(len(v))
    gap, speed = gap[rows, nearest], speed[rows, nearest]
    exists = np.isfinite(gap)
    return np.where(exists, follow(v, np.where(exists, gap, 1e3), np.where(exists, speed, 0.0)), np.inf)


def _held_up_by(situation: Situation, name: str, driver: CarFollowing) -> Bools:
    """By step of the profile: whether this vehicle limits the speed of the unattacked ego, or has done so until now.

    Always False if the driver's car following is not known exactly.
    """
    s, v = situation.baseline.s, situation.baseline.v
    held = np.zeros(len(s), bool)
    leader = next((o for o in situation.traffic.ahead if o.id == name), None)
    model = situation.baseline.model
    if leader is None or len(s) < 2 or not exact(model):
        return held
    d, half_lane = leader.d[:-1], situation.road.lane_width / 2
    along = (leader.s[:-1] > s[:-1]) & (np.abs(leader.heading[:-1]) < ALONG)
    left = along & (d >= half_lane) & (d < 3 * half_lane) & (not model.ignores_sumo_lane_rules)
    follows = along & ((np.abs(d) < half_lane) | (left & (v[:-1] > JAM)))
    if not follows.any():
        return held
    gap = np.where(follows, leader.s[:-1] - s[:-1] - (leader.length + situation.ego.length) / 2, 1e3)
    behind = driver.behind(v[:-1], gap, np.where(follows, leader.speed[:-1], 0.0))
    held[:-1] = follows & (behind <= v[1:] + HELD_UP)
    easy = situation.baseline.a > BRAKES
    easy[:-1] |= left  # around ``JAM`` the ego brakes and accelerates in turns
    for k in np.flatnonzero(held[:-1]).tolist():
        while k + 1 < len(held) and not held[k + 1] and easy[k + 1]:
            k += 1
            held[k] = True
    return held
