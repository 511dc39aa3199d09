"""SUMO's states of vehicles and persons, and its poses as ours.

SUMO's pose is the front bumper and degrees clockwise from north. Everywhere else a pose is the centre of the box and a
heading in rad counter-clockwise from +x. Snapshots and FCD hold SUMO's poses, as ``RawState`` or as columns, because
most of them are never looked at. Only the functions here convert one into the other. ``consistency.py`` compares
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
"""Before the id of a ``<person>``: SUMO lets a person and a vehicle have one id."""


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
    """Return x, y [m] of the centre of a vehicle's box and its heading [rad]; ``length``: of the vehicle [m]."""
    heading, back = heading_of(raw[2]), length / 2
    return raw[0] - back * math.cos(heading), raw[1] - back * math.sin(heading), heading


def front_of(x: float, y: float, heading: float, length: float) -> tuple[float, float]:
    """Return x, y [m] of the front bumper of a box."""
    ahead = length / 2
    return x + ahead * math.cos(heading), y + ahead * math.sin(heading)


def raw_of(x: float, y: float, heading: float, speed: float, length: float) -> RawState:
    """Return a box that SUMO does not know as SUMO's state: off every lane."""
    return (*front_of(x, y, heading, length), angle_deg_of(heading), speed, "")


def correct_speeds(raw: dict[str, RawState], given: Mapping[str, float]) -> None:
    """Give each vehicle that was moved in the last step the speed that it was given.

    Measured with SUMO 1.28: a vehicle that comes back on a lane from beside it has its speed a step late, and one that
    enters a junction's internal lane can have speed 0 for one step. Its position is exact in both cases.
    """
    for vehicle in given.keys() & raw.keys():
        raw[vehicle] = (*raw[vehicle][:3], given[vehicle], raw[vehicle][4])


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Everything SUMO said after one step. ``raw``: vehicle id -> bumper pose, speed, lane; also ``person:ID`` of each
    person on foot: the middle of its front, its speed, and no lane.

    lights: by id the states of the traffic lights near the ego, where they are recorded. heights: by id those of the
    road under all vehicles and persons [m], where roads have heights.
    """

    time: float
    raw: Mapping[str, RawState]
    lights: Mapping[str, str] = field(default_factory=dict)
    heights: Mapping[str, float] = field(default_factory=dict)


class Fleet:
    """What SUMO says of its vehicles and persons once each.

    Attributes:
        sizes: Length and width [m].
        classes: Their vClasses.
        arrivals: Attributes of where vehicles leave.
        persons: Those of them that are SUMO's persons, and no vehicles.
    """

    def __init__(self, api: Any) -> None:
        """``api``: libsumo, or a connection with the same functions."""
        self._api = api
        self.sizes: dict[str, tuple[float, float]] = {}
        self.classes: dict[str, str] = {}
        self.arrivals: dict[str, Mapping[str, str]] = {}
        self.persons: set[str] = set()

    def measure(self, vehicle: str) -> None:
        """Ask for a vehicle's size."""
        self.sizes[vehicle] = (self._api.vehicle.getLength(vehicle), self._api.vehicle.getWidth(vehicle))

    def add_person(self, person: str) -> None:
        """Ask for the size of a person; ``person``: SUMO's id of it."""
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
        """Drop all but these: what a simulation that goes on for hours needs."""
        self.sizes = {name: size for name, size in self.sizes.items() if name in keep}
        self.classes = {name: kind for name, kind in self.classes.items() if name in keep}
        self.arrivals = {name: known for name, known in self.arrivals.items() if name in keep}
        self.persons.intersection_update(keep)
