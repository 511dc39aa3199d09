"""Egos at junctions as they are foreseen: they keep clear of who is on it, and wait at their line where they must.

Everywhere the ego starts at station 0 with 10 m/s and is 5 m long, so its front is at 2.5 m.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from situation_samples import KRAUSS, leader, situation

from sumo_adv.datatypes import EgoCourse, Floats
from sumo_adv.planning.drivers import Blocked, PredictedEgos, _seconds
from sumo_adv.planning.scenes import Scenes
from sumo_adv.situation import Situation

KINDS = pytest.mark.parametrize("kind", ["krauss", "idm"])


def crossroads(line: float = math.inf, model: Mapping[str, Any] = KRAUSS) -> Situation:
    """The ego on a road that has to give way at a station [m]."""
    return replace(situation([leader()], model=model), gives_way_at=line)


def blocked(
    begins: float = math.inf, *, beside: float = 0.0, before: float = 0.0, behind: float = 0.0, meets: float = 34.0,
    speed: float = 0.0,
) -> Blocked:  # fmt: skip
    return Blocked(*(np.array([float(q)]) for q in (begins, beside, speed, before, behind, meets)))


def drive(
    egos: PredictedEgos, seconds: float, way: Callable[[float], Blocked], speed: float, begin: float = 0.0
) -> None:
    """Steps of 0.1 s beside a vehicle that is never in the ego's lane, and on the junction as ``way`` says."""
    aside = (np.array([0.0]), np.array([50.0]), np.array([0.0]))
    for k in range(round(seconds / 0.1)):
        now = begin + 0.1 * k
        egos.step(now, aside, np.array([speed]), way(now))


def egos_of(sit: Situation) -> PredictedEgos:
    return PredictedEgos(Scenes([sit]), np.array([5.0]), np.array([2.0]))


def crossing_at(speed: float, before: float, behind: float) -> Callable[[float], Blocked]:
    """A vehicle that drives over the junction at an even speed, and is never in the way yet."""
    return lambda now: blocked(before=before - speed * now, behind=behind - speed * now)


# ---- seconds for a distance


@pytest.mark.parametrize(
    ("distance", "speed", "seconds"),
    [
        (0.0, 8.0, 0.0),
        (-4.0, 8.0, 0.0),  # it is past
        (5.2, 0.0, 2.0),  # from standstill: 2.6 m/s2 for 2 s make 5.2 m
        (20.8, 0.0, 4.0),
        (22.6, 8.7, 2.0),  # from 8.7 to 13.9 m/s in 2 s, at 11.3 m/s in the mean
        (64.3, 8.7, 5.0),  # 3 s more at 13.9 m/s: 41.7 m
        (40.0, 20.0, 2.0),  # who is faster than that keeps its speed
    ],
)
def test_the_seconds_for_a_distance_with_acceleration_up_to_13_9_metres_a_second(
    distance: float, speed: float, seconds: float
) -> None:
    found: Floats = _seconds(np.array([distance]), np.array([speed]), 2.6)
    assert found[0] == pytest.approx(seconds, abs=0.005)  # a standing one counts as going at 1 cm/s


# ---- somebody stands in the way


@KINDS
def test_it_stops_behind_one_that_stands_in_its_way_and_goes_on_once_that_has_left(kind: str) -> None:
    egos = egos_of(crossroads(model={**KRAUSS, "kind": kind}))
    drive(egos, 30.0, lambda _: blocked(40.0), 0.0)
    assert egos.disturbed[0]
    assert egos.v[0] < 0.2
    assert 40.0 - 3.5 < egos.s[0] + 2.5 < 40.0 - 2.4  # its gap at a standstill is 2.5 m
    before = float(egos.v[0])
    drive(egos, 2.0, lambda _: blocked(), 0.0, begin=30.0)
    assert egos.v[0] == pytest.approx(before + 2 * 2.6)  # with all it has
    drive(egos, 3.0, lambda _: blocked(), 0.0, begin=32.0)
    assert egos.v[0] == pytest.approx(10.0)  # and no faster than before


