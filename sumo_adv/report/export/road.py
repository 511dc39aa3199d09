"""The lanes around a run's vehicles, as formats with a map of lanes write them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.report.export.piece import Piece
from sumo_adv.simulation.network import Lane, RoadMap, read_network

REACH = 220.0  # m around the vehicles' paths
SPACING = 0.5  # m between points of a spaced line


@dataclass(frozen=True, slots=True)
class MapLane:
    """A lane under a number. Lines are ``(n, 2)`` [m], in the direction of travel; links are numbers of lanes."""

    number: int
    lane: Lane
    left: Floats
    right: Floats
    entries: tuple[int, ...]
    exits: tuple[int, ...]
    beside_left: int | None
    beside_right: int | None


def map_lanes(piece: Piece) -> list[MapLane]:
    """The passenger lanes within ``REACH`` of the vehicles' paths, also those within junctions, numbered from 1.

    Raises UsageError: the network is unreadable.
    """
    from shapely import MultiPoint, dwithin, linestrings

    road = network_of(piece)
    lanes = [lane for lane in road.lanes.values() if lane.passenger and len(lane.shape) > 1]
    points = np.concatenate([np.column_stack([t.x, t.y])[::10] for t in piece.tracks])
    near = dwithin([linestrings(lane.shape) for lane in lanes], MultiPoint(points), REACH)
    kept = [lane for lane, is_near in zip(lanes, near, strict=True) if is_near]
    numbers = {lane.id: k for k, lane in enumerate(kept, 1)}
    exits = _exits(road, numbers)
    return [_map_lane(lane, road, numbers, exits) for lane in kept]


def network_of(piece: Piece) -> RoadMap:
    """The network of a run. Raises UsageError: it is unreadable."""
    return _network(piece.network)


@lru_cache(maxsize=2)
def _network(path: Path) -> RoadMap:
    """The formats of one run share theirs."""
    return read_network(path)


def _exits(road: RoadMap, numbers: dict[str, int]) -> dict[int, list[int]]:
    """For each lane the lanes that follow, through junctions lane by lane."""
    exits: dict[int, list[int]] = {number: [] for number in numbers.values()}
    for lane in road.lanes.values():
        for connection in () if lane.internal else lane.connections:
            chain = (lane.id, *connection.via, connection.to)
            for a, b in pairwise(chain):
                if a in numbers and b in numbers and numbers[b] not in exits[numbers[a]]:
                    exits[numbers[a]].append(numbers[b])
    return exits


def _map_lane(lane: Lane, road: RoadMap, numbers: dict[str, int], exits: dict[int, list[int]]) -> MapLane:
    number, row = numbers[lane.id], road.edges[lane.edge]
    at = row.index(lane.id)
    beside: dict[bool, int | None] = {True: None, False: None}
    for k in (at - 1, at + 1):
        if not lane.internal and 0 <= k < len(row) and row[k] in numbers:
            beside[_is_left(road.lanes[row[k]], lane)] = numbers[row[k]]
    return MapLane(
        number, lane, shifted(lane.shape, lane.width / 2), shifted(lane.shape, -lane.width / 2),
        tuple(a for a, following in exits.items() if number in following), tuple(exits[number]), beside[True],
        beside[False],
    )  # fmt: skip


def _is_left(other: Lane, lane: Lane) -> bool:
    """Whether a lane of the same edge is to the left; SUMO counts from the kerb, in left-hand traffic from the left."""
    (ax, ay), (dx, dy) = lane.shape[1] - lane.shape[0], other.shape[0] - lane.shape[0]
    return bool(ax * dy - ay * dx > 0.0)


def shifted(line: Floats, offset: float) -> Floats:
    """A line ``(n, 2)`` moved to the left by ``offset`` [m], each vertex along the mean normal of its segments."""
    along = np.diff(line, axis=0)
    along = along / np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)[:, None]
    mean = np.concatenate([along[:1], along[:-1] + along[1:], along[-1:]])
    mean = mean / np.maximum(np.hypot(mean[:, 0], mean[:, 1]), 1e-9)[:, None]
    return line + offset * np.column_stack([-mean[:, 1], mean[:, 0]])


def spaced(line: Floats) -> Floats:
    """A line ``(n, 2)`` with a point every ``SPACING`` m and at its ends."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    stations = np.linspace(0.0, along[-1], max(2, round(along[-1] / SPACING) + 1))
    return np.column_stack([np.interp(stations, along, line[:, k]) for k in (0, 1)])
