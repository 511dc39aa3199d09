"""The road near the action, from the network's copy in a run's folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from sumo_adv.datatypes import Floats, Track
from sumo_adv.simulation.network import Lane, RoadMap, read_network

REACH = 220.0  # m around the ego's path
THINNED = 0.02  # m a lane's line may be off when points are left out
ROAD, INSIDE, OTHER, AREA = 0, 1, 2, 3


@dataclass(frozen=True, slots=True)
class Strip:
    """A lane: centreline (n, 2) [m], width [m], kind: on a road, inside a junction, or not for cars.

    Or the outline of a junction, of kind ``AREA``.
    """

    line: Floats
    width: float
    kind: int


@lru_cache(maxsize=4)
def network(path: Path) -> RoadMap:
    """A network, the last few kept: the runs of a batch share theirs."""
    return read_network(path)


def strips_near(road: RoadMap, tracks: Sequence[Track]) -> list[Strip]:
    """Lanes and junctions within ``REACH`` of the tracks' paths."""
    from shapely import LineString, MultiPoint, dwithin, linestrings

    points = np.concatenate([np.column_stack([t.x, t.y])[:: max(1, len(t.x) // 100)] for t in tracks])
    path = LineString(points) if len(points) > 1 else MultiPoint(points)
    lanes = [lane for lane in road.lanes.values() if len(lane.shape) > 1]
    strips = [Strip(lane.shape, lane.width, _kind(lane)) for lane in lanes]
    strips += [Strip(area, 0.0, AREA) for area in road.junctions]
    near = dwithin([linestrings(s.line) for s in strips], path, REACH)
    return [_thinned(s) for s, is_near in zip(strips, near, strict=True) if is_near]


def _kind(lane: Lane) -> int:
    if not lane.passenger:
        return OTHER
    return INSIDE if lane.internal else ROAD


def _thinned(strip: Strip) -> Strip:
    from shapely import linestrings, simplify

    return replace(strip, line=np.asarray(simplify(linestrings(strip.line), THINNED).coords, float))
