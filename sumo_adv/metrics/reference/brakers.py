"""Reference drivers that brake: their protocol, helpers for their rules, and the drivers for one direction."""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

import numpy as np

from sumo_adv.datatypes import Bools, Floats, Ints
from sumo_adv.metrics.fault import Rss, lateral_way, longitudinal_safe_distance
from sumo_adv.metrics.reference.view import View

FULL_BRAKING_RAMP_S = 0.6  # UN R157
FULL_BRAKING_M_S2 = 0.774 * 9.81  # UN R157


def speed_lost(pressed: Floats) -> Floats:
    """Return the speed that braking has taken after a time.

    Args:
        pressed: Time since the braking began [s].

    Returns:
        The lost speed [m/s]; 0 before the braking begins.
    """
    pressed = np.maximum(pressed, 0.0)
    rising = np.minimum(pressed, FULL_BRAKING_RAMP_S)
    return np.asarray(FULL_BRAKING_M_S2 * (rising**2 / (2.0 * FULL_BRAKING_RAMP_S) + pressed - rising))


class Braker(Protocol):
    """N drivers that watch M vehicles each, in steps of ``dt`` [s]. Their state is what they have seen.

    Attributes:
        name: The driver's name.
        delay: Time from the alarm until the driver acts [s].
    """

    name: ClassVar[str]
    delay: ClassVar[float]

    def __init__(self, shape: tuple[int, int], dt: float) -> None: ...

    def step(self, view: View) -> Floats:
        """Look at one step.

        Args:
            view: What the drivers see.

        Returns:
            The acceleration over the step to come ``(N,)`` [m/s2]; NaN if a driver does not act.
        """
        ...

    def watch(self, columns: Ints) -> None:
        """Watch other vehicles from now on.

        Args:
            columns: For each new column, the column in which its vehicle was before ``(M',)``; -1 = the vehicle is new.
        """
        ...

    @property
    def alarmed(self) -> Bools:
        """Whether a danger has shown to the driver, now or before, ``(N,)``."""
        ...


def rearranged(values: Any, columns: Ints, fresh: float | bool) -> Any:
    """Rearrange what drivers remember of vehicles for the columns of ``Braker.watch``.

    Args:
        values: What is remembered ``(N, M)``.
        columns: For each new column, the column in which its vehicle was before ``(M',)``; -1 = the vehicle is new.
        fresh: The value of new vehicles.

    Returns:
        The values ``(N, M')``.
    """
    new = columns < 0
    kept = values[:, np.maximum(columns, 0)] if values.shape[1] else np.full((len(values), len(columns)), fresh)
    return np.where(new[None, :], fresh, kept)


def needed_braking(speed: Floats, gap: Floats, leader_speed: Floats, leader_acceleration: Floats) -> Floats:
    """Compute the constant deceleration with which the ego just avoids running into a leader.

    It is the larger of two values: c^2 / (2 gap) at a closing speed c and, behind a braking leader, the deceleration
    with which the ego stops just behind the stopped leader.

    Args:
        speed: The ego's speed [m/s].
        gap: The gap to the leader [m].
        leader_speed: The leader's speed [m/s].
        leader_acceleration: The leader's acceleration [m/s2].

    Returns:
        The deceleration [m/s2]. Without a gap, it is ``inf`` for a moving ego.
    """
    room = np.maximum(gap, 1e-6)
    needed = np.maximum(speed - leader_speed, 0.0) ** 2 / (2.0 * room)
    brakes = leader_acceleration < -0.5
    if brakes.any():
        standstill = np.maximum(leader_speed, 0.0) ** 2 / (2.0 * np.maximum(-leader_acceleration, 0.5))
        needed = np.where(brakes, np.maximum(needed, speed**2 / (2.0 * (room + standstill))), needed)
    return np.where(gap > 0.0, needed, np.where(speed > 0.0, np.inf, 0.0))


