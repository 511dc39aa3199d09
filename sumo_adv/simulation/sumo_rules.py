"""Predict SUMO's drivers: car following and right of way at junctions, for many adversaries at once.

Attacks that begin at different moments of one encounter are predicted together. Each moment has its own frame, path,
lane and unattacked ego (``SituationBatch``).

Krauss follows ``MSCFModel_Krauss`` (Krauß 1998). All other drivers follow ``MSCFModel_IDM`` (Treiber, Hennecke and
Helbing 2000). Speeds are in m/s and gaps in m. Arrays have shape ``(n,)`` or any shape that broadcasts.

At junctions, drivers keep clear of a vehicle on the junction, and give way at their line. The rules follow
``MSLink::getLeaderInfo``, ``MSLink::blockedByFoe``, ``MSVehicle::isLeader`` and ``MSVehicle::adaptToJunctionLeader`` of
SUMO 1.28.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from sumo_adv.datatypes import Bools, DriverModel, Floats
from sumo_adv.geometry import Paths, wrap
from sumo_adv.situation import Situation


class SituationBatch:
    """A situation for each of ``n`` adversaries.

    All situations belong to one encounter, so they share the ego, its driver and the step length.

    Attributes:
        of: The situation of each adversary.
        dt: The step length [s].
        ego: The ego.
        driver: The driver model of the ego.
    """

    def __init__(self, situations: Sequence[Situation]) -> None:
        """Stack the situations.

        Args:
            situations: The situation of each adversary. The same object may occur several times.
        """
        self.of = list(situations)
        distinct = list({id(s): s for s in situations}.values())
        place = {id(s): k for k, s in enumerate(distinct)}
        self._distinct, self._row = distinct, np.array([place[id(s)] for s in situations], np.intp)
        self._rows = [np.flatnonzero(self._row == k) for k in range(len(distinct))]
        self._paths = Paths([s.baseline.path for s in distinct])
        frames = [s.frame for s in distinct]
        self._frame = np.array(
            [(f.x, f.y, math.cos(f.heading), math.sin(f.heading), f.heading, f.hand) for f in frames]
        )
        self._profiles = [(s.baseline.s.tolist(), s.baseline.v.tolist()) for s in distinct]
        self.dt, self.ego, self.driver = distinct[0].dt, distinct[0].ego, distinct[0].baseline.model

    def each(self, value: Callable[[Situation], float]) -> Floats:
        """Return ``value(situation)`` for each adversary, ``(n,)``."""
        return np.array([value(s) for s in self._distinct], float)[self._row]

    def profile(self, time: Floats) -> tuple[Floats, Floats]:
        """Return the motion of the unattacked egos along their paths.

        Args:
            time: Times after the triggers [s], ``(k,)``.

        Returns:
            Stations [m] and speeds [m/s], each ``(n, k)``.
        """
        profiles = [profile_at(s, time) for s in self._distinct]
        return np.stack([s for s, _ in profiles])[self._row], np.stack([v for _, v in profiles])[self._row]

    def profile_now(self, time: float) -> tuple[Floats, Floats]:
        """Return stations [m] and speeds [m/s] of the unattacked egos at one time after the triggers [s], each
        ``(n,)``.
        """
        profiles = np.array([_profile_at_once(s, v, time, self.dt) for s, v in self._profiles])[self._row]
        return profiles[:, 0], profiles[:, 1]

    def pace(self, station: Floats) -> Floats:
        """Return the speeds [m/s] of the unattacked egos at these stations [m], ``(n,)``."""
        speed = np.empty(len(station))
        for situation, rows in zip(self._distinct, self._rows, strict=True):
            speed[rows] = np.interp(station[rows], situation.baseline.s, situation.baseline.v)
        return speed

    def ego_at(self, s: Floats, d: Floats | float = 0.0) -> tuple[Floats, Floats, Floats]:
        """Return the poses at stations and lateral offsets of the egos' paths.

        Args:
            s: Stations [m], ``(n,)`` or ``(n, k)``.
            d: Lateral offsets [m].

        Returns:
            x [m], y [m] and heading [rad], in the shape of ``s``.
        """
        return self._paths.at(_fit(self._row, s), s, d)

    def to_local(self, x: Floats, y: Floats, heading: Floats) -> tuple[Floats, Floats, Floats]:
        """Convert world poses to the frames of the egos at their triggers.

        Args:
            x: x [m], ``(n,)`` or ``(n, k)``.
            y: y [m], in the same shape.
            heading: Headings [rad], in the same shape.

        Returns:
            x [m], y [m] and heading [rad] in those frames. In left-hand traffic, y and heading are mirrored.
        """
        x0, y0, c, s, h, hand = (_fit(q, x) for q in self._frame[self._row].T)
        dx, dy = x - x0, y - y0
        return c * dx + s * dy, hand * (-s * dx + c * dy), hand * wrap(heading - h)


def _fit(values: Any, like: Floats) -> Any:
    """Reshape values ``(n,)`` so that they broadcast with ``(n,)`` or ``(n, k)``."""
    return values if np.ndim(like) == 1 else values[:, None]


def profile_at(situation: Situation, time: Floats) -> tuple[Floats, Floats]:
    """Return the motion of the unattacked ego along its path.

    The ego keeps its last speed after the end of the baseline.

    Args:
        situation: The situation.
        time: Times after the trigger [s].

    Returns:
        Stations [m] and speeds [m/s], in the shape of ``time``.
    """
    s, v = situation.baseline.s, situation.baseline.v
    last = len(s) - 1
    u = np.minimum(np.maximum(time / situation.dt, 0.0), last)
    i = np.minimum(u.astype(np.intp), last - 1)
    w = u - i
    beyond = np.maximum(time - last * situation.dt, 0.0)
    return s[i] * (1 - w) + s[i + 1] * w + beyond * v[-1], v[i] * (1 - w) + v[i + 1] * w


def _profile_at_once(s: Sequence[float], v: Sequence[float], time: float, dt: float) -> tuple[float, float]:
    """Return ``profile_at`` for one time in plain floats, because numpy is slow on scalars."""
    last = len(s) - 1
    u = min(max(time / dt, 0.0), last)
    i = min(int(u), last - 1)
    w = u - i
    beyond = max(time - last * dt, 0.0)
    return s[i] * (1 - w) + s[i + 1] * w + beyond * v[-1], v[i] * (1 - w) + v[i + 1] * w


EMERGENCY_BRAKING_FACTOR = 1.2  # [-]; in an emergency, Krauss's driver brakes this many times as hard as necessary
NUMERICAL_EPS = 0.001  # SUMO's NUMERICAL_EPS


class CarFollowing:
    """The car following of a driver model in steps of ``dt`` [s].

    Attributes:
        krauss: Whether the driver follows Krauss; otherwise it follows the IDM.
        acceleration: Its acceleration [m/s2].
        deceleration: Its comfortable deceleration [m/s2].
        tau: Its headway [s].
        min_gap: Its gap at a standstill [m].
        desired_speed: Its desired speed [m/s], at least 1.
    """

    def __init__(self, model: DriverModel, dt: float) -> None:
        """Take the parameters of a driver model.

        Args:
            model: The driver model.
            dt: The step length [s].
        """
        self.krauss = model.kind == "krauss"
        self.acceleration, self.deceleration = model.acceleration, model.deceleration
        self._hardest = model.hardest_braking
        self.tau, self.min_gap, self.desired_speed = model.tau, model.min_gap, max(model.speed, 1.0)
        self._dt = dt
        self._twice_root = float(2 * np.sqrt(self.acceleration * self.deceleration))

    def free(self, v: Floats) -> Floats:
        """Return the speed after the next step without a leader [m/s], from speed ``v`` [m/s]."""
        a = self.acceleration if self.krauss else self.acceleration * (1 - (v / self.desired_speed) ** 4)
        return np.asarray(np.maximum(v + a * self._dt, 0.0))

    def behind(self, v: Floats, gap: Floats, leader: Floats) -> Floats:
        """Return the speed after the next step behind a leader.

        Args:
            v: The present speed [m/s].
            gap: The gap between the bumpers [m].
            leader: The speed of the leader [m/s].

        Returns:
            The speed [m/s].
        """
        if self.krauss:
            return self._safe_behind(v, gap - self.min_gap, leader)
        desired_gap = self.min_gap + np.maximum(0.0, v * self.tau + v * (v - leader) / self._twice_root)
        return self._idm(v, desired_gap, gap)

    def stopping(self, v: Floats, room: Floats) -> Floats:
        """Return the speed after the next step before a place to stop, without a headway (``stopSpeed``).

        Args:
            v: The present speed [m/s].
            room: The distance to the place [m].

        Returns:
            The speed [m/s].
        """
        if self.krauss:
            return self._safe(room, self._dt)
        desired_gap = v * self.tau + v * v / self._twice_root
        return np.where(room < 0.01, 0.0, self._idm(v, desired_gap, room))

    def _safe(self, room: Floats, headway: float) -> Floats:
        """Return the speed from which constant braking in steps ends within ``room`` [m]
        (``maximumSafeStopSpeedEuler``).
        """
        b, dt, t, usable = self.deceleration * self._dt, self._dt, headway, np.maximum(room - NUMERICAL_EPS, 0.0)
        root = np.sqrt(np.maximum(dt * dt + 4.0 * (dt * (2.0 * usable / b - t) + t * t), 0.0))
        n = np.floor(0.5 - (t - root / 2.0) / dt)
        distance = 0.5 * n * (n - 1.0) * b * dt + n * b * t
        return np.asarray(np.where(room < NUMERICAL_EPS, 0.0, n * b + (usable - distance) / (n * dt + t)))

    def _safe_behind(self, v: Floats, room: Floats, leader: Floats) -> Floats:
        """Return Krauss's safe speed (``maximumSafeFollowSpeed``) [m/s].

        If comfortable braking is not enough, the driver brakes harder than necessary by ``EMERGENCY_BRAKING_FACTOR``.
        """
        dt = self._dt
        safe = self._safe(np.maximum(room, 0.0) + brake_gap(leader, self.deceleration, dt), self.tau)
        safe = np.where(room >= 0.0, safe, v - self._hardest * dt)
        hard = (v - safe) / dt
        if not (hard > self.deceleration + NUMERICAL_EPS).any():
            return safe
        usable = np.maximum(room, NUMERICAL_EPS)
        needed = 0.5 * v * v / (usable + 0.5 * leader * leader / self.deceleration)
        needed = np.where(needed <= self.deceleration, needed, 0.5 * (v * v - leader * leader) / usable)
        needed = np.minimum(
            np.maximum(EMERGENCY_BRAKING_FACTOR * np.where(room > 0.0, needed, self._hardest), self.deceleration), hard
        )
        return np.where(hard > self.deceleration + NUMERICAL_EPS, np.maximum(v - needed * dt, 0.0), safe)

    def _idm(self, v: Floats, desired_gap: Floats, gap: Floats) -> Floats:
        """Return the IDM's speed after the next step [m/s]."""
        a = self.acceleration * (1 - (v / self.desired_speed) ** 4 - (desired_gap / np.maximum(gap, 0.1)) ** 2)
        return np.maximum(v + a * self._dt, 0.0)


