"""The counterfactual: the same encounter with a reference driver as the ego, rolled out for N encounters at once.

The adversary and third vehicles move as recorded, then as planned, then straight on at constant speed. The ego moves
as recorded until the driver's rule says that a danger shows. From then on, the driver brakes on the ego's path at least
as hard as the recorded ego did. The path continues as the ego went without the attack, or straight. While the driver
does not brake, the ego's speed changes as it was recorded, up to the recorded speed. Contact is swept between steps.
A driver avoids the collision if it touches no vehicle, apart from those that run into it from behind in its lane.

A pedestrian or cyclist is seen only while a line from the unchanged ego's centre to its centre or a corner passes
through no other box, standing or moving (``metrics/reference/view.py``). Until then, no danger shows to any driver.

The unchanged ego (recorded motion, then constant speed) is rolled out by the same code. If it has no collision in this
check, the check is inconclusive.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sumo_adv.datatypes import Bools, Boxes, Floats, Ints
from sumo_adv.metrics.avoidance import OnRoad, escapes, stays_on_road, window
from sumo_adv.metrics.boxes import first_contact, height_as, pick, some_steps, touches
from sumo_adv.metrics.contact import SAME_DIRECTION
from sumo_adv.metrics.reference import BRAKERS, COMPETENT, MANOEUVRE, REFERENCE_DRIVERS, Braker
from sumo_adv.metrics.reference.cc_human import CcHuman
from sumo_adv.metrics.reference.sight import beyond
from sumo_adv.metrics.reference.view import EgoPaths, Views, located_on, seen

Located = tuple[Floats, Floats, Floats]
"""Stations [m], offsets [m] and path headings [rad] on the egos' paths."""
MakeDriver = Callable[[tuple[int, int], float], Braker]
"""Makes drivers for a shape (N, M) and a step [s]: a class of ``BRAKERS``, or one with other numbers."""
MIN_AFTER_CONTACT_S = 4.0  # how long the check continues after the contact, at least


@dataclass(frozen=True, slots=True)
class Encounters:
    """N encounters on one grid.

    Attributes:
        ego: The recorded egos ``(N, T)``; their motion after the step ``last`` does not count.
        adversary: The adversaries ``(N, T')``, as recorded and then as planned.
        start: The step from which a driver may act ``(N,)``. Views begin at step 0, so drivers have some history.
        last: The last step of each ego that counts ``(N,)``.
        dt: Step [s].
        others: The other vehicles ``(N, K, T'')``, or ``(K, T'')`` if they are the same for all N. NaN = absent; None =
            no vehicle.
        lane_half_width: Half the width of the egos' lanes [m].
        onward: Points of the egos' ways past the step ``last`` ``(N, P, 2)`` [m]; without them, the egos go straight
            on.
        until: The last step that is checked ``(N,)``; without it, all steps are.
        sight: How far the recorded egos see along their ways ``(N, T)`` [m]; None = without limit.
    """

    ego: Boxes
    adversary: Boxes
    start: Ints
    last: Ints
    dt: float
    others: Boxes | None = None
    lane_half_width: float = 1.6
    onward: Floats | None = None
    until: Ints | None = None
    sight: Floats | None = None


@dataclass(frozen=True, slots=True)
class DriverOutcome:
    """How one driver fares in N encounters. Arrays are ``(N,)``.

    Attributes:
        avoids: Whether the driver avoids the collision.
        alarm: When a danger first showed to the driver [s from step 0]; ``inf`` = never.
        contact: The driver's own first contact that counts [s from step 0]; ``inf`` = never.
    """

    avoids: Bools
    alarm: Floats
    contact: Floats


