"""Measure how severe a collision is: the planar impact of two rigid bodies, and the injury risk at its delta-v.

Impact: two-body planar impulse along the contact normal at the contact point (Brach and Brach 2011, "Vehicle Accident
Analysis and Reconstruction Methods", chapter 6), with yaw inertia, restitution 0.1 and no friction. With unit normal n
from the ego to the adversary, levers r, masses m, yaw inertias I and closing speed u at the contact point along n:

    impulse J = (1 + e) u / (1 / m_a + 1 / m_b + (r_a x n)^2 / I_a + (r_b x n)^2 / I_b),   delta-v = J / m

A sideswipe at equal speeds has almost no closing speed along its normal, and so almost no delta-v.

Injury risk: Lubbe et al. 2022 (Traffic Safety Research 2, 000006), serious injury (MAIS3+F) of a car driver in a
frontal collision with a car, logistic in the closing speed with a slope of 0.041 per km/h and 10 % at 112 km/h. The
closing speed is taken as twice the delta-v, as for two equal cars head-on. The risk serves to order collisions; it does
not predict injuries in side impacts or with trucks.

If the ego hits a pedestrian, a cyclist or a motorcyclist, the risk is theirs: a serious injury (MAIS3+F) at the impact
speed, which is the closing speed along the contact normal. The same study gives 10 % at 29 km/h for pedestrians, at
44 km/h for cyclists and at 48 km/h for motorcyclists hit by the front of a car. Its slopes were not at hand. The slope
of Rosen and Sander 2009 (Accident Analysis and Prevention 41, 536-542; fatality of adult pedestrians, 0.090 per km/h)
is used for all three. The level ``serious`` depends on the speed of 10 % alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from sumo_adv.datatypes import MPH_M_S, Boxes, Track
from sumo_adv.geometry import wrap_below_pi
from sumo_adv.metrics.boxes import at_time, axis_separations
from sumo_adv.metrics.contact import Side, contact_point, contact_sides
from sumo_adv.road_users import RoadUser, Sized, is_motorcycle, road_user

RESTITUTION = 0.1
RISK_SLOPE_PER_KMH = 0.041
CLOSING_SPEED_OF_TENTH_RISK_KMH = 112.0  # the risk is 10 % at this speed
UNPROTECTED_SLOPE_PER_KMH = 0.090
TENTH_RISK_SPEED_KMH = {RoadUser.PEDESTRIAN: 29.0, RoadUser.CYCLIST: 44.0}  # the risk is 10 % at this impact speed
MOTORCYCLIST_TENTH_RISK_SPEED_KMH = 48.0
SERIOUS_DELTA_V_M_S = 2.24  # 5 mph
NEAR_TOUCH_DELTA_V_M_S = 0.447  # 1 mph; a collision with a smaller delta-v of the ego is a near-touch
MASS_KG_BY_LENGTH_M = (
    (1.0, 80.0),
    (2.05, 100.0),
    (2.15, 160.0),
    (2.8, 250.0),
    (4.2, 1150.0),
    (5.3, 1500.0),
    (7.0, 2800.0),
    (9.0, 7500.0),
    (math.inf, 16000.0),
)
"""Mass [kg] of vehicles up to a length [m].

