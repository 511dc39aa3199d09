"""Angles, the ego's frame and paths: stories with numbers worked out by hand, and properties of gentle curves."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sumo_adv.datatypes import Floats
from sumo_adv.geometry import PATH_STEP_M, Frame, Path, along, make_path, quintics, seen_from_segments, wrap

COORDINATE = st.floats(-2000.0, 2000.0)
ANGLE = st.floats(-math.pi + 1e-6, math.pi)
RADIUS = st.floats(25.0, 500.0)
TURN = st.sampled_from([-1.0, 1.0])
EXAMPLES = settings(max_examples=60, deadline=None, derandomize=True)


def arc(radius: float, turn: float, length: float = 40.0) -> Path:
    """A bend from the origin, first along +x, to the left for ``turn`` 1."""
    a = np.arange(0.0, length, 0.1) / radius
    return make_path(np.column_stack([radius * np.sin(a), turn * radius * (1.0 - np.cos(a))]))


def spacing(path: Path) -> Floats:
    distances: Floats = np.hypot(np.diff(path.x), np.diff(path.y))
    return distances


def test_angles_are_wrapped_to_minus_pi_exclusive_and_pi_inclusive() -> None:
    assert wrap(-math.pi) == pytest.approx(math.pi)
    assert wrap(3 * math.pi) == pytest.approx(math.pi)
    assert wrap(1.5 * math.pi) == pytest.approx(-math.pi / 2)
    assert wrap(np.array([0.0, -7.0])) == pytest.approx([0.0, 2 * math.pi - 7.0])


@EXAMPLES
@given(st.floats(-1e4, 1e4))
def test_wrapping_changes_an_angle_by_whole_turns(angle: float) -> None:
    turns = (angle - wrap(angle)) / (2 * math.pi)
    assert turns == pytest.approx(round(turns), abs=1e-9)
    assert -math.pi < wrap(angle) <= math.pi


# ---- the ego's frame


def test_an_ego_that_drives_north_sees_the_west_on_its_left() -> None:
    frame = Frame(10.0, 5.0, math.pi / 2)
    assert frame.to_local(10.0, 15.0, math.pi / 2) == pytest.approx((10.0, 0.0, 0.0))
    assert frame.to_local(7.0, 5.0, math.pi) == pytest.approx((0.0, 3.0, math.pi / 2))
    assert frame.to_world(10.0, 3.0, 0.0) == pytest.approx((7.0, 15.0, math.pi / 2))


@EXAMPLES
@given(COORDINATE, COORDINATE, ANGLE, COORDINATE, COORDINATE, ANGLE)
def test_into_the_frame_and_back_is_where_one_was(
    fx: float, fy: float, fh: float, x: float, y: float, h: float
) -> None:
    frame = Frame(fx, fy, fh)
    back = frame.to_world(*frame.to_local(x, y, h))
    assert back[:2] == pytest.approx((x, y), abs=1e-8)
    assert abs(wrap(back[2] - h)) < 1e-9
    many = frame.to_local(np.array([x]), np.array([y]), np.array([h]))
    assert [float(q[0]) for q in many[:2]] == pytest.approx(frame.to_local(x, y, h)[:2], abs=1e-9)


# ---- paths


def test_a_straight_path_goes_on_beyond_both_ends() -> None:
    path = make_path([(0.0, 0.0), (0.0, 20.0)])  # northwards: left is -x
    assert path.length == pytest.approx(20.0)
    x, y, h = path.at(np.array([3.2, -4.0, 25.0]), np.array([1.0, 0.0, -2.0]))
    assert x == pytest.approx([-1.0, 0.0, 2.0])
    assert y == pytest.approx([3.2, -4.0, 25.0])
    assert h == pytest.approx([math.pi / 2] * 3)
    assert path.project(-1.5, 27.0) == pytest.approx((27.0, 1.5))
    assert path.project(0.5, -3.0) == pytest.approx((-3.0, -0.5))


def test_a_path_that_turns_back_is_searched_near_a_station() -> None:
    out = [(float(x), 0.0) for x in range(41)]
    bend = [(40.0 + 6.0 * math.sin(a), 6.0 - 6.0 * math.cos(a)) for a in np.arange(0.05, math.pi, 0.05)]
    path = make_path([*out, *bend, *[(float(x), 12.0) for x in range(40, -1, -1)]])
    assert path.project(10.0, 5.0)[0] == pytest.approx(10.0, abs=0.01)  # nearer to the way out
    station, offset = path.project(10.0, 5.0, near=85.0)
    assert station == pytest.approx(40.0 + 6.0 * math.pi + 30.0, abs=0.4)  # pi: the bend is 18.8 m long
    assert offset == pytest.approx(7.0, abs=0.05)  # westwards, south is left


@EXAMPLES
@given(RADIUS, TURN, st.floats(0.0, 39.0), st.floats(-5.0, 5.0))
def test_projecting_a_point_of_a_gentle_bend_gives_its_station_and_offset(
    radius: float, turn: float, s: float, d: float
) -> None:
    path = arc(radius, turn)
    x, y, _ = path.at(np.array(s), d)
    for near in (None, s):
        station, offset = path.project(float(x), float(y), near=near)
        assert station == pytest.approx(s, abs=0.07)
        assert offset == pytest.approx(d, abs=0.02)


@EXAMPLES
@given(RADIUS, TURN)
def test_samples_lie_half_a_metre_apart_on_the_curve_they_were_made_from(radius: float, turn: float) -> None:
    path = arc(radius, turn)
    assert spacing(path) == pytest.approx(PATH_STEP_M, abs=0.005)
    assert np.hypot(path.x, path.y - turn * radius) == pytest.approx(radius, abs=0.02)
    assert path.heading[4:-4] == pytest.approx(turn * np.arange(4, len(path.x) - 4) * PATH_STEP_M / radius, abs=0.01)


def test_a_bend_of_20_metres_is_taken_at_8_metres_a_second() -> None:
    path = arc(20.0, 1.0)
    assert path.curvature[10:-10] == pytest.approx(0.05, rel=0.02)
    assert path.speed[10:40] == pytest.approx(8.0, rel=0.01)  # sqrt(3.2 * 20)


def test_before_a_bend_the_speed_is_what_4_metres_a_second_squared_can_still_brake() -> None:
    bend = [(100.0 + 20.0 * math.sin(a), 20.0 - 20.0 * math.cos(a)) for a in np.arange(0.01, 1.5, 0.01)]
    path = make_path([*[(float(x), 0.0) for x in range(101)], *bend])
    at_bend = int(np.argmax(path.speed < 8.1))
    assert at_bend * PATH_STEP_M == pytest.approx(100.0, abs=3.0)  # the bend is smoothed in
    assert path.speed[at_bend - 20] == pytest.approx(12.0, abs=0.1)  # 10 m before: sqrt(8^2 + 2 * 4 * 10)
    assert (np.diff(path.speed[:at_bend] ** 2) >= -2 * 4.0 * PATH_STEP_M - 1e-9).all()


def test_an_extended_path_is_straight_on_and_fast() -> None:
    path = arc(25.0, 1.0).extended(7.2)
    assert path.length == pytest.approx(39.5 + 7.5)  # whole samples: 0.5 * ceil(14.4)
    assert spacing(path)[-16:] == pytest.approx(PATH_STEP_M, abs=0.005)
    assert path.heading[-15:] == pytest.approx(path.heading[-16])
    assert path.curvature[-15:] == pytest.approx(0.0)
    assert path.speed[-1] == pytest.approx(50.0)


def test_points_that_repeat_or_are_too_few_still_make_a_path() -> None:
    repeated = make_path([(0.0, 0.0), (0.0, 0.0), (5.0, 0.0), (5.0, 0.0), (10.0, 0.0)])
    assert repeated.x == pytest.approx(np.arange(0.0, 10.01, 0.5))
    assert make_path([(3.0, 4.0)]).x == pytest.approx([3.0, 3.5])
    short = make_path([(0.0, 0.0), (0.0, 0.2)])
    assert (short.length, float(short.y[1])) == (0.5, pytest.approx(0.5))
    assert short.heading == pytest.approx([math.pi / 2] * 2)


def test_a_bend_that_no_car_can_follow_is_rounded() -> None:
    """A right angle with a radius of 2.9 m (1/m: 0.34), as lanes at tight corners have it."""
    turn = [(2.9 * math.sin(a), 2.9 * (1 - math.cos(a))) for a in np.linspace(0.0, math.pi / 2, 20)]
    corner = [(-30.0, 0.0), *turn, (2.9, 32.9)]
    sharp, rounded = make_path(corner), make_path(corner, tightest=0.195)
    assert np.abs(sharp.curvature).max() > 0.25
    assert np.abs(rounded.curvature).max() <= 0.195
    step = np.hypot(np.diff(rounded.x), np.diff(rounded.y))
    assert step == pytest.approx(0.5, abs=0.01)
    assert (rounded.x[0], rounded.y[0]) == pytest.approx((-30.0, 0.0))
    apart = [
        min(math.dist((x, y), p) for p in zip(sharp.x, sharp.y, strict=True))
        for x, y in zip(rounded.x, rounded.y, strict=True)
    ]
    assert max(apart) < 1.6  # the arc itself of 5.1 m cuts the corner by 0.9 m
    assert rounded.length > sharp.length - 4.0
    gentle = [(0.0, 0.0), (100.0, 0.0)]
    assert (make_path(gentle, tightest=0.195).x == make_path(gentle).x).all()


def test_a_quintic_move_from_rest_to_rest() -> None:
    """1 m in 2 s: half way after 1 s, at 15/8 of the mean speed (0.9375 m/s) without acceleration; the third
    derivative's square comes to 720 h^2 / T^5 = 22.5 m2/s5. From then on it stays."""
    d, rate, second, jerk = quintics((0.0, 0.0, 0.0), np.array([1.0]), np.array([2.0]), np.array([0.0, 1.0, 2.0, 3.0]))
    assert d[0] == pytest.approx([0.0, 0.5, 1.0, 1.0])
    assert rate[0] == pytest.approx([0.0, 0.9375, 0.0, 0.0])
    assert second[0] == pytest.approx([0.0, 0.0, 0.0, 0.0])
    assert jerk == pytest.approx([22.5])


