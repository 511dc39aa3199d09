"""Classify road users by the size of their box (vehicle, cyclist, pedestrian), and define what each kind can do.

Recordings, logs and users' tracks hold sizes and no class, so the size decides everywhere. SUMO's pedestrians are at
most 0.6 m wide, its bicycles 1.6 m by 0.65 m, its scooters and wheelchairs 1.2 m long, its mopeds 2.1 m by 0.78 m, its
motorcycles 2.2 m by 0.9 m. A cyclist in a log has about 1.8 m by 0.8 m.

=========== ========= ============ =====================================================================
kind        fastest   start, stop  source
=========== ========= ============ =====================================================================
pedestrian  4.0 m/s   3, 5 m/s2    walking at about 1.4 m/s (Bohannon 1997, comfortable gait speed of
                                   adults); Euro NCAP's running adult has 2.2 m/s; a run to beat a car is
                                   assumed to reach 4 m/s; a walk begins and ends within half a second
cyclist     8.0 m/s   1.5, 4 m/s2  Euro NCAP's cyclists ride at 4.2 to 6.9 m/s; AASHTO, Guide for the
                                   Development of Bicycle Facilities: starts with up to 1.5 m/s2, brakes
                                   with about 4.9 m/s2 on a dry road, 2.4 to 3 m/s2 on a wet one
=========== ========= ============ =====================================================================

A pedestrian turns on the spot, so its curvature has no practical limit. A cyclist leans at most about 20 degrees (3.5
m/s2 sideways) and turns with a radius of 2 m or more.

Vehicles differ by build. The settings define the limits of a car. The limits of a truck or bus are at most these:

=========== ============ ======== ========= ================================================================
build       start, stop  sideways curvature source
=========== ============ ======== ========= ================================================================
motorcycle  6, 8 m/s2    5 m/s2   0.4 1/m   start: SUMO's vClass motorcycle; stop: riders with ABS reached
                                            7.8 m/s2 on average (Vavryn and Winkelbauer 2004); a lean of 27
                                            degrees; a turning radius of 2.5 m
truck, bus  2, 7 m/s2    3.5 m/s2 0.12 1/m  start, stop: SUMO's vClass coach (``emergencyDecel``); sideways:
                                            loaded trucks roll over from 0.35 g on (Winkler and Ervin 1999);
                                            a turning circle of 12.5 m at its outer side (97/27/EC)
=========== ============ ======== ========= ================================================================
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from enum import StrEnum
from typing import Any, Protocol

import numpy as np

from sumo_adv.datatypes import Limits


class RoadUser(StrEnum):
    """What a road user is; a vehicle protects its driver, the others are unprotected."""

    VEHICLE = "vehicle"
    CYCLIST = "cyclist"
    PEDESTRIAN = "pedestrian"


MAX_PEDESTRIAN_SIZE_M = 1.2  # largest length and width
MIN_BICYCLE_LENGTH_M = 1.2  # SUMO's scooter; a box at least as long and no wider than a bicycle is a cyclist
MAX_BICYCLE_LENGTH_M, MAX_BICYCLE_WIDTH_M = 2.0, 0.85
MAX_MOTORCYCLE_LENGTH_M, MAX_MOTORCYCLE_WIDTH_M = 2.8, 1.1  # mopeds included
MIN_HEAVY_LENGTH_M = 7.0  # SUMO's trucks have 7.1 m, its delivery vans and ambulances 6.5 m
UNPROTECTED_LIMITS: Mapping[RoadUser, Limits] = {
    RoadUser.PEDESTRIAN: Limits(braking=5.0, acceleration=3.0, lateral=4.0, curvature=50.0, jerk=20.0),
    RoadUser.CYCLIST: Limits(braking=4.0, acceleration=1.5, lateral=3.5, curvature=0.5, jerk=12.0),
}
"""Motion limits of unprotected road users."""
MOTORCYCLE_LIMITS = Limits(braking=8.0, acceleration=6.0, lateral=5.0, curvature=0.4, jerk=12.0)
HEAVY_LIMITS = Limits(braking=7.0, acceleration=2.0, lateral=3.5, curvature=0.12, jerk=12.0)
"""Motion limits of a truck or bus. Lower limits of the settings take precedence."""
UNPROTECTED_SPEEDS_M_S: Mapping[RoadUser, float] = {RoadUser.PEDESTRIAN: 4.0, RoadUser.CYCLIST: 8.0}
"""Highest speeds of unprotected road users [m/s]."""


class Sized(Protocol):
    """Something with the size of a box [m]."""

    @property
    def length(self) -> float: ...

    @property
    def width(self) -> float: ...


def road_user(box: Sized) -> RoadUser:
    """Return the kind of the road user with this box."""
    rides = box.length >= MIN_BICYCLE_LENGTH_M and box.width <= MAX_BICYCLE_WIDTH_M
    if max(box.length, box.width) <= MAX_PEDESTRIAN_SIZE_M and not rides:
        return RoadUser.PEDESTRIAN
    return RoadUser.CYCLIST if unprotected(box.length, box.width) else RoadUser.VEHICLE


def unprotected(length: Any, width: Any) -> Any:
    """Return whether boxes belong to pedestrians or cyclists.

    Args:
        length: Lengths [m]; a number or an array.
        width: Widths [m], of the same shape.
    """
    small = np.maximum(length, width) <= MAX_PEDESTRIAN_SIZE_M
    return small | ((np.asarray(length) <= MAX_BICYCLE_LENGTH_M) & (np.asarray(width) <= MAX_BICYCLE_WIDTH_M))


def is_unprotected(box: Sized) -> bool:
    """Return whether the box belongs to a pedestrian or a cyclist."""
    return road_user(box) is not RoadUser.VEHICLE


def is_motorcycle(box: Sized) -> bool:
    """Return whether the box belongs to a motorcycle or a moped."""
    return not is_unprotected(box) and box.length <= MAX_MOTORCYCLE_LENGTH_M and box.width <= MAX_MOTORCYCLE_WIDTH_M


def limits_of(box: Sized, car: Limits) -> Limits:
    """Return the limits of the motion of the road user with this box.

    Args:
        box: The box.
        car: The limits of a car.
    """
    user = road_user(box)
    if user is not RoadUser.VEHICLE:
        return UNPROTECTED_LIMITS[user]
    if is_motorcycle(box):
        return MOTORCYCLE_LIMITS
    if box.length < MIN_HEAVY_LENGTH_M:
        return car
    return Limits(**{f.name: min(getattr(car, f.name), getattr(HEAVY_LIMITS, f.name)) for f in fields(Limits)})
