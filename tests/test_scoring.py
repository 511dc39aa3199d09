"""What predicted rollouts score: which driver could have avoided it, with what margin, and whether others leave
room.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
from shapely import box
from situation_samples import car, changed, situation, target

from sumo_adv.datatypes import Floats, Level, Limits, Planner, Proposal, Role, Track
from sumo_adv.geometry import make_path
from sumo_adv.search.rollouts import Rollouts
from sumo_adv.search.scoring import judge_all
from sumo_adv.search.settings import ScoreSettings
from sumo_adv.simulation.network import Drivable
from sumo_adv.situation import Situation

STEPS, DT = 60, 0.1
WEIGHTS = ScoreSettings()
NONE, OFF_ROAD, BEYOND = WEIGHTS.collision, WEIGHTS.off_road, WEIGHTS.beyond_limits
THIRD, REAR = WEIGHTS.third_party, WEIGHTS.rear_end
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
    situations = {0.0: replace(scene(bv, others), left=left)}
    ((score, prediction),) = judge_all(situations, [PROPOSAL], rollouts, drivable, Limits(), WEIGHTS)
    return {"score": score, **asdict(prediction)}


def vehicle(name: str, state: State) -> Track:
    """Another vehicle, from the trigger (100 s) on."""
    x, y, h, v = state
    return Track(name, Role.BACKGROUND, 100.0 + TIME, x, y, h, v, 0.0 * v, 5.0, 2.0, ("",) * STEPS)


# ---- whole rollouts: the ego at 30 m/s in the right of two lanes


DRIFTS = np.maximum(1.2 - 0.8 * TIME, 0.5)  # from the line into the ego's lane: 0.4 m within 0.5 s


def test_how_much_it_brakes_until_the_contact_is_said() -> None:
    """Half a second after the start it brakes by 2 m/s2 for one second, 10 of the 22 steps before the contact."""
    x, y, h, v = motion(60.0, DRIFTS, 5.0)
    ego = motion(0.0, 0.0, 30.0)
    assert judged(ego, (x, y, h, v))["braking"] == 0.0
    slower = np.where(TIME < 0.5, 5.0, np.where(TIME < 1.5, 5.0 - 2.0 * (TIME - 0.5), 3.0))
    prediction = judged(ego, (60.0 + np.cumsum(slower) * DT, y, h, slower))
    assert prediction["braking"] == pytest.approx(10 / (prediction["time"] / DT), abs=0.01)


@pytest.mark.parametrize(("x", "level"), [(45.0, Level.COLLISION), (60.0, Level.VALID), (100.0, Level.SERIOUS)])
def test_the_level_goes_by_the_reference_drivers(x: float, level: Level) -> None:
    """A car at 5 m/s comes half into the lane within half a second: the drift is perceived 0.4 s later.

    The ego at 30 m/s closes in at 25 m/s. A driver that brakes takes 25 * (0.75 + 0.3) + 25^2 / (2 * 7.59) = 67 m from
    the alarm on: too much 45 m and 60 m ahead. From 60 m there is time to go to the right, from 45 m there is not.
    """
    prediction = judged(motion(0.0, 0.0, 30.0), motion(x, DRIFTS, 5.0))
    assert prediction["hit"] and prediction["level"] is level
    assert (prediction["careful"], prediction["manoeuvre"]) == (level is Level.SERIOUS, level is not Level.COLLISION)
    base = {Level.COLLISION: WEIGHTS.collision, Level.VALID: WEIGHTS.valid, Level.SERIOUS: WEIGHTS.serious}[level]
    assert base <= prediction["score"] < base + 0.3


def test_a_soft_contact_is_strict_and_the_harder_the_nearer_to_serious() -> None:
    """Closing in at 3 m/s changes the ego's speed by about 1.6 m/s, at 4 m/s by about 2.1: 5 mph are 2.24."""
    ego = motion(0.0, 0.0, 30.0)
    soft, harder = (judged(ego, motion(gap, DRIFTS, speed)) for gap, speed in ((17.0, 27.0), (21.0, 26.0)))
    assert (soft["level"], harder["level"]) == (Level.STRICT, Level.STRICT)
    assert 1.4 < soft["delta_v"] < 1.8 and 1.9 < harder["delta_v"] < 2.24
    assert WEIGHTS.strict < harder["score"] < soft["score"] < WEIGHTS.valid


