"""Predicted egos at junctions: they keep clear of a vehicle on it, and wait at their line where they give way.

Everywhere the ego starts at station 0 with 10 m/s and is 5 m long, so its front is at 2.5 m.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from situation_samples import KRAUSS, changed, leader, situation

from sumo_adv.datatypes import DriverModel, Floats
from sumo_adv.drivers.prediction import PredictedEgos
from sumo_adv.simulation.sumo_rules import AtJunction, CarFollowing, SituationBatch, travel_time
from sumo_adv.situation import Situation

KINDS = pytest.mark.parametrize("kind", ["krauss", "idm"])


def crossroads(line: float = math.inf, model: DriverModel = KRAUSS, rule: str = "m", speed: float = 10.0) -> Situation:
    """The ego on a road with a junction that begins at a station [m], inf: no junction is known."""
    sit = situation([leader()], model=model, speed=speed)
    return changed(sit, junction=line, rule=rule if math.isfinite(line) else "")


def at_junction(
    on_junction: bool = False, *, merging: bool = False, rear_station: float = 0.0, front_to_zone: float = 0.0,
    rear_to_exit: float = 0.0, meets_at: float = 34.0, half_zone: float = 1.6, speed: float = 0.0,
    ran_red: bool = False, goes_first: bool = True, joins_at: float = math.inf, has_bay: bool = False,
) -> AtJunction:  # fmt: skip
    """A car of 5 m."""
    flags = (np.array([q]) for q in (on_junction, on_junction, has_bay, ran_red, goes_first, merging))
    rear_to_zone = front_to_zone + 5.0
    places = (
        meets_at, half_zone, min(joins_at, meets_at), front_to_zone, rear_to_zone, rear_to_exit, rear_station, speed,
    )  # fmt: skip
    return AtJunction(*flags, *(np.array([float(q)]) for q in places))


def drive(
    egos: PredictedEgos, seconds: float, way: Callable[[float], AtJunction], speed: float, begin: float = 0.0
) -> None:
    """Steps of 0.1 s beside a vehicle that is never in the ego's lane, and on the junction as ``way`` says."""
    aside = (np.array([0.0]), np.array([50.0]), np.array([0.0]))
    for k in range(round(seconds / 0.1)):
        time = begin + 0.1 * k
        egos.step(time, aside, np.array([speed]), way(time))


def egos_of(sit: Situation) -> PredictedEgos:
    return PredictedEgos(SituationBatch([sit]), np.array([5.0]), np.array([2.0]))


def crossing_at(speed: float, before: float, behind: float) -> Callable[[float], AtJunction]:
    """A vehicle that drives over the junction at an even speed, and is never in the way yet."""
    return lambda time: at_junction(
        front_to_zone=before - 1.6 - speed * time, rear_to_exit=behind - speed * time, meets_at=10.0, speed=speed
    )


# ---- seconds for a distance


@pytest.mark.parametrize(
    ("distance", "speed", "takes"),
    [
        (0.0, 8.0, 0.0),
        (-4.0, 8.0, 0.0),  # it is past
        (5.2, 0.0, 2.0),  # from standstill: 2.6 m/s2 for 2 s make 5.2 m
        (20.8, 0.0, 4.0),
        (22.6, 8.7, 2.0),  # from 8.7 to 13.9 m/s in 2 s, at 11.3 m/s in the mean
        (64.3, 8.7, 5.0),  # 3 s more at 13.9 m/s: 41.7 m
        (40.0, 20.0, 2.0),  # a faster vehicle keeps its speed
    ],
)
def test_the_seconds_for_a_distance_with_acceleration_up_to_13_9_metres_a_second(
    distance: float, speed: float, takes: float
) -> None:
    times: Floats = travel_time(np.array([distance]), np.array([speed]), 2.6)
    assert times[0] == pytest.approx(takes, abs=0.005)  # a standing one counts as going at 1 cm/s


# ---- car following