def test_one_that_drives_off_on_the_ego_s_path_is_followed() -> None:
    """40 m on the other way: at its own speed nobody is held up, at 2 m/s the ego comes down to that."""
    for speed, disturbed in ((10.0, False), (2.0, True)):
        egos = egos_of(crossroads())
        drive(egos, 20.0, lambda now, v=speed: blocked(40.0 + v * now, speed=v), speed)  # type: ignore[misc]
        assert egos.disturbed[0] == disturbed
        assert egos.v[0] == pytest.approx(speed, abs=0.1)


def test_what_is_blocked_behind_its_front_does_not_hold_it_up() -> None:
    egos = egos_of(crossroads())
    drive(egos, 2.0, lambda _: blocked(2.0), 0.0)
    assert not egos.disturbed[0]
    assert egos.s[0] == pytest.approx(20.0)


def test_beside_one_that_merges_and_is_ahead_it_brakes_as_hard_as_it_can() -> None:
    """The front of the ego (2.5 m) is 1 m past the rear of a car of 5 m: by 9 m/s2 slower each second. Once it is past
    that car's front, the ego drives on."""
    egos = egos_of(crossroads())
    v = float(egos.v[0])
    drive(egos, 0.1, lambda _: blocked(1.5, beside=5.0, speed=8.0), 8.0)
    assert egos.v == pytest.approx([v - 0.9])
    past = egos_of(crossroads())
    drive(past, 0.1, lambda _: blocked(-2.6, beside=5.0, speed=8.0), 8.0)
    assert past.v == pytest.approx([v])


# ---- its line is at 30 m, the ways meet at 34 m. To be over the ego has 34 + 2.5 + 2 = 38.5 m, which it takes to drive
# ---- in 1.5 s up to 13.9 m/s (17.925 m) and 1.48 s more: 2.98 s; to be there 29.5 m, that is 2.33 s.


@KINDS
def test_it_waits_at_its_line_for_one_who_comes_and_goes_on_behind_it(kind: str) -> None:
    """One who comes from 20 m at 3 m/s is expected there in 2.47 s and gone (40 m) in 4.0 s. The ego then stands 3 m
    before the place, for which it takes 1.5 s; so it goes when that one has 7.5 m left, which is after 10.8 s."""
    egos = egos_of(crossroads(30.0, {**KRAUSS, "kind": kind}))
    coming = crossing_at(3.0, before=20.0, behind=40.0)
    drive(egos, 10.0, coming, 3.0)
    assert egos.disturbed[0]
    assert egos.v[0] < 0.3
    assert 28.5 < egos.s[0] + 2.5 < 29.1  # SUMO's drivers stop 1 m before the line
    drive(egos, 6.0, coming, 3.0, begin=10.0)
    assert egos.v[0] == pytest.approx(10.0)
    assert egos.s[0] > 34.0


def test_it_does_not_wait_when_there_is_time_enough() -> None:
    """From 60 m at 10 m/s: 1.5 + 42.075 / 13.9 = 4.53 s, more than 2.98 + 1; from 40 m it is 3.09 s."""
    far, near = egos_of(crossroads(30.0)), egos_of(crossroads(30.0))
    drive(far, 5.0, crossing_at(10.0, before=60.0, behind=80.0), 10.0)
    drive(near, 3.0, crossing_at(10.0, before=40.0, behind=60.0), 10.0)
    assert (bool(far.disturbed[0]), bool(near.disturbed[0])) == (False, True)
    assert far.s[0] == pytest.approx(50.0)


def test_it_does_not_wait_for_one_who_will_be_gone_before() -> None:
    """20 m are left to that one: 1.5 + 2.075 / 13.9 = 1.65 s, less than the ego's 2.33 s."""
    egos = egos_of(crossroads(30.0))
    drive(egos, 5.0, crossing_at(10.0, before=0.0, behind=20.0), 10.0)
    assert not egos.disturbed[0]


@pytest.mark.parametrize(("line", "waits"), [(12.5, False), (13.7, True)])
def test_it_does_not_wait_when_it_can_no_longer_stop(line: float, waits: bool) -> None:
    """It needs 10^2 / (2 * 4.5) = 11.1 m, and would stop 1 m before the line: 10.1 m. It has 10.0 or 11.2 m."""
    egos = egos_of(crossroads(line))
    drive(egos, 3.0, crossing_at(3.0, before=20.0, behind=40.0), 3.0)
    assert bool(egos.disturbed[0]) is waits


