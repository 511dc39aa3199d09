"""How wide each stretch is: from its centre to the painted line or road edge at either side."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.womd.network.polyline import at, headings
from sumo_adv.womd.network.rows import Row, Stretch
from sumo_adv.womd.network.strands import Strand
from sumo_adv.womd.record import LineFeature

REACH = 3.5  # m to a side that a line is looked for
PROBES = 5  # places along a stretch
DEFAULT = 3.4  # m
BIKE_DEFAULT = 1.5  # m
LEAST, MOST = 2.8, 5.0  # m
BIKE_LEAST, BIKE_MOST = 1.0, 2.5  # m
OVERPASS = 3.0  # m of height between a line and a lane that do not belong together


@dataclass(frozen=True, slots=True)
class Widths:
    """Width [m] of every stretch, and where it came from: boundaries, one side, neighbours, default (counts)."""

    width: dict[Stretch, float]
    sources: dict[str, int]

    def of(self, stretch: Stretch) -> float:
        """Width of a stretch [m]."""
        return self.width[stretch]


def find_widths(strands: tuple[Strand, ...], rows: Iterable[Row], lines: Iterable[LineFeature]) -> Widths:
    """Measure every stretch of every row."""
    rows = list(rows)
    stretches = [stretch for row in rows for stretch in row]
    centre, side = _probes(strands, stretches)
    sides = _distances(np.vstack([centre, centre]), np.vstack([side, -side]), lines)
    left, right = (part.reshape(-1, PROBES) for part in np.split(sides, 2))
    spacing = _spacings(strands, rows)
    width: dict[Stretch, float] = {}
    sources = {"both sides": 0, "one side": 0, "neighbours": 0, "default": 0}
    for k, stretch in enumerate(stretches):
        bike = strands[stretch.strand].bike
        value, source = _choose(left[k], right[k], spacing.get(stretch), BIKE_DEFAULT if bike else DEFAULT)
        low, high = (BIKE_LEAST, BIKE_MOST) if bike else (LEAST, MOST)
        width[stretch] = round(min(max(value, low), high), 2)
        sources[source] += 1
    return Widths(width, sources)


def _choose(left: Floats, right: Floats, spacing: float | None, default: float) -> tuple[float, str]:
    both = left + right
    if np.isfinite(both).any():
        return float(np.median(both[np.isfinite(both)])), "both sides"
    if spacing is not None:
        return spacing, "neighbours"
    finite = np.concatenate([left[np.isfinite(left)], right[np.isfinite(right)]])
    if len(finite):
        return 2 * float(np.median(finite)), "one side"
    return default, "default"


def _probes(strands: tuple[Strand, ...], stretches: list[Stretch]) -> tuple[Floats, Floats]:
    """Points ``(n, 3)`` on the centres and unit vectors ``(n, 2)`` to the left of each."""
    centres, sides = [], []
    for stretch in stretches:
        strand = strands[stretch.strand]
        places = stretch.start + (stretch.end - stretch.start) * (np.arange(PROBES) + 0.5) / PROBES
        centres.append(at(strand.points, strand.along, places))
        heading = headings(strand.points, strand.along, places)
        sides.append(np.stack([-np.sin(heading), np.cos(heading)], axis=-1))
    if not centres:
        return np.empty((0, 3)), np.empty((0, 2))
    return np.vstack(centres), np.vstack(sides)


def _distances(centre: Floats, side: Floats, lines: Iterable[LineFeature]) -> Floats:
    """Distance from each centre to the first line that crosses the ray to its side, inf if none within ``REACH``."""
    from shapely import STRtree, linestrings

    distances = np.full(len(centre), np.inf)
    pieces = [np.stack([line.points[:-1], line.points[1:]], axis=1) for line in lines if len(line.points) > 1]
    if not pieces or not len(centre):
        return distances
    segments = np.concatenate(pieces)
    rays = np.stack([centre[:, :2] + 0.2 * side, centre[:, :2] + REACH * side], axis=1)
    ray, hit = STRtree(linestrings(segments[:, :, :2])).query(linestrings(rays))
    p, d = centre[ray], side[ray]
    a, b = segments[hit, 0], segments[hit, 1]
    along = b[:, :2] - a[:, :2]
    cross = d[:, 0] * along[:, 1] - d[:, 1] * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        to = a[:, :2] - p[:, :2]
        t = (to[:, 0] * along[:, 1] - to[:, 1] * along[:, 0]) / cross
        u = (to[:, 0] * d[:, 1] - to[:, 1] * d[:, 0]) / cross
    good = (t > 0.2) & (t < REACH) & (u >= 0) & (u <= 1) & (np.abs(a[:, 2] - p[:, 2]) < OVERPASS)
    np.minimum.at(distances, ray[good], t[good])
    return distances


def _spacings(strands: tuple[Strand, ...], rows: Iterable[Row]) -> dict[Stretch, float]:
    """Mean distance between the middles of neighbours in a row."""
    spacings: dict[Stretch, list[float]] = {}
    for row in rows:
        middles = [_middle(strands[s.strand], s) for s in row]
        for right, left, p, q in zip(row, row[1:], middles, middles[1:], strict=False):
            distance = float(np.hypot(*(p - q)[:2]))
            spacings.setdefault(right, []).append(distance)
            spacings.setdefault(left, []).append(distance)
    return {stretch: float(np.mean(values)) for stretch, values in spacings.items()}


def _middle(strand: Strand, stretch: Stretch) -> Floats:
    return at(strand.points, strand.along, (stretch.start + stretch.end) / 2)