def test_krauss_s_safe_speeds() -> None:
    """Braking by 0.45 m/s in each step of 0.1 s, n steps from 0.45 n m/s take 0.0225 n (n - 1) + 0.45 n tau metres.

    The car ahead needs 22 steps and 10.615 m from 10 m/s; with 20 m more, and tau = 1 s, 28 steps take 29.61 m, and the
    1.004 m that are left over 2.8 + 1 s: 12.6 + 0.264 m/s. Before a line 20 m ahead (tau = 0.1 s) 29 steps take
    19.575 m: 13.05 + 0.424 / 3 m/s; at the line 0."""
    driver, v = CarFollowing(KRAUSS, 0.1), np.array([10.0])
    assert driver.behind(v, np.array([22.5]), v)[0] == pytest.approx(12.864, abs=0.001)
    assert driver.stopping(v, np.array([20.0]))[0] == pytest.approx(13.191, abs=0.001)
    assert driver.stopping(v, np.array([-3.0]))[0] == 0.0
    assert driver.free(v)[0] == pytest.approx(10.26)


@pytest.mark.parametrize(
    ("gap", "leader", "speed"),
    [
        (12.5, 0.0, 10.0 - 0.1 * 1.2 * 5.0),  # 10 m beyond 2.5 m: 10^2 / (2 * 10) = 5 m/s2
        (7.5, 5.0, 10.0 - 0.1 * 1.2 * 7.5),  # (10^2 - 5^2) / (2 * 5) = 7.5 m/s2: the leader brakes as hard
        (3.5, 0.0, 10.0 - 6.0),  # 50 m/s2: more than any car can do; the caller limits it
        (2.4, 0.0, 10.0 - 0.9),  # nearer than it wants to stand: 9 m/s2
    ],
)
def test_in_an_emergency_krauss_s_driver_brakes_by_a_fifth_more_than_is_needed(
    gap: float, leader: float, speed: float
) -> None:
    driver, v = CarFollowing(KRAUSS, 0.1), np.array([10.0])
    assert driver.behind(v, np.array([gap]), np.array([leader]))[0] == pytest.approx(speed, abs=0.01)


def test_idm_s_speeds() -> None:
    """At 10 of 20 m/s it accelerates by 2.6 * (1 - 1/16) = 2.4375 m/s2. Before a line its gap is
    v tau + v^2 / (2 sqrt(a b)) = 10 + 100 / 6.841 = 24.62 m, behind a car of its speed 2.5 + 10 m:
    at such gaps it brakes by 2.6 / 16 m/s2."""
    driver, v = CarFollowing(replace(KRAUSS, kind="idm", speed=20.0), 0.1), np.array([10.0])
    assert driver.free(v)[0] == pytest.approx(10.24375)
    assert driver.stopping(v, np.array([24.62]))[0] == pytest.approx(10.0 - 0.01625, abs=1e-4)
    assert driver.behind(v, np.array([12.5]), v)[0] == pytest.approx(10.0 - 0.01625)
    assert driver.stopping(v, np.array([0.0]))[0] == 0.0


# ---- a vehicle stands in the way


@KINDS
@pytest.mark.parametrize("junction", [26.0, math.inf])
def test_it_stops_before_a_vehicle_standing_in_its_way_until_that_has_left(kind: str, junction: float) -> None:
    """The ways cross at 34 m, what is taken up there begins at 32.4 m: it stops 2.5 m before."""
    egos = egos_of(crossroads(junction, replace(KRAUSS, kind=kind), "M"))
    drive(egos, 30.0, lambda _: at_junction(True, front_to_zone=-3.0), 0.0)
    assert egos.disturbed[0]
    assert egos.v[0] < 0.2
    assert egos.s[0] + 2.5 == pytest.approx(29.9, abs=0.3)
    before = float(egos.v[0])
    drive(egos, 2.0, lambda _: at_junction(), 0.0, begin=30.0)
    assert egos.v[0] == pytest.approx(before + 2 * 2.6, abs=0.1)  # with all it has
    drive(egos, 8.0, lambda _: at_junction(), 0.0, begin=32.0)
    assert egos.v[0] == pytest.approx(10.0, abs=0.05)  # and no faster than before


