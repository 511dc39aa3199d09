"""The vTypes of the ego: each vType of the user's, with the driver under test as its driver.

The ego stays the same vehicle. It keeps its own type's class, size, capacities, desired speed, imperfection, emission
class and all other attributes; only the car-following model is the driver's. An attribute of the driver overrides the
type's if it was asked for. Otherwise, the type's value overrides the driver's. If neither gives a value, SUMO's default
for the class holds.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import quoteattr

from sumo_adv.simulation.permissions import CAR
from sumo_adv.simulation.scan import parse_xml

EGO_TYPE = "sumo_adv_ego"
"""The vType of an ego whose own type no file defines. For any other ego, the name is followed by ``:`` and the name of
its own type.
"""
BUILT_IN_TYPES = {
    "DEFAULT_VEHTYPE": CAR, "DEFAULT_TAXITYPE": "taxi", "DEFAULT_BIKETYPE": "bicycle", "DEFAULT_RAILTYPE": "rail",
}  # fmt: skip
"""The types that SUMO defines itself, and their classes."""

FOLLOWING = "carFollowing-"
"""The beginning of the names of elements in a ``vType`` whose attributes (of car following) override its own."""


@dataclass(slots=True)
class VehicleType:
    """A ``vType`` of a file.

    Attributes:
        attributes: Its attributes, without the id, and those of its elements for car following.
        parameters: The values of its ``param`` elements by key.
    """

    attributes: dict[str, str]
    parameters: dict[str, str] = field(default_factory=dict)


def vehicle_types(files: Iterable[Path]) -> dict[str, VehicleType]:
    """Return the vTypes of route and additional files, and SUMO's built-in ones.

    Args:
        files: The files.

    Returns:
        The types by id.

    Raises:
        UsageError: A file is damaged.
    """
    types = {name: VehicleType({"vClass": vclass}) for name, vclass in BUILT_IN_TYPES.items()}
    for file in files:
        _read(file, types)
    return types


def _read(file: Path, types: dict[str, VehicleType]) -> None:
    """Add the vTypes of a file."""
    within: list[VehicleType] = []  # the vType whose element is open

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag == "vType":
            made = VehicleType({k: v for k, v in attributes.items() if k != "id"})
            types[attributes.get("id", "")] = made
            within.append(made)
        elif tag.startswith(FOLLOWING) and within:
            within[-1].attributes.update(attributes)
        elif tag == "param" and within:
            within[-1].parameters[attributes.get("key", "")] = attributes.get("value", "")

    def end(tag: str) -> None:
        if tag == "vType":
            within.pop()

    parse_xml(file, start, end)


def ego_types_xml(driver: Mapping[str, str], defaults: frozenset[str], types: Mapping[str, VehicleType]) -> str:
    """Return ``vType`` elements for an ego of any of these types.

    Args:
        driver: vType attributes of the driver under test.
        defaults: The names of those attributes that were not asked for.
        types: The types that the ego may have, by id.

    Returns:
        The XML elements.
    """
    elements = [_element(EGO_TYPE, {"vClass": CAR, "speedDev": "0", **driver}, {})]
    behind = {name: value for name, value in driver.items() if name in defaults and name in NOISE}
    given = {name: value for name, value in driver.items() if name not in defaults}
    if "speedFactor" in given:  # the value is exact, not the mean of a distribution
        given = {"speedDev": "0", **given}
    for name, own in types.items():
        elements.append(_element(f"{EGO_TYPE}:{name}", {**behind, **own.attributes, **given}, own.parameters))
    return "\n  ".join(elements)


NOISE = frozenset({"sigma", "sigmaleader", "sigmagap", "sigmaerror"})
"""Imperfections that a driver under test has only if its own type sets them, because SUMO's defaults for them are not
zero.
"""


def _element(name: str, attributes: Mapping[str, str], parameters: Mapping[str, str]) -> str:
    """Return a ``vType`` element."""
    text = " ".join(f"{k}={quoteattr(v)}" for k, v in attributes.items())
    inner = "".join(f"<param key={quoteattr(k)} value={quoteattr(v)}/>" for k, v in parameters.items())
    return f"<vType id={quoteattr(name)} {text}>{inner}</vType>"
