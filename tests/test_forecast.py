"""What the ego will do: its profile, its driver, when it is at a conflict; and rollouts of many attacks at once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from situation_samples import KRAUSS, changed, crossing, leader, neighbour, situation

from sumo_adv.datatypes import Bools, Floats, Limits, Planner, Proposal
from sumo_adv.geometry import Frame
from sumo_adv.planners.answers import (
    Answer,
    PlannerObservation,
    arrivals,
    expected_stations,
    local_endpoint,
    world_endpoint,
)
from sumo_adv.search.rollouts import Ask, Rollouts, predict
from sumo_adv.simulation.sumo_rules import SituationBatch, profile_at
from sumo_adv.situation import NO_ARRIVAL_S, Situation

SIT = situation([neighbour()])  # an ego at 10 m/s for 5 s


def array(*values: float) -> Floats:
    return np.array(values)


# ---- the unattacked profile


def test_the_profile_is_read_between_its_samples_and_goes_on_beyond_them() -> None:
    s, v = profile_at(SIT, array(0.0, 2.05, 5.0, 7.0))
    assert s == pytest.approx([0.0, 20.5, 50.0, 70.0])
    assert v == pytest.approx([10.0] * 4)


def test_an_ego_on_its_profile_is_forecast_by_it_shifted_to_where_it_is() -> None:
    braking = changed(SIT, s=SIT.baseline.s, v=np.linspace(10.0, 5.0, 51))
    s, v = expected_stations(SituationBatch([braking]), 2.0, array(20.4), array(8.3), array(0.0), array(0.0, 1.0))
    assert s[0] == pytest.approx([20.4, 30.4])  # 0.4 m ahead of its profile, and so it stays
    assert v[0] == pytest.approx([8.0, 7.0])


def test_a_disturbed_ego_keeps_its_acceleration_for_half_a_second_and_then_its_speed() -> None:
    s, v = expected_stations(
        SituationBatch([SIT] * 2), 2.0, array(20.0, 17.0), array(5.0, 10.0), array(-4.0, 0.0), array(0.0, 0.5, 1.0)
    )
    assert s[0] == pytest.approx([20.0, 22.0, 23.5])  # 5 -> 3 m/s on 2 m, then 1.5 m
    assert v[0] == pytest.approx([5.0, 3.0, 3.0])
    assert s[1] == pytest.approx([17.0, 22.0, 27.0])  # 3 m behind its profile: not on it


def test_a_braking_ego_never_rolls_back() -> None:
    s, v = expected_stations(SituationBatch([SIT]), 2.0, array(5.0), array(1.0), array(-8.0), array(0.5, 3.0))
    assert (v == 0.0).all()
    assert (np.diff(s[0]) == 0.0).all()


def test_arrivals_are_seconds_to_the_conflict_negative_once_past_and_never_for_a_standing_ego() -> None:
    s = array(20.0, 20.0, 20.0, 20.0, 20.0)
    v = array(10.0, 10.0, 0.0, 5.0, 10.0)
    at = array(50.0, 17.0, 50.0, 30.0, math.inf)[:, None]
    arrival = arrivals(SituationBatch([SIT] * 5), 2.0, s, v, array(0.0, 0.0, 0.0, 0.0, 0.0), at)
    assert arrival[:, 0] == pytest.approx([3.0, -0.3, NO_ARRIVAL_S, 2.0, NO_ARRIVAL_S], abs=1e-6)


# ---- rollouts


PLANNER = Planner("any", "plain", "", (), "seed")
End = Mapping[str, float]


def proposals(n: int) -> list[Proposal]:
    return [Proposal("bv", "any", PLANNER, {}, 0.0, 0.0) for _ in range(n)]


def roll(sit: Situation, answers: Sequence[End | None], steps: int = 50) -> tuple[Rollouts, list[PlannerObservation]]:
    """Rollouts of planners that always answer the same, in the ego's frame; and what row 0 was told."""
    observed: list[PlannerObservation] = []

    def ask(rows: Sequence[int], observations: Sequence[PlannerObservation]) -> list[Answer | None]:
        observed.append(observations[0])
        given = [answers[k] if k in rows else None for k in range(len(observations))]
        return [None if a is None else Answer(world_endpoint(sit, a)) for a in given]

    fixed: Ask = ask
    return predict({0.0: sit}, proposals(len(answers)), fixed, limits=Limits(), steps=steps, replan=5), observed


def end(x: float, y: float, speed: float, time: float = 5.0) -> dict[str, float]:
    return {"x": x, "y": y, "heading": 0.0, "speed": speed, "time": time}


def test_an_endpoint_comes_back_from_the_world_as_it_was_given() -> None:
    turned = replace(SIT, frame=Frame(7.0, -3.0, 2.0))
    given = {"x": 20.0, "y": 3.0, "heading": -0.5, "speed": 9.0, "time": 2.5}
    assert local_endpoint(turned, world_endpoint(turned, given)) == pytest.approx(given)


def test_an_adversary_that_is_left_alone_keeps_lane_and_speed_and_so_does_the_ego() -> None:
    rollouts, _ = roll(SIT, [None])
    x, y, h, v = rollouts.adversary
    assert rollouts.time == pytest.approx(np.arange(50) * 0.1)
    assert y[0] == pytest.approx(3.2)
    assert h[0] == pytest.approx(0.0)
    assert v[0] == pytest.approx(12.0)
    assert x[0] == pytest.approx(20.0 + 1.2 * np.arange(50))
    assert rollouts.ego[0][0] == pytest.approx(np.arange(50) * 1.0)
    assert not rollouts.disturbed[0]