def test_it_does_not_brake_for_a_vehicle_that_will_be_gone_in_time() -> None:
    """The zone begins 14 m before the ego's front, which wants to stop after 11.5 m: for that 22 steps take 11.385 m,
    so it may have 9.9 + 0.114 / 2.3 = 9.95 m/s. A vehicle with 2 m left to be past it is followed, 11.5 - 2 m behind:
    at 12 m/s no reason to brake."""
    for speed, brakes in ((12.0, False), (0.0, True)):
        egos = egos_of(crossroads(12.0))
        drive(egos, 0.1, lambda _, v=speed: at_junction(True, front_to_zone=-6.2, speed=v, meets_at=18.1), speed)  # type: ignore[misc]
        assert bool(egos.disturbed[0]) is brakes


@pytest.mark.parametrize(
    ("junction", "yields", "before", "brakes"),
    [
        (2.4, False, 6.0, False),  # the ego was on the junction first
        (2.4, False, -0.1, True),  # but that one is where the ways meet
        (2.6, False, 6.0, True),  # that one was there first
        (2.6, True, 6.0, True),  # against a red light too, as long as the ego is not on the junction itself
    ],
)
def test_the_first_vehicle_on_the_junction_goes_first(
    junction: float, yields: bool, before: float, brakes: bool
) -> None:
    """The ego's front is at 2.5 m, the zone begins at 12 m, that one stands; after a tenth of a second."""
    egos = egos_of(crossroads(junction))
    if junction < 2.5:
        drive(egos, 0.1, lambda _: at_junction(meets_at=13.6), 0.0)
    drive(egos, 0.1, lambda _: at_junction(True, front_to_zone=before, meets_at=14.6, ran_red=yields), 0.0, begin=0.1)
    assert bool(egos.disturbed[0]) is brakes


@pytest.mark.parametrize(("bay", "first", "held"), [(math.inf, True, False), (6.0, True, True), (6.0, False, False)])
def test_where_it_waits_on_the_junction_for_others_it_is_not_there_first(bay: float, first: bool, held: bool) -> None:
    """The ego's front is at 2.5 m, over the line of its junction at 2 m. Then another one comes, and stands; where the
    ego waits on the junction, at 6 m, and that one goes first, it is in its way as before the junction."""
    egos = egos_of(changed(crossroads(2.0), bay=bay))
    drive(egos, 0.1, lambda _: at_junction(meets_at=13.6, goes_first=first), 0.0)
    drive(egos, 0.2, lambda _: at_junction(True, front_to_zone=6.0, meets_at=13.6, goes_first=first), 0.0, begin=0.1)
    assert bool(egos.disturbed[0]) is held


def test_a_vehicle_that_drives_off_on_the_ego_s_path_is_followed() -> None:
    """40 m on the other way: at the ego's own speed it is not held up; behind 2 m/s it slows down to that."""
    for speed, disturbed in ((10.0, False), (2.0, True)):
        egos = egos_of(crossroads())
        drive(
            egos,
            20.0,
            lambda time, v=speed: at_junction(
                True, merging=True, rear_station=40.0 + v * time, meets_at=300.0, speed=v
            ),
            speed,
        )  # type: ignore[misc]
        assert egos.disturbed[0] == disturbed
        assert egos.v[0] == pytest.approx(speed, abs=0.1)


@pytest.mark.parametrize(("junction", "v"), [(14.0, 10.0 - 0.045), (11.0, 10.0 - 0.9), (40.0, 10.0)])
def test_while_one_merges_that_is_not_ahead_the_ego_does_not_drive_onto_the_junction(junction: float, v: float) -> None:
    """The other's rear is 20 m behind the ego's front (2.5 m). It has 11.4, 8.4 or 37.4 m to the line: for the first it
    may have 9.95 m/s as before any line, for the second 8.5 m/s, which is more than 9 m/s2."""
    egos = egos_of(crossroads(junction))
    drive(egos, 0.1, lambda _: at_junction(True, merging=True, rear_station=-17.5, meets_at=60.0, speed=8.0), 8.0)
    assert egos.v[0] == pytest.approx(v, abs=0.05)


