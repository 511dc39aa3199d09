"""What predicted rollouts score: who could have avoided it, with what to spare, and whether others leave room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
from shapely import box
from situation_samples import car, changed, situation, target

from sumo_adv.datatypes import Boxes, Floats, Limits, Planner, Proposal, Role, Track
from sumo_adv.geometry import make_path
from sumo_adv.search.rollouts import Rollouts
from sumo_adv.search.scoring import (
    _brakes,
    _cut,
    _held,
    _score,
    _surely,
    judge_all,
)
from sumo_adv.search.settings import ScoreSettings
from sumo_adv.simulation.network import Drivable
from sumo_adv.situation import Situation

STEPS, DT = 60, 0.1
WEIGHTS = ScoreSettings()
NONE, OFF_ROAD, BEYOND = WEIGHTS.unavoidable, WEIGHTS.off_road, WEIGHTS.beyond_limits
THIRD, REAR, GRAZES = WEIGHTS.third_party, WEIGHTS.rear_end, WEIGHTS.grazes
TIME: Floats = DT * np.arange(float(STEPS))
PLANNER = Planner("any", "plain", "", (), "seed")
PROPOSAL = Proposal("bv", "any", PLANNER, {}, 0.0, 0.0)
State = tuple[Floats, Floats, Floats, Floats]


def motion(x: float, y: Floats | float, speed: float) -> State:
    """East at an even speed; ``y`` over time, the heading left at 0 (it drifts)."""
    zero = 0.0 * TIME
    return x + speed * TIME, zero + y, zero, zero + speed


def row(state: State) -> State:
    x, y, h, v = (q[None, :] for q in state)
    return x, y, h, v


def scene(bv: State, others: Sequence[Track] = ()) -> Situation:
    x, y, _, v = (float(q[0]) for q in bv)
    path = make_path([(0.0, 0.0), (400.0, 0.0)])
    way = make_path([(x, y), (x + 300.0, y)])
    base = situation([target(car("bv", x, y, speed=v), "neighbour", [(way, "none", np.inf)], path)], speed=30.0)
    return changed(base, others=tuple(others))


def judged(
    ego: State, bv: State, others: Sequence[Track] = (), road: tuple[float, float] = (-4.8, 2.3), left: float = np.inf,
) -> Any:  # fmt: skip
    """The one rollout of these motions on a road between two offsets [m]; the log is over after ``left`` steps."""
    drivable = Drivable(box(-100.0, road[0], 500.0, road[1]))
    rollouts = Rollouts(TIME, row(ego), row(bv), np.array([False]))
    (found,) = judge_all(replace(scene(bv, others), left=left), [PROPOSAL], rollouts, drivable, Limits(), WEIGHTS)
    return {"score": found[0], **asdict(found[1])}


def vehicle(name: str, state: State) -> Track:
    """Another vehicle, from the trigger (100 s) on."""
    x, y, h, v = state
    return Track(name, Role.BACKGROUND, 100.0 + TIME, x, y, h, v, 0.0 * v, 5.0, 2.0, ("",) * STEPS)


# ---- the table


@pytest.mark.parametrize(
    ("careful", "late", "manoeuvre", "score"),
    [
        (False, False, (0, 0, 0, 0), 1.3),  # nobody
        (False, False, (1, 0, 0, 0), 1.0),  # a manoeuvre begun 0.6 s after the hazard, no later
        (False, False, (1, 1, 0, 0), 0.6),  # 0.8 s
        (False, False, (1, 1, 1, 0), 0.47),  # 1.0 s
        (False, False, (1, 1, 1, 1), 0.34),  # 1.4 s
        (False, False, (0, 1, 0, 0), 0.6),  # the last one that helps, whether or not earlier ones do
        (True, False, (0, 0, 0, 0), 0.08),  # the careful driver, who only brakes
        (True, False, (1, 1, 1, 1), 0.08),
        (True, True, (1, 1, 1, 1), 0.0),  # also one who is 0.4 s slower
    ],
)
def test_the_score_goes_by_who_avoids_it_and_with_what_to_spare(
    careful: bool, late: bool, manoeuvre: tuple[int, ...], score: float
) -> None:
    found = _score(
        np.array([careful]), np.array([late]), np.zeros(1), np.array([manoeuvre], bool), np.zeros(1), WEIGHTS
    )
    assert found.tolist() == [score]


def test_the_nearer_a_brake_comes_to_avoiding_it_the_better_but_never_as_good_as_avoided() -> None:
    """At most 0.24 less: what nobody avoids does not come to be avoidable (0.75), nor that what a brake avoids."""
    no, most = np.zeros(3, bool), np.full(3, 0.24)
    manoeuvre = np.array([(0, 0, 0, 0), (1, 0, 0, 0), (1, 1, 1, 1)], bool)
    found = _score(no, no, most, manoeuvre, np.full(3, 5.0), WEIGHTS)
    assert found == pytest.approx([0.76, 0.76, 0.10])
    assert _score(~no, no, most, manoeuvre, np.zeros(3), WEIGHTS).tolist() == [0.08] * 3


def test_of_those_that_nobody_avoids_one_with_more_warning_scores_better() -> None:
    """0.3 less for two seconds of it or more, in proportion for less."""
    nobody = np.zeros(4, bool)
    found = _score(nobody, nobody, np.zeros(4), np.zeros((4, 4), bool), np.array([0.0, 1.0, 2.0, 5.0]), WEIGHTS)
    assert found == pytest.approx([1.3, 1.15, 1.0, 1.0])


# ---- after the contact


def test_after_the_contact_the_motion_goes_straight_on_as_the_judge_has_it() -> None:
    """North at 5 m/s, from the step 2 on (y = 1.0) braking and turning; cut there it is at 1.5 m after 0.1 s."""
    y = np.array([[0.0, 0.5, 1.0, 1.2, 1.3, 1.3]])
    x = np.array([[0.0, 0.0, 0.0, 0.1, 0.2, 0.2]])
    heading = np.array([[1.0, 1.0, 1.0, 0.5, 0.2, 0.2]]) * np.pi / 2
    speed = np.array([[5.0, 5.0, 5.0, 2.0, 1.0, 0.0]])
    found = _cut(Boxes(x, y, heading, speed, 5.0, 2.0), np.array([2]), 0.1)
    assert found.y[0] == pytest.approx([0.0, 0.5, 1.0, 1.5, 2.0, 2.5])
    assert found.x[0] == pytest.approx([0.0] * 6)
    assert found.heading[0] == pytest.approx([np.pi / 2] * 6)
    assert found.speed[0] == pytest.approx([5.0] * 6)
    assert (found.length, found.width) == (5.0, 2.0)


def test_motions_without_a_contact_stay_as_they_are() -> None:
    x = np.array([[0.0, 1.0, 1.5], [4.0, 5.0, 7.0]])
    found = _cut(Boxes(x, 0 * x, 0 * x, 10.0 + 0 * x, 5.0, 2.0), np.array([2, 2]), 0.1)
    assert found.x == pytest.approx(x)


# ---- whole rollouts: the ego at 30 m/s in the right of two lanes


DRIFTS = np.maximum(1.2 - 0.8 * TIME, 0.5)  # from the line into the ego's lane: 0.4 m within 0.5 s


def test_how_much_it_brakes_until_the_contact_is_told() -> None:
    """From 10 m/s by 0.9, then by 2 m/s2, each in half of the steps before the contact; what comes then is nothing."""
    speeds = np.concatenate([10.0 - 0.09 * np.arange(11), 9.1 - 0.2 * np.arange(1, 11), np.full(30, 0.0)])
    assert _brakes(speeds[None, :], 0.1)[0, :20].tolist() == [False] * 10 + [True] * 10
    ego = motion(0.0, 0.0, 30.0)
    assert judged(ego, motion(60.0, 0.0, 5.0))["braking"] == 0.0


def test_a_way_out_that_another_vehicle_fills_does_not_count() -> None:
    """A car at 5 m/s, 60 m ahead, comes half into the lane: the hazard shows after half a second (0.4 m), the contact
    comes after 2.2 s (55 m of gap at 25 m/s). Then 42.5 m are left, and braking takes 25 * 0.6 + 25^2 / 16 = 54 m; but
    to the right there is room, and just time for 1.5 m."""
    ego, bv = motion(0.0, 0.0, 30.0), motion(60.0, DRIFTS, 5.0)
    alone = judged(ego, bv)
    assert (alone["hit"], alone["careful"]) == (True, False)
    assert (alone["time"], alone["warning"]) == pytest.approx((2.2, 1.7))
    assert 0.1 < alone["score"] <= 0.8
    beside = vehicle("beside", motion(1.0, -3.2, 30.0))
    filled = judged(ego, bv, [beside])
    assert (filled["hit"], filled["manoeuvre"]) == (True, False)
    assert filled["score"] == pytest.approx(NONE - 0.3 * 1.7 / 2)
    far = vehicle("far", motion(1.0, -30.0, 30.0))
    assert judged(ego, bv, [far])["score"] == alone["score"]
    itself = vehicle("bv", motion(1.0, -3.2, 30.0))  # the adversary's unattacked motion is in nobody's way
    assert judged(ego, bv, [itself])["score"] == alone["score"]


def test_nor_does_one_off_the_road() -> None:
    found = judged(motion(0.0, 0.0, 30.0), motion(60.0, DRIFTS, 5.0), road=(-1.3, 2.3))
    assert found["score"] == pytest.approx(NONE - 0.3 * 1.7 / 2)


@pytest.mark.parametrize(("turned", "sure"), [(0.0, True), (-0.02, False)])
def test_who_turns_may_have_turned_otherwise_and_see_the_hazard_late(turned: float, sure: bool) -> None:
    """Another one comes towards the ego at 20 m/s, 1 m to the left of its way, and seems to be over the line (1.6 m to
    its side, 1 m from its middle) from the beginning. An ego that has turned by -0.02 rad in the end, at 52 m, and may
    be by 0.02 rad more has it 1 + 0.04 d metres to its left where it is d metres from there: over the line from 40 m
    on, after 3.4 s, 1.8 s before they meet."""
    x, y, h, v = row(motion(0.0, 0.0, 10.0))
    ego = Boxes(x, y, np.where(TIME > 4.0, turned, h), v, 5.0, 2.0)
    other = Boxes(160.0 - 20.0 * TIME[None, :], y + 1.0, h + np.pi, v * 0.0 + 20.0, 5.0, 2.0)
    last, yes, first = np.array([52]), np.array([True]), np.array([0])
    careful, hazard = _surely(yes, ego, other, _held(ego, last), first, last, DT, 1.6, WEIGHTS.turn_error)
    assert careful[0] == sure
    assert hazard[0] == (0 if sure else pytest.approx(34, abs=1))


def test_who_has_time_enough_scores_better() -> None:
    """Half a second after the trigger the hazard shows. A careful driver takes 25 m/s * 1.15 s, 7.5 m in the ramp and
    25^2 / (2 * 7.59) = 41.2 m: 77.4 m; one who is 0.4 s slower 10 m more. 82.5 m and 122.5 m are left."""
    ego = motion(0.0, 0.0, 30.0)
    near, middle, far = (judged(ego, motion(x, DRIFTS, 5.0)) for x in (60.0, 100.0, 140.0))
    assert [q["hit"] for q in (near, middle, far)] == [True] * 3
    assert [q["careful"] for q in (near, middle, far)] == [False, True, True]
    assert (middle["score"], far["score"]) == (0.08, 0.0)


def test_what_does_not_count_as_a_collision() -> None:
    ego, behind = motion(0.0, 0.0, 30.0), motion(-15.0, 0.0, 40.0)
    assert judged(ego, behind)["score"] == REAR
    assert judged(ego, motion(50.0, DRIFTS, 5.0), road=(-4.8, 2.0))["score"] == OFF_ROAD  # its side is at 2.2 m
    standing = vehicle("standing", motion(56.0, 0.6, 0.0))  # 1 m ahead
    assert judged(ego, motion(50.0, DRIFTS, 5.0), [standing])["score"] == THIRD


def test_a_third_party_counts_if_it_is_touched_between_steps_and_before_the_ego() -> None:
    """The adversary reaches 55 m with its front after 1 s, when a car 1 m long crosses at 60 m/s, 6 m a step.

    The bumpers of ego and adversary are 40 m apart, which 25 m/s close in 1.6 s.
    """
    ego, bv = motion(0.0, 0.0, 30.0), motion(45.0, 0.0, 5.0)
    for meets, counts in ((1.05, True), (1.75, False)):
        y = 60.0 * (TIME - meets)
        crossing = replace(
            vehicle("third", (0.0 * TIME + 52.0, y, 0.0 * TIME + np.pi / 2, 0.0 * TIME + 60.0)), length=1.0
        )
        found = judged(ego, bv, [crossing])
        assert found["hit"] and found["third_party"] is counts


@pytest.mark.parametrize(("aside", "closing", "rear"), [
    (1.7, 3.0, True),  # the corners: 0.3 m of the two widths overlap, front to back
    (2.3, 3.0, False),  # it comes up beside, and over from there
    (1.7, -3.0, False),  # the ego backs into it, so to say: the adversary is ahead
])  # fmt: skip
def test_who_drives_into_the_ego_s_back_does_not_count_also_with_a_corner(
    aside: float, closing: float, rear: bool
) -> None:
    """Both 5 x 2 m, 15 m apart; 2.3 m aside it drifts by 1 m/s over the last second, when it is beside."""
    drift = np.maximum(TIME - 4.0, 0.0) if aside > 2.0 else 0.0 * TIME
    ego = motion(0.0, 0.0, 20.0)
    bv = motion(-15.0 if closing > 0 else 15.0, aside - drift, 20.0 + closing)
    assert (judged(ego, bv)["score"] == REAR) == rear
    assert judged(ego, bv)["hit"]


def test_a_miss_scores_by_how_near_it_comes() -> None:
    """Beside the ego at its speed, the sides 0.1 m apart: no TTC (10 s are the most), 1.5 + 0.3 * 10 + 0.1 * 0.1."""
    found = judged(motion(0.0, 0.0, 30.0), motion(0.0, 2.1, 30.0), road=(-4.8, 4.8))
    assert not found["hit"]
    assert found["gap"] == pytest.approx(0.1)
    assert found["score"] == pytest.approx(1.5 + 3.0 + 0.01)


def test_a_touch_by_a_hand_s_breadth_may_be_a_miss_and_is_worth_less() -> None:
    """Both are 2 m wide. At 1.9 m aside they overlap by 0.1 m, and 0.3 m less of width would not; at 1.6 m by 0.4 m."""
    ego = motion(0.0, 0.0, 30.0)
    graze, firm = (judged(ego, motion(140.0, aside, 5.0), road=(-4.8, 4.8)) for aside in (1.9, 1.6))
    assert (graze["hit"], firm["hit"]) == (True, True)
    assert graze["score"] - firm["score"] == pytest.approx(GRAZES)


def test_what_would_happen_after_the_end_of_the_log_does_not_count() -> None:
    """The bumpers are 135 m apart and come nearer by 25 m/s: they touch after 5.4 s, 54 steps."""
    ego, bv = motion(0.0, 0.0, 30.0), motion(140.0, 0.0, 5.0)
    assert judged(ego, bv, left=54)["hit"]
    missed = judged(ego, bv, left=53)
    assert not missed["hit"]
    assert (missed["time"], missed["gap"]) == pytest.approx((5.3, 135.0 - 25.0 * 5.1))  # every third step is looked at


def test_a_motion_that_leaps_is_no_hit_that_counts() -> None:
    """Half a metre to the side within a step of 0.1 s; at 10 m/s 0.2 m are a slip."""
    ego, (x, y, h, v) = motion(0.0, 0.0, 20.0), motion(40.0, 0.0, 10.0)
    for leap, beyond in ((0.5, True), (0.1, False)):
        assert judged(ego, (x, y + np.where(TIME >= 1.0, leap, 0.0), h, v))["beyond_limits"] is beyond


def test_a_motion_that_jerks_is_no_hit_that_counts() -> None:
    """A brake of 3 m/s2 that is there within a step has 30 m/s3, one that grows by 1 m/s2 a step 10; 12 are allowed,
    and 3 for rounding."""
    ego, (x, y, h, v) = motion(0.0, 0.0, 20.0), motion(40.0, 0.0, 10.0)
    for brakes, beyond in (([3.0], True), ([1.0, 2.0, 3.0], False)):
        a = np.concatenate([np.zeros(9), brakes, np.full(STEPS - 9 - len(brakes), 3.0)])
        speed = np.maximum(v - 0.1 * np.cumsum(a), 0.0)
        along = x[0] + 0.1 * np.cumsum(speed)
        assert judged(ego, (along, y, h, speed))["beyond_limits"] is beyond


def test_a_motion_that_turns_harder_than_the_gates_allow_is_no_hit_that_counts() -> None:
    """At 15 m/s a turn of 0.3 rad/s has 4.5 m/s2 sideways, half a m/s2 more than the limit; of 0.2 rad/s it has 3."""
    for rate, beyond in ((0.3, True), (0.2, False)):
        x, y, heading, speed = motion(60.0, DRIFTS, 15.0)
        heading = heading + rate * np.minimum(TIME, 0.5)
        found = judged(motion(0.0, 0.0, 30.0), (x, y, heading, speed))
        assert found["hit"]
        assert found["beyond_limits"] == beyond
        assert (found["score"] == BEYOND) == beyond


@pytest.mark.parametrize(("behind", "role", "reacting", "third"), [
    (30.0, Role.BACKGROUND, True, False),  # it brakes
    (30.0, Role.BACKGROUND, False, True),  # a log moves it
    (30.0, Role.OBSTACLE, True, True),  # nobody drives it
    (7.0, Role.BACKGROUND, True, True),  # 2 m behind: it cannot stop in time
    (6.0, Role.BACKGROUND, True, False),  # 1 m behind: they touch at the first driven step, which the gate allows
])  # fmt: skip
def test_a_third_vehicle_that_brakes_for_the_adversary_is_not_hit(
    behind: float, role: Role, reacting: bool, third: bool
) -> None:
    """The adversary comes to the ego's lane 100 m away, at once half as fast as the one behind it at 20 m/s."""
    ego, bv = motion(0.0, 0.0, 20.0), motion(60.0, 0.0, 10.0)
    follower = replace(vehicle("third", motion(60.0 - behind, 0.0, 20.0)), role=role)
    now = changed(scene(bv, [follower]), reacting=reacting)
    rollouts = Rollouts(TIME, row(ego), row(bv), np.array([False]))
    road = Drivable(box(-100.0, -4.8, 500.0, 2.3))
    ((score, found),) = judge_all(now, [PROPOSAL], rollouts, road, Limits(), WEIGHTS)
    assert found.third_party is third
    assert (score == THIRD) is third
