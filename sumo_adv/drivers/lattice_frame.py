"""The frame of the ego's route path, and where others will be in it.

Others that go along the path, either way, keep their speed (or their braking, to standstill) and their drift sideways;
one that comes into the ego's lane stays on its centre.  All others go on at constant speed and yaw rate.  Left out are
followers in the ego's own lane, and vehicles on crossing courses that can still stop short of the path at 3 m/s2 (the
rule of ``hazard.py``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Bools, Floats, VehicleState
from sumo_adv.geometry import PATH_STEP, Path, make_path, wrap, wrap_all
from sumo_adv.metrics.reference.cc_human import STOPPING_SHORT

COARSE = 2  # samples of the path between those that points are compared with
BEND_LATERAL, BEND_BRAKING = 3.2, 3.0  # m/s2, m/s2: how bends are taken
BEND_SPAN = 8  # samples to either side, over which the path turns: a lane's points are no smooth line
FASTEST = 60.0  # m/s
DRIFT_RATE = 0.15  # m/s, slower sideways motion is lane keeping
DRIFT_BEND = 1.2  # m, times the yaw rate of a bend: so much more is lane keeping there
DRIFT_TIME = 2.5  # s, so long a vehicle is taken to move over
BRAKING = 0.5  # m/s2, less is no braking
ALONG = math.pi / 4  # rad to the path: more is crossing
SMOOTHING = 0.5  # -, weight of the newest yaw rate


class RoadFrame:
    """Stations ``s`` [m] along a path and offsets ``d`` [m, left positive] from it."""

    def __init__(self, points: Sequence[tuple[float, float]]) -> None:
        """``points``: (x, y) [m] of the path's centreline in driving direction."""
        self.path: Path = make_path(points)
        count = len(self.path.x)
        self._grid = PATH_STEP * np.arange(count)
        index = np.arange(count)
        first, last = np.maximum(index - BEND_SPAN, 0), np.minimum(index + BEND_SPAN, count - 1)
        self._curvature = (self.path.heading[last] - self.path.heading[first]) / ((last - first) * PATH_STEP)
        square = np.minimum(BEND_LATERAL / np.maximum(np.abs(self._curvature), 1e-9), FASTEST**2)
        gained = 2 * BEND_BRAKING * self._grid
        self._pace = np.sqrt(np.minimum.accumulate((square + gained)[::-1])[::-1] - gained)

    def project(self, x: Floats, y: Floats, heading: Floats) -> tuple[Floats, Floats, Floats]:
        """Stations, offsets and relative headings of poses (any one shape); straight on beyond the path's ends."""
        p = self.path
        px, py = p.x[::COARSE], p.y[::COARSE]
        i = COARSE * np.argmin((x[..., None] - px) ** 2 + (y[..., None] - py) ** 2, axis=-1)
        cos, sin = np.cos(p.heading[i]), np.sin(p.heading[i])
        dx, dy = x - p.x[i], y - p.y[i]
        s = PATH_STEP * i + cos * dx + sin * dy
        there = np.interp(s, self._grid, p.heading)
        return s, cos * dy - sin * dx, wrap_all(heading - there)

    @property
    def length(self) -> float:
        """Metres that are known; beyond, nothing is said of those who come from there."""
        return self.path.length

    def locate(self, state: VehicleState) -> tuple[float, float, float]:
        """Station, offset and relative heading of one vehicle."""
        found = self.project(*(np.array([q]) for q in (state.x, state.y, state.heading)))
        s, d, h = (float(q[0]) for q in found)
        return s, d, h

    def bend(self, s: Floats) -> tuple[Floats, Floats]:
        """Curvature [1/m] and the fastest comfortable speed [m/s] at stations."""
        return np.interp(s, self._grid, self._curvature, right=0.0), np.interp(s, self._grid, self._pace)


@dataclass(frozen=True, slots=True)
class Others:
    """Predicted boxes along the path's axes. s, d: centres; half_s, half_d: half extents [m]; all ``(n, time)``.

    speed: along the path [m/s], ``(n,)``.
    """

    s: Floats
    d: Floats
    half_s: Floats
    half_d: Floats
    speed: Floats


class Watch:
    """Remembers where others were, for their yaw rates and drifts."""

    def __init__(self) -> None:
        self._seen: dict[str, tuple[float, float, float, float, float]] = {}  # time, x, y, heading, yaw rate

    def look(self, time: float, others: Sequence[VehicleState]) -> Floats:
        """Velocities in x and y [m/s] and yaw rates [rad/s] of all, ``(n, 3)``."""
        seen, rows = {}, np.zeros((len(others), 3))
        for k, o in enumerate(others):
            vx, vy, rate = o.speed * math.cos(o.heading), o.speed * math.sin(o.heading), 0.0
            if o.id in self._seen:
                before, x, y, h, rate = self._seen[o.id]
                passed = max(time - before, 1e-3)
                vx, vy = (o.x - x) / passed, (o.y - y) / passed
                rate += SMOOTHING * (wrap(o.heading - h) / passed - rate)
            seen[o.id] = (time, o.x, o.y, o.heading, rate)
            rows[k] = vx, vy, rate
        self._seen = seen
        return rows


