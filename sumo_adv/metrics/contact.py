"""What touched what: the sides in contact, nuPlan's collision classes, rear-end, impact.

Contact sides come from the separating axes at the moment of first contact: the axis along which the boxes were last
apart is the one they touched across.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from sumo_adv.datatypes import Boxes, Floats, Track
from sumo_adv.metrics.boxes import at_time, axis_separations, corners, overlaps, wrap

STOPPED = 0.05  # m/s, nuPlan's threshold for a stopped vehicle
SAME_DIRECTION = np.pi / 4  # rad, heading difference below which two vehicles go the same way
BEHIND = np.deg2rad(150.0)  # rad, nuPlan's angle from the rear axle beyond which an agent is behind
BUMPER = 0.02  # m before the ego's front edge, and in from its ends: a touch of the corner alone is lateral
REAR_AXLE = 0.3  # of the length, rear axle behind the box centre


class CollisionClass(StrEnum):
    """nuPlan's classes of an ego collision (nuplan-devkit, no_ego_at_fault_collisions)."""

    STOPPED_EGO = "stopped_ego"
    STOPPED_TRACK = "stopped_track"
    ACTIVE_REAR = "active_rear"
    ACTIVE_FRONT = "active_front"
    ACTIVE_LATERAL = "active_lateral"


class Side(StrEnum):
    """A side of a box."""

    FRONT = "front"
    REAR = "rear"
    LEFT = "left"
    RIGHT = "right"


def heading_difference(a: Boxes, b: Boxes) -> Floats:
    """|heading of b - heading of a| in [0, pi] [rad]."""
    return np.abs(wrap(np.asarray(b.heading - a.heading)))


def contact_sides(a: Boxes, b: Boxes) -> tuple[Side, Side]:
    """The side of a and the side of b that meet, for two boxes at first contact (0-d arrays)."""
    separations = [float(v) for v in axis_separations(a, b)]
    across = int(np.argmax(separations))
    if across < 2:
        return _face(a, b, across), _nearest_face(b, a, across, a)
    return _nearest_face(a, b, across - 2, b), _face(b, a, across - 2)


def _face(own: Boxes, other: Boxes, axis: int) -> Side:
    """The face of ``own`` that looks at ``other`` along its length (axis 0) or width (axis 1)."""
    c, s = float(np.cos(own.heading)), float(np.sin(own.heading))
    dx, dy = float(other.x - own.x), float(other.y - own.y)
    if axis == 0:
        return Side.FRONT if dx * c + dy * s >= 0 else Side.REAR
    return Side.LEFT if dy * c - dx * s >= 0 else Side.RIGHT


def _nearest_face(own: Boxes, other: Boxes, axis: int, frame: Boxes) -> Side:
    """The face of ``own`` most nearly perpendicular to the contact axis of ``frame``, on the side of ``other``."""
    turn = float(own.heading - frame.heading)
    lengthwise = abs(np.cos(turn)) if axis == 0 else abs(np.sin(turn))
    return _face(own, other, 0 if lengthwise >= np.sqrt(0.5) else 1)


def contact_point(a: Boxes, b: Boxes) -> tuple[float, float]:
    """Where two boxes at first contact touch (x, y) [m]: the mean of the corners that lie in (or nearest) the other."""
    points = []
    for own, other in ((a, b), (b, a)):
        c, s = float(np.cos(other.heading)), float(np.sin(other.heading))
        for x, y in corners(own):
            px, py = (x - other.x) * c + (y - other.y) * s, (y - other.y) * c - (x - other.x) * s
            outside = np.hypot(max(abs(px) - other.length / 2, 0.0), max(abs(py) - other.width / 2, 0.0))
            points.append((float(outside), float(x), float(y)))
    least = min(p[0] for p in points)
    touching = [p for p in points if p[0] <= least + 0.02]
    return float(np.mean([p[1] for p in touching])), float(np.mean([p[2] for p in touching]))


