"""Predictions that stop asking the planner early: the paths part, the vehicles pass each other, or one falls behind."""

from __future__ import annotations

import math

import numpy as np
from situation_samples import EGO_PATH, car, line, neighbour, situation, target

from sumo_adv.planners.adversary_batch import AdversaryBatch
from sumo_adv.search.early_termination import EarlyTermination
from sumo_adv.situation import Target


def gone(vehicle: Target, stations: list[float], egos: list[float], *, held_up: bool = False) -> list[bool]:
    """Whether it has parted, asked at one moment after the other; centres, [m] along its way and the ego's path."""
    ground = AdversaryBatch([situation([vehicle])], ["bv"])
    parting, start = EarlyTermination(ground, held_up=held_up), ground.begin()
    return [
        bool(parting.gone(start._replace(s=np.array([s])), np.array([ego]))[0])
        for s, ego in zip(stations, egos, strict=True)
    ]


def crossing() -> Target:
    """From 25 m south of the ego's path at x = 30 straight north."""
    way = line((30.0, -25.0), (30.0, 150.0))
    return target(car("bv", 30.0, -25.0, math.pi / 2, 8.0), "crossing", [(way, "straight", 15.0)], EGO_PATH)


def test_a_vehicle_that_has_crossed_the_ego_s_path_cannot_meet_it_again() -> None:
    """Its way is less than 8 m from the path until 32.5 m along it, and 8 m more are allowed: with its rear (2.5 m)
    past 40.5 m it is gone."""
    assert gone(crossing(), [30.0, 42.5, 43.5], [0.0, 0.0, 0.0]) == [False, False, True]


def test_nor_when_the_ego_has_crossed_its_way() -> None:
    """They meet 30 m along the ego's path: with its rear 8 m further, past 40.5 m, the ego is gone."""
    assert gone(crossing(), [0.0, 0.0], [40.0, 41.0]) == [False, True]


def test_an_oncoming_vehicle_is_gone_once_it_has_passed_the_ego() -> None:
    """It starts 100 m ahead. The ego at 20 m, it at 16 m (84 m along its way): 4 m behind, their boxes overlap along
    the road by 1 m. At 11.9 m there are 3.1 m between the ego's rear and its own."""
    towards = target(
        car("bv", 100.0, 3.2, math.pi), "oncoming", [(line((100.0, 3.2), (-100.0, 3.2)), "none", math.inf)], EGO_PATH
    )
    assert gone(towards, [84.0, 87.0, 88.1], [20.0, 20.0, 20.0]) == [False, False, True]


def test_a_vehicle_is_gone_after_it_fell_behind_three_times_running_without_catching_up() -> None:
    beside = neighbour(x=0.0)
    assert gone(beside, [0.0] * 5, [14.0, 15.5, 18.0, 20.0, 22.0]) == [False, False, False, True, True]
    assert gone(beside, [0.0, 0.0, 5.0, 5.0], [16.0, 18.0, 20.0, 22.0]) == [False, False, False, False]


def test_a_vehicle_that_falls_behind_an_ego_which_a_support_may_hold_up_is_not_gone() -> None:
    assert gone(neighbour(x=0.0), [0.0] * 5, [14.0, 15.5, 18.0, 20.0, 22.0], held_up=True) == [False] * 5
