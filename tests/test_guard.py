"""The emergency brake of predicted drivers: an ego of 5 x 2 m at 10 m/s, and a car of the same size."""

import numpy as np
import pytest

from sumo_adv.datatypes import Guard
from sumo_adv.drivers.guard import Guards

SIZE = np.array([5.0]), np.array([2.0])


def guards(ttc: float = 1.5, reaction: float = 0.0) -> Guards:
    return Guards(Guard(ttc, reaction, 8.0), (5.0, 2.0), *SIZE, 0.1)


def bound(of: Guards, station: float, offset: float = 0.0, heading: float = 0.0, speed: float = 0.0) -> float:
    ego = (np.array([0.0]), np.array([0.0]), np.array([10.0]))
    return float(of.bound(ego, (np.array([station]), np.array([offset]), np.array([heading])), np.array([speed]))[0])


@pytest.mark.parametrize(("station", "after"), [(20.0, 9.2), (25.0, np.inf)])
def test_it_brakes_when_a_standing_car_is_1_5_s_away(station: float, after: float) -> None:
    # the boxes with 0.3 m between them meet after (20 - 5.3) / 10 = 1.47 s, or after 1.97 s; 8 m/s2 for 0.1 s
    assert bound(guards(), station) == pytest.approx(after)


def test_it_looks_to_the_side() -> None:
    # 8 m to the left, coming across at 6 m/s: the sides are 4.2 m apart for the boxes as they stand (half of 5 and of
    # 2 and 0.3), which takes 0.7 s; the ego's front is then 7 m further on
    assert bound(guards(), 12.0, 8.0, -np.pi / 2, 6.0) == pytest.approx(9.2)
    assert bound(guards(), 12.0, 8.0, np.pi / 2, 6.0) == np.inf  # it goes away


def test_it_reacts_after_its_reaction_time_and_goes_on_for_a_second() -> None:
    slow = guards(reaction=0.25)
    assert [bound(slow, 20.0) for _ in range(3)] == pytest.approx([np.inf, np.inf, 9.2])  # 0.3 s of danger
    assert [bound(slow, 20.0, 10.0) for _ in range(9)] == pytest.approx([9.2] * 9)  # it moved aside
    assert bound(slow, 20.0, 10.0) == np.inf


def test_who_follows_in_its_lane_is_no_danger() -> None:
    assert bound(guards(), -7.0, speed=20.0) == np.inf