def test_one_with_priority_does_not_wait_at_a_line() -> None:
    egos = egos_of(crossroads())
    drive(egos, 5.0, crossing_at(3.0, before=20.0, behind=40.0), 3.0)
    assert not egos.disturbed[0]
    assert egos.s[0] == pytest.approx(50.0)


def test_nobody_waits_for_one_whose_way_does_not_meet_theirs() -> None:
    egos = egos_of(crossroads(30.0))
    drive(egos, 5.0, lambda _: blocked(before=5.0, behind=25.0, meets=math.inf), 3.0)
    assert not egos.disturbed[0]


# ---- egos that were seen


def test_an_ego_that_was_seen_goes_as_it_did_whoever_is_in_its_way() -> None:
    speed = np.array([10.0, 9.0, 7.0, 4.0])
    course = EgoCourse(np.array([0.0, 0.9, 1.6, 2.0]), speed)
    other = EgoCourse(2.0 * course.s, 2.0 * speed)
    both = np.array([1.0, 1.0])
    egos = PredictedEgos(Scenes([crossroads(30.0)] * 2), 5.0 * both, 2.0 * both, [course, other])
    here = Blocked(*(q * both for q in (3.0, 0.0, 0.0, 5.0, 25.0, 34.0)))
    for k in range(3):
        egos.step(0.1 * k, (5.0 * both, 0.0 * both, 0.0 * both), 0.0 * both, here)
        assert egos.s == pytest.approx([course.s[k + 1], other.s[k + 1]])
        assert egos.v == pytest.approx([speed[k + 1], 2.0 * speed[k + 1]])
    assert egos.a == pytest.approx([-30.0, -60.0])  # 3 and 6 m/s within the last 0.1 s
    egos.step(0.3, (5.0 * both, 0.0 * both, 0.0 * both), 0.0 * both, here)
    assert egos.s == pytest.approx([2.0, 4.0])  # nothing more is known


# ---- above 60 km/h nobody passes on the right


@pytest.mark.parametrize(
    ("ego", "other", "left", "brakes"),
    [
        (20.0, 15.0, 3.2, True),
        (20.0, 15.0, -3.2, False),  # on the right: passing on the left is free
        (20.0, 15.0, 6.4, False),  # two lanes away
        (20.0, 22.0, 3.2, False),  # faster
        (16.0, 12.0, 3.2, False),  # below 60 km/h: as in a jam
    ],
)
def test_behind_a_slower_one_in_the_lane_to_the_left_a_fast_driver_brakes_gently(
    ego: float, other: float, left: float, brakes: bool
) -> None:
    """15 m before it. Krauss's safe speed is below what 4.5 m/s2 can do in a step of 0.1 s: it does that."""
    sit = situation([leader()], model=KRAUSS)
    sit = replace(sit, ego=replace(sit.ego, speed=ego), profile_s=np.arange(51) * 0.1 * ego, profile_v=np.full(51, ego))
    egos = egos_of(sit)
    egos.step(0.0, (np.array([20.0]), np.array([left]), np.array([0.0])), np.array([other]), blocked())
    assert egos.v[0] == pytest.approx(ego - (0.45 if brakes else 0.0))


def test_a_driver_that_is_not_sumo_s_passes_on_the_right() -> None:
    sit = situation([leader()], model={**KRAUSS, "passes_right": True})
    sit = replace(sit, ego=replace(sit.ego, speed=20.0), profile_s=np.arange(51) * 2.0, profile_v=np.full(51, 20.0))
    egos = egos_of(sit)
    egos.step(0.0, (np.array([20.0]), np.array([3.2]), np.array([0.0])), np.array([15.0]), blocked())
    assert egos.v[0] == pytest.approx(20.0)


@pytest.mark.parametrize(("sees", "brakes"), [(0.0, False), (2.5, True)])
def test_a_driver_may_have_whoever_is_beside_its_lane_for_its_leader(sees: float, brakes: bool) -> None:
    """A car that stands 12.5 m before the ego's front, its middle 2.2 m to the left: the lane ends at 1.6 m."""
    egos = egos_of(situation([leader()], model={**KRAUSS, "sees": sees, "passes_right": True}))
    for k in range(10):
        egos.step(0.1 * k, (np.array([17.5]), np.array([2.2]), np.array([0.0])), np.array([0.0]), blocked())
    assert bool(egos.v[0] < 9.0) is brakes