def predict(
    frame: RoadFrame,
    ego: VehicleState,
    at: tuple[float, float],
    others: Sequence[VehicleState],
    moving: Floats,
    times: Floats,
) -> Others:
    """Where others will be at ``times`` (from now, s).

    ``at``: the ego's station and offset; ``moving``: what ``Watch.look`` said of the others.
    """
    state = np.array([[o.x, o.y, o.heading, o.speed, o.acceleration, o.length, o.width] for o in others])
    x, y, h, v, a, length, width = state.reshape(-1, 7).T
    near = np.hypot(x - ego.x, y - ego.y) < 15.0 + times[-1] * (v + ego.speed)
    x, y, h, v, a, length, width = (q[near] for q in (x, y, h, v, a, length, width))
    vx, vy, rate = moving[near].T
    s, d, turn = frame.project(x, y, h)
    direction = h - turn
    drift = vy * np.cos(direction) - vx * np.sin(direction)
    wander = DRIFT_RATE + DRIFT_BEND * v * np.abs(frame.bend(s)[0])
    drift = np.where(np.abs(drift) < wander, 0.0, drift)
    along = (np.abs(np.sin(turn)) < math.sin(ALONG)) & (np.abs(d) < 12.0)
    way = _travelled(v, a, times)
    all_s, all_d = s[:, None] + np.cos(turn)[:, None] * way, _drifting(d, drift, turn, times)
    angle = np.tile(turn[:, None], (1, len(times)))
    if not along.all():
        free = ~along
        arcs = _arcs(x[free], y[free], h[free], rate[free], way[free], v[free])
        all_s[free], all_d[free], angle[free] = frame.project(*arcs)
    cos, sin = np.abs(np.cos(angle)), np.abs(np.sin(angle))
    half_s = (cos * length[:, None] + sin * width[:, None]) / 2
    half_d = (sin * length[:, None] + cos * width[:, None]) / 2
    matter = ~_behind(ego, at, s, d, turn, half_s[:, 0], half_d[:, 0])
    matter &= (s < frame.length) | (np.cos(turn) > math.cos(ALONG))
    matter &= along | ~_yields(ego, d, turn, v, half_d[:, 0])
    return Others(all_s[matter], all_d[matter], half_s[matter], half_d[matter], (v * np.cos(turn))[matter])


def _travelled(v: Floats, a: Floats, times: Floats) -> Floats:
    """Metres at ``times``: those that brake go on braking, to standstill; all others keep their speed."""
    braking = np.where(a < -BRAKING, a, 0.0)[:, None]
    until = np.where(braking < 0, v[:, None] / np.maximum(-braking, 1e-6), np.inf)
    t = np.minimum(times, until)
    return np.asarray(v[:, None] * t + braking / 2 * t * t)


def _drifting(d: Floats, drift: Floats, turn: Floats, times: Floats) -> Floats:
    """Offsets of those that go along the path; one that comes the same way into its middle stays there."""
    moved = d[:, None] + drift[:, None] * np.minimum(times, DRIFT_TIME)
    through = (moved * d[:, None] < 0) & (np.cos(turn) > 0)[:, None]
    return np.where(through, 0.0, moved)


def _arcs(x: Floats, y: Floats, h: Floats, rate: Floats, way: Floats, v: Floats) -> tuple[Floats, Floats, Floats]:
    """Poses after ``way`` metres on the circles that they are on, at most a quarter turn on."""
    bend = np.where(v > 0.5, rate / np.maximum(v, 0.5), 0.0)[:, None]
    turned = np.clip(bend * way, -math.pi / 2, math.pi / 2)
    chord = way * np.sinc(turned / math.tau)
    direction = h[:, None] + turned / 2
    return x[:, None] + chord * np.cos(direction), y[:, None] + chord * np.sin(direction), h[:, None] + turned


def _behind(
    ego: VehicleState, at: tuple[float, float], s: Floats, d: Floats, turn: Floats, half_s: Floats, half_d: Floats
) -> Bools:
    """Followers: wholly behind the ego, in its lane, going the same way."""
    lane = np.abs(d - at[1]) < half_d + ego.width / 2 + 0.3
    return np.asarray((s + half_s < at[0] - ego.length / 2) & lane & (np.cos(turn) > 0))


def _yields(ego: VehicleState, d: Floats, turn: Floats, v: Floats, half_d: Floats) -> Bools:
    """On a crossing course, and still able to stop short of the path."""
    towards = -np.sign(d) * v * np.sin(turn)
    side_gap = np.abs(d) - half_d - ego.width / 2
    room = side_gap * v / np.maximum(towards, 1e-6)
    return np.asarray((side_gap > 0) & (towards > 0) & (room >= v * v / (2 * STOPPING_SHORT)))
