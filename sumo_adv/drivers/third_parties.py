"""Third parties as they are foreseen: along their own unattacked motion, and braking for the adversary.

A driver of SUMO's who gets the adversary before it in its lane follows it by Krauss's safe speed (SUMO's default
driver; Krauß 1998), and brakes with ``EMERGENCY`` where that is what it takes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sumo_adv.datatypes import Bools, Boxes, Floats
from sumo_adv.drivers.car_following import DEFAULT_DRIVER, EMERGENCY, CarFollowing
from sumo_adv.drivers.prediction import ACROSS
from sumo_adv.geometry import wrap_all

COARSE = 6  # steps: the nearest place on a way is looked for among every so many, then between these
SLOWER = 0.05  # m/s less than unattacked: from then on it follows


def braking(others: Boxes, adversary: Boxes, lane_width: float, dt: float) -> Boxes:
    """Each other vehicle's motion where it brakes for the adversary.

    others, adversary: ``(n, T)`` and ``(n, t)`` states a step ``dt`` [s] apart from one moment on, t at most T, row by
    row, sizes ``(n, 1)``; the others' motion is the unattacked one, NaN where one is not there.  ``lane_width`` [m]:
    the adversary is before one whose lane its front's centre is in.  Returned: ``(n, t)``, along the same ways and
    never further on.
    """
    x, y, heading, there = _filled(others)
    step = np.hypot(np.diff(x, axis=1), np.diff(y, axis=1))
    way = np.concatenate([np.zeros((len(x), 1)), np.cumsum(step, axis=1)], axis=1)
    s, d, turned = _beside(adversary, x, y, heading, way)
    half = np.asarray(adversary.length) / 2
    front_s, front_d = s + half * np.cos(turned), d + half * np.sin(turned)
    across = (np.abs(turned) > ACROSS[0]) & (np.abs(turned) < ACROSS[1])
    before = (np.abs(front_d) < lane_width / 2) & ~across
    room = half[:, 0] + np.broadcast_to(np.asarray(others.length), way.shape)[:, 0] / 2
    at = _followed(way, s, front_s, before, adversary.speed, room, dt)
    turns, ways = np.unwrap(heading, axis=1), way + 1e-9 * np.arange(way.shape[1])  # also where one stands
    found = np.empty((3, *at.shape))
    for k in range(len(way)):
        found[:, k] = [np.interp(at[k], ways[k], q[k]) for q in (x, y, turns)]
    found[0][~there[:, : at.shape[1]]] = np.nan
    return Boxes(found[0], found[1], found[2], np.gradient(at, dt, axis=1), others.length, others.width)


def _filled(b: Boxes) -> tuple[Floats, Floats, Floats, Bools]:
    """x, y, heading with the first and last state kept before and after a vehicle is there, and where it is."""
    there = np.isfinite(b.x)
    first, last = there.argmax(axis=1), there.shape[1] - 1 - there[:, ::-1].argmax(axis=1)
    k = np.clip(np.arange(there.shape[1])[None, :], first[:, None], last[:, None])
    rows = np.arange(len(k))[:, None]
    return b.x[rows, k], b.y[rows, k], b.heading[rows, k], there


def _beside(adversary: Boxes, x: Floats, y: Floats, heading: Floats, way: Floats) -> tuple[Floats, Floats, Floats]:
    """Station, offset and heading of the adversary at each step along the ways, ``(n, t)``."""
    rows = np.arange(len(x))[:, None]
    i = _nearest(adversary, x[:, None, ::COARSE], y[:, None, ::COARSE]) * COARSE
    near = np.clip(i[:, :, None] + np.arange(1 - COARSE, COARSE), 0, x.shape[1] - 1)
    k = _nearest(adversary, x[rows[:, :, None], near], y[rows[:, :, None], near])
    i = np.take_along_axis(near, k[:, :, None], axis=2)[:, :, 0]
    dx, dy, h = adversary.x - x[rows, i], adversary.y - y[rows, i], heading[rows, i]
    c, s = np.cos(h), np.sin(h)
    return way[rows, i] + c * dx + s * dy, c * dy - s * dx, wrap_all(adversary.heading - h)


def _nearest(adversary: Boxes, x: Floats, y: Floats) -> Any:
    """Which of the places along the last axis is nearest to the adversary, ``(n, t)``."""
    dx, dy = adversary.x[:, :, None] - x, adversary.y[:, :, None] - y
    return np.argmin(dx * dx + dy * dy, axis=2)


def _followed(way: Floats, s: Floats, front_s: Floats, before: Bools, speed: Floats, room: Floats, dt: float) -> Floats:
    """Stations ``(n, t)`` of drivers that follow the adversary once it is before them."""
    driver = CarFollowing(DEFAULT_DRIVER, dt)
    unattacked = np.diff(way, axis=1) / dt
    at = way[:, : s.shape[1]].copy()
    comes = (before & (front_s > at)).any(axis=0)
    if not comes.any():
        return at
    first = int(comes.argmax())  # until then all go as unattacked
    v, brakes = np.maximum(unattacked[:, max(first - 1, 0)], 0.0), np.zeros(len(way), bool)
    for k in range(first, at.shape[1] - 1):
        leads = before[:, k] & (front_s[:, k] > at[:, k])
        bound = np.where(leads, driver.behind(v, s[:, k] - at[:, k] - room, speed[:, k]), np.inf)
        brakes |= bound < unattacked[:, k] - SLOWER
        free = np.minimum(driver.free(v), np.maximum(unattacked[:, k], v))
        v = np.where(brakes, np.maximum(np.minimum(free, bound), v - EMERGENCY * dt), unattacked[:, k])
        v = np.maximum(v, 0.0)
        at[:, k + 1] = np.minimum(np.where(brakes, at[:, k] + v * dt, way[:, k + 1]), way[:, -1])
    return at