class Delay:
    """An effect that begins a fixed time after its cause and ends with it. Arrays are ``(N, ...)``."""

    def __init__(self, shape: tuple[int, ...], seconds: float, dt: float) -> None:
        self._since = np.full(shape, np.inf)
        self._now, self._seconds, self._dt = 0.0, seconds, dt

    def watch(self, columns: Ints) -> None:
        """Watch other vehicles; see ``Braker.watch``."""
        self._since = rearranged(self._since, columns, np.inf)

    def step(self, cause: Bools) -> Floats:
        """Advance by one step.

        Args:
            cause: Whether the cause is present.

        Returns:
            How long the effect has lasted [s]: negative before it begins, ``-inf`` without a cause.
        """
        self._since = np.where(cause, np.minimum(self._since, self._now), np.inf)
        lasted = np.where(cause, self._now - self._since - self._seconds, -np.inf)
        self._now += self._dt
        return np.where(np.isfinite(lasted), np.round(lasted, 9), lasted)


REG157_BRAKING_M_S2 = 6.0  # UN R157
REG157_INTRUSION_M = 0.3  # past the line, UN R157
REG157_TTC_S = 2.0  # time to collision


class Reg157:
    """UN R157's requirement for cut-ins: avoid each collision that braking at 6 m/s2 after 0.35 s avoids.

    Source: UN Regulation No. 157, 5.2.5.2. The system avoids a collision with a vehicle that cuts in if the time to
    collision at the moment of intrusion is more than v_rel / (2 * 6 m/s2) + 0.35 s. The vehicle has intruded once it is
    0.3 m beyond the line of the ego's lane.

    The requirement as a driver: a slower vehicle ahead must have intruded, or drive in the lane. Braking at 6 m/s2
    begins 0.35 s after the time to collision is at most 2 s or, at high closing speeds, at most the time that the
    requirement takes. Braking earlier changes no outcome and would only raise false alarms. The regulation leaves two
    points open: here, the braking is at once complete, without a ramp, and it lasts until the ego is no longer faster.
    """

    name: ClassVar[str] = "reg157"
    delay: ClassVar[float] = 0.35  # s, UN R157

    def __init__(self, shape: tuple[int, int], dt: float) -> None:
        self._dt = dt
        self._delay = Delay(shape, self.delay, dt)
        self._danger = np.zeros(shape, bool)
        self.alarmed: Bools = np.zeros(shape[0], bool)

    def watch(self, columns: Ints) -> None:
        self._delay.watch(columns)
        self._danger = rearranged(self._danger, columns, False)

    def step(self, view: View) -> Floats:
        over_the_line = view.near_edge < view.lane_half_width - REG157_INTRUSION_M + 1e-9
        intrudes = view.same_direction & view.ahead & over_the_line
        closing = view.closing
        faster = intrudes & (closing > 0.0)
        begins = faster & (view.gap > 0.0)
        if begins.any():
            needed = closing / (2 * REG157_BRAKING_M_S2) + self.delay + self._dt
            begins &= view.time_to_reach <= np.maximum(REG157_TTC_S, needed)
        self._danger = (self._danger & faster) | begins
        self.alarmed |= self._danger.any(axis=1)
        lasted = self._delay.step(self._danger).max(axis=1, initial=-np.inf)
        part = np.clip((lasted + self._dt) / self._dt, 0.0, 1.0)  # braked share of the first step
        return np.where(part > 1e-9, -REG157_BRAKING_M_S2 * part, np.nan)


RSS_NUMBERS = Rss(
    response=0.75, acceleration=3.0, braking=6.0, hard_braking=6.0, lateral_acceleration=1.0, lateral_braking=1.0
)  # fmt: skip
RSS_LATERAL_MARGIN_M = 0.3  # lateral distance that is kept in addition to RSS's own


