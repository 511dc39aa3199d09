"""SUMO's drivers make room within their lane for a vehicle that was in it and comes back in beside them.

The ego is 1.8 m wide and 5 m long, its lane 3.2 m: 0.7 m of room on either side of it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from situation_samples import changed, leader, situation

from sumo_adv.drivers.lateral_gap import LateralGap, lateral_speed
from sumo_adv.drivers.prediction import seen_edges
from sumo_adv.drivers.scenes import Scenes


def lateral_gap(lane: float = 3.2, sides: tuple[tuple[float, str], ...] = ((3.2, "same"),)) -> LateralGap:
    """Against a car of 5 x 1.8 m; the ego's is the rightmost of two lanes."""
    sit = situation([leader()])
    sit = changed(sit, ego=replace(sit.ego, width=1.8), lane_width=lane, sides=sides)
    return LateralGap(Scenes([sit]), np.array([5.0]), np.array([1.8]))


def beside(gap: LateralGap, front: float, seconds: float, ahead: float = 0.0, was_inside: bool = True) -> float:
    """The offset [m] after so long at 10 m/s with the other's front there."""
    for _ in range(round(seconds / 0.1)):
        gap.step(np.array([ahead]), np.array([front]), np.array([was_inside]), np.array([10.0]))
    return float(gap.d[0])


def test_it_moves_over_for_a_vehicle_that_comes_back_in() -> None:
    """The other's side is 1.3 m from the lane's middle, in the strip from 0.8 to 1.6 m, which the ego wants 0.6 m from:
    it would move by 0.9 + 0.6 - 0.8 = 0.7 m, which is all the room there is. Its front begins with 1 m/s2: 0.01 m
    in the first step, 0.03 m after two. The rear follows: in the second step by 1 m / 5 m of the 0.01 m."""
    gap = lateral_gap()
    assert beside(gap, 2.2, 0.1) == pytest.approx(-0.01 / 2)
    assert beside(gap, 2.2, 0.1) == pytest.approx(-(0.03 + 0.002) / 2)
    assert float(gap.turn[0]) == pytest.approx(-(0.03 - 0.002) / 5, rel=1e-4)
    assert beside(gap, 2.2, 6.0) == pytest.approx(-0.7, abs=0.01)


def test_behind_a_leader_it_stays_where_it_is_and_alone_it_goes_back() -> None:
    gap = lateral_gap()
    beside(gap, 2.2, 0.7)
    there = float(gap.front[0])
    assert there == pytest.approx(-0.28)  # 0.01 m x (1 + 2 + ... + 7)
    beside(gap, 1.0, 1.0)  # the other's front is in the lane now
    assert float(gap.front[0]) == there
    assert beside(gap, 5.0, 6.0) == pytest.approx(0.0, abs=0.01)


def test_it_stops_beside_where_it_wants_to_be_and_goes_no_faster_than_1_m_s() -> None:
    """0.7 m with 1 m/s2: it speeds up for 0.8 s to 0.8 m/s, and brakes as evenly."""
    speed, there, speeds = np.zeros(1), 0.0, []
    while there < 0.7 - 1e-9:
        speed = lateral_speed(speed, np.array([0.7 - there]), 0.1)
        there += 0.1 * float(speed[0])
        speeds.append(float(speed[0]))
    assert max(speeds) == pytest.approx(0.8)
    assert there == pytest.approx(0.7)
    assert len(speeds) <= 16
    assert float(lateral_speed(np.array([-0.97]), np.array([-5.0]), 0.1)[0]) == -1.0


@pytest.mark.parametrize(
    ("lane", "sides", "front", "ahead", "was_inside"),
    [
        (3.2, ((3.2, "same"),), 2.2, 0.0, False),  # it never was in the lane
        (3.2, ((3.2, "same"),), 2.6, 0.0, True),  # its side is beyond the line
        (3.2, ((3.2, "same"),), 2.2, 7.6, True),  # 2.6 m ahead, more than the least gap
        (3.2, ((3.2, "same"),), 2.2, -2.6, True),  # its front is behind the ego's middle
        (3.2, ((3.2, "same"), (-3.2, "same")), 2.2, 0.0, True),  # lanes on both sides, 0.1 m of the strip is the ego's
        (3.2, ((3.2, "opposite"),), 2.2, 0.0, True),  # no lane of the same direction
        (3.4, ((3.4, "same"),), 2.2, 0.0, True),  # the strip from 0.7 m on is 0.2 m within the ego's width
    ],
)
def test_else_it_keeps_its_place(
    lane: float, sides: tuple[tuple[float, str], ...], front: float, ahead: float, was_inside: bool
) -> None:
    assert beside(lateral_gap(lane, sides), front, 2.0, ahead, was_inside) == 0.0


def test_from_the_right_it_makes_room_even_with_a_lane_to_the_left() -> None:
    """0.7 m, from the moment there is less than the least gap to that one."""
    both = ((3.2, "same"), (-3.2, "same"))
    assert beside(lateral_gap(3.2, both), -2.2, 6.0, 7.4) == pytest.approx(0.7, abs=0.01)


def test_a_vehicle_that_comes_still_nearer_does_not_move_it() -> None:
    """After 0.5 s its front has moved by 0.15 m; then the other's side is 0.5 m from the middle of the lane. Its strip
    begins at 0 m, 0.75 m within the ego's width."""
    gap = lateral_gap()
    beside(gap, 2.2, 0.5)
    there = float(gap.front[0])
    assert there == pytest.approx(-0.15)
    beside(gap, 1.7, 2.0)
    assert float(gap.front[0]) == there


def test_between_two_lanes_it_makes_room_for_a_vehicle_on_the_left_that_is_not_in_its_way() -> None:
    """Lane of 3.5 m: the strip of the other's side begins 1.45 m from the middle, so the ego wants 0.05 m more."""
    both = ((3.5, "same"), (-3.5, "same"))
    assert beside(lateral_gap(3.5, both), 2.5, 6.0) == pytest.approx(-0.05, abs=0.001)


def test_from_the_left_lane_it_moves_to_the_left() -> None:
    """Lane of 3.5 m: the strip of the other's side ends 0.95 m to the right, the ego wants 0.9 + 0.6 - 0.95 = 0.55."""
    assert beside(lateral_gap(3.5, ((-3.5, "same"),)), -2.3, 6.0) == pytest.approx(0.55, abs=0.01)


def test_an_ego_that_has_moved_over_looks_less_far_to_the_side_that_it_left() -> None:
    """Its left side is 0.9 m from the middle, in the strip from 0.8 m on; once it has moved by 0.1 m, it
    is no longer in that strip."""
    left, right = seen_edges(np.full(2, 3.2), 1.8, np.array([0.0, -0.1]))
    assert left == pytest.approx([1.6, 0.8])
    assert right == pytest.approx([1.6, 1.6])
