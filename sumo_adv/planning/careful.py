"""The careful and competent driver as it is foreseen: many of them at once, in the frame of the ego's path.

The rules are those of ``world/egos/hazard.py`` and ``careful.py`` (UN R157), for the adversary alone: when it alarms
the driver, and how the driver then brakes. There the path is the engine's and boxes stand in the world; here stations
and offsets stand for both, which is the same on a straight road and nearly so on a bend. Left out: what the driver saw
before the attack began, and of a vehicle that crosses without coming nearer its box's TTC (whether they meet decides).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sumo_adv.datatypes import Bools, Floats

DRIFT, DRIFT_RATE = 0.375, 0.1  # m, m/s
REACTION = 1.15  # s until the driver brakes
RAMP, FULL_BRAKING = 0.6, 0.774 * 9.81  # s, m/s2
MEMORY = 0.5  # s without a hazard until the driver is at ease again
OWN_BRAKING, GENTLE, STOPPING_SHORT, ALARM_BRAKING = 4.5, 1.5, 3.0, 3.0  # m/s2
HALF_LANE = 1.6  # m
CLOSE_HEADWAY, HEADWAY, SOON, SIGHT = 0.5, 2.0, 1.5, 4.0  # s
HISTORY = 0.5  # s over which yaw rates are measured
LOOK_STEP = 0.2  # s between the moments at which a meeting is looked for
ALIKE, FACING = np.pi / 4, 3 * np.pi / 4


class View(NamedTuple):
    """The adversaries as the drivers see them, ``(n,)``: m, rad, m/s; the ego's speed and acceleration (m/s2)."""

    ahead: Bools
    away: Floats  # m, along the path between centres
    left: Floats  # m
    heading: Floats
    gap: Floats
    side_gap: Floats
    near_edge: Floats
    speed: Floats
    along: Floats  # m/s, along the path
    towards: Floats  # m/s, sideways, from the last two places
    crossing: Floats  # m/s, sideways, from heading and speed
    braking: Floats  # m/s2, the adversary's acceleration
    yaw_rate: Floats  # rad/s
    ego_speed: Floats
    ego_acceleration: Floats


class CarefulDrivers:
    """One careful driver against each adversary of a length and width [m], ``(n,)``; ``ego``: length and width [m];
    ``reaction``: s until it brakes."""

    def __init__(
        self, ego: tuple[float, float], length: Floats, width: Floats, dt: float, reaction: float = REACTION
    ) -> None:
        self._ego, self._length, self._width, self._dt, self._reaction = ego, length, width, dt, reaction
        n, self._history = len(length), max(1, round(HISTORY / dt))
        self._seen: list[tuple[Floats, Floats, Floats]] = []  # offset, heading, speed of the last steps
        self._drift = np.zeros(n)
        self.alarmed = np.zeros(n, bool)
        self._shown, self._last = np.full(n, np.inf), np.full(n, -np.inf)

    def bound(
        self, now: float, ego: tuple[Floats, Floats, Floats], adversary: tuple[Floats, Floats, Floats], speed: Floats
    ) -> Floats:
        """The speed [m/s] that the drivers brake to within this step, inf where they do not brake.

        ego: station, speed, acceleration; adversary: station, offset, heading (ego path's frame, box centres)."""
        view = self._view(ego, adversary, speed)
        self._follow_drift(view)
        self.alarmed = np.where(self.alarmed, ~self._over(view), self._appears(view))
        self._last = np.where(self.alarmed, now, self._last)
        ease = ~self.alarmed & (now - self._last > MEMORY)
        self._shown = np.where(ease, np.inf, np.where(self.alarmed, np.minimum(self._shown, now), self._shown))
        since = np.where(np.isfinite(self._shown), now - self._shown, 0.0)
        lost = _speed_lost(since + self._dt - self._reaction) - _speed_lost(since - self._reaction)
        return np.where(self.alarmed & (lost > 1e-9), np.maximum(view.ego_speed - lost, 0.0), np.inf)

    def _view(
        self, ego: tuple[Floats, Floats, Floats], adversary: tuple[Floats, Floats, Floats], speed: Floats
    ) -> View:
        (at, v, a), (s, d, h) = ego, adversary
        cos, sin = np.abs(np.cos(h)), np.abs(np.sin(h))
        along, across = (cos * self._length + sin * self._width) / 2, (sin * self._length + cos * self._width) / 2
        side = np.copysign(1.0, d)
        before, _, slower = self._seen[-1] if self._seen else (d, h, speed)
        first = self._seen[0][1] if self._seen else h
        turned = np.remainder(h - first + np.pi, 2 * np.pi) - np.pi
        span = max(len(self._seen), 1) * self._dt
        self._seen = [*self._seen, (d, h, speed)][-self._history :]
        return View(
            s > at, s - at, d, h, s - at - along - self._ego[0] / 2, np.abs(d) - across - self._ego[1] / 2,
            np.abs(d) - across, speed, speed * np.cos(h), -side * (d - before) / self._dt, -side * speed * np.sin(h),
            (speed - slower) / self._dt, turned / span, v, a,
        )  # fmt: skip

    def _follow_drift(self, view: View) -> None:
        moved = np.maximum(self._drift + view.towards * self._dt, 0.0)
        far = np.hypot(view.away, view.left) > 15.0 + SIGHT * (view.ego_speed + view.speed)
        self._drift = np.where((np.abs(view.towards) < DRIFT_RATE) | (far & ~self.alarmed), 0.0, moved)

    def _appears(self, view: View) -> Bools:
        """Whether one that was no hazard becomes one."""
        turned = np.abs(view.heading)
        seen = view.ahead & (view.ego_speed >= 0.1)
        seen &= view.gap <= SIGHT * (view.ego_speed + np.maximum(-view.along, 0.0))
        found = seen & (turned < ALIKE) & self._same_direction(view)
        comes = seen & (view.speed >= 0.1) & (view.gap > 0.0)
        facing = comes & (turned > FACING) & (view.near_edge < HALF_LANE) & (self._drift >= DRIFT)
        across = comes & (turned >= ALIKE) & (turned <= FACING)
        across &= _needed(view.ego_speed, view.gap, 0.0 * view.gap, 0.0 * view.gap) >= ALARM_BRAKING
        sideways = (view.side_gap > 0.0) & (view.crossing > DRIFT_RATE)
        span = view.side_gap / np.maximum(view.crossing, DRIFT_RATE)  # s until it is in the way
        late = across & sideways & (span < view.speed / (2.0 * STOPPING_SHORT))
        for rows, horizon, margin in ((facing, 3.0, 0.5), (late, SIGHT, 1.0), (across & ~sideways, 3.0, 0.0)):
            k = np.flatnonzero(rows)
            if len(k):
                found[k] = self._meet(view, k, horizon, margin)
        return np.asarray(found)

    def _same_direction(self, view: View) -> Bools:
        needed = _needed(view.ego_speed, view.gap, view.along, view.braking)
        leads = (view.side_gap <= 0.0) & (needed > OWN_BRAKING)
        entering = (view.side_gap <= 0.0) | (view.side_gap < SOON * view.towards)
        return np.where(self._drift < DRIFT, leads, entering & _too_near(view, REACTION, GENTLE))

    def _over(self, view: View) -> Bools:
        """Whether a hazard is past: behind, out of the way and not coming, or harmless as a leader."""
        waits = (view.ego_speed < 0.5) & (view.gap < 2.5) & (view.speed < 0.5)
        harmless = (np.abs(view.heading) < ALIKE) & ~waits & ~_too_near(view, 0.0, 0.5)
        return ~view.ahead | ((view.side_gap > 0.0) & (view.towards < DRIFT_RATE)) | harmless

    def _meet(self, view: View, k: Any, horizon: float, margin: float) -> Bools:
        """Whether the boxes, the adversary's grown by ``margin``, overlap within ``horizon``: the ego goes on along its
        path, braking on if it brakes, the adversary on the arc that it is on."""
        t = np.arange(0.0, horizon + 1e-6, LOOK_STEP)
        speed, braking = view.ego_speed[k][:, None], np.maximum(-view.ego_acceleration[k], 0.0)[:, None]
        braking = np.where(braking > 0.5, braking, 0.0)
        moving = np.minimum(t, np.where(braking > 0.0, speed / np.maximum(braking, 0.5), np.inf))
        turned = view.yaw_rate[k][:, None] * t
        h = view.heading[k][:, None]
        chord = view.speed[k][:, None] * t * np.sinc(turned / (2 * np.pi))
        x = view.away[k][:, None] + chord * np.cos(h + turned / 2) - speed * moving + braking * moving**2 / 2
        y = view.left[k][:, None] + chord * np.sin(h + turned / 2)
        size = (self._length[k][:, None] + 2 * margin, self._width[k][:, None] + 2 * margin)
        return np.asarray(_overlap(x, y, h + turned, self._ego, size).any(axis=1))


