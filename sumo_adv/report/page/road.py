"""The road near the action, from the network's copy in a run's folder."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sumo_adv.datatypes import Floats, Track
from sumo_adv.report.page.markings import Changes, Marking, StopLine, markings_of, stop_lines
from sumo_adv.simulation.network import Lane, RoadMap, read_network

REACH = 220.0  # m around the ego's path
THINNED = 0.02  # m a lane's line may be off when points are left out
Along = TypeVar("Along", "Strip", Marking)
Line = TypeVar("Line", "Strip", Marking, StopLine)
ROAD, INSIDE, OTHER, AREA = 0, 1, 2, 3


@dataclass(frozen=True, slots=True)
class Strip:
    """A lane: centreline (n, 2) [m], width [m], kind: on a road, inside a junction, or not for cars.

    Or the outline of a junction, of kind ``AREA``.
    """

    line: Floats
    width: float
    kind: int


@dataclass(frozen=True, slots=True)
class RoadNear:
    """The road that a page draws: its surface, the lines along it and the lines across it."""

    strips: Sequence[Strip] = ()
    markings: Sequence[Marking] = ()
    stops: Sequence[StopLine] = ()


@lru_cache(maxsize=4)
def network(path: Path) -> RoadMap:
    """A network, the last few kept: the runs of a batch share theirs."""
    return read_network(path)


def road_near(road: RoadMap, changes: Changes, tracks: Sequence[Track]) -> RoadNear:
    """Lanes, junctions and lines within ``REACH`` of the tracks' paths."""
    from shapely import LineString, MultiPoint

    points = np.concatenate([np.column_stack([t.x, t.y])[:: max(1, len(t.x) // 100)] for t in tracks])
    path = LineString(points) if len(points) > 1 else MultiPoint(points)
    lanes = [lane for lane in road.lanes.values() if len(lane.shape) > 1]
    strips = [Strip(lane.shape, lane.width, _kind(lane)) for lane in lanes]
    strips += [Strip(area, 0.0, AREA) for area in road.junctions]
    return RoadNear(
        [_thinned(s) for s in _near(strips, path)], [_thinned(m) for m in _near(markings_of(road, changes), path)],
        _near(stop_lines(road), path),
    )  # fmt: skip


def _near(lines: Iterable[Line], path: Any) -> list[Line]:
    """Those within ``REACH`` of a path (a shapely geometry)."""
    from shapely import dwithin, linestrings

    every = list(lines)
    near = dwithin([linestrings(each.line) for each in every], path, REACH)
    return [each for each, is_near in zip(every, near, strict=True) if is_near]


def _kind(lane: Lane) -> int:
    if not lane.passenger:
        return OTHER
    return INSIDE if lane.internal else ROAD


def _thinned(line: Along) -> Along:
    from shapely import linestrings, simplify

    return replace(line, line=np.asarray(simplify(linestrings(line.line), THINNED).coords, float))
