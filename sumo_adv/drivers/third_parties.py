"""Third parties as they are predicted: along their unattacked motion, but they brake for the adversary.

Once the adversary is ahead of a third party in its lane, the third party follows it as SUMO's default driver does
(Krauss's safe speed; Krauß 1998), and brakes with up to ``EMERGENCY``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sumo_adv.datatypes import Bools, Boxes, Floats
from sumo_adv.drivers.car_following import DEFAULT_DRIVER, EMERGENCY, CarFollowing
from sumo_adv.drivers.prediction import ACROSS
from sumo_adv.geometry import wrap

COARSE = 6  # steps between the samples of a motion that are compared first; then those around the best are
SLOWER = 0.05  # m/s below the unattacked speed, from which on the third party follows the adversary


def braking(others: Boxes, adversary: Boxes, lane_width: Floats | float, dt: float) -> Boxes:
    """The motion of each third party when it brakes for the adversary, ``(n, t)``.

    Third parties keep their ways, and are never ahead of their unattacked motion.

    others, adversary: ``(n, T)`` and ``(n, t)`` states at steps of ``dt`` [s] from the same moment, t <= T; sizes
    ``(n, 1)``. ``others``: the unattacked motion, NaN while a third party is absent. ``lane_width`` [m], one or
    ``(n, 1)``: the adversary is in the third party's lane if its front's centre is.
    """
    x, y, heading, present = _filled(others)
    step = np.hypot(np.diff(x, axis=1), np.diff(y, axis=1))
    way = np.concatenate([np.zeros((len(x), 1)), np.cumsum(step, axis=1)], axis=1)
    s, d, turned = _located(adversary, x, y, heading, way)
    half = np.asarray(adversary.length) / 2
    front_s, front_d = s + half * np.cos(turned), d + half * np.sin(turned)
    across = (np.abs(turned) > ACROSS[0]) & (np.abs(turned) < ACROSS[1])
    in_lane = (np.abs(front_d) < lane_width / 2) & ~across
    both_halves = half[:, 0] + np.broadcast_to(np.asarray(others.length), way.shape)[:, 0] / 2
    at = _followed(way, s, front_s, in_lane, adversary.speed, both_halves, dt)
    turns, ways = np.unwrap(heading, axis=1), way + 1e-9 * np.arange(way.shape[1])  # ascending also at standstill
    poses = np.empty((3, *at.shape))
    for k in range(len(way)):
        poses[:, k] = [np.interp(at[k], ways[k], q[k]) for q in (x, y, turns)]
    poses[0][~present[:, : at.shape[1]]] = np.nan
    return Boxes(poses[0], poses[1], poses[2], np.gradient(at, dt, axis=1), others.length, others.width)


def _filled(b: Boxes) -> tuple[Floats, Floats, Floats, Bools]:
    """x, y, heading with the first and last state repeated while a vehicle is absent; and where it is present."""
    present = np.isfinite(b.x)
    first, last = present.argmax(axis=1), present.shape[1] - 1 - present[:, ::-1].argmax(axis=1)
    k = np.clip(np.arange(present.shape[1])[None, :], first[:, None], last[:, None])
    rows = np.arange(len(k))[:, None]
    return b.x[rows, k], b.y[rows, k], b.heading[rows, k], present


def _located(adversary: Boxes, x: Floats, y: Floats, heading: Floats, way: Floats) -> tuple[Floats, Floats, Floats]:
    """Station, offset and heading of the adversary at each step along the ways, ``(n, t)``."""
    rows = np.arange(len(x))[:, None]
    i = _nearest(adversary, x[:, None, ::COARSE], y[:, None, ::COARSE]) * COARSE
    near = np.clip(i[:, :, None] + np.arange(1 - COARSE, COARSE), 0, x.shape[1] - 1)
    k = _nearest(adversary, x[rows[:, :, None], near], y[rows[:, :, None], near])
    i = np.take_along_axis(near, k[:, :, None], axis=2)[:, :, 0]
    dx, dy, h = adversary.x - x[rows, i], adversary.y - y[rows, i], heading[rows, i]
    c, s = np.cos(h), np.sin(h)
    return way[rows, i] + c * dx + s * dy, c * dy - s * dx, wrap(adversary.heading - h)


def _nearest(adversary: Boxes, x: Floats, y: Floats) -> Any:
    """The index of the place along the last axis that is nearest to the adversary, ``(n, t)``."""
    dx, dy = adversary.x[:, :, None] - x, adversary.y[:, :, None] - y
    return np.argmin(dx * dx + dy * dy, axis=2)


def _followed(
    way: Floats, s: Floats, front_s: Floats, in_lane: Bools, speed: Floats, both_halves: Floats, dt: float
) -> Floats:
    """Stations ``(n, t)`` of third parties that follow the adversary while it is in their lane and ahead.

    way: their unattacked stations; s, front_s, speed: of the adversary; both_halves: half of the two lengths [m].
    """
    driver = CarFollowing(DEFAULT_DRIVER, dt)
    unattacked = np.diff(way, axis=1) / dt
    at = way[:, : s.shape[1]].copy()
    appears = (in_lane & (front_s > at)).any(axis=0)
    if not appears.any():
        return at
    first = int(appears.argmax())  # until then all move as unattacked
    v, brakes = np.maximum(unattacked[:, max(first - 1, 0)], 0.0), np.zeros(len(way), bool)
    for k in range(first, at.shape[1] - 1):
        leads = in_lane[:, k] & (front_s[:, k] > at[:, k])
        bound = np.where(leads, driver.behind(v, s[:, k] - at[:, k] - both_halves, speed[:, k]), np.inf)
        brakes |= bound < unattacked[:, k] - SLOWER
        free = np.minimum(driver.free(v), np.maximum(unattacked[:, k], v))
        v = np.where(brakes, np.maximum(np.minimum(free, bound), v - EMERGENCY * dt), unattacked[:, k])
        v = np.maximum(v, 0.0)
        at[:, k + 1] = np.minimum(np.where(brakes, at[:, k] + v * dt, way[:, k + 1]), way[:, -1])
    return at