def test_what_is_blocked_behind_its_front_does_not_hold_it_up() -> None:
    """The zone ends 0.1 m behind its front."""
    egos = egos_of(crossroads())
    drive(egos, 2.0, lambda _: at_junction(True, meets_at=0.8), 0.0)
    assert not egos.disturbed[0]
    assert egos.s[0] == pytest.approx(20.0)


def test_beside_a_merging_vehicle_it_brakes_as_hard_as_it_can_until_it_is_past_that_place() -> None:
    """The front of the ego (2.5 m) is on the junction, 1 m past the rear of a car of 5 m: by 9 m/s2 slower each second.
    Past the place where their ways become one, or where they merge, it drives on."""
    egos = egos_of(crossroads(1.0))
    v = float(egos.v[0])
    drive(egos, 0.1, lambda _: at_junction(True, merging=True, rear_station=1.5, speed=12.0), 12.0)
    assert egos.v == pytest.approx([v - 0.9])
    for place in ({"meets_at": 2.4}, {"joins_at": 2.4, "front_to_zone": 6.0}):
        past = egos_of(crossroads(1.0))
        drive(past, 0.1, lambda _, p=place: at_junction(True, merging=True, rear_station=1.5, speed=12.0, **p), 12.0)
        assert past.v == pytest.approx([v])


@pytest.mark.parametrize(("rival_speed", "brakes"), [(9.9, False), (10.1, True)])
def test_if_two_enter_a_junction_in_one_step_the_slower_one_yields(rival_speed: float, brakes: bool) -> None:
    """The ego's front (2.5 m, then 3.5 m at 10 m/s) is past its line (3 m) in the step in which the other one's is."""
    egos = egos_of(crossroads(3.0))
    drive(egos, 0.1, lambda _: at_junction(merging=True, front_to_zone=2.0, speed=rival_speed), rival_speed)
    drive(
        egos,
        0.1,
        lambda _: at_junction(True, merging=True, rear_station=4.0, front_to_zone=1.0, speed=rival_speed),
        rival_speed,
        begin=0.1,
    )
    assert (egos.v[0] < 10.0 - 1e-6) == brakes


def test_being_first_on_one_junction_says_nothing_about_the_next() -> None:
    """Its way leads over a junction at 1 m and another one at 20 m; ways that merge at 30 m do so on that. A vehicle
    on that junction keeps the ego from driving onto it."""
    sit = changed(crossroads(1.0, rule="M"), later=(20.0,))
    egos = egos_of(sit)
    drive(egos, 4.0, lambda _: at_junction(True, merging=True, rear_station=5.0, meets_at=30.0), 0.0)
    assert egos.s[0] + 2.5 == pytest.approx(19.9, abs=0.05)  # 0.1 m before it
    alone = egos_of(changed(sit, later=()))
    drive(alone, 4.0, lambda _: at_junction(True, merging=True, rear_station=5.0, meets_at=30.0), 0.0)
    assert alone.s[0] > 30.0


def test_an_ego_that_turns_left_waits_in_its_bay_for_a_vehicle_on_the_junction() -> None:
    """Its line is at 3 m, its bay at 12 m, the ways cross at 25 m: it stops 0.1 m before the end of the bay, although
    there is room up to the other vehicle, which stands."""
    egos = egos_of(changed(crossroads(3.0, rule="m"), bay=12.0))
    drive(egos, 8.0, lambda _: at_junction(True, meets_at=25.0, front_to_zone=3.0, goes_first=False), 0.0)
    assert egos.s[0] + 2.5 == pytest.approx(11.9, abs=0.05)


# ---- its line is at 6 m, the ways meet at 10 m, it comes with 5 m/s. To be over it has 7.5 + 5 + 2 = 14.5 m, which it
# ---- takes to drive in 1.93 s up to 10.0 m/s; to its line 3.5 m, that is 0.60 s.