class Counterfactual:
    """N encounters extended to the end of the check, with everything that does not depend on the driver.

    Attributes:
        given: The encounters.
        steps: Number of steps that are checked.
        time: Times of the steps ``(steps,)`` [s from step 0].
        ego: The unchanged egos ``(N, steps)``.
        adversary: The adversaries ``(N, steps)``.
        others: The other vehicles ``(N, K, steps)``; None if there are none.
        shape: The numbers of egos and of vehicles around each.
        paths: The egos' paths.
    """

    def __init__(self, given: Encounters, beyond: float = MIN_AFTER_CONTACT_S) -> None:
        """Extend the encounters.

        Args:
            given: The encounters.
            beyond: How long the check continues after the step ``last``, at least [s].
        """
        self.given = given
        dt = given.dt
        planned = given.adversary.x.shape[1]
        self.steps = int(max(int(given.last.max(initial=0)) + round(beyond / dt), planned - 1)) + 1
        self._until = np.full(len(given.last), self.steps - 1) if given.until is None else given.until
        self.time: Floats = np.asarray(np.arange(self.steps) * dt, dtype=np.float64)
        first, count = np.zeros_like(given.last), given.ego.x.shape[1]
        self.ego = _along(_extended(window(given.ego, first, count - 1, dt, given.last), self.steps, dt), given)
        self.adversary = _extended(given.adversary, self.steps, dt)
        self.others = (
            None if given.others is None else _for_all(_extended(given.others, self.steps, dt), len(self.ego.x))
        )
        self.shape = (len(self.ego.x), 1 if self.others is None else 1 + self.others.x.shape[1])  # egos, vehicles
        self.paths = EgoPaths(self.ego)

    @cached_property
    def views(self) -> Views:
        """What drivers see in each step."""
        visible = self._everybody(seen(self.ego, self.adversary, self.others))
        located = self._in_sight(located_on(self.paths, visible), visible)
        return Views(visible, located, self._ego_size(), self.given.dt, self.given.lane_half_width)

    def _in_sight(self, located: Located, vehicles: Boxes) -> Located:
        """Return the places of vehicles; NaN while the recorded ego cannot see so far along its way."""
        limit = self.given.sight
        if limit is None:
            return located
        limit = np.pad(limit, ((0, 0), (0, max(0, self.steps - limit.shape[1]))), mode="edge")[:, : self.steps]
        sizes = np.asarray(vehicles.length, float), np.asarray(vehicles.width, float)
        away = beyond(located, vehicles.heading, sizes, self.paths.station, limit)
        station, left, heading = (np.where(away, np.nan, values) for values in located)
        return station, left, heading

    def unchanged(self) -> DriverOutcome:
        """Return how the egos fare as they were."""
        return self._touched(self.ego, self.paths.station)

    def braking(self, driver: MakeDriver) -> DriverOutcome:
        """Return how a driver that brakes fares.

        Args:
            driver: Makes the drivers.
        """
        station, speed, alarm = self.roll_out(driver)
        return replace(self.moving(station, speed), alarm=alarm)

    def moving(self, station: Floats, speed: Floats) -> DriverOutcome:
        """Return how egos fare that move along their paths in a given way.

        Args:
            station: Their stations ``(N, steps)`` [m].
            speed: Their speeds ``(N, steps)`` [m/s].
        """
        x, y, heading = self.paths.poses(station)
        z = self.paths.heights(station)
        return self._touched(replace(self.ego, x=x, y=y, heading=heading, speed=speed, z=z), station)

    def manoeuvring(self, alarm: Floats, on_road: OnRoad | None = None) -> tuple[DriverOutcome, Ints]:
        """Return how egos fare that brake and steer.

        Args:
            alarm: When a danger shows to each ego ``(N,)`` [s from step 0]; ``inf`` = never.
            on_road: Returns which points are drivable; None if all are.

        Returns:
            The outcome, and the index of the best manoeuvre in ``avoidance.TABLE`` ``(N,)``; -1 = none avoids the
            collision.
        """
        alarmed = np.isfinite(alarm)
        best = np.full(len(alarm), -1)
        contact = np.where(alarmed, 0.0, np.inf) if alarmed.all() else np.where(alarmed, 0.0, self.unchanged().contact)
        first = np.round(np.where(alarmed, alarm, 0.0) / self.given.dt).astype(np.intp)
        rows = np.flatnonzero(alarmed & (self._until - first >= 2))
        if len(rows):
            ego, adversary = pick(self.ego, rows), pick(self.adversary, rows)
            poses, clear = escapes(ego, adversary, first[rows], self._until[rows] - first[rows], self.given.dt)
            for place, row in enumerate(rows.tolist()):
                tried = np.flatnonzero(clear[:, place])
                clear[tried, place] = self._clear_of_others(poses, tried, row, place, int(first[row]))
            if on_road is not None:
                clear &= stays_on_road(poses, clear, on_road, self.given.dt)
            some = clear.any(axis=0)
            best[rows[some]], contact[rows[some]] = clear.argmax(axis=0)[some], np.inf
        return DriverOutcome(best >= 0, alarm, contact), best

    def roll_out(self, driver: MakeDriver) -> tuple[Floats, Floats, Floats]:
        """Roll out the egos with a driver.

        Args:
            driver: Makes the drivers.

        Returns:
            The stations [m] and speeds [m/s] of the egos ``(N, steps)``, and when a danger first showed ``(N,)`` [s
            from step 0]; ``inf`` = never.
        """
        n, dt = len(self.ego.x), self.given.dt
        drivers = driver(self.shape, dt)
        recorded, pace = self.paths.station, self.ego.speed
        change = np.diff(pace, axis=1, append=pace[:, -1:]) / dt
        station, speed = recorded.copy(), np.array(np.broadcast_to(pace, recorded.shape))
        acceleration = np.zeros(n)
        acting, alarmed, alarm = np.zeros(n, bool), np.zeros(n, bool), np.full(n, np.inf)
        for k in range(self.steps - 1):
            reaction = drivers.step(self.views.at(k, station[:, k], speed[:, k], acceleration))
            if not alarmed.all():
                alarm = np.where(drivers.alarmed & ~alarmed, self.time[k], alarm)
                alarmed = np.isfinite(alarm)
            brakes, present = np.isfinite(reaction), speed[:, k]
            acting |= brakes & (k >= self.given.start)
            if acting.any():
                braking = np.minimum(np.where(brakes, reaction, np.inf), change[:, k])
                after = np.clip(present + braking * dt, 0.0, np.maximum(pace[:, k + 1], present))
                evenly = (present + after) / 2 * dt
                moved = np.where(after > 0.0, evenly, present**2 / np.maximum(-2 * braking, 1e-9))
                moved = np.minimum(moved, evenly)
                station[:, k + 1] = np.where(acting, station[:, k] + moved, recorded[:, k + 1])
                speed[:, k + 1] = np.where(acting, after, speed[:, k + 1])
            acceleration = (speed[:, k + 1] - present) / dt
        return station, speed, alarm

    def _touched(self, ego: Boxes, station: Floats) -> DriverOutcome:
        """Find when the egos first touch a vehicle that does not run into them from behind in their lane."""
        n = len(ego.x)
        wide = Boxes(
            ego.x[:, None], ego.y[:, None], ego.heading[:, None], np.asarray(ego.speed)[:, None],
            _size(ego.length, n), _size(ego.width, n), height_as(ego, lambda z: z[:, None]),
        )  # fmt: skip
        when = first_contact(wide, self._everybody(), self.time)
        first, last = (steps[:, None] * self.given.dt for steps in (self.given.start, self._until))
        when = np.where((when >= first - 1e-9) & (when <= last + 1e-9), when, np.inf)
        rows, columns = pairs = np.nonzero(np.isfinite(when))
        if len(rows):
            k = np.minimum(np.floor(when[pairs] / self.given.dt + 1e-9).astype(np.intp), self.steps - 1)
            there, left, heading = self.views.place(rows, columns, k)
            behind = (there < station[rows, k]) & (np.abs(left) < self.given.lane_half_width)
            when[pairs] = np.where(behind & (np.abs(heading) < SAME_DIRECTION), np.inf, when[pairs])
        contact = np.asarray(when.min(axis=1))
        return DriverOutcome(~np.isfinite(contact), np.full(n, np.inf), contact)

    def _clear_of_others(self, poses: Boxes, which: Ints, row: int, place: int, first: int) -> Bools:
        """Return which manoeuvres of a row touch no other vehicle, apart from those that come from behind in the lane.

        Args:
            poses: Poses of the manoeuvres ``(manoeuvres, rows, steps + 1)``.
            which: Indices of the manoeuvres to check.
            row: The encounter.
            place: The encounter's row in ``poses``.
            first: The step at which the poses begin.
        """
        if self.others is None or not len(which) or not self.others.x.shape[1]:
            return np.ones(len(which), bool)
        o = self.others
        part, steps = slice(first, int(self._until[row]) + 1), slice(int(self._until[row]) + 1 - first)
        there_x, there_y, turned, pace = (v[row][:, part] for v in (o.x, o.y, o.heading, o.speed))
        size = np.asarray(o.length)[row], np.asarray(o.width)[row]
        near = Boxes(there_x, there_y, turned, pace, *size, height_as(o, lambda z: z[row][:, part]))
        x, y, heading, speed = (v[which, place][:, None, steps] for v in (poses.x, poses.y, poses.heading, poses.speed))
        z = height_as(self.ego, lambda z: z[row, part][None, None])
        ego = Boxes(x, y, heading, speed, *self._ego_size(), z)
        others = np.arange(1, self.others.x.shape[1] + 1)
        there, left, _ = self.views.place(row, others, first)
        behind = (there < self.paths.station[row, first]) & (np.abs(left) < self.given.lane_half_width)
        return np.asarray(~(touches(ego, near) & ~behind[None, :]).any(axis=1))

    def _everybody(self, adversary: Boxes | None = None) -> Boxes:
        """Return the adversary (as it is, or as given) and the others, ``(N, 1 + K, steps)``."""
        a, n = self.adversary if adversary is None else adversary, len(self.ego.x)
        sizes = _size(a.length, n), _size(a.width, n)
        if self.others is None:
            x, y, heading, speed = (v[:, None, :] for v in (a.x, a.y, a.heading, a.speed))
            return Boxes(x, y, heading, speed, *sizes, height_as(a, lambda z: z[:, None, :]))
        o = self.others
        x, y, heading, speed = (
            np.concatenate([p[:, None, :], q], axis=1)
            for p, q in ((a.x, o.x), (a.y, o.y), (a.heading, o.heading), (a.speed, o.speed))
        )
        length, width = (np.concatenate(pair, axis=1) for pair in zip(sizes, (o.length, o.width), strict=True))
        z: Floats | float = a.z
        if np.ndim(a.z) or np.ndim(o.z):
            z = np.concatenate([np.broadcast_to(a.z, a.x.shape)[:, None, :], np.broadcast_to(o.z, o.x.shape)], axis=1)
        return Boxes(x, y, heading, speed, length, width, z)

    def _ego_size(self) -> tuple[float, float]:
        return float(np.ravel(self.ego.length)[0]), float(np.ravel(self.ego.width)[0])


