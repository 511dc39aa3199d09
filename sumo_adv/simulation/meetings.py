"""Where the ways over a junction meet: places at which two of them cross or join, and which of them gives way there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.geometry import along
from sumo_adv.simulation.network import Connection, RoadMap

Link = tuple[str, int]
"""A junction's id and the index of a way over it, as in the network's ``request`` elements."""


@dataclass(frozen=True, slots=True)
class Meeting:
    """A place where a way over a junction meets another.

    other: the other way. lane: its lane there. at, other_at: metres from the beginning of the two ways, which is their
    stop line. x, y [m]. joins: both end in the same lane, else they cross. yields: signs have the first give way.
    """

    other: Link
    lane: str
    at: float
    other_at: float
    x: float
    y: float
    joins: bool
    yields: bool


class Meetings:
    """All meetings of a network. Each way's are worked out when they are first asked for."""

    def __init__(self, road: RoadMap) -> None:
        self._road = road
        self.ways: dict[Link, Connection] = {}
        self.link_of: dict[str, Link] = {}  # lane of a junction -> its way
        self._at: dict[str, list[Link]] = {}
        self._found: dict[Link, tuple[Meeting, ...]] = {}
        self._lines: dict[Link, Floats] = {}
        for lane in road.lanes.values():
            for connection in () if lane.internal else lane.connections:
                if connection.link[1] < 0 or connection.link in self.ways:
                    continue
                self.ways[connection.link] = connection
                self._at.setdefault(connection.link[0], []).append(connection.link)
                self.link_of.update(dict.fromkeys(connection.via, connection.link))

    def line(self, link: Link) -> Floats:
        """The centreline of a way over a junction, ``(n, 2)``."""
        if link not in self._lines:
            self._lines[link] = np.vstack([self._road.lanes[n].shape for n in self.ways[link].via])
        return self._lines[link]

    def of(self, link: Link) -> tuple[Meeting, ...]:
        """The meetings on a way, in its direction. None with ways that begin in the same lane: they part."""
        if link not in self._found:
            others = (crossed for crossed in self._at.get(link[0], ()) if crossed != link)
            meetings = [m for crossed in others for m in self._between(link, crossed)]
            self._found[link] = tuple(sorted(meetings, key=lambda m: m.at))
        return self._found[link]

    def _between(self, mine: Link, other: Link) -> Iterator[Meeting]:
        """The first place where two ways meet, if they do."""
        from shapely import LineString

        way, other_way = self.ways[mine], self.ways[other]
        a, b = self.line(mine), self.line(other)
        if np.hypot(*(a[0] - b[0])) < 0.1:
            return
        joins = way.to == other_way.to
        if joins:
            x, y = a[-1]
        else:
            points = _points(LineString(a).intersection(LineString(b)))
            if not points:
                return
            x, y = min(points, key=lambda p: float(along(a, *p)))
        at, other_at = float(along(a, x, y)), float(along(b, x, y))
        lane = min(other_way.via, key=lambda n: _distance(self._road.lanes[n].shape, x, y))
        yield Meeting(other, lane, at, other_at, float(x), float(y), joins, other[1] in way.yields_to)


def _points(shape: Any) -> list[tuple[float, float]]:
    """Where two lines meet; of a stretch that they share, its ends."""
    return [(float(p[0]), float(p[1])) for part in getattr(shape, "geoms", [shape]) for p in part.coords]


def _distance(shape: Floats, x: float, y: float) -> float:
    from shapely import LineString, Point

    return float(LineString(shape).distance(Point(x, y)))
