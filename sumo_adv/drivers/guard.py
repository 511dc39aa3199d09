"""An emergency brake as many stacks have one: it looks at the time to collision in two dimensions.

The ego is expected to go on along its path, another vehicle straight on, both at their speeds. If their boxes, made
larger by a margin, overlap within ``ttc`` seconds, and have done so for the reaction time, the ego brakes. It goes on
braking until no such overlap was expected for ``CALM``, or until it stands.
"""

from __future__ import annotations

import numpy as np

from sumo_adv.datatypes import Bools, Floats, Guard

STEP = 0.25  # s between the moments that are looked at
MARGIN = 0.3  # m to each side
CALM = 1.0  # s


class Guards:
    """One guard in each of N egos, which watches one adversary of a length and width [m], ``(N,)``."""

    def __init__(self, guard: Guard, ego: tuple[float, float], length: Floats, width: Floats, dt: float) -> None:
        """``ego``: length and width [m]."""
        self._guard, self._ego, self._length, self._width, self._dt = guard, ego, length, width, dt
        self._for, self._calm = np.zeros(len(length)), np.full(len(length), np.inf)  # s of danger; s since the last
        self._times = np.arange(0.0, guard.ttc + STEP / 2, STEP)[:, None]

    def bound(
        self, ego: tuple[Floats, Floats, Floats], adversary: tuple[Floats, Floats, Floats], speed: Floats
    ) -> Floats:
        """The speeds [m/s] to which the egos brake within this step, ``(N,)``; inf if they do not brake.

        ego: station, offset, speed. adversary: station, offset, heading of box centres in the frame of the ego's path;
        ``speed`` [m/s]. All are ``(N,)``.
        """
        dt, v = self._dt, ego[2]
        danger = self._danger(ego, adversary, speed)
        self._for = np.where(danger, self._for + dt, 0.0)
        acting = (self._calm < CALM - dt / 2) & (v > 0.0)
        begins = danger & (self._for > self._guard.reaction)
        self._calm = np.where(begins | (acting & danger), 0.0, self._calm + dt)
        return np.where(self._calm < CALM - dt / 2, np.maximum(v - self._guard.deceleration * dt, 0.0), np.inf)

    def _danger(
        self, ego: tuple[Floats, Floats, Floats], adversary: tuple[Floats, Floats, Floats], speed: Floats
    ) -> Bools:
        (s, d, h), (es, ed, ev), t = adversary, ego, self._times
        cos, sin = np.cos(h), np.sin(h)
        along = (np.abs(cos) * self._length + np.abs(sin) * self._width + self._ego[0]) / 2 + MARGIN
        across = (np.abs(sin) * self._length + np.abs(cos) * self._width + self._ego[1]) / 2 + MARGIN
        away = s - es + (speed * cos - ev) * t
        beside = d - ed + speed * sin * t
        from_behind = (s < es) & (cos > 0.0) & (np.abs(d - ed) < across)  # a follower in the lane has to look out
        return np.asarray(((np.abs(away) < along) & (np.abs(beside) < across)).any(axis=0) & ~from_behind)
