"""Decide who is at fault: nuPlan's at-fault rules, with Responsibility-Sensitive Safety (RSS) as a second opinion.

nuPlan (nuplan-devkit, ``no_ego_at_fault_collisions``): the ego is at fault if it runs into a stopped vehicle or hits
another one with its front bumper. It is never at fault if it stands or is hit from behind. nuPlan's rule for lateral
collisions of an ego that is between lanes or off the road is left out.

RSS: Shalev-Shwartz, Shammah, Shashua 2017, definitions 1, 6 and the blame rule, same direction only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Bools, Floats, Track
from sumo_adv.geometry import wrap_below_pi
from sumo_adv.metrics.contact import OPPOSITE_DIRECTION, SAME_DIRECTION, CollisionClass, collision_class

EGO_PARTY, ADVERSARY_PARTY = "ego", "adversary"
LOOK_BACK_DISTANCE_M = 60.0  # before the contact, for both vehicles: an intrusion takes 2 to 3 s, at 20 m/s
MIN_SHARED_PATH_M = 1.0  # both ways together; shorter ones do not show a bend
MAX_START_ANGLE_RAD = 1.3  # between the directions at the start; if larger, one vehicle came from another road
STRAIGHT_CURVATURE_1_M = 1e-6  # an arc with less curvature is a line


@dataclass(frozen=True, slots=True)
class Rss:
    """Parameters of RSS. The defaults are those of the ad-rss library.

    Attributes:
        response: Response time [s].
        acceleration: Maximum acceleration while responding [m/s2].
        braking: Minimum deceleration of the vehicle behind [m/s2].
        hard_braking: Maximum deceleration of the vehicle ahead [m/s2].
        lateral_acceleration: Maximum lateral acceleration while responding [m/s2].
        lateral_braking: Minimum lateral deceleration [m/s2].
    """

    response: float = 1.0
    acceleration: float = 3.5
    braking: float = 4.0
    hard_braking: float = 8.0
    lateral_acceleration: float = 0.2
    lateral_braking: float = 0.8


DEFAULT_RSS = Rss()


def nuplan_fault(ego: Track, adversary: Track, contact_time: float) -> str:
    """Return which party is at fault by nuPlan's rules: ``ego`` or ``adversary``."""
    kind = collision_class(ego, adversary, contact_time)
    return EGO_PARTY if kind in (CollisionClass.STOPPED_TRACK, CollisionClass.ACTIVE_FRONT) else ADVERSARY_PARTY


def fault(ego: Track, adversary: Track, contact_time: float) -> str:
    """Return which party is at fault: by nuPlan's rules or, in a head-on collision, the vehicle that left its side.

    nuPlan blames an ego that is hit head-on in its own lane, because the ego meets the other vehicle with its front
    bumper. In a head-on collision, this function blames the vehicle that came further over to the other's side on its
    own last ``LOOK_BACK_DISTANCE_M``, even if it then stopped. The road is assumed to be the arc that the vehicles'
    directions at the start of this stretch span.

    Args:
        ego: The ego's track.
        adversary: The adversary's track.
        contact_time: When they first touch [s].

    Returns:
        ``ego`` or ``adversary``.
    """
    a, b = (t.between(-np.inf, contact_time) for t in (ego, adversary))
    turn = np.abs(wrap_below_pi(b.heading[-1:] - a.heading[-1:]))
    if len(a.time) < 2 or len(b.time) < 2 or turn[0] < OPPOSITE_DIRECTION:
        return nuplan_fault(ego, adversary, contact_time)
    a, b = map(_last_way, (a, b))
    angle = float(wrap_below_pi(b.heading[:1] - np.pi - a.heading[:1])[0])
    angle = angle if abs(angle) < MAX_START_ANGLE_RAD else 0.0
    curvature = angle / max(_to_go(a)[0] + _to_go(b)[0], MIN_SHARED_PATH_M)
    return ADVERSARY_PARTY if _came_over(b, a, -curvature) > _came_over(a, b, curvature) else EGO_PARTY


def _last_way(track: Track) -> Track:
    """Return the last ``LOOK_BACK_DISTANCE_M`` of a track, or all of a shorter one."""
    to_go = _to_go(track)
    return track.between(float(track.time[to_go >= min(LOOK_BACK_DISTANCE_M, to_go[0])][-1]), np.inf)


def _to_go(track: Track) -> Floats:
    """Return the distance from each state of a track to its last one [m]."""
    steps = np.hypot(np.diff(track.x), np.diff(track.y))
    return np.append(steps[::-1].cumsum()[::-1], 0.0)


def _came_over(track: Track, other: Track, curvature: float) -> float:
    """Return how far a vehicle is on the other's side at its last state [m], on the arc that begins at its first state.

    Args:
        track: The vehicle's track.
        other: The other vehicle's track.
        curvature: Curvature of the arc [1/m], positive to the left.
    """
    side = np.sign(_left_of(track, curvature, other.x[0], other.y[0]))
    return float(side * _left_of(track, curvature, track.x[-1], track.y[-1]))


def _left_of(track: Track, curvature: float, x: float, y: float) -> float:
    """Return how far a point is to the left of the arc that begins as the track does [m]."""
    c, s = np.cos(track.heading[0]), np.sin(track.heading[0])
    dx, dy = x - track.x[0], y - track.y[0]
    along, left = dx * c + dy * s, dy * c - dx * s
    if abs(curvature) < STRAIGHT_CURVATURE_1_M:
        return float(left)
    return float((1.0 - np.hypot(curvature * along, 1.0 - curvature * left)) / curvature)


