"""The vTypes of the ego: each type of the user's with the driver under test instead of its own.

The ego stays the vehicle that it is.  Of its own type it keeps class, size, capacities, desired speed, imperfection,
emission class and all else; the car-following model is the driver's.  An attribute of the driver goes before the
type's where somebody asked for it, else behind it; where neither says a value, SUMO's default for the class holds.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import quoteattr

from sumo_adv.simulation.permissions import CAR
from sumo_adv.simulation.scan import parse_xml

EGO_TYPE = "sumo_adv_ego"
"""The type of an ego whose own type no file defines; before a ``:`` and the own type's name, the type of any other."""
BUILT_IN_TYPES = {
    "DEFAULT_VEHTYPE": CAR, "DEFAULT_TAXITYPE": "taxi", "DEFAULT_BIKETYPE": "bicycle", "DEFAULT_RAILTYPE": "rail",
}  # fmt: skip
"""Types of SUMO that no file defines, and their classes."""


@dataclass(slots=True)
class VehicleType:
    """A ``vType`` of a file: its attributes, and the values of its ``param`` elements by key."""

    attributes: dict[str, str]
    parameters: dict[str, str] = field(default_factory=dict)


def vehicle_types(files: Iterable[Path]) -> dict[str, VehicleType]:
    """The vTypes of route and additional files by id, with those that SUMO has by itself.

    Raises UsageError: a file is damaged.
    """
    types = {name: VehicleType({"vClass": vclass}) for name, vclass in BUILT_IN_TYPES.items()}
    for file in files:
        _read(file, types)
    return types


def _read(file: Path, types: dict[str, VehicleType]) -> None:
    """Add the vTypes of a file."""
    within: list[VehicleType] = []  # the vType that has begun

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag == "vType":
            made = VehicleType({k: v for k, v in attributes.items() if k != "id"})
            types[attributes.get("id", "")] = made
            within.append(made)
        elif tag == "param" and within:
            within[-1].parameters[attributes.get("key", "")] = attributes.get("value", "")

    def end(tag: str) -> None:
        if tag == "vType":
            within.pop()

    parse_xml(file, start, end)


def ego_types_xml(driver: Mapping[str, str], defaults: frozenset[str], types: Mapping[str, VehicleType]) -> str:
    """The ``vType`` elements of an ego of any of these types.

    Args:
        driver: vType attributes of the driver under test.
        defaults: those of them that nobody asked for.
        types: the types that the ego may have, by id.
    """
    elements = [_element(EGO_TYPE, {"vClass": CAR, "speedDev": "0", **driver}, {})]
    behind = {name: value for name, value in driver.items() if name in defaults and name in NOISE}
    given = {name: value for name, value in driver.items() if name not in defaults}
    if "speedFactor" in given:  # it is meant as it is, not as the middle of a spread
        given = {"speedDev": "0", **given}
    for name, own in types.items():
        elements.append(_element(f"{EGO_TYPE}:{name}", {**behind, **own.attributes, **given}, own.parameters))
    return "\n  ".join(elements)


NOISE = frozenset({"sigma", "sigmaleader", "sigmagap", "sigmaerror"})
"""Imperfections that a driver under test has only where its own type says so: SUMO's defaults for them are not zero."""


def _element(name: str, attributes: Mapping[str, str], parameters: Mapping[str, str]) -> str:
    text = " ".join(f"{k}={quoteattr(v)}" for k, v in attributes.items())
    inner = "".join(f"<param key={quoteattr(k)} value={quoteattr(v)}/>" for k, v in parameters.items())
    return f"<vType id={quoteattr(name)} {text}>{inner}</vType>"
