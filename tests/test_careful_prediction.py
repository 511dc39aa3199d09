"""The predicted careful driver brakes when, and as, the real controller does, on a straight road along x."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sumo_adv.datatypes import Floats, VehicleState
from sumo_adv.drivers import CarefulEgo, LaneSpeed, Observation
from sumo_adv.drivers.careful import CarefulDrivers

DT = 0.1
PATH = tuple((float(x), 0.0) for x in range(-50, 2000, 5))
Motion = tuple[float, float, float, float, float, float]  # x, y, heading, speed, acceleration, turn rate


def states(motion: Motion, steps: int) -> list[tuple[float, float, float, float]]:
    """x, y, heading, speed a step apart."""
    x, y, heading, speed, acceleration, turn = motion
    rows = []
    for _ in range(steps):
        rows.append((x, y, heading, speed))
        x, y = x + speed * DT * math.cos(heading), y + speed * DT * math.sin(heading)
        heading, speed = heading + turn * DT, max(speed + acceleration * DT, 0.0)
    return rows


def column(values: tuple[float, float, float]) -> tuple[Floats, Floats, Floats]:
    a, b, c = (np.array([v]) for v in values)
    return a, b, c


def braked(speed: float, motion: Motion, steps: int = 50) -> tuple[list[float], list[float]]:
    """The ego's speeds, driven by the real controller and by the foreseen one."""
    runs = []
    for foreseen in (False, True):
        real, many = CarefulEgo(), CarefulDrivers((5.0, 2.0), np.array([5.0]), np.array([2.0]), DT, np.array([1.6]))
        at, v, a, before = 0.0, speed, 0.0, None
        speeds = []
        for k, (x, y, h, w) in enumerate(states(motion, steps)):
            if foreseen:
                ego_now, other_now, speed_now = (at, v, a), (x, y, h), np.array([w])
                bound = many.bound(column(ego_now), column(other_now), speed_now)
                target = float(bound[0])
            else:
                slower = 0.0 if before is None else (w - before) / DT
                ego = VehicleState("ego", at, 0.0, 0.0, v, a, 5.0, 2.0, "")
                vehicle = VehicleState("bv", x, y, h, w, slower, 5.0, 2.0, "")
                action = real.act(Observation(k * DT, DT, ego, (vehicle,), path=PATH))
                target = action.speed if isinstance(action, LaneSpeed) else math.inf
            before = w
            a, v = (min(v, target) - v) / DT, min(v, target)
            at += v * DT
            speeds.append(v)
        runs.append(speeds)
    return runs[0], runs[1]


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    st.floats(5.0, 30.0), st.floats(6.0, 60.0), st.floats(-5.0, 5.0), st.floats(-0.15, 0.15), st.floats(0.0, 30.0),
    st.floats(-4.0, 2.0), st.floats(-0.03, 0.03),
)  # fmt: skip
def test_braking_for_a_vehicle_in_the_same_direction_is_predicted_as_the_controller_brakes(
    speed: float, x: float, y: float, heading: float, adversary_speed: float, acceleration: float, turn: float
) -> None:
    """But for a step where rounding decides: full braking is 0.76 m/s a step."""
    real, foreseen = braked(speed, (x, y, heading, adversary_speed, acceleration, turn))
    assert foreseen == pytest.approx(real, abs=0.8)


@pytest.mark.parametrize(
    ("speed", "motion", "brakes"),
    [
        (10.0, (90.0, 3.2, math.pi + 0.1, 12.0, 0.0, -0.02), True),  # comes over the line
        (10.0, (90.0, 3.2, math.pi, 12.0, 0.0, 0.0), False),  # keeps its lane
        (12.0, (45.0, -30.0, math.pi / 2, 9.0, 0.0, 0.0), True),  # crosses and meets it
        (12.0, (45.0, -60.0, math.pi / 2, 9.0, 0.0, 0.0), False),  # crosses behind it
        (12.0, (45.0, 40.0, -2.0, 12.0, -1.0, 0.0), False),  # stops short of the path
    ],
)
def test_braking_for_an_oncoming_or_crossing_vehicle_is_predicted_within_two_steps(
    speed: float, motion: Motion, brakes: bool
) -> None:
    """A meeting is looked for every 0.2 s, not 0.1 s."""
    real, foreseen = braked(speed, motion)
    assert (min(real) < speed, min(foreseen) < speed) == (brakes, brakes)
    first = [next((k for k, v in enumerate(speeds) if v < speed), None) for speeds in (real, foreseen)]
    assert first[0] == first[1] or abs(first[0] - first[1]) <= 2  # type: ignore[operator]


def test_a_cut_in_8_m_ahead_is_braked_for_and_one_far_ahead_is_not() -> None:
    """The one cuts in at 15 m/s, the ego drives 20 m/s."""
    near, far = (braked(20.0, (x, 3.2, -0.1, 15.0, 0.0, 0.0), 30)[1] for x in (13.0, 300.0))
    assert min(near) < 15.0
    assert min(far) == 20.0
