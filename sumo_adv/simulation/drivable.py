"""The drivable area: where a vehicle may be without having left the road.

A network may carry its area with it, as SUMO's generic parameter ``drivable`` of a junction: polygons in the network's
own coordinates. So it travels with every copy of the file, and whatever reads the network has the same area. A network
without it has the area of its lanes and junctions (``RoadMap.drivable``).

    <param key="drivable" value="0,0 50,0 50,7 0,7|10,3 20,3 20,4 10,4;60,0 90,0 90,7 60,7"/>

``;`` separates polygons. The first ring of a polygon is its outline, the rings after ``|`` are holes.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from sumo_adv.datatypes import Bools, Floats

KEY = "drivable"


class Drivable:
    """A test of points (arrays of any one shape) for lying on the carriageway; can be sent between processes."""

    def __init__(self, area: Any) -> None:
        from shapely import prepare

        self.area = area
        prepare(area)

    def __call__(self, x: Floats, y: Floats) -> Bools:
        from shapely import contains_xy

        return np.asarray(contains_xy(self.area, x, y))

    def __reduce__(self) -> tuple[type[Drivable], tuple[Any]]:
        return Drivable, (self.area,)


def area_text(area: Any) -> str:
    """The parameter's value for shapely polygons [m], to the centimetre."""
    return ";".join(
        "|".join(_ring_text(ring) for ring in (polygon.exterior, *polygon.interiors))
        for polygon in getattr(area, "geoms", [area])
    )


def _ring_text(ring: Any) -> str:
    return " ".join(f"{x:.2f},{y:.2f}" for x, y in list(ring.coords)[:-1])


def area_of(texts: Iterable[str]) -> Any:
    """The shapely polygons [m] that parameters' values describe; None if there is no value. Raises ValueError: a value
    holds something else than rings of at least three points."""
    from shapely import Polygon, make_valid, union_all

    polygons = []
    for text in texts:
        for polygon in text.split(";"):
            outline, *holes = ([[float(v) for v in p.split(",")] for p in ring.split()] for ring in polygon.split("|"))
            polygons.append(make_valid(Polygon(outline, holes)))
    return union_all(polygons) if polygons else None
