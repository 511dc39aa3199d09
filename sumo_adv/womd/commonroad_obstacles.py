"""Read the obstacles of a CommonRoad scenario as tracks, with their boxes where commonroad-io puts them.

commonroad-io rotates a shape about its own centre, and then moves it to the obstacle's place. The centre that a shape
names is therefore an offset along the map's axes, whatever the obstacle's heading. Each of several shapes becomes an
object.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from xml.etree.ElementTree import Element

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.geometry import Pose
from sumo_adv.womd.record import TRACK_KINDS, VEHICLE, ObjectTrack

TRACK_KIND_OF_TYPE = {
    "pedestrian": TRACK_KINDS.index("pedestrian"),
    "bicycle": TRACK_KINDS.index("cyclist"),
    **dict.fromkeys(("constructionZone", "building", "pillar", "median_strip", "train"), TRACK_KINDS.index("other")),
}
"""Kinds of tracks by CommonRoad's obstacle types; all other types are vehicles."""
BOUNDARY = "roadBoundary"  # a type that is not an object; the lanelets say where the road ends
OBSTACLE_ROLES = {"dynamicObstacle": "dynamic", "staticObstacle": "static"}


@dataclass(frozen=True, slots=True)
class ShapeBox:
    """The box of a shape.

    Attributes:
        length: Its length [m].
        width: Its width [m].
        turn: The angle of its length against the obstacle's heading [rad], at most a quarter of pi.
        offset: The offset of its centre along the map's axes, ``(2,)`` [m].
        lever: The part of the offset that turns with the heading, ``(2,)`` [m].
    """

    length: float
    width: float
    turn: float
    offset: Floats
    lever: Floats


def obstacles(root: Element) -> Iterator[tuple[Element, bool]]:
    """Yield each obstacle, and whether it stands still.

    An ``<obstacle>`` with a role belongs to format 2018b.

    Args:
        root: The scenario.

    Yields:
        The obstacle, and True if it is static.

    Raises:
        ValueError: An obstacle has an unknown role.
    """
    for element in root:
        role = OBSTACLE_ROLES.get(element.tag, "")
        if element.tag == "obstacle":
            role = element.findtext("role", "").strip()
            if role not in OBSTACLE_ROLES.values():
                raise ValueError(f"obstacle {element.get('id', '')} has the role '{role}'")
        if role:
            yield element, role == "static"


def obstacle_type(obstacle: Element) -> str:
    """Return CommonRoad's type of an obstacle."""
    return obstacle.findtext("type", "").strip()


def obstacle_tracks(
    obstacle: Element, poses: Mapping[int, Pose], numbers: Iterator[int], count: int
) -> Iterator[ObjectTrack]:
    """Yield a track for each shape of an obstacle.

    Args:
        obstacle: The obstacle.
        poses: Its poses by time step.
        numbers: Ids for the shapes after the first one, which has the obstacle's id.
        count: The number of time steps.

    Yields:
        The tracks.

    Raises:
        ValueError: The obstacle has no shape, or an unknown one.
    """
    kind = TRACK_KIND_OF_TYPE.get(obstacle_type(obstacle), VEHICLE)
    shapes = list(child(obstacle, "shape"))
    if not shapes:
        raise ValueError(f"obstacle {obstacle.get('id', '')} has an empty shape")
    for k, shape in enumerate(shapes):
        yield make_track(next(numbers) if k else int(obstacle.attrib["id"]), kind, _box(shape), poses, count)


def make_track(number: int, kind: int, box: ShapeBox, poses: Mapping[int, Pose], count: int) -> ObjectTrack:
    """Return the track of a box, valid at the steps that have a pose.

    Args:
        number: The id of the track.
        kind: Its kind, an index of ``TRACK_KINDS``.
        box: The box.
        poses: The obstacle's poses by time step.
        count: The number of time steps.

    Returns:
        The track.
    """
    values, valid = np.zeros((count, 5)), np.zeros(count, bool)
    for step, pose in poses.items():
        c, s = math.cos(pose.heading), math.sin(pose.heading)
        x = pose.x + box.offset[0] + c * box.lever[0] - s * box.lever[1]
        y = pose.y + box.offset[1] + s * box.lever[0] + c * box.lever[1]
        values[step], valid[step] = (x, y, pose.heading + box.turn, pose.speed * c, pose.speed * s), True
    x, y, heading, vx, vy = values.T
    length, width = np.full(count, box.length), np.full(count, box.width)
    return ObjectTrack(number, kind, valid, x, y, length, width, heading, vx, vy)


def plain_box(length: float, width: float) -> ShapeBox:
    """Return a box about its own centre, along its heading."""
    return ShapeBox(length, width, 0.0, np.zeros(2), np.zeros(2))


