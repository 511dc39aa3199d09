"""How unlike its log an attack is: distances of speeds and of accelerations."""

import math
from dataclasses import replace

import pytest

from sumo_adv.datatypes import Attempt, Level, Proposal
from sumo_adv.episode.assessment import NOTHING
from sumo_adv.episode.attempt import Driven
from sumo_adv.episode.neighbours import unlikeness
from sumo_adv.episode.task import AttemptResult
from sumo_adv.planners.source import make_planner
from sumo_adv.simulation.simulation import Snapshot

TEXT = """
PARAMETERS = {"gap": (0.5, -3.0, 4.0, "m", "where")}

def endpoint(bv, ego, road, parameters, acc, horizon):
    return {"x": 0.0, "y": 0.0, "heading": 0.0, "speed": 1.0, "time": 1.0}
"""
SIZES = {"bv": (5.0, 2.0)}


def states(speeds: list[float]) -> list[Snapshot]:
    """The vehicle's states from 100 s on, 0.1 s apart, to the east."""
    return [Snapshot(100.0 + 0.1 * k, {"bv": (10.0 * k, 0.0, 90.0, v, "a")}) for k, v in enumerate(speeds)]


def attack(speeds: list[float], contact: float | None = None) -> tuple[Attempt, AttemptResult]:
    proposal = Proposal("bv", "Shift", make_planner("Shift", "side", TEXT, "seed"), {"gap": 0.5}, 0.0, 0.0)
    verdict = replace(NOTHING, level=Level.VALID, collided=contact is not None, contact_time=contact)
    result = AttemptResult(Driven("contact", ""), None, 100.0, states(speeds), SIZES)
    return Attempt(0, "tuner", proposal, 100.0, verdict, "contact", ""), result


def unlike(attacking: tuple[Attempt, AttemptResult], logged: list[float]) -> float:
    return unlikeness(*attacking, states(logged), SIZES, 0.1)


def test_two_metres_a_second_faster_all_the_time_are_two_fifths() -> None:
    """The distance of the speeds, 2 m/s, counts in shares of 5 m/s; both accelerations are 0."""
    assert unlike(attack([12.0] * 20), [10.0] * 20) == pytest.approx(0.4)
    assert unlike(attack([10.0] * 20), [10.0] * 20) == 0.0


def test_braking_counts_in_shares_of_two_metres_a_second_squared() -> None:
    """From 10 m/s at -2 m/s2 to 8.1 m/s: on average 1.0 m/s slower from 0.1 s on, and 2 m/s2 away."""
    braking = [10.0 - 0.2 * k for k in range(20)]
    slower = sum(0.2 * k for k in range(1, 20)) / 19
    assert unlike(attack(braking), [10.0] * 20) == pytest.approx(slower / 5 + 1.0)


def test_what_comes_after_the_contact_does_not_count() -> None:
    speeds = [10.0] * 10 + [0.0] * 10  # the contact is at 100.8 s
    assert unlike(attack(speeds, contact=100.8), [10.0] * 20) == pytest.approx(0.0)


def test_a_vehicle_that_the_log_does_not_show_is_never_like_it() -> None:
    assert unlike(attack([10.0] * 20), []) == math.inf
