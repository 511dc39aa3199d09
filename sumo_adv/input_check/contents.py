"""What was read of an input: counts by kind."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from sumo_adv.errors import UsageError
from sumo_adv.simulation.inputs import RunInput
from sumo_adv.simulation.scan import allows_passenger, parse_seconds, parse_xml, scan_demand
from sumo_adv.simulation.sumo_states import PERSON

LANE_KINDS = (
    ("bus", "bus"), ("tram", "tram"), ("rail", "railway"), ("bicycle", "cycle"), ("pedestrian", "foot")
)  # fmt: skip
"""Classes that make a lane without cars one of a kind, in this order."""
EDGE_KINDS = {"crossing": "pedestrian crossings", "walkingarea": "walking areas"}


def contents_of(run_input: RunInput) -> Mapping[str, int]:
    """Counts of what an input holds, by kind: its network's, its demand's, its recording's."""
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
    """The vehicles and persons that are to depart from ``first`` to ``last`` [s]; without those of flows."""
    due: set[str] = set()

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag in ("vehicle", "trip", "person"):
            with contextlib.suppress(UsageError):  # "triggered" and the like are no times
                time = parse_seconds(run_input.path, "departure", attributes.get("depart"))
                if time is not None and first <= time < last:
                    due.add((PERSON if tag == "person" else "") + attributes.get("id", ""))

    for file in (*run_input.routes, *run_input.additional):
        parse_xml(file, start)
    return frozenset(due)


def _network(network: Path) -> Counter[str]:
    counts: Counter[str] = Counter()
    function = ""

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal function
        if tag == "edge":
            function = attributes.get("function", "normal")
            counts["edges"] += function == "normal"
            if function in EDGE_KINDS:
                counts[EDGE_KINDS[function]] += 1
        elif tag == "lane" and function == "normal":
            counts[_kind(attributes)] += 1
        elif tag == "junction" and attributes.get("type") not in ("internal", "dead_end"):
            counts[f"junctions ({attributes.get('type', 'unknown')})"] += 1
        elif tag == "tlLogic":
            counts["programs of traffic lights"] += 1
        elif tag == "roundabout":
            counts["roundabouts"] += 1

    parse_xml(network, start)
    return counts


def _kind(lane: dict[str, str]) -> str:
    if allows_passenger(lane):
        return "lanes for cars"
    allowed = lane.get("allow", "").split()
    kind = next((kind for name, kind in LANE_KINDS if any(each.startswith(name) for each in allowed)), "other")
    return f"{kind} lanes"
