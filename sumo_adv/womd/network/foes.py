"""Which links of a junction are in each other's way, from their shapes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sumo_adv.womd.network.roads import Link

CLOSE = 0.8  # m between the lines of two links that are in each other's way without crossing
OVERPASS = 3.0  # m of height that keep two links apart


def find_foes(links: Sequence[Link]) -> set[tuple[int, int]]:
    """Pairs (i, j), i < j, of links of one junction that merge, cross or come too close; never two from one lane."""
    from shapely import STRtree, linestrings

    if not links:
        return set()
    lines = [linestrings(link.shape) for link in links]
    pairs = STRtree(lines).query(lines, predicate="dwithin", distance=CLOSE).T
    found = set()
    for i, j in pairs[pairs[:, 0] < pairs[:, 1]].tolist():
        a, b = links[i], links[j]
        if a.junction != b.junction or (a.source, a.from_lane) == (b.source, b.from_lane):
            continue
        if (a.target, a.to_lane) == (b.target, b.to_lane) or not _apart(a, b):
            found.add((i, j))
    return found


def _apart(a: Link, b: Link) -> bool:
    """Whether one passes over the other."""
    if abs(float(np.mean(a.heights)) - float(np.mean(b.heights))) < OVERPASS / 2:
        return False
    distance = np.hypot(a.shape[:, None, 0] - b.shape[None, :, 0], a.shape[:, None, 1] - b.shape[None, :, 1])
    i, j = np.unravel_index(int(np.argmin(distance)), distance.shape)
    return abs(float(a.heights[i] - b.heights[j])) >= OVERPASS
