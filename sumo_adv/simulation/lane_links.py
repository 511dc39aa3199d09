"""What each lane of a network leads to and lies beside; lanes under numbers, as exports and CommonRoad need them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Protocol

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.geometry import wrap
from sumo_adv.simulation.network import NetworkLane, RoadMap

OPPOSITE_SEARCH_DISTANCE_M = 12.0  # from the middle of a lane to the lane across the centre line
MIN_OPPOSITE_TURN_RAD = 2.6  # between the directions of two lanes that lead opposite ways
MAX_OPPOSITE_GAP_M = 0.5  # between the boundaries of two lanes that share their centre line
MAX_OPPOSITE_LENGTH_DIFFERENCE_M = 10.0  # of two such lanes; in a bend the outer one is longer


class Linked(Protocol):
    """A lane's links, as ids of lanes."""

    @property
    def successors(self) -> Sequence[str]: ...

    @property
    def predecessors(self) -> Sequence[str]: ...

    @property
    def left(self) -> str | None: ...

    @property
    def right(self) -> str | None: ...

    @property
    def opposite_left(self) -> str | None: ...

    @property
    def opposite_right(self) -> str | None: ...


@dataclass(frozen=True, slots=True)
class LaneLinks:
    """The links of one lane.

    Attributes:
        successors: The lanes that follow, through junctions lane by lane.
        predecessors: The lanes that it follows.
        left: The next lane of the same edge to the left; None if there is none.
        right: The same to the right.
        opposite_left: The lane of the opposite direction that shares its left boundary; None if there is none.
        opposite_right: The same of its right boundary, as in left-hand traffic.
    """

    successors: tuple[str, ...]
    predecessors: tuple[str, ...]
    left: str | None
    right: str | None
    opposite_left: str | None
    opposite_right: str | None


class LaneGraph:
    """The links of a network's lanes. Each is found when it is first asked for, and kept."""

    def __init__(self, road: RoadMap) -> None:
        self._road = road
        self._links: dict[str, LaneLinks] = {}
        self._across: dict[str, NetworkLane | None] = {}

    def links(self, lane: NetworkLane) -> LaneLinks:
        """The links of one of the network's lanes."""
        if lane.id not in self._links:
            row = self._road.edges[lane.edge]
            right = row[lane.index - 1] if lane.index > 0 else None
            left = row[lane.index + 1] if lane.index + 1 < len(row) else None
            opposite, on_left = self._opposite(lane), self._road.hand > 0
            successors, predecessors = self._connected
            self._links[lane.id] = LaneLinks(
                tuple(successors.get(lane.id, ())), tuple(predecessors.get(lane.id, ())), left, right,
                opposite if on_left else None, None if on_left else opposite,
            )  # fmt: skip
        return self._links[lane.id]

    @cached_property
    def _connected(self) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
        """Successors and predecessors by lane."""
        successors: dict[str, dict[str, None]] = {}  # an ordered set
        for lane in self._road.lanes.values():
            for connection in () if lane.internal else lane.connections:
                for a, b in pairwise((lane.id, *connection.via, connection.to)):
                    successors.setdefault(a, {})[b] = None
        predecessors: dict[str, list[str]] = {}
        for name in self._road.lanes:
            for after in successors.get(name, ()):
                predecessors.setdefault(after, []).append(name)
        return {name: list(after) for name, after in successors.items()}, predecessors

    def _opposite(self, lane: NetworkLane) -> str | None:
        """The lane of the opposite direction that shares a lane's inner boundary: each is across from the other."""
        other = self._lane_across(lane)
        return other.id if other is not None and self._lane_across(other) is lane else None

    def _lane_across(self, lane: NetworkLane) -> NetworkLane | None:
        if lane.id not in self._across:
            self._across[lane.id] = self._find_across(lane)
        return self._across[lane.id]

    def _find_across(self, lane: NetworkLane) -> NetworkLane | None:
        """The lane that touches the inner boundary at the middle of a lane and leads the opposite way."""
        if not self._is_innermost(lane):
            return None
        x, y, heading = lane.point_at(lane.length / 2)
        inwards = -math.sin(heading) * self._road.hand, math.cos(heading) * self._road.hand
        for other in self._road.lanes_near(x, y, OPPOSITE_SEARCH_DISTANCE_M):
            other_x, other_y, other_heading = other.point_at(other.station_at(x, y))
            away = inwards[0] * (other_x - x) + inwards[1] * (other_y - y)
            if (
                abs(away - (lane.width + other.width) / 2) < MAX_OPPOSITE_GAP_M
                and abs(wrap(other_heading - heading)) > MIN_OPPOSITE_TURN_RAD
                and abs(other.length - lane.length) < MAX_OPPOSITE_LENGTH_DIFFERENCE_M
                and self._is_innermost(other)
            ):
                return other
        return None

    def _is_innermost(self, lane: NetworkLane) -> bool:
        """Whether no lane of its edge lies between it and the centre line; junctions have no centre line."""
        return not lane.internal and self._road.edges[lane.edge][-1 if self._road.hand > 0 else 0] == lane.id


@dataclass(frozen=True, slots=True)
class NumberedLane:
    """A lane under a number.

    Attributes:
        number: Its own.
        left: Its left boundary ``(n, 2)`` [m], in the direction of travel.
        right: Its right boundary.
        entries: Numbers of the lanes before it.
        exits: Numbers of the lanes after it.
        beside_left: The lane beside it to the left that leads the same way; None within junctions.
        beside_right: The same to the right.
        opposite_left: The lane of the opposite direction at its left boundary.
        opposite_right: The same at its right boundary.
    """

    number: int
    left: Floats
    right: Floats
    entries: tuple[int, ...]
    exits: tuple[int, ...]
    beside_left: int | None
    beside_right: int | None
    opposite_left: int | None
    opposite_right: int | None


def numbered_lane(
    number: int, centre: Floats, width: float, *, junction: bool, links: Linked, numbers: Mapping[str, int]
) -> NumberedLane:
    """A lane under a number, linked to those lanes that have one.

    Args:
        number: Of the lane.
        centre: Its centreline ``(n, 2)`` [m].
        width: Of the lane [m].
        junction: Whether it lies within a junction, where no lane is said to be beside it.
        links: Its links by id.
        numbers: The numbers of the lanes that are known, by id.
    """

    def known(lanes: Iterable[str]) -> tuple[int, ...]:
        return tuple(numbers[name] for name in lanes if name in numbers)

    def beside(name: str | None) -> int | None:
        return None if name is None or junction else numbers.get(name)

    return NumberedLane(
        number, shifted(centre, width / 2), shifted(centre, -width / 2), known(links.predecessors),
        known(links.successors), beside(links.left), beside(links.right), beside(links.opposite_left),
        beside(links.opposite_right),
    )  # fmt: skip


def shifted(line: Floats, offset: float) -> Floats:
    """A line ``(n, 2)`` moved to the left by ``offset`` [m], each vertex along the mean normal of its segments."""
    along = np.diff(line, axis=0)
    along = along / np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)[:, None]
    mean = np.concatenate([along[:1], along[:-1] + along[1:], along[-1:]])
    mean = mean / np.maximum(np.hypot(mean[:, 0], mean[:, 1]), 1e-9)[:, None]
    return line + offset * np.column_stack([-mean[:, 1], mean[:, 0]])
