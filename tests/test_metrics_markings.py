"""Which markings are crossed, on roads drawn by hand: lanes 3.2 m wide, eastbound ones south of westbound ones."""

from __future__ import annotations

import numpy as np
import pytest
from metrics_tracks import TIME, car

from sumo_adv.datatypes import Bools, Floats, LaneStrip, Track
from sumo_adv.metrics.markings import Marking, markings_crossed


def lane(y: float, *, start: float = 0.0, end: float = 200.0, west: bool = False, internal: bool = False) -> LaneStrip:
    """A straight lane along x with its centre line at ``y``."""
    points = np.array([[start, y], [end, y]])
    return LaneStrip(points[::-1] if west else points, 3.2, internal)


TWO_WAY = (lane(-4.8), lane(-1.6), lane(1.6, west=True))


def sideways(path: list[tuple[float, float]]) -> Track:
    """Along +x at 10 m/s through (time, y) points, straight between them."""
    y = np.interp(TIME, [p[0] for p in path], [p[1] for p in path])
    return car("adversary", 10.0 + 10.0 * TIME, y, 10.0, np.arctan2(np.gradient(y, TIME), 10.0))


def between_kerbs(x: Floats, y: Floats) -> Bools:
    return np.asarray((y > -6.4) & (y < 3.2))


def test_staying_in_the_lane_crosses_nothing() -> None:
    assert markings_crossed(sideways([(0, -4.8), (12, -3.3)]), TWO_WAY, between_kerbs) == []


def test_a_lane_change_crosses_one_broken_line() -> None:
    """From y = -4.8 at 1.6 m/s from 2 s on: at the line, y = -3.2, at 3 s; the step past it is at 3.1 s."""
    crossed = markings_crossed(sideways([(0, -4.8), (2, -4.8), (4, -1.6), (12, -1.6)]), TWO_WAY)
    assert [(c.time, c.kind) for c in crossed] == [(pytest.approx(3.0, abs=0.11), Marking.LANE_LINE)]


def test_out_over_the_centre_line_and_back_are_two_crossings() -> None:
    crossed = markings_crossed(sideways([(0, -1.6), (2, -1.6), (4, 1.6), (6, 1.6), (8, -1.6), (12, -1.6)]), TWO_WAY)
    assert [c.kind for c in crossed] == [Marking.CENTRE_LINE] * 2
    assert [c.time for c in crossed] == [pytest.approx(3.0, abs=0.11), pytest.approx(7.0, abs=0.11)]


def test_off_the_carriageway_is_an_edge_once() -> None:
    """Over y = -6.4 at 3 s, back on the road at 9 s: one edge, and no line on the way back."""
    track = sideways([(0, -4.8), (2, -4.8), (4, -8.0), (8, -8.0), (10, -4.8), (12, -4.8)])
    assert [c.kind for c in markings_crossed(track, TWO_WAY, between_kerbs)] == [Marking.ROAD_EDGE]
    assert markings_crossed(track, TWO_WAY) == []


def test_driving_on_into_the_next_lane_crosses_nothing() -> None:
    """A road in two edges, 0 to 50 m and 50 to 200 m; then the same with 20 m of junction between."""
    straight = sideways([(0, -1.6), (12, -1.6)])
    assert markings_crossed(straight, [lane(-1.6, end=50.0), lane(-1.6, start=50.0)]) == []
    through = [lane(-1.6, end=40.0), lane(-1.6, start=40.0, end=60.0, internal=True), lane(-4.8, start=60.0)]
    wander = sideways([(0, -1.6), (3, -1.6), (5, -4.8), (12, -4.8)])
    assert markings_crossed(wander, through) == []


def test_coming_back_from_between_the_lanes_is_no_crossing() -> None:
    """A gap of 1 m between the directions: into it and back crosses nothing, across it the centre line."""
    road = (lane(-1.6), lane(2.6, west=True))
    assert markings_crossed(sideways([(0, -1.6), (3, 0.5), (6, -1.6), (12, -1.6)]), road) == []
    across = markings_crossed(sideways([(0, -1.6), (6, 2.6), (12, 2.6)]), road)
    assert [c.kind for c in across] == [Marking.CENTRE_LINE]


def test_without_lanes_there_are_no_markings() -> None:
    assert markings_crossed(sideways([(0, 0), (12, 9)]), []) == []
    edge = markings_crossed(sideways([(0, 0), (12, 9)]), [], between_kerbs)
    assert [c.kind for c in edge] == [Marking.ROAD_EDGE]
    assert edge[0].time == pytest.approx(4.3, abs=0.11)  # y = 3.2
