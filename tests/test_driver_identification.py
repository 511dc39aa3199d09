"""What kind of driver an unknown ego is taken for, by how it went in attempts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from situation_samples import KRAUSS, changed, neighbour, situation

from sumo_adv.config import Settings
from sumo_adv.datatypes import Limits, ObservedMotion, Proposal, Role, Track
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.sessions import Roads, Sessions
from sumo_adv.planners.source import make_planner
from sumo_adv.search.driver_identification import (
    AUTOMATIC,
    FORESIGHT,
    WIDE,
    DriverIdentification,
    apart,
    family_of,
    in_traffic,
)
from sumo_adv.search.prediction import Predictor
from sumo_adv.search.rollouts import predict

IDM = replace(KRAUSS, kind="idm")
UNKNOWN = replace(IDM, known=False)
SQUEEZE = """
PARAMETERS = {}


def endpoint(bv, ego, road, parameters, acc, horizon):
    return {"x": bv["x"] + 10.0, "y": 2.2, "heading": 0.0, "speed": 5.0, "time": 2.0}
"""


@pytest.fixture(scope="module")
def sandbox() -> Iterator[Sandbox]:
    with Sandbox() as box:
        yield box


def everywhere(x: object, y: object) -> object:
    return np.ones(np.shape(x), bool)


def course(x: list[float], seen: int) -> ObservedMotion:
    return ObservedMotion(np.array(x), np.zeros(len(x)), np.zeros(len(x)), seen)


def test_a_driver_that_is_known_has_one_model_and_an_unknown_one_a_family_without_our_own_careful_driver() -> None:
    assert [m.model for m in family_of(IDM)] == [IDM] and not DriverIdentification(IDM).open
    family = family_of(UNKNOWN)
    assert sum(m.weight for m in family) == pytest.approx(1.0)
    assert family[0].model == UNKNOWN and "careful" not in {m.model.kind for m in family}
    assert len(family_of(replace(UNKNOWN, kind="replay"))) == 1  # a forecast at constant velocity was asked for


def test_each_observed_second_multiplies_the_odds() -> None:
    driver = DriverIdentification(UNKNOWN)
    before = dict(zip(driver.models, driver.weights, strict=True))
    far, near = np.array([4.0, 4.0]), np.array([0.0, 0.0])  # m in each of two seconds
    wide = replace(UNKNOWN, sees=WIDE)
    assert driver.observe([near if m == wide else far for m in driver.models]) is True and driver.model == wide
    after = dict(zip(driver.models, driver.weights, strict=True))
    odds = (after[wide] / after[UNKNOWN]) / (before[wide] / before[UNKNOWN])
    assert odds == pytest.approx(np.exp((4.0 + 4.0) / 4.0))  # a scale of 4 m


def test_another_driver_is_believed_only_if_it_is_clearly_likelier() -> None:
    driver = DriverIdentification(UNKNOWN)  # 0.25 against 0.2 for the automatic brake
    braked = [np.array([2.0])] + [np.array([0.0])] + [np.array([9.0])] * 4
    assert driver.observe(braked) is False  # 0.25 exp(-0.5) = 0.15 against 0.2: 1.3 times
    assert driver.observe(braked) is True  # 0.092 against 0.2
    assert driver.model.guard is not None and [w for _, w in driver.likely] == pytest.approx([0.685, 0.315], abs=1e-3)


def test_a_brake_that_would_have_acted_without_an_attack_counts_against_the_driver_that_has_it() -> None:
    """A car on the next road comes straight at the ego's path and turns away at the last moment; the real ego keeps its
    10 m/s. An ego that looks 1.5 s ahead brakes for a while."""
    time = np.round(100.0 + 0.1 * np.arange(51), 6)
    south, still = np.minimum(-14.0 + 0.8 * np.arange(51), -6.0), np.zeros(51)
    heading = np.where(np.arange(51) < 10, np.pi / 2, 0.0)
    turns = Track("bv", Role.BACKGROUND, time, still + 22.0, south, heading, still + 8.0, still, 5.0, 2.0)
    turning_away = changed(situation([neighbour()], model=UNKNOWN), others=(turns,))
    assert in_traffic(turning_away, UNKNOWN).max() == pytest.approx(0.0, abs=0.01)
    assert in_traffic(turning_away, replace(UNKNOWN, guard=AUTOMATIC)).max() > 1.0


def test_what_earlier_encounters_showed_is_seven_tenths_of_the_first_weights() -> None:
    driver = DriverIdentification(UNKNOWN, {"swerves": 0.5, "foresight": 0.5, "of another version": 0.9})
    weights = dict(zip(driver.names, driver.weights, strict=True))
    assert weights["swerves"] == pytest.approx(0.3 * 0.1 + 0.7 * 0.5)
    assert weights["car_following"] == pytest.approx(0.3 * 0.25)
    assert driver.model.guard == FORESIGHT  # 0.3 * 0.2 + 0.35


def test_the_distance_is_the_mean_in_each_second_that_was_seen() -> None:
    seen, predicted = (np.array([0.0, 3.0, 50.0, 9.0]), np.zeros(4)), (np.zeros(5), np.array([1.0, 4.0, 0.0, 0.0, 0.0]))
    assert apart(seen, predicted, course([0.0] * 4, 2), 0.5) == pytest.approx([(1.0 + 5.0) / 2])
    assert apart(seen, predicted, course([0.0] * 4, 3), 0.5) == pytest.approx([3.0, 50.0])


def test_an_unknown_ego_seen_braking_for_a_vehicle_beside_its_lane_is_predicted_to_do_so(sandbox: Sandbox) -> None:
    """A car 20 m ahead slows down to 5 m/s with its middle 2.2 m to the left. IDM's driver keeps 10 m/s, since its
    lane ends at 1.6 m. A driver that watches 2.5 m to either side brakes, and the attempt showed the ego braking."""
    tried = Proposal("bv", "Squeeze", make_planner("Squeeze", "side", SQUEEZE, "person"), {}, 0.0, 0.0)
    wide, unknown = (situation([neighbour()], model=m) for m in (replace(IDM, sees=WIDE), UNKNOWN))
    with Sessions(sandbox, Roads({0.0: wide}), [tried], 0) as sessions:
        real = predict(
            {0.0: wide}, [tried], lambda rows, seen: sessions.answers([tried], rows, seen), limits=Limits(), steps=60,
            replan=6,
        )  # fmt: skip
    went = ObservedMotion(real.ego[0][0], real.ego[1][0], real.ego[3][0], 60)  # its path is the x axis
    assert went.v[-1] < 7.0

    predictor, informed = (
        Predictor(sandbox, Settings(), everywhere, {0.0: s})  # type: ignore[arg-type]
        for s in (unknown, wide)
    )
    before = predictor.score([tried])[0].prediction
    assert predictor.observe(tried, went) is True and predictor.observe(tried, went) is False
    after = predictor.score([tried])[0].prediction
    assert after == informed.score([tried])[0].prediction != before
    assert informed.observe(tried, went) is False  # it already has this model
