"""The lattice driver as it is foreseen brakes and swerves as the real controller does (on a straight road along x)."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sumo_adv.datatypes import DriverModel, Floats, VehicleState
from sumo_adv.drivers import (
    LatticeEgo,
    Observation,
    Steer,
    apply_steer,
    lattice_choice,
    lattice_cost,
    lattice_frame,
    lattice_model,
    lattice_sample,
)
from sumo_adv.drivers import lattice_controller as controller
from sumo_adv.drivers.lattice_model import LatticeDrivers
from sumo_adv.drivers.protocol import Road
from sumo_adv.drivers.scenes import Scenes

DT = 0.1
PATH = [(float(x), 0.0) for x in range(-50, 900)]
LENGTH, WIDTH = 5.0, 2.0
Motion = tuple[float, float, float, float, float, float]  # x, y, heading, speed, acceleration, turn rate


class StraightScenes:
    """Egos alone on a straight road at ``speed`` [m/s], 3.2 m lanes, with a lane to the left if there is one."""

    def __init__(self, speed: float, sides: tuple[float, ...]) -> None:
        self.dt, self.speed, self.ego = DT, speed, SimpleNamespace(length=LENGTH, width=WIDTH)
        beside = tuple((offset, "same") for offset in sides)
        self.of = [SimpleNamespace(ego_sides=beside, lane_width=3.2, junction=math.inf, profile_a=[0.0])]

    def each(self, value: Any) -> Floats:
        return np.array([value(s) for s in self.of], float)

    def profile_now(self, time: float) -> tuple[Floats, Floats]:
        return np.array([self.speed * time]), np.array([self.speed])

    def profile(self, time: Floats) -> tuple[Floats, Floats]:
        return self.speed * time[None], np.full((1, len(time)), self.speed)

    def pace(self, station: Floats) -> Floats:
        return np.full(len(station), self.speed)


def states(motion: Motion, steps: int) -> list[VehicleState]:
    """The other, a step apart."""
    x, y, heading, speed, acceleration, turn = motion
    found = []
    for _ in range(steps):
        found.append(VehicleState("bv", x, y, heading, speed, acceleration, LENGTH, WIDTH, ""))
        x, y = x + speed * DT * math.cos(heading), y + speed * DT * math.sin(heading)
        heading, speed = heading + turn * DT, max(speed + acceleration * DT, 0.0)
    return found


def driven(speed: float, motion: Motion, sides: tuple[float, ...] = (), steps: int = 50) -> tuple[Floats, Floats]:
    """x, y, heading, speed by step of the ego driven by the real controller, and as it is foreseen; ``(steps, 4)``."""
    real, road = LatticeEgo(), Road(limit=speed, sides=sides, until=400.0)
    model = DriverModel("lattice", *(float(real.sumo_type[n]) for n in ("accel", "decel", "tau", "minGap")), speed)
    many = LatticeDrivers(
        cast(Scenes, StraightScenes(speed, sides)), np.array([LENGTH]), np.array([WIDTH]), model
    )  # fmt: skip
    ego, at, v = VehicleState("ego", 0.0, 0.0, 0.0, speed, 0.0, LENGTH, WIDTH, ""), np.zeros(1), np.array([speed])
    came, foreseen = [], []
    for k, other in enumerate(states(motion, steps)):
        now = replace(other, x=other.x)
        action = real.act(Observation(k * DT, DT, ego, (now,), path=PATH, road=road))
        assert isinstance(action, Steer)
        ego = apply_steer(ego, action, DT)
        came.append((ego.x, ego.y, ego.heading, ego.speed))
        place = (np.array([other.x]), np.array([other.y]), np.array([other.heading]))
        at, v = many.step(k * DT, (at, v), place, np.array([other.speed]), np.array([np.inf]))
        foreseen.append((at[0], many.d[0], many.turn[0], v[0]))
    return np.array(came), np.array(foreseen)


def test_alone_it_goes_on_as_unattacked() -> None:
    """50 steps of 0.1 s at 15 m/s: 75 m."""
    came, foreseen = driven(15.0, (300.0, 0.0, 0.0, 15.0, 0.0, 0.0))
    assert foreseen[-1] == pytest.approx((75.0, 0.0, 0.0, 15.0), abs=1e-6)
    assert came == pytest.approx(foreseen, abs=0.05)


def test_it_brakes_for_one_that_moves_in_near_before_it() -> None:
    """On one lane there is nowhere to go: it brakes, hard at first."""
    came, foreseen = driven(15.0, (4.0, 3.2, -0.12, 15.0, 0.0, 0.0))
    assert foreseen[:, 3].min() < 9.0
    assert abs(foreseen[:, 1]).max() < 0.01
    assert came == pytest.approx(foreseen, abs=0.3)


def test_it_swerves_into_a_free_lane_for_a_wreck() -> None:
    """A stopped car 25 m ahead, which full braking from 20 m/s (25 m) cannot stop short of: it goes round on the left
    of it, at more than the boxes' width of 2 m."""
    came, foreseen = driven(20.0, (27.0, -0.4, 0.0, 0.0, 0.0, 0.0), sides=(3.2,))
    passing = foreseen[(foreseen[:, 0] > 22.0) & (foreseen[:, 0] < 32.0), 1]
    assert len(passing)
    assert passing.min() > 1.6
    assert came == pytest.approx(foreseen, abs=0.3)