def in_frame(b: Boxes, point: tuple[float, float]) -> tuple[float, float]:
    """A point in the box's own frame [m]: forward, left of its centre."""
    c, s = float(np.cos(b.heading)), float(np.sin(b.heading))
    dx, dy = point[0] - float(b.x), point[1] - float(b.y)
    return dx * c + dy * s, dy * c - dx * s


def rear_end(ego: Track, adversary: Track, contact_time: float) -> bool:
    """Whether the adversary runs into the ego's back.

    Both head the same way (within 45 degrees), the faces that meet are the ego's rear and the adversary's front, and
    the adversary is the faster along the ego's heading.
    """
    a, b = at_time(ego, contact_time), at_time(adversary, contact_time)
    if heading_difference(a, b) > SAME_DIRECTION or contact_sides(a, b) != (Side.REAR, Side.FRONT):
        return False
    return bool(b.speed * np.cos(b.heading - a.heading) > a.speed)


def collision_class(ego: Track, adversary: Track, contact_time: float) -> CollisionClass:
    """nuPlan's class of a collision, in its order: stopped ego, stopped track, rear, front bumper, else lateral.

    nuPlan looks at the first overlapping sample (0.1 s), where a box that ran into the ego's flank may already cut the
    line of its front bumper; here it is the exact first contact.
    """
    a, b = at_time(ego, contact_time), at_time(adversary, contact_time)
    if a.speed <= STOPPED:
        return CollisionClass.STOPPED_EGO
    if b.speed <= STOPPED:
        return CollisionClass.STOPPED_TRACK
    axle_x = a.x - REAR_AXLE * a.length * np.cos(a.heading)
    axle_y = a.y - REAR_AXLE * a.length * np.sin(a.heading)
    bearing = np.arctan2(b.y - axle_y, b.x - axle_x) - a.heading
    if abs(float(wrap(np.asarray(bearing)))) > BEHIND:
        return CollisionClass.ACTIVE_REAR
    front = a.length / 2 * np.cos(a.heading), a.length / 2 * np.sin(a.heading)
    bumper = Boxes(a.x + front[0], a.y + front[1], a.heading, a.speed, 2 * BUMPER, a.width - 2 * BUMPER)
    return CollisionClass.ACTIVE_FRONT if overlaps(bumper, b) else CollisionClass.ACTIVE_LATERAL


@dataclass(frozen=True, slots=True)
class Impact:
    """A collision's severity. Speeds m/s, angle rad, points m in each box's own frame (forward, left)."""

    time: float
    speed: float  # relative speed at contact
    ego_speed: float
    adversary_speed: float
    delta_v: float  # of the ego, equal specific mass by area, plastic
    angle: float  # heading of the adversary in the ego's frame
    ego_point: tuple[float, float]
    adversary_point: tuple[float, float]
    ego_side: Side
    adversary_side: Side


def impact(ego: Track, adversary: Track, contact_time: float) -> Impact:
    """How hard, where and with which sides they met; delta-v of the ego for a plastic impact.

    delta_v = m_b / (m_a + m_b) |v_b - v_a| with masses taken as proportional to length x width.
    """
    a, b = at_time(ego, contact_time), at_time(adversary, contact_time)
    vx = float(b.speed * np.cos(b.heading) - a.speed * np.cos(a.heading))
    vy = float(b.speed * np.sin(b.heading) - a.speed * np.sin(a.heading))
    mass_a, mass_b = float(a.length * a.width), float(b.length * b.width)
    closing = float(np.hypot(vx, vy))
    point = contact_point(a, b)
    sides = contact_sides(a, b)
    return Impact(
        contact_time, closing, float(a.speed), float(b.speed), closing * mass_b / (mass_a + mass_b),
        float(wrap(np.asarray(b.heading - a.heading))), in_frame(a, point), in_frame(b, point), *sides,
    )  # fmt: skip