def driver_outcomes(
    given: Encounters, drivers: Sequence[str] = REFERENCE_DRIVERS, on_road: OnRoad | None = None,
    *, until_avoided: bool = False,
) -> dict[str, DriverOutcome]:  # fmt: skip
    """Return how each driver fares in the encounters.

    Args:
        given: The encounters.
        drivers: The names of the reference drivers.
        on_road: Returns which points are drivable; None if all are.
        until_avoided: Whether to stop once the level is known; only for a single encounter. No driver is run if the
            unchanged ego misses, and none after the first driver that avoids the collision. Only drivers that count
            (``COMPETENT``) are run, ``cc_human`` first.

    Returns:
        The outcomes by driver, with that of the ego as it was as ``unchanged``.
    """
    check = Counterfactual(given)
    by_driver = {"unchanged": check.unchanged()}
    asked = [name for name in drivers if name in COMPETENT] if until_avoided else drivers
    for name in sorted(asked, key=lambda n: (n == MANOEUVRE, n != "cc_human")):
        if until_avoided and any(bool(answer.avoids[0]) for answer in by_driver.values()):
            break
        if name in BRAKERS:
            by_driver[name] = check.braking(BRAKERS[name])
        elif name == MANOEUVRE:
            alarm = by_driver["cc_human"].alarm if "cc_human" in by_driver else check.roll_out(CcHuman)[2]
            by_driver[MANOEUVRE] = check.manoeuvring(alarm, on_road)[0]
    return by_driver


