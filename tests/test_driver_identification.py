"""What kind of driver an unknown ego is taken for, by how it went in attempts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from situation_samples import KRAUSS, neighbour, situation

from sumo_adv.config import Settings
from sumo_adv.datatypes import Limits, ObservedMotion, Proposal
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.sessions import Roads, Sessions
from sumo_adv.planners.source import make_planner
from sumo_adv.search.driver_identification import WIDE, DriverIdentification, apart, models_of
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


def test_a_driver_that_is_known_has_one_model_and_an_unknown_one_four() -> None:
    assert models_of(IDM) == [IDM] and not DriverIdentification(IDM).open
    assert [(m.kind, m.sees, m.reaction) for m in models_of(UNKNOWN)] == [
        ("idm", 0.0, None), ("careful", 0.0, 0.1), ("idm", WIDE, None), ("replay", 0.0, None)
    ]  # fmt: skip
    assert len(models_of(replace(UNKNOWN, kind="replay"))) == 1  # a forecast at constant velocity was asked for


def test_the_model_with_the_least_error_over_all_attempts_is_believed() -> None:
    driver = DriverIdentification(UNKNOWN)
    assert driver.observe([2.0, 2.0, 3.0, 4.0]) is False  # of equals the first
    assert driver.observe([3.0, 2.0, 1.0, 4.0]) is True and driver.model.kind == "careful"  # 5, 4, 4, 8
    assert driver.observe([0.0, 3.0, 1.5, 4.0]) is True and driver.model == UNKNOWN  # 5, 7, 5.5, 12
    assert driver.observe([0.6, 0.0, 0.0, 0.0]) is False  # 5.6, 7, 5.5, 12: not clearly
    assert driver.observe([0.6, 0.0, 0.0, 0.0]) is True and driver.model.sees == WIDE  # 6.2, 7, 5.5: less than 5.58


def test_the_error_is_the_mean_distance_as_far_as_the_ego_was_seen_and_10_m_at_most() -> None:
    seen, predicted = (np.array([0.0, 3.0, 50.0, 9.0]), np.zeros(4)), (np.zeros(5), np.array([1.0, 4.0, 0.0, 0.0, 0.0]))
    assert apart(seen, predicted, course([0.0] * 4, 2)) == pytest.approx((1.0 + 5.0) / 2)
    assert apart(seen, predicted, course([0.0] * 4, 3)) == pytest.approx((1.0 + 5.0 + 10.0) / 3)


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