def longitudinal_safe_distance(rear: Floats, front: Floats, rss: Rss = DEFAULT_RSS) -> Floats:
    """Compute RSS's minimum safe gap in one direction: v_r p + a p^2/2 + (v_r + p a)^2 / 2b - v_f^2 / 2B, at least 0.

    Args:
        rear: Speed of the vehicle behind, v_r [m/s].
        front: Speed of the vehicle ahead, v_f [m/s].
        rss: The parameters.

    Returns:
        The gap [m].
    """
    after = rear + rss.response * rss.acceleration
    needed = rear * rss.response + rss.acceleration * rss.response**2 / 2 + after**2 / (2 * rss.braking)
    return np.maximum(needed - front**2 / (2 * rss.hard_braking), 0.0)


def lateral_way(speed: Floats, rss: Rss) -> Floats:
    """Compute how far a vehicle moves sideways at most until its lateral speed is zero.

    Args:
        speed: Lateral speed towards the other vehicle [m/s].
        rss: The parameters.

    Returns:
        The distance towards the other vehicle [m]; negative if it moves away.
    """
    after = speed + rss.response * rss.lateral_acceleration
    return (speed + after) / 2 * rss.response + np.sign(after) * after**2 / (2 * rss.lateral_braking)


@dataclass(frozen=True, slots=True)
class SecondOpinion:
    """The opinion of RSS on a collision of vehicles that go the same way.

    Attributes:
        dangerous_since: Since when the situation was dangerous [s].
        trigger: ``lateral`` if a vehicle moved across, ``longitudinal`` if a vehicle followed too closely.
        blame: The party to blame, ``ego`` or ``adversary``.
    """

    dangerous_since: float
    trigger: str  # lateral | longitudinal
    blame: str


def rss_opinion(ego: Track, adversary: Track, contact_time: float) -> SecondOpinion | None:
    """Decide by RSS which vehicle is to blame.

    The situation is dangerous while both the longitudinal and the lateral distance are unsafe; the last such spell
    before the contact counts. If the lateral distance became unsafe last (a cut-in), the adversary is to blame if it
    moves towards the ego or not sideways at all. If the longitudinal distance became unsafe last, the rear vehicle had
    to brake with ``braking`` after ``response``. The adversary is to blame if it was behind, or if the ego was behind
    and did brake so.

    Args:
        ego: The ego's track.
        adversary: The adversary's track.
        contact_time: When they first touch [s].

    Returns:
        The opinion; None unless both go the same way at the contact.
    """
    start = max(ego.time[0], adversary.time[0])
    a, b = ego.between(start, contact_time), adversary.between(start, contact_time)
    if not len(a.time) or abs(float(wrap_below_pi(b.heading[-1:] - a.heading[-1:])[0])) > SAME_DIRECTION:
        return None
    towards, behind, unsafe_along, unsafe_across = _unsafe(a, b)
    spell = min(_spell(unsafe_along & unsafe_across), len(a.time) - 1)
    when = float(a.time[spell])
    if _spell(unsafe_across) > _spell(unsafe_along):
        return SecondOpinion(when, "lateral", ADVERSARY_PARTY if towards[spell] >= 0.0 else EGO_PARTY)
    if not behind[spell]:
        return SecondOpinion(when, "longitudinal", ADVERSARY_PARTY)
    due = a.time >= when + DEFAULT_RSS.response
    braked = bool((a.acceleration[due] <= -DEFAULT_RSS.braking + 0.1).all())
    return SecondOpinion(when, "longitudinal", ADVERSARY_PARTY if braked else EGO_PARTY)


def _unsafe(a: Track, b: Track) -> tuple[Floats, Bools, Bools, Bools]:
    """Return per step: the adversary's lateral speed towards the ego, and whether the ego is behind.

    Return also whether the longitudinal and the lateral distance are unsafe. The ego has no lateral speed in its own
    frame.
    """
    c, s = np.cos(a.heading), np.sin(a.heading)
    dx, dy, turn = b.x - a.x, b.y - a.y, b.heading - a.heading
    x, y = dx * c + dy * s, dy * c - dx * s
    behind = x >= 0
    along = np.abs(x) - (a.length + b.length * np.abs(np.cos(turn)) + b.width * np.abs(np.sin(turn))) / 2
    beside = np.abs(y) - (a.width + b.length * np.abs(np.sin(turn)) + b.width * np.abs(np.cos(turn))) / 2
    forward, towards = b.speed * np.cos(turn), -np.sign(y) * b.speed * np.sin(turn)
    safe = np.where(behind, longitudinal_safe_distance(a.speed, forward), longitudinal_safe_distance(forward, a.speed))
    own, its = lateral_way(np.zeros(1), DEFAULT_RSS), lateral_way(towards, DEFAULT_RSS)
    return towards, behind, along < safe, beside < np.maximum(own + its, 0.0)


def _spell(holds: Bools) -> int:
    """Return the first step of the spell that runs to the end; ``len(holds)`` if the last step does not hold."""
    broken = np.flatnonzero(~holds)
    return int(broken[-1] + 1) if broken.size else 0