def test_one_that_is_wholly_behind_in_its_lane_is_left_alone() -> None:
    _, foreseen = driven(15.0, (-12.0, 0.0, 0.0, 20.0, 0.0, 0.0), steps=8)
    assert foreseen[-1] == pytest.approx((12.0, 0.0, 0.0, 15.0), abs=1e-6)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    st.floats(6.0, 28.0), st.floats(3.0, 60.0), st.floats(-5.0, 5.0), st.floats(-0.15, 0.15), st.floats(0.0, 28.0),
    st.floats(-4.0, 2.0), st.booleans(),
)  # fmt: skip
def test_one_that_goes_the_same_way_is_met_as_the_controller_meets_it(
    speed: float, x: float, y: float, heading: float, other: float, acceleration: float, two: bool
) -> None:
    """For two seconds within a metre: where two candidates cost nearly the same either may be taken for a step."""
    came, foreseen = driven(speed, (x, y, heading, other, acceleration, 0.0), (3.2,) if two else (), steps=20)
    assert np.abs(came[:, :2] - foreseen[:, :2]).max() < 1.0


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    st.floats(6.0, 20.0), st.floats(10.0, 50.0), st.floats(-25.0, -8.0), st.floats(1.2, 1.9), st.floats(2.0, 15.0),
    st.floats(-0.3, 0.3),
)  # fmt: skip
def test_one_that_crosses_is_met_as_the_controller_meets_it(
    speed: float, x: float, y: float, heading: float, other: float, turn: float
) -> None:
    came, foreseen = driven(speed, (x, y, heading, other, 0.0, turn), steps=20)
    assert np.abs(came[:, :2] - foreseen[:, :2]).max() < 1.0


SAMPLED = ("DURATIONS", "STEPS_ASIDE", "BRAKES", "RAMP")
PRICED = (
    "CONTACT", "CONTACT_SOON", "CONTACT_FADES", "NEAR", "NEAR_FADES", "CLOSE", "CONTACT_MARGIN", "NEAR_MARGIN",
    "CLOSE_MARGIN", "CLOSE_HEADWAY", "OFF_ROAD", "SLOWER", "FASTER", "BRAKING", "JERK_ASIDE", "ACCELERATION_ASIDE",
    "ASIDE", "STRAYING", "CHANGE", "OTHER_LANE", "SLOPE", "STEEP", "GRIP", "SLIDING",
)  # fmt: skip
DRIVEN = ("STEP", "WHEELBASE", "EASING", "EASED", "SETTING_OFF", "KEEPING", "LOOK", "LEAST_LOOK", "MAX_STEERING")
SEEN = ("DRIFT_RATE", "DRIFT_TIME", "ALONG", "SMOOTHING", "STOPPING_SHORT")


@pytest.mark.parametrize(
    ("names", "mine", "theirs"),
    [
        (SAMPLED, lattice_choice, lattice_sample), (PRICED, lattice_choice, lattice_cost),
        (DRIVEN, lattice_model, controller), (SEEN, lattice_model, lattice_frame),
    ],
)  # fmt: skip
def test_its_numbers_are_the_controllers(names: tuple[str, ...], mine: Any, theirs: Any) -> None:
    assert [getattr(mine, n) for n in names] == [getattr(theirs, n) for n in names]


def test_its_settings_are_the_controllers() -> None:
    own = controller.LatticeSettings()
    assert (own.horizon, own.braking, own.lateral) == (
        lattice_model.HORIZON,
        lattice_model.BRAKING,
        lattice_model.LATERAL,
    )
    assert lattice_model.SLOWING == lattice_frame.BRAKING
