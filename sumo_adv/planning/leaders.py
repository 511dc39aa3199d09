"""Whom an ego follows besides the adversary: vehicles that are ahead of it in its lane, where they are unattacked.

And where the adversary itself held the unattacked ego up: what the ego did there is no limit of its own, and one whose
leader hurries on or leaves goes faster.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.planning.car_following import CarFollowing
from sumo_adv.planning.scenes import Scenes
from sumo_adv.situation import Situation

HELD = 0.02  # m/s: so near to what it would drive behind the other, the other is why
ALONG = 0.9  # rad: a vehicle at more of an angle crosses, and is no leader
BRAKES = -0.3  # m/s2: an ego that was held up and brakes harder does so for something else
EXACT = ("krauss", "idm", "careful")  # drivers whose following ``car_following.py`` has as SUMO has it
JAM = 60.0 / 3.6  # m/s: slower drivers pass on the right (SUMO's ``congested``)


class Leaders:
    """For egos against adversaries of these names, ``(n,)``."""

    def __init__(self, scenes: Scenes, names: Sequence[str], driver: CarFollowing) -> None:
        keys = [(id(s), name) for s, name in zip(scenes.of, names, strict=True)]
        first = {key: k for k, key in reversed(list(enumerate(keys)))}
        group = {key: g for g, key in enumerate(first)}
        self._row = np.array([group[key] for key in keys], np.intp)
        self._mine, self._driver = scenes.ego.length / 2, driver
        cases = [(scenes.of[k], names[k]) for k in first.values()]
        held = [_held_by(s, name, driver) for s, name in cases]
        self._held = [
            (np.flatnonzero(self._row == g), s.profile_s, h)
            for g, ((s, _), h) in enumerate(zip(cases, held, strict=True))
            if h.any()
        ]
        others = [[o for o in s.ahead if o.id != name] for s, name in cases]
        steps, most = max(len(s.profile_s) for s, _ in cases), max(map(len, others))
        self._others = np.full((3, len(cases), most, steps), np.inf)  # rear's station, centre's station, speed
        for g, (situation, _) in enumerate(cases):
            for m, other in enumerate(others[g]):
                inside = (np.abs(other.d) < situation.lane_width / 2) & (np.abs(other.heading) < ALONG)
                values = np.stack([other.s - other.length / 2, other.s, other.speed])
                self._others[:, g, m, : len(other.s)] = np.where(inside, values, np.inf)

    def held(self, station: Floats) -> Bools:
        """Whether the adversary held the unattacked ego up at stations ``(n,)``."""
        found = np.zeros(len(station), bool)
        for rows, stations, held in self._held:
            k = np.searchsorted(stations, station[rows], side="right") - 1
            found[rows] = held[np.clip(k, 0, len(held) - 1)]
        return found

    def bound(self, now: float, dt: float, s: Floats, v: Floats) -> Floats:
        """The speed [m/s] behind the nearest other ahead, inf where there is none; egos at ``s`` with ``v``."""
        if not self._others.shape[2]:
            return np.full(len(s), np.inf)
        k = min(round(now / dt), self._others.shape[3] - 1)
        rear, centre, speed = self._others[:, :, :, k][:, self._row]
        gap = np.where(centre > s[:, None], rear - s[:, None] - self._mine, np.inf)
        nearest = gap.argmin(axis=1)
        rows = np.arange(len(s))
        gap, speed = gap[rows, nearest], speed[rows, nearest]
        there = np.isfinite(gap)
        return np.where(there, self._driver.behind(v, np.where(there, gap, 1e3), np.where(there, speed, 0.0)), np.inf)


def _held_by(situation: Situation, name: str, driver: CarFollowing) -> Bools:
    """By step of the profile, whether this vehicle is why the unattacked ego goes no faster, or was until now; never
    where the driver's following is not known exactly."""
    s, v = situation.profile_s, situation.profile_v
    found = np.zeros(len(s), bool)
    other = next((o for o in situation.ahead if o.id == name), None)
    model = situation.ego_model
    if other is None or len(s) < 2 or model["kind"] not in EXACT or model.get("unknown", False):
        return found
    d, half = other.d[:-1], situation.lane_width / 2
    follows = np.abs(d) < half
    if not model.get("passes_right", False):
        follows |= (d >= half) & (d < 3 * half) & (v[:-1] > JAM)
    follows &= (other.s[:-1] > s[:-1]) & (np.abs(other.heading[:-1]) < ALONG)
    if not follows.any():
        return found
    gap = np.where(follows, other.s[:-1] - s[:-1] - (other.length + situation.ego.length) / 2, 1e3)
    behind = driver.behind(v[:-1], gap, np.where(follows, other.speed[:-1], 0.0))
    found[:-1] = follows & (behind <= v[1:] + HELD)
    easy = situation.profile_a > BRAKES
    for k in np.flatnonzero(found[:-1]).tolist():
        while k + 1 < len(found) and not found[k + 1] and easy[k + 1]:
            k += 1
            found[k] = True
    return found
