"""Candidate motions in the frame of the path, all at once.

Sideways: quintic polynomials from the present offset, its rate and its second derivative to an offset that is then kept
(Werling et al. 2010, "Optimal trajectory generation for dynamic street scenarios in a Frenet frame").  Along: the
reference (the driver's following, see ``lattice.py``), and accelerations that are ramped to and held, to standstill or
to the wanted speed; quartics towards a speed, as in the paper, would be too slow in an emergency.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.geometry import quintics

DURATIONS = (1.2, 2.0, 3.0)  # s, of a move sideways
STEPS_ASIDE = (-1.5, -1.0, -0.5, 0.5, 1.0, 1.5)  # m from the lane's centre
BRAKES = (2.0, 4.0)  # m/s2: comfortable, hard; the emergency brake is a setting
RAMP = 20.0  # m/s3, how fast pedals act


@dataclass(frozen=True, slots=True)
class Along:
    """Candidates along, the reference first: station s [m], speed v [m/s], acceleration a [m/s2]; ``(n, time)``."""

    s: Floats
    v: Floats
    a: Floats


@dataclass(frozen=True, slots=True)
class Aside:
    """Lateral candidates: offset d [m], its rate and second derivative by time, each ``(n, time)``.

    target [m] and duration [s] are ``(n,)``; jerk: integral of the third derivative's square [m2/s5], ``(n,)``.
    """

    d: Floats
    rate: Floats
    second: Floats
    target: Floats
    duration: Floats
    jerk: Floats


def along(
    s: float, v: float, a: float, reference: Floats, wanted: float, acceleration: float, emergency: float,
    times: Floats,
) -> Along:  # fmt: skip
    """The reference ``(time,)`` [m/s2], keep, accelerate to ``wanted`` [m/s], and three brakes, from (s, v, a)."""
    aims = np.array([0.0, acceleration if v < wanted else 0.0, *(-b for b in BRAKES), -emergency])
    ramped = a + np.clip(aims[:, None] - a, -RAMP * times, RAMP * times)
    pedals = np.vstack([reference, ramped])
    dt = np.diff(times, prepend=0.0)
    change = np.cumsum((pedals + np.roll(pedals, 1, axis=1)) / 2 * dt, axis=1)
    speed = np.maximum(v + change, 0.0)
    speed[2] = np.minimum(speed[2], max(wanted, v))
    way = np.cumsum((speed + np.roll(speed, 1, axis=1)) / 2 * dt, axis=1)
    return Along(s + way, speed, pedals)


def aside(state: tuple[float, float, float], offsets: Floats, kept: tuple[float, float] | None, times: Floats) -> Aside:
    """Quintics from ``state`` (offset, rate, second derivative) to each of ``offsets`` in each of ``DURATIONS``.

    ``kept``: target and what is left of the duration of the move under way, which is then a candidate too.
    """
    target, duration = np.repeat(offsets, len(DURATIONS)), np.tile(DURATIONS, len(offsets))
    if kept is not None:
        target, duration = np.append(target, kept[0]), np.append(duration, max(kept[1], 0.5))
    d, rate, second, jerk = quintics(state, target, duration, times)
    return Aside(d, rate, second, target, duration, jerk)


def offsets_in(room: tuple[float, float], width: float, sides: tuple[float, ...]) -> Floats:
    """Where the ego may go: the lane's centre, steps aside that stay within ``room`` (right, left) [m], and the
    centres of ``sides``. ``width``: the ego's [m]."""
    right, left = room
    steps = [d for d in STEPS_ASIDE if right + width / 2 <= d <= left - width / 2]
    return np.array([0.0, *steps, *sides])