def _overlap(x: Floats, y: Floats, h: Floats, ego: tuple[float, float], size: tuple[Floats, Floats]) -> Bools:
    """Whether a box of a size at x, y, heading overlaps the ego's at the origin (separating axes)."""
    cos, sin, (length, width) = np.cos(h), np.sin(h), size
    c, s = np.abs(cos), np.abs(sin)
    apart = (np.abs(x) > (ego[0] + c * length + s * width) / 2) | (np.abs(y) > (ego[1] + s * length + c * width) / 2)
    apart |= np.abs(x * cos + y * sin) > (length + c * ego[0] + s * ego[1]) / 2
    return ~(apart | (np.abs(y * cos - x * sin) > (width + s * ego[0] + c * ego[1]) / 2))


def _needed(speed: Floats, gap: Floats, leader: Floats, acceleration: Floats) -> Floats:
    """The deceleration [m/s2] that just avoids running into a leader ``gap`` [m] ahead, who may brake."""
    room = np.maximum(gap, 1e-6)
    needed = np.maximum(speed - leader, 0.0) ** 2 / (2.0 * room)
    standstill = np.maximum(leader, 0.0) ** 2 / (2.0 * np.maximum(-acceleration, 0.5))
    needed = np.where(acceleration < -0.5, np.maximum(needed, speed**2 / (2.0 * (room + standstill))), needed)
    return np.where(gap > 0.0, needed, np.where(speed > 0.0, np.inf, 0.0))


def _too_near(view: View, reaction: float, gentle: float) -> Bools:
    """Whether coasting for ``reaction`` [s] and then braking by ``gentle`` [m/s2] does not do behind it."""
    v, closing = view.ego_speed, view.ego_speed - view.along
    close = (view.gap < CLOSE_HEADWAY * v) & (closing > -1.0)
    far = view.gap > np.maximum(SIGHT * closing, HEADWAY * v)
    left_over = view.gap - np.maximum(closing, 0.0) * reaction
    return close | (~far & (_needed(v, left_over, view.along, view.braking) > gentle))


def _speed_lost(since: Floats) -> Floats:
    """What braking has taken [m/s] so long after it began [s]."""
    pressed = np.maximum(since, 0.0)
    rising = np.minimum(pressed, RAMP)
    return FULL_BRAKING * (rising**2 / (2.0 * RAMP) + pressed - rising)
