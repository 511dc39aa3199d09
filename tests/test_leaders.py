"""Leaders of the ego other than the adversary, and when the adversary held the ego up.

Everywhere the ego goes east along y = 0 from 0 m at 10 m/s, 5 m long; Krauss's driver would go 15 m/s, and keeps
10 m/s behind a car of that speed at a gap of 12.5 m (2.5 m and one second).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from situation_samples import KRAUSS, changed, leader, line, situation

from sumo_adv.datatypes import DriverModel, Role, Track
from sumo_adv.drivers.car_following import CarFollowing
from sumo_adv.drivers.leaders import Leaders
from sumo_adv.drivers.prediction import PredictedEgos
from sumo_adv.drivers.scenes import Scenes
from sumo_adv.situation import OnPath, Situation, on_path

HERE = 17.5  # m: centre of a car of 5 m with 12.5 m to the ego's front


def car(name: str, s: float, d: float = 0.0, speed: float = 10.0) -> OnPath:
    """A car that goes along the ego's path for the 5 s of the profile."""
    time = 0.1 * np.arange(51)
    return OnPath(name, s + speed * time, np.full(51, d), np.zeros(51), np.full(51, speed), 5.0)


def behind(*others: OnPath, model: DriverModel = KRAUSS) -> Situation:
    return changed(situation([leader(12.5)], model=model), ahead=others)


def leaders(sit: Situation) -> Leaders:
    return Leaders(Scenes([sit]), ["bv"], np.array([5.0]), CarFollowing(sit.baseline.model, 0.1))


def gone(sit: Situation, seconds: float) -> PredictedEgos:
    """The egos after so long with the adversary far aside."""
    egos = PredictedEgos(Scenes([sit]), ["bv"], np.array([5.0]), np.array([2.0]))
    aside = (np.array([0.0]), np.array([50.0]), np.array([0.0]))
    for k in range(round(seconds / 0.1)):
        egos.step(0.1 * k, aside, np.array([0.0]))
    return egos


def test_an_ego_whose_leader_leaves_goes_faster_than_it_did() -> None:
    """By 2.6 m/s2 for a second: 12.6 m/s; in the end 15 m/s."""
    sit = behind(car("bv", HERE))
    assert leaders(sit).held_up(np.array([0.0]))[0]
    assert gone(sit, 1.0).v[0] == pytest.approx(12.6)
    assert gone(sit, 4.0).v[0] == pytest.approx(15.0, abs=0.3)


def test_where_somebody_else_is_why_it_goes_no_faster_it_stays_behind_that_one() -> None:
    """The other keeps 10 m/s, 20 m ahead of the leader that leaves: at first there is room, then 12.5 m again."""
    assert gone(behind(car("bv", HERE), car("second", HERE + 20.0)), 4.9).v[0] < 13.0
    sit = replace(behind(car("bv", 60.0), car("second", HERE)))
    assert not leaders(sit).held_up(np.array([0.0]))[0]
    assert gone(sit, 4.0).v[0] == pytest.approx(10.0)


def test_a_vehicle_far_ahead_or_in_another_lane_does_not_hold_the_ego_up() -> None:
    """At 10 m/s, below 60 km/h, SUMO's drivers pass on the right of a slower one."""
    assert not leaders(behind(car("bv", 80.0))).held_up(np.array([0.0]))[0]
    assert not leaders(behind(car("bv", HERE, d=3.2))).held_up(np.array([0.0]))[0]


def test_faster_than_60_km_h_one_in_the_lane_to_the_left_holds_it_up_as_well() -> None:
    """At 20 m/s the gap is 22.5 m."""
    fast = replace(KRAUSS, speed=30.0)
    beside = car("bv", 27.5, d=3.2, speed=20.0)
    sit = changed(situation([leader()], model=fast, speed=20.0), ahead=(beside,))
    assert leaders(sit).held_up(np.array([0.0]))[0]
    passes = changed(sit, model=replace(fast, ignores_sumo_lane_rules=True))
    assert not leaders(passes).held_up(np.array([0.0]))[0]


@pytest.mark.parametrize("model", [replace(KRAUSS, kind="eidm"), replace(KRAUSS, known=False)])
def test_of_a_driver_whose_following_is_not_known_exactly_nothing_is_said(model: DriverModel) -> None:
    assert not leaders(behind(car("bv", HERE), model=model)).held_up(np.array([0.0]))[0]