class RssDriver:
    """Responsibility-Sensitive Safety (RSS) as a driver: it keeps the safe distances and brakes if both are broken.

    Source: Shalev-Shwartz, Shammah, Shashua 2017, "On a Formal Model of Safe and Scalable Self-driving Cars",
    definitions 1 (longitudinal), 6 (lateral) and 4 (proper response). A situation is dangerous if the longitudinal and
    the lateral distance are both unsafe. After the response time, the driver brakes until the situation is safe again.

    The paper gives no numbers. These are those of the JRC's implementation (ec-jrc/JRC-FSM): both vehicles brake at
    6 m/s2 in the safe distance, and the other vehicle moves sideways with 1 m/s2. The driver responds after 0.75 s with
    the braking of UN R157's human driver, so that the drivers differ by their rules and not by their reaction. The
    lateral part of the proper response is left out: the driver does not steer, and its own lateral movement is taken as
    zero.
    """

    name: ClassVar[str] = "rss"
    delay: ClassVar[float] = RSS_NUMBERS.response

    def __init__(self, shape: tuple[int, int], dt: float) -> None:
        self._dt = dt
        self._delay = Delay(shape, self.delay, dt)
        self.alarmed: Bools = np.zeros(shape[0], bool)

    def watch(self, columns: Ints) -> None:
        self._delay.watch(columns)

    def step(self, view: View) -> Floats:
        along = np.maximum(view.along, 0.0)
        own = np.broadcast_to(view.ego_speed, along.shape)
        unsafe_along = view.gap < longitudinal_safe_distance(own, along, RSS_NUMBERS)
        unsafe_across = view.side_gap < RSS_LATERAL_MARGIN_M + lateral_way(view.towards, RSS_NUMBERS)
        dangerous = view.same_direction & view.ahead & unsafe_along & unsafe_across
        self.alarmed |= dangerous.any(axis=1)
        lasted = self._delay.step(dangerous).max(axis=1, initial=-np.inf)
        lost = speed_lost(lasted + self._dt) - speed_lost(lasted)
        return np.where(lost > 1e-9, -lost / self._dt, np.nan)


FSM_REACTION_S = 0.75
FSM_COMFORTABLE_BRAKING_M_S2, FSM_MAX_BRAKING_M_S2 = 4.0, 6.0  # the ego's braking
FSM_LEADER_BRAKING_M_S2 = 7.0  # the other vehicle's maximum braking
FSM_STANDING_GAP_M = 2.0  # gap between two vehicles that stand
FSM_LATERAL_SLACK_S = 0.1
FSM_JERK_M_S3 = 12.65


def proactive(gap: Floats, ego: Floats, other: Floats) -> Floats:
    """Compute the proactive fuzzy metric (PFS), for a leader that brakes at its maximum.

    Args:
        gap: The gap [m].
        ego: The ego's speed [m/s].
        other: The other vehicle's speed [m/s].

    Returns:
        1 if the ego's maximum braking would not be enough, 0 if comfortable braking is, linear between.
    """
    stopping = ego * FSM_REACTION_S - other**2 / (2 * FSM_LEADER_BRAKING_M_S2)
    safe = stopping + ego**2 / (2 * FSM_COMFORTABLE_BRAKING_M_S2) + FSM_STANDING_GAP_M
    return _between(gap, stopping + ego**2 / (2 * FSM_MAX_BRAKING_M_S2), safe)


def critical(gap: Floats, ego: Floats, other: Floats, acceleration: Floats) -> Floats:
    """Compute the critical fuzzy metric (CFS), for a leader that keeps its speed.

    Args:
        gap: The gap [m].
        ego: The ego's speed [m/s].
        other: The other vehicle's speed [m/s].
        acceleration: The ego's acceleration [m/s2].

    Returns:
        1 if the ego's maximum braking would not be enough, 0 if comfortable braking is, linear between.
    """
    held = np.maximum(acceleration, -FSM_COMFORTABLE_BRAKING_M_S2)
    after = np.maximum(ego + held * FSM_REACTION_S, 0.0)
    nearer = ((ego + after) / 2 - other) * FSM_REACTION_S
    closing = np.maximum(after - other, 0.0)
    most, comfortable = 2 * FSM_MAX_BRAKING_M_S2, 2 * FSM_COMFORTABLE_BRAKING_M_S2
    degree = _between(gap, nearer + closing**2 / most, nearer + closing**2 / comfortable)
    stopping = (ego - other) ** 2 / (2 * np.maximum(np.abs(held), 1e-9))
    degree = np.where(after <= other, np.where(gap <= stopping, 1.0, 0.0), degree)
    return np.where(ego > other, degree, 0.0)


