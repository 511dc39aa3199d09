"""When attacks may begin. The ego goes east at 10 m/s, the other one comes from the south and crosses its way."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from situation_samples import EGO_PATH, car, crossing, leader, line, neighbour, target

from sumo_adv.config import Settings
from sumo_adv.datatypes import Role, Track
from sumo_adv.episode.encounter_detector import RankedVehicle
from sumo_adv.episode.situation_builder import delays, spent
from sumo_adv.situation import Target

LIMIT = 4.0  # m/s2


def drives(name: str, speed: float, seconds: float = 30.0) -> Track:
    """East at an even speed, a tenth of a second a step; how far it is says all."""
    time = np.arange(0.0, seconds, 0.1)
    same = np.full_like(time, speed)
    return Track(name, Role.BACKGROUND, time, speed * time, 0 * time, 0 * time, same, 0 * time, 5.0, 2.0)


def ranked(vehicle: Target) -> RankedVehicle:
    return RankedVehicle(vehicle.state.id, vehicle.relation, 0.5, vehicle.ways, "")


def far_crossing(x: float, before: float) -> Target:
    """A car ``before`` metres south of the ego's path, which it crosses at ``x``."""
    way = line((x, -before), (x, 150.0))
    return target(car("bv", x, -before, math.pi / 2), "crossing", [(way, "straight", before - 10.0)], EGO_PATH)


TRACKS = {"ego": drives("ego", 10.0), "bv": drives("bv", 10.0)}


@pytest.mark.parametrize(("ahead", "later"), [(130.0, [6.0, 7.5, 9.0]), (250.0, [8.0, 9.5, 11.0])])
def test_attacks_begin_7_s_before_the_ego_is_where_ways_meet_and_at_most_8_s_later(
    ahead: float, later: Sequence[float]
) -> None:
    assert delays([ranked(far_crossing(ahead, 90.0))], TRACKS, "ego", Settings()) == later


@pytest.mark.parametrize(
    ("step", "starts"), [(0.2, [0.0, 1.6, 3.0]), (0.04, [0.0, 1.52, 3.0]), (0.033, [0.0, 1.485, 3.003])]
)
def test_they_begin_after_whole_steps(step: float, starts: Sequence[float]) -> None:
    """1.5 s are 7.5 steps of 0.2 s, 37.5 of 0.04 s (both rounded to an even number) and 45.5 of 0.033 s."""
    assert delays([ranked(neighbour())], TRACKS, "ego", Settings(step_length=step)) == starts


def test_where_the_other_counts_they_begin_7_s_before_that_is_there() -> None:
    """It is there after 9 s."""
    assert delays([ranked(far_crossing(130.0, 90.0))], TRACKS, "ego", Settings(), both=True) == [2.0, 3.5, 5.0]


def test_a_vehicle_beside_the_ego_can_attack_at_once() -> None:
    both = [ranked(far_crossing(130.0, 90.0)), ranked(neighbour())]
    assert delays(both, TRACKS, "ego", Settings()) == [0.0, 1.5, 3.0]


def test_a_vehicle_past_the_place_is_spent_and_a_leader_never_is() -> None:
    north = target(
        car("bv", 30.0, 6.0, math.pi / 2), "crossing", [(line((30.0, 6.0), (30.0, 90.0)), "none", 0.0)], EGO_PATH
    )
    assert spent(north, LIMIT)
    assert not spent(crossing(), LIMIT)
    assert not spent(leader(), LIMIT)


@pytest.mark.parametrize(("speed", "too_fast"), [(7.5, False), (9.0, True)])
def test_a_vehicle_that_turns_harder_than_an_adversary_may_is_spent(speed: float, too_fast: bool) -> None:
    """On a bend of 16 m radius 7.5 m/s is 3.5 m/s2 sideways, 9 m/s is 5.1."""
    arc = [(14.0 + 16.0 * math.sin(a), -20.0 + 16.0 * (1.0 - math.cos(a))) for a in np.arange(0.0, 1.5, 0.02)]
    turning = target(car("bv", *arc[0], 0.0), "crossing", [(line(*arc, (30.0, 60.0)), "left", 0.0)], EGO_PATH)
    assert spent(replace(turning, state=replace(turning.state, speed=speed)), LIMIT) == too_fast
