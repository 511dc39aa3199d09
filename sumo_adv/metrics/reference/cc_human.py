"""UN R157's careful and competent human driver: when it is alarmed, and how it brakes.

Source: UN Regulation No. 157, Annex 4 appendix 3 (01 series: Annex 3 appendix), performance model 1. A vehicle that
cuts in is perceived once it has left its zone of wandering (0.375 m) for 0.4 s. It is a danger at a time to collision
of at most 2.0 s. The driver begins to brake 0.75 s later, and braking rises evenly within 0.6 s to 0.774 g. A leader
is perceived when it brakes at more than 5 m/s2.

The regulation covers cut-in, cut-out and braking leaders on motorways. The rest is our extrapolation, with the same
delays and the same braking:

- A vehicle that will be passed before it is in the way (at its present lateral speed, with 0.5 s to spare) is no
  danger.
- A leader in the ego's corridor is also a danger if braking for it after the reaction time takes more than 4.5 m/s2.
- A vehicle beside the ego that drifts towards it is also a danger if the boxes would touch within 2.0 s.
- An oncoming vehicle is a danger once its box is over the line of the ego's lane, it has drifted by 0.375 m, and the
  two meet within 3 s.
- A crossing vehicle is a danger in two cases: it can no longer stop short of the ego's corridor at 3 m/s2 and the two
  meet within 4 s, or it is in the corridor and they meet within 3 s. In both cases, the ego must have to brake at
  3 m/s2 or more, because an ego that is about to yield is not alarmed.
- A pedestrian or cyclist is judged like a vehicle that cuts in, whichever way it faces: it has left its place by
  0.375 m towards the ego's path, it is reached within 2.0 s, and it is in the way before it is passed. It is perceived
  once it is in the line of sight, because the views leave out hidden road users.

The danger must last through the reaction time, apart from lapses of 0.3 s: the driver looks again before braking. A
vehicle that has come over the line of the ego's lane remains a danger while its box is over the line and it is still
reached within 2.0 s, even while it pauses there. The driver brakes until the danger is past: the vehicle is behind, it
has gone back behind the line or is on its way back, or it is a leader that needs no braking.

The regulation leaves these points open:

- The zone of wandering counts from the place at which the vehicle last kept its lateral position (slower than 0.1 m/s
  sideways) while its box was outside the ego's lane. A pause over the line is part of the same cut-in.
- A vehicle that comes over slowly is perceived 0.5 m beyond that zone at the earliest, or in the ego's corridor. The
  JRC's implementation (ec-jrc/JRC-FSM) takes 0.72 m and no time, and agrees with this in 98 % of cut-ins.
- 0.774 g is not raised to the 0.85 g of the emergency brake that the regulation assumes once both overlap fully.

In unattacked SUMO traffic (``benchmarks/false_alarms.py``), this driver brakes without need 0.1 times in 10 km;
``reg157`` does so 0.1, ``fsm`` 3.6 and ``rss`` 12.3 times, because drivers there follow at 1 s, nearer than these two
models want.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from sumo_adv.datatypes import Bools, Floats, Ints
from sumo_adv.metrics.contact import OPPOSITE_DIRECTION
from sumo_adv.metrics.reference.brakers import needed_braking, rearranged, speed_lost
from sumo_adv.metrics.reference.view import View
from sumo_adv.road_users import unprotected

WANDERING_M = 0.375  # UN R157
LATERAL_REST_SPEED_M_S = 0.1  # a vehicle that is slower sideways keeps its lateral place
PERCEPTION_S = 0.4  # UN R157
PERCEIVED_DRIFT_M = WANDERING_M + 0.5  # a cut-in is perceived at this drift, or in the corridor, at the earliest
HUMAN_REACTION_S = 0.75  # UN R157
DANGER_TTC_S = 2.0  # time to collision, UN R157
PASSING_SLACK_S = 0.5  # how much later than it is passed a vehicle may come into the way
LEADER_HARD_BRAKING_M_S2 = 5.0  # UN R157
FOLLOWING_HEADWAY_S = 2.0  # a leader's braking matters within this headway, UN R157
OWN_BRAKING_M_S2 = 4.5  # drivers brake by themselves behind a leader up to this (SUMO's default)
YIELDING_BRAKING_M_S2 = 3.0  # a crossing driver may brake up to this to yield
ALARM_BRAKING_M_S2 = 3.0  # minimum braking that the ego must need
CROSSING_SIGHT_S, FACING_SIGHT_S = 4.0, 3.0  # how far ahead a meeting is looked for
CROSSING_MARGIN_M, FACING_MARGIN_M = 1.0, 0.5  # boxes nearer than this meet
CLOSE_HEADWAY_S = 0.5  # a leader within this headway is still a danger
PAST_DANGER_BRAKING_M_S2 = 0.5  # if a leader requires less braking than this, the danger is past
BRAKE_EASING_S = 0.5  # time without a danger until the foot leaves the brake
MAX_DANGER_LAPSE_S = 0.3  # before the driver brakes, a danger that is out of sight this long is not forgotten
MEETING_STEP_S = 0.2  # between the moments at which a meeting is checked


class CcHuman:
    """N drivers that watch M vehicles each. Call ``step`` with one view a step, in order.

    Attributes:
        name: The driver's name.
        delay: Time from the alarm until the driver acts [s].
        danger: Which vehicles are a danger now ``(N, M)``.
    """

    name: ClassVar[str] = "cc_human"
    delay: ClassVar[float] = HUMAN_REACTION_S

    def __init__(self, shape: tuple[int, int], dt: float) -> None:
        """Start without any memory.

        Args:
            shape: The numbers of drivers and vehicles (N, M).
            dt: Step [s].
        """
        self._dt, self._now = dt, 0.0
        self._drift = np.zeros(shape)  # [m] towards the ego's path since a vehicle last kept its lateral place
        self._perceived_since = np.full(shape, np.inf)
        self.danger: Bools = np.zeros(shape, bool)
        self._decided_at, self._last = np.full(shape, np.inf), np.full(shape, -np.inf)
        self._seen_at = np.full(shape, -np.inf)
        self._first_alarm = np.full(shape[0], np.inf)

    @property
    def alarmed(self) -> Bools:
        """Whether a danger has shown to the driver, ``(N,)``."""
        return np.isfinite(self._first_alarm)

    def watch(self, columns: Ints) -> None:
        """Watch other vehicles from now on.

        Args:
            columns: For each new column, the column in which its vehicle was before ``(M',)``; -1 = the vehicle is new.
        """
        self._drift = rearranged(self._drift, columns, 0.0)
        self._perceived_since = rearranged(self._perceived_since, columns, np.inf)
        self.danger = rearranged(self.danger, columns, False)
        self._decided_at = rearranged(self._decided_at, columns, np.inf)
        self._last, self._seen_at = (rearranged(v, columns, -np.inf) for v in (self._last, self._seen_at))

    def step(self, view: View) -> Floats:
        """Look at one step.

        Args:
            view: What the drivers see.

        Returns:
            The acceleration over the step to come ``(N,)`` [m/s2]; NaN if a driver does not brake.
        """
        time, dt = self._now, self._dt
        intrudes = _intrudes(view)
        paused = intrudes & (np.abs(view.towards) < LATERAL_REST_SPEED_M_S)
        drift = np.where(view.towards < LATERAL_REST_SPEED_M_S, 0.0, self._drift + view.towards * dt)
        self._drift = np.where(paused, self._drift, drift)
        perceived = self._perceived(view)
        danger = self._is_danger(view)
        if (intruding := self.danger & intrudes).any():
            danger = danger | (intruding & _still_reached(view))
        self._perceived_since = np.where(perceived, np.minimum(self._perceived_since, time), np.inf)
        seen = danger & self._understood(view, time)
        self._seen_at = np.where(seen, time, self._seen_at)
        braking = time - self._decided_at >= HUMAN_REACTION_S - 1e-9
        lasts = self.danger & (braking | (time - self._seen_at <= MAX_DANGER_LAPSE_S + 1e-9))
        self.danger = seen | (lasts & ~self._is_over(view)) if lasts.any() else seen
        self._last = np.where(self.danger, time, self._last)
        at_ease = ~self.danger & ((time - self._last > BRAKE_EASING_S) | ~braking)
        started = np.where(self.danger, np.minimum(self._decided_at, time), self._decided_at)
        self._decided_at = np.where(at_ease, np.inf, started)
        shown = self.danger.any(axis=1) & ~np.isfinite(self._first_alarm)
        self._first_alarm = np.where(shown, time, self._first_alarm)
        self._now = round(time + dt, 9)
        if not self.danger.any():
            return np.full(len(self.danger), np.nan)
        earliest = np.where(self.danger, self._decided_at, np.inf).min(axis=1, initial=np.inf)
        pressed = np.where(np.isfinite(earliest), time - earliest - HUMAN_REACTION_S, -np.inf)
        lost = speed_lost(pressed + dt) - speed_lost(pressed)
        return np.where(lost > 1e-9, -lost / dt, np.nan)

    def _perceived(self, view: View) -> Bools:
        """Return whether there is something to perceive; it must last for ``PERCEPTION_S`` to be understood."""
        wanders = self._drift >= WANDERING_M - 1e-9
        leads = view.same_direction & view.ahead & view.in_corridor
        return wanders | leads | ~view.same_direction

    def _understood(self, view: View, time: float) -> Bools:
        """Return whether the perceived motion has lasted long enough, and a cut-in has come far enough."""
        long_enough = time - self._perceived_since >= PERCEPTION_S - 1e-9
        cuts_in = view.same_direction & ~view.in_corridor
        return long_enough & (~cuts_in | (self._drift >= PERCEIVED_DRIFT_M - 1e-9))

    def _is_danger(self, view: View) -> Bools:
        moving, same_direction = view.ego_speed >= 0.1, view.same_direction
        ahead, wanders = moving & view.ahead, self._drift >= WANDERING_M - 1e-9
        dangers = np.zeros(view.gap.shape, bool)
        if wanders.any():
            cuts_in = (same_direction | unprotected(view.length, view.width)) & self._cuts_in(view)
            dangers = wanders & ((ahead & cuts_in) | (moving & same_direction & self._comes_from_beside(view)))
        if (leads := ahead & same_direction & view.in_corridor).any():
            dangers |= leads & self._leads_too_slowly(view)
        comes = ahead & ~same_direction & (view.speed >= 0.1) & (view.gap > 0.0)
        comes &= view.gap <= CROSSING_SIGHT_S * (view.ego_speed + np.maximum(-view.along, 0.0))
        return self._meets(view, comes, dangers) if comes.any() else dangers

    def _meets(self, view: View, comes: Bools, dangers: Bools) -> Bools:
        """Return ``dangers`` with the oncoming and crossing vehicles (``comes``) that are a danger."""
        turned = np.abs(view.heading)
        over_the_line = (view.near_edge < view.lane_half_width) & (self._drift >= WANDERING_M)
        facing = comes & (turned > OPPOSITE_DIRECTION) & over_the_line
        across = comes & (turned <= OPPOSITE_DIRECTION)
        still = np.zeros(view.gap.shape)
        across &= needed_braking(view.ego_speed, view.gap, still, still) >= ALARM_BRAKING_M_S2
        outside = (view.side_gap > 0.0) & (view.crossing > LATERAL_REST_SPEED_M_S)
        until_there = view.side_gap / np.maximum(view.crossing, LATERAL_REST_SPEED_M_S)
        too_late = across & outside & (until_there < view.speed / (2.0 * YIELDING_BRAKING_M_S2))
        looks = (
            (facing, FACING_SIGHT_S, FACING_MARGIN_M), (too_late, CROSSING_SIGHT_S, CROSSING_MARGIN_M),
            (across & view.in_corridor, FACING_SIGHT_S, 0.0),
        )  # fmt: skip
        for rows, horizon, margin in looks:
            k = np.nonzero(rows)
            if len(k[0]):
                dangers[k] |= meet(view, k, horizon, margin)
        return dangers

    def _cuts_in(self, view: View) -> Bools:
        """Return whether a vehicle is ahead, reached within ``DANGER_TTC_S``, and in the way before it is passed."""
        reached = (view.gap > 0.0) & (view.time_to_reach <= DANGER_TTC_S)
        passed = (view.gap + view.length + view.ego_length) / np.maximum(view.closing, 1e-9)
        entered = np.maximum(view.side_gap, 0.0) / np.maximum(view.towards, LATERAL_REST_SPEED_M_S)
        return reached & (entered <= passed + PASSING_SLACK_S)

    def _comes_from_beside(self, view: View) -> Bools:
        """Return whether a vehicle overlaps the ego lengthwise and drifts into it within ``DANGER_TTC_S``."""
        return (
            (view.gap <= 0.0)
            & (view.side_gap > -1.0)
            & (np.maximum(view.side_gap, 0.0) <= DANGER_TTC_S * np.maximum(view.towards, LATERAL_REST_SPEED_M_S))
        )

    def _leads_too_slowly(self, view: View) -> Bools:
        """Return whether a leader is reached within ``DANGER_TTC_S``, brakes hard, or requires hard braking."""
        hard = (view.acceleration <= -LEADER_HARD_BRAKING_M_S2) & (view.gap <= FOLLOWING_HEADWAY_S * view.ego_speed)
        room = view.gap - np.maximum(view.closing, 0.0) * HUMAN_REACTION_S
        needed = needed_braking(view.ego_speed, room, view.along, view.acceleration)
        slow = (view.closing > 0.0) & ((view.time_to_reach <= DANGER_TTC_S) | (needed > OWN_BRAKING_M_S2))
        return hard | slow

    def _is_over(self, view: View) -> Bools:
        """Return whether a danger is past."""
        beside = view.gap <= 0.0
        away = (view.side_gap > 0.0) & (view.towards < LATERAL_REST_SPEED_M_S)
        returns = view.same_direction & (view.towards <= -LATERAL_REST_SPEED_M_S)
        across = ~view.same_direction & (np.abs(view.heading) <= OPPOSITE_DIRECTION)
        leaves = away & (across | returns | (view.near_edge >= view.lane_half_width))
        waits = (view.ego_speed < 0.5) & (view.gap < 2.5) & (view.speed < 0.5)
        near = (view.gap < CLOSE_HEADWAY_S * view.ego_speed) & (view.closing > -1.0)
        needed = needed_braking(view.ego_speed, view.gap, view.along, view.acceleration) > PAST_DANGER_BRAKING_M_S2
        harmless = view.same_direction & ~beside & ~waits & ~near & ~needed
        return (~view.ahead & ~(beside & view.same_direction)) | leaves | harmless


def _intrudes(view: View) -> Bools:
    """Return whether a vehicle that goes the ego's way is over the line of the ego's lane, and not on its way back."""
    over_the_line = view.near_edge < view.lane_half_width
    return view.same_direction & over_the_line & (view.towards > -LATERAL_REST_SPEED_M_S)


def _still_reached(view: View) -> Bools:
    """Return whether the ego comes up to a vehicle ahead or beside within ``DANGER_TTC_S``."""
    beside = (view.gap <= 0.0) & (view.side_gap > -1.0)
    return (view.ego_speed >= 0.1) & (beside | (view.ahead & (view.time_to_reach <= DANGER_TTC_S)))


def meet(view: View, k: Any, horizon: float, margin: float) -> Bools:
    """Return whether the boxes of the pairs ``k`` overlap within a time.

    The ego continues along its path; if it brakes, it continues braking. The other vehicle keeps its speed and yaw
    rate.

    Args:
        view: What the drivers see.
        k: Index of the pairs into the arrays ``(N, M)``.
        horizon: The time [s].
        margin: The other vehicle's box grows by this on each side [m].
    """
    t = np.arange(0.0, horizon + 1e-6, MEETING_STEP_S)
    rows = k[0]
    speed, braking = view.ego_speed[rows, 0][:, None], np.maximum(-view.ego_acceleration[rows, 0], 0.0)[:, None]
    braking = np.where(braking > 0.5, braking, 0.0)
    moving = np.minimum(t, np.where(braking > 0.0, speed / np.maximum(braking, 0.5), np.inf))
    turned, h = view.yaw_rate[k][:, None] * t, view.heading[k][:, None]
    chord = view.speed[k][:, None] * t * np.sinc(turned / (2 * np.pi))
    x = view.away[k][:, None] + chord * np.cos(h + turned / 2) - speed * moving + braking * moving**2 / 2
    y = view.left[k][:, None] + chord * np.sin(h + turned / 2)
    size = (view.length[k][:, None] + 2 * margin, view.width[k][:, None] + 2 * margin)
    return np.asarray(overlapping(x, y, h + turned, (view.ego_length, view.ego_width), size).any(axis=1))


def overlapping(x: Floats, y: Floats, h: Floats, ego: tuple[float, float], size: tuple[Floats, Floats]) -> Bools:
    """Return whether boxes overlap the ego's box at the origin (separating axes).

    Args:
        x: Centre of the other boxes [m].
        y: Centre of the other boxes [m].
        h: Heading of the other boxes [rad].
        ego: The ego's length and width [m].
        size: The other boxes' length and width [m].
    """
    cos, sin, (length, width) = np.cos(h), np.sin(h), size
    c, s = np.abs(cos), np.abs(sin)
    apart = (np.abs(x) > (ego[0] + c * length + s * width) / 2) | (np.abs(y) > (ego[1] + s * length + c * width) / 2)
    apart |= np.abs(x * cos + y * sin) > (length + c * ego[0] + s * ego[1]) / 2
    return ~(apart | (np.abs(y * cos - x * sin) > (width + s * ego[0] + c * ego[1]) / 2))
