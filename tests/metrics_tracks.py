"""Tracks made by hand for the tests of metrics: a car of 5 x 2 m on a grid of 0.1 s."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sumo_adv.datatypes import Floats, Role, Track

DT = 0.1
TIME = np.round(np.arange(0.0, 12.0 + DT / 2, DT), 3)


def car(
    name: str, x: Floats | float, y: Floats | float, speed: Floats | float, heading: Floats | float = 0.0, *,
    time: Floats = TIME, length: float = 5.0, width: float = 2.0,
) -> Track:  # fmt: skip
    """A track from arrays or constants; acceleration is the difference of the speeds."""
    x, y, speed, heading = (np.array(np.broadcast_to(v, time.shape), dtype=float) for v in (x, y, speed, heading))
    acceleration = np.diff(speed, prepend=speed[0]) / DT
    role = Role(name) if name in {"ego", "adversary"} else Role.BACKGROUND
    return Track(name, role, time, x, y, heading, speed, acceleration, length, width)


def cruise(name: str, x0: float, y0: float, speed: float, heading: float = 0.0, **more: float) -> Track:
    """Constant speed along a straight line from (x0, y0) at time 0."""
    return car(
        name, x0 + speed * TIME * np.cos(heading), y0 + speed * TIME * np.sin(heading), speed, heading, **more
    )  # fmt: skip


def braking(name: str, x0: float, y0: float, speed: float, start: float, rate: float) -> Track:
    """Constant speed along +x, from ``start`` braking at ``rate`` to a stand."""
    since = np.clip(TIME - start, 0.0, speed / rate)
    x = x0 + speed * np.minimum(TIME, start) + speed * since - rate * since**2 / 2
    return car(name, x, y0, speed - rate * since)


def drift(
    name: str, x0: float, y0: float, speed: float, start: float, duration: float, to: float,
    along: Callable[[Floats], Floats] | None = None,
) -> Track:  # fmt: skip
    """Along +x at constant speed, moving sideways from y0 to ``to`` on a quintic from ``start`` on."""
    u = np.clip((TIME - start) / duration, 0.0, 1.0)
    y = y0 + (to - y0) * u**3 * (10 - 15 * u + 6 * u**2)
    x = x0 + speed * TIME if along is None else along(TIME)
    return car(name, x, y, speed, np.arctan2(np.gradient(y, TIME), speed))
