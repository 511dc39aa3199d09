"""The careful driver as it is predicted: many of them at once, in the frame of the ego's path.

The rules are those of the reference driver ``cc_human``, for the adversary alone.  There the path is the recorded one
and boxes stand in the world; here stations and offsets stand for both, which is the same on a straight road and nearly
so on a bend.  What the driver saw before the attack began is left out.
"""

from __future__ import annotations

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.metrics.reference.cc_human import PERCEPTION, CcHuman
from sumo_adv.metrics.reference.cc_human import REACTION as DECISION
from sumo_adv.metrics.reference.view import HISTORY, View

REACTION = PERCEPTION + DECISION  # s until the driver brakes
HALF_LANE = 1.6  # m


class CarefulDrivers:
    """One careful driver against each adversary of a length and width [m], ``(n,)``; ``ego``: length and width [m];
    ``reaction``: s until it brakes."""

    def __init__(
        self, ego: tuple[float, float], length: Floats, width: Floats, dt: float, reaction: float = REACTION
    ) -> None:
        self._ego, self._length, self._width, self._dt = ego, length[:, None], width[:, None], dt
        self._history = max(1, round(HISTORY / dt))
        self._seen: list[tuple[Floats, Floats, Floats]] = []  # offset, heading, speed of the last steps
        self._drivers = CcHuman((len(length), 1), dt, max(reaction - PERCEPTION, 0.0))

    @property
    def alarmed(self) -> Bools:
        """Whether the adversary is a danger now, ``(n,)``."""
        return np.asarray(self._drivers.danger[:, 0])

    def bound(
        self, now: float, ego: tuple[Floats, Floats, Floats], adversary: tuple[Floats, Floats, Floats], speed: Floats
    ) -> Floats:
        """The speed [m/s] that the drivers brake to within this step, inf where they do not brake.

        ego: station, speed, acceleration; adversary: station, offset, heading (ego path's frame, box centres)."""
        asked = self._drivers.step(self._view(ego, adversary, speed))
        return np.where(np.isnan(asked), np.inf, np.maximum(ego[1] + np.nan_to_num(asked) * self._dt, 0.0))

    def _view(
        self, ego: tuple[Floats, Floats, Floats], adversary: tuple[Floats, Floats, Floats], speed: Floats
    ) -> View:
        at, v, a = (q[:, None] for q in ego)
        s, d, h = (q[:, None] for q in adversary)
        w = speed[:, None]
        cos, sin = np.abs(np.cos(h)), np.abs(np.sin(h))
        along, across = (cos * self._length + sin * self._width) / 2, (sin * self._length + cos * self._width) / 2
        side = np.copysign(1.0, d)
        before, _, slower = self._seen[-1] if self._seen else (d, h, w)
        first = self._seen[0][1] if self._seen else h
        turned = np.remainder(h - first + np.pi, 2 * np.pi) - np.pi
        span = max(len(self._seen), 1) * self._dt
        self._seen = [*self._seen, (d, h, w)][-self._history :]
        near_edge = np.abs(d) - across
        return View(
            s > at, s - at, d, h, np.abs(s - at) - along - self._ego[0] / 2, near_edge - self._ego[1] / 2, near_edge,
            w, w * np.cos(h), -side * (d - before) / self._dt, -side * w * np.sin(h), (w - slower) / self._dt,
            turned / span, self._length, self._width, v, a, self._ego[0], self._ego[1], HALF_LANE,
        )  # fmt: skip
