"""A batch of ``n`` adversaries on their ways: one in an attempt, many in a prediction.

A way is one of the paths that a vehicle can take (``ReferencePath``). ``AdversaryBatch`` knows the way of each vehicle,
turns endpoints into goals along it, and makes the planners' observations. An observation consists of the dictionaries
``bv`` and ``ego`` in the frame of the ego's pose at the trigger.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any

import numpy as np

from sumo_adv.datatypes import Bools, Endpoint, Floats
from sumo_adv.geometry import PATH_STEP_M, wrap
from sumo_adv.metrics.contact import SAME_DIRECTION
from sumo_adv.planners.answers import PATH_TIMES_S, PlannerObservation, arrivals, expected_stations
from sumo_adv.planners.follower import Follower, PlannedCourse, starting_now
from sumo_adv.planners.trajectory import Batch, Motion, PathEndpoint, PathRow, PathRows, pose, start
from sumo_adv.road_users import is_unprotected
from sumo_adv.simulation.sumo_rules import AtJunction, SituationBatch
from sumo_adv.situation import ReferencePath, Situation, Target

TURN_COST_M_RAD = 4.0  # cost of a heading difference when an endpoint's way is chosen
WAY_CHANGE_COST_M = 0.5  # another way must be this much nearer to an endpoint than the present one
COINCIDING_WAYS_DISTANCE_M = 0.4  # ways this near to each other still coincide
MAX_LATERAL_MOVE_S = 20.0  # bound of ``lateral_time``, because the move of a vehicle that hardly moves takes minutes
MAX_TURN_ON_WAY_BACK_RAD = 0.8  # heading difference up to which an endpoint chooses a way that turns back
COARSE_WAY_STRIDE = 12  # the first search for the nearest sample of a way looks at every twelfth
COARSE_NEIGHBOURS = np.arange(1 - COARSE_WAY_STRIDE, COARSE_WAY_STRIDE)
SUMO_TURN_COST_M_RAD, SUMO_WAY_CHANGE_COST_M = 2.2, 2.0  # SUMO's costs of heading and of another way (moveToXY)
AFTER_MERGE_M = 10.0  # a vehicle counts as on the junction up to this far past the place where ways meet
FRONT_NEIGHBOURS = np.arange(-12, 13)  # samples of a way around a vehicle's front
JOINED_DISTANCE_M = 2.5  # ways this near to each other are one (SUMO's DIVERGENCE_MIN_WIDTH; at most a lane's width)


class AdversaryBatch:
    """``n`` vehicles on their ways, each in a situation of one encounter.

    Attributes:
        scenes: The situations.
        targets: The BV of each vehicle.
        rows: All ways; ``rows.row`` is the index of each vehicle's way.
        length: The vehicles' lengths [m], ``(n,)``.
        cap: The vehicles' highest speeds [m/s], ``(n,)``.
    """

    def __init__(self, situations: Sequence[Situation], names: Sequence[str], waits: Sequence[float] = ()) -> None:
        """Put each vehicle on its first way.

        Args:
            situations: The situation of each vehicle.
            names: The BV id of each vehicle. Ids may repeat.
            waits: How long each vehicle waits before its planner is asked [s]; empty if none waits.
        """
        self._waits = waits or [0.0] * len(names)
        self.scenes = SituationBatch(situations)
        self.targets: list[Target] = [s.targets[n] for s, n in zip(situations, names, strict=True)]
        unique = list({id(t): t for t in self.targets}.values())
        first = dict(zip(map(id, unique), accumulate((len(t.ways) for t in unique[:-1]), initial=0), strict=True))
        self._ways = ways = [w for t in unique for w in t.ways]
        self._base = np.array([first[id(t)] for t in self.targets])
        self._count = np.array([len(t.ways) for t in self.targets])
        self.rows = PathRows([w.path for w in ways], self._base.copy())
        longest = max(len(w.path.x) for w in ways)
        beyond = np.arange(0, longest, COARSE_WAY_STRIDE) > self.rows.last[:, None, None]
        self._coarse = np.where(beyond, np.inf, self.rows.table[:, :2, ::COARSE_WAY_STRIDE])
        relative = [(w.ego_s, w.ego_d, w.ego_h) for w in ways]
        self._ego = np.array([[np.pad(a, (0, longest - len(a)), "edge") for a in own] for own in relative])
        conflicts = {id(t): [w.conflict.ego_s if w.conflict is not None else np.inf for w in t.ways] for t in unique}
        most = int(self._count.max())
        self._conflicts = np.array([conflicts[id(t)] + [np.inf] * (most - len(t.ways)) for t in self.targets])
        self._roads: dict[int, PathRow] = {}
        self._junctions = np.array([_junction(w, situations[0].road.lane_width) for w in ways])
        self._first = np.array([w.before_ego for w in ways])
        self._bays = np.array([w.bay for w in ways])
        route = np.array([-1 if t.unattacked is None else t.unattacked for t in self.targets])
        self._route = np.where(route < 0, -1, self._base + route)  # way of its route, -1 if unknown
        self._sumo_way: Any = None  # the way that SUMO has each vehicle on
        self._enters, self._leaves = np.array([_inside(t) for t in self.targets]).T
        self._yields = np.array([_yields(s, t) for s, t in zip(situations, self.targets, strict=True)])
        self._lane = self.scenes.each(lambda s: s.road.lane_width)
        self.length = np.array([t.state.length for t in self.targets])
        self.cap = np.array([t.fastest for t in self.targets])
        self._unprotected = np.array([is_unprotected(t.state) for t in self.targets])
        self._turned = np.array([-np.inf if w.turn is None else w.turn[1] for w in ways])  # where a half turn ends

    def begin(self) -> Motion:
        """Return the motion of all vehicles at the trigger."""
        columns = [(t.station, t.offset, math.sin(t.turn), t.state.speed, t.state.acceleration) for t in self.targets]
        s, d, slope, v, a = np.array(columns, float).T
        return start(Batch, s, d, slope, v, a)

    def relative(self, motion: Motion) -> tuple[Floats, Floats, Floats]:
        """Express the box centres in the frame of the ego's path.

        Returns:
            Stations [m], offsets [m] and headings [rad], each ``(n,)``.
        """
        row = self.rows.row
        u = np.minimum(np.maximum(motion.s / PATH_STEP_M, 0.0), self._ego.shape[2] - 1.0)
        i = np.minimum(u.astype(np.intp), self._ego.shape[2] - 2)
        w = u - i
        s0, d0, h0 = self._ego[row, :, i].T
        s1, d1, _ = self._ego[row, :, i + 1].T
        h = h0 + np.arcsin(motion.slope)
        near = np.abs(s1 - s0) < 5.0  # otherwise, the nearest place on the ego's path jumps
        s, d = np.where(near, s0 + (s1 - s0) * w, s0), np.where(near, d0 + (d1 - d0) * w, d0)
        return s - motion.d * np.sin(h0), d + motion.d * np.cos(h0), wrap(h)

    def may_brake_hard(self, motion: Motion) -> Bools:
        """Return which vehicles may brake harder than people usually do.

        Vehicles in the ego's lane that go its way may, because people brake hard for what is ahead of them. Pedestrians
        and cyclists may, because they have limits of their own.

        Returns:
            A flag for each vehicle, ``(n,)``.
        """
        _, d, h = self.relative(motion)
        in_line = (np.abs(d) < self._lane / 2) & (np.abs(h) < SAME_DIRECTION)
        return np.asarray(in_line | self._unprotected)

    def at_junction(self, motion: Motion) -> AtJunction | None:
        """Describe how the vehicles block the junction where their ways meet the ego's path.

        Call this method once per step, because the way of each vehicle depends on its way in the last step. The end of
        a junction is unknown. It is assumed to be as far past the place where the ways meet as the junction's beginning
        is before that place.

        Returns:
            The vehicles' places relative to the junction, or None if no way meets the ego's path at a junction.
        """
        if not np.isfinite(self._junctions[:, 2]).any():
            return None
        row = self._find_sumo_ways(motion)
        entry, meets, ego, merging, wide, joins = self._junctions[row].T
        bay = self._bays[row]
        entry = np.where(np.isfinite(bay), bay, entry)
        half, merges = self.length / 2, merging > 0
        zone = np.where(merges, 0.0, wide * self._lane / 2)
        front, rear = motion.s + half, motion.s - half
        return AtJunction(
            entered=front > entry,
            on_junction=(front > entry) & np.where(merges, motion.s < meets, rear < meets + zone),
            has_bay=np.isfinite(bay), ran_red=self._yields, goes_first=self._first[row], merging=merges, meets_at=ego,
            half_zone=zone, joins_at=joins,
            front_to_zone=meets - zone - front, rear_to_zone=meets - zone - rear,
            rear_to_exit=2.0 * meets - entry - rear, rear_station=ego - (meets - rear), speed=motion.v,
        )  # fmt: skip

    def _find_sumo_ways(self, motion: Motion) -> Any:
        """Find the way on which SUMO places each vehicle, ``(n,)``.

        Before the junction, it is the way of the vehicle's route. On the junction, it is the way nearest to the
        vehicle's front, and the way of the last step counts as nearer (``moveToXY``).
        """
        on = (motion.s + self.length / 2 > self._enters) & (motion.s < self._leaves) & (self._count > 1)
        if self._sumo_way is None:
            self._sumo_way = np.where(self._route < 0, self.rows.row, self._route)
        keeps = on | ((self._route >= 0) & (motion.s < self._leaves))
        self._sumo_way = np.where(keeps, self._sumo_way, self.rows.row)
        rows = np.flatnonzero(on)
        if not len(rows):
            return self._sumo_way
        x, y, h = (q[rows] for q in pose(Batch, motion, self.rows))
        half = self.length[rows] / 2
        x, y = x + half * np.cos(h), y + half * np.sin(h)
        least, nearest = np.full(len(rows), np.inf), self._sumo_way[rows]
        here = ((motion.s[rows] + half) / PATH_STEP_M).astype(np.intp)
        near = np.clip(here[:, None] + FRONT_NEIGHBOURS, 0, self.rows.table.shape[2] - 1)[:, None]
        places, count = np.arange(int(self._count[rows].max())), self._count[rows][:, None]
        ways = self._base[rows][:, None] + np.where(places < count, places, 0)
        px, py = (self.rows.table[ways[:, :, None], c, near] for c in range(2))
        square = (px - x[:, None, None]) ** 2 + (py - y[:, None, None]) ** 2
        at = square.argmin(axis=2)[:, :, None]
        distance = np.sqrt(np.take_along_axis(square, at, axis=2)[:, :, 0])
        heading = self.rows.table[ways, 2, np.take_along_axis(near, at, axis=2)[:, :, 0]]
        turned = np.abs(wrap(h[:, None] - heading))
        costs = distance + SUMO_TURN_COST_M_RAD * turned - SUMO_WAY_CHANGE_COST_M * (ways == nearest[:, None])
        costs[places >= count] = np.inf
        for cost, way in zip(costs.T, ways.T, strict=True):
            better = cost < least - 1e-6
            least, nearest = np.where(better, cost, least), np.where(better, way, nearest)
        self._sumo_way[rows] = nearest
        return self._sumo_way

    def road(self, k: int) -> PathRow:
        """Return the way of vehicle ``k`` for look-ups with floats."""
        row = int(self.rows.row[k])
        if row not in self._roads:
            self._roads[row] = PathRow(self._ways[row].path)
        return self._roads[row]

    # -- endpoints ----------------------------------------------------------------------------------------------

    def aim(self, motion: Motion, ends: Sequence[Endpoint | None], before: PathEndpoint) -> PathEndpoint:
        """Put each vehicle on the way that leads to its endpoint, and return goals along these ways.

        A way that turns back is chosen only by an endpoint that goes its way after the turn. Other ways lead to the
        places before the turn.

        Args:
            motion: The vehicles' motion.
            ends: The endpoint of each vehicle in the world, or None. A vehicle without an endpoint keeps its way and
                goal.
            before: The previous goals.
        """
        have = np.array([e is not None for e in ends])
        values = [(e.x, e.y, e.heading, e.speed, e.time) if e else (0.0, 0.0, 0.0, 0.0, 1.0) for e in ends]
        x, y, h, v, time = np.array(values, float).T
        least = np.full(len(ends), np.inf)
        best, best_s, best_d = self.rows.row.copy(), before.s.copy(), before.d.copy()
        here = pose(Batch, motion, self.rows) if int(self._count.max()) > 1 else None
        for k in range(int(self._count.max())):
            vehicles = np.flatnonzero(have & (self._count > k))
            row = self._base[vehicles] + k
            s, d, turned = self._project(row, x[vehicles], y[vehicles], h[vehicles])
            same = row == self.rows.row[vehicles]
            cost = np.abs(d) + TURN_COST_M_RAD * turned - WAY_CHANGE_COST_M * same
            after = (s > self._turned[row] - PATH_STEP_M) & (turned < MAX_TURN_ON_WAY_BACK_RAD)
            better = (cost < least[vehicles]) & (same | after | np.isinf(self._turned[row]))
            if here is not None:
                part = motion._replace(s=motion.s[vehicles], d=motion.d[vehicles], slope=motion.slope[vehicles])
                there = pose(Batch, part, self.rows.on(row))
                apart = np.hypot(there[0] - here[0][vehicles], there[1] - here[1][vehicles])
                better &= (apart < COINCIDING_WAYS_DISTANCE_M) | same
            to = vehicles[better]
            least[to], best[to], best_s[to], best_d[to] = cost[better], row[better], s[better], d[better]
        self.rows.row = best
        return PathEndpoint(best_s, best_d, np.where(have, v, before.v), np.where(have, time, before.time))

    def _project(self, row: Any, x: Floats, y: Floats, h: Floats) -> tuple[Floats, Floats, Floats]:
        """Project poses ``(n,)`` onto the ways ``row``: stations and offsets [m], and heading differences [rad].

        The two legs of a way that turns back lie beside each other. The heading of the pose tells the leg.
        """
        table, last = self.rows.table, self.rows.last[row]
        coarse, way = self._coarse[row], row[:, None]
        first = _nearest(coarse[:, 0], coarse[:, 1], x, y) * COARSE_WAY_STRIDE
        near = np.minimum(np.maximum(first[:, None] + COARSE_NEIGHBOURS, 0), last[:, None])
        i = near[np.arange(len(x)), _nearest(table[way, 0, near], table[way, 1, near], x, y)]
        back = np.flatnonzero(np.isfinite(self._turned[row]))
        if len(back):
            px, py, heading = np.moveaxis(table[row[back], :3], 1, 0)
            px = np.where(np.cos(h[back, None] - heading) < 0.0, np.inf, px)
            i[back] = _nearest(px, py, x[back], y[back])
        px, py, heading = table[row, :3, i].T
        dx, dy, c, s = x - px, y - py, np.cos(heading), np.sin(heading)
        along, aside = c * dx + s * dy, -s * dx + c * dy
        along = np.where((i > 0) & (i < last), np.minimum(np.maximum(along, -PATH_STEP_M), PATH_STEP_M), along)
        return i * PATH_STEP_M + along, aside, np.abs(wrap(h - heading))

    def follower(self, k: int, motion: Motion, states: Floats) -> Follower:
        """Make a follower that drives a vehicle along a planner's own trajectory on its way.

        Args:
            k: The index of the vehicle.
            motion: The vehicles' motion.
            states: The trajectory: x, y, heading and speed in the world, ``(n, 4)``.

        Raises:
            PlannerResultError: There are too few states, or they leave the way.
        """
        x, y, h = pose(Batch, motion, self.rows)
        dt = self.scenes.dt
        line = PlannedCourse(starting_now(states, float(x[k]), float(y[k]), float(h[k]), dt), dt)
        return Follower(line, self._ways[int(self.rows.row[k])].path)

    # -- observations -------------------------------------------------------------------------------------------

    def observe(
        self, motion: Motion, now: float, ego: tuple[Floats, Floats, Floats, Floats],
        last: Sequence[Mapping[str, float] | None], rows: Sequence[int] | None = None,
    ) -> list[PlannerObservation]:  # fmt: skip
        """Make the observation of each vehicle's planner.

        Args:
            motion: The vehicles' motion.
            now: The time since the trigger [s]; planners get the time since their own start.
            ego: Station [m], offset [m], speed [m/s] and acceleration [m/s2] of the egos, each ``(n,)``.
            last: The last endpoint of each vehicle, or None.
            rows: The vehicles that are observed; None means all.

        Returns:
            The observation of each vehicle. It has empty dictionaries for vehicles that are not in ``rows``.
        """
        scenes = self.scenes
        es, ed, ev, ea = ego
        x, y, h = scenes.to_local(*pose(Batch, motion, self.rows))
        rs, rd, rh = self.relative(motion)
        hand = scenes.each(lambda s: s.frame.hand)
        ahead_s, ahead_v = expected_stations(scenes, now, es, ev, ea, PATH_TIMES_S)
        px, py, ph = scenes.to_local(*scenes.ego_at(ahead_s, ed[:, None]))
        table = np.empty((*px.shape, 5))
        for column, values in enumerate((PATH_TIMES_S, px, py, ph, ahead_v)):
            table[:, :, column] = values
        road_h = wrap(scenes.ego_at(rs)[2] - scenes.each(lambda s: s.frame.heading))
        meet = arrivals(scenes, now, es, ev, ea, self._conflicts).tolist()  # at the conflict of each way
        target_left = rd + (motion.target - motion.d) * np.cos(rh)
        busy = np.clip(motion.span - motion.clock, 0.0, MAX_LATERAL_MOVE_S) * (np.abs(motion.target - motion.d) > 0.05)
        columns = np.array(
            [x, y, h, motion.v, motion.a, motion.s, hand * motion.d, rs - es, hand * (rd - ed), hand * rh,
             hand * road_h, hand * (target_left - ed), busy,
             motion.v * np.cos(rh), ev, ea],
        ).T  # fmt: skip
        rows = range(len(self.targets)) if rows is None else rows
        observations: list[PlannerObservation] = [({}, {})] * len(self.targets)
        length, width = scenes.ego.length, scenes.ego.width
        for k, values, path in zip(rows, columns[rows].tolist(), table[rows].tolist(), strict=True):
            state, (_, ego_x, ego_y, heading, _) = self.targets[k].state, path[0]
            (bv_x, bv_y, h, v, a, travelled, offset, ahead, left, relative, road_heading, target, time, along, speed,
             acceleration) = values  # fmt: skip
            observations[k] = {
                "x": bv_x, "y": bv_y, "heading": h, "speed": v, "acceleration": a, "travelled": travelled,
                "offset": offset, "ahead": ahead, "left": left, "relative_heading": relative,
                "road_heading": road_heading, "target_left": target, "lateral_time": time, "speed_along": along,
                "length": state.length, "width": state.width, "time": now - self._waits[k], "last": last[k],
            }, {
                "x": ego_x, "y": ego_y, "heading": heading, "speed": speed, "acceleration": acceleration,
                "length": length, "width": width, "path": path, "arrivals": meet[k][: self._count[k]],
            }  # fmt: skip
        return observations


def _nearest(place_x: Floats, place_y: Floats, x: Floats, y: Floats) -> Any:
    """Find the index of the place ``(n, k)`` nearest to each point, ``(n,)``."""
    dx, dy = x[:, None] - place_x, y[:, None] - place_y
    return np.argmin(dx * dx + dy * dy, axis=1)


def _inside(target: Target) -> tuple[float, float]:
    """Return the stations [m] at which a BV enters and leaves the junction where its ways part."""
    begins = min(w.junction for w in target.ways)
    meets = [w.conflict.bv_s for w in target.ways if w.conflict is not None and w.turn is None]
    return begins, max(meets, default=begins) + AFTER_MERGE_M


def _junction(way: ReferencePath, lane: float) -> tuple[float, float, float, float, float, float]:
    """Describe the junction of a way by six numbers.

    Returns:
        The station of the way at which its junction begins [m]; the station of the way at which it meets the ego's path
        [m]; the station of the ego's path there [m]; 1 if the two merge, 0 if they cross; the length of their conflict
        in lane widths (SUMO's ``conflictSize``); the station of the ego's path at which merging paths have joined [m].
    """
    c = way.conflict
    if c is None:
        return np.inf, 0.0, np.inf, 0.0, 0.0, np.inf
    wide = 2.0 / abs(math.sin(c.angle)) - 1.0 if c.kind == "crossing" else 0.0
    at = int(c.bv_s / PATH_STEP_M)
    apart = np.flatnonzero(np.abs(way.ego_d[: at + 1]) > min(JOINED_DISTANCE_M, lane))
    joins = float(way.ego_s[min(apart[-1] + 1, at)]) if len(apart) else c.ego_s
    return way.junction, c.bv_s, c.ego_s, float(c.kind == "merging"), wide, joins


def _yields(situation: Situation, target: Target) -> bool:
    """Return whether the BV has no green light and the ego has one at the trigger."""
    ego, bv = (situation.traffic.signals.get(name, ()) for name in (situation.ego.id, target.state.id))
    return bool(ego) and ego[0][2] in "Gg" and bool(bv) and bv[0][2] not in "Gg"
