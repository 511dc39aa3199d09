"""The mode "tail": a vehicle that slows down while it leaves the lane, and stands before it is quite out of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
from bank_samples import shipped_planners

from sumo_adv.datatypes import Planner
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.trial import TRIAL_HORIZON_S, Probe, probes

SHIFT, LEFT, STRAIGHT = (
    "Straight Lane Shift", "Intersection Rush-through Turn Left", "Intersection Rush-through Go-straight",
)  # fmt: skip
BESIDE = probes("neighbour")[6]  # in its lane at y = 3.2, 4 m ahead at 25 m/s; lanes 3.2 m to its left and right
LEADS = {
    "wait": 1.0, "braking": 2.0, "creep": 0.5, "turn": 2.0, "drift": 5.0, "aside": 2.2, "side": 1.0,
}  # fmt: skip
TURNS = {
    "pace": 6.0, "past": 10.0, "braking": 2.0, "creep": 0.0, "turn": 0.0, "drift": 4.0, "aside": 2.0, "side": -1.0,
}  # fmt: skip


def planner(label: str) -> Planner:
    return shipped_planners()[label, "tail"]


def asked(
    sandbox: Sandbox, probe: Probe, which: Planner, numbers: Mapping[str, float], changes: Mapping[str, Any],
    sides: Any = None,
) -> dict[str, float]:  # fmt: skip
    probe = replace(probe, road={**probe.road, **({} if sides is None else {"sides": sides})})
    with sandbox.session(which, {"here": probe.road}) as session:
        return session.endpoint("here", {**probe.bv, **changes}, probe.ego, numbers, 0.0, TRIAL_HORIZON_S)


# ---- ahead of the ego


@pytest.mark.parametrize(
    ("time", "aside", "duration", "speed"),
    [
        (0.0, 0.0, 5.0, 17.0),  # 5 s from now it has braked for 4 s: 25 - 8 m/s
        (1.9, 0.0, 5.0, 13.2),
        (2.0, 2.2, 5.0, 13.0),  # now it pulls out, for 5 s
        (4.0, 2.2, 3.0, 13.0),
        (6.5, 2.2, 1.5, 11.0),  # at least 1.5 s ahead
        (20.0, 2.2, 1.5, 0.5),  # never slower than it creeps
    ],
)
def test_it_slows_down_and_pulls_out(
    sandbox: Sandbox, time: float, aside: float, duration: float, speed: float
) -> None:
    travelled = 25.0 * time
    early = {"time": time, "travelled": travelled, "x": BESIDE.bv["x"] + travelled}
    end = asked(sandbox, BESIDE, planner(SHIFT), LEADS, early)
    assert (end["y"] - 3.2, end["time"], end["speed"]) == pytest.approx((aside, duration, speed))


@pytest.mark.parametrize(
    ("offsets", "wanted", "side"),
    [((3.2, -3.2), 1.0, 1), ((3.2, -3.2), -0.2, -1), ((3.2,), -1.0, 1), ((-3.2,), 1.0, -1), ((), 1.0, 1)],
)
def test_it_pulls_out_to_where_there_is_a_lane(
    sandbox: Sandbox, offsets: tuple[float, ...], wanted: float, side: int
) -> None:
    sides = [{"offset": offset, "kind": "same"} for offset in offsets]
    late = {"time": 3.0, "travelled": 75.0, "x": BESIDE.bv["x"] + 75.0}
    end = asked(sandbox, BESIDE, planner(SHIFT), {**LEADS, "side": wanted}, late, sides)
    assert end["y"] - 3.2 == pytest.approx(2.2 * side)


# ---- through a junction


def crossing() -> Probe:
    """40 m before the conflict at 7 m/s."""
    return next(p for p in probes("crossing_left") if p.bv["travelled"] == 0.0)


@pytest.mark.parametrize(
    ("travelled", "now", "speed"),
    [
        (0.0, 7.0, 6.0),  # at its pace
        (49.0, 6.0, 2.334),  # 1 m at 6 m/s takes 1/6 s, then 11/6 s of braking with 2 m/s2
        (50.1, 6.0, 0.0),  # 4 s of moving aside, and after 3 s it stands
    ],
)
def test_it_drives_through_and_slows_down_behind_the_place_where_they_meet(
    sandbox: Sandbox, travelled: float, now: float, speed: float
) -> None:
    """They meet after 40 m; it slows down 10 m later."""
    changes = {"travelled": travelled, "speed": now, "lateral_time": 0.0}
    end = asked(sandbox, crossing(), planner(LEFT), TURNS, changes)
    assert end["speed"] == pytest.approx(speed, abs=0.001)
    assert end["time"] == pytest.approx(4.0 if travelled > 50.0 else 2.0)


def test_it_then_stands_off_the_middle_of_its_lane(sandbox: Sandbox) -> None:
    """From 52 m on: 6 m/s, braking with 2 m/s2, are 9 m; 2 m to the right of the way at its 61st metre."""
    probe = crossing()
    (ax, ay), (bx, by) = probe.road["ways"][0]["centreline"][:2]
    cos, sin = (bx - ax) / 2.0, (by - ay) / 2.0  # a straight way, a point every 2 m
    end = asked(sandbox, probe, planner(LEFT), TURNS, {"travelled": 52.0, "speed": 6.0, "lateral_time": 3.5})
    along, left = (end["x"] - ax) * cos + (end["y"] - ay) * sin, (end["y"] - ay) * cos - (end["x"] - ax) * sin
    assert (along, left) == pytest.approx((61.0, -2.0), abs=0.01)
    assert end["time"] == pytest.approx(3.5)  # what is left of the move


def test_two_intents_have_it_and_differ_in_the_movement_alone() -> None:
    texts = {name: planner(name).text.splitlines()[1:] for name in (LEFT, STRAIGHT)}
    differ = [pair for pair in zip(*texts.values(), strict=True) if pair[0] != pair[1]]
    assert differ == [('MOVEMENT = "left"', 'MOVEMENT = "straight"')]
