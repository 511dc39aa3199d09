"""Derive the road near the action, and the paint on it, from the network's copy in a run's folder.

A network says little about paint, so these rules replace it:

between lanes of one direction   dashed if cars may change lanes over it from both sides (SUMO's ``changeLeft`` and
                                 ``changeRight``), otherwise solid
edges of a carriageway           solid
end of a lane                    a stop line at a traffic light or a stop sign; a dashed line if every way on gives way
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sumo_adv.datatypes import Floats, Track
from sumo_adv.geometry import stations
from sumo_adv.simulation.layers import covers
from sumo_adv.simulation.network import NetworkLane, RoadMap, read_network
from sumo_adv.simulation.scan import parse_xml

SOLID, DASHED = 0, 1
LINE_STOP, LINE_GIVE_WAY, LINE_LIGHT = 0, 1, 2
LINE_INSET_M = 0.15  # distance from the edge of a carriageway to the line beside it
STOP_LINE_SETBACK_M = 0.4  # distance from the end of a lane to the middle of its line
MUST_STOP, MUST_YIELD = "sw", "m"  # SUMO's letters of right of way

Changes = Mapping[str, tuple[bool, bool]]
"""By lane, whether passenger cars may leave it to the left and to the right. Missing lanes have no restriction."""
ROAD_RADIUS_M = 220.0  # the road is drawn this far around the vehicles' paths
SHAPE_TOLERANCE_M = 0.02  # maximum error of a line when points are left out
AREA_ROAD, AREA_JUNCTION, AREA_OTHER, AREA_GROUND = 0, 1, 2, 3


@dataclass(frozen=True, slots=True)
class DrawnMarking:
    """A line along the road.

    Attributes:
        line: The line ``(n, 2)`` [m].
        kind: ``SOLID`` or ``DASHED``.
    """

    line: Floats
    kind: int


@dataclass(frozen=True, slots=True)
class DrawnStopLine:
    """A line across a lane.

    Attributes:
        line: The line ``(2, 2)`` from the lane's right to its left side [m].
        kind: ``LINE_STOP``, ``LINE_GIVE_WAY`` or ``LINE_LIGHT``.
        light: The traffic light's id; '' without one.
        links: The positions of the lane's connections in the light's state, rightmost first.
    """

    line: Floats
    kind: int
    light: str = ""
    links: tuple[int, ...] = ()


@lru_cache(maxsize=4)
def lane_changes(path: Path) -> Changes:
    """Read which lanes of a network restrict lane changes.

    Args:
        path: The network.

    Returns:
        The restricted lanes. All other lanes have no restriction.

    Raises:
        UsageError: The network cannot be read.
    """
    changes: dict[str, tuple[bool, bool]] = {}

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag == "lane" and ("changeLeft" in attributes or "changeRight" in attributes):
            changes[attributes["id"]] = _allowed(attributes.get("changeLeft")), _allowed(attributes.get("changeRight"))

    parse_xml(path, start)
    return changes


def _allowed(classes: str | None) -> bool:
    """Return whether a list of vehicle classes includes passenger cars; a missing list includes all."""
    return classes is None or bool({"passenger", "all"} & set(classes.split()))


def markings_of(road: RoadMap, changes: Changes) -> Iterator[DrawnMarking]:
    """Yield the lines along all edges outside junctions, without the parts that another road covers.

    Args:
        road: The network.
        changes: The restrictions of lane changes.
    """
    for edge, marking in _markings(road, changes):
        if road.heights is None:
            yield marking
        else:
            yield from (replace(marking, line=line) for line in _uncovered(road, edge, marking.line))


def _uncovered(road: RoadMap, edge: str, line: Floats) -> Iterator[Floats]:
    """Yield the pieces of a line along an edge that no lane passes over."""
    own = stations(*line.T)
    station = np.union1d(own, np.arange(0.0, float(own[-1]), 1.0))
    points = np.column_stack([np.interp(station, own, values) for values in line.T])
    assert road.heights is not None
    z = np.asarray(road.heights.at(road.edges[edge][0], *points.T))
    covered = np.zeros(len(points), bool)
    for lane in road.lanes.values():
        covered |= covers(road.line(lane), lane.width, points[:, 0], points[:, 1], z)
    if not covered.any():
        yield line
        return
    for piece in np.split(np.arange(len(points)), np.flatnonzero(np.diff(covered)) + 1):
        if len(piece) > 1 and not covered[piece[0]]:
            yield points[piece]


def _markings(road: RoadMap, changes: Changes) -> Iterator[tuple[str, DrawnMarking]]:
    """Yield the lines along all edges outside junctions, with their edges."""
    for edge, names in road.edges.items():
        lanes = [road.lanes[name] for name in names if len(road.lanes[name].shape) > 1]
        driven = [lane for lane in lanes if lane.carriageway and not lane.internal]
        if not driven:
            continue
        yield edge, DrawnMarking(_beside(driven[0], LINE_INSET_M - driven[0].width / 2), SOLID)
        for right, left in pairwise(driven):
            both = changes.get(right.id, (True, True))[0] and changes.get(left.id, (True, True))[1]
            yield edge, DrawnMarking(_beside(right, right.width / 2), DASHED if both else SOLID)
        yield edge, DrawnMarking(_beside(driven[-1], driven[-1].width / 2 - LINE_INSET_M), SOLID)


def _beside(lane: NetworkLane, offset: float) -> Floats:
    """Return a line beside the middle of a lane; ``offset`` [m] is positive to the left."""
    from shapely import LineString

    moved = LineString(lane.shape).offset_curve(offset, join_style="mitre")
    points = np.asarray(moved.coords, float) if moved.geom_type == "LineString" else np.empty((0, 2))
    return points if len(points) > 1 else lane.shape  # the offset degenerates if a lane is shorter than wide


def stop_lines(road: RoadMap) -> Iterator[DrawnStopLine]:
    """Yield the lines across lanes at junctions."""
    for lane in road.lanes.values():
        onward = [c for c in lane.connections if c.movement != "u-turn"]
        if lane.internal or not lane.carriageway or not onward or len(lane.shape) < 2:
            continue
        lit = [c.light for c in onward if c.light[0]]
        if lit:
            yield DrawnStopLine(_across(lane), LINE_LIGHT, lit[0][0], tuple(k for _, k in lit))
        elif all(c.state in MUST_STOP for c in onward):
            yield DrawnStopLine(_across(lane), LINE_STOP)
        elif all(c.state in MUST_STOP + MUST_YIELD for c in onward):
            yield DrawnStopLine(_across(lane), LINE_GIVE_WAY)


def _across(lane: NetworkLane) -> Floats:
    end, before = lane.shape[-1], lane.shape[-2]
    forward = (end - before) / max(float(np.hypot(*(end - before))), 1e-9)
    left = np.array([-forward[1], forward[0]]) * (lane.width / 2 - 0.1)
    middle = end - STOP_LINE_SETBACK_M * forward
    return np.stack([middle - left, middle + left])


def lights_of(stops: Sequence[DrawnStopLine]) -> list[str]:
    """Return the ids of the traffic lights, sorted."""
    return sorted({stop.light for stop in stops if stop.light})


Along = TypeVar("Along", "DrawnStrip", DrawnMarking)
Line = TypeVar("Line", "DrawnStrip", DrawnMarking, DrawnStopLine)


@dataclass(frozen=True, slots=True)
class DrawnStrip:
    """A lane, or the outline of a junction.

    Attributes:
        line: The lane's centreline, or the outline ``(n, 2)`` [m].
        width: The lane's width [m]; 0 for an outline.
        kind: ``AREA_ROAD``, ``AREA_JUNCTION`` (a lane inside a junction), ``AREA_OTHER`` (a lane that is not for cars)
            or ``AREA_GROUND`` (the outline of a junction).
    """

    line: Floats
    width: float
    kind: int


@dataclass(frozen=True, slots=True)
class DrawnRoad:
    """The road that a page draws.

    Attributes:
        strips: The surface.
        markings: The lines along the road.
        stops: The lines across lanes.
    """

    strips: Sequence[DrawnStrip] = ()
    markings: Sequence[DrawnMarking] = ()
    stops: Sequence[DrawnStopLine] = ()


@lru_cache(maxsize=4)
def network(path: Path) -> RoadMap:
    """Read a network; the last four are cached, because the runs of a batch and the formats of a run share theirs.

    Args:
        path: The network.

    Returns:
        The network.

    Raises:
        UsageError: The network cannot be read.
    """
    return read_network(path)


def road_near(road: RoadMap, changes: Changes, tracks: Sequence[Track]) -> DrawnRoad:
    """Select lanes, junctions and lines within ``ROAD_RADIUS_M`` of the tracks' paths.

    Args:
        road: The network.
        changes: The restrictions of lane changes.
        tracks: The vehicles.

    Returns:
        What is drawn, upper lanes last.
    """
    from shapely import LineString, MultiPoint

    points = np.concatenate([np.column_stack([t.x, t.y])[:: max(1, len(t.x) // 100)] for t in tracks])
    path = LineString(points) if len(points) > 1 else MultiPoint(points)
    lanes = sorted((lane for lane in road.lanes.values() if len(lane.shape) > 1), key=road.top)
    strips = [
        DrawnStrip(
            lane.shape,
            lane.width,
            AREA_OTHER if not lane.carriageway else AREA_JUNCTION if lane.internal else AREA_ROAD,
        )
        for lane in lanes
    ]
    strips += [DrawnStrip(area, 0.0, AREA_GROUND) for area in road.junctions]
    return DrawnRoad(
        [_thinned(s) for s in _near(strips, path)], [_thinned(m) for m in _near(markings_of(road, changes), path)],
        _near(stop_lines(road), path),
    )  # fmt: skip


def _near(lines: Iterable[Line], path: Any) -> list[Line]:
    """Select the lines within ``ROAD_RADIUS_M`` of a path (a shapely geometry)."""
    from shapely import dwithin, linestrings

    every = list(lines)
    near = dwithin([linestrings(each.line) for each in every], path, ROAD_RADIUS_M)
    return [each for each, is_near in zip(every, near, strict=True) if is_near]


def _thinned(line: Along) -> Along:
    """Leave out points that a line does not need."""
    from shapely import linestrings, simplify

    return replace(line, line=np.asarray(simplify(linestrings(line.line), SHAPE_TOLERANCE_M).coords, float))
