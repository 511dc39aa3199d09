"""Count the contents of an input by kind."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from sumo_adv.errors import UsageError
from sumo_adv.simulation.inputs import RunInput
from sumo_adv.simulation.network_counts import count_network
from sumo_adv.simulation.scan import parse_seconds, parse_xml, scan_demand
from sumo_adv.simulation.sumo_states import PERSON

EDGE_KINDS = {"crossing": "pedestrian crossings", "walkingarea": "walking areas"}


def contents_of(run_input: RunInput) -> Mapping[str, int]:
    """Count the elements of an input's network, demand and recording, by kind."""
    counts = Counter(_network(run_input.network))
    for file in (*run_input.routes, *run_input.additional):
        scan = scan_demand(file)
        counts["vehicles and trips"] += len(scan.vehicles)
        counts["flows"] += len(scan.flows)
        counts["persons and flows of them"] += len(scan.persons)
    if run_input.playback is not None:
        counts["recorded vehicles"] += len(run_input.playback.vehicles)
        counts["recorded obstacles, pedestrians and cyclists"] += len(run_input.playback.obstacles)
    return {kind: number for kind, number in counts.items() if number}


def departures(run_input: RunInput, first: float, last: float) -> frozenset[str]:
    """Find the vehicles and persons that should depart within a period, without those of flows.

    Args:
        run_input: The input.
        first: The beginning of the period [s].
        last: The end of the period [s], which is not included.

    Returns:
        Their ids; persons as ``person:ID``.
    """
    due: set[str] = set()

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag in ("vehicle", "trip", "person"):
            with contextlib.suppress(UsageError):  # values such as "triggered" are not times
                time = parse_seconds(run_input.path, "departure", attributes.get("depart"))
                if time is not None and first <= time < last:
                    due.add((PERSON if tag == "person" else "") + attributes.get("id", ""))

    for file in (*run_input.routes, *run_input.additional):
        parse_xml(file, start)
    return frozenset(due)


def _network(network: Path) -> Counter[str]:
    found = count_network(network)
    counts = Counter({label: found.edges[function] for function, label in EDGE_KINDS.items()})
    counts |= Counter(edges=found.edges["normal"]) | found.lanes
    counts |= Counter({"programs of traffic lights": found.others["tlLogic"]})
    counts |= Counter({f"junctions ({kind})": number for kind, number in found.junctions.items()})
    return counts | Counter(roundabouts=found.others["roundabout"])
