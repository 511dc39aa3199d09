"""Planners that write their own trajectory: it is driven as it says where that can be, within the limits where not."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import box
from situation_samples import KRAUSS, line, neighbour, situation
from trajectory_samples import lane_change

from sumo_adv.config import load_settings
from sumo_adv.datatypes import Bools, Floats, Limits, Planner, Proposal, Role, Track
from sumo_adv.episode.assessment import AttemptRunner
from sumo_adv.episode.attempt import PlannedAdversary
from sumo_adv.episode.engine import EpisodeCalls, episode_worker
from sumo_adv.episode.task import AttemptResult, FoundEncounter, make_task
from sumo_adv.errors import PlannerResultError
from sumo_adv.metrics.gates import motion
from sumo_adv.planners.follower import Follower, PlannedCourse, leaves_road, starting_now
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.sessions import Roads, Sessions
from sumo_adv.planners.trajectory import PathRow, Scalar, pose, start
from sumo_adv.search.rollouts import predict
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.inputs import load_input
from sumo_adv.simulation.network import Drivable
from sumo_adv.simulation.tracks import tracks_of

DT = 0.1
LIMITS = Limits()
EXAMPLES = settings(max_examples=25, deadline=None, derandomize=True)
ROAD = line((0.0, 0.0), (500.0, 0.0))
SIT = situation([neighbour()], model=replace(KRAUSS, kind="replay"))  # the BV at x = 20 m, y = 3.2 m with 12 m/s
HERE = Roads({0.0: SIT})


# ---- a line of states


def straight(v: float, a: float = 0.0, n: int = 40, y: float = 0.0) -> Floats:
    t = DT * np.arange(n)
    return np.column_stack([v * t + a * t * t / 2, 0.0 * t + y, 0.0 * t, v + a * t])


def test_speed_and_accelerations_are_those_of_the_positions() -> None:
    line = PlannedCourse(straight(10.0, 2.0), DT)
    assert line.v == pytest.approx(10.0 + 0.2 * np.arange(40))
    assert line.a == pytest.approx([2.0] * 40)
    turn = 0.2 * DT * np.arange(40)  # a circle of 50 m at 10 m/s: 2 m/s2, 0.02 1/m
    line = PlannedCourse(np.column_stack([50.0 * np.sin(turn), 50.0 - 50.0 * np.cos(turn), turn, 0.0 * turn]), DT)
    assert line.lateral == pytest.approx([2.0] * 40, abs=0.02)
    assert line.curvature == pytest.approx([0.02] * 40, abs=3e-4)
    assert line.heading == pytest.approx(turn, abs=0.003)


def test_what_no_vehicle_can_do_is_named_with_its_limit() -> None:
    assert PlannedCourse(straight(10.0, 2.0), DT).beyond(LIMITS, 20.0) == ""
    assert PlannedCourse(straight(10.0, 5.0), DT).beyond(LIMITS, 50.0) == "acceleration 5 m/s2 (at most 4)"
    assert (
        PlannedCourse(straight(30.0, -9.0, n=30), DT).beyond(LIMITS, 20.0)
        == "braking 9 m/s2 (at most 8), speed 30 m/s (at most 20)"
    )


def test_states_from_now_on_and_from_a_step_later_differ_by_their_place() -> None:
    states = straight(10.0)
    assert starting_now(states, 0.0, 0.0, 0.0, DT) is states
    later = starting_now(states[1:], 0.0, 0.0, 0.0, DT)
    assert later[:, :3] == pytest.approx(states[:, :3])


def test_the_first_moment_off_the_road_is_found() -> None:
    def on_road(x: Floats, y: Floats) -> Bools:
        return np.asarray(x < 32.4)

    # the front is 5 / 2 - 0.15 = 2.35 m ahead: at 32.4 m once x is 30.05, after 3.01 s: 3.1 s, too far ahead
    assert leaves_road(straight(10.0)[1:], 5.0, 2.0, DT, on_road) is None
    assert leaves_road(straight(20.0)[1:], 5.0, 2.0, DT, on_road) == pytest.approx(1.6)  # x = 30.05 after 1.503 s


# ---- a vehicle after it


def drive(states: Floats, v: float, y: float = 0.0, limits: Limits = LIMITS) -> tuple[Floats, Follower]:
    """Rows x, y, heading, speed, acceleration of a vehicle at the origin that drives after the states."""
    road, follower = PathRow(ROAD), Follower(PlannedCourse(states, DT), ROAD)
    m = follower.begin(start(Scalar, 0.0, y, 0.0, v, 0.0))
    rows = []
    while not follower.over:
        m = follower.advance(m, road, limits, 60.0, True)
        rows.append((*pose(Scalar, m, road), m.v, m.a))
    return np.array(rows), follower


def test_what_can_be_driven_is_driven_to_the_centimetre() -> None:
    states = straight(10.0, 1.0)
    states[:, 1] = (
        1.5 * (1.0 - np.cos(math.pi * np.arange(40) / 39)) / 2
    )  # 1.5 m to the left in 3.9 s: at most 0.5 m/s2
    rows, follower = drive(states, 10.0)
    assert np.hypot(rows[:, 0] - states[1:, 0], rows[:, 1] - states[1:, 1]).max() < 0.08
    assert follower.farthest < 0.08
    assert rows[-1, 3] == pytest.approx(13.9, abs=0.05)


def test_in_a_bend_the_line_is_kept_and_not_the_lane() -> None:
    """A lane of 30 m radius; the line is a circle of 31.5 m round the same centre: 1.5 m to the right of the lane."""
    lane = line(*((30.0 * math.sin(a), 30.0 - 30.0 * math.cos(a)) for a in np.arange(0.0, 3.1, 0.01)))
    turn = 0.5 + 8.0 / 31.5 * DT * np.arange(50)
    states = np.column_stack([31.5 * np.sin(turn), 30.0 - 31.5 * np.cos(turn), turn, 0.0 * turn + 8.0])
    road, follower = PathRow(lane), Follower(PlannedCourse(states, DT), lane)
    m = follower.begin(start(Scalar, 15.0, -1.5, 0.0, 8.0, 0.0))
    for k in range(49):
        m = follower.advance(m, road, LIMITS, 60.0, True)
        x, y, h = pose(Scalar, m, road)
        assert math.hypot(x, y - 30.0) == pytest.approx(31.5, abs=0.1)
        assert math.dist((x, y), states[k + 1, :2]) < 0.25
    assert h == pytest.approx(turn[-1], abs=0.02)
    assert m.v == pytest.approx(8.0, abs=0.1)


def test_a_vehicle_beside_the_line_comes_back_to_it() -> None:
    rows, _ = drive(straight(10.0, n=60), 10.0, y=0.6)
    assert rows[-1, 1] == pytest.approx(0.0, abs=0.02)
    assert rows[:, 1].min() > -0.12  # hardly beyond


def test_too_fast_a_timetable_makes_it_late_and_not_faster_than_the_limits() -> None:
    """People speed up with 4 - 2 (v - 5) / 15 m/s2 at most, 3.33 m/s2 at 10 m/s, of which 95 % are used."""
    rows, follower = drive(straight(10.0, 9.0), 10.0)
    assert 3.0 < rows[:, 4].max() <= 0.95 * 10.0 / 3.0
    assert follower.farthest > 10.0


@EXAMPLES
@given(st.floats(0.0, 25.0), st.floats(-14.0, 9.0), st.floats(-3.0, 3.0), st.floats(0.3, 3.0))
def test_the_limits_hold_whatever_it_writes(v: float, a: float, aside: float, time: float) -> None:
    states = straight(v, a, n=50)
    states[:, 0] = np.maximum.accumulate(states[:, 0])
    states[:, 1] = aside * np.clip(DT * np.arange(50) / time, 0.0, 1.0) ** 2
    try:
        rows, _ = drive(states, v)
    except PlannerResultError:  # it turns off its way
        return
    t, (x, y, h, speed, acceleration) = DT * np.arange(float(len(rows))), rows.T
    batch = motion(Track("bv", Role.ADVERSARY, t, x, y, h, speed, acceleration, 5.0, 2.0))
    assert batch.lateral.max() <= 4.1
    assert batch.curvature.max() <= 0.21
    assert acceleration.min() >= -8.0 - 1e-9 and acceleration.max() <= 4.0 + 1e-9
    assert np.abs(batch.jerk).max() <= 12.0 + 1e-6
    step = np.hypot(np.diff(x), np.diff(y))
    assert step == pytest.approx((speed[1:] + speed[:-1]) / 2 * DT, abs=1e-3)


def test_a_line_that_is_none_on_this_way_is_refused() -> None:
    for states, words in (
        (straight(10.0, n=3), "gave 3 states"),
        (straight(10.0) * np.array([-1.0, 1.0, 1.0, 1.0]), "does not go the endpoint's way"),
    ):
        with pytest.raises(PlannerResultError, match=words):
            Follower(PlannedCourse(states, DT), ROAD)


# ---- attempts and predictions


@dataclass(frozen=True)
class AdversaryController:
    """A vehicle led by a planner: its poses (x, y, heading, speed, acceleration), the message, the failure."""

    rows: Floats
    message: str
    failure: str | None


def lead(
    sandbox: Sandbox, planner: Planner, steps: int = 80, every: int = 5, **numbers: float
) -> tuple[AdversaryController, Any, dict[str, str]]:
    """The adversary of an attempt without SUMO against an ego that keeps 10 m/s, and the prediction of the same."""
    proposal = Proposal("bv", planner.label, planner, {**planner.defaults(), **numbers}, 0.0, 0.0)
    with Sessions(sandbox, HERE, [proposal], 0) as sessions:
        adversary = PlannedAdversary(SIT, "bv", LIMITS, partial(sessions.answer, proposal))
        rows, failure = [], None
        for k in range(steps):
            if k % every == 0:
                failure = adversary.replan(k * DT, (k * 1.0, 0.0, 10.0, 0.0))
                if failure is not None:
                    break
            p = adversary.advance()
            rows.append((p.x, p.y, p.heading, p.speed, adversary.motion.a))
        both = [proposal, proposal]
        rollouts = predict(
            HERE.situations, both, lambda k, told: sessions.answers(both, k, told), limits=LIMITS, steps=steps + 1,
            replan=every,
        )  # fmt: skip
        return AdversaryController(np.array(rows), adversary.message, failure), rollouts, sessions.failures


@pytest.mark.parametrize(("lateral", "slower"), [(2.0, 0.0), (12.0, 0.0), (2.0, 12.0)])
def test_prediction_and_attempt_are_the_same_motion(sandbox: Sandbox, lateral: float, slower: float) -> None:
    """For 6 s: after that the slower one has fallen so far behind that predictions ask it no more."""
    led, rollouts, _ = lead(sandbox, lane_change(), lateral=lateral, slower=slower)
    for k in range(4):
        assert rollouts.adversary[k][1, 1:61] == pytest.approx(led.rows[:60, k], abs=1e-9)


def test_a_gentle_lane_change_pulls_no_more_than_it_says(sandbox: Sandbox) -> None:
    led, _, _ = lead(sandbox, lane_change())
    yaw_rate = np.gradient(np.unwrap(led.rows[:, 2]), DT)
    assert 1.0 < np.abs(led.rows[:, 3] * yaw_rate).max() <= 2.0
    assert led.rows[-1, 1] == pytest.approx(0.0, abs=0.02)
    assert (led.message, led.failure) == ("", None)


def test_the_limits_are_named_to_the_modifier(sandbox: Sandbox) -> None:
    # 3.2 m in sqrt(6 * 3.2 / 12) = 1.26 s
    led, _, failures = lead(sandbox, lane_change(), lateral=12.0)
    assert led.message.startswith(
        "0.0 s after the takeover: trajectory() was brought within the limits: it has sideways "
    )
    assert "m/s2 (at most 4)" in led.message
    assert failures == {}


def test_a_trajectory_that_ends_goes_over_into_the_built_in_one(sandbox: Sandbox) -> None:
    four = "return [(bv['x'] + bv['speed'] * dt * k, bv['y'], 0.0, bv['speed']) for k in range(1, 5)]"
    led, rollouts, _ = lead(sandbox, lane_change(four), every=100)
    assert led.rows[:4, 1] == pytest.approx(3.2)
    assert led.rows[-1, 1] == pytest.approx(0.0, abs=0.01)  # of the endpoint
    assert np.hypot(*np.diff(led.rows[:, :2], axis=0).T) == pytest.approx(1.2, abs=0.05)
    assert rollouts.adversary[1][0, 1:] == pytest.approx(led.rows[:, 1], abs=1e-9)


def test_where_a_trajectory_is_refused_the_built_in_one_drives_and_the_reason_is_said(sandbox: Sandbox) -> None:
    without, _, _ = lead(sandbox, lane_change(""))
    backwards = "return [(bv['x'] - k, bv['y'], 0.0, 10.0) for k in range(20)]"
    led, _, _ = lead(sandbox, lane_change(backwards))
    assert led.rows == pytest.approx(without.rows)
    assert without.message == ""
    assert "does not go the endpoint's way" in led.message and "built-in one was driven" in led.message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("return [(bv['x'], bv['y'], float('nan'), 1.0)]", "heading must be finite"),
        ("return [(bv['x'] + k + (5 if k > 7 else 0), bv['y'], 0.0, 10.0) for k in range(30)]", "jumps between states"),
        # 500 m where 12 m/s lead 1.2 m in 0.1 s
        ("return [(bv['x'], bv['y'], 0.0, 12.0), (bv['x'] + 500.0, bv['y'], 0.0, 12.0)]", "498.8 m from where the veh"),
        ("return [(bv['x'] + 9.0 * k, bv['y'], 0.0, 90.0) for k in range(30)]", "jumps between states 0 and 1, 7.8 m"),
        ("return [(bv['x'] + 9.0 + k, bv['y'], 0.0, 10.0) for k in range(30)]", "begins 9.0 m from where the vehicle"),
        ("return []", "must return 1 to 400 states"),
        ("return 1 / 0", "ZeroDivisionError"),
    ],
)
def test_what_is_no_trajectory_is_a_sentence(sandbox: Sandbox, text: str, words: str) -> None:
    led, _, failures = lead(sandbox, lane_change(text))
    assert led.failure is not None and words in led.failure
    assert list(failures.values()) == [led.failure]


def test_off_the_road_is_refused_with_the_time(sandbox: Sandbox) -> None:
    """To y = -4.8 m in sqrt(6 * 8 / 2) = 4.9 s.

    After 2 s: y = 0.29 m, 2.37 m/s aside at 12 m/s; the front right corner is 0.83 + 0.46 m further right: -1.0 m.
    """
    planner = lane_change()
    proposal = Proposal("bv", "x", planner, {**planner.defaults(), "beyond": -4.8}, 0.0, 0.0)
    for edge, refused in ((-0.97, True), (-9.0, False)):
        with Sessions(sandbox, HERE, [proposal], 0, drivable=Drivable(box(-50.0, edge, 500.0, 9.0))) as sessions:
            adversary = PlannedAdversary(SIT, "bv", LIMITS, partial(sessions.answer, proposal))
            assert adversary.replan(0.0, (0.0, 0.0, 10.0, 0.0)) is None
        assert ("trajectory() leaves the road 2.0 s later" in adversary.message) == refused


# ---- in SUMO


@pytest.fixture(scope="module")
def encounter(tmp_path_factory: pytest.TempPathFactory, sandbox: Sandbox) -> Iterator[AttemptRunner]:
    """A vehicle one lane to the left, 12 m ahead of the ego, at 20 m/s."""
    run_input = load_input(Path("neighbour_ahead_left"))
    given = load_settings(None, horizon=run_input.horizon, ego=run_input.ego_controller)
    with Engine(episode_worker) as engine:
        engine.call(EpisodeCalls.open, make_task(run_input, given, tmp_path_factory.mktemp("own")))
        encounter = engine.call(EpisodeCalls.seek, "")
        assert isinstance(encounter, FoundEncounter)
        yield AttemptRunner(engine, sandbox, encounter, 0)


def attempt(runner: AttemptRunner, planner: Planner, **numbers: float) -> tuple[AttemptResult, Track | None]:
    proposal = Proposal("left_ahead", planner.label, planner, {**planner.defaults(), **numbers}, 0.0, 0.0)
    (result,) = runner.attempt([proposal])
    tracks = {t.id: t for t in tracks_of(result.snapshots, result.sizes, {}, DT)}
    return result, tracks.get("left_ahead")


def test_in_sumo_a_cubic_of_2_metres_a_second_squared_is_driven_as_such(encounter: AttemptRunner) -> None:
    result, track = attempt(encounter, lane_change())
    assert result.verdict is not None
    assert (result.verdict.feasible, result.verdict.failed_gates) == (True, ())
    assert result.driven.message == "" and track is not None
    moving = track.between(result.start, math.inf)
    assert moving.y[0] - moving.y[-1] > 2.5  # it has come over
    assert 1.0 < motion(moving).lateral.max() <= 2.0


def test_in_sumo_a_cubic_of_20_metres_a_second_squared_is_brought_within_4(encounter: AttemptRunner) -> None:
    result, track = attempt(encounter, lane_change(), lateral=20.0)
    assert result.verdict is not None and result.verdict.feasible and track is not None
    assert "brought within the limits: it has sideways" in result.driven.message
    assert 3.0 < motion(track.between(result.start, math.inf)).lateral.max() <= 4.1


def test_in_sumo_a_trajectory_that_jumps_ends_the_attempt_with_the_reason(encounter: AttemptRunner) -> None:
    jumps = lane_change("return [(bv['x'] + k + (5 if k > 7 else 0), bv['y'], 0.0, 10.0) for k in range(30)]")
    result, _ = attempt(encounter, jumps)
    assert result.driven.ending == "planner_failed"
    assert "its trajectory jumps between states 7 and 8" in result.driven.message
