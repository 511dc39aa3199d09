"""The frame of the ego's path, and where other vehicles are expected in it.

A vehicle along the path, in either direction, keeps its speed (or its braking, until standstill) and its lateral drift.
If it comes into the ego's lane in the ego's direction, it stays on the centre. All other vehicles continue at constant
speed and yaw rate. Two kinds are left out: followers in the ego's own lane, and vehicles on crossing courses that can
still stop short of the path at 3 m/s2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from sumo_adv.datatypes import Bools, Floats, VehicleState
from sumo_adv.drivers.lattice import Expected, LatticeEgos, Size, look_ahead, steering
from sumo_adv.geometry import PATH_STEP_M, Path, make_path, wrap
from sumo_adv.metrics.reference.cc_human import YIELDING_BRAKING_M_S2

COARSE_PATH_STRIDE = 2  # points are compared with every second sample of the path
BEND_LATERAL_M_S2, BEND_BRAKING_M_S2 = 3.2, 3.0  # how bends are taken
BEND_HALF_WINDOW = 8  # curvature is taken over these samples to either side: a lane's points are no smooth line
LINE_HOLDING_M_S2 = -3.0  # at a line at which the ego must wait
UNBENT_SPEED_M_S = 60.0
MIN_DRIFT_M_S = 0.15  # slower sideways motion is lane keeping
DRIFT_YAW_RATE_FACTOR_M = 1.2  # times the yaw rate of a bend: is added to ``MIN_DRIFT_M_S`` there
DRIFT_DURATION_S = 2.5  # how long a vehicle is expected to drift
MIN_FORESEEN_BRAKING_M_S2 = 0.5  # less deceleration is no braking
ALONG_PATH_RAD, ALONG_PATH_OFFSET_M = math.pi / 4, 12.0  # a vehicle that exceeds these is not along the path
YAW_RATE_WEIGHT = 0.5  # -, weight of the newest yaw rate
RELEVANT_GAP_M = 15.0  # a vehicle matters within this distance plus the ways of both within the horizon
FOLLOWER_WIDTH_MARGIN_M = 0.3  # added to the width of the ego's way for followers

Poses: TypeAlias = tuple[Floats, Floats, Floats]
"""x, y [m] and heading [rad]; or station [m], offset [m] and heading against the path [rad]. The shapes are equal."""


class RoadFrame:
    """The frame of a path: stations ``s`` [m] along it, and offsets ``d`` [m, left positive] from it."""

    def __init__(self, points: Sequence[tuple[float, float]]) -> None:
        """Make the frame.

        Args:
            points: Points (x, y) of the path's centre line in driving direction [m].
        """
        self.path: Path = make_path(points)
        count = len(self.path.x)
        self._grid = PATH_STEP_M * np.arange(count)
        index = np.arange(count)
        first, last = np.maximum(index - BEND_HALF_WINDOW, 0), np.minimum(index + BEND_HALF_WINDOW, count - 1)
        self._curvature = (self.path.heading[last] - self.path.heading[first]) / ((last - first) * PATH_STEP_M)
        square = np.minimum(BEND_LATERAL_M_S2 / np.maximum(np.abs(self._curvature), 1e-9), UNBENT_SPEED_M_S**2)
        gained = 2 * BEND_BRAKING_M_S2 * self._grid
        self._pace = np.sqrt(np.minimum.accumulate((square + gained)[::-1])[::-1] - gained)

    def project(self, x: Floats, y: Floats, heading: Floats) -> tuple[Floats, Floats, Floats]:
        """Project poses on the path, which is straight beyond its ends. The arrays have one common shape.

        Args:
            x: Box centres [m].
            y: Box centres [m].
            heading: Headings [rad].

        Returns:
            Stations [m], offsets [m] and headings against the path [rad].
        """
        p = self.path
        px, py = p.x[::COARSE_PATH_STRIDE], p.y[::COARSE_PATH_STRIDE]
        i = COARSE_PATH_STRIDE * np.argmin((x[..., None] - px) ** 2 + (y[..., None] - py) ** 2, axis=-1)
        cos, sin = np.cos(p.heading[i]), np.sin(p.heading[i])
        dx, dy = x - p.x[i], y - p.y[i]
        s = PATH_STEP_M * i + cos * dx + sin * dy
        there = np.interp(s, self._grid, p.heading)
        return s, cos * dy - sin * dx, wrap(heading - there)

    def locate(self, state: VehicleState) -> tuple[float, float, float]:
        """Return station [m], offset [m] and heading against the path [rad] of one vehicle."""
        s, d, turn = self.project(*(np.array([q]) for q in (state.x, state.y, state.heading)))
        return float(s[0]), float(d[0]), float(turn[0])

    def bend(self, s: Floats) -> tuple[Floats, Floats]:
        """Return the curvature [1/m] and the highest comfortable speed [m/s] at stations [m]."""
        return np.interp(s, self._grid, self._curvature, right=0.0), np.interp(s, self._grid, self._pace)

    def wheel(self, ego: VehicleState, lateral: float) -> float:
        """Return the wheel angle that keeps a vehicle to the path.

        Args:
            ego: The vehicle.
            lateral: Maximum lateral acceleration [m/s2].

        Returns:
            The angle [rad].
        """
        speed = np.array([ego.speed])
        ahead = look_ahead(speed)
        x, y, _ = self.path.at(self.locate(ego)[0] + ahead)
        angle = wrap(math.atan2(float(y[0]) - ego.y, float(x[0]) - ego.x) - ego.heading)
        return float(steering(np.array([angle]), ahead, speed, lateral)[0][0])


class OtherVehicles(NamedTuple):
    """Vehicles now, ``m`` for each of ``n`` egos. Arrays are ``(n, m)``.

    Attributes:
        pose: Poses in any plane.
        place: Poses on the path.
        speed: Speed [m/s].
        acceleration: Acceleration [m/s2].
        drift: Rate of the offset [m/s]; 0 for lane keeping.
        yaw_rate: Yaw rate [rad/s].
        distance: Distance from the ego [m]; ``inf`` if the way between is not known.
        length: Length [m].
        width: Width [m].
    """

    pose: Poses
    place: Poses
    speed: Floats
    acceleration: Floats
    drift: Floats
    yaw_rate: Floats
    distance: Floats
    length: Floats
    width: Floats


class VehicleHistory:
    """Remembers where other vehicles were, to derive their velocities and yaw rates."""

    def __init__(self) -> None:
        self._seen: dict[str, tuple[float, float, float, float, float]] = {}  # time, x, y, heading, yaw rate

    def look(self, time: float, others: Sequence[VehicleState]) -> Floats:
        """Look at the vehicles of one step.

        Args:
            time: Time of the step [s].
            others: The vehicles.

        Returns:
            Velocity in x [m/s], velocity in y [m/s] and yaw rate [rad/s] of each vehicle ``(m, 3)``.
        """
        seen, rows = {}, np.zeros((len(others), 3))
        for k, o in enumerate(others):
            vx, vy, rate = o.speed * math.cos(o.heading), o.speed * math.sin(o.heading), 0.0
            if o.id in self._seen:
                before, x, y, h, rate = self._seen[o.id]
                passed = max(time - before, 1e-3)
                vx, vy = (o.x - x) / passed, (o.y - y) / passed
                rate += YAW_RATE_WEIGHT * (wrap(o.heading - h) / passed - rate)
            seen[o.id] = (time, o.x, o.y, o.heading, rate)
            rows[k] = vx, vy, rate
        self._seen = seen
        return rows


def others_on(frame: RoadFrame, ego: VehicleState, others: Sequence[VehicleState], moving: Floats) -> OtherVehicles:
    """Return the other vehicles of one ego, ``(1, m)``.

    Args:
        frame: The frame of the ego's path.
        ego: The ego.
        others: The other vehicles.
        moving: The result of ``VehicleHistory.look`` for them.
    """
    state = np.array([[o.x, o.y, o.heading, o.speed, o.acceleration, o.length, o.width] for o in others])
    x, y, h, v, a, length, width = state.reshape(-1, 7).T[:, None]
    vx, vy, yaw_rate = moving.T[:, None]
    s, d, turn = frame.project(x, y, h)
    direction = h - turn
    drift = vy * np.cos(direction) - vx * np.sin(direction)
    keeps_lane = np.abs(drift) < MIN_DRIFT_M_S + DRIFT_YAW_RATE_FACTOR_M * (v * np.abs(frame.bend(s)[0]))
    unknown = (s >= frame.path.length) & (np.cos(turn) <= math.cos(ALONG_PATH_RAD))  # beyond the end of the known path
    return OtherVehicles(
        (x, y, h), (s, d, turn), v, a, np.where(keeps_lane, 0.0, drift), yaw_rate,
        np.where(unknown, np.inf, np.hypot(x - ego.x, y - ego.y)), length, width,
    )  # fmt: skip


def expect(
    others: OtherVehicles, egos: LatticeEgos, size: Size, times: Floats, project: Callable[..., Poses]
) -> Expected:
    """Predict other vehicles.

    Args:
        others: The vehicles now.
        egos: The egos.
        size: Size of the egos.
        times: Times from now ``(time,)`` [s].
        project: Projects poses of the plane on the path.
    """
    (s, d, turn), v = others.place, others.speed
    way = _travelled(v, others.acceleration, times)
    all_s, all_d = s[..., None] + np.cos(turn)[..., None] * way, _drifting(d, others.drift, turn, times)
    angle = np.repeat(turn[..., None], len(times), axis=-1)
    along = (np.abs(np.sin(turn)) < math.sin(ALONG_PATH_RAD)) & (np.abs(d) < ALONG_PATH_OFFSET_M)
    if not along.all():
        free = ~along
        x, y, h = (q[free] for q in others.pose)
        all_s[free], all_d[free], angle[free] = project(*_arcs(x, y, h, others.yaw_rate[free], way[free], v[free]))
    cos, sin = np.abs(np.cos(angle)), np.abs(np.sin(angle))
    length, width = others.length[..., None], others.width[..., None]
    half_s, half_d = (cos * length + sin * width) / 2, (sin * length + cos * width) / 2
    matters = others.distance < RELEVANT_GAP_M + times[-1] * (v + egos.speed[:, None])
    matters &= ~_follows(others, egos, size, half_s[..., 0], half_d[..., 0])
    matters &= along | ~_yields(others, size, half_d[..., 0])
    return Expected(np.where(matters[..., None], all_s, np.inf), all_d, half_s, half_d, v * np.cos(turn))


def _travelled(v: Floats, a: Floats, times: Floats) -> Floats:
    """Return the distance at ``times`` [m]: braking continues until standstill, other vehicles keep their speed."""
    braking = np.where(a < -MIN_FORESEEN_BRAKING_M_S2, a, 0.0)[..., None]
    until = np.where(braking < 0, v[..., None] / np.maximum(-braking, 1e-6), np.inf)
    t = np.minimum(times, until)
    return np.asarray(v[..., None] * t + braking / 2 * t * t)


def _drifting(d: Floats, drift: Floats, turn: Floats, times: Floats) -> Floats:
    """Return the offsets of vehicles along the path; one that comes the same way to its centre stays there."""
    moved = d[..., None] + drift[..., None] * np.minimum(times, DRIFT_DURATION_S)
    through = (moved * d[..., None] < 0) & (np.cos(turn) > 0)[..., None]
    return np.where(through, 0.0, moved)


def _arcs(x: Floats, y: Floats, h: Floats, rate: Floats, way: Floats, v: Floats) -> Poses:
    """Return the poses after ``way`` metres on the present circles, at most a quarter turn on."""
    bend = np.where(v > 0.5, rate / np.maximum(v, 0.5), 0.0)[:, None]
    turned = np.clip(bend * way, -math.pi / 2, math.pi / 2)
    chord = way * np.sinc(turned / math.tau)
    direction = h[:, None] + turned / 2
    return x[:, None] + chord * np.cos(direction), y[:, None] + chord * np.sin(direction), h[:, None] + turned


def _follows(others: OtherVehicles, egos: LatticeEgos, size: Size, half_s: Floats, half_d: Floats) -> Bools:
    """Return whether a vehicle is wholly behind the ego, in its lane, and goes the same way."""
    s, d, turn = others.place
    lane = np.abs(d - egos.d[:, None]) < half_d + size.width / 2 + FOLLOWER_WIDTH_MARGIN_M
    return np.asarray((s + half_s < egos.s[:, None] - size.length / 2) & lane & (np.cos(turn) > 0))


def _yields(others: OtherVehicles, size: Size, half_d: Floats) -> Bools:
    """Return whether a vehicle on a crossing course can still stop short of the path."""
    (_, d, turn), v = others.place, others.speed
    towards = -np.sign(d) * v * np.sin(turn)
    side_gap = np.abs(d) - half_d - size.width / 2
    room = side_gap * v / np.maximum(towards, 1e-6)
    return np.asarray((side_gap > 0) & (towards > 0) & (room >= v * v / (2 * YIELDING_BRAKING_M_S2)))
