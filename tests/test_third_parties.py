"""Predicted third parties brake for an adversary ahead in their lane, and for nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sumo_adv.datatypes import Boxes, Floats
from sumo_adv.drivers.third_parties import braking
from sumo_adv.metrics.boxes import overlaps

STEPS, DT, LANE = 80, 0.1, 3.2
TIME: Floats = DT * np.arange(float(STEPS))


def boxes(x: Floats, y: Floats | float, heading: float, speed: Floats) -> Boxes:
    """One car of 5 m by 2 m."""
    size = np.array([[5.0]]), np.array([[2.0]])
    return Boxes(x[None, :], (0.0 * TIME + y)[None, :], (0.0 * TIME + heading)[None, :], speed[None, :], *size)


def east(x: float, speed: float, y: float = 0.0) -> Boxes:
    return boxes(x + speed * TIME, y, 0.0, 0.0 * TIME + speed)


def stopping(x: float, speed: float, rate: float) -> Boxes:
    """Brakes evenly from the start."""
    v = np.maximum(speed - rate * TIME, 0.0)
    t = np.minimum(TIME, speed / rate)
    return boxes(x + speed * t - rate * t * t / 2, 0.0, 0.0, v)


def touches(a: Boxes, b: Boxes) -> bool:
    return bool(overlaps(a, b).any())


def test_a_follower_brakes_for_an_adversary_that_stops() -> None:
    """Both at 15 m/s, 25 m of room, a stop at 4 m/s2 after 28 m: going on it is there after (25 + 28) / 15 = 3.5 s;
    braking it comes to SUMO's 2.5 m behind, and creeps by then."""
    adversary, follower = stopping(30.0, 15.0, 4.0), east(0.0, 15.0)
    assert touches(follower, adversary)
    reacted = braking(follower, adversary, LANE, DT)
    assert not touches(reacted, adversary)
    assert float(adversary.x[0, -1] - reacted.x[0, -1]) - 5.0 == pytest.approx(2.5, abs=0.5)
    assert float(reacted.speed[0, -1]) < 0.5


def test_a_follower_that_is_cut_off_too_closely_still_touches() -> None:
    """At 20 m/s, 2 m behind a standing adversary: even at 9 m/s2 it takes 22 m to stop."""
    adversary, follower = east(7.0, 0.0), east(0.0, 20.0)
    assert touches(braking(follower, adversary, LANE, DT), adversary)


def test_it_does_not_brake_for_an_adversary_beside_behind_or_across() -> None:
    """Its front a tenth of a metre beyond the lane's line; behind; standing across at a right angle (as at a junction,
    where the right of way rules): the motion stays as it was, bit for bit."""
    follower = east(0.0, 15.0)
    across = boxes(30.0 + 0.0 * TIME, 0.0, np.pi / 2, 0.0 * TIME)
    for adversary in (east(20.0, 2.0, y=LANE / 2 + 0.1), east(-10.0, 15.0), across):
        reacted = braking(follower, adversary, LANE, DT)
        assert np.allclose(reacted.x, follower.x, atol=1e-6)
    assert braking(follower, east(20.0, 2.0, y=LANE / 2 - 0.1), LANE, DT).x[0, -1] < follower.x[0, -1] - 10.0


def test_a_vehicle_that_appears_later_or_leaves_is_there_only_then() -> None:
    """NaN before 2 s and after 5 s, as before."""
    x = np.where((TIME >= 2.0) & (TIME <= 5.0), 15.0 * TIME, np.nan)
    follower = boxes(x, 0.0, 0.0, 0.0 * TIME + 15.0)
    reacted = braking(follower, stopping(60.0, 15.0, 4.0), LANE, DT)
    assert (np.isnan(reacted.x) == np.isnan(follower.x)).all()


@given(
    gap=st.floats(-40.0, 60.0), speed=st.floats(0.0, 30.0), other=st.floats(0.0, 30.0), rate=st.floats(0.5, 8.0),
    heading=st.floats(-np.pi, np.pi),
)  # fmt: skip
def test_it_is_never_further_on_than_unattacked_and_never_goes_back(
    gap: float, speed: float, other: float, rate: float, heading: float
) -> None:
    """Turned as a whole in any direction, it stays on its way."""
    c, s = np.cos(heading), np.sin(heading)
    follower, adversary = east(0.0, other), stopping(gap, speed, rate)
    turned = [Boxes(c * b.x, s * b.x, 0.0 * b.x + heading, b.speed, b.length, b.width) for b in (follower, adversary)]
    reacted = braking(*turned, LANE, DT)
    along = (c * reacted.x + s * reacted.y)[0]
    assert (along <= follower.x[0] + 1e-6).all()
    assert (np.diff(along) >= -1e-6).all()
    assert np.allclose(c * reacted.y, s * reacted.x, atol=1e-6)
