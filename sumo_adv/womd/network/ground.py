"""Find the ground that vehicles may drive on from the map's road edges and driveways.

A road edge of the dataset has the road on its left: 99.8 % of the lane points of 58 records lie to the left of their
nearest edge. A place near a lane is therefore road if it lies to the left of the nearest road edge. The dataset's own
metrics distinguish on-road from off-road in this way (``compute_distance_to_road_edge`` of the Waymo Open Dataset).
Lanes count as road as far as the next edge beside them, because edges are missing in places, and an overpass has other
edges. Driveways always count.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.womd.network.roads import RoadNetwork
from sumo_adv.womd.record import Record

# From the middle of a lane: a lane, a bay of parked cars and a shoulder. Ground farther away does not count.
MAX_ROAD_HALF_WIDTH_M = 10.0
# An edge decides about places within this distance: as far as the middle of a wide junction.
EDGE_RELEVANCE_DISTANCE_M = 30.0
EDGE_MARGIN_M = 5.0  # edges up to this far outside the area are used, because the nearest edge decides about a place
# An edge is extended straight by this beyond its end; more than EDGE_RELEVANCE_DISTANCE_M.
EDGE_EXTENSION_M = 45.0
EDGE_POINT_SPACING_M = 1.0  # between the points of edges that have Voronoi cells
DRIVEWAY_MARGIN_M = 0.3  # by which a driveway is widened, because its polygon ends a little before the road edge
HALF_CRACK_WIDTH_M = 0.05  # half the width of the cracks that are closed
OUTLINE_TOLERANCE_M = 0.02  # error of the outline that is allowed to reduce its points
MIN_CENTRE_LINE_PART_M = 0.01  # minimum length of its centre line that a part of a lane must contain


def drivable_ground(record: Record, roads: RoadNetwork) -> Any:
    """Return the drivable area of a record.

    Args:
        record: The record.
        roads: Its network.

    Returns:
        Shapely polygons [m]; None if the record has no road edge or no lane for cars.
    """
    from shapely import LineString, MultiPolygon, Polygon, make_valid, union_all

    edges = [line.points[:, :2] for line in record.lines.values() if line.edge and len(line.points) > 1]
    lanes = [(lane.shape, lane.width) for edge in roads.edges.values() for lane in edge.lanes if not lane.bike]
    lanes += [(k.shape, k.width) for k in roads.links if not roads.edges[k.source].lanes[k.from_lane].bike]
    if not edges or not lanes:
        return None
    near = union_all([LineString(shape).simplify(0.2).buffer(MAX_ROAD_HALF_WIDTH_M, quad_segs=4) for shape, _ in lanes])
    driveways = [
        make_valid(Polygon(area.points[:, :2])).buffer(DRIVEWAY_MARGIN_M)
        for area in record.areas if area.kind == "driveway" and len(area.points) > 2
    ]  # fmt: skip
    ground = union_all([left_of_edges(edges, near), *_lane_ground(lanes, edges), *driveways])
    ground = (
        ground.buffer(HALF_CRACK_WIDTH_M, join_style="mitre")
        .buffer(-HALF_CRACK_WIDTH_M, join_style="mitre")
        .simplify(OUTLINE_TOLERANCE_M)
    )
    return MultiPolygon([p for p in getattr(ground, "geoms", [ground]) if p.geom_type == "Polygon"])


def left_of_edges(edges: Sequence[Floats], near: Any) -> Any:
    """Return the part of a polygon that lies to the left of the nearest edge.

    Args:
        edges: The edges, each ``(n, 2)`` [m].
        near: The shapely polygon [m].

    Returns:
        The part, a shapely geometry [m].
    """
    import shapely

    lines = [shapely.LineString(edge) for edge in edges]
    close = [line for line in lines if bool(shapely.dwithin(line, near, EDGE_MARGIN_M))]
    if not close:
        return shapely.Polygon()
    near = near.intersection(
        shapely.union_all(shapely.buffer(shapely.simplify(close, 0.2), EDGE_RELEVANCE_DISTANCE_M, quad_segs=4))
    )
    owner, sites = _sites(close)
    cells = shapely.get_parts(shapely.voronoi_polygons(shapely.MultiPoint(sites), extend_to=near.envelope))
    cells = np.where(
        shapely.is_valid(cells), cells, shapely.buffer(cells, 0.0)
    )  # cells of evenly spaced points on a grid can be invalid
    site, cell = shapely.STRtree(cells).query(shapely.points(sites), predicate="intersects")
    whose = np.full(len(cells), -1)
    whose[cell] = owner[site]
    regions = [shapely.union_all(cells[whose == k]) for k in np.unique(whose)]
    cuts = [*shapely.boundary(regions), near.boundary, *close, *(_extended(line) for line in close)]
    faces = shapely.get_parts(shapely.polygonize(shapely.get_parts(shapely.union_all(cuts))))
    inside = shapely.point_on_surface(faces)
    segments = np.concatenate([np.stack([e[:-1], e[1:]], axis=1) for e in (np.asarray(c.coords) for c in close)])
    tree = shapely.STRtree(shapely.linestrings(segments))
    kept = near.contains(inside) & _on_the_left(inside, segments, tree)
    return shapely.union_all(faces[kept])


def _sites(lines: Sequence[Any]) -> tuple[Any, Floats]:
    """Return the line of each site ``(n,)``, and the sites ``(n, 2)``: points every ``EDGE_POINT_SPACING_M``."""
    from shapely import get_coordinates, segmentize

    coordinates, owner = get_coordinates(segmentize(lines, EDGE_POINT_SPACING_M), return_index=True)
    sites, first = np.unique(np.round(coordinates, 3), axis=0, return_index=True)
    return owner[first], sites


def _extended(line: Any) -> Any:
    """Extend an open line by ``EDGE_EXTENSION_M`` straight on from both ends, where the side changes as well."""
    from shapely import MultiLineString

    c = np.asarray(line.coords)
    ends = []
    for tip, inner in ((c[0], c[1]), (c[-1], c[-2])):
        out = (tip - inner) / max(float(np.hypot(*(tip - inner))), 1e-6)
        ends.append([tip, tip + EDGE_EXTENSION_M * out])
    return MultiLineString([] if line.is_closed else ends)


def _on_the_left(places: Any, segments: Floats, tree: Any) -> Bools:
    """Return whether each place lies to the left of its nearest segment ``(m, 2, 2)``.

    At a corner, two segments are equally near. The one from whose line the place is farther away decides.
    """
    from shapely import get_coordinates

    place, hit = tree.query_nearest(places)
    a, along = segments[hit, 0], segments[hit, 1] - segments[hit, 0]
    to = get_coordinates(places)[place] - a
    beside = (along[:, 0] * to[:, 1] - along[:, 1] * to[:, 0]) / np.maximum(np.hypot(*along.T), 1e-9)
    order = np.argsort(np.abs(beside), kind="stable")  # the farthest is written last
    left = np.zeros(len(places), bool)
    left[place[order]] = beside[order] > 0.0
    return left


def _lane_ground(lanes: Sequence[tuple[Floats, float]], edges: Sequence[Floats]) -> list[Any]:
    """Return each lane's strip, without what lies beyond an edge as seen from its centre line."""
    from shapely import LineString, STRtree, get_parts, intersection, length, polygonize, union_all

    centres = [LineString(shape) for shape, _ in lanes]
    strips = [line.buffer(width / 2, cap_style="flat") for line, (_, width) in zip(centres, lanes, strict=True)]
    borders = [LineString(edge) for edge in edges]
    crossed, by = STRtree(borders).query(strips, predicate="intersects")
    for k in np.unique(crossed):
        cuts = union_all([strips[k].boundary, *(borders[j] for j in by[crossed == k])])
        parts = get_parts(polygonize(get_parts(cuts)))
        held = length(intersection(intersection(parts, strips[k]), centres[k])) > MIN_CENTRE_LINE_PART_M
        strips[k] = union_all(intersection(parts[held], strips[k]))
    return strips