def _between(gap: Floats, unsafe: Floats, safe: Floats) -> Floats:
    """Interpolate between 1 up to the gap ``unsafe`` and 0 from the gap ``safe`` on."""
    span = np.maximum(safe - unsafe, 1e-9)
    return np.clip((safe - gap) / span, 0.0, 1.0)


class Fsm:
    """JRC's Fuzzy Safety Model: a driver that anticipates, and brakes comfortably before it has to brake hard.

    Source: Mattas et al. 2020, "Fuzzy Surrogate Safety Metrics for real-time assessment of rear-end collision risk",
    and 2022, "Driver models for the definition of safety requirements of automated vehicles in international
    regulations"; performance model 2 of UN R157 (01 series).

    Lateral check: a vehicle beside the ego's corridor matters if its rear is ahead of the ego's front, it moves towards
    the ego, the ego is faster, and side_gap / v_lateral < (gap + both lengths) / closing speed + 0.1 s. A vehicle in
    the corridor always matters.

    Longitudinal check: the proactive (PFS) and the critical (CFS) fuzzy metrics, in [0, 1].

    Reaction: 0.75 s after the risk shows, the driver brakes with CFS * (6 - 4) + 4 m/s2 if CFS > 0, otherwise with
    PFS * 4 m/s2. Braking changes by at most 12.65 m/s3.

    The papers leave two points open. Here, the delay runs while the risk lasts. Once the driver brakes, it follows the
    risk without a further delay.
    """

    name: ClassVar[str] = "fsm"
    delay: ClassVar[float] = FSM_REACTION_S

    def __init__(self, shape: tuple[int, int], dt: float) -> None:
        self._dt = dt
        self._delay = Delay((shape[0],), self.delay, dt)
        self._braking = np.zeros(shape[0])
        self.alarmed: Bools = np.zeros(shape[0], bool)

    def watch(self, columns: Ints) -> None:
        """Do nothing: the driver remembers nothing about single vehicles."""

    def step(self, view: View) -> Floats:
        matters = view.same_direction & view.ahead & (view.in_corridor | self._moves_in(view))
        ego, leader = view.ego_speed + 0.0 * view.along, np.maximum(view.along, 0.0)
        gap = np.maximum(view.gap, 0.0)
        gap = np.where(matters, gap, 1e9)
        cfs = critical(gap, ego, leader, view.ego_acceleration + 0.0 * leader)
        pfs = proactive(gap, ego, leader)
        comfortable, most = FSM_COMFORTABLE_BRAKING_M_S2, FSM_MAX_BRAKING_M_S2
        braking = np.where(cfs > 0.0, cfs * (most - comfortable) + comfortable, pfs * comfortable)
        braking = np.where(matters, braking, 0.0).max(axis=1, initial=0.0)
        risk = braking > 0.0
        self.alarmed |= risk
        acts = self._delay.step(risk) > -1e-9
        change = FSM_JERK_M_S3 * self._dt
        target = np.where(acts, braking, 0.0)
        self._braking = np.clip(target, self._braking - change, self._braking + change)
        return np.where(self._braking > 1e-9, -self._braking, np.nan)

    @staticmethod
    def _moves_in(view: View) -> Bools:
        """Apply the lateral check."""
        sideways = view.towards > 1e-9
        across = view.side_gap / np.where(sideways, view.towards, 1.0)
        closing = view.closing
        lengths = view.gap + view.ego_length + view.length
        along = lengths / np.where(closing > 1e-9, closing, 1.0)
        return (view.gap > 0.0) & sideways & (closing > 1e-9) & (across < along + FSM_LATERAL_SLACK_S)