def brake_gap(v: Floats, deceleration: float, dt: float) -> Floats:
    """Return the braking distance to a standstill with constant braking in steps (``brakeGapEuler``).

    Args:
        v: The initial speed [m/s].
        deceleration: The braking [m/s2].
        dt: The step length [s].

    Returns:
        The distance [m], in the shape of ``v``.
    """
    b = deceleration * dt
    steps = np.floor(v / b)
    return dt * (steps * v - b * steps * (steps + 1.0) / 2.0)


FAR_AWAY_M = 1e4
# A driver expects other vehicles to approach a junction with this acceleration, up to this speed.
FOE_ACCELERATION_M_S2 = 2.6
FOE_SPEED_M_S = 13.9
# A driver that gives way wants to be across this long before another vehicle arrives (jmTimegapMinor).
MINOR_TIME_GAP_S = 1.0
# Right-of-way letters with which the ego waits for no adversary. At an all-way stop (w), the vehicle that stopped
# first goes first, and an approaching adversary has not stopped.
UNYIELDING_LETTERS = ("", "M", "O", "o", "w")
# A driver decides at this distance before the line (SUMO's visibility distance); until then it brakes as if to stop.
VISIBILITY_DISTANCE_M = 4.5
MEETING_CLEARANCE_M = 2.0  # kept before and behind the meeting place, for the vehicle on the other path
MAX_MEETING_DISTANCE_M = 60.0  # from the beginning of a junction; a meeting place farther away is on another junction
POSITION_EPS_M = 0.1  # before the line or the junction at which a driver stops (SUMO's POSITION_EPS)
HALTING_SPEED_M_S = 0.1  # the minimum speed at which a driver expects another one to leave (SUMO's haltingSpeed)


