"""The modes "straddle" and "nudge": a vehicle that stays at or over the line for a while before it comes across."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
from bank_samples import shipped_planners

from sumo_adv.datatypes import Planner
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.trial import TRIAL_HORIZON_S, Probe, probes

COMES = probes("oncoming")[6]  # the ego at 24 m/s; the lane to the left, its middle at 3.2 m
BESIDE = probes("neighbour")[6]  # in its lane at y = 3.2, 4 m ahead at 25 m/s; cars of 5 x 1.8 m
LEADS = probes("leader")[6]
STRADDLE = {
    "early": 5.0, "over": 0.7, "pace": 3.0, "braking": 2.5, "go": 10.0, "drift": 3.0, "across": 0.9, "stop": 2.0,
}  # fmt: skip
NUDGE = {
    "gap": 4.0, "speed": 0.0, "edge": 0.4, "drift": 3.5, "early": 0.2, "swing": 2.8, "gate": 2.0, "side": 1.0,
    "across": 0.3, "brake": 3.0,
}  # fmt: skip
LABELS = {"straddle": "Opposite Direction Intrusion", "nudge": "Straight Lane Shift"}
AGO = {"x": 0.0, "y": 0.0, "heading": 0.0, "speed": 24.0, "time": 2.0}


def planner(mode: str) -> Planner:
    return shipped_planners()[LABELS[mode], mode]


def endpoint(
    sandbox: Sandbox, mode: str, probe: Probe, numbers: Mapping[str, float], changes: Mapping[str, Any]
) -> dict[str, float]:
    with sandbox.session(planner(mode), {"here": probe.road}) as session:
        return session.endpoint("here", {**probe.bv, **changes}, probe.ego, numbers, 0.0, TRIAL_HORIZON_S)


# ---- straddle: towards the ego


@pytest.mark.parametrize(
    ("ahead", "speed", "target_left", "aside", "slower"),
    [
        (205.0, 16.0, 3.2, 3.2, 16.0),  # 200 m between the bumpers at 40 m/s: 5 s and no sooner
        (204.0, 16.0, 3.2, 1.8, 8.5),  # now: 1.6 + 0.9 - 0.7 m from the ego's middle, 3 s of braking with 2.5 m/s2
        (150.0, 8.0, 1.8, 1.8, 5.5),  # once it is there 1 s ahead
        (150.0, 3.5, 1.8, 1.8, 3.0),  # at its pace it keeps it
        (15.5, 3.0, 1.8, 1.8, 3.0),  # 10.5 m between the bumpers
        (15.0, 3.0, 1.8, 0.9, 0.0),  # 10 m: it swings across, and stops
    ],
)
def test_it_keeps_astride_the_line_until_the_ego_is_near(
    sandbox: Sandbox, ahead: float, speed: float, target_left: float, aside: float, slower: float
) -> None:
    changes = {"ahead": ahead, "speed": speed, "target_left": target_left, "left": target_left, "lateral_time": 0.0}
    numbers = STRADDLE if ahead != 205.0 else {**STRADDLE, "early": 4.99}
    end = endpoint(sandbox, "straddle", COMES, numbers, changes)
    assert (end["y"], end["speed"]) == pytest.approx((aside, slower))


def test_what_slowed_down_goes_on_to_the_line_although_they_meet_later_now(sandbox: Sandbox) -> None:
    """At 3 m/s and 24 m/s 200 m take 7.4 s; it began before, and is on its way to 1.8 m."""
    changes = {"ahead": 205.0, "speed": 3.0, "target_left": 1.8, "left": 2.6, "lateral_time": 2.0}
    end = endpoint(sandbox, "straddle", COMES, STRADDLE, changes)
    assert (end["y"], end["time"]) == pytest.approx((1.8, 2.0))


# ---- nudge: the same way


@pytest.mark.parametrize(
    ("changes", "aside", "time"),
    [
        ({"ahead": 4.0, "left": 3.2, "target_left": 3.2}, 2.2, 3.5),  # in place: to 1.8 m and 0.4 m beside it
        ({"ahead": 9.0, "left": 3.2, "target_left": 3.2}, 3.2, 2.0),  # not yet
        ({"ahead": 4.0, "left": 2.5, "target_left": 2.2, "lateral_time": 1.5}, 2.2, 1.5),  # on its way to the edge
        ({"ahead": 4.0, "left": 2.2, "target_left": 2.2, "lateral_time": 0.2}, 0.3, 2.8),  # there: it moves in
        ({"ahead": 4.0, "left": 1.8, "target_left": 0.3, "lateral_time": 2.0}, 0.3, 2.0),
        ({"ahead": 4.0, "left": 0.6, "target_left": 0.3, "lateral_time": 1.0}, 0.3, 1.5),  # half over: it brakes
    ],
)
def test_it_drives_at_the_edge_before_it_moves_in(
    sandbox: Sandbox, changes: Mapping[str, Any], aside: float, time: float
) -> None:
    at_24 = {"speed": 24.0, "speed_along": 24.0, "lateral_time": 0.0, "last": AGO}
    end = endpoint(sandbox, "nudge", BESIDE, NUDGE, {**at_24, **changes})
    assert (end["y"], end["time"]) == pytest.approx((aside, time))
    if aside == 3.2:
        assert end["speed"] < 24.0  # it falls back to its place
    else:
        assert end["speed"] == pytest.approx(24.0 - 3.0 * 1.5 if changes["left"] == 0.6 else 24.0)


@pytest.mark.parametrize("moved", [-0.3, 0.3])
def test_an_ego_that_moves_aside_a_little_does_not_confuse_it(sandbox: Sandbox, moved: float) -> None:
    """All places are told from where the ego is now: at the edge it still knows that it is there, and stays."""
    changes = {
        "ahead": 4.0, "left": 2.4 + moved, "target_left": 2.2 + moved, "lateral_time": 1.0, "speed": 24.0, "last": AGO,
    }  # fmt: skip
    assert endpoint(sandbox, "nudge", BESIDE, NUDGE, changes)["y"] == pytest.approx(2.2 + moved)


def test_one_ahead_in_the_ego_s_lane_leaves_it_first_although_it_is_where_it_will_end(sandbox: Sandbox) -> None:
    """0.0 m aside is as good as the 0.3 m it ends at; at the first question it has not left yet."""
    sides = [{"offset": 3.2, "kind": "same"}]
    probe = Probe(LEADS.name, LEADS.bv, LEADS.ego, {**LEADS.road, "sides": sides})
    end = endpoint(sandbox, "nudge", probe, NUDGE, {"last": None})
    assert end["y"] == pytest.approx(3.2)
