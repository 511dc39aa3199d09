"""Vehicles and obstacles as OpenSCENARIO entities: sizes, boxes and reference points.

An OpenSCENARIO vehicle stands where the middle of its rear axle is, on the ground.  SUMO's vehicle types have no axles,
so a convention stands in, the same for every vehicle: wheelbase 0.6 of the length, equal overhangs, hence the box's
centre 0.3 of the length ahead of the rear axle.  The reference point of other objects is their box's centre.
"""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from sumo_adv.datatypes import Floats, Role, Track
from sumo_adv.road_users import RoadUser, road_user

CENTRE = 0.3  # of the length, from the rear axle to the box's centre
WHEELBASE, TRACK_WIDTH = 0.6, 0.85  # of length and width
WHEEL = 0.65  # m
LARGEST_STEER = 0.6  # rad
HEIGHT = {"car": 1.5, "truck": 3.2, "bicycle": 1.7, "pedestrian": 1.75, "obstacle": 1.5}  # m: SUMO has none either
MASS = {"car": 1500, "truck": 12000, "bicycle": 90, "pedestrian": 75, "obstacle": 500}  # kg
SLOWEST = 1.0  # m/s, below which no steering angle follows from the motion
SHORTEST_TRUCK, NARROWEST_CAR = 6.5, 1.0  # m
FASTEST, ACCELERATION, BRAKING = 70.0, 4.0, 9.0  # m/s, m/s2: wide enough for every trajectory


def kind(track: Track) -> str:
    """car, truck, bicycle, pedestrian or obstacle, by role and size."""
    if road_user(track) is RoadUser.PEDESTRIAN:
        return "pedestrian"
    if track.role is Role.OBSTACLE:
        return "obstacle"
    if track.width < NARROWEST_CAR:
        return "bicycle"
    return "truck" if track.length >= SHORTEST_TRUCK else "car"


def centre_ahead(track: Track) -> float:
    """How far the box's centre is ahead of the reference point [m]."""
    return 0.0 if kind(track) in ("pedestrian", "obstacle") else CENTRE * track.length


def reference_points(track: Track) -> tuple[Floats, Floats, Floats]:
    """x, y [m] of the reference point and heading [rad], unwrapped, at the track's times."""
    ahead = centre_ahead(track)
    x, y = track.x - ahead * np.cos(track.heading), track.y - ahead * np.sin(track.heading)
    return x, y, np.unwrap(track.heading)


def entity_names(tracks: Sequence[Track]) -> dict[str, str]:
    """A name that OpenSCENARIO takes for each id: no control character, no ``$`` (a parameter), each its own."""
    names: dict[str, str] = {}
    for track in tracks:
        name = "".join(c if c.isprintable() and c not in "$:" else "_" for c in track.id).strip() or "_"
        while name in names.values():
            name += "_"
        names[track.id] = name
    return names


def add_entities(parent: Element, tracks: Sequence[Track], names: dict[str, str]) -> None:
    """``Entities`` with a ``ScenarioObject`` a track."""
    entities = SubElement(parent, "Entities")
    for track in tracks:
        scenario_object = SubElement(entities, "ScenarioObject", name=names[track.id])
        category = kind(track)
        if category == "pedestrian":
            thing = SubElement(scenario_object, "Pedestrian", pedestrianCategory="pedestrian")
        elif category == "obstacle":
            thing = SubElement(scenario_object, "MiscObject", miscObjectCategory="obstacle")
        else:
            thing = SubElement(scenario_object, "Vehicle", vehicleCategory=category)
        thing.set("name", f"{category}_{track.length:.2f}x{track.width:.2f}")
        thing.set("mass", str(MASS[category]))
        _add_box(thing, track, category)
        if thing.tag == "Vehicle":
            _add_vehicle_parts(thing, track)
        properties = SubElement(thing, "Properties")
        SubElement(properties, "Property", name="sumo_adv_id", value=printable(track.id))
        SubElement(properties, "Property", name="sumo_adv_role", value=str(track.role))


def printable(text: str) -> str:
    """Text that XML 1.0 can hold and that OpenSCENARIO does not take for a parameter."""
    return "".join(c if c.isprintable() and c != "$" else "_" for c in text)


def _add_box(thing: Element, track: Track, category: str) -> None:
    box = SubElement(thing, "BoundingBox")
    height = HEIGHT[category]
    SubElement(box, "Center", x=metres(centre_ahead(track)), y="0.0", z=metres(height / 2))
    SubElement(
        box, "Dimensions", length=metres(track.length), width=metres(track.width), height=metres(height)
    )  # fmt: skip


def _add_vehicle_parts(thing: Element, track: Track) -> None:
    SubElement(
        thing, "Performance", maxSpeed=f"{FASTEST}", maxAcceleration=f"{ACCELERATION}", maxDeceleration=f"{BRAKING}"
    )
    axles = SubElement(thing, "Axles")
    for name, at, steer in (("FrontAxle", WHEELBASE * track.length, LARGEST_STEER), ("RearAxle", 0.0, 0.0)):
        SubElement(
            axles, name, maxSteering=f"{steer}", wheelDiameter=f"{WHEEL}", trackWidth=metres(TRACK_WIDTH * track.width),
            positionX=metres(at), positionZ=metres(WHEEL / 2),
        )  # fmt: skip


def metres(value: float) -> str:
    """0.1 mm."""
    return f"{value + 0.0:.4f}"


def steering(track: Track) -> Floats:
    """Steering angles [rad] of a single-track model from heading over distance, 0 where it hardly moves."""
    if len(track.time) < 2:
        return np.zeros(len(track.time))
    turn = np.gradient(np.unwrap(track.heading), track.time)
    curvature = np.divide(turn, track.speed, out=np.zeros_like(turn), where=track.speed > SLOWEST)
    return np.clip(np.arctan(WHEELBASE * track.length * curvature), -LARGEST_STEER, LARGEST_STEER)