class AtJunction(NamedTuple):
    """The adversaries at the junction where their paths meet the ego's path.

    All arrays have shape ``(n,)``. Stations are those of the ego's path.

    Attributes:
        entered: Whether the adversary's front is on the junction or past it.
        on_junction: Whether it has entered and its rear has not passed the meeting place yet.
        has_bay: Whether it waits on the junction when it turns.
        ran_red: Whether it came against a red light, so that SUMO never expects it.
        goes_first: Whether it has the right of way over an ego that gives way.
        merging: Whether the paths merge; otherwise they cross.
        meets_at: The station of the meeting place [m]; inf without one.
        half_zone: Half the length of the meeting place [m].
        joins_at: The station where merging paths become one [m].
        front_to_zone: The distance from the adversary's front to the beginning of the meeting place [m].
        rear_to_zone: The distance from the adversary's rear to the beginning of the meeting place [m].
        rear_to_exit: The distance from the adversary's rear to the end of the junction [m].
        rear_station: The station of the adversary's rear if the paths merge [m].
        speed: The adversary's speed [m/s].
    """

    entered: Bools
    on_junction: Bools
    has_bay: Bools
    ran_red: Bools
    goes_first: Bools
    merging: Bools
    meets_at: Floats
    half_zone: Floats
    joins_at: Floats
    front_to_zone: Floats
    rear_to_zone: Floats
    rear_to_exit: Floats
    rear_station: Floats
    speed: Floats


