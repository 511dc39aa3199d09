"""Which links of a junction are in each other's way, from their shapes.

SUMO knows of a conflict inside a junction only where two lines cross. Two that pass each other nearer than vehicles can
are therefore bent until they do, each by half of what is missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.womd.network.polyline import SAME, at, stations
from sumo_adv.womd.network.roads import Link

if TYPE_CHECKING:
    from shapely import LineString

CLOSE = 0.8  # m between the lines of two links that are in each other's way without crossing
BEND = 4.0  # m before and after the nearest place over which a line is bent
END = 1.0  # m from its end where a line is not bent
MOST_BENT = 0.45  # m that one line is bent
OVER = 0.05  # m by which bent lines reach over each other
OVERPASS = 3.0  # m of height that keep two links apart


def find_foes(links: Sequence[Link]) -> set[tuple[int, int]]:
    """Pairs (i, j), i < j, of links of one junction that merge, cross or come too close; never two from one lane."""
    from shapely import STRtree, linestrings

    if not links:
        return set()
    lines = [linestrings(link.shape) for link in links]
    pairs = STRtree(lines).query(lines, predicate="dwithin", distance=CLOSE).T
    foes = set()
    for i, j in pairs[pairs[:, 0] < pairs[:, 1]].tolist():
        a, b = links[i], links[j]
        if a.junction != b.junction or (a.source, a.from_lane) == (b.source, b.from_lane):
            continue
        if (a.target, a.to_lane) == (b.target, b.to_lane) or not _apart(a, b):
            foes.add((i, j))
    return foes


def _apart(a: Link, b: Link) -> bool:
    """Whether one passes over the other."""
    if abs(float(np.mean(a.heights)) - float(np.mean(b.heights))) < OVERPASS / 2:
        return False
    distance = np.hypot(a.shape[:, None, 0] - b.shape[None, :, 0], a.shape[:, None, 1] - b.shape[None, :, 1])
    i, j = np.unravel_index(int(np.argmin(distance)), distance.shape)
    return abs(float(a.heights[i] - b.heights[j])) >= OVERPASS


def bend_together(links: Sequence[Link], foes: set[tuple[int, int]]) -> tuple[tuple[Link, ...], int]:
    """The links, with those bent that pass a foe closely without crossing it on the way; and how many such pairs."""
    from shapely import LineString
    from shapely.ops import substring

    bent, pairs = list(links), 0
    for i, j in sorted(foes):
        a, b = bent[i], bent[j]
        if (a.target, a.to_lane) == (b.target, b.to_lane):
            continue
        lines = LineString(a.shape), LineString(b.shape)
        if lines[0].intersects(lines[1]):
            continue
        nearest_at, missing = _nearest(lines, [substring(line, END, line.length - END) for line in lines])
        if np.hypot(*missing) > 2.0 * MOST_BENT:
            nearest_at, missing = _nearest(lines, lines)
        midway = [END - SAME <= w <= line.length - END + SAME for w, line in zip(nearest_at, lines, strict=True)]
        if not any(midway) or (not all(midway) and np.hypot(*missing) > MOST_BENT):
            continue
        share = 1.0 / sum(midway)
        if midway[0]:
            bent[i] = _bend(a, nearest_at[0], share * missing)
        if midway[1]:
            bent[j] = _bend(b, nearest_at[1], -share * missing)
        pairs += 1
    return tuple(bent), pairs


def _nearest(lines: Sequence[LineString], parts: Sequence[LineString]) -> tuple[list[float], Floats]:
    """Where parts of two lines are nearest, as stations on the lines [m], and what the first lacks to cross the second
    there [m]."""
    from shapely.ops import nearest_points

    ends = nearest_points(*parts)
    nearest_at = [float(line.project(end)) for line, end in zip(lines, ends, strict=True)]
    gap = np.array([ends[1].x - ends[0].x, ends[1].y - ends[0].y])
    return nearest_at, gap * (1.0 + OVER / max(float(np.hypot(*gap)), 1e-6))


def _bend(link: Link, station: float, way: Floats) -> Link:
    """The link moved by ``way`` [m] at station ``where``, less and less to both sides, its ends kept."""
    along = stations(link.shape)
    reach = min(BEND, station, float(along[-1]) - station)
    extra = station + reach * np.linspace(-1.0, 1.0, 17)
    every = np.unique(np.concatenate([along, extra]))
    weight = 0.5 + 0.5 * np.cos(np.pi * np.clip((every - station) / reach, -1.0, 1.0))
    shape = at(link.shape, along, every) + weight[:, None] * way
    return replace(link, shape=shape, heights=np.interp(every, along, link.heights))
