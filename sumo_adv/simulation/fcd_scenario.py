"""Convert SUMO's floating car data (``--fcd-output``) to a scenario with the recording and the driven routes."""

from __future__ import annotations

import heapq
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from sumo_adv.consistency import even_grid, off_grid, steps_over
from sumo_adv.datatypes import Floats
from sumo_adv.errors import UsageError
from sumo_adv.simulation.fcd_recording import (
    FcdRecording,
    RecordedObject,
    check_recording,
    in_network,
    read_recording,
    some,
)
from sumo_adv.simulation.fcd_types import CAR_SIZE, CLASS_SIZES, Size, read_sizes, size_of
from sumo_adv.simulation.network import RoadMap, read_network
from sumo_adv.simulation.permissions import CAR
from sumo_adv.simulation.scenario import DEFAULT_WARM_UP_S, NETWORK_FILE, ROUTES_FILE, SCENARIO_FILE, TRACKS_FILE
from sumo_adv.simulation.sumo_states import headings_of
from sumo_adv.simulation.tracks import LoggedTrack, TrackLog, write_tracks

MAX_RECORDED_STATES = 20_000_000  # maximum number of states, over all objects and times: about 700 MB
PREFERRED_MOVEMENTS = ("straight", "right", "left", "u-turn")  # order in which routes are extended
FCD_ROUTE_EXTENSION_M = 500.0  # length of road after the recording's end: half a minute in town, longer than an attack
UNRECORDED_ROAD_SLACK_M = 5.0  # how much longer edges between two states may be than the line between their places


@dataclass(frozen=True, slots=True)
class ImportedFcd:
    """The result of a conversion.

    Attributes:
        objects: The number of objects.
        notes: Sentences on what was converted, left out or assumed.
    """

    objects: int
    notes: tuple[str, ...]


def write_scenario(
    folder: Path,
    recording: Path,
    network: Path,
    ego: str,
    types: Sequence[Path] = (),
    warm_up: float = DEFAULT_WARM_UP_S,
) -> ImportedFcd:
    """Write a scenario with its network, tracks and routes.

    Args:
        folder: Where the files are written.
        recording: The FCD file.
        network: The network file.
        ego: The name of the ego.
        types: Files with the vTypes of the vehicles. Vehicles of unknown types get SUMO's 5 by 1.8 m.
        warm_up: How long the recording moves all vehicles after the ego appears [s].

    Returns:
        The number of objects, and notes on the conversion.

    Raises:
        UsageError: A file is damaged or no FCD; some motion is impossible; the ego is not in the recording, never on a
            lane outside junctions, or gone before it can be driven.
    """
    recorded, road = read_recording(recording), read_network(network)
    vehicles = [o.name for o in recorded.objects.values() if not o.person]
    if ego not in vehicles:
        raise UsageError(f"There is no vehicle '{ego}' in {recording}; it has {some(sorted(vehicles))}.")
    sizes, unknown = _sizes(recorded, read_sizes(types))
    recorded = in_network(recording, recorded, network, road, ego)
    check_recording(recording, recorded, sizes)
    log = _log(recording, recorded, sizes)
    found = {name: _edges(recorded.objects[name], road, log.end) for name in vehicles}
    routes = {name: edges for name, (edges, _) in found.items()}
    cut = [name for name, (_, whole) in found.items() if not whole]
    if not routes[ego]:
        raise UsageError(f"The vehicle '{ego}' is only on junctions of {network.name} in {recording}: record longer.")
    lasts = float(np.ptp(recorded.objects[ego].time))
    if lasts < warm_up:
        raise UsageError(
            f"The vehicle '{ego}' is in {recording} for {lasts:g} s, and the recording moves it for the first "
            f"{warm_up:g} s: give a shorter --warm-up, or record longer."
        )
    copy = f"{NETWORK_FILE}.gz" if network.name.lower().endswith(".gz") else NETWORK_FILE
    shutil.copyfile(network, folder / copy)
    write_tracks(folder / TRACKS_FILE, log)
    lines = [f'    <route id={quoteattr(n)} edges="{" ".join(edges)}"/>\n' for n, edges in routes.items() if edges]
    (folder / ROUTES_FILE).write_text("<routes>\n" + "".join(lines) + "</routes>\n", encoding="utf-8")
    (folder / SCENARIO_FILE).write_text(_scenario(copy, ego, float(log.time[0]), warm_up), encoding="utf-8")
    return ImportedFcd(len(log.tracks), (*recorded.notes, *_said(unknown, cut)))


def _sizes(recorded: FcdRecording, sizes: Mapping[str, Size]) -> tuple[dict[str, Size], list[str]]:
    """Return length and width by object [m], and the vTypes whose size no file gives."""
    known: dict[str, Size] = {}
    unknown: dict[str, None] = {}
    for name, o in recorded.objects.items():
        size = size_of(o.kind, name, sizes)
        if size is None and not o.person:
            unknown[o.kind] = None
        known[name] = size or (CLASS_SIZES["pedestrian"] if o.person else CAR_SIZE)
    return known, list(unknown)


