"""Junctions as SUMO's drivers see them: keeping clear of who is on one, and waiting at the line where they give way.

After ``MSLink::getLeaderInfo``, ``MSLink::blockedByFoe``, ``MSVehicle::isLeader`` and
``MSVehicle::adaptToJunctionLeader`` of SUMO 1.28.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.drivers.car_following import CarFollowing
from sumo_adv.drivers.scenes import Scenes
from sumo_adv.situation import Situation

FAR = 1e4  # m
FOE_ACCELERATION, FOE_SPEED = 2.6, 13.9  # m/s2, m/s: how a driver expects others to come to a junction
AHEAD = 1.0  # s by which a driver who gives way wants to be over before others come (SUMO's jmTimegapMinor)
GOES = ("", "M", "O", "o", "w")  # right of way letters with which no adversary is waited for; at an all-way stop (w)
# who stood first goes first, and one that comes does not stand
SEES = 4.5  # m before the line at which they decide (SUMO's visibility distance); until then they brake as to stop
CAN_STOP = 0.5  # m less than an even braking takes is enough for that: they brake step by step
CLEARANCE = 2.0  # m before and behind the place where ways meet that a vehicle on the other way takes up
LONGEST = 60.0  # m from where a junction begins to where ways meet on it: what is further is on another one
CRAWL = 0.1  # m/s, SUMO's haltingSpeed


class Blocked(NamedTuple):
    """Who could be in the ego's way at a junction, ``(n,)``.

    entered: its front is on the junction or past it; on: and its rear is not yet past the place where the ways meet;
    turns: its way has a bay; yields: it came against a red light (SUMO then never has it come); first: it goes before
    an ego that has to give way; merging: they merge there, else they cross; meets: the station of that place on the
    ego's path [m], inf where they do not meet; zone: half the length [m] that each takes up there; joins: the station
    of the ego's path where ways that merge become one; before, back: metres that its front and its rear have to where
    that begins; behind: that its rear has to the end of the junction; begins: the station of the ego's path [m] that
    its rear is at (merging); speed [m/s], length [m].
    """

    entered: Bools
    on: Bools
    turns: Bools
    yields: Bools
    first: Bools
    merging: Bools
    meets: Floats
    zone: Floats
    joins: Floats
    before: Floats
    back: Floats
    behind: Floats
    begins: Floats
    speed: Floats
    length: Floats


class Junctions:
    """The junction ahead of each of ``n`` egos, ``half`` metres from their centres to their bumpers."""

    def __init__(self, scenes: Scenes, driver: CarFollowing) -> None:
        self._driver, self._half, self._dt = driver, scenes.ego.length / 2, scenes.dt
        self._enters, self._bay = scenes.each(lambda s: s.junction), scenes.each(lambda s: s.bay)
        stays = np.isfinite(self._bay)
        self._begins = np.where(stays, self._bay, self._enters)
        self._line = np.where(stays, self._bay, scenes.each(lambda s: math.inf if s.rule in GOES else s.junction))
        self._waits = bool(np.isfinite(self._line).any())
        self._sees = np.where(stays & (scenes.each(_has_priority) > 0.0), FAR, SEES)
        most = max(len(s.later) for s in scenes.of)
        n = len(self._begins)
        self._later = np.array([(*s.later, *[math.inf] * (most - len(s.later))) for s in scenes.of]).reshape(n, most)
        self._first_at = np.full(n, np.nan)  # where the junction begins that it was on first
        self._other_came = np.zeros(n, bool)

    def bound(self, blocked: Blocked, s: Floats, v: Floats) -> Floats:
        """The speeds [m/s] of SUMO's drivers at stations ``s`` [m] with speeds ``v``; inf where nobody is in the way.

        They keep clear of whoever is on the junction, whoever of the two has to yield, but for who came later than they
        and is not yet where the ways meet; where they have to give way themselves they wait at the line.
        """
        front = s + self._half
        late = blocked.first | blocked.yields
        begins, enters = self._of(blocked.meets)
        near = (blocked.meets < begins + LONGEST) | ~np.isfinite(blocked.meets)
        there = (front > np.where(late, begins, enters)) & near & ~self._other_came
        there &= ~blocked.entered | (v >= blocked.speed)  # of two who come in one step the slower one yields
        self._first_at = np.where(there, begins, self._first_at)
        self._other_came |= blocked.entered
        merging, crossing = (f(blocked, begins, front, v) for f in (self._merging, self._crossing))
        clear = np.where(blocked.merging, merging, crossing)
        return np.minimum(clear, self._giving_way(blocked, begins, front, v)) if self._waits else clear

    def _of(self, meets: Floats) -> tuple[Floats, Floats]:
        """Where the junctions begin on which the ways meet, and where the egos are on them."""
        if not self._later.shape[1]:
            return self._begins, self._enters
        at = np.where(np.isfinite(meets)[:, None] & (self._later < meets[:, None]), self._later, -np.inf).max(axis=1)
        return np.where(at > 0.0, at, self._begins), np.where(at > 0.0, at, self._enters)

    def _merging(self, blocked: Blocked, begins: Floats, front: Floats, v: Floats) -> Floats:
        """Behind who merges as behind a leader; where that one is not far enough ahead, not onto the junction."""
        gap = blocked.begins - front
        beside = (front < blocked.joins) & (self._first_at != begins)
        held = blocked.on & (beside | ((front < blocked.meets) & (blocked.before < 0.0)))
        entry = np.where(np.isfinite(begins), begins - front - CRAWL, 0.0)
        follow = self._driver.behind(v, np.minimum(gap, FAR), blocked.speed)
        near = np.where(gap >= self._driver.min_gap, follow, self._driver.stopping(v, entry))
        return np.where(held, near, np.inf)

    def _crossing(self, blocked: Blocked, begins: Floats, front: Floats, v: Floats) -> Floats:
        """Before the zone where the ways cross, or so slowly that the other one is past it by then."""
        to = np.minimum(blocked.meets - blocked.zone - front, FAR)
        rest = np.maximum(blocked.back + 2 * blocked.zone, 0.0)  # until its rear is past
        in_the_way = (to > 0.0) & (blocked.before < 0.0)
        held = blocked.on & (to + 2 * blocked.zone >= 0.0) & ((self._first_at != begins) | in_the_way)
        if not held.any():
            return np.full(len(v), np.inf)
        driver, gap = self._driver, to - self._driver.min_gap - rest
        room = to - driver.min_gap
        entry = np.where(np.isfinite(begins), begins - front - CRAWL, room)
        follow = np.where(gap >= 0.0, driver.behind(v, gap + driver.min_gap, blocked.speed), driver.stopping(v, entry))
        time = np.maximum(rest, 1e-3) / np.maximum(blocked.speed, CRAWL)
        through = v + (np.maximum(v, 2 * room / time - v) - v) / time * self._dt
        near = np.where(to >= 0.0, np.maximum(follow, np.minimum(through, driver.stopping(v, room))), follow)
        in_bay = np.isfinite(self._bay) & (front < begins)
        near = np.where(in_bay, driver.stopping(v, entry), near)
        return np.where(held, near, np.inf)

    def _giving_way(self, blocked: Blocked, begins: Floats, front: Floats, v: Floats) -> Floats:
        """Whether it waits before its line: it can still stop there, and would be on the junction together with the
        other one, who is expected to speed up, or, of those who are on it already, turns over a bay."""
        room = np.where(np.isfinite(self._line), self._line - front, -FAR)
        left = blocked.meets - front
        stops = (room > -0.5) & (room < self._sees) & (room > v * v / (2 * self._driver.deceleration) - CAN_STOP)
        comes = seconds(blocked.before + blocked.zone, blocked.speed, FOE_ACCELERATION)
        gone = seconds(blocked.behind, blocked.speed, FOE_ACCELERATION)
        mine = seconds(room, v, self._driver.acceleration)
        over = seconds(left + 2 * self._half + CLEARANCE, v, self._driver.acceleration)
        waits = (
            stops
            & blocked.first
            & ~blocked.yields
            & (~blocked.on | blocked.turns)
            & np.isfinite(blocked.meets)
            & (begins == self._begins)
            & (blocked.behind > 0.0)
            & (over + AHEAD > comes)
            & (gone > mine)
        )
        return np.where(waits, self._driver.stopping(v, np.maximum(room, 0.0)), np.inf)


def _has_priority(situation: Situation) -> float:
    """1 if the ego's light is green without others to mind, or it is on a road that has the right of way, else 0."""
    lights = situation.signals.get(situation.ego.id, ())
    return float(lights[0][2] == "G" if lights else situation.rule == "M")


def seconds(distance: Floats, speed: Floats, acceleration: float) -> Floats:
    """Seconds for a distance [m] (0 where it is behind) from a speed, with an even acceleration up to ``FOE_SPEED``."""
    distance, least = np.maximum(distance, 0.0), np.maximum(speed, 0.01)
    most = np.maximum(np.minimum(np.sqrt(least * least + 2 * acceleration * distance), FOE_SPEED), least)
    span = (most - least) / acceleration
    return np.maximum(span + (distance - (least + most) / 2 * span) / most, 0.0)