def test_a_krauss_ego_brakes_for_a_leader_that_stops_and_does_not_hit_it() -> None:
    rollouts, _ = roll(situation([leader(gap=15.0)]), [end(35.0, 0.0, 0.0, 2.0)], steps=80)
    gap = rollouts.adversary[0][0] - rollouts.ego[0][0] - 5.0
    assert gap.min() > 1.0
    assert rollouts.ego[3][0, -1] < 1.0
    assert rollouts.disturbed[0]
    fall = np.diff(rollouts.ego[3][0]) / 0.1
    assert fall.min() >= -9.0 - 1e-6


def test_a_replayed_ego_yields_to_nobody() -> None:
    stubborn = situation([leader(gap=15.0)], model=replace(KRAUSS, kind="replay"))
    rollouts, _ = roll(stubborn, [end(35.0, 0.0, 0.0, 2.0)])
    assert rollouts.ego[0][0] == pytest.approx(np.arange(50) * 1.0)
    assert not rollouts.disturbed[0]
    assert (rollouts.adversary[0][0] - rollouts.ego[0][0] - 5.0).min() < 0.0


@pytest.mark.parametrize("kind", ["krauss", "idm", "careful"])
def test_a_neighbour_counts_as_a_leader_only_once_its_front_is_in_the_lane(kind: str) -> None:
    slow = situation([neighbour(x=20.0, speed=7.0)], model=replace(KRAUSS, kind=kind))
    beside, cutting_in = end(48.0, 3.2, 7.0, 4.0), end(48.0, 0.0, 7.0, 4.0)
    rollouts, _ = roll(slow, [beside, cutting_in], steps=70)
    assert rollouts.disturbed.tolist() == [False, True]
    assert rollouts.ego[3][1, -1] < rollouts.ego[3][0, -1] - 2.0
    assert rollouts.ego[0][0] == pytest.approx(np.arange(70) * 1.0)


def test_each_of_many_rollouts_goes_as_it_goes_alone() -> None:
    sit = situation([crossing()])
    answers = [
        {"x": 30.0, "y": 20.0, "heading": math.pi / 2, "speed": 12.0, "time": 4.0},
        {"x": 5.0, "y": -2.0, "heading": math.pi, "speed": 6.0, "time": 6.0},
        None,
    ]
    together, _ = roll(sit, answers)
    for k, answer in enumerate(answers):
        alone, _ = roll(sit, [answer])
        for a, b in zip((*together.ego, *together.adversary), (*alone.ego, *alone.adversary), strict=True):
            assert a[k] == pytest.approx(b[0], abs=1e-9)
    assert together.adversary[1][0, -1] > 2.0  # across the ego's path
    assert together.adversary[0][1, -1] < 25.0  # round the corner


def test_an_adversary_that_has_touched_the_ego_keeps_its_last_plan() -> None:
    """Asked every half second; the first of two touches after 0.7 s. From 1.0 s on only the other one is asked."""
    batches: list[list[int]] = []

    def ask(rows: Sequence[int], observations: Sequence[PlannerObservation]) -> list[Answer | None]:
        batches.append(list(rows))
        place = end(60.0, 3.2, 12.0, 3.0) if len(batches) <= 2 else end(60.0, 3.2, 4.0, 3.0)
        return [Answer(world_endpoint(SIT, place)) if k in rows else None for k in range(len(observations))]

    def touch(ego: Floats, adversary: Floats, untouched: Bools) -> Bools:
        assert ego.shape == adversary.shape == (4, 2)
        return np.array([ego[0, 0] >= 7.0 - 1e-9, False])  # 0.7 s at 10 m/s

    rollouts = predict({0.0: SIT}, proposals(2), ask, limits=Limits(), steps=30, replan=5, touch=touch)
    assert batches == [[0, 1], [0, 1], [1], [1], [1], [1]]
    first, second = rollouts.adversary[3]
    assert first[:10] == pytest.approx(second[:10])
    assert first[-1] > second[-1] + 2.0  # its plan keeps 12 m/s; the other plan slows down to 4 m/s


def test_once_all_have_touched_the_ego_goes_on_at_an_even_speed() -> None:
    """At 10 m/s it is at 7 m when it touches after 0.7 s, and at 29 m in the last step, 2.9 s from the trigger; the
    adversary follows its last plan, and its planner is asked no more."""
    times: list[float] = []

    def ask(rows: Sequence[int], observations: Sequence[PlannerObservation]) -> list[Answer | None]:
        times.append(observations[0][0]["time"])
        return [Answer(world_endpoint(SIT, end(60.0, 3.2, 12.0, 3.0)))]

    def touch(ego: Floats, adversary: Floats, untouched: Bools) -> Bools:
        return np.array([ego[0, 0] >= 7.0 - 1e-9])

    rollouts = predict({0.0: SIT}, proposals(1), ask, limits=Limits(), steps=30, replan=5, touch=touch)
    assert times == pytest.approx([0.0, 0.5])
    assert rollouts.ego[0][0].tolist() == pytest.approx([float(k) for k in range(30)])
    assert rollouts.ego[3][0].tolist() == pytest.approx([10.0] * 30)
    assert (np.diff(rollouts.adversary[0][0]) > 0.9).all()


def test_planners_get_the_time_and_their_last_endpoint_every_half_second() -> None:
    answer = end(60.0, 3.2, 12.0)
    _, observed = roll(SIT, [answer], steps=12)
    assert [bv["time"] for bv, _ in observed] == pytest.approx([0.0, 0.5, 1.0])
    lasts: list[Any] = [bv["last"] for bv, _ in observed]
    assert lasts[0] is None
    assert lasts[1] == pytest.approx(answer)
    assert [bv["x"] for bv, _ in observed][:1] == pytest.approx([20.0])