def _said(unknown: Sequence[str], cut: Sequence[str]) -> list[str]:
    """Return notes on what is assumed for vehicles of unknown types, and on vehicles whose routes are cut short."""
    notes = []
    if unknown:
        of = f"the types {some(unknown)}" if any(unknown) else "vehicles whose type the recording does not say"
        notes.append(
            f"No file says the size of {of}: {CAR_SIZE[0]:g} by {CAR_SIZE[1]:g} m are assumed; name "
            "their file with --types."
        )
    if cut:
        notes.append(
            f"Routes end before the recording does, where no connection leads to the next recorded edge: {some(cut)}."
        )
    return notes


def _log(recording: Path, recorded: FcdRecording, sizes: Mapping[str, Size]) -> TrackLog:
    """Return the recording as tracks on an even time grid."""
    objects = recorded.objects
    times = np.unique(np.concatenate([o.time for o in objects.values()]))
    if (steps_over(times) + 1) * len(objects) > MAX_RECORDED_STATES:
        raise UsageError(
            f"{recording} spans {times[-1] - times[0]:.3g} s in steps of {np.diff(times).min():.3g} s with "
            f"{len(objects)} objects, more than {MAX_RECORDED_STATES:.0e} states; cut it to the part that you need."
        )
    if (worst := off_grid(times)) is not None:
        raise UsageError(f"{recording} has no even steps: {times[worst]:g} s is off; record it with one period.")
    grid = even_grid(times)[0]
    return TrackLog(grid, {name: _track(o, sizes[name], grid) for name, o in objects.items()})


def _track(o: RecordedObject, size: Size, grid: Floats) -> LoggedTrack:
    """Return one object as a track of box centres on the time grid."""
    step = grid[1] - grid[0] if len(grid) > 1 else 1.0
    at = np.rint((o.time - grid[0]) / step).astype(np.intp)
    valid = np.zeros(len(grid), dtype=bool)
    valid[at] = True
    columns = np.zeros((4, len(grid)))
    heading = headings_of(o.angle)
    back = 0.0 if o.person else size[0] / 2
    columns[:, at] = o.x - back * np.cos(heading), o.y - back * np.sin(heading), heading, o.speed
    x, y, heading, speed = columns
    return LoggedTrack(o.name, "pedestrian" if o.person else "vehicle", valid, x, y, heading, speed, *size)


def _edges(o: RecordedObject, road: RoadMap, end: float) -> tuple[tuple[str, ...], bool]:
    """Return the edges that an object drove outside junctions, as long as each leads to the next, and whether all do.

    Edges that the object passed between two recorded states are added. A vehicle that is still there at the ``end``
    [s] of the recording has not arrived. Its route is extended, straight if possible.
    """
    route: list[str] = []
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(o.x), np.diff(o.y)))])  # to each state [m]
    last = 0  # the latest state on the route's last edge
    for k, name in enumerate(o.lanes):
        lane = road.lanes.get(name)
        if lane is None or lane.internal:
            continue
        if route and lane.edge != route[-1]:
            reach = float(driven[k] - driven[last]) + UNRECORDED_ROAD_SLACK_M
            between = _edges_between(route[-1], lane.edge, road, reach)
            if between is None:
                return tuple(route), False
            route += [*between, lane.edge]
        elif not route:
            route.append(lane.edge)
        last = k
    if not route or o.time[-1] < end:
        return tuple(route), True
    left = FCD_ROUTE_EXTENSION_M
    while left > 0.0 and (onward := [edge for edge in _next_edges(route[-1], road) if edge not in route]):
        lanes = [road.lanes[name] for name in road.edges[onward[0]]]
        if not any(lane.allows(CAR) for lane in lanes):
            break
        route.append(onward[0])
        left -= lanes[0].length
    return tuple(route), True


def _edges_between(start: str, goal: str, road: RoadMap, reach: float) -> tuple[str, ...] | None:
    """Return the shortest chain of edges that connects two edges; None if it is longer than ``reach`` [m]."""
    open_chains: list[tuple[float, tuple[str, ...]]] = [(0.0, ())]
    reached: set[str] = set()
    while open_chains:
        length, chain = heapq.heappop(open_chains)
        onward = _next_edges(chain[-1] if chain else start, road)
        if goal in onward:
            return chain
        for edge in onward:
            longer = length + road.lanes[road.edges[edge][0]].length
            if edge not in reached and longer <= reach:
                reached.add(edge)
                heapq.heappush(open_chains, (longer, (*chain, edge)))
    return None


def _next_edges(edge: str, road: RoadMap) -> list[str]:
    """Return the edges that an edge leads to: straight ones first, then right, left and back."""
    found = {(road.lanes[c.to].edge, c.movement) for lane in road.edges[edge] for c in road.lanes[lane].connections}
    return [to for to, _ in sorted(found, key=lambda each: (PREFERRED_MOVEMENTS.index(each[1]), each[0]))]


def _scenario(network: str, ego: str, begin: float, warm_up: float) -> str:
    """Return the text of the scenario file."""
    return f"""\
schema = 1
network = "{network}"
tracks = "{TRACKS_FILE}"

[demand]
files = ["{ROUTES_FILE}"]
begin = {begin:.3f}

[ego]
id = {json.dumps(ego, ensure_ascii=False)}

[window]
warm_up = {warm_up:.3f}
"""