def _size(value: Floats | float, n: int) -> Floats:
    """Return a size as ``(N, 1, 1)``."""
    return np.reshape(np.broadcast_to(np.asarray(value, float), (n, 1)), (n, 1, 1))


def _along(ego: Boxes, given: Encounters) -> Boxes:
    """Move the egos at constant speed along their ways past the step ``last``, and straight on after the ways end."""
    if given.onward is None:
        return ego
    x, y, heading = ego.x.copy(), ego.y.copy(), np.array(np.broadcast_to(ego.heading, ego.x.shape))
    for row, last in enumerate(given.last.tolist()):
        ahead = given.onward[row][np.isfinite(given.onward[row]).all(axis=1)]
        count = x.shape[1] - last - 1
        if not len(ahead) or count < 1:
            continue
        points = np.concatenate([[[x[row, last], y[row, last]]], ahead])
        turns = np.arctan2(*np.diff(points, axis=0).T[::-1])
        px, py, ph = (v[None] for v in (*points.T, np.append(turns, turns[-1])))
        way = EgoPaths(Boxes(px, py, ph, ego.speed[:1, :1], 1.0, 1.0))
        moved = ego.speed[row, last] * given.dt * np.arange(1, count + 1)
        x[row, last + 1 :], y[row, last + 1 :], _ = (v[0] for v in way.poses(moved[None]))
        steps = np.minimum(np.searchsorted(way.station[0], moved, side="right") - 1, len(turns) - 1)
        heading[row, last + 1 :] = turns[np.maximum(steps, 0)] if ego.speed[row, last] > 0.1 else heading[row, last]
    return replace(ego, x=x, y=y, heading=heading)


