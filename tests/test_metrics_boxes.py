"""Boxes: overlap, distance, swept contact, against hand figures and against brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from metrics_tracks import TIME, car, cruise

from sumo_adv.datatypes import Boxes, Floats
from sumo_adv.geometry import wrap_below_pi
from sumo_adv.metrics.boxes import (
    at_time,
    between_steps,
    corners,
    first_contact,
    gap,
    on_grid,
    overlaps,
    separation,
    sweep,
)


def box(x: float, y: float, heading: float = 0.0, length: float = 5.0, width: float = 2.0) -> Boxes:
    return Boxes(np.asarray(x), np.asarray(y), np.asarray(heading), np.asarray(0.0), length, width)


def clouds(seed: int, n: int, steps: int) -> tuple[Boxes, Boxes]:
    """Two sets of boxes that wander near one another."""
    r = np.random.default_rng(seed)

    def wandering() -> Boxes:
        x, y = (r.uniform(-12, 12, (n, 1)) + np.cumsum(r.uniform(-2, 2, (n, steps)), 1) for _ in "xy")
        heading = r.uniform(-3, 3, (n, 1)) + np.cumsum(r.uniform(-0.2, 0.2, (n, steps)), 1)
        return Boxes(x, y, heading, np.zeros((n, steps)), r.uniform(0.6, 12, (n, 1)), r.uniform(0.4, 3, (n, 1)))

    return wandering(), wandering()


def between(b: Boxes, part: Floats) -> Boxes:
    """Poses inside every interval, linear as the sweep defines them; a new last axis."""
    x, y = (v[..., :-1, None] + part * np.diff(v)[..., None] for v in (b.x, b.y))
    heading = b.heading[..., :-1, None] + part * wrap_below_pi(np.diff(b.heading))[..., None]
    sizes = [np.asarray(v)[..., None] for v in (b.length, b.width)]
    return Boxes(x, y, heading, np.zeros_like(x), sizes[0], sizes[1])


def test_a_box_within_a_step_is_on_the_line_between_its_ends_and_turns_the_shorter_way() -> None:
    """From (0, 0) heading 3.0 to (4, 2) heading -3.0, which is 0.283 rad further; a quarter of the way there."""
    boxes = Boxes(
        np.array([[0.0, 4.0]]), np.array([[0.0, 2.0]]), np.array([[3.0, -3.0]]), np.array([[8.0, 4.0]]), 5.0, 2.0
    )
    at = between_steps(boxes, np.array([1]), np.array([0.25]))
    assert (at.x[0], at.y[0], at.speed[0]) == (1.0, 0.5, 7.0)
    assert at.heading[0] == pytest.approx(3.0 + (2 * np.pi - 6.0) / 4)
    assert between_steps(boxes, np.array([0]), np.array([0.25])).x[0] == 0.0


def test_corners_run_counter_clockwise_from_front_left() -> None:
    north = corners(box(10, 0, np.pi / 2))
    assert north == pytest.approx(np.array([[9, 2.5], [9, -2.5], [11, -2.5], [11, 2.5]]))


def test_boxes_that_touch_overlap_and_a_millimetre_apart_do_not() -> None:
    assert overlaps(box(0, 0), box(5, 0))
    assert not overlaps(box(0, 0), box(5.001, 0))
    assert overlaps(box(0, 0), box(3.5, 0, np.pi / 2))  # 2.5 + 1
    assert not overlaps(box(0, 0), box(3.501, 0, np.pi / 2))


def test_sumo_s_false_positives_are_apart_and_its_misses_overlap() -> None:
    """Perpendicular 2 m apart and side by side 0.15 m apart are not; a perpendicular overlap is."""
    assert gap(box(0, 0), box(5.5, 0, np.pi / 2)) == pytest.approx(2.0)
    assert gap(box(0, 0), box(0, 2.15)) == pytest.approx(0.15)
    assert overlaps(box(0, 0), box(2, 3, np.pi / 2))


def test_gap_between_a_corner_and_a_corner() -> None:
    assert gap(box(0, 0), box(8, 6)) == pytest.approx(5.0)  # 3 m along and 4 m across
    turned = box(10, 0, np.pi / 4, 2.0, 2.0)  # its corner points at us
    assert gap(box(0, 0), turned) == pytest.approx(10 - 2.5 - np.sqrt(2))


def test_gap_agrees_with_shapely_and_bounds_the_separation() -> None:
    shapely = pytest.importorskip("shapely")
    a, b = clouds(3, 300, 1)
    polygons = [shapely.polygons(corners(v)[:, 0]) for v in (a, b)]
    exact = shapely.distance(*polygons)
    assert gap(a, b)[:, 0] == pytest.approx(exact, abs=1e-9)
    assert (separation(a, b)[:, 0] <= exact + 1e-9).all()


def test_a_vehicle_that_is_not_there_touches_nobody() -> None:
    assert not overlaps(box(0, 0), box(np.nan, 0))
    a, b = cruise("ego", 0, 0, 10).boxes(), cruise("far", 0, 0, 10).boxes()
    absent = Boxes(np.full_like(b.x, np.nan), b.y, b.heading, b.speed, b.length, b.width)
    assert first_contact(a, absent, TIME) == np.inf


def test_crossing_cars_that_pass_through_one_another_between_two_steps_are_caught() -> None:
    a = Boxes(np.array([-10.0, 10.0]), np.zeros(2), np.zeros(2), np.full(2, 200.0), 5.0, 2.0)
    b = Boxes(np.zeros(2), np.zeros(2), np.full(2, np.pi / 2), np.zeros(2), 5.0, 2.0)
    assert not overlaps(a, b).any()
    assert sweep(a, b) == pytest.approx([6.5 / 20])  # front at -7.5 reaches -1 after 6.5 of 20 m


def test_first_contact_of_a_head_on_at_twice_ten_metres_a_second() -> None:
    a, b = cruise("ego", 0, 0, 10), cruise("adversary", 65, 0, 10, np.pi)
    assert first_contact(a.boxes(), b.boxes(), TIME) == pytest.approx(3.0)  # 60 m between bumpers, 20 m/s
    single_step = Boxes(a.x[:1], a.y[:1], a.heading[:1], a.speed[:1], 5.0, 2.0)
    assert first_contact(single_step, single_step, TIME[:1]) == 0.0


@pytest.mark.parametrize("seed", [1, 2])
def test_the_sweep_finds_what_one_millisecond_sampling_finds_and_nothing_else(seed: int) -> None:
    a, b = clouds(seed, 800, 6)
    part = np.linspace(0, 1, 101)  # 1 ms of a 0.1 s step
    sampled = overlaps(between(a, part), between(b, part))
    contact = sweep(a, b)
    hit = np.isfinite(contact)
    assert 300 < hit.sum() < 3700
    assert not (sampled.any(-1) & ~hit).any()
    first = np.where(sampled.any(-1), sampled.argmax(-1) / 100, np.inf)
    assert (contact[hit] <= first[hit] + 1e-3).all()
    rows, columns = np.nonzero(hit)
    at = contact[rows, columns]
    poses = [between(v, np.array([0.0])) for v in (a, b)]
    turned = []
    for v, p in zip((a, b), poses, strict=True):
        x, y = (w[rows, columns] + at * np.diff(w)[rows, columns] for w in (v.x, v.y))
        heading = v.heading[rows, columns] + at * wrap_below_pi(np.diff(v.heading))[rows, columns]
        sizes = [np.asarray(w)[rows, 0, 0] for w in (p.length, p.width)]
        turned.append(Boxes(x, y, heading, x, sizes[0], sizes[1]))
    assert (separation(turned[0], turned[1]) <= 1e-8).all()


angles = st.floats(-3.1, 3.1)
coordinates = st.floats(-20, 20)


@settings(max_examples=100, deadline=None)
@given(coordinates, coordinates, angles, angles, angles, coordinates, coordinates)
def test_distance_is_symmetric_and_the_same_from_any_point_of_view(
    x: float, y: float, ha: float, hb: float, turn: float, ox: float, oy: float
) -> None:
    a, b = box(0, 0, ha), box(x, y, hb, 9.0, 2.5)
    c, s = np.cos(turn), np.sin(turn)
    a2, b2 = box(ox, oy, ha + turn), box(ox + c * x - s * y, oy + s * x + c * y, hb + turn, 9.0, 2.5)
    assert gap(a, b) == pytest.approx(float(gap(b, a)), abs=1e-9)
    assert gap(a, b) == pytest.approx(float(gap(a2, b2)), abs=1e-6)


def test_headings_are_interpolated_the_shorter_way() -> None:
    track = car("ego", 0.0, 0.0, 0.0, np.array([3.1, -3.1]), time=np.array([0.0, 0.1]))
    assert abs(float(wrap_below_pi(at_time(track, 0.05).heading))) == pytest.approx(np.pi)


def test_tracks_of_different_spans_meet_on_one_grid() -> None:
    late = cruise("late", 0, 0, 10).between(1.0, 2.0)
    grid = on_grid([late, cruise("all", 5, 0, 0)], TIME)
    assert grid.x.shape == (2, len(TIME))
    assert np.isnan(grid.x[0, 9]) and grid.x[0, 10] == pytest.approx(10.0) and np.isnan(grid.x[0, 21])
    assert (grid.x[1] == 5.0).all()
