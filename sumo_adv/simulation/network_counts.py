"""Count what a SUMO network contains, by kind."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from sumo_adv.simulation.scan import allows_passenger, parse_xml

CAR_LANES = "lanes for cars"
LANE_KINDS = (
    ("bus", "bus lanes"), ("tram", "tram lanes"), ("rail", "railway lanes"), ("bicycle", "cycle lanes"),
    ("pedestrian", "foot lanes"),
)  # fmt: skip
"""Classes that determine the kind of a lane without cars, in this order."""


@dataclass(frozen=True, slots=True)
class NetworkCounts:
    """Counts of a network.

    Attributes:
        edges: Edges by SUMO's function; that of a road is ``normal``.
        lanes: Lanes of roads by kind: ``CAR_LANES``, one of ``LANE_KINDS`` or ``other lanes``.
        junctions: Junctions by SUMO's type, without internal junctions and dead ends.
        others: Further elements by tag.
        original_ids: Ids of the roads or lanes of the map that the network was converted from.
    """

    edges: Counter[str]
    lanes: Counter[str]
    junctions: Counter[str]
    others: Counter[str]
    original_ids: frozenset[str]


def count_network(network: Path) -> NetworkCounts:
    """Count what a network contains.

    Args:
        network: The network file.

    Returns:
        The counts.

    Raises:
        UsageError: The file cannot be read.
    """
    edges, lanes, junctions, others = Counter[str](), Counter[str](), Counter[str](), Counter[str]()
    ids: set[str] = set()
    function = ""

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal function
        if tag == "edge":
            function = attributes.get("function", "normal")
            edges[function] += 1
        elif tag == "lane" and function == "normal":
            lanes[_kind(attributes)] += 1
        elif tag == "junction" and attributes.get("type") not in ("internal", "dead_end"):
            junctions[attributes.get("type", "unknown")] += 1
        elif tag == "param" and attributes.get("key") == "origId":
            ids.update(attributes.get("value", "").split())
        else:
            others[tag] += 1

    parse_xml(network, start)
    return NetworkCounts(edges, lanes, junctions, others, frozenset(ids))


def _kind(lane: dict[str, str]) -> str:
    """Return the kind of a lane."""
    if allows_passenger(lane):
        return CAR_LANES
    allowed = lane.get("allow", "").split()
    return next((kind for name, kind in LANE_KINDS if any(each.startswith(name) for each in allowed)), "other lanes")
