"""The drivable area of converted records: road edges and driveways bound it, and the network carries it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import womd_samples as samples
from shapely import Polygon, box, contains_xy

from sumo_adv.errors import UsageError
from sumo_adv.simulation.drivable import area_of, area_text
from sumo_adv.simulation.network import Drivable, read_network
from sumo_adv.womd.network import convert_network
from sumo_adv.womd.network.ground import left_of_edges
from sumo_adv.womd.reader import parse_record

EAST, WEST = ((0.0, 1.0), (1.0, 0.0))  # shares of the road's 200 m at which a line begins and ends


def edge(message: Any, number: int, y: float, course: tuple[float, float], kind: int = 1) -> None:
    """A road edge over 200 m at ``y``; the road is on the left of its course."""
    made = message.map_features.add(id=number).road_edge
    made.type = kind
    for x, y_, z in samples.line(*((200.0 * share, y) for share in course)):
        made.polyline.add(x=x, y=y_, z=z)


def two_carriageways() -> Any:
    """One lane eastwards at y = 0 between edges at -3 and 2, one westwards at y = 8 between 6 and 10, a median between;
    a driveway of 6 m by 5 m to the south."""
    message = samples.empty("two_carriageways")
    samples.lane(message, 1, samples.line((0.0, 0.0), (200.0, 0.0)))
    samples.lane(message, 2, samples.line((200.0, 8.0), (0.0, 8.0)))
    edge(message, 11, -3.0, EAST)
    edge(message, 12, 2.0, WEST, kind=2)
    edge(message, 13, 6.0, EAST, kind=2)
    edge(message, 14, 10.0, WEST)
    driveway = message.map_features.add(id=21).driveway
    for x, y in ((50.0, -8.0), (56.0, -8.0), (56.0, -3.0), (50.0, -3.0)):
        driveway.polygon.add(x=x, y=y)
    samples.track(message, 1, samples.line((0.0, 0.0), (200.0, 0.0)), start=10.0, speed=10.0)
    return message


def converted(folder: Path, message: Any) -> Drivable:
    """The area that every part of the program takes from the converted network."""
    return read_network(convert_network(parse_record(message, "a test"), folder).path).drivable(100.0, 0.0, 50.0)


def inside(area: Drivable, *places: tuple[float, float]) -> list[bool]:
    x, y = np.array(places).T
    return area(x, y).tolist()


def test_the_road_reaches_to_its_edges_and_no_further(tmp_path: Path) -> None:
    """The lane's own strip ends at y = 1.7 at most; the shoulder to the south is 3 m wide and is road."""
    area = converted(tmp_path, two_carriageways())
    assert inside(area, (100.0, 1.9), (100.0, -2.9), (100.0, 6.1), (100.0, 9.9)) == [True] * 4
    assert inside(area, (100.0, 2.1), (100.0, -3.1), (100.0, 5.9), (100.0, 10.1)) == [False] * 4


def test_the_median_and_what_lies_beyond_a_boundary_are_outside(tmp_path: Path) -> None:
    area = converted(tmp_path, two_carriageways())
    assert inside(area, (20.0, 4.0), (180.0, 4.0), (100.0, 14.0), (100.0, -7.0)) == [False] * 4


def test_a_driveway_is_inside_although_it_is_beyond_the_edge(tmp_path: Path) -> None:
    area = converted(tmp_path, two_carriageways())
    assert inside(area, (53.0, -5.0), (53.0, -3.0), (48.0, -5.0), (53.0, -9.0)) == [True, True, False, False]


def test_the_lane_counts_where_the_edges_have_a_gap(tmp_path: Path) -> None:
    """Only the first 80 m of the road have edges: at 150 m the lane alone, with the width it was given, is road."""
    message = samples.empty("half")
    samples.lane(message, 1, samples.line((0.0, 0.0), (200.0, 0.0)))
    edge(message, 11, -3.0, (0.0, 0.4))
    edge(message, 12, 3.0, (0.4, 0.0))
    samples.track(message, 1, samples.line((0.0, 0.0), (200.0, 0.0)), start=10.0, speed=10.0)
    area = converted(tmp_path, message)
    assert inside(area, (40.0, 2.9), (40.0, 3.1), (150.0, 1.3), (150.0, 2.9)) == [True, False, True, False]


def test_a_record_without_edges_has_its_lanes_as_before(tmp_path: Path) -> None:
    road = read_network(convert_network(parse_record(samples.overpass(), "a test"), tmp_path).path)
    assert road.ground is None
    area = road.drivable(0.0, 0.0, 200.0)
    assert inside(area, (50.0, 0.0), (50.0, 1.6), (50.0, 2.0)) == [True, True, False]


def test_left_of_a_corner_is_the_road_around_it() -> None:
    """A kerb that comes from the west and turns north at the origin has the road on its left, to the north-west. The
    same kerb the other way has it on three sides of four."""
    kerb = np.array([(-20.0, 0.0), (0.0, 0.0), (0.0, 20.0)])
    around = box(-9.0, -9.0, 9.0, 9.0)
    assert left_of_edges([kerb], around).area == pytest.approx(9.0 * 9.0)
    right_side = left_of_edges([kerb[::-1]], around)
    assert right_side.area == pytest.approx(18.0 * 18.0 - 81.0)
    assert contains_xy(right_side, [5.0, 5.0, -5.0], [5.0, -5.0, -5.0]).all()


def test_an_area_is_read_as_it_was_written() -> None:
    """Two polygons, one with a hole: 100 - 4 m2 and 1 m2."""
    ring = Polygon([(0, 0), (10, 0), (10, 10), (0, 10)], [[(2, 2), (4, 2), (4, 4), (2, 4)]])
    text = area_text(ring.union(box(20.0, 0.0, 21.0, 1.0)))
    area = area_of([text])
    assert area.area == pytest.approx(97.0)
    assert contains_xy(area, [1.0, 3.0, 20.5], [1.0, 3.0, 0.5]).tolist() == [True, False, True]
    assert area_of([]) is None


def test_a_damaged_area_is_one_sentence(tmp_path: Path) -> None:
    path = convert_network(parse_record(two_carriageways(), "a test"), tmp_path).path
    path.write_text(path.read_text().replace('key="drivable" value="', 'key="drivable" value="x,y '))
    with pytest.raises(UsageError, match=r"drivable area in .* is damaged"):
        read_network(path)