def _box(shape: Element) -> ShapeBox:
    """Return the box of a shape."""
    centre = shape.find("center")
    offset = np.zeros(2) if centre is None else point(centre)
    if shape.tag == "rectangle":
        length, width = (float(child(shape, name).text or "nan") for name in ("length", "width"))
        return _turned(length, width, float(shape.findtext("orientation", "0")), offset, np.zeros(2))
    if shape.tag == "circle":
        across = 2 * float(child(shape, "radius").text or "nan")
        return ShapeBox(across, across, 0.0, offset, np.zeros(2))
    if shape.tag == "polygon":
        return _box_of_polygon(points(shape))
    raise ValueError(f"an obstacle has the shape {shape.tag}")


def _box_of_polygon(corners: Floats) -> ShapeBox:
    """Return the smallest rectangle around a polygon, which turns about its centroid."""
    from shapely import Polygon

    area = Polygon(corners)
    centroid = np.array(area.centroid.coords[0])
    around = area.minimum_rotated_rectangle
    if around.geom_type != "Polygon":
        raise ValueError("a polygon has no area")
    corner = np.array(around.exterior.coords[:4])
    along, across = corner[1] - corner[0], corner[3] - corner[0]
    length, width, turn = math.hypot(*along), math.hypot(*across), math.atan2(along[1], along[0])
    return _turned(length, width, turn, centroid, corner.mean(axis=0) - centroid)


def _turned(length: float, width: float, turn: float, offset: Floats, lever: Floats) -> ShapeBox:
    """Return the box with its length along the heading, as far as quarter turns allow."""
    quarters = round(turn / (math.pi / 2))
    sides = (width, length) if quarters % 2 else (length, width)
    return ShapeBox(*sides, turn - quarters * math.pi / 2, offset, lever)


# -- states


def read_poses(obstacle: Element, step: float) -> dict[int, Pose]:
    """Return an obstacle's poses by time step.

    If no state gives a speed, it follows from the distance between two states.

    Args:
        obstacle: The obstacle.
        step: The length of a time step [s].

    Returns:
        The poses.
    """
    every = [child(obstacle, "initialState"), *obstacle.findall("trajectory/state")]
    poses = {time_step(state): read_pose(state) for state in every}
    pairs = list(pairwise(sorted(poses)))
    for before, after in (*pairs, *((b, a) for a, b in pairs)):
        pose, other = poses[before], poses[after]
        if math.isnan(pose.speed):
            speed = math.dist((pose.x, pose.y), (other.x, other.y)) / (abs(after - before) * step)
            poses[before] = Pose(pose.x, pose.y, pose.heading, speed)
    return {k: Pose(p.x, p.y, p.heading, 0.0) if math.isnan(p.speed) else p for k, p in poses.items()}


def time_step(state: Element) -> int:
    """Return the number of a state's time step.

    Raises:
        ValueError: The number is negative.
    """
    step = round(exact_number(state, "time", 0.0))
    if step < 0:
        raise ValueError(f"a state has the time step {step}")
    return step


def read_pose(state: Element) -> Pose:
    """Return the pose of a state.

    If a place or value is given as a range, its middle is taken.

    Returns:
        The pose; its speed is NaN if the state gives none.

    Raises:
        ValueError: The state has no exact position.
    """
    position = child(state, "position")
    exact, region = position.find("point"), position.find("polygon")
    if exact is not None:
        x, y = point(exact)
    elif region is not None:
        x, y = _box_of_polygon(points(region)).offset
    elif (centre := position.find("*/center")) is not None:
        x, y = point(centre)
    else:
        raise ValueError("a state has no exact position")
    return Pose(float(x), float(y), exact_number(state, "orientation"), exact_number(state, "velocity", math.nan))


# -- elements


def child(parent: Element, name: str) -> Element:
    """Return the child element with a name.

    Raises:
        ValueError: There is none.
    """
    found = parent.find(name)
    if found is None:
        raise ValueError(f"{parent.tag} {parent.get('id', '')} has no {name}".replace("  ", " "))
    return found


def exact_number(state: Element, name: str, default: float | None = None) -> float:
    """Return an exact value, or the middle of an interval.

    Args:
        state: The parent element.
        name: The name of the value's element.
        default: The value if the element is absent; None requires the element.

    Returns:
        The value.

    Raises:
        ValueError: The element is absent or holds no number.
    """
    holder = state.find(name)
    if holder is None and default is not None:
        return default
    values = [float(v.text or "nan") for v in child(state, name)]
    if not values or not all(map(math.isfinite, values)):
        raise ValueError(f"a {name} is not a number")
    return sum(values) / len(values)


def point(element: Element) -> Floats:
    """Return x, y of a point [m]."""
    return np.array([float(element.findtext(name, "nan")) for name in ("x", "y")])


def points(parent: Element) -> Floats:
    """Return the points of a line or polygon, ``(n, 2)`` [m]."""
    return np.array([point(each) for each in parent.findall("point")])
