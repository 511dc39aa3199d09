"""The drivable area: where a vehicle may be without having left the road.

A network may carry its area with it, as SUMO's generic parameter ``drivable`` of a junction: polygons in the network's
own coordinates. So it travels with every copy of the file, and whatever reads the network has the same area. A network
without it has the area of its lanes and junctions (``RoadMap.drivable``).

    <param key="drivable" value="0,0 50,0 50,7 0,7|10,3 20,3 20,4 10,4;60,0 90,0 90,7 60,7"/>

``;`` separates polygons. The first ring of a polygon is its outline, the rings after ``|`` are holes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.geometry import along, same_layer, stations

DRIVABLE_KEY = "drivable"


@dataclass(frozen=True, slots=True)
class Surface:
    """A part of the carriageway with a height. area: a shapely polygon [m]; line: ``(n, 3)`` [m], or ``(n, 2)`` at
    height 0: the height at a point is that of the line where it is nearest."""

    area: Any
    line: Floats

    def height(self, x: Floats, y: Floats) -> Floats:
        """The height [m] at points of any one shape."""
        if self.line.shape[1] < 3:
            return np.zeros(np.shape(x))
        plan = self.line[:, :2]
        return np.asarray(np.interp(along(plan, x, y), stations(*plan.T), self.line[:, 2]))


class Drivable:
    """A test of points (arrays of any one shape) for lying on the carriageway; can be sent between processes.

    With heights [m] a point must also be on the layer of the carriageway there: no vehicle leaves a bridge for the road
    below it.
    """

    def __init__(self, area: Any, surfaces: tuple[Surface, ...] = ()) -> None:
        """``surfaces``: the parts of the area, where roads have heights."""
        from shapely import STRtree, prepare

        self.area, self.surfaces = area, surfaces
        self._tree = STRtree([surface.area for surface in surfaces]) if surfaces else None
        prepare(area)

    def __call__(self, x: Floats, y: Floats, z: Floats | None = None) -> Bools:
        from shapely import contains_xy, points

        inside = np.asarray(contains_xy(self.area, x, y))
        if z is None or self._tree is None:
            return inside
        at, part = self._tree.query(points(np.ravel(x), np.ravel(y)), predicate="intersects")
        level = np.zeros(np.size(x), bool)
        for k in np.unique(part):
            those = at[part == k]
            height = self.surfaces[k].height(np.ravel(x)[those], np.ravel(y)[those])
            level[those] |= same_layer(height, np.ravel(z)[those])
        return np.asarray(inside & level.reshape(inside.shape))

    def __reduce__(self) -> tuple[type[Drivable], tuple[Any, tuple[Surface, ...]]]:
        return Drivable, (self.area, self.surfaces)


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