def test_what_no_person_would_drive_is_not_serious() -> None:
    """In the next lane it brakes by 7 m/s2 from 26 m/s to 5 m/s and then comes over: people brake by 3.5 m/s2 there."""
    x, y, h, v = motion(100.0, DRIFTS, 5.0)
    ego = motion(0.0, 0.0, 30.0)
    assert judged(ego, (x, y, h, v))["level"] is Level.SERIOUS
    steps = np.arange(float(STEPS))
    braking = 26.0 - DT * np.cumsum(np.clip(np.minimum(steps, 38.0 - steps), 0.0, 7.0))  # built up by 10 m/s3
    beside = np.where(TIME < 3.0, 3.2, np.maximum(3.2 - 1.0 * (TIME - 3.0), 0.5))
    prediction = judged(ego, (80.0 + np.cumsum(braking) * DT, beside, h, braking), road=(-4.8, 4.8))
    assert prediction["hit"] and not prediction["human"] and prediction["level"] < Level.SERIOUS


def test_an_ego_that_stands_proves_nothing() -> None:
    """A car comes from ahead at 10 m/s; braking 30 m before the contact would not help an ego that stands."""
    standing = motion(0.0, 0.0, 0.0)
    _, y, h, v = motion(0.0, 0.0, 10.0)
    prediction = judged(standing, (40.0 - 10.0 * TIME, y, h + np.pi, v))
    assert prediction["hit"] and prediction["level"] is Level.COLLISION


def test_a_way_out_that_another_vehicle_fills_does_not_count() -> None:
    """To the right there is room, and just time to go there, unless another car is beside the ego."""
    ego, bv = motion(0.0, 0.0, 30.0), motion(60.0, DRIFTS, 5.0)
    alone = judged(ego, bv)
    assert (alone["hit"], alone["careful"], alone["manoeuvre"]) == (True, False, True)
    assert (alone["time"], alone["warning"]) == pytest.approx((2.2, 1.8))
    beside = vehicle("beside", motion(1.0, -3.2, 30.0))
    filled = judged(ego, bv, [beside])
    assert (filled["hit"], filled["manoeuvre"], filled["level"]) == (True, False, Level.COLLISION)
    far = vehicle("far", motion(1.0, -30.0, 30.0))
    assert judged(ego, bv, [far])["score"] == alone["score"]
    itself = vehicle("bv", motion(1.0, -3.2, 30.0))  # the adversary's unattacked motion is in no one's way
    assert judged(ego, bv, [itself])["score"] == alone["score"]


def test_nor_does_one_off_the_road() -> None:
    prediction = judged(motion(0.0, 0.0, 30.0), motion(60.0, DRIFTS, 5.0), road=(-1.3, 2.3))
    assert not prediction["manoeuvre"] and prediction["score"] == pytest.approx(NONE + 0.2 * (1 - 1.8 / 2))


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
        prediction = judged(ego, bv, [crossing])
        assert prediction["hit"] and prediction["third_party"] is counts


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
    prediction = judged(motion(0.0, 0.0, 30.0), motion(0.0, 2.1, 30.0), road=(-4.8, 4.8))
    assert not prediction["hit"]
    assert prediction["gap"] == pytest.approx(0.1)
    assert prediction["score"] == pytest.approx(1.5 + 3.0 + 0.01)


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
    """A brake of 3 m/s2 that is there within a step has 30 m/s3, a brake that grows by 1 m/s2 a step 10; 12 are
    allowed, and 3 for rounding."""
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
        prediction = judged(motion(0.0, 0.0, 30.0), (x, y, heading, speed))
        assert prediction["hit"]
        assert prediction["beyond_limits"] == beyond
        assert (prediction["score"] == BEYOND) == beyond


@pytest.mark.parametrize(("behind", "role", "reacting", "third"), [
    (30.0, Role.BACKGROUND, True, False),  # it brakes
    (30.0, Role.BACKGROUND, False, True),  # a log moves it
    (30.0, Role.OBSTACLE, True, True),  # it has no driver
    (-30.0, Role.BACKGROUND, True, False),  # ahead, and faster
])  # fmt: skip
def test_a_third_vehicle_that_brakes_for_the_adversary_is_not_hit(
    behind: float, role: Role, reacting: bool, third: bool
) -> None:
    """The adversary comes to the ego's lane 100 m away, at once half as fast as the one behind it at 20 m/s."""
    ego, bv = motion(0.0, 0.0, 20.0), motion(60.0, 0.0, 10.0)
    follower = replace(vehicle("third", motion(60.0 - behind, 0.0, 20.0)), role=role)
    situation = changed(scene(bv, [follower]), reacting=reacting)
    rollouts = Rollouts(TIME, row(ego), row(bv), np.array([False]))
    road = Drivable(box(-100.0, -4.8, 500.0, 2.3))
    ((score, prediction),) = judge_all({0.0: situation}, [PROPOSAL], rollouts, road, Limits(), WEIGHTS)
    assert prediction.third_party is third
    assert (score == THIRD) is third
