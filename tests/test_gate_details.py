"""Failed gates in words: when, where and by how much."""

from __future__ import annotations

import numpy as np
from metrics_tracks import braking, cruise, drift

from sumo_adv.datatypes import Floats, Limits
from sumo_adv.metrics.gates import explained_gates

LIMITS = Limits()


def on_strip(x: Floats, y: Floats) -> Floats:
    """A road along x, 2 m to either side."""
    return np.asarray(np.abs(y) <= 2.0)


def test_too_hard_braking_is_told_with_its_time_and_the_limit() -> None:
    """From 20 m/s with 10 m/s2 from 3 to 5 s; the attack starts at 1 s, and 8 m/s2 are allowed."""
    (sentence,) = explained_gates(braking("bv", 0, 0, 20, 3.0, 10.0), [], ("longitudinal",), LIMITS, None, 1.0, 8.0)
    assert sentence == "longitudinal: -10 m/s2 along its way (limit 8) 2.1 s after its start, until 4.0 s."


def test_leaving_the_road_is_told_with_the_side_and_by_how_much() -> None:
    """A car of 2 m width moves 1.6 m to the left: its side comes to y = 2.6, 0.6 m off the road."""
    (sentence,) = explained_gates(drift("bv", 0, 0, 10, 2.0, 4.0, 1.6), [], ("off_road",), LIMITS, on_strip, 0.0, 8.0)
    assert sentence.startswith("off_road: its left side is up to 0.75 m off the road 4.")


def test_what_was_so_before_the_take_over_is_said_to_be() -> None:
    beside = cruise("bv", 0, 1.5, 10)
    (sentence,) = explained_gates(beside, [], ("off_road",), LIMITS, on_strip, 1.0, 8.0)
    assert sentence == "off_road: its left side is up to 0.5 m off the road already at the take-over."


def test_a_third_vehicle_is_told_with_its_place() -> None:
    """10 m/s behind a standing car: centres 30 m apart, 5 m long, so they touch 2.5 s after zero, 1.5 s after 1 s."""
    (sentence,) = explained_gates(
        cruise("bv", 0, 0, 10), [cruise("third", 30, 0, 0)], ("third_party",), LIMITS, None, 1.0, 8.0
    )  # fmt: skip
    assert sentence == "third_party: it touches another vehicle (5.0 m ahead, 0.0 m right of it) 1.5 s after its start."


def test_gates_that_did_not_fail_are_not_told() -> None:
    assert explained_gates(cruise("bv", 0, 0, 10), [], (), LIMITS, on_strip, 1.0, 8.0) == []