@KINDS
def test_it_waits_at_its_line_for_a_vehicle_and_goes_on_behind_it(kind: str) -> None:
    """A vehicle from 15 m at 3 m/s is expected there in 2.43 s. The ego then stands at its line; it goes when the
    vehicle has driven its 35 m, which is after 11.7 s."""
    egos = egos_of(crossroads(6.0, replace(KRAUSS, kind=kind), speed=5.0))
    coming = crossing_at(3.0, before=15.0, behind=35.0)
    drive(egos, 10.0, coming, 3.0)
    assert egos.disturbed[0]
    assert egos.v[0] < 0.3
    assert 5.4 < egos.s[0] + 2.5 < 6.1
    drive(egos, 6.0, coming, 3.0, begin=10.0)
    assert egos.v[0] == pytest.approx(5.0, abs=0.1)
    assert egos.s[0] > 10.0


@pytest.mark.parametrize(
    ("speed", "before", "behind", "waits"),
    [
        (10.0, 60.0, 80.0, False),  # 1.5 + 42.1 / 13.9 = 4.53 s, more than 1.93 + 1
        (10.0, 30.0, 50.0, True),  # 2.37 s
        (10.0, -15.0, 5.0, False),  # it will be gone in 0.47 s
        (3.0, 15.0, 35.0, True),
    ],
)
def test_it_waits_where_both_would_be_there_at_once(speed: float, before: float, behind: float, waits: bool) -> None:
    egos = egos_of(crossroads(6.0, speed=5.0))
    drive(egos, 0.5, crossing_at(speed, before=before, behind=behind), speed)
    assert bool(egos.disturbed[0]) is waits


def test_it_waits_at_its_line_for_one_on_the_junction_that_turns_over_a_bay() -> None:
    """Its line is at 6 m; the ways cross at 14 m, if the vehicle goes straight on, the ego drives up to there."""
    for turns, front in ((True, 6.0), (False, 14.0 - 1.6 - 2.5)):
        egos = egos_of(crossroads(6.0, speed=5.0))
        here = at_junction(True, meets_at=14.0, front_to_zone=-1.0, rear_to_exit=3.0, has_bay=turns)
        drive(egos, 6.0, lambda _, b=here: b, 0.0)
        assert egos.s[0] + 2.5 == pytest.approx(front, abs=0.3)


@pytest.mark.parametrize(("line", "waits"), [(4.9, False), (5.1, True), (7.1, False)])
def test_it_decides_where_it_sees_the_others_and_can_still_stop(line: float, waits: bool) -> None:
    """Braking by 0.45 m/s a step, it needs 0.1 (4.55 + 4.1 + ... + 0.05) = 2.53 m. It has 2.4, 2.6 or 4.6 m; more than
    4.5 m before the line SUMO's drivers brake as to stop, and do so unattacked too."""
    egos = egos_of(crossroads(line, speed=5.0))
    drive(egos, 0.1, crossing_at(3.0, before=15.0, behind=35.0), 3.0)
    assert bool(egos.disturbed[0]) is waits


def test_at_an_all_way_stop_it_does_not_wait_for_a_vehicle_that_does_not_stop() -> None:
    egos = egos_of(crossroads(6.0, rule="w", speed=5.0))
    drive(egos, 2.0, crossing_at(3.0, before=15.0, behind=35.0), 3.0)
    assert not egos.disturbed[0]


def test_one_with_priority_does_not_wait_at_a_line() -> None:
    egos = egos_of(crossroads())
    drive(egos, 5.0, crossing_at(3.0, before=20.0, behind=40.0), 3.0)
    assert not egos.disturbed[0]
    assert egos.s[0] == pytest.approx(50.0)


def test_it_does_not_wait_for_a_vehicle_that_gives_way_to_it() -> None:
    """At 6 m there is a line at which it gives way, but not to this one."""
    egos = egos_of(crossroads(6.0, speed=5.0))
    drive(
        egos,
        2.0,
        lambda _: at_junction(front_to_zone=15.0, rear_to_exit=35.0, meets_at=10.0, speed=3.0, goes_first=False),
        3.0,
    )
    assert not egos.disturbed[0]


def test_it_does_not_wait_for_a_vehicle_if_their_ways_do_not_meet() -> None:
    egos = egos_of(crossroads(30.0))
    drive(egos, 5.0, lambda _: at_junction(front_to_zone=5.0, rear_to_exit=25.0, meets_at=math.inf), 3.0)
    assert not egos.disturbed[0]
