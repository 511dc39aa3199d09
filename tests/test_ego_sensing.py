"""Sensors that err and answers that are late, for any driver: what it sees, and what the ego does then."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ego_samples import CalmEgo

import sumo_adv
from sumo_adv import Observation, Steer
from sumo_adv.config import load_settings
from sumo_adv.datatypes import VehicleState
from sumo_adv.drivers import Action, LaneSpeed, Pose, UserEgo, make_ego
from sumo_adv.drivers.sensing import LateEgo, SensedEgo
from sumo_adv.drivers.tested import with_sensors
from sumo_adv.drivers.timing import TimedEgo
from sumo_adv.ego_sensing import EgoSensing
from sumo_adv.errors import UsageError

EGO = VehicleState("ego", 0.0, 0.0, 0.0, 10.0, 0.0, 4.5, 1.8, "lane")
OTHER = VehicleState("other", 30.0, 3.5, 0.0, 8.0, 0.0, 4.5, 1.8, "lane")


class Noting:
    """Notes what it sees, and answers with what it was given."""

    def __init__(self, answers: list[Action] | None = None) -> None:
        self.seen: list[Observation] = []
        self._answers = answers or []

    def reset(self, seed: int) -> None:
        self.seen.clear()

    def act(self, seen: Observation) -> Action:
        self.seen.append(seen)
        return self._answers[len(self.seen) - 1] if self._answers else None


def steps(count: int, *others: VehicleState) -> list[Observation]:
    """Steps of 0.1 s; the others go on along +x."""
    return [
        Observation(k / 10, 0.1, EGO, tuple(replace(o, x=o.x + o.speed * k / 10) for o in others)) for k in range(count)
    ]


def seen_of(sensing: EgoSensing, observations: list[Observation], seed: int = 0) -> list[list[VehicleState]]:
    driver = Noting()
    sensed = SensedEgo(UserEgo("noting", driver), sensing)
    sensed.reset(seed)
    for observation in observations:
        sensed.act(observation)
    return [list(seen.others) for seen in driver.seen]


def test_vehicles_beyond_the_range_are_not_seen() -> None:
    """30 m ahead and 3.5 m to the left are 30.2 m."""
    observation = steps(1, OTHER)
    assert seen_of(EgoSensing(range=30.3), observation) == [[OTHER]]
    assert seen_of(EgoSensing(range=30.1), observation) == [[]]


def test_with_a_delay_a_vehicle_is_seen_where_it_was_and_at_first_not_at_all() -> None:
    """At 0.3 s and with 0.2 s of delay it is where it was at 0.1 s: 0.8 m on at 8 m/s."""
    seen = seen_of(EgoSensing(delay=0.2), steps(4, OTHER))
    assert [[round(o.x, 6) for o in each] for each in seen] == [[], [], [30.0], [30.8]]


def test_noise_has_the_standard_deviation_that_was_asked_for() -> None:
    """Of 2000 draws the deviation is known within 5 % (three times 1 / sqrt(2 * 2000))."""
    still = replace(OTHER, speed=8.0)
    observations = [replace(o, others=(still,)) for o in steps(2000)]
    seen = [each[0] for each in seen_of(EgoSensing(position_noise=0.5, speed_noise=0.2), observations)]
    for values, deviation in (([o.x for o in seen], 0.5), ([o.y for o in seen], 0.5), ([o.speed for o in seen], 0.2)):
        assert np.std(values) == pytest.approx(deviation, rel=0.05)


def test_a_quarter_of_the_vehicles_is_missed() -> None:
    """Of 2000 looks a quarter within 3 %, three times sqrt(0.25 * 0.75 / 2000)."""
    seen = seen_of(EgoSensing(missed=0.25), [replace(o, others=(OTHER,)) for o in steps(2000)])
    assert sum(not each for each in seen) / 2000 == pytest.approx(0.25, abs=0.03)


def test_noise_follows_from_the_seeds_the_vehicle_and_the_time_alone() -> None:
    """Another vehicle beside it changes nothing; another seed, of the run or of the sensors, does."""
    noisy = EgoSensing(position_noise=0.5)
    alone = [each[0] for each in seen_of(noisy, steps(5, OTHER))]
    beside = [each[-1] for each in seen_of(noisy, steps(5, replace(OTHER, id="first"), OTHER))]
    assert alone == beside == [each[0] for each in seen_of(noisy, steps(5, OTHER))]
    assert alone != [each[0] for each in seen_of(noisy, steps(5, OTHER), seed=1)]
    assert alone != [each[0] for each in seen_of(EgoSensing(position_noise=0.5, seed=1), steps(5, OTHER))]


class Wary:
    """Slows down by what it sees: the nearer the others, and the faster, the slower it goes."""

    forkable = True

    def reset(self, seed: int) -> None:
        """There is nothing to forget."""

    def act(self, seen: Observation) -> LaneSpeed:
        near = sum(o.speed / max(math.hypot(o.x - seen.ego.x, o.y - seen.ego.y), 5.0) for o in seen.others)
        return LaneSpeed(None, 25.0 / (1.0 + near))


def late(answers: list[Action], latency: float | None) -> LateEgo:
    driver = LateEgo(TimedEgo(UserEgo("noting", Noting(answers))), latency)
    driver.reset(0)
    return driver


def test_an_answer_takes_effect_two_steps_later_and_sumo_drives_until_then() -> None:
    answers: list[Action] = [Steer(1.0, 0.0), Steer(2.0, 0.0), LaneSpeed(None, 9.0), None]
    driver = late(answers, 0.2)
    assert [driver.act(o) for o in steps(4)] == [None, None, answers[0], answers[1]]


def test_a_late_pose_changes_speed_and_heading_by_what_it_asked_for() -> None:
    """Asked for at 10 m/s: 0.5 m/s faster and turned by 0.1 rad. It takes effect where the ego goes 12 m/s along +y:
    12.5 m/s after 0.1 s at 12.25 m/s on average, 1.225 m further north."""
    driver = late([Pose(1.025, 0.0, 0.1, 10.5), None], 0.1)
    first, second = steps(2)
    north = replace(EGO, x=5.0, y=7.0, heading=math.pi / 2, speed=12.0)
    assert driver.act(first) is None
    pose = driver.act(replace(second, ego=north))
    assert isinstance(pose, Pose)
    assert (pose.x, pose.y, pose.heading, pose.speed) == pytest.approx((5.0, 8.225, math.pi / 2 + 0.1, 12.5))


def test_a_measured_answer_of_less_than_half_a_step_is_not_late() -> None:
    pose = Pose(1.0, 0.0, 0.0, 10.0)
    assert late([pose], None).act(replace(steps(1)[0], dt=0.5)) == pose


def test_a_driver_of_sumo_has_no_sensors_and_a_latency_is_at_least_half_a_step() -> None:
    with pytest.raises(UsageError, match=r"'idm' is driven by SUMO or by a log, which use no observation"):
        with_sensors(make_ego("idm", {}), load_settings(None, ego_latency=0.1))
    with pytest.raises(UsageError, match=r"ego_latency is less than half a step of 0\.1 s"):
        load_settings(None, ego_latency=0.02)
    driver, timed = with_sensors(UserEgo("calm", CalmEgo()), load_settings(None))
    assert driver is timed


def test_a_run_with_sensors_is_the_same_in_forks_and_without(tmp_path: Path) -> None:
    given: dict[str, Any] = {
        "ego": Wary, "memory": str(tmp_path / "bank.sqlite"), "learn": "off", "attempts": 2, "seconds": 30.0,
        "ego_sensing": {"position_noise": 0.3, "delay": 0.1, "missed": 0.1, "range": 80.0}, "ego_latency": 0.1,
    }  # fmt: skip
    attempts = [
        sumo_adv.run("motorway_cut_in_left", out=tmp_path / str(fork), fork=fork, **given).outcome.document["attempts"]
        for fork in (True, False)
    ]
    assert attempts[0] == attempts[1]
