"""Just enough of an OpenSCENARIO reader to say where boxes are when; shares no code with the program."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Motion:
    """A box: time of the simulation [s], centre x, y [m], heading [rad], length, width [m]."""

    time: NDArray[np.float64]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    heading: NDArray[np.float64]
    length: float
    width: float


def number(element: Element | None, name: str) -> float:
    """An attribute."""
    assert element is not None
    return float(element.attrib[name])


def properties(root: Element) -> Mapping[str, str]:
    """What the file's header says, without the prefix of the names."""
    return {
        p.attrib["name"].removeprefix("sumo_adv_"): p.attrib["value"] for p in root.iterfind("FileHeader//Property")
    }


def entity(root: Element, name: str) -> Element:
    """The object of that name."""
    return next(o[0] for o in root.iterfind("Entities/ScenarioObject") if o.get("name") == name)


def events(root: Element, name: str) -> list[Element]:
    """The events of the groups in which the entity acts."""
    groups = [g for g in root.iter("ManeuverGroup") if g.find(f"Actors/EntityRef[@entityRef='{name}']") is not None]
    return [event for group in groups for event in group.iter("Event")]


def motion(root: Element, name: str, trajectory: Element, start: float) -> Motion:
    """The motion of a trajectory that begins at ``start`` [s] of the simulation."""
    thing = entity(root, name)
    ahead = number(thing.find("BoundingBox/Center"), "x")
    size = thing.find("BoundingBox/Dimensions")
    rows = []
    for vertex in trajectory.iter("Vertex"):
        at = vertex.find("Position/WorldPosition")
        rows.append([start + number(vertex, "time"), *(number(at, k) for k in ("x", "y", "h"))])
    time, x, y, heading = np.array(rows).T
    return Motion(
        time, x + ahead * np.cos(heading), y + ahead * np.sin(heading), heading, number(size, "length"),
        number(size, "width"),
    )  # fmt: skip


def replayed(file: Path) -> dict[str, Motion]:
    """Every entity's motion in a file that replays all vehicles."""
    root = ElementTree.parse(file).getroot()
    begin = float(properties(root)["begin"])
    motions = {}
    for scenario_object in root.iterfind("Entities/ScenarioObject"):
        name = scenario_object.attrib["name"]
        (trajectory,) = [t for event in events(root, name) for t in event.iter("Trajectory")]
        motions[name] = motion(root, name, trajectory, begin)
    return motions
