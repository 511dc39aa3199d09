"""Egos as they are foreseen: along their path, by the unattacked profile, then by their driver's model.

An ego follows its unattacked profile until the adversary counts as its leader, or is in its way at a junction, and a
safe speed falls below the profile; from then on its driver's model drives (Krauss's safe speed, IDM, the careful
driver's brake); only the lattice driver steers.  How SUMO's drivers see others is in ENGINE.md; at junctions they
follow ``MSLink``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sumo_adv.datatypes import Bools, Floats, ObservedMotion
from sumo_adv.drivers.car_following import EMERGENCY, CarFollowing
from sumo_adv.drivers.careful import CarefulDrivers
from sumo_adv.drivers.junctions import Blocked, Junctions
from sumo_adv.drivers.lateral_gap import SUBLANE, LateralGap
from sumo_adv.drivers.lattice_model import LatticeDrivers
from sumo_adv.drivers.leaders import JAM, NOTICED, Leaders
from sumo_adv.drivers.scenes import Scenes

WITHIN = 0.045  # m by which a side lies within a strip's edge to count as in it (measured: between 0.034 and 0.058)
ACROSS = (0.9, 2.2)  # rad: a vehicle at such an angle is no leader
SAME_WAY = 0.5  # rad
OVER, TURNED = 0.365, 0.21  # m over the line to the other direction at which SUMO has a vehicle there; less by rad that
BACK = 0.1  # it is turned; m over it at which it is back (measured)
LEAST_STEP = 0.05  # m: over less way an ego that was seen has the path's heading, or nearly


class PredictedEgos:
    """Copies of the ego along its path, one against each adversary (``names``) of a length and width [m], ``(n,)``.

    ``seen``: egos that drive as they were seen to in an attempt, whatever the adversary does.
    """

    def __init__(
        self, scenes: Scenes, names: Sequence[str], length: Floats, width: Floats,
        seen: Sequence[ObservedMotion] | None = None,
    ) -> None:  # fmt: skip
        self._seen = None if seen is None else np.stack([np.stack([c.s, c.d, c.v]) for c in seen])
        self.scenes, self._length, self._width = scenes, length, width
        n = len(length)
        self.model = scenes.driver
        self.s, self.v, self.a = (
            scenes.each(lambda s, name=name: getattr(s, name)[0]) for name in ("profile_s", "profile_v", "profile_a")
        )  # fmt: skip
        self.d, self.turn = np.zeros(n), np.zeros(n)
        self.disturbed = np.zeros(n, bool)
        self._front_before: Floats | None = None
        self._was_inside, self._was_beside = np.zeros(n, bool), np.zeros(n, bool)
        mine = (scenes.ego.length, scenes.ego.width)
        self._lane = scenes.each(lambda s: s.lane_width)
        self._beside = scenes.has_lane(1), scenes.has_lane(-1)
        self._passes_right = self.model.ignores_sumo_lane_rules
        if self._passes_right:  # no driver of SUMO's: the directions of lanes are nothing to it
            self._beside = np.ones(n, bool), np.ones(n, bool)
        self._driver = CarFollowing(self.model, scenes.dt)
        self._junctions = Junctions(scenes, self._driver)
        self._leaders = Leaders(scenes, names, length, self._driver)
        careful = self.model.kind == "careful"
        self._careful = CarefulDrivers(mine, length, width, scenes.dt, self.model.reaction) if careful else None
        lattice = self.model.kind == "lattice"
        self._lattice = LatticeDrivers(scenes, length, width, self.model) if lattice else None
        self._sidestep = LateralGap(scenes, length, width)
        self._edges_at, self._seen_edges = self.d, seen_edges(self._lane, scenes.ego.width, self.d)  # of these offsets
        self._sees = np.maximum(self._lane / 2, self.model.sees)
        self._opposed = np.zeros(n, bool) if self._passes_right else scenes.opposed()
        self._gone_over = np.zeros(n, bool)

    def step(
        self, now: float, adversary: tuple[Floats, Floats, Floats], speed: Floats,
        blocked: Blocked | None = None,
    ) -> None:  # fmt: skip
        """One step against adversaries at station, offset, heading (ego path's frame, box centres); ``blocked``: who is
        in the way on a junction (``AdversaryBatch.blocked``)."""
        dt = self.scenes.dt
        if self._seen is not None:
            self._as_seen(now, self._seen)
            return
        next_s, next_v = self.scenes.profile_now(now + dt)
        if self.model.kind == "replay":
            self.s, self.a, self.v = next_s, (next_v - self.v) / dt, next_v
            return
        (s, d, h), half = adversary, self._length / 2
        front_d = d + half * np.sin(h)
        seen_s = s if self._passes_right else self.scenes.seen_at(s, front_d)
        front_s = seen_s + half * np.cos(h)
        ahead = front_s > self.s + self.scenes.ego.length / 2
        bound = self._bound(now, adversary, speed, (seen_s, ahead, front_d), blocked)
        if self._lattice is not None:
            self.s, v = self._lattice.step(now, (self.s, self.v), adversary, speed, bound)
            self.a, self.v, self.disturbed = (v - self.v) / dt, v, self._lattice.disturbed
            self.d, self.turn = self._lattice.d, self._lattice.turn
            return
        held = self._leaders.held(self.s)
        self.disturbed |= (bound < next_v - NOTICED) | (held & (bound > next_v + NOTICED))
        others = self._leaders.bound(now, self.s, self.v, self.disturbed)
        self.disturbed |= others < next_v - NOTICED
        bound = np.minimum(bound, others)
        self._leaders.step(now, seen_s, front_d, speed)
        pace = np.maximum(np.where(held, self._driver.most, self.scenes.pace(self.s)), next_v)
        free = np.minimum(self._driver.free(self.v), pace)
        v = np.where(self.disturbed, np.maximum(np.minimum(free, bound), self.v - EMERGENCY * dt), next_v)
        v = np.maximum(v, 0.0)
        self._sidestep.step(seen_s - self.s, front_d, self._was_inside)
        self.d, self.a = self._sidestep.d, (v - self.v) / dt
        self.s = np.where(self.disturbed, self.s + v * dt, next_s)
        self.v = v

    def _as_seen(self, now: float, seen: Floats) -> None:
        """One step of the courses ``(n, 3, steps)``: station, offset, speed."""
        dt = self.scenes.dt
        s, d, v = seen[:, :, min(round(now / dt) + 1, seen.shape[2] - 1)].T
        self.turn = np.arctan2(d - self.d, np.maximum(s - self.s, LEAST_STEP))
        self.s, self.d, self.a, self.v = s, d, (v - self.v) / dt, v

    def _bound(
        self, now: float, adversary: tuple[Floats, Floats, Floats], speed: Floats,
        front: tuple[Floats, Bools, Floats], blocked: Blocked | None,
    ) -> Floats:  # fmt: skip
        """The speed [m/s] of the drivers for the adversaries, inf where they are no reason; ``front``: the stations
        that SUMO has them at, whether their fronts are ahead of the egos', and their fronts' offsets."""
        (_, _, h), (s, ahead, front_d) = adversary, front
        across = (np.abs(h) > ACROSS[0]) & (np.abs(h) < ACROSS[1])
        leads = self._in_lane(front_d, h) & ahead & ~across
        gap = s - self.s - (self._length + self.scenes.ego.length) / 2
        bound = np.where(leads, self._driver.behind(self.v, gap, speed), np.inf)
        if self._careful is not None:
            bound = np.minimum(bound, self._careful.bound((self.s, self.v, self.a), adversary, speed))
        if blocked is not None:
            bound = np.minimum(bound, self._junctions.bound(blocked, self.s, self.v))
        return np.minimum(bound, self._staying_behind(gap, speed, front_d, ahead & (np.abs(h) < SAME_WAY)))

    def pose(self) -> tuple[Floats, Floats, Floats, Floats]:
        """x, y, heading, speed, each ``(n,)``."""
        x, y, h = self.scenes.ego_at(self.s, self.d)
        return x, y, h + self.turn, self.v

    def onwards(self, steps: int) -> Floats:
        """x, y, heading, speed of the next ``steps`` at even speeds and offsets, ``(4, n, steps)``."""
        s = self.s[:, None] + self.v[:, None] * self.scenes.dt * np.arange(steps)
        return np.stack([*self.scenes.ego_at(s, self.d[:, None]), np.broadcast_to(self.v[:, None], s.shape)])

    def _in_lane(self, front_d: Floats, h: Floats) -> Bools:
        """Whether SUMO's driver has the adversary in its lane: its front's centre is within the lane's lines (another
        driver's: as near to the side as it ``sees``); or, once it has been there (SUMO then keeps it in both lanes),
        its side is within the strips that the ego takes up; not where it went over to a lane of the other direction."""
        inside, half = self._within(front_d, h), self._width / 2
        if self.d is not self._edges_at:
            self._edges_at, self._seen_edges = self.d, seen_edges(self._lane, self.scenes.ego.width, self.d)
        left, right = self._seen_edges
        partly = (front_d - half < left) & (front_d + half > -right)
        self._was_inside |= inside
        return inside | (self._was_inside & partly & np.where(front_d > 0.0, *self._beside))

    def _within(self, front_d: Floats, h: Floats) -> Bools:
        """Whether the front's centre is in the lane; SUMO has who goes over to a lane of the other direction in its own
        for longer (``OVER``)."""
        more = np.where(self._gone_over & (np.abs(h) < np.pi / 2), BACK, OVER - TURNED * np.abs(h))
        left = self._sees + np.where(self._opposed, more, 0.0)
        inside = (front_d > -self._sees) & (front_d < left)
        self._gone_over = ~inside & (front_d > 0.0)
        return inside

    def _staying_behind(self, gap: Floats, speed: Floats, front_d: Floats, ahead: Bools) -> Floats:
        """The speed of SUMO's driver, who at more than ``JAM`` does not overtake on the right: behind whoever is in the
        lane to the left, or was there and is partly, it drives as behind a leader, but brakes gently. Other drivers
        (``ignores_sumo_lane_rules``) do not."""
        if self._passes_right:
            return np.full(len(self.s), np.inf)
        before = front_d if self._front_before is None else self._front_before  # lanes change at the end of a step
        front_d, self._front_before = before, front_d
        beside = (front_d >= self._lane / 2) & (front_d < 1.5 * self._lane)
        self._was_beside |= beside
        beside |= self._was_beside & (front_d >= self._lane / 2) & (front_d - self._width / 2 < 1.5 * self._lane)
        rules = beside & ahead & (self.v > JAM)
        return np.where(rules, self._driver.staying_behind(self.v, gap, speed), np.inf)


def seen_edges(lane: Floats, width: float, offset: Floats) -> tuple[Floats, Floats]:
    """How far to the left and to the right [m] of the middle of its lane a driver of this width looks for leaders:
    SUMO's strips of ``SUBLANE``, counted from the lane's right edge, that the ego is in (``MSLeaderInfo``)."""
    wide, middle = width - 2 * WITHIN, lane / 2 + offset
    right = np.maximum(np.floor((middle - wide / 2) / SUBLANE), 0.0) * SUBLANE
    left = np.minimum((np.floor((middle + wide / 2) / SUBLANE) + 1.0) * SUBLANE, lane)
    return left - lane / 2, lane / 2 - right
