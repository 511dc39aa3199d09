"""Whom an ego follows besides the adversary: vehicles that are ahead of it in its lane, where they are unattacked or,
if the adversary is before them, behind that.

And where the adversary itself held the unattacked ego up: what the ego did there is no limit of its own, and one whose
leader hurries on or leaves goes faster.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.drivers.car_following import DEFAULT_DRIVER, EMERGENCY, CarFollowing, exact
from sumo_adv.drivers.scenes import Scenes
from sumo_adv.situation import Situation

HELD = 0.02  # m/s: so near to what it would drive behind the other, the other is why
ALONG = 0.9  # rad: a vehicle at more of an angle crosses, and is no leader
BRAKES = -0.3  # m/s2: an ego that was held up and brakes harder does so for something else
FAR = 1e6  # m: where those are who are not there
IN_SIGHT = 100.0  # m
LATE = 0.05  # m behind where it would be unattacked
NOTICED = 0.005  # m/s: so much slower than unattacked within a step its driver drives it, no longer its profile
JAM = 60.0 / 3.6  # m/s: slower drivers pass on the right (SUMO's ``congested``)


class Leaders:
    """For egos against adversaries of these names and lengths [m], ``(n,)``; others brake for the adversary as Krauss's
    drivers do, and so do those behind them."""

    def __init__(self, scenes: Scenes, names: Sequence[str], length: Floats, driver: CarFollowing) -> None:
        keys = [(id(s), name) for s, name in zip(scenes.of, names, strict=True)]
        first = {key: k for k, key in reversed(list(enumerate(keys)))}
        group = {key: g for g, key in enumerate(first)}
        self._row = np.array([group[key] for key in keys], np.intp)
        self._mine, self._driver, self._dt = scenes.ego.length / 2, driver, scenes.dt
        self._theirs = CarFollowing(DEFAULT_DRIVER, scenes.dt)
        cases = [(scenes.of[k], names[k]) for k in first.values()]
        held = [_held_by(s, name, driver) for s, name in cases]
        self._held = [
            (np.flatnonzero(self._row == g), s.profile_s, h)
            for g, ((s, _), h) in enumerate(zip(cases, held, strict=True))
            if h.any()
        ]
        others = [[o for o in s.ahead if o.id != name] for s, name in cases]
        steps, most = max(len(s.profile_s) for s, _ in cases), max(map(len, others))
        self._unattacked = np.full((3, len(cases), most, steps), FAR)  # station, offset, speed
        lengths = np.zeros((len(cases), most))
        for g in range(len(cases)):
            for m, other in enumerate(others[g]):
                values = np.stack([other.s, other.d, other.speed])
                there = np.isfinite(other.s) & (np.abs(other.heading) < ALONG)
                self._unattacked[:, g, m, : len(other.s)] = np.where(there, values, FAR)
                lengths[g, m] = other.length
        self._length, self._half = length / 2, lengths[self._row] / 2
        self._lane = scenes.each(lambda s: s.lane_width)[:, None]
        self._react = scenes.each(lambda s: float(s.reacting))[:, None] > 0.0
        self._late, self._v = np.zeros((2, len(keys), most))  # metres that they are behind, and speeds where they are
        known = np.where(self._unattacked[2] < FAR, self._unattacked[2], 0.0)
        self._fastest = known.max(axis=2, initial=0.0)[self._row]
        self._passes_right = scenes.driver.ignores_sumo_lane_rules

    def held(self, station: Floats) -> Bools:
        """Whether the adversary held the unattacked ego up at stations ``(n,)``."""
        found = np.zeros(len(station), bool)
        for rows, stations, held in self._held:
            k = np.searchsorted(stations, station[rows], side="right") - 1
            found[rows] = held[np.clip(k, 0, len(held) - 1)]
        return found

    def step(self, now: float, adversary: Floats, front_d: Floats, speed: Floats) -> None:
        """The others a step on: adversaries at stations, their fronts at offsets [m], at speeds [m/s], ``(n,)``."""
        if not self._late.shape[1]:
            return
        dt = self._dt
        unattacked, d, pace = self._at(now)
        s, v = unattacked - self._late, np.where(self._late > 0.0, self._v, pace)
        bound = self._behind(s, d, v, (adversary, front_d, speed, self._length))
        for k in np.flatnonzero(self._late.any(axis=0)).tolist():
            late = np.where(self._late[:, k] > 0.0, s[:, k], -FAR)
            bound = np.minimum(bound, self._behind(s, d, v, (late, d[:, k], v[:, k], self._half[:, k])))
        next_s, _, next_v = self._at(now + dt)
        held = (self._late > 0.0) | (bound < next_v - NOTICED)
        if not held.any():
            return
        free = np.minimum(v + self._theirs.acceleration * dt, self._fastest)
        v = np.maximum(np.minimum(bound, free), v - EMERGENCY * dt)
        self._late = np.where(held, np.maximum(next_s - s - v * dt, 0.0), 0.0)
        self._v = np.maximum(v, 0.0)

    def bound(self, now: float, s: Floats, v: Floats, disturbed: Bools) -> Floats:
        """The speed [m/s] behind the nearest other ahead, inf where there is none; egos at ``s`` with ``v``. Those who
        drive as unattacked count for ``disturbed`` egos alone."""
        if not self._late.shape[1] or not (disturbed.any() or self._late.any()):
            return np.full(len(s), np.inf)
        unattacked, d, pace = self._at(now)
        counts = disturbed[:, None] | (self._late > LATE)
        centre = unattacked - self._late
        ahead = counts & (centre > s[:, None]) & (centre < s[:, None] + FAR / 2)
        speed = np.where(self._late > 0.0, self._v, pace)
        gap = centre - self._half - s[:, None] - self._mine
        inside = ahead & (np.abs(d) < self._lane / 2)
        found = _nearest(v, np.where(inside, gap, np.inf), speed, self._driver.behind)
        left = ahead & (d >= self._lane / 2) & (d < 1.5 * self._lane) & (self._late > LATE)
        if self._passes_right or not left.any():
            return found
        rule = _nearest(v, np.where(left, gap, np.inf), speed, self._driver.staying_behind)
        return np.where(v > JAM, np.minimum(found, rule), found)

    def _behind(self, s: Floats, d: Floats, v: Floats, one: tuple[Floats, Floats, Floats, Floats]) -> Floats:
        """The speeds [m/s] of the others, ``(n, m)``, for ``one``: station, offset, speed, half its length, ``(n,)``,
        whom they follow in their lane, and do not overtake on the right."""
        at, aside, speed, half = (q[:, None] for q in one)
        before, across = at - s, aside - d
        near = (before > 0.0) & (before < IN_SIGHT) & self._react
        follows = near & (np.abs(across) < self._lane / 2)
        left = near & (across >= self._lane / 2) & (across < 1.5 * self._lane) & (v > JAM)
        if not (follows | left).any():
            return np.full(s.shape, np.inf)
        gap = np.where(near, before - half - self._half, IN_SIGHT)
        speed = np.broadcast_to(speed, gap.shape)
        found = np.where(follows, self._theirs.behind(v, gap, speed), np.inf)
        return np.where(left, self._theirs.staying_behind(v, gap, speed), found) if left.any() else found

    def _at(self, now: float) -> Floats:
        """Station, offset, speed of the unattacked others, ``(3, n, m)``."""
        k = min(round(now / self._dt), self._unattacked.shape[3] - 1)
        return self._unattacked[:, :, :, k][:, self._row]


def _nearest(v: Floats, gap: Floats, speed: Floats, follow: Callable[[Floats, Floats, Floats], Floats]) -> Floats:
    """The speeds [m/s] behind the nearest ones, by their gaps [m] and speeds, ``(n, m)``; inf where all gaps are."""
    nearest, rows = gap.argmin(axis=1), np.arange(len(v))
    gap, speed = gap[rows, nearest], speed[rows, nearest]
    there = np.isfinite(gap)
    return np.where(there, follow(v, np.where(there, gap, 1e3), np.where(there, speed, 0.0)), np.inf)


def _held_by(situation: Situation, name: str, driver: CarFollowing) -> Bools:
    """By step of the profile, whether this vehicle is why the unattacked ego goes no faster, or was until now; never
    where the driver's following is not known exactly."""
    s, v = situation.profile_s, situation.profile_v
    found = np.zeros(len(s), bool)
    other = next((o for o in situation.ahead if o.id == name), None)
    model = situation.ego_model
    if other is None or len(s) < 2 or not exact(model):
        return found
    d, half = other.d[:-1], situation.lane_width / 2
    follows = np.abs(d) < half
    along = (other.s[:-1] > s[:-1]) & (np.abs(other.heading[:-1]) < ALONG)
    left = along & (d >= half) & (d < 3 * half) & (not model.ignores_sumo_lane_rules)
    follows = along & (follows | (left & (v[:-1] > JAM)))
    if not follows.any():
        return found
    gap = np.where(follows, other.s[:-1] - s[:-1] - (other.length + situation.ego.length) / 2, 1e3)
    behind = driver.behind(v[:-1], gap, np.where(follows, other.speed[:-1], 0.0))
    found[:-1] = follows & (behind <= v[1:] + HELD)
    easy = situation.profile_a > BRAKES
    easy[:-1] |= left  # at ``JAM`` it brakes and speeds up in turns
    for k in np.flatnonzero(found[:-1]).tolist():
        while k + 1 < len(found) and not found[k + 1] and easy[k + 1]:
            k += 1
            found[k] = True
    return found
