"""TTC, PET, DRAC and the rest, by hand and by brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from metrics_tracks import braking, cruise

from sumo_adv.datatypes import Boxes, Floats
from sumo_adv.metrics.boxes import overlaps
from sumo_adv.metrics.criticality import btn, drac, exposure, headway, pet, required_lateral, ttc


def box(x: float, y: float, heading: float, speed: float, length: float = 5.0, width: float = 2.0) -> Boxes:
    return Boxes(*(np.asarray(float(v)) for v in (x, y, heading, speed)), length, width)


EAST, NORTH, WEST = 0.0, np.pi / 2, np.pi


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        (box(0, 0, EAST, 10), box(65, 0, WEST, 10), 3.0),  # head-on: 60 m at 20 m/s
        (box(0, 0, EAST, 15), box(25, 0, EAST, 5), 2.0),  # rear-end: 20 m at 10 m/s
        (box(0, 0, EAST, 15), box(25, 0, EAST, 15), np.inf),  # following at the same speed
        (box(0, 0, EAST, 10), box(30, -30, NORTH, 10), 2.65),  # right angle: both axes overlap from (30 - 3.5) / 10
        (box(0, 0, EAST, 10), box(30, -40, NORTH, 10), np.inf),  # the same, 10 m later: a near miss
        (box(0, 0, EAST, 10), box(0, 5, EAST, 10), np.inf),  # parallel
        (box(0, 0, EAST, 10), box(20, 2.01, EAST, 5), np.inf),  # overtaking 1 cm beside
        (box(0, 0, EAST, 10), box(20, 1.99, EAST, 5), 3.0),  # overtaking 1 cm too near
        (box(0, 0, EAST, 0), box(-35, 0, EAST, 10), 3.0),  # standing, hit from behind
        (box(0, 0, EAST, 0), box(3, 0, EAST, 0), 0.0),  # already overlapping
        (box(0, 0, EAST, 10), box(60, 0, WEST, 10, 18.0, 2.5), 2.425),  # a truck: 60 - 2.5 - 9 = 48.5
        (box(0, 0, EAST, 10), box(0, 30, EAST, 5), np.inf),
    ],
)
def test_ttc_worked_out_by_hand(a: Boxes, b: Boxes, expected: float) -> None:
    assert float(ttc(a, b)) == pytest.approx(expected)


def test_drifting_sideways_is_seen_long_before_the_line_is_crossed() -> None:
    drifting = box(0, 3.2, -0.1, 10)
    assert float(ttc(box(0, 0, EAST, 10), drifting)) == pytest.approx(
        (3.2 - 1 - 2.5 * np.sin(0.1) - np.cos(0.1)) / (10 * np.sin(0.1))
    )


def random_pairs(seed: int, n: int) -> tuple[Boxes, Boxes]:
    r = np.random.default_rng(seed)
    size = lambda: (r.uniform(0.5, 12, n), r.uniform(0.5, 2.6, n))  # noqa: E731
    a = Boxes(np.zeros(n), np.zeros(n), r.uniform(-np.pi, np.pi, n), r.uniform(0, 25, n), *size())
    b = Boxes(r.uniform(-25, 25, n), r.uniform(-25, 25, n), r.uniform(-np.pi, np.pi, n), r.uniform(0, 25, n), *size())
    return a, b


def stepped(b: Boxes, time: Floats) -> Boxes:
    x = b.x[:, None] + b.speed[:, None] * np.cos(b.heading)[:, None] * time
    y = b.y[:, None] + b.speed[:, None] * np.sin(b.heading)[:, None] * time
    return Boxes(
        x, y, b.heading[:, None], b.speed[:, None], np.asarray(b.length)[:, None], np.asarray(b.width)[:, None]
    )


def test_ttc_agrees_with_stepping_at_one_millisecond_over_ten_thousand_pairs() -> None:
    a, b = random_pairs(7, 10_000)
    exact = ttc(a, b)
    time = np.arange(0, 6.0, 0.001)
    coarse = overlaps(stepped(a, time[::10]), stepped(b, time[::10]))
    hits = np.flatnonzero(coarse.any(1))
    assert len(hits) > 1000
    start = time[coarse[hits].argmax(1) * 10]
    fine = start[:, None] - np.arange(10, -1, -1) * 0.001
    pick = lambda v: Boxes(*(np.asarray(w)[hits] for w in (v.x, v.y, v.heading, v.speed, v.length, v.width)))  # noqa: E731
    sampled = overlaps(stepped(pick(a), fine), stepped(pick(b), fine)) & (fine >= 0)
    first = fine[np.arange(len(hits)), sampled.argmax(1)]
    assert np.abs(exact[hits] - first).max() < 0.002
    longer = np.isfinite(exact) & (exact < 5.9) & ~coarse.any(1)
    at = exact[longer][:, None] + np.linspace(0, 0.02, 41)
    keep = np.flatnonzero(longer)
    picked = [Boxes(*(np.asarray(w)[keep] for w in (v.x, v.y, v.heading, v.speed, v.length, v.width))) for v in (a, b)]
    grazing = overlaps(stepped(picked[0], at + 1e-9), stepped(picked[1], at + 1e-9))
    assert grazing.any(1).all()  # contacts shorter than 10 ms that the coarse steps jumped over


numbers = st.floats(-30, 30)
angles = st.floats(-3.1, 3.1)
speeds = st.floats(0, 25)


@settings(max_examples=150, deadline=None)
@given(numbers, numbers, angles, angles, speeds, speeds, angles, numbers)
def test_ttc_is_symmetric_and_the_same_from_any_point_of_view(
    x: float, y: float, ha: float, hb: float, va: float, vb: float, turn: float, shift: float
) -> None:
    a, b = box(0, 0, ha, va), box(x, y, hb, vb, 8.0, 2.4)
    c, s = np.cos(turn), np.sin(turn)
    a2, b2 = (
        box(shift, -shift, ha + turn, va),
        box(shift + c * x - s * y, s * x + c * y - shift, hb + turn, vb, 8.0, 2.4),
    )
    there, back, moved = float(ttc(a, b)), float(ttc(b, a)), float(ttc(a2, b2))
    assert there == pytest.approx(back, rel=1e-6, abs=1e-6)
    grazing = float(ttc(box(0, 0, ha, va, 5.001, 2.001), b)), float(ttc(box(0, 0, ha, va, 4.999, 1.999), b))
    assert min(grazing) * (1 - 1e-6) - 1e-6 <= moved <= max(grazing) * (1 + 1e-6) + 1e-6


def test_pet_of_two_cars_that_cross_one_after_the_other() -> None:
    """The ego's rear leaves x = 51 at 5.35 s; the other's front reaches y = -1 at (80 - 3.5) / 12 = 6.375 s."""
    ego, crossing_car = cruise("ego", 0, 0, 10), cruise("b", 50, -80, 12, NORTH)
    result = pet(ego, crossing_car)
    assert result.pet == pytest.approx(6.375 - 5.35, abs=0.005)
    assert result.first == "a" and pet(crossing_car, ego).first == "b"
    assert result.point is not None and np.hypot(result.point[0] - 50, result.point[1]) < 5
    assert pet(ego, cruise("far", 0, 50, 10)).pet == np.inf
    assert pet(ego, cruise("hit", 50, -50, 10, NORTH)).pet == 0.0


def test_pet_of_a_follower_is_its_time_gap() -> None:
    assert pet(cruise("ego", 0, 0, 10), cruise("b", 25, 0, 10)).pet == pytest.approx(2.0, abs=0.005)


def test_drac_and_btn_of_car_following_are_the_textbook_s() -> None:
    ego, leader = box(0, 0, EAST, 15), box(25, 0, EAST, 5)
    assert float(drac(ego, leader)) == pytest.approx(10**2 / (2 * 20))
    assert float(btn(ego, leader)) == pytest.approx(2.5 / 8)
    assert float(drac(ego, box(25, 0, EAST, 20))) == 0.0
    assert float(drac(box(0, 0, EAST, 10), box(30, -30, NORTH, 10))) == pytest.approx(10 / (2 * 2.65))
    assert float(drac(box(0, 0, EAST, 5), box(-35, 0, EAST, 15))) == 0.0  # hit from behind: braking is no remedy


def test_required_lateral_acceleration_to_pass_a_standing_car() -> None:
    """20 m at 10 m/s leave 2 s; 2 m of shift clear two cars in line: 2 * 2 / 4 = 1; offset by 1.5 m only 0.5 m."""
    assert float(required_lateral(box(0, 0, EAST, 10), box(25, 0, EAST, 0))) == pytest.approx(1.0)
    assert float(required_lateral(box(0, 0, EAST, 10), box(25, 1.5, EAST, 0))) == pytest.approx(0.25)
    assert float(required_lateral(box(0, 0, EAST, 10), box(25, 9, EAST, 0))) == 0.0


def test_headway_is_gap_over_speed_to_what_is_in_the_path() -> None:
    assert float(headway(box(0, 0, EAST, 10), box(25, 0, EAST, 10))) == pytest.approx(2.0)
    assert float(headway(box(0, 0, EAST, 10), box(25, 3, EAST, 10))) == np.inf
    assert float(headway(box(0, 0, EAST, 10), box(-25, 0, EAST, 10))) == np.inf
    assert float(headway(box(0, 0, EAST, 0), box(25, 0, EAST, 10))) == np.inf


def test_exposure_counts_time_and_depth_below_the_threshold() -> None:
    times = np.array([np.inf, 2.0, 1.0, 0.5, 3.0])
    tet, tit = exposure(times, 1.5, 0.1)
    assert (float(tet), float(tit)) == (pytest.approx(0.2), pytest.approx(0.15))


def test_shapes_broadcast_over_vehicles_and_steps() -> None:
    ego = cruise("ego", 0, 0, 15).boxes()
    leader = braking("b", 40, 0, 15, 2.0, 5.0).boxes()
    many = Boxes(*(np.stack([v, v + 0.0]) for v in (leader.x, leader.y, leader.heading, leader.speed)), 5.0, 2.0)
    assert ttc(ego, many).shape == (2, len(ego.x))
    assert (ttc(ego, many)[0] == ttc(ego, leader)).all()


def test_headway_counts_only_the_part_of_a_slanted_box_that_is_in_the_path() -> None:
    """Nose 20 degrees to the left across our right edge: only the front corner's part lies within 0.9 m of our line."""
    turn = np.radians(20.0)
    ego = Boxes(np.array(0.0), np.array(0.0), np.array(0.0), np.array(10.0), 4.8, 1.8)
    slanted = Boxes(np.array(6.0), np.array(-2.0), np.array(turn), np.array(10.0), 4.8, 1.8)
    # front left corner: (6 + 2.4 cos - 0.9 sin, -2 + 2.4 sin + 0.9 cos) = (7.947, -0.333); the left side runs back from
    # it along (-cos, -sin) and leaves the path at y = -0.9, 0.567 / sin 20 = 1.657 m back: x = 7.947 - 1.557 = 6.390
    assert headway(ego, slanted) == pytest.approx((6.390 - 2.4) / 10.0, abs=2e-3)
    assert headway(ego, Boxes(np.array(6.0), np.array(-3.5), np.array(turn), np.array(10.0), 4.8, 1.8)) == np.inf