The classes are pedestrian, bicycle, moped or motorcycle with rider, small car, car, van, light truck, and bus or truck.
The masses are kerb masses of common vehicles with a driver.
"""


class Severity(StrEnum):
    """Classes of the larger delta-v: below 1 mph, below 5 mph, below 15 mph, above."""

    NEGLIGIBLE = "negligible"
    MINOR = "minor"
    MODERATE = "moderate"
    SEVERE = "severe"


@dataclass(frozen=True, slots=True)
class Crash:
    """The impact of the ego and the adversary.

    Attributes:
        ego_delta_v: The ego's delta-v [m/s].
        adversary_delta_v: The adversary's delta-v [m/s].
        closing: Closing speed along the contact normal, at the contact point [m/s].
        ego_side: The side of the ego that is hit.
        adversary_side: The side of the adversary that is hit.
        severity: The class of the larger delta-v.
        overlap: Share of the narrower of the two touching faces that meets the other one, [0, 1].
        injury_risk: Risk of a serious injury, [0, 1]: of the unprotected road user that is hit or, without one, of the
            ego's driver.
        impact_speed: ``closing``, if the adversary does not protect its driver; otherwise None [m/s].
    """

    ego_delta_v: float
    adversary_delta_v: float
    closing: float
    ego_side: Side
    adversary_side: Side
    severity: Severity
    overlap: float
    injury_risk: float
    impact_speed: float | None


def mass_of(length: float) -> float:
    """Return the mass [kg] of a vehicle of a length [m]."""
    return next(mass for longest, mass in MASS_KG_BY_LENGTH_M if length < longest)


def severity_of(delta_v: float) -> Severity:
    """Return the class of a delta-v [m/s]."""
    for limit, name in ((1, Severity.NEGLIGIBLE), (5, Severity.MINOR), (15, Severity.MODERATE)):
        if delta_v < limit * MPH_M_S:
            return name
    return Severity.SEVERE


def is_near_touch(delta_v: float, impact_speed: float | None) -> bool:
    """Return whether a contact was negligible.

    Args:
        delta_v: The delta-v of the ego [m/s].
        impact_speed: The speed at which a pedestrian, a cyclist or a motorcyclist is hit [m/s], which never is
            negligible; None for another road user.
    """
    return impact_speed is None and delta_v < NEAR_TOUCH_DELTA_V_M_S


def injury_risk(delta_v: float) -> float:
    """Return the probability of a serious injury (MAIS3+F) of a car driver at a delta-v [m/s]."""
    closing = 2 * delta_v * 3.6
    return 1.0 / (1.0 + math.exp(-(RISK_SLOPE_PER_KMH * (closing - CLOSING_SPEED_OF_TENTH_RISK_KMH) + math.log(1 / 9))))


def unprotected_risk(tenth: float, impact_speed: float) -> float:
    """Return the probability of a serious injury (MAIS3+F) of a road user that is hit.

    Args:
        tenth: The speed at which the probability is 10 % [km/h].
        impact_speed: The impact speed [m/s].
    """
    beyond = impact_speed * 3.6 - tenth
    return 1.0 / (1.0 + math.exp(-(UNPROTECTED_SLOPE_PER_KMH * beyond + math.log(1 / 9))))


def tenth_of(adversary: Sized) -> float | None:
    """Return the impact speed at which 10 % of the people on the adversary are seriously injured.

    Args:
        adversary: The adversary, whose size tells its kind.

    Returns:
        The speed [km/h] for a pedestrian, cyclist or motorcyclist; None for a vehicle that protects its driver.
    """
    if is_motorcycle(adversary):
        return MOTORCYCLIST_TENTH_RISK_SPEED_KMH
    return TENTH_RISK_SPEED_KMH.get(road_user(adversary))


def hardness(crash: Crash, user: RoadUser) -> float:
    """Return how hard a crash is; 1 = serious.

    Args:
        crash: The crash.
        user: The kind of the adversary.

    Returns:
        The ego's delta-v as a share of the serious one. For an adversary that does not protect its driver, the impact
        speed as a share of that at which 10 % of such road users are seriously injured.
    """
    if crash.impact_speed is None:
        return crash.ego_delta_v / SERIOUS_DELTA_V_M_S
    return crash.impact_speed * 3.6 / TENTH_RISK_SPEED_KMH.get(user, MOTORCYCLIST_TENTH_RISK_SPEED_KMH)


def crash(ego: Track, adversary: Track, contact_time: float) -> Crash:
    """Return the impact of two tracks at their first contact.

    Args:
        ego: The ego's track.
        adversary: The adversary's track.
        contact_time: When they first touch [s].
    """
    boxes = at_time(ego, contact_time), at_time(adversary, contact_time)
    return crash_of(*boxes, (_yaw_rate(ego, contact_time), _yaw_rate(adversary, contact_time)))


def crash_of(ego: Boxes, adversary: Boxes, yaw_rates: tuple[float, float]) -> Crash:
    """Return the impact of two boxes at first contact.

    Args:
        ego: The ego's box (0-d arrays).
        adversary: The adversary's box (0-d arrays).
        yaw_rates: The yaw rates of both [rad/s].
    """
    a, b = ego, adversary
    normal, point = _normal(a, b), contact_point(a, b)
    mass = [mass_of(float(v.length)) for v in (a, b)]
    inertia = [m * (float(v.length) ** 2 + float(v.width) ** 2) / 12 for m, v in zip(mass, (a, b), strict=True)]
    lever, velocity = [], []
    for box, yaw in zip((a, b), yaw_rates, strict=True):
        rx, ry = point[0] - float(box.x), point[1] - float(box.y)
        vx, vy = float(box.speed * np.cos(box.heading)), float(box.speed * np.sin(box.heading))
        lever.append(rx * normal[1] - ry * normal[0])
        velocity.append((vx - yaw * ry, vy + yaw * rx))
    closing = max(sum((v - w) * n for v, w, n in zip(*velocity, normal, strict=True)), 0.0)
    effective = sum(1 / m + arm**2 / i for m, arm, i in zip(mass, lever, inertia, strict=True))
    impulse = (1 + RESTITUTION) * closing / effective
    deltas = [impulse / m for m in mass]
    sides, tenth = contact_sides(a, b), tenth_of(b)  # type: ignore[arg-type]
    risk = injury_risk(deltas[0]) if tenth is None else unprotected_risk(tenth, closing)
    return Crash(
        deltas[0], deltas[1], closing, *sides, severity_of(max(deltas)), _overlap(a, b, normal), risk,
        None if tenth is None else closing,
    )  # fmt: skip


def _overlap(a: Boxes, b: Boxes, normal: tuple[float, float]) -> float:
    """Return the share of the narrower box, seen along the contact normal, that meets the other one."""
    spans = []
    for box in (a, b):
        middle = float(box.y) * normal[0] - float(box.x) * normal[1]
        turned = float(box.heading) - math.atan2(normal[1], normal[0])
        half = (abs(math.sin(turned)) * float(box.length) + abs(math.cos(turned)) * float(box.width)) / 2
        spans.append((middle - half, middle + half))
    (low, high), (other_low, other_high) = spans
    meets = max(min(high, other_high) - max(low, other_low), 0.0)
    return meets / min(high - low, other_high - other_low)


def _normal(a: Boxes, b: Boxes) -> tuple[float, float]:
    """Return the unit vector from a to b across the faces that touch: the axis on which the boxes were last apart."""
    across = int(np.argmax([float(v) for v in axis_separations(a, b)]))
    heading = float(a.heading if across < 2 else b.heading) + (0.0 if across % 2 == 0 else math.pi / 2)
    n = math.cos(heading), math.sin(heading)
    towards = (float(b.x) - float(a.x)) * n[0] + (float(b.y) - float(a.y)) * n[1]
    return n if towards >= 0 else (-n[0], -n[1])


def _yaw_rate(track: Track, time: float) -> float:
    """Return the yaw rate [rad/s] over the step before ``time``."""
    k = int(np.clip(np.searchsorted(track.time, time - 1e-9) - 1, 0, max(len(track.time) - 2, 0)))
    if len(track.time) < 2:
        return 0.0
    turn = wrap_below_pi(track.heading[k + 1] - track.heading[k])
    return float(turn / (track.time[k + 1] - track.time[k]))
