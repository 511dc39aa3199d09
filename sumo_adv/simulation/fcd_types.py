"""The sizes of recorded vehicles: SUMO's sizes of its classes, and the vTypes of files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from sumo_adv.errors import UsageError
from sumo_adv.simulation.scan import parse_xml

Size = tuple[float, float]
CAR_SIZE: Size = (5.0, 1.8)
CLASS_SIZES: Mapping[str, Size] = {
    "aircraft": (72.7, 79.8), "bicycle": (1.6, 0.65), "bus": (12.0, 2.5), "coach": (14.0, 2.6),
    "container": (6.096, 2.438), "delivery": (6.5, 2.16), "drone": (0.5, 0.5), "emergency": (6.5, 2.16),
    "moped": (2.1, 0.78), "motorcycle": (2.2, 0.9), "pedestrian": (0.215, 0.478), "rail": (135.0, 2.84),
    "rail_electric": (200.0, 2.95), "rail_fast": (200.0, 2.95), "rail_urban": (109.5, 3.0), "scooter": (1.2, 0.5),
    "ship": (17.0, 4.0), "subway": (109.5, 3.0), "trailer": (16.5, 2.55), "tram": (22.0, 2.4), "truck": (7.1, 2.4),
    "wheelchair": (1.2, 0.72),
}  # fmt: skip
"""Length and width [m] if a vType of the class gives none (SUMO's ``SUMOVTypeParameter::VClassDefaultValues``).
Vehicles of all other classes are 5 by 1.8 m.
"""
DEFAULT_TYPES: Mapping[str, Size] = {
    "DEFAULT_VEHTYPE": CAR_SIZE, "DEFAULT_TAXITYPE": CAR_SIZE, "DEFAULT_BIKETYPE": CLASS_SIZES["bicycle"],
    "DEFAULT_PEDTYPE": CLASS_SIZES["pedestrian"], "DEFAULT_RAILTYPE": CLASS_SIZES["rail"],
    "DEFAULT_CONTAINERTYPE": CLASS_SIZES["container"],
}  # fmt: skip


def read_sizes(files: Sequence[Path]) -> dict[str, Size]:
    """Return length and width by vType [m], including SUMO's built-in types.

    Args:
        files: Files with vTypes.

    Returns:
        The sizes.

    Raises:
        UsageError: A file is damaged, or the size of a vType is invalid.
    """
    sizes = dict(DEFAULT_TYPES)

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag == "vType":
            default = CLASS_SIZES.get(attributes.get("vClass", ""), CAR_SIZE)
            length, width = (float(attributes.get(k, d)) for k, d in zip(("length", "width"), default, strict=True))
            if not (0.0 < length < math.inf and 0.0 < width < math.inf):
                raise ValueError(f"its size is {length:g} m by {width:g} m")
            sizes[attributes["id"]] = length, width

    for file in files:
        try:
            parse_xml(file, start)
        except (KeyError, ValueError) as error:
            raise UsageError(f"{file} has a vType that cannot be used ({error}).") from error
    return sizes


def size_of(kind: str, vehicle: str, sizes: Mapping[str, Size]) -> Size | None:
    """Return the size of a vehicle by its vType.

    If TraCI changes the type of a vehicle, it gives the vehicle a copy called ``type@vehicle``, which has the same
    size.

    Args:
        kind: The vType.
        vehicle: The id of the vehicle.
        sizes: The known sizes (``read_sizes``).

    Returns:
        Length and width [m]; None if the type is unknown.
    """
    return sizes.get(kind) or sizes.get(kind.removesuffix(f"@{vehicle}"))
