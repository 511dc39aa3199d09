"""The drivable area: where a vehicle can be without having left the road.

A network may carry its area, as SUMO's generic parameter ``drivable`` of a junction. The value describes polygons in
the network's coordinates. The area is therefore part of every copy of the file, and is the same for every reader. The
area of a network without the parameter is that of its lanes and junctions (``RoadMap.drivable``).

    <param key="drivable" value="0,0 50,0 50,7 0,7|10,3 20,3 20,4 10,4;60,0 90,0 90,7 60,7"/>

``;`` separates polygons. The first ring of a polygon is its outline. The rings after ``|`` are holes.
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
    """A part of the carriageway with its height.

    Attributes:
        area: A shapely polygon [m].
        line: A line ``(n, 3)`` [m]; the height at a point is that of the line where it is nearest. A line ``(n, 2)``
            means height 0.
    """

    area: Any
    line: Floats

    def height(self, x: Floats, y: Floats) -> Floats:
        """Return the heights at points [m].

        Args:
            x: x of the points [m], of any shape.
            y: y of the points [m], of the same shape.

        Returns:
            The heights [m], of the same shape.
        """
        if self.line.shape[1] < 3:
            return np.zeros(np.shape(x))
        plan = self.line[:, :2]
        return np.asarray(np.interp(along(plan, x, y), stations(*plan.T), self.line[:, 2]))


class Drivable:
    """Tests whether points lie on the carriageway. The test can be sent between processes.

    If points have heights, each must also be on the layer of the carriageway there: no vehicle leaves a bridge for the
    road below it.

    Attributes:
        area: The carriageway, a shapely geometry [m].
        surfaces: The parts of the area with heights; empty if roads have no heights.
    """

    def __init__(self, area: Any, surfaces: tuple[Surface, ...] = ()) -> None:
        """Prepare the test.

        Args:
            area: The carriageway, a shapely geometry [m].
            surfaces: The parts of the area with heights, if roads have heights.
        """
        from shapely import STRtree, prepare

        self.area, self.surfaces = area, surfaces
        self._tree = STRtree([surface.area for surface in surfaces]) if surfaces else None
        prepare(area)

    def __call__(self, x: Floats, y: Floats, z: Floats | None = None) -> Bools:
        """Return whether points lie on the carriageway.

        Args:
            x: x of the points [m], of any shape.
            y: y of the points [m], of the same shape.
            z: Heights of the points [m], of the same shape; None ignores layers.

        Returns:
            The results, of the same shape.
        """
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
    """Return the parameter's value for an area of shapely polygons [m], to the centimetre."""
    return ";".join(
        "|".join(_ring_text(ring) for ring in (polygon.exterior, *polygon.interiors))
        for polygon in getattr(area, "geoms", [area])
    )


def _ring_text(ring: Any) -> str:
    return " ".join(f"{x:.2f},{y:.2f}" for x, y in list(ring.coords)[:-1])


def area_of(texts: Iterable[str]) -> Any:
    """Return the area that values of the parameter describe.

    Args:
        texts: The values.

    Returns:
        A shapely geometry [m]; None if there are no values.

    Raises:
        ValueError: A value holds something else than rings of at least three points.
    """
    from shapely import Polygon, make_valid, union_all

    polygons = []
    for text in texts:
        for polygon in text.split(";"):
            outline, *holes = ([[float(v) for v in p.split(",")] for p in ring.split()] for ring in polygon.split("|"))
            polygons.append(make_valid(Polygon(outline, holes)))
    return union_all(polygons) if polygons else None
