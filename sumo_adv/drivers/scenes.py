"""The situations of many adversaries, row by row, as arrays.

Attacks that begin at different moments of one encounter are predicted together. Each moment has its own frame, path,
lane and unattacked ego.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.geometry import Paths, wrap
from sumo_adv.situation import Situation


class Scenes:
    """A situation for each of ``n`` adversaries. All are of one encounter: ego, driver and step are the same."""

    def __init__(self, situations: Sequence[Situation]) -> None:
        self.of = list(situations)
        distinct = list({id(s): s for s in situations}.values())
        place = {id(s): k for k, s in enumerate(distinct)}
        self._distinct, self._row = distinct, np.array([place[id(s)] for s in situations], np.intp)
        self._rows = [np.flatnonzero(self._row == k) for k in range(len(distinct))]
        self._paths = Paths([s.baseline.path for s in distinct])
        frames = [s.frame for s in distinct]
        self._frame = np.array(
            [(f.x, f.y, math.cos(f.heading), math.sin(f.heading), f.heading, f.hand) for f in frames]
        )
        self._profiles = [(s.baseline.s.tolist(), s.baseline.v.tolist()) for s in distinct]
        self.dt, self.ego, self.driver = distinct[0].dt, distinct[0].ego, distinct[0].baseline.model

    def each(self, value: Callable[[Situation], float]) -> Floats:
        """``value(situation)`` for each adversary, ``(n,)``."""
        return np.array([value(s) for s in self._distinct], float)[self._row]

    def profile(self, time: Floats) -> tuple[Floats, Floats]:
        """Stations [m] and speeds [m/s] of the unattacked egos ``time`` (k,) s after their triggers, ``(n, k)``."""
        profiles = [profile_at(s, time) for s in self._distinct]
        return np.stack([s for s, _ in profiles])[self._row], np.stack([v for _, v in profiles])[self._row]

    def profile_now(self, time: float) -> tuple[Floats, Floats]:
        """The same at one time, ``(n,)``."""
        profiles = np.array([_profile_at_once(s, v, time, self.dt) for s, v in self._profiles])[self._row]
        return profiles[:, 0], profiles[:, 1]

    def pace(self, station: Floats) -> Floats:
        """The unattacked egos' speeds [m/s] at stations (n,)."""
        speed = np.empty(len(station))
        for situation, rows in zip(self._distinct, self._rows, strict=True):
            speed[rows] = np.interp(station[rows], situation.baseline.s, situation.baseline.v)
        return speed

    def ego_at(self, s: Floats, d: Floats | float = 0.0) -> tuple[Floats, Floats, Floats]:
        """x, y, heading at stations and offsets [m] of the egos' paths, ``(n,)`` or ``(n, k)``."""
        return self._paths.at(_fit(self._row, s), s, d)

    def to_local(self, x: Floats, y: Floats, heading: Floats) -> tuple[Floats, Floats, Floats]:
        """World poses, ``(n,)`` or ``(n, k)``, in the frames of the egos at their triggers."""
        x0, y0, c, s, h, hand = (_fit(q, x) for q in self._frame[self._row].T)
        dx, dy = x - x0, y - y0
        return c * dx + s * dy, hand * (-s * dx + c * dy), hand * wrap(heading - h)


def _fit(values: Any, like: Floats) -> Any:
    """Values of the rows ``(n,)`` in a shape that broadcasts with ``(n,)`` or ``(n, k)``."""
    return values if np.ndim(like) == 1 else values[:, None]


def profile_at(situation: Situation, time: Floats) -> tuple[Floats, Floats]:
    """Station [m] and speed [m/s] of the unattacked ego ``time`` s after the trigger; constant speed past the end."""
    s, v = situation.baseline.s, situation.baseline.v
    last = len(s) - 1
    u = np.minimum(np.maximum(time / situation.dt, 0.0), last)
    i = np.minimum(u.astype(np.intp), last - 1)
    w = u - i
    beyond = np.maximum(time - last * situation.dt, 0.0)
    return s[i] * (1 - w) + s[i + 1] * w + beyond * v[-1], v[i] * (1 - w) + v[i + 1] * w


def _profile_at_once(s: Sequence[float], v: Sequence[float], time: float, dt: float) -> tuple[float, float]:
    """``profile_at`` for one time, in plain floats because numpy is slow on scalars."""
    last = len(s) - 1
    u = min(max(time / dt, 0.0), last)
    i = min(int(u), last - 1)
    w = u - i
    beyond = max(time - last * dt, 0.0)
    return s[i] * (1 - w) + s[i + 1] * w + beyond * v[-1], v[i] * (1 - w) + v[i + 1] * w
