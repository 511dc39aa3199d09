"""What a driver asks of the engine by attributes of its class, beside what every driver gets."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

from sumo_adv.drivers.bicycle import DEFAULT, Bicycle
from sumo_adv.errors import UsageError

STEEPEST = math.pi / 2  # rad: at this steering angle the bicycle would turn on the spot


@dataclass(frozen=True, slots=True)
class Wishes:
    """needs_road: SUMO's advice, ``Road.advised``. visible_only: ``others`` has only the vehicles in line of sight.
    sees_buildings: buildings block the view. bicycle: the car that ``Steer`` moves."""

    needs_road: bool = False
    visible_only: bool = False
    sees_buildings: bool = False
    bicycle: Bicycle = DEFAULT


def wishes_of(controller: Any) -> Wishes:
    """A controller's ``wishes``, by default none."""
    wishes = getattr(controller, "wishes", None)
    return wishes if isinstance(wishes, Wishes) else Wishes()


def read_wishes(driver: Any, spec: str) -> Wishes:
    """The wishes of a user's driver, by attributes of the names of ``Wishes`` and ``Bicycle``.

    Raises UsageError: a number of the bicycle that is not finite or not above zero, or a steering angle of 90 degrees.
    """
    numbers: dict[str, float] = {}
    for field in fields(Bicycle):
        value = getattr(driver, field.name, None)
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < math.inf:
            raise UsageError(f"The ego {spec!r} has {field.name} = {value!r}; it must be a finite number above zero.")
        numbers[field.name] = float(value)
    if numbers.get("max_steering", 0.0) >= STEEPEST:
        raise UsageError(
            f"The ego {spec!r} has max_steering = {numbers['max_steering']:g} rad; it must be below pi / 2."
        )
    flags = {name: bool(getattr(driver, name, False)) for name in ("needs_road", "visible_only", "sees_buildings")}
    return Wishes(**flags, bicycle=Bicycle(**numbers))
