"""Links between the lanes of a network, and lanes with numbers as exports and CommonRoad need them."""

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
MIN_OPPOSITE_TURN_RAD = 2.6  # between the directions of two opposite lanes
MAX_OPPOSITE_GAP_M = 0.5  # between the boundaries of two lanes that share a centre line
MAX_OPPOSITE_LENGTH_DIFFERENCE_M = 10.0  # between two such lanes; in a bend, the outer one is longer


class Linked(Protocol):
    """An object with a lane's links as lane ids; see ``LaneLinks``."""

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
        successors: The lanes that follow this lane. On junctions, they are the junction's internal lanes.
        predecessors: The lanes that lead to this lane.
        left: The next lane of the same edge to the left; None if there is none.
        right: The next lane of the same edge to the right; None if there is none.
        opposite_left: The lane of the opposite direction that shares the left boundary; None if there is none.
        opposite_right: The lane of the opposite direction that shares the right boundary, as in left-hand traffic; None
            if there is none.
    """

    successors: tuple[str, ...]
    predecessors: tuple[str, ...]
    left: str | None
    right: str | None
    opposite_left: str | None
    opposite_right: str | None


class LaneGraph:
    """The links of a network's lanes. A lane's links are computed at the first request and kept."""

    def __init__(self, road: RoadMap) -> None:
        """Begin without links.

        Args:
            road: The network.
        """
        self._road = road
        self._links: dict[str, LaneLinks] = {}
        self._across: dict[str, NetworkLane | None] = {}

    def links(self, lane: NetworkLane) -> LaneLinks:
        """Return the links of one of the network's lanes."""
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
        """Find the lane of the opposite direction that shares a lane's inner boundary. The relation is mutual."""
        other = self._lane_across(lane)
        return other.id if other is not None and self._lane_across(other) is lane else None

    def _lane_across(self, lane: NetworkLane) -> NetworkLane | None:
        if lane.id not in self._across:
            self._across[lane.id] = self._find_across(lane)
        return self._across[lane.id]

    def _find_across(self, lane: NetworkLane) -> NetworkLane | None:
        """Find the opposite lane that touches the inner boundary of a lane at the lane's middle."""
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
        """Return whether no lane of its edge lies between a lane and the centre line; junctions have no centre line."""
        return not lane.internal and self._road.edges[lane.edge][-1 if self._road.hand > 0 else 0] == lane.id


@dataclass(frozen=True, slots=True)
class NumberedLane:
    """A lane with a number. Its links are numbers of lanes, or None if there is no such lane or it has no number.

    Attributes:
        number: The number of the lane.
        left: The left boundary in the direction of travel [m], ``(n, 2)``.
        right: The right boundary in the direction of travel [m], ``(n, 2)``.
        entries: The lanes that lead to this lane.
        exits: The lanes that follow this lane.
        beside_left: The adjacent lane to the left that leads the same way; None within junctions.
        beside_right: The adjacent lane to the right that leads the same way; None within junctions.
        opposite_left: The lane of the opposite direction at the left boundary; None within junctions.
        opposite_right: The lane of the opposite direction at the right boundary; None within junctions.
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
    """Give a lane a number, and link it to the other lanes that have one.

    Args:
        number: The number of the lane.
        centre: The centreline ``(n, 2)`` [m].
        width: The width of the lane [m].
        junction: Whether the lane is within a junction. Such a lane has no adjacent lanes.
        links: The links of the lane, as lane ids.
        numbers: The numbers of lanes by id.
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
    """Shift a line to the left. Each vertex moves along the mean normal of its segments.

    Args:
        line: The points ``(n, 2)`` [m].
        offset: The distance to the left [m].
    """
    along = np.diff(line, axis=0)
    along = along / np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)[:, None]
    mean = np.concatenate([along[:1], along[:-1] + along[1:], along[-1:]])
    mean = mean / np.maximum(np.hypot(mean[:, 0], mean[:, 1]), 1e-9)[:, None]
    return line + offset * np.column_stack([-mean[:, 1], mean[:, 0]])