def _extended(b: Boxes, steps: int, dt: float) -> Boxes:
    """Extend motions (time is the last axis) to ``steps``, straight on at constant speed."""
    have = b.x.shape[-1]
    if have >= steps:
        return some_steps(b, slice(steps))
    on = np.arange(1, steps - have + 1) * dt * b.speed[..., -1:]
    x = np.concatenate([b.x, b.x[..., -1:] + on * np.cos(b.heading[..., -1:])], axis=-1)
    y = np.concatenate([b.y, b.y[..., -1:] + on * np.sin(b.heading[..., -1:])], axis=-1)
    heading, speed = (
        np.concatenate([v, np.repeat(v[..., -1:], steps - have, axis=-1)], axis=-1) for v in (b.heading, b.speed)
    )
    z = height_as(b, lambda z: np.concatenate([z, np.repeat(z[..., -1:], steps - have, axis=-1)], axis=-1))
    return Boxes(x, y, heading, speed, b.length, b.width, z)


def _for_all(others: Boxes, n: int) -> Boxes:
    """Return the others as ``(N, K, steps)`` with sizes ``(N, K, 1)``."""
    k = others.x.shape[-2]
    sizes = (np.asarray(v, float) for v in (others.length, others.width))
    length, width = (np.broadcast_to(v if v.ndim == 3 else np.broadcast_to(v, (k, 1)), (n, k, 1)) for v in sizes)
    x, y, heading, speed = (
        np.broadcast_to(v, (n, *v.shape[-2:])) for v in (others.x, others.y, others.heading, others.speed)
    )
    z = height_as(others, lambda z: np.broadcast_to(z, (n, *z.shape[-2:])))
    return Boxes(x, y, heading, speed, length, width, z)
