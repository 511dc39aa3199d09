"""The timing of a winner's motion is disturbed to see whether the attack holds."""

import numpy as np
import pytest

from sumo_adv.benchmark.perturbed import retimed
from sumo_adv.datatypes import PrescribedMotion

EAST = PrescribedMotion(
    np.arange(1.0, 61.0), np.zeros(60), np.zeros(60), np.full(60, 10.0)
)  # 6 s to the east at 10 m/s, a state each 0.1 s


def test_a_slower_clock_is_taken_over_one_second() -> None:
    slow = retimed(EAST, 0.9, 0.1)
    # at 1 s the clock shows 1 - 0.1 / 2 = 0.95 s, at 6 s another 5 * 0.9 = 4.5 s
    assert slow.x[9] == pytest.approx(9.5)
    assert slow.x[59] == pytest.approx(54.5)
    assert (slow.speed[9], slow.speed[59]) == pytest.approx((9.0, 9.0))
    assert np.diff(slow.speed).min() > -0.11  # 1 m/s over 1 s: no jump


def test_after_the_recorded_motion_a_faster_one_goes_straight_on() -> None:
    fast = retimed(EAST, 1.1, 0.1)
    # the clock shows 1.05 + 5 * 1.1 = 6.55 s: 60 m and 0.55 s at 10 m/s
    assert fast.x[59] == pytest.approx(65.5)
    assert fast.y[59] == 0.0
