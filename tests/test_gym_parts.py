"""What agents of the environments see, what their actions mean and what a step is worth, with numbers by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from situation_samples import line

from sumo_adv.datatypes import Level, Limits, VehicleState, Verdict
from sumo_adv.drivers import LaneSpeed, Observation, Steer
from sumo_adv.errors import UsageError
from sumo_adv.gym.actions import EGO_ACTIONS, action_space, controlled, ego_action, endpoint
from sumo_adv.gym.picture import beside
from sumo_adv.gym.policy import PolicyDriver
from sumo_adv.gym.rewards import Transition, adversary_reward, ego_reward
from sumo_adv.gym.views import AgentWatch, Viewing, view_of_ego

ME = VehicleState("ego", 100.0, 50.0, math.pi / 2, 20.0, 1.0, 5.0, 2.0, "north_1")  # on its way north
SEEN = Observation(3.0, 0.1, ME, (), math.pi / 2 - 0.1, 0.5, [(100.5, 40.0), (100.5, 50.0), (100.5, 62.0)])
ROAD = line((0.0, 0.0), (500.0, 0.0))


def vehicle(name: str, x: float, y: float, heading: float) -> VehicleState:
    return VehicleState(name, x, y, heading, 12.0, 0.0, 4.0, 1.8, "")


# ---- views


def test_the_ego_sees_all_in_its_own_frame() -> None:
    """East of it is to its right; a vehicle that goes west is turned left by 90 degrees."""
    seen = replace(SEEN, others=(vehicle("far", 100.0, 90.0, math.pi / 2), vehicle("near", 110.0, 70.0, math.pi)))
    view = view_of_ego(seen, 3)
    own = [20.0, 1.0, 0.5, math.sin(0.1), math.cos(0.1), 60.0, 0.0, 0.0, 120.0]
    assert view["own"] == pytest.approx(own, abs=1e-6)
    near = [1.0, 20.0, -10.0, 0.0, 1.0, 12.0, 4.0, 1.8]
    near += [-20.0, 12.0]  # it drives to the left, and the ego ahead
    near += [20.0, -9.5]  # the way is half a metre to the right
    near += [(20.0 * 20.0 + 10.0 * 12.0) / 500.0]  # of its distance a second
    assert view["vehicles"][0] == pytest.approx(near, abs=1e-5)
    assert view["vehicles"][1, :3] == pytest.approx([1.0, 40.0, 0.0], abs=1e-6)
    assert not view["vehicles"][2].any()
    assert view["path"][0] == pytest.approx([5.0, -0.5], abs=1e-5)
    assert view["path"][-1] == pytest.approx([12.0, -0.5], abs=1e-5)  # where the path ends


def test_without_a_path_the_way_is_straight_on() -> None:
    assert view_of_ego(replace(SEEN, path=None), 1)["path"][[0, 9]] == pytest.approx(
        np.array([[5.0, 0.0], [50.0, 0.0]]), abs=1e-4
    )


def test_the_watch_tells_when_a_careful_driver_sees_a_danger_and_brakes() -> None:
    """A vehicle stands 60 m ahead, which at 20 m/s takes 400 / 2 / (60 - 4.5 - 0.75 * 20) = 4.9 m/s2, more than 4.5. It
    is understood after 0.4 s; braking begins 0.75 s later and is whole, 0.774 g, after another 0.6 s."""
    watch, told = AgentWatch(), []
    for k in range(20):
        me = replace(ME, y=50.0 + 2.0 * k)
        standing = replace(vehicle("ahead", 100.0, 110.0, math.pi / 2), speed=0.0)
        seen = replace(SEEN, ego=me, time=0.1 * k, others=(standing,), lane_heading=math.pi / 2, path=None)
        watch.step(seen)
        told.append(view_of_ego(seen, 1, watch)["danger"])
    assert [list(numbers) for numbers in told[3:5]] == [[0.0, 0.0], [1.0, 0.0]]
    assert told[10][1] == 0.0
    assert 0.0 < told[11][1] < told[12][1]
    assert told[19][1] == pytest.approx(0.774 * 9.81, abs=1e-3)


@pytest.mark.parametrize("adversary", [False, True])
def test_a_vector_is_the_dictionary_by_its_largest_values(adversary: bool) -> None:
    view = view_of_ego(replace(SEEN, others=(vehicle("fast", 100.0, 450.0, 0.0),)), 2)
    if adversary:
        view = {"own": view["own"], "path": view["path"], "ego": view["vehicles"][0], "vehicles": view["vehicles"]}
    as_dict, as_vector = Viewing(2, vector=False), Viewing(2, vector=True)
    assert as_dict.space(adversary=adversary).contains(as_dict.given(view))
    vector = as_vector.given(view)
    assert as_vector.space(adversary=adversary).contains(vector)
    assert isinstance(vector, np.ndarray)
    assert len(vector) == 9 + 20 + 26 + (13 if adversary else 0)
    assert vector[[0, 1]] == pytest.approx([20 / 60, 1 / 15])
    assert vector[-25] == 1.0  # 400 m ahead is cut to 120 m


# ---- actions


@pytest.mark.parametrize(
    ("speed", "numbers", "expected"),
    [
        (20.0, (1.0, 0.0), (4.0, 0.0)),
        (20.0, (-0.5, 1.0), (-4.5, math.atan(6.0 * 2.8 / 400.0))),  # 6 m/s2 sideways
        (0.5, (0.0, -1.0), (0.0, -0.6)),  # the wheels' end stop
        (20.0, (7.0, 0.0), (4.0, 0.0)),
    ],
)
def test_controls_are_shares_of_what_a_car_can_do(speed: float, numbers: tuple[float, float], expected: object) -> None:
    action = ego_action("controls", np.array(numbers), replace(ME, speed=speed), 30.0, 0.1)
    assert isinstance(action, Steer)
    assert (action.acceleration, action.steering) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("numbers", "lane", "expected"),
    [
        ((1.0, 0.0), "north_1", LaneSpeed(None, 20.3)),  # towards 39 m/s with 3 m/s2
        ((-1.0, 0.9), "north_1", LaneSpeed(2, 19.2)),  # towards 0 with 8 m/s2, and to the left
        ((20.0 / 19.5 - 1.0, -0.5), "north_1", LaneSpeed(0, 20.0)),
        ((20.0 / 19.5 - 1.0, -0.5), "north_0", LaneSpeed(0, 20.0)),  # there is none to the right
        ((20.0 / 19.5 - 1.0, 0.9), ":junction_3_0", LaneSpeed(None, 20.0)),
    ],
)
def test_speed_and_lane(numbers: tuple[float, float], lane: str, expected: LaneSpeed) -> None:
    action = ego_action("lane", np.array(numbers), replace(ME, lane=lane), 30.0, 0.1)
    assert isinstance(action, LaneSpeed)
    assert (action.lane, action.speed) == (expected.lane, pytest.approx(expected.speed))


@pytest.mark.parametrize(
    ("speed", "pedal", "expected"),
    [
        (20.0, 1.0, 20.3),  # 3 m/s2
        (20.0, -1.0, 19.2),  # 8 m/s2
        (29.9, 1.0, 30.0),  # the speed limit
        (35.0, 1.0, 34.7),  # above it, gently towards it
        (0.2, -1.0, 0.0),
    ],
)
def test_pedals_keep_the_lane_and_the_speed_limit(speed: float, pedal: float, expected: float) -> None:
    action = ego_action("pedals", np.array([pedal]), replace(ME, speed=speed), 30.0, 0.1)
    assert action == LaneSpeed(None, pytest.approx(expected))


def test_an_endpoint_is_along_the_way_of_the_adversary() -> None:
    end = endpoint(np.array([0.0, 0.5, 1.0, -1.0]), ROAD, 100.0, 25.0)
    assert (end.x, end.y, end.heading, end.speed, end.time) == pytest.approx((135.0, 4.0, 0.0, 25.0, 0.5))


def test_an_adversarys_controls_stay_within_its_limits() -> None:
    """Full braking begins with 0.95 * 12 m/s3 * 0.1 s = 1.14 m/s2; full steering is 0.95 * 4 m/s2 at 20 m/s."""
    me = replace(ME, heading=0.0, acceleration=0.0)
    pose = controlled(np.array([-1.0, 1.0]), me, Limits(), 28.0, 0.1)
    travelled = (20.0 + 19.886) / 2 * 0.1
    assert pose.speed == pytest.approx(19.886)
    assert pose.heading == pytest.approx(0.95 * 4.0 / 400.0 * travelled)
    assert pose.x == pytest.approx(100.0 + travelled, abs=1e-3)
    assert controlled(np.array([1.0, 0.0]), replace(me, speed=28.0), Limits(), 28.0, 0.1).speed == 28.0


def test_unknown_actions_are_refused_with_the_known_ones() -> None:
    with pytest.raises(UsageError, match="no actions 'wheel'; choose pedals or controls or lane"):
        action_space(EGO_ACTIONS, "wheel")


# ---- rewards


def moved(**changes: object) -> Transition:
    t = Transition(0.5, replace(ME, speed=15.0), replace(ME, speed=16.0), ME, 20.0, 30.0, 32.0, None, None)
    return replace(t, **changes)  # type: ignore[arg-type]


def test_the_ego_loses_what_it_falls_behind_and_wins_it_back() -> None:
    """Half a metre of a second at 20 m/s; the ego in its lane alone pays 0.1 a second for each m/s2 beyond 2."""
    assert ego_reward(moved(attacked=True)) == 0.0
    assert ego_reward(moved(attacked=True, behind=3.0, behind_before=2.0)) == pytest.approx(-0.05)
    assert ego_reward(moved(attacked=True, behind=2.0, behind_before=3.0)) == pytest.approx(0.05)
    harder = replace(ME, speed=18.0)  # before: 6 m/s2
    assert ego_reward(moved(before=harder)) == pytest.approx(-0.1 * 4.0 * 0.5)
    assert ego_reward(moved(before=harder, attacked=True)) == 0.0
    assert ego_reward(moved(ego=None)) == 0.0


def test_the_ego_pays_for_harm_and_for_blocking() -> None:
    assert ego_reward(moved(touched="bv", delta_v=3.0)) == pytest.approx(-(2.0 + 4.0 * 3.0))
    assert ego_reward(moved(off_road="ego")) == pytest.approx(-20.0)
    assert ego_reward(moved(off_road="bv")) == 0.0
    assert ego_reward(moved(unattacked=31.0)) == 0.0
    assert ego_reward(moved(unattacked=31.0, followed=True)) == pytest.approx(-0.25)
    assert ego_reward(moved(unattacked=29.0, followed=True)) == 0.0


def test_the_adversary_is_rewarded_for_the_level_it_reaches() -> None:
    strict = Verdict(0.0, 0.0, True, True, True, False, level=Level.STRICT)
    assert adversary_reward(moved()) == pytest.approx(0.04)  # two metres nearer
    assert adversary_reward(moved(ending="contact", verdict=strict)) == pytest.approx(8.0)
    assert adversary_reward(moved(ending="passed")) == 0.0
    assert adversary_reward(moved(adversary=None)) == 0.0


# ---- a policy as a driver, and the picture


def test_a_policy_decides_every_so_often_and_its_action_holds_until_then() -> None:
    speeds_seen: list[float] = []

    def policy(vector: np.ndarray) -> np.ndarray:
        speeds_seen.append(float(vector[0]) * 60.0)
        return np.array([1.0, 0.0])

    driver = PolicyDriver(policy, actions="controls", vehicles=2, interval=0.2)
    driver.reset(0)
    for k in range(5):
        action = driver.act(replace(SEEN, time=3.0 + 0.1 * k, ego=replace(ME, speed=20.0 + k)))
        assert action == Steer(4.0, 0.0)
    assert speeds_seen == pytest.approx([20.0, 22.0, 24.0])
    driver.reset(0)
    driver.act(SEEN)
    assert len(speeds_seen) == 4


def test_a_policy_that_gives_nan_is_named() -> None:
    driver = PolicyDriver(lambda vector: np.array([np.nan]), vehicles=2)
    with pytest.raises(UsageError, match=r"action of the agent 'policy' is \[nan\]: its numbers must be finite"):
        driver.act(SEEN)


def test_the_lines_of_a_lane_lie_beside_its_middle() -> None:
    assert beside(np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]]), 2.0)[0] == [0.0, 2.0]
