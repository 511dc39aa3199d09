"""The contact of two boxes: the sides that meet, rear-end collisions, nuPlan's collision classes, speeds and points.

Contact sides come from the separating axes at the moment of first contact. The boxes touch across the axis along which
they were last apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from sumo_adv.datatypes import Bools, Boxes, Ints, Track
from sumo_adv.geometry import wrap_below_pi
from sumo_adv.metrics.boxes import at_time, axis_separations, corners, first_contact, on_grid, overlaps

STOPPED_SPEED_M_S = 0.05  # nuPlan's threshold for a stopped vehicle
SAME_DIRECTION = np.pi / 4  # rad, heading difference up to which two vehicles or lanes go the same way
OPPOSITE_DIRECTION = 3 * np.pi / 4  # rad, heading difference from which they go opposite ways
BEHIND_ANGLE_RAD = np.deg2rad(150.0)  # nuPlan's angle from the rear axle beyond which an agent is behind
BUMPER_DEPTH_M = 0.02  # ahead of the front edge; both ends are drawn in by this, so that a corner's touch is lateral
REAR_AXLE_SHARE = 0.3  # -, distance of the rear axle behind the box centre, as a share of the length


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


SIDES = tuple(Side)
FRONT, REAR, LEFT, RIGHT = range(4)  # indices into SIDES


def contact_sides(a: Boxes, b: Boxes) -> tuple[Side, Side]:
    """Return the side of a and the side of b that meet, for two boxes at first contact (0-d arrays)."""
    of_a, of_b = _meeting_sides(a, b)
    return SIDES[int(of_a)], SIDES[int(of_b)]


def _meeting_sides(a: Boxes, b: Boxes) -> tuple[Ints, Ints]:
    """Return the sides of a and of b that meet, as indices into ``SIDES``, for boxes at first contact (any shape)."""
    axis = np.argmax(np.stack(np.broadcast_arrays(*axis_separations(a, b))), axis=0)
    of_a, across = axis < 2, axis % 2 == 1
    turned = np.abs(np.cos(b.heading - a.heading)) < np.sqrt(0.5)  # by more than 45 degrees: length and width swap
    return _facing_side(a, b, across ^ (~of_a & turned)), _facing_side(b, a, across ^ (of_a & turned))


def _facing_side(own: Boxes, other: Boxes, across: Bools) -> Ints:
    """Return the side of ``own`` that faces ``other``, as an index into ``SIDES``: left or right if ``across``."""
    c, s = np.cos(own.heading), np.sin(own.heading)
    dx, dy = other.x - own.x, other.y - own.y
    beside, along = np.where(dy * c - dx * s >= 0, LEFT, RIGHT), np.where(dx * c + dy * s >= 0, FRONT, REAR)
    return np.where(across, beside, along)


def contact_point(a: Boxes, b: Boxes) -> tuple[float, float]:
    """Return the point at which two boxes at first contact touch, (x, y) [m].

    It is the mean of the corners that lie in the other box or nearest to it.
    """
    points = []
    for own, partner in ((a, b), (b, a)):
        length, width = float(partner.length), float(partner.width)
        for x, y in corners(own).tolist():
            px, py = in_frame(partner, (x, y))
            outside = np.hypot(max(abs(px) - length / 2, 0.0), max(abs(py) - width / 2, 0.0))
            points.append((float(outside), x, y))
    least = min(p[0] for p in points)
    touching = [p for p in points if p[0] <= least + 0.02]
    return float(np.mean([p[1] for p in touching])), float(np.mean([p[2] for p in touching]))


def in_frame(b: Boxes, point: tuple[float, float]) -> tuple[float, float]:
    """Transform a point into a box's own frame.

    Args:
        b: The box.
        point: The point (x, y) [m].

    Returns:
        The point (forward, left) of the box's centre [m].
    """
    c, s = float(np.cos(b.heading)), float(np.sin(b.heading))
    dx, dy = point[0] - float(b.x), point[1] - float(b.y)
    return dx * c + dy * s, dy * c - dx * s


def rear_end(ego: Boxes, adversary: Boxes) -> Bools:
    """Return whether the adversary runs into the ego's back, for boxes at first contact (any shape).

    Both head the same way (within 45 degrees), the ego's rear meets the adversary's front, and the adversary is faster
    along the ego's heading.
    """
    of_ego, of_adversary = _meeting_sides(ego, adversary)
    turn = np.asarray(adversary.heading - ego.heading)
    same_way = np.abs(wrap_below_pi(turn)) <= SAME_DIRECTION
    faster = adversary.speed * np.cos(turn) > ego.speed
    return np.asarray(same_way & (of_ego == REAR) & (of_adversary == FRONT) & faster)


def collision_class(ego: Track, adversary: Track, contact_time: float) -> CollisionClass:
    """Return nuPlan's class of a collision.

    The classes are tried in nuPlan's order: stopped ego, stopped track, rear, front bumper; the rest is lateral. nuPlan
    looks at the first overlapping sample (0.1 s), in which a box that ran into the ego's flank may already overlap the
    front bumper. This function looks at the exact first contact.

    Args:
        ego: The ego's track.
        adversary: The adversary's track.
        contact_time: When they first touch [s].
    """
    a, b = at_time(ego, contact_time), at_time(adversary, contact_time)
    if abs(a.speed) <= STOPPED_SPEED_M_S:
        return CollisionClass.STOPPED_EGO
    if abs(b.speed) <= STOPPED_SPEED_M_S:
        return CollisionClass.STOPPED_TRACK
    axle_x = a.x - REAR_AXLE_SHARE * a.length * np.cos(a.heading)
    axle_y = a.y - REAR_AXLE_SHARE * a.length * np.sin(a.heading)
    bearing = np.arctan2(b.y - axle_y, b.x - axle_x) - a.heading
    if abs(float(wrap_below_pi(np.asarray(bearing)))) > BEHIND_ANGLE_RAD:
        return CollisionClass.ACTIVE_REAR
    front = a.length / 2 * np.cos(a.heading), a.length / 2 * np.sin(a.heading)
    depth = 2 * BUMPER_DEPTH_M
    bumper = replace(a, x=a.x + front[0], y=a.y + front[1], length=depth, width=a.width - depth)
    return CollisionClass.ACTIVE_FRONT if overlaps(bumper, b) else CollisionClass.ACTIVE_LATERAL


@dataclass(frozen=True, slots=True)
class Impact:
    """Where the ego and the adversary meet, and how fast.

    Attributes:
        speed: Relative speed [m/s].
        ego_speed: The ego's speed [m/s].
        adversary_speed: The adversary's speed [m/s].
        angle: The adversary's heading in the ego's frame [rad].
        ego_point: The contact point in the ego's frame (forward, left) [m].
        adversary_point: The contact point in the adversary's frame (forward, left) [m].
        adversary_side: The side of the adversary that meets the ego.
    """

    speed: float
    ego_speed: float
    adversary_speed: float
    angle: float
    ego_point: tuple[float, float]
    adversary_point: tuple[float, float]
    adversary_side: Side


def impact(ego: Track, adversary: Track, contact_time: float) -> Impact:
    """Return how the two vehicles meet; ``metrics/severity.py`` says how hard.

    Args:
        ego: The ego's track.
        adversary: The adversary's track.
        contact_time: When they first touch [s].
    """
    a, b = at_time(ego, contact_time), at_time(adversary, contact_time)
    vx = float(b.speed * np.cos(b.heading) - a.speed * np.cos(a.heading))
    vy = float(b.speed * np.sin(b.heading) - a.speed * np.sin(a.heading))
    point = contact_point(a, b)
    angle = float(wrap_below_pi(np.asarray(b.heading - a.heading)))
    return Impact(
        float(np.hypot(vx, vy)), float(a.speed), float(b.speed), angle, in_frame(a, point), in_frame(b, point),
        contact_sides(a, b)[1],
    )  # fmt: skip


def first_other_contact(ego: Track, others: Sequence[Track], start: float) -> tuple[str, float] | None:
    """Return the first vehicle or object that the ego touches.

    Boxes that already overlap at ``start`` are errors of a log and are left out. A vehicle that runs into the ego's
    back is left out, too.

    Args:
        ego: The ego's track.
        others: Other tracks, on the same regular grid.
        start: The time from which contacts count [s].

    Returns:
        The id and the time of the contact [s]; None if there is none.
    """
    driven = ego.between(start, np.inf)
    near = [t for t in others if len(t.between(start, np.inf).time) > 1]
    if len(driven.time) < 2 or not near:
        return None
    me, them = on_grid([driven], driven.time), on_grid(near, driven.time)
    times = first_contact(me, them, driven.time)
    for k in np.argsort(times):
        when, vehicle = float(times[k]), near[int(k)]
        if not np.isfinite(when):
            return None
        if when > driven.time[0] and not rear_end(at_time(driven, when), at_time(vehicle, when)):
            return vehicle.id, when
    return None
