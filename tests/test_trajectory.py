"""f_traj: the limits hold whatever is asked, and one vehicle goes as it goes among many."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sumo_adv.datatypes import Floats, Limits
from sumo_adv.geometry import Path, make_path
from sumo_adv.planners.trajectory import (
    Batch,
    Motion,
    PathEndpoint,
    PathRow,
    PathRows,
    Scalar,
    advance,
    pose,
    start,
    steer,
)

DT = 0.1
LIMITS = Limits()
STRAIGHT = make_path([(0.0, 0.0), (600.0, 0.0)])
BEND = make_path([(30.0 * math.sin(a), 30.0 - 30.0 * math.cos(a)) for a in np.arange(0.0, 6.2, 0.02)])
PATHS = {"straight": STRAIGHT, "bend": BEND}
EXAMPLES = settings(max_examples=25, deadline=None, derandomize=True)
SPEED = st.floats(0.0, 30.0)
OFFSET = st.floats(-3.2, 3.2)


def drive(
    path: Path, motion: Motion, goal: PathEndpoint, *, steps: int = 60, cap: float = 40.0, hard: bool = True
) -> tuple[list[Motion], list[tuple[float, float, float]]]:
    """States and poses while a goal given once is driven to, the state at the start first."""
    road = PathRow(path)
    states, poses = [motion], [pose(Scalar, motion, road)]
    motion = steer(Scalar, motion, goal, road.at(motion.s)[3])
    for _ in range(steps):
        motion = advance(Scalar, motion, goal, road, LIMITS, cap, DT, hard)
        goal = goal._replace(time=goal.time - DT)
        states.append(motion)
        poses.append(pose(Scalar, motion, road))
    return states, poses


def keeping(v: float, *, s: float = 50.0, d: float = 0.0, a: float = 0.0) -> Motion:
    """A car that keeps its place in the lane."""
    return start(Scalar, s, d, 0.0, v, a)


def column(states: list[Motion], name: str) -> Floats:
    return np.array([getattr(m, name) for m in states])


# ---- stories


def test_a_goal_that_constant_speed_reaches_changes_nothing() -> None:
    states, poses = drive(STRAIGHT, keeping(10.0), PathEndpoint(90.0, 0.0, 10.0, 4.0), steps=40)
    assert column(states, "v") == pytest.approx(10.0)
    assert poses[-1] == pytest.approx((90.0, 0.0, 0.0))


def test_a_gentle_goal_is_met_in_place_speed_and_time() -> None:
    # 10 -> 14 m/s in 4 s at 1 m/s2: 48 m
    states, _ = drive(STRAIGHT, keeping(10.0), PathEndpoint(98.0, 0.0, 14.0, 4.0), steps=40)
    assert states[-1].s == pytest.approx(98.0, abs=0.4)
    assert states[-1].v == pytest.approx(14.0, abs=0.2)


def test_a_vehicle_beside_or_across_brakes_and_speeds_up_as_people_do() -> None:
    """From 20 m/s it brakes with 3.5 m/s2 at most and at 5 m/s with 5, of which 95 % are used; one ahead of the ego in
    its lane with nearly 8 m/s2. It speeds up with 2.4 m/s2, from 17 m/s on with less, and with 1.9 m/s2 at 20 m/s."""
    stops = PathEndpoint(50.0, 0.0, 0.0, 0.8)
    gently, _ = drive(STRAIGHT, keeping(20.0), stops, steps=60, hard=False)
    hard, _ = drive(STRAIGHT, keeping(20.0), stops, steps=60)
    v, a = column(gently, "v"), column(gently, "a")
    assert a[3:10].min() == pytest.approx(-3.5, abs=0.2) and column(hard, "a").min() < -7.5
    assert (a >= -0.95 * np.interp(v, (5.0, 20.0), (5.0, 3.5)) - 0.03).all()
    faster, _ = drive(STRAIGHT, keeping(10.0), PathEndpoint(400.0, 0.0, 25.0, 6.0), steps=60, hard=False)
    v, a = column(faster, "v"), column(faster, "a")
    assert a.max() == pytest.approx(2.4, abs=0.01) and (a <= np.interp(v, (5.0, 20.0), (4.0, 2.0)) + 1e-9).all()


def test_a_full_stop_from_10_takes_its_11_metres_and_never_goes_back() -> None:
    # 11.04 m/s3 until nearly 8 m/s2: 0.7 s and 6.4 m, 7.3 m/s left; then as sqrt(8.83 v): some 5 m more
    states, _ = drive(STRAIGHT, keeping(10.0), PathEndpoint(50.0, 0.0, 0.0, 0.8), steps=40)
    v, a = column(states, "v"), column(states, "a")
    assert -8.0 < a.min() < -7.5
    assert v[-1] == 0.0
    assert 9.5 < states[-1].s - 50.0 < 12.5
    assert (np.diff(column(states, "s")) >= 0.0).all()


def test_no_vehicle_goes_faster_than_the_cap() -> None:
    states, _ = drive(STRAIGHT, keeping(10.0), PathEndpoint(250.0, 0.0, 30.0, 6.0), cap=15.0)
    assert 14.5 < column(states, "v").max() < 15.1


def test_a_bend_of_30_metres_is_taken_at_what_3_2_metres_a_second_squared_allows() -> None:
    states, poses = drive(BEND, keeping(9.0, s=10.0), PathEndpoint(150.0, 0.0, 20.0, 6.0), steps=50)
    assert column(states, "v").max() < math.sqrt(3.2 * 30.0) + 0.4  # 9.8 m/s
    assert [math.hypot(x, y - 30.0) for x, y, _ in poses] == pytest.approx([30.0] * 51, abs=0.05)


def test_a_lane_change_ends_in_the_lane_and_along_it() -> None:
    states, poses = drive(STRAIGHT, keeping(15.0), PathEndpoint(110.0, 3.2, 15.0, 4.0), steps=60)
    end = states[-1]
    assert (end.d, end.dd, end.ddd) == pytest.approx((3.2, 0.0, 0.0), abs=1e-9)
    assert poses[-1][2] == pytest.approx(0.0, abs=1e-3)
    d = column(states, "d")
    assert d[20] == pytest.approx(1.6, abs=0.01)  # half of it after half of 4 s
    assert column(states, "dd").max() == pytest.approx(15 / 8 * 3.2 / 4.0, rel=0.01)  # a quintic's middle


def test_a_lane_change_asked_for_in_no_time_is_stretched_to_the_limits() -> None:
    states, _ = drive(STRAIGHT, keeping(15.0), PathEndpoint(51.5, 3.2, 15.0, 0.1), steps=60)
    assert np.abs(column(states, "ddd")).max() <= 3.0 + 0.05  # m/s2: 10 / sqrt(3) * 3.2 / T^2 gives T >= 2.48 s
    moving = DT * np.flatnonzero(np.abs(column(states, "d") - 3.2) > 1e-6)
    assert 2.3 < moving[-1] < 3.0
    assert states[-1].d == pytest.approx(3.2)


def test_a_standing_car_does_not_slide_sideways() -> None:
    states, poses = drive(STRAIGHT, keeping(0.0), PathEndpoint(50.0, 3.2, 0.0, 3.0), steps=30)
    assert column(states, "d") == pytest.approx(0.0)
    assert poses[-1] == pytest.approx((50.0, 0.0, 0.0))


def test_a_car_that_stands_at_an_angle_keeps_it_until_it_drives_off() -> None:
    road, motion = PathRow(STRAIGHT), start(Scalar, 50.0, 0.0, math.sin(0.1), 0.0, 0.0)
    for target in (1.0, -1.0, 0.0):  # wherever it is to go
        motion = steer(Scalar, motion, PathEndpoint(50.0, target, 0.0, 3.0), 0.0)
        for _ in range(5):
            motion = advance(Scalar, motion, PathEndpoint(50.0, target, 0.0, 3.0), road, LIMITS, 40.0, DT, True)
        assert pose(Scalar, motion, road) == pytest.approx((50.0, 0.0, 0.1))
    states, poses = drive(STRAIGHT, motion, PathEndpoint(70.0, 0.0, 8.0, 5.0), steps=80)
    turned = np.abs(np.diff([h for _, _, h in poses])) / DT / np.maximum(column(states, "v")[1:], 1.0)
    assert turned.max() <= LIMITS.curvature
    assert 0.0 < column(states, "d").max() < 1.0  # it goes where it points before it comes back


def test_a_target_that_moved_by_a_hand_keeps_the_running_lane_change() -> None:
    road = PathRow(STRAIGHT)
    goal = PathEndpoint(110.0, 3.2, 15.0, 4.0)
    motion = steer(Scalar, keeping(15.0), goal, 0.0)
    for _ in range(10):
        motion = advance(Scalar, motion, goal, road, LIMITS, 40.0, DT, True)
    assert steer(Scalar, motion, goal._replace(d=3.3), 0.0) is motion
    turned = steer(Scalar, motion, goal._replace(d=0.0), 0.0)
    assert (turned.target, turned.clock) == (0.0, 0.0)
    after = advance(Scalar, turned, goal._replace(d=0.0), road, LIMITS, 40.0, DT, True)
    assert after.d - motion.d == pytest.approx(motion.dd * DT, abs=0.02)  # no jump
    assert after.dd == pytest.approx(motion.dd, abs=0.35)


def test_a_vehicle_that_drifts_at_the_start_comes_to_rest_beside_its_lane_centre() -> None:
    states, _ = drive(
        STRAIGHT, start(Scalar, 50.0, 0.5, 0.4 / 12.0, 12.0, 0.0), PathEndpoint(100.0, 0.5, 12.0, 4.0), steps=50
    )
    assert states[-1].d == pytest.approx(0.5)
    assert 0.55 < column(states, "d").max() < 0.9


def test_after_its_goal_a_car_goes_on_at_the_speed_of_the_goal() -> None:
    states, _ = drive(STRAIGHT, keeping(10.0), PathEndpoint(60.0, 0.0, 10.0, 1.0), steps=40)
    assert column(states, "v") == pytest.approx(10.0)
    assert states[-1].s == pytest.approx(90.0)


# ---- properties


@st.composite
def starts_and_goals(draw: st.DrawFn) -> tuple[Motion, PathEndpoint]:
    """A state SUMO could leave behind and any goal, sensible or not."""
    v = draw(SPEED)
    softest = -math.sqrt(0.8 * 11.0 * v)  # no car brakes at 8 m/s2 when it is almost standing
    a = draw(st.floats(max(-8.0, softest), 4.0))
    slope = draw(st.floats(-0.1, 0.1))
    motion = start(Scalar, 50.0, draw(OFFSET), max(-1.0, min(1.0, slope * v)) / v if v > 1.0 else slope, v, a)
    ahead = draw(st.floats(-20.0, 150.0))
    return motion, PathEndpoint(50.0 + ahead, draw(OFFSET), draw(st.floats(0.0, 35.0)), draw(st.floats(0.05, 8.0)))


@EXAMPLES
@given(starts_and_goals(), st.sampled_from(list(PATHS)))
def test_speed_acceleration_and_jerk_stay_within_the_limits(case: tuple[Motion, PathEndpoint], path: str) -> None:
    states, _ = drive(PATHS[path], case[0], case[1])
    v, a = column(states, "v"), column(states, "a")
    assert v.min() >= 0.0
    assert a[1:].min() >= -8.0 - 1e-9
    assert a[1:].max() <= 4.0 + 1e-9
    assert np.abs(np.diff(a)).max() <= 12.0 * DT + 1e-9
    assert np.diff(v) == pytest.approx(a[1:] * DT, abs=1e-9)


@EXAMPLES
@given(starts_and_goals())
def test_sideways_a_car_pulls_no_more_than_about_4_metres_a_second_squared(case: tuple[Motion, PathEndpoint]) -> None:
    """The bounds are on the quintic; braking hard in the middle of a lane change adds up to half a metre more."""
    states, poses = drive(STRAIGHT, case[0], case[1])
    heading = np.unwrap([h for _, _, h in poses[1:]])  # before the first step the heading is SUMO's, not ours
    v = column(states, "v")[1:]
    lateral = v * np.abs(np.gradient(heading, DT))
    assert lateral[v >= 3.0].max(initial=0.0) <= 4.6


@EXAMPLES
@given(starts_and_goals(), st.sampled_from(list(PATHS)))
def test_poses_move_as_fast_as_the_speed_says_and_where_the_heading_points(
    case: tuple[Motion, PathEndpoint], path: str
) -> None:
    states, poses = drive(PATHS[path], case[0], case[1], steps=30)
    way = np.hypot(*np.diff([(x, y) for x, y, _ in poses], axis=0).T)
    assert way == pytest.approx(column(states, "v")[1:] * DT, abs=0.04)
    step = np.diff([(x, y) for x, y, _ in poses], axis=0)
    heading = np.unwrap([h for _, _, h in poses])
    middle = (heading[1:] + heading[:-1]) / 2
    across = step[:, 1] * np.cos(middle) - step[:, 0] * np.sin(middle)
    assert across[1:] == pytest.approx(0.0, abs=0.03)  # m


@EXAMPLES
@given(starts_and_goals())
def test_the_quintic_ends_at_its_target_with_no_sideways_speed(case: tuple[Motion, PathEndpoint]) -> None:
    motion = steer(Scalar, case[0], case[1], 0.0)
    c = motion.c
    assert sum(c) == pytest.approx(motion.target, abs=1e-9)
    assert sum(k * q for k, q in enumerate(c)) == pytest.approx(0.0, abs=1e-8)
    assert sum(k * (k - 1) * q for k, q in enumerate(c)) == pytest.approx(0.0, abs=1e-7)
    assert c[0] == pytest.approx(case[0].d)


def spread(values: list[Any]) -> Any:
    """The values of several floats or tuples of floats as arrays."""
    if isinstance(values[0], tuple):
        return tuple(spread(list(part)) for part in zip(*values, strict=True))
    return np.array(values)


@EXAMPLES
@given(st.lists(starts_and_goals(), min_size=2, max_size=5), st.floats(-1.0, 1.0))
def test_one_vehicle_goes_as_it_goes_among_many(cases: list[tuple[Motion, PathEndpoint]], shift: float) -> None:
    n = len(cases)
    paths, row = [STRAIGHT, BEND], np.arange(n) % 2
    roads, rows = [PathRow(paths[k]) for k in row], PathRows(paths, row)
    ones = [m for m, _ in cases]
    single = [(m.s, m.d, m.slope, m.v, m.a) for m in ones]
    goals = [g for _, g in cases]
    many = start(Batch, *(np.array(q) for q in zip(*single, strict=True)))
    goal = PathEndpoint(*(np.array(q) for q in zip(*goals, strict=True)))
    for k in range(40):
        if k % 10 == 0:
            side = shift * k / 10
            goal = goal._replace(d=goal.d + side)
            goals = [g._replace(d=g.d + side) for g in goals]
            many = steer(Batch, many, goal, rows.at(many.s)[3])
            ones = [steer(Scalar, m, g, r.at(m.s)[3]) for m, g, r in zip(ones, goals, roads, strict=True)]
        many = advance(Batch, many, goal, rows, LIMITS, np.full(n, 25.0), DT, np.full(n, True))
        ones = [advance(Scalar, m, g, r, LIMITS, 25.0, DT, True) for m, g, r in zip(ones, goals, roads, strict=True)]
    for name, a, b in zip(Motion._fields, many, spread(ones), strict=True):
        assert np.allclose(a, b, rtol=0.0, atol=1e-9), name
    together = np.array(pose(Batch, many, rows)).T
    apart = np.array([pose(Scalar, m, r) for m, r in zip(ones, roads, strict=True)])
    assert together == pytest.approx(apart, abs=1e-9)
