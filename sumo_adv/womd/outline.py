"""The outline of a road that is given as areas, as the dataset draws road edges: the road is to the left of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats

SEAM = 0.2  # m, gaps between areas that are no gaps of the road


def road_outline(areas: Sequence[Any]) -> list[Floats]:
    """Closed lines ``(n, 2)`` [m] around the union of shapely polygons."""
    from shapely import get_parts, union_all

    ground = union_all([area.buffer(SEAM) for area in areas]).buffer(-SEAM)
    lines = []
    for part in get_parts(ground):
        outer = part.exterior if part.exterior.is_ccw else part.exterior.reverse()
        inner = (ring.reverse() if ring.is_ccw else ring for ring in part.interiors)
        lines += [np.asarray(ring.coords, np.float64)[:, :2] for ring in (outer, *inner)]
    return lines