def test_it_was_held_up_until_it_brakes_for_something_else() -> None:
    """Its leader turns off after 2 s; the ego speeds up, and brakes from 4 s on."""
    turning_off = car("bv", HERE)
    turning_off.d[20:] = 20.0
    sit = behind(turning_off)
    a = np.where(np.arange(51) < 20, 0.0, np.where(np.arange(51) < 40, 1.0, -2.0))
    v = 10.0 + np.concatenate([[0.0], np.cumsum(a[:-1]) * 0.1])
    sit = changed(sit, a=a, v=v, s=np.concatenate([[0.0], np.cumsum(v[:-1]) * 0.1]))
    at = sit.baseline.s[[5, 25, 39, 45]]
    held = [bool(leaders(sit).held_up(np.array([s]))[0]) for s in at]
    assert held == [True, True, True, False]


def test_the_speed_behind_the_nearest_other_in_the_lane() -> None:
    """12.5 m behind a car of 10 m/s: 10 m/s; without a leader in the lane there is no such speed; a second later the
    others are 10 m farther."""
    ahead = leaders(behind(car("bv", 10.0), car("near", HERE), car("far", 60.0), car("aside", 8.0, d=3.2)))
    at, v, disturbed = np.array([0.0]), np.array([10.0]), np.array([True])
    assert ahead.bound(0.0, at, v, disturbed)[0] == pytest.approx(10.0, abs=0.001)
    assert ahead.bound(1.0, at + 10.0, v, disturbed)[0] == pytest.approx(10.0, abs=0.001)
    assert ahead.bound(0.0, at, v, ~disturbed)[0] == math.inf  # what it does unattacked has that in it
    assert leaders(behind(car("bv", 10.0))).bound(0.0, at, v, disturbed)[0] == math.inf


def test_a_crossing_vehicle_is_no_leader() -> None:
    """It stands across the ego's lane: what the ego does about that is a matter of the junction."""
    across = car("second", HERE, speed=0.0)
    across.heading[:] = 1.5
    ahead = leaders(behind(car("bv", 60.0), across))
    assert ahead.bound(0.0, np.array([0.0]), np.array([10.0]), np.array([True]))[0] == math.inf


def beyond(leaders: Leaders, at: float, aside: float, speed: float, seconds: float) -> None:
    """So long with the adversary's centre at a station, its front at an offset."""
    for k in range(round(seconds / 0.1)):
        leaders.step(0.1 * k, np.array([at]), np.array([aside]), np.array([speed]))


def test_a_vehicle_between_brakes_for_a_standing_adversary_and_the_ego_brakes_for_the_vehicle() -> None:
    """The other is 22.5 m ahead at 10 m/s, the adversary stands 25 m before its front. After 2 s it would be past that;
    an ego of 10 m/s 20 m behind where it would be is too near to it then, though nothing happened to the ego itself."""
    ahead = leaders(behind(car("bv", 80.0), car("between", 27.5)))
    at, v = np.array([19.0]), np.array([10.0])
    beyond(ahead, 57.5, 0.0, 0.0, 2.0)
    assert ahead.bound(2.0, at, v, np.array([False]))[0] < 9.9
    free = leaders(behind(car("bv", 80.0), car("between", 27.5)))
    beyond(free, 57.5, 3.2, 0.0, 2.0)  # in the lane beside: at 10 m/s it goes by on the right
    assert free.bound(2.0, at, v, np.array([False]))[0] == math.inf


def test_a_vehicle_behind_a_braking_leader_brakes_too() -> None:
    ahead = leaders(behind(car("bv", 80.0), car("first", 40.0), car("second", 22.5)))
    beyond(ahead, 60.0, 0.0, 0.0, 3.0)
    assert ahead.bound(3.0, np.array([20.0]), np.array([10.0]), np.array([False]))[0] < 9.9


def test_others_that_a_log_moves_do_not_brake() -> None:
    sit = changed(behind(car("bv", 80.0), car("between", 27.5)), reacting=False)
    ahead = leaders(sit)
    beyond(ahead, 57.5, 0.0, 0.0, 2.0)
    assert ahead.bound(2.0, np.array([19.0]), np.array([10.0]), np.array([False]))[0] == math.inf


def test_a_track_in_the_frame_of_the_egos_path() -> None:
    """A car 3 m to the left that appears after half a second, on a path that goes north."""
    path = line((0.0, 0.0), (0.0, 300.0))
    time, k = 100.5 + 0.1 * np.arange(3), np.arange(3.0)
    full = np.full(3, 10.0)
    track = Track(
        "a", Role.BACKGROUND, time, full * 0.0 - 3.0, 20.0 + k, full * 0.0 + math.pi / 2, full, full * 0.0, 5.0, 2.0
    )
    motion = on_path(track, 100.0, 0.1, 10, path)
    assert np.isnan(motion.s[:5]).all()
    assert motion.s[5:8] == pytest.approx([20.0, 21.0, 22.0])
    assert motion.d[5:8] == pytest.approx([3.0, 3.0, 3.0])
    assert motion.heading[5:8] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)
    assert np.isnan(motion.speed[8:]).all()
