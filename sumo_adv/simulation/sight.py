"""Line of sight between boxes, past other boxes and buildings."""

from __future__ import annotations

import gzip
from collections.abc import Iterable, Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from sumo_adv.datatypes import Bools, Floats, VehicleState
from sumo_adv.geometry import crosses_box

BUILDING = "building"  # types of SUMO's polygons that begin with it are buildings, as polyconvert names them


def read_buildings(files: Iterable[Path]) -> tuple[Floats, ...]:
    """Outlines ``(n, 2)`` [m] of the buildings in SUMO's additional files: polygons with a type ``building...``.

    Polygons in degrees (``geo``) are left out.
    """
    outlines = []
    for file in files:
        with gzip.open(file, "rb") if file.suffix == ".gz" else file.open("rb") as stream:
            for _, element in ElementTree.iterparse(stream):
                if element.tag != "poly" or not element.get("type", "").startswith(BUILDING):
                    continue
                if element.get("geo", "false") in ("true", "1"):
                    continue
                points = [tuple(map(float, p.split(",")[:2])) for p in element.get("shape", "").split()]
                if len(points) > 2:
                    outlines.append(np.array(points))
    return tuple(outlines)


class Sight:
    """What can be seen past buildings with outlines ``(n, 2)`` [m]."""

    def __init__(self, buildings: Sequence[Floats] = ()) -> None:
        from shapely import Polygon, STRtree

        self._tree = STRtree([Polygon(outline) for outline in buildings]) if len(buildings) else None

    def visible(self, eye: tuple[float, float], boxes: Sequence[VehicleState]) -> Bools:
        """Whether each box is seen from the point ``eye``: its centre or one of its corners, past the other boxes."""
        if not boxes:
            return np.zeros(0, bool)
        targets = np.stack([_targets(box) for box in boxes])  # (n, 5, 2)
        blocked = np.zeros(targets.shape[:2], bool)
        for k, box in enumerate(boxes):
            half = (box.length / 2, box.width / 2)
            through = crosses_box(eye, (targets[..., 0], targets[..., 1]), (box.x, box.y, box.heading), half)
            through[k] = False
            blocked |= through
        if self._tree is not None:
            from shapely import linestrings

            lines = linestrings(np.stack([np.broadcast_to(eye, targets.shape), targets], axis=2).reshape(-1, 2, 2))
            hit = self._tree.query(lines, predicate="intersects")[0]
            blocked.reshape(-1)[hit] = True
        return np.asarray(~blocked.all(axis=1))


def _targets(box: VehicleState) -> Floats:
    """Centre and corners, ``(5, 2)``."""
    c, s = np.cos(box.heading), np.sin(box.heading)
    local = np.array([(0, 0), (1, 1), (1, -1), (-1, -1), (-1, 1)]) * (box.length / 2, box.width / 2)
    return np.asarray(local @ np.array([[c, s], [-s, c]]) + (box.x, box.y))
