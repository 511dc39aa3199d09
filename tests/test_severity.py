"""Severity and the human envelope, with numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from metrics_tracks import TIME, car, cruise, drift

from sumo_adv.metrics.contact import Side
from sumo_adv.metrics.realism import outside
from sumo_adv.metrics.severity import Severity, crash, injury_risk, mass_of, severity_of


def test_head_on_each_takes_half_of_the_closing_speed_and_a_tenth_more() -> None:
    c = crash(cruise("ego", 0, 0, 10), cruise("adversary", 105, 0, 10, np.pi), 5.0)
    assert c.closing == pytest.approx(20.0)
    assert (c.ego_delta_v, c.adversary_delta_v) == pytest.approx((11.0, 11.0))  # 1.1 * 20 / 2
    assert (c.ego_side, c.adversary_side, c.severity) == (Side.FRONT, Side.FRONT, Severity.SEVERE)


def test_a_truck_takes_less() -> None:
    """16 t against 1.5 t: J = 1.1 * 5 / (1/1500 + 1/16000) N s, delta-v 5.03 and 0.47 m/s."""
    truck = cruise("adversary", 12.5, 0, 5, length=15.0)  # 12.5 - 7.5 - 2.5: 2.5 m ahead, 5 m/s slower: 0.5 s
    c = crash(cruise("ego", 0, 0, 10), truck, 0.5)
    assert (c.ego_delta_v, c.adversary_delta_v) == pytest.approx((5.029, 0.471), abs=1e-3)


def test_a_side_swipe_at_equal_speeds_is_negligible() -> None:
    """Both at 20 m/s, one drifting at 0.3 m/s: only the 0.3 m/s count."""
    y = 3.0 - 0.3 * TIME
    foe = car("adversary", 20.0 * TIME, y, 20.0)
    foe = car("adversary", 20.0 * TIME, y, 20.0, heading=float(np.arctan2(-0.3, 20.0)))
    contact = float(np.interp(-2.0, -y, TIME))
    c = crash(cruise("ego", 0, 0, 20), foe, contact)
    assert c.ego_delta_v < 0.17 and c.severity is Severity.NEGLIGIBLE


def test_an_off_centre_hit_turns_the_car_and_takes_less_than_a_central_one() -> None:
    """A car hits the ego's flank 1 m behind its middle: (1 + e) u / (2 / m + r^2 / I), r = 1 m, I = m (25 + 4) / 12."""
    ego, foe = cruise("ego", 0, 0, 0.001), cruise("adversary", -1.0, -13.5, 10, np.pi / 2)
    c = crash(ego, foe, 1.0)
    inertia = 29 / 12
    assert c.ego_delta_v == pytest.approx(1.1 * 10 / (2 + 1.0 / inertia), abs=0.02)


@pytest.mark.parametrize(
    ("delta_v", "name"), [(0.44, "negligible"), (0.46, "minor"), (2.23, "minor"), (2.25, "moderate"), (6.8, "severe")]
)
def test_classes_of_severity(delta_v: float, name: str) -> None:
    assert severity_of(delta_v) == name


def test_the_injury_risk_is_the_published_one_where_it_is_published() -> None:
    assert injury_risk(112 / 3.6 / 2) == pytest.approx(0.10)
    assert injury_risk(0.0) < 0.002
    assert [mass_of(v) for v in (1.8, 4.8, 12.0)] == [100.0, 1500.0, 16000.0]


# ---- the human envelope


def test_a_calm_lane_change_is_human() -> None:
    assert outside(drift("adversary", 0, 3.2, 15, 2.0, 5.0, 0.0), 1.0, 9.0) == ()


def test_a_full_brake_is_not_unless_it_leads() -> None:
    """8 m/s2 from 20 m/s: above 3.5 to 5 m/s2 for more than a second."""
    speed = np.maximum(20.0 - 8.0 * np.maximum(TIME - 3.0, 0.0), 0.0)
    x = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * 0.1)])
    foe = car("adversary", x, 0.0, speed)
    assert set(outside(foe, 1.0, 9.0)) >= {"braking", "jerk"}
    assert outside(foe, 1.0, 9.0, np.ones(len(TIME), bool)) == ()


def test_a_jerk_of_the_wheel_at_speed_is_not_human() -> None:
    """3.2 m in 1.2 s at 25 m/s: 5.77 * 3.2 / 1.44 = 12.8 m/s2 at its peak."""
    assert "lateral" in outside(drift("adversary", 0, 3.2, 25, 2.0, 1.2, 0.0), 1.0, 5.0)
