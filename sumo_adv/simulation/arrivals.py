"""Where SUMO takes a vehicle out: ``arrivalPos`` and ``arrivalEdge``, which only a saved state tells."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree


class ArrivalPlace(NamedTuple):
    """The edge on which a vehicle leaves, and SUMO's lane position there [m]; inf: at the edge's end."""

    edge: str
    position: float


def arrival_attributes(api: Any, vehicle: str) -> Mapping[str, str]:
    """What SUMO's state says of a vehicle; empty if it does not hold it."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "state.xml"
        api.simulation.saveState(str(file))
        for _, element in ElementTree.iterparse(file):
            if element.tag == "vehicle" and element.get("id") == vehicle:
                return dict(element.attrib)
    return {}


def arrival(attributes: Mapping[str, str], route: Sequence[str], api: Any) -> ArrivalPlace:
    """Where a vehicle with these attributes leaves its route, all of whose edges are given."""
    index = attributes.get("arrivalEdge", "")
    edge = route[int(index)] if index.isdigit() and int(index) < len(route) else route[-1]
    text = attributes.get("arrivalPosRandomized", attributes.get("arrivalPos", "max"))
    try:
        position = float(text)
    except ValueError:  # SUMO's words for the end of the edge
        return ArrivalPlace(edge, math.inf)
    return ArrivalPlace(edge, position if position >= 0 else position + float(api.lane.getLength(f"{edge}_0")))
