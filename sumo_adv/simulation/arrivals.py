"""Find where SUMO removes a vehicle: ``arrivalPos`` and ``arrivalEdge``, which only a saved state contains."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

OTHER_FOLDERS = ("/tmp", "/var/tmp", "/dev/shm")  # for temporary files if the usual folder cannot be used


class ArrivalPlace(NamedTuple):
    """Where a vehicle leaves the network.

    Attributes:
        edge: The id of the edge.
        position: SUMO's lane position there [m]; inf at the edge's end.
    """

    edge: str
    position: float


def arrival_attributes(api: Any, vehicle: str) -> Mapping[str, str]:
    """Return the attributes of a vehicle in SUMO's saved state.

    Args:
        api: libsumo, or a connection with the same functions.
        vehicle: The id of the vehicle.

    Returns:
        The attributes; empty if the state does not contain the vehicle.
    """
    with tempfile.TemporaryDirectory(dir=_place()) as folder:
        file = Path(folder) / "state.xml"
        api.simulation.saveState(str(file))
        for _, element in ElementTree.iterparse(file):
            if element.tag == "vehicle" and element.get("id") == vehicle:
                return dict(element.attrib)
    return {}


def _place() -> str | None:
    """Return the folder to write in: None for the usual one, unless SUMO would read its path as HOST:PORT.

    SUMO opens a socket instead of a file if the path has a colon that does not follow a drive letter.
    """
    usual, *others = (tempfile.gettempdir(), *OTHER_FOLDERS)
    if ":" not in usual[2:]:
        return None
    return next((folder for folder in others if os.access(folder, os.W_OK)), None)


def arrival(attributes: Mapping[str, str], route: Sequence[str], api: Any) -> ArrivalPlace:
    """Return where a vehicle leaves its route.

    Args:
        attributes: Its attributes in SUMO's state (``arrival_attributes``).
        route: All edges of its route.
        api: libsumo, or a connection with the same functions.

    Returns:
        The place.
    """
    index = attributes.get("arrivalEdge", "")
    edge = route[int(index)] if index.isdigit() and int(index) < len(route) else route[-1]
    text = attributes.get("arrivalPosRandomized", attributes.get("arrivalPos", "max"))
    try:
        position = float(text)
    except ValueError:  # a word of SUMO's, which means the end of the edge
        return ArrivalPlace(edge, math.inf)
    return ArrivalPlace(edge, position if position >= 0 else position + float(api.lane.getLength(f"{edge}_0")))
