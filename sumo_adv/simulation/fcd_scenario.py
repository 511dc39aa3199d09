"""Recorded floating car data (SUMO's ``--fcd-output``) as a scenario: the recording, and the routes that were driven.

``x``, ``y`` are front bumpers, ``angle`` degrees clockwise from north; a ``person`` stands at its middle.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.errors import UsageError
from sumo_adv.simulation.network import RoadMap, read_network
from sumo_adv.simulation.scan import parse
from sumo_adv.simulation.scenario import DEFAULT_WARM_UP
from sumo_adv.simulation.simulation import heading_of
from sumo_adv.simulation.tracks import LoggedTrack, TrackLog, write_tracks

SCENARIO, TRACKS, ROUTES = "scenario.toml", "tracks.csv.gz", "routes.rou.xml"
CAR, PERSON = (5.0, 1.8), (0.215, 0.478)  # m, length and width: SUMO's defaults
LATEST = 1e7  # s, about four months: of times in a recording
MOST_STATES = 20_000_000  # of all objects at all times: about 700 MB
LARGEST, FARTHEST = 100.0, 1e9  # m: the size of a vehicle, and a place
Size = tuple[float, float]
Seen = dict[str, dict[float, dict[str, str]]]


def write_scenario(
    folder: Path, recording: Path, network: Path, ego: str, types: Sequence[Path] = (), warm_up: float = DEFAULT_WARM_UP
) -> int:
    """Network, tracks, routes and scenario into ``folder``; gives the number of objects.

    ``types``: files with the vTypes of the vehicles (else SUMO's 5 by 1.8 m). ``warm_up`` [s]: how long
    the recording moves all vehicles after the ego came.

    Raises UsageError: a file that is damaged or no FCD, an ego that is not in it or never on a lane.
    """
    seen, persons = _read(recording)
    road = read_network(network)
    if ego not in seen:
        named = ", ".join(sorted(seen)[:5])
        raise UsageError(f"There is no vehicle '{ego}' in {recording}; it has {named}{' ..' if len(seen) > 5 else ''}.")
    log = _log(recording, seen, persons, _sizes(types))
    routes = {name: _edges(states, road) for name, states in seen.items() if name not in persons}
    if not routes[ego]:
        raise UsageError(f"The vehicle '{ego}' is on no lane of {network.name} in {recording}; is it that network's?")
    copy = "network.net.xml.gz" if network.name.lower().endswith(".gz") else "network.net.xml"
    shutil.copyfile(network, folder / copy)
    write_tracks(folder / TRACKS, log)
    lines = [f'    <route id={quoteattr(n)} edges="{" ".join(edges)}"/>\n' for n, edges in routes.items() if edges]
    (folder / ROUTES).write_text("<routes>\n" + "".join(lines) + "</routes>\n", encoding="utf-8")
    (folder / SCENARIO).write_text(_scenario(copy, ego, float(log.time[0]), warm_up), encoding="utf-8")
    return len(log.tracks)


@contextmanager
def _no_fcd(recording: Path) -> Iterator[None]:
    try:
        yield
    except (KeyError, ValueError) as error:
        raise UsageError(f"{recording} is no FCD of SUMO ({error}); write it with sumo --fcd-output.") from error


def _read(recording: Path) -> tuple[Seen, set[str]]:
    """Attributes by id and time [s], and which ids are persons'."""
    seen: Seen = {}
    persons: set[str] = set()
    timestep = math.nan

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal timestep
        if tag == "timestep":
            timestep = float(attributes["time"])
            if not abs(timestep) < LATEST:
                raise ValueError(f"a timestep at {attributes['time'][:40]}")
        elif tag in ("vehicle", "person"):
            seen.setdefault(attributes["id"], {})[timestep] = attributes
            if tag == "person":
                persons.add(attributes["id"])

    with _no_fcd(recording):
        parse(recording, start)
    if not seen:
        raise UsageError(f"{recording} has no vehicle in a timestep; write it with sumo --fcd-output.")
    return seen, persons


def _sizes(types: Sequence[Path]) -> dict[str, Size]:
    """Length and width [m] by vType."""
    sizes: dict[str, Size] = {}

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag == "vType":
            length, width = (attributes.get(k, d) for k, d in (("length", CAR[0]), ("width", CAR[1])))
            sizes[attributes["id"]] = float(length), float(width)
            if not all(0.0 < size < LARGEST for size in sizes[attributes["id"]]):
                raise ValueError(f"its size is {length} m by {width} m")

    for file in types:
        try:
            parse(file, start)
        except (KeyError, ValueError) as error:
            raise UsageError(f"{file} has a vType that cannot be used ({error}).") from error
    return sizes


def _log(recording: Path, seen: Seen, persons: set[str], sizes: Mapping[str, Size]) -> TrackLog:
    times = np.array(sorted({time for states in seen.values() for time in states}))
    step = float(np.diff(times).min()) if len(times) > 1 else 0.1
    count = round((times[-1] - times[0]) / step) + 1
    if count * len(seen) > MOST_STATES:
        raise UsageError(
            f"{recording} spans {times[-1] - times[0]:.3g} s in steps of {step:.3g} s with {len(seen)} objects, more"
            f" than {MOST_STATES:.0e} states; cut it to the part that you need."
        )
    grid = times[0] + step * np.arange(count)
    with _no_fcd(recording):
        tracks = {n: _track(n, states, n in persons, sizes, grid, step) for n, states in seen.items()}
    return TrackLog(np.round(grid, 3), tracks)


def _track(
    name: str, states: Mapping[float, Mapping[str, str]], person: bool, sizes: Mapping[str, Size], grid: Floats,
    step: float,
) -> LoggedTrack:  # fmt: skip
    first = next(iter(states.values()))
    length, width = sizes.get(first.get("type", ""), PERSON if person else CAR)
    x, y, heading, speed = np.zeros((4, len(grid)))
    valid = np.zeros(len(grid), dtype=bool)
    for time, state in states.items():
        k = round((time - float(grid[0])) / step)
        heading[k] = heading_of(float(state["angle"]))
        back = 0.0 if person else length / 2
        x[k] = float(state["x"]) - back * math.cos(heading[k])
        y[k] = float(state["y"]) - back * math.sin(heading[k])
        speed[k] = float(state["speed"])
        valid[k] = True
    if not (np.abs([x, y, heading, speed]) < FARTHEST).all():
        raise ValueError(f"'{name}' has a number that is not finite, or no place on a map")
    return LoggedTrack(name, "pedestrian" if person else "vehicle", valid, x, y, heading, speed, length, width)


def _edges(states: Mapping[float, Mapping[str, str]], road: RoadMap) -> tuple[str, ...]:
    """The edges driven on outside junctions, as long as each leads to the next."""
    route: list[str] = []
    for state in states.values():
        lane = road.lanes.get(state.get("lane", ""))
        if lane is None or lane.internal or (route and lane.edge == route[-1]):
            continue
        before = road.edges[route[-1]] if route else ()
        if route and lane.edge not in {road.lanes[c.to].edge for n in before for c in road.lanes[n].connections}:
            break
        route.append(lane.edge)
    return tuple(route)


def _scenario(network: str, ego: str, begin: float, warm_up: float) -> str:
    return f"""\
schema = 1
network = "{network}"
tracks = "{TRACKS}"

[demand]
files = ["{ROUTES}"]
begin = {begin:.3f}

[ego]
id = {json.dumps(ego, ensure_ascii=False)}

[window]
warm_up = {warm_up:.3f}
"""
