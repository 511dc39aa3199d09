"""SUMO's states of vehicles and persons, and the conversion of its poses to those of this program.

SUMO's pose is the front bumper and degrees clockwise from north. Everywhere else, a pose is the centre of the box and a
heading in rad counter-clockwise from +x. Snapshots and FCD hold SUMO's poses, as ``RawState`` or as columns, because
most of them are never used. Only the functions of this module convert one into the other. ``consistency.py`` compares
SUMO's angles with those of other formats, to find files with wrong headings.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.geometry import wrap

RawState = tuple[float, float, float, float, str]
"""x, y [m] of the front bumper, angle [degrees], speed [m/s], lane id."""
PERSON = "person:"
"""Prefix of a ``<person>``'s id, because SUMO lets a person and a vehicle have the same id."""


def heading_of(angle_deg: float) -> float:
    """Return SUMO's angle as a heading [rad] in (-pi, pi]."""
    return wrap(math.radians(90.0 - angle_deg))


def headings_of(angles_deg: Floats) -> Floats:
    """Return SUMO's angles as headings [rad] in (-pi, pi], of the same shape."""
    return wrap(np.radians(90.0 - angles_deg))


def angle_deg_of(heading: float) -> float:
    """Return a heading [rad] as SUMO's angle in [0, 360)."""
    return (90.0 - math.degrees(heading)) % 360.0


def pose_of(raw: RawState, length: float) -> tuple[float, float, float]:
    """Return the pose of a vehicle's box.

    Args:
        raw: SUMO's state.
        length: The length of the vehicle [m].

    Returns:
        x and y of the centre [m], and the heading [rad].
    """
    heading, back = heading_of(raw[2]), length / 2
    return raw[0] - back * math.cos(heading), raw[1] - back * math.sin(heading), heading


def front_of(x: float, y: float, heading: float, length: float) -> tuple[float, float]:
    """Return x, y [m] of the front bumper of a box."""
    ahead = length / 2
    return x + ahead * math.cos(heading), y + ahead * math.sin(heading)


def raw_of(x: float, y: float, heading: float, speed: float, length: float) -> RawState:
    """Return SUMO's state of a box that SUMO does not know, which is off every lane."""
    return (*front_of(x, y, heading, length), angle_deg_of(heading), speed, "")


def correct_speeds(raw: dict[str, RawState], given: Mapping[str, float]) -> None:
    """Replace the speeds of vehicles that were moved in the last step by those that they were given.

    Measured with SUMO 1.28: a vehicle that returns to a lane from beside it has its speed one step late, and one that
    enters a junction's internal lane can have speed 0 for one step. Its position is exact in both cases.

    Args:
        raw: The states by id, which are changed.
        given: The speeds by id [m/s].
    """
    for vehicle in given.keys() & raw.keys():
        raw[vehicle] = (*raw[vehicle][:3], given[vehicle], raw[vehicle][4])


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Everything SUMO reported after one step.

    Attributes:
        time: The time [s].
        raw: Bumper pose, speed and lane by vehicle id. For ``person:ID`` of a person on foot, the middle of its front,
            its angle, its speed, and no lane.
        lights: The states of the traffic lights near the ego by id, if they are recorded.
        heights: The heights of the road under all vehicles and persons by id [m], if roads have heights.
    """

    time: float
    raw: Mapping[str, RawState]
    lights: Mapping[str, str] = field(default_factory=dict)
    heights: Mapping[str, float] = field(default_factory=dict)


class Fleet:
    """What SUMO says once about each vehicle and person.

    Attributes:
        sizes: Length and width by id [m].
        classes: vClasses by id.
        arrivals: The attributes that say where a vehicle leaves, by id.
        persons: Ids of those that are persons in SUMO rather than vehicles.
    """

    def __init__(self, api: Any) -> None:
        """Start empty.

        Args:
            api: libsumo, or a connection with the same functions.
        """
        self._api = api
        self.sizes: dict[str, tuple[float, float]] = {}
        self.classes: dict[str, str] = {}
        self.arrivals: dict[str, Mapping[str, str]] = {}
        self.persons: set[str] = set()

    def measure(self, vehicle: str) -> None:
        """Ask SUMO for a vehicle's size."""
        self.sizes[vehicle] = (self._api.vehicle.getLength(vehicle), self._api.vehicle.getWidth(vehicle))

    def add_person(self, person: str) -> None:
        """Ask SUMO for the size of a person.

        Args:
            person: SUMO's id of the person.
        """
        name, p = PERSON + person, self._api.person
        self.sizes[name] = (p.getLength(person), p.getWidth(person))
        self.classes[name] = "pedestrian"
        self.persons.add(name)

    def vehicle_class(self, vehicle: str) -> str:
        """Return SUMO's vClass of a vehicle."""
        kind = self.classes.get(vehicle)
        if kind is None:
            kind = self.classes[vehicle] = str(self._api.vehicle.getVehicleClass(vehicle))
        return kind

    def forget(self, keep: Collection[str]) -> None:
        """Drop all but these vehicles and persons, which keeps memory small in a simulation of many hours."""
        self.sizes = {name: size for name, size in self.sizes.items() if name in keep}
        self.classes = {name: kind for name, kind in self.classes.items() if name in keep}
        self.arrivals = {name: known for name, known in self.arrivals.items() if name in keep}
        self.persons.intersection_update(keep)
