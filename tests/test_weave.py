"""The mode "weave" of the shipped intents: asked in the sandbox, on a straight road along x."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
from bank_samples import shipped_planners

from sumo_adv.datatypes import Planner
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.trial import TRIAL_HORIZON_S, Probe, probes

LABELS = (
    "Intersection Rush-through Go-straight", "Intersection Rush-through Turn Left", "Opposite Direction Intrusion",
    "Straight Lane Shift",
)  # fmt: skip
NUMBERS = {
    "pull": -2.0, "until": 3.0, "then": 1.0, "span": 2.0, "begin": 1.0, "lane": 1.0, "stray": 0.4, "again": 4.0,
    "lane_2": 0.0, "stray_2": -0.5, "drift": 4.0,
}  # fmt: skip
BESIDE = probes("neighbour")[6]  # on the left at y = 3.2, 4 m ahead at 25 m/s; lanes 3.2 m to its left and right


def planner(label: str = "Straight Lane Shift") -> Planner:
    return shipped_planners()[label, "weave"]


def asked(
    sandbox: Sandbox, time: float, numbers: Mapping[str, float], probe: Probe = BESIDE, sides: Any = None
) -> dict[str, float]:
    """Its endpoint so long after the trigger, where it has driven on at its first speed in its lane."""
    probe = replace(probe, road={**probe.road, **({} if sides is None else {"sides": sides})})
    travelled = probe.road["start"]["speed"] * time
    bv = {**probe.bv, "time": time, "travelled": travelled, "x": probe.bv["x"] + travelled}
    with sandbox.session(planner(), {"here": probe.road}) as session:
        return session.endpoint("here", bv, probe.ego, {**NUMBERS, **numbers}, 0.0, TRIAL_HORIZON_S)


def aside(end: Mapping[str, float]) -> float:
    """Metres to the left of the middle of its own lane."""
    return end["y"] - 3.2


def test_four_intents_share_the_mode_with_their_own_movements() -> None:
    movements = [
        next(line for line in planner(label).text.splitlines() if line.startswith("MOVEMENT")) for label in LABELS
    ]
    assert movements == [f'MOVEMENT = "{m}"' for m in ("straight", "left", "none", "none")]
    assert sorted(label for label, mode in shipped_planners() if mode == "weave") == sorted(LABELS)


@pytest.mark.parametrize(
    ("time", "offset", "duration"),
    [
        (0.0, 0.0, 1.5),  # the first move begins after 1 s
        (0.9, 0.0, 1.5),
        (1.0, 3.6, 4.0),  # to the lane on the left and 0.4 m further, within 4 s
        (2.0, 3.6, 3.0),
        (4.5, 3.6, 1.5),  # at least 1.5 s
        (5.0, -0.5, 4.0),  # 4 s later the second one: back to its own lane, half a metre to the right
        (8.0, -0.5, 1.5),
    ],
)
def test_it_keeps_its_lane_then_makes_one_move_and_then_the_other(
    sandbox: Sandbox, time: float, offset: float, duration: float
) -> None:
    end = asked(sandbox, time, {})
    assert (aside(end), end["time"]) == pytest.approx((offset, duration))


@pytest.mark.parametrize(
    ("lane", "sides", "offset"),
    [
        (1.0, (3.2, -3.2), 3.2),
        (-1.0, (3.2, -3.2), -3.2),
        (0.5, (3.2, -3.2), 0.0),
        (-0.5, (3.2, -3.2), 0.0),
        (1.0, (-3.2,), 0.0),  # there is no lane on the left
        (-1.0, (3.5,), 0.0),
        (1.0, (3.5,), 3.5),
        (1.5, (), 0.0),
    ],
)
def test_a_lane_that_does_not_exist_is_its_own(
    sandbox: Sandbox, lane: float, sides: tuple[float, ...], offset: float
) -> None:
    beside = [{"offset": each, "kind": "same"} for each in sides]
    first = asked(sandbox, 2.0, {"lane": lane, "stray": 0.0}, sides=beside)
    second = asked(sandbox, 6.0, {"lane_2": lane, "stray_2": 0.0}, sides=beside)
    assert (aside(first), aside(second)) == pytest.approx((offset, offset))


def test_it_goes_by_two_stretches_of_even_acceleration(sandbox: Sandbox) -> None:
    """From 25 m/s: 2 m/s2 less until 3 s, 1 m/s2 more until 5 s, then 21 m/s."""
    assert asked(sandbox, 0.0, {})["speed"] == pytest.approx(22.0)  # 1.5 s on
    assert asked(sandbox, 1.0, {})["speed"] == pytest.approx(25.0 - 6.0 + 2.0)  # 5 s
    assert asked(sandbox, 6.0, {})["speed"] == pytest.approx(21.0)
    end = asked(sandbox, 0.0, {})
    assert end["x"] == pytest.approx(4.0 + (25.0 + 22.0) / 2 * 1.5)  # Simpson's rule is exact for it
    assert asked(sandbox, 0.0, {"pull": -4.0, "until": 6.0, "begin": 0.0, "drift": 6.5})["speed"] == pytest.approx(1.5)