def test_quintic_moves_of_many_go_as_each_alone() -> None:
    """Two with states of their own, to the same two aims."""
    starts, aims, spans, times = (
        [(0.5, -0.2, 0.1), (-1.0, 0.3, 0.0)],
        np.array([0.0, 3.2]),
        np.array([1.2, 3.0]),
        np.arange(0.0, 4.1, 0.2),
    )
    a, b, c = (np.array([[s[k]] for s in starts]) for k in range(3))
    together = quintics((a, b, c), np.stack([aims, aims]), np.stack([spans, spans]), times)
    for row, start in enumerate(starts):
        for many, alone in zip(together, quintics(start, aims, spans, times), strict=True):
            assert np.array_equal(many[row], alone)


def test_metres_along_a_polyline_are_those_of_the_nearest_place_on_it() -> None:
    corner = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 5.0]])

    assert float(along(corner, 4.0, 1.0)) == 4.0
    assert along(corner, np.array([-3.0, 12.0, 9.0]), np.array([1.0, 2.0, 9.0])).tolist() == [0.0, 12.0, 15.0]


def test_a_point_is_seen_from_each_segment_of_a_bent_line() -> None:
    """The line goes 4 m east, then 2 m north. (1, 3) is 3 m beside the first segment and 1 m past the second one."""
    bent = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 2.0]])
    share, distance = seen_from_segments(bent, 1.0, 3.0)
    assert share.tolist() == [0.25, 1.0]
    assert distance == pytest.approx([3.0, math.hypot(3.0, 1.0)])
    share, distance = seen_from_segments(bent, np.array([1.0]), np.array([3.0]), straight_on=True)
    assert share.tolist() == [[0.25, 1.5]] and distance.tolist() == [[3.0, 3.0]]
