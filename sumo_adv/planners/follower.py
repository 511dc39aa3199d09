"""Follow a planner's own trajectory: its states form a line with a timetable, and a vehicle drives along the line.

Two critically damped springs pull the vehicle: one sideways to the nearest place of the line, the other along the line
to the place of the timetable. The vehicle stays within the limits. If the timetable is too fast, the vehicle is late.
If the line is too sharp, the vehicle leaves it. Attempts and predictions both drive one vehicle at a time here, with
floats.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable

import numpy as np

from sumo_adv.datatypes import Bools, Boxes, Floats, Limits
from sumo_adv.errors import PlannerResultError
from sumo_adv.geometry import Path, stations, wrap
from sumo_adv.metrics.gates import off_road
from sumo_adv.planners.trajectory import BEND_SPEED_TIMES_S, LATERAL_RESERVE_M_S2, Motion, PathRow, Scalar, faster, pose

MIN_FITTED_STATES = 4  # with fewer, speeds and accelerations cannot be fitted
FIT_HALF_WINDOW = 3  # states on either side over which speeds and accelerations are fitted
ACROSS_SPRING_1_S, ALONG_SPRING_1_S = 2.0, 1.5  # natural frequencies of the two springs
MAX_SPRING_DELAY_M = 5.0  # a larger delay is capped for the spring along the line
USED_LIMIT_SHARE = 0.95  # share of the limits on lateral acceleration and curvature that is used
MIN_CORRECTION_M_S2 = 0.5  # lateral acceleration for corrections where the planner's line is straight
MAX_LATERAL_JERK_M_S3 = 10.0
# Beyond these, a line has no place beside the way; the stretch is 1 - curvature * offset.
MAX_WAY_ANGLE_RAD, MIN_WAY_STRETCH = 0.7, 0.3
MIN_HEADING_SPEED_M_S = 0.3  # below it, headings are the planner's
MIN_CURVATURE_SPEED_M_S = 2.0  # below it, curvature is not checked
ON_ROAD_S = 3.0  # the first part of a trajectory, which must be on the road


class PlannedCourse:
    """A planner's states as a smooth motion. All arrays have the shape ``(n,)``.

    Attributes:
        dt: The time between two states [s].
        x: The x positions [m].
        y: The y positions [m].
        heading: The headings [rad]: those of the motion or, below ``MIN_HEADING_SPEED_M_S``, the planner's.
        p: The distances along the line [m].
        v: The speeds [m/s].
        a: The accelerations along the line [m/s2].
        lateral: The lateral accelerations [m/s2].
        curvature: The curvatures [1/m].
    """

    def __init__(self, states: Floats, dt: float) -> None:
        """Fit the motion to states.

        Args:
            states: x, y [m], heading [rad] and speed [m/s] in the world, ``(n, 4)``.
            dt: The time between two states [s].
        """
        self.dt = dt
        x, y, heading = states[:, 0], states[:, 1], states[:, 2]
        vx, ax = _slopes(x, dt)
        vy, ay = _slopes(y, dt)
        self.x, self.y = x, y
        self.v = np.hypot(vx, vy)
        self.p = stations(x, y)
        moving = self.v > MIN_HEADING_SPEED_M_S
        self.heading = np.where(moving, np.arctan2(vy, vx), heading)
        speed = np.maximum(self.v, MIN_HEADING_SPEED_M_S)
        self.a = np.where(moving, (vx * ax + vy * ay) / speed, 0.0)
        self.lateral = np.where(moving, (vx * ay - vy * ax) / speed, 0.0)
        self.curvature = np.where(moving, self.lateral / speed**2, 0.0)

    def beyond(self, limits: Limits, cap: float) -> str:
        """Name the quantities that exceed the limits.

        Args:
            limits: The limits of the vehicle's motion.
            cap: The vehicle's highest speed [m/s].

        Returns:
            The quantities in words, or an empty string.
        """
        exceeded, moves = [], self.v > MIN_CURVATURE_SPEED_M_S
        for quantity, value, most, unit in (
            ("sideways", np.abs(self.lateral).max(), limits.lateral, "m/s2"),
            ("braking", -self.a.min(), limits.braking, "m/s2"),
            ("acceleration", self.a.max(), limits.acceleration, "m/s2"),
            ("curvature", np.abs(self.curvature[moves]).max(initial=0.0), limits.curvature, "1/m"),
            ("speed", self.v.max(), cap, "m/s"),
        ):
            if value > 1.05 * most:
                exceeded.append(f"{quantity} {value:.2g} {unit} (at most {most:.2g})")
        return ", ".join(exceeded)


def _slopes(values: Floats, dt: float) -> tuple[Floats, Floats]:
    """Return first and second derivatives of values ``dt`` [s] apart, from a parabola fitted around each value."""
    n = len(values)
    width = min(2 * FIT_HALF_WINDOW + 1, n)
    first = np.clip(np.arange(n) - width // 2, 0, n - width)
    fit = np.linalg.pinv(np.vander(np.arange(width) * dt, 3, increasing=True))
    c = np.lib.stride_tricks.sliding_window_view(values, width)[first] @ fit.T
    return c[:, 1] + 2 * c[:, 2] * (np.arange(n) - first) * dt, 2 * c[:, 2]


def starting_now(states: Floats, x: float, y: float, heading: float, dt: float) -> Floats:
    """Make a planner's states begin now.

    Args:
        states: The states: x, y [m], heading [rad] and speed [m/s], ``(n, 4)``.
        x: The vehicle's present x position [m].
        y: The vehicle's present y position [m].
        heading: The vehicle's present heading [rad].
        dt: The time between two states [s].

    Returns:
        The states. If the first one is ``dt`` from now, the present pose is put before them.
    """
    step = math.hypot(*(states[1, :2] - states[0, :2])) if len(states) > 1 else 0.0
    ahead = math.cos(heading) * (states[0, 0] - x) + math.sin(heading) * (states[0, 1] - y)
    if step > MIN_HEADING_SPEED_M_S * dt and ahead > step / 2:
        return np.vstack([[x, y, heading, states[0, 3]], states])
    return states


def leaves_road(
    states: Floats, length: float, width: float, dt: float, on_road: Callable[[Floats, Floats], Bools]
) -> float | None:
    """Find when a vehicle leaves the road within the first ``ON_ROAD_S`` seconds, as the gate ``off_road`` judges it.

    Args:
        states: The vehicle's states: x, y [m], heading [rad] and speed [m/s], ``(n, 4)``.
        length: The vehicle's length [m].
        width: The vehicle's width [m].
        dt: The time between two states [s].
        on_road: Returns which points are on the road.

    Returns:
        The time from now [s], or None if the vehicle stays on the road.
    """
    x, y, heading, speed = states[: round(ON_ROAD_S / dt)].T
    out = off_road(Boxes(x, y, heading, speed, length, width), np.ones(len(x), bool), on_road)
    return float((np.argmax(out) + 1) * dt) if out.any() else None


class Follower:
    """Drives one vehicle along one trajectory on its way.

    Attributes:
        line: The trajectory.
        farthest: The largest distance so far between the vehicle and its place in the timetable [m].
    """

    def __init__(self, line: PlannedCourse, way: Path) -> None:
        """Prepare to follow a trajectory.

        Args:
            line: The trajectory.
            way: The way that the vehicle takes.

        Raises:
            PlannerResultError: The trajectory has too few states, or leaves the way.
        """
        if len(line.x) < MIN_FITTED_STATES:
            raise PlannerResultError(f"trajectory() gave {len(line.x)} states, at least {MIN_FITTED_STATES} are needed")
        d, turned, curvature = _beside(line, way)
        astray = (turned > MAX_WAY_ANGLE_RAD) | (1.0 - curvature * d < MIN_WAY_STRETCH)
        if astray.any():
            k = int(np.argmax(astray))
            raise PlannerResultError(
                f"trajectory() does not go the endpoint's way after {k * line.dt:.1f} s: there it is turned by "
                f"{turned[k]:.1f} rad and {abs(d[k]):.1f} m aside of it"
            )
        self.line = line
        heading = np.unwrap(line.heading).tolist()
        self._rows = list(zip(line.x.tolist(), line.y.tolist(), heading, line.curvature.tolist(), strict=True))
        self._p, self._v, self._a = line.p.tolist(), line.v.tolist(), line.a.tolist()
        self._lateral = max(MIN_CORRECTION_M_S2, 1.02 * float(np.abs(line.lateral).max()))
        self._k, self._here = 0, 0.0
        settled = np.flatnonzero(np.abs(d - d[-1]) > 0.05)
        self._end = float(d[-1]), (float(settled[-1] + 1) * line.dt if len(settled) else 0.0)
        self.farthest = 0.0

    @property
    def over(self) -> bool:
        """Whether the vehicle has driven all steps of the trajectory."""
        return self._k >= len(self._p) - 1

    def begin(self, motion: Motion) -> Motion:
        """Set the offset at the trajectory's end as the motion's lateral target, which planners observe."""
        target, seconds = self._end
        return motion._replace(target=target, clock=0.0, span=max(seconds, 1e-3))

    def advance(self, motion: Motion, road: PathRow, limits: Limits, cap: float, hard: bool) -> Motion:
        """Advance the vehicle by one step.

        Args:
            motion: The vehicle's motion.
            road: The vehicle's way.
            limits: The limits of the vehicle's motion.
            cap: The vehicle's highest speed [m/s].
            hard: Whether the vehicle may brake as hard as the limits allow; see ``trajectory.faster``.
        """
        dt, v = self.line.dt, motion.v
        x, y, h = pose(Scalar, motion, road)
        bend = road.at(motion.s)[3]
        before = motion.ddd + v * v * bend
        aside, turn, curvature = self._place(x, y, h)
        want, grip = self._along(v, limits), abs(before) + LATERAL_RESERVE_M_S2
        speed, a = faster(Scalar, v, motion.a, want, grip, limits, cap, dt, hard)
        lateral = v * v * curvature + ACROSS_SPRING_1_S**2 * aside + 2 * ACROSS_SPRING_1_S * v * math.sin(turn)
        most = min(USED_LIMIT_SHARE * limits.lateral, self._lateral)
        lateral = min(max(lateral, before - MAX_LATERAL_JERK_M_S3 * dt), before + MAX_LATERAL_JERK_M_S3 * dt)
        lateral = min(max(lateral, -most), most)
        mean = (v + speed) / 2
        sharpest = USED_LIMIT_SHARE * limits.curvature * mean
        rate = min(max(lateral / max(mean, MIN_HEADING_SPEED_M_S), -sharpest), sharpest)
        self._k += 1
        middle = h + rate * dt / 2
        return _on_way(
            motion, road, x + mean * dt * math.cos(middle), y + mean * dt * math.sin(middle), h + rate * dt,
            speed, a, rate * mean, dt,
        )  # fmt: skip

    def _place(self, x: float, y: float, h: float) -> tuple[float, float, float]:
        """Find the nearest place of the line: its distance to the left [m], relative heading [rad], curvature [1/m]."""
        for _ in range(2):
            rx, ry, rh, curvature = self._at(self._here)
            c, s = math.cos(rh), math.sin(rh)
            self._here = max(self._here + c * (x - rx) + s * (y - ry), 0.0)
        rx, ry, rh, curvature = self._at(self._here)
        aside = -math.sin(rh) * (rx - x) + math.cos(rh) * (ry - y)
        self.farthest = max(self.farthest, math.hypot(aside, self._p[self._k] - self._here))
        return aside, wrap(rh - h), curvature

    def _at(self, p: float) -> tuple[float, float, float, float]:
        """Return x, y, heading and curvature ``p`` metres along the line."""
        last = len(self._p) - 1
        i = min(max(bisect.bisect_right(self._p, p) - 1, 0), last - 1)
        step = self._p[i + 1] - self._p[i]
        w = (p - self._p[i]) / step if step > 1e-6 else 0.0
        a, b = self._rows[i], self._rows[i + 1]
        if w > 1.0:
            return b[0] + (p - self._p[last]) * math.cos(b[2]), b[1] + (p - self._p[last]) * math.sin(b[2]), b[2], 0.0
        e = 1.0 - w
        return a[0] * e + b[0] * w, a[1] * e + b[1] * w, a[2] * e + b[2] * w, a[3] * e + b[3] * w

    def _along(self, v: float, limits: Limits) -> float:
        """Return the acceleration that the timetable needs [m/s2], reduced for sharp bends ahead."""
        k = self._k
        late = min(max(self._p[k] - self._here, -MAX_SPRING_DELAY_M), MAX_SPRING_DELAY_M)
        want = (self._a[k] + self._a[k + 1]) / 2 + 2 * ALONG_SPRING_1_S * (self._v[k] - v) + ALONG_SPRING_1_S**2 * late
        for t in BEND_SPEED_TIMES_S:
            ahead = max(v * t, 0.5)
            sharp = abs(self._at(self._here + ahead)[3])
            square = USED_LIMIT_SHARE * limits.lateral / max(sharp, 1e-6)
            want = min(want, (square - v * v) / (2.0 * ahead) + (0.5 if square > v * v else 0.0))
        return want


def _on_way(
    motion: Motion, road: PathRow, x: float, y: float, h: float, v: float, a: float, lateral: float, dt: float
) -> Motion:
    """Convert a pose in the world to a motion on the way, near the station of ``motion``."""
    s, d = motion.s, motion.d
    for _ in range(3):
        px, py, ph, bend = road.at(s)
        c, t = math.cos(ph), math.sin(ph)
        d = -t * (x - px) + c * (y - py)
        s += (c * (x - px) + t * (y - py)) / max(1.0 - bend * d, 0.2)
    px, py, ph, bend = road.at(s)
    d = -math.sin(ph) * (x - px) + math.cos(ph) * (y - py)
    slope = min(max(math.sin(wrap(h - ph)), -0.95), 0.95)
    clock = min(motion.clock + dt, motion.span)
    return motion._replace(s=s, d=d, dd=v * slope, ddd=lateral - v * v * bend, v=v, a=a, slope=slope, clock=clock)


def _beside(line: PlannedCourse, way: Path) -> tuple[Floats, Floats, Floats]:
    """Return offsets of a line from a way [m], heading differences [rad], and the way's curvature there [1/m]."""
    i = np.argmin((line.x[:, None] - way.x) ** 2 + (line.y[:, None] - way.y) ** 2, axis=1)
    h = way.heading[i]
    d = -np.sin(h) * (line.x - way.x[i]) + np.cos(h) * (line.y - way.y[i])
    return d, np.abs(wrap(line.heading - h)), way.curvature[i]