class Junctions:
    """The junctions ahead of ``n`` egos.

    The object remembers which vehicle of each pair was on the junction first, so its steps must be taken in order.
    """

    def __init__(self, scenes: SituationBatch, driver: CarFollowing) -> None:
        """Start before any vehicle has entered a junction.

        Args:
            scenes: The situations of the egos.
            driver: The car following of the egos.
        """
        self._driver, self._half, self._dt = driver, scenes.ego.length / 2, scenes.dt
        self._enters, self._bay = scenes.each(lambda s: s.road.junction), scenes.each(lambda s: s.road.bay)
        has_bay = np.isfinite(self._bay)
        self._begins = np.where(has_bay, self._bay, self._enters)
        must_stop = scenes.each(lambda s: float(s.road.rule not in UNYIELDING_LETTERS)) > 0.0
        self._line = np.where(has_bay, self._bay, np.where(must_stop, self._enters, math.inf))
        self._gives_way = bool(np.isfinite(self._line).any())
        self._sees = np.where(has_bay & (scenes.each(_has_priority) > 0.0), FAR_AWAY_M, VISIBILITY_DISTANCE_M)
        later = [situation.road.later for situation in scenes.of]
        n, most = len(later), max(map(len, later))
        self._later = np.array([(*rest, *[math.inf] * (most - len(rest))) for rest in later]).reshape(n, most)
        self._ego_first_at = np.full(n, np.nan)  # station of the beginning of the junction on which the ego was first
        self._adversary_entered = np.zeros(n, bool)

    def bound(self, adversary: AtJunction, s: Floats, v: Floats) -> Floats:
        """Return the highest speeds that SUMO's rules allow the egos.

        The ego keeps clear of an adversary on the junction, even if the ego has priority. An ego that was on the
        junction first need not keep clear until the adversary reaches the meeting place. If the ego has to give way, it
        waits at its line.

        Args:
            adversary: The adversaries at the junction.
            s: Stations of the egos [m], ``(n,)``.
            v: Speeds of the egos [m/s], ``(n,)``.

        Returns:
            The speeds [m/s], ``(n,)``; inf if no rule applies.
        """
        front = s + self._half
        late = adversary.goes_first | adversary.ran_red
        begins, enters = self._meeting_junction(adversary.meets_at)
        near = (adversary.meets_at < begins + MAX_MEETING_DISTANCE_M) | ~np.isfinite(adversary.meets_at)
        ego_first = (front > np.where(late, begins, enters)) & near & ~self._adversary_entered
        ego_first &= ~adversary.entered | (v >= adversary.speed)  # if both enter in one step, the slower one yields
        self._ego_first_at = np.where(ego_first, begins, self._ego_first_at)
        self._adversary_entered |= adversary.entered
        clear = np.full(len(v), np.inf)
        if (adversary.on_junction & adversary.merging).any():
            clear = np.where(adversary.merging, self._merging(adversary, begins, front, v), clear)
        if (adversary.on_junction & ~adversary.merging).any():
            clear = np.where(adversary.merging, clear, self._crossing(adversary, begins, front, v))
        return np.minimum(clear, self._giving_way(adversary, begins, front, v)) if self._gives_way else clear

    def _meeting_junction(self, meets_at: Floats) -> tuple[Floats, Floats]:
        """Return the stations from which the egos keep clear of the junction with the meeting place, and at which they
        enter it.
        """
        if not self._later.shape[1]:
            return self._begins, self._enters
        met = np.isfinite(meets_at)[:, None] & (self._later < meets_at[:, None])
        at = np.where(met, self._later, -np.inf).max(axis=1)
        return np.where(at > 0.0, at, self._begins), np.where(at > 0.0, at, self._enters)

    def _merging(self, adversary: AtJunction, begins: Floats, front: Floats, v: Floats) -> Floats:
        """Follow a merging adversary as a leader; if it is not far enough ahead, do not enter the junction."""
        gap = adversary.rear_station - front
        beside = (front < adversary.joins_at) & (self._ego_first_at != begins)
        in_zone = (front < adversary.meets_at) & (adversary.front_to_zone < 0.0)
        entry = np.where(np.isfinite(begins), begins - front - POSITION_EPS_M, 0.0)
        follow = self._driver.behind(v, np.minimum(gap, FAR_AWAY_M), adversary.speed)
        speed = np.where(gap >= self._driver.min_gap, follow, self._driver.stopping(v, entry))
        return np.where(adversary.on_junction & (beside | in_zone), speed, np.inf)

    def _crossing(self, adversary: AtJunction, begins: Floats, front: Floats, v: Floats) -> Floats:
        """Stop before the meeting place, or slow down to arrive after a crossing adversary has passed it."""
        to_zone = np.minimum(adversary.meets_at - adversary.half_zone - front, FAR_AWAY_M)
        to_clear = np.maximum(adversary.rear_to_zone + 2 * adversary.half_zone, 0.0)  # until its rear is past
        in_zone = (to_zone > 0.0) & (adversary.front_to_zone < 0.0)
        held = adversary.on_junction & (to_zone + 2 * adversary.half_zone >= 0.0)
        held &= (self._ego_first_at != begins) | in_zone
        if not held.any():
            return np.full(len(v), np.inf)
        driver, gap = self._driver, to_zone - self._driver.min_gap - to_clear
        room = to_zone - driver.min_gap
        entry = np.where(np.isfinite(begins), begins - front - POSITION_EPS_M, room)
        follow = driver.behind(v, gap + driver.min_gap, adversary.speed)
        speed = np.where(gap >= 0.0, follow, driver.stopping(v, entry))
        time = np.maximum(to_clear, 1e-3) / np.maximum(adversary.speed, HALTING_SPEED_M_S)
        later = v + (np.maximum(v, 2 * room / time - v) - v) / time * self._dt
        speed = np.where(to_zone >= 0.0, np.maximum(speed, np.minimum(later, driver.stopping(v, room))), speed)
        before_bay = np.isfinite(self._bay) & (front < begins)
        speed = np.where(before_bay, driver.stopping(v, entry), speed)
        return np.where(held, speed, np.inf)

    def _giving_way(self, adversary: AtJunction, begins: Floats, front: Floats, v: Floats) -> Floats:
        """Wait at the line if the ego can still stop there and would share the junction with the adversary.

        The ego expects the adversary to accelerate. On the junction, only an adversary that turns through a bay counts.
        """
        room = np.where(np.isfinite(self._line), self._line - front, -FAR_AWAY_M)
        left = adversary.meets_at - front
        stops = (room > -0.5) & (room < self._sees) & (room > brake_gap(v, self._driver.deceleration, self._dt))
        stops &= adversary.goes_first & ~adversary.ran_red & (~adversary.on_junction | adversary.has_bay)
        stops &= np.isfinite(adversary.meets_at) & (begins == self._begins) & (adversary.rear_to_exit > 0.0)
        if not stops.any():
            return np.full(len(v), np.inf)
        arrival = travel_time(adversary.front_to_zone + adversary.half_zone, adversary.speed, FOE_ACCELERATION_M_S2)
        gone = travel_time(adversary.rear_to_exit, adversary.speed, FOE_ACCELERATION_M_S2)
        at_line = travel_time(room, v, self._driver.acceleration)
        across = travel_time(left + 2 * self._half + MEETING_CLEARANCE_M, v, self._driver.acceleration)
        waits = stops & (across + MINOR_TIME_GAP_S > arrival) & (gone > at_line)
        return np.where(waits, self._driver.stopping(v, np.maximum(room - POSITION_EPS_M, 0.0)), np.inf)


def _has_priority(situation: Situation) -> float:
    """Return 1 if the ego has a green light with priority, or no light and the right of way; 0 otherwise."""
    lights = situation.traffic.signals.get(situation.ego.id, ())
    return float(lights[0][2] == "G" if lights else situation.road.rule == "M")


def travel_time(distance: Floats, speed: Floats, acceleration: float, fastest: float = FOE_SPEED_M_S) -> Floats:
    """Return the time for a distance with constant acceleration.

    Args:
        distance: The distance [m]; negative ones take 0 s.
        speed: The initial speed [m/s].
        acceleration: The acceleration [m/s2].
        fastest: The speed at which the acceleration ends [m/s].

    Returns:
        The time [s].
    """
    distance, initial = np.maximum(distance, 0.0), np.maximum(speed, 0.01)
    final = np.maximum(np.minimum(np.sqrt(initial * initial + 2 * acceleration * distance), fastest), initial)
    span = (final - initial) / acceleration
    return np.maximum(span + (distance - (initial + final) / 2 * span) / final, 0.0)
