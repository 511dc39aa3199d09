"""The benchmark's opponents that give a motion in advance: controls, the Bezier rule, resampling."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bench_rows_samples import attempt, encounter, first_proposals
from hypothesis import given
from hypothesis import strategies as st
from situation_samples import KRAUSS, changed, crossing, leader, neighbour

from sumo_adv.benchmark.nouns import Encounter
from sumo_adv.benchmark.rows.bezier import ARRIVALS, Bezier
from sumo_adv.benchmark.rows.cma import POPULATION, Cma
from sumo_adv.benchmark.rows.controls import SIZE, drive, objective, starts
from sumo_adv.benchmark.rows.random_search import RandomSearch
from sumo_adv.benchmark.rows.resampling import FUTURES, Resampling
from sumo_adv.datatypes import Limits, PrescribedMotion, Proposal, Role, Track
from sumo_adv.metrics.gates import failed_gates
from sumo_adv.simulation.network import Drivable
from sumo_adv.situation import Target

DT = 0.1
REPLAY = replace(KRAUSS, kind="replay")


def course_of(proposal: Proposal | None) -> PrescribedMotion:
    assert proposal is not None and proposal.course is not None
    return proposal.course


def driven(target: Target, course: PrescribedMotion) -> Track:
    """The course as the judge gets it: with two states of history."""
    state, n = target.state, len(course.x)
    back = -state.speed * DT * np.array([2.0, 1.0, 0.0])
    x = np.concatenate([state.x + back * math.cos(state.heading), course.x])
    y = np.concatenate([state.y + back * math.sin(state.heading), course.y])
    heading = np.concatenate([np.full(3, state.heading), course.heading])
    speed = np.concatenate([np.full(3, state.speed), course.speed])
    acceleration = np.concatenate([[0.0], np.diff(speed) / DT])
    time = 99.8 + DT * np.arange(n + 3)
    return Track("bv", Role.ADVERSARY, time, x, y, heading, speed, acceleration, state.length, state.width)


def gates(target: Target, course: PrescribedMotion) -> tuple[str, ...]:
    track = driven(target, course)
    return failed_gates(track, Limits(), on_road=None, ego=track, others=[], end=None, start=100.05)


# -- the Bezier rule


def test_a_bezier_curve_is_at_the_known_ego_when_it_said() -> None:
    row = Bezier()
    row.begin(encounter([neighbour()], model=REPLAY))
    course = course_of(row.propose([]))
    # The ego goes east at 10 m/s from the origin: after 6 s it is at (60, 0).
    assert len(course.x) == 60
    assert (course.x[-1], course.y[-1]) == pytest.approx((60.0, 0.0), abs=1e-6)
    # Control points x: 20, 20 + 12 x 2, 40, 60; at half the time (20 + 3 x 44 + 3 x 40 + 60) / 8 = 41.5.
    assert course.x[29] == pytest.approx(41.5)
    # y: 3.2, 3.2, 0, 0: halfway at 1.6.
    assert course.y[29] == pytest.approx(1.6)


def test_every_curve_ends_where_the_ego_is_and_they_run_out() -> None:
    row = Bezier()
    row.begin(encounter([crossing()], model=REPLAY))
    plans = first_proposals(row, 100)
    assert len(plans) == len(ARRIVALS)
    for plan, arrival in zip(plans, ARRIVALS, strict=True):
        course = course_of(plan)
        assert (course.x[-1], course.y[-1]) == pytest.approx((10.0 * arrival, 0.0), abs=1e-6)


def test_a_curve_keeps_no_limits() -> None:
    row, bv = Bezier(), neighbour(x=60.0, speed=20.0)
    row.begin(encounter([bv], model=REPLAY))
    # 20 m/s, first at 60 m, and at 60 m again 6 s later: it must stop and turn back.
    assert {"longitudinal", "continuity"} & set(gates(bv, course_of(row.propose([]))))


def test_an_ego_that_is_no_replay_is_taken_to_keep_its_speed() -> None:
    neighbour_encounter = encounter([neighbour()])
    slows = changed(neighbour_encounter.situations[0.0], s=0.2 * neighbour_encounter.situations[0.0].baseline.s)
    ends = []
    for model in (KRAUSS, REPLAY):
        row = Bezier()
        row.begin(replace(neighbour_encounter, situations={0.0: changed(slows, model=model)}))
        ends.append(course_of(row.propose([])).x[-1])
    # At its speed 60 m; along the profile 0.2 x 50 m in 5 s and then 1 s at the profile's last speed, 10 m/s.
    assert ends == pytest.approx([60.0, 20.0])


# -- controls


def test_the_zero_vector_drives_on_along_the_way() -> None:
    bv = neighbour()
    neighbour_encounter = encounter([bv])
    course = drive(starts(neighbour_encounter)[0], np.zeros(SIZE), neighbour_encounter)
    k = np.arange(1, 121)
    assert course.x == pytest.approx(20.0 + 1.2 * k)
    assert course.y == pytest.approx(np.full(120, 3.2))
    assert course.speed == pytest.approx(np.full(120, 12.0))


def test_a_bend_of_the_way_is_driven_without_steering_of_ones_own() -> None:
    """8 m/s into a bend of 6 m radius is too fast, at 3 m/s it is not (1.5 m/s2)."""
    bv = crossing()
    slow = replace(bv, state=replace(bv.state, speed=3.0))
    crossing_encounter = encounter([slow])
    left = next(s for s in starts(crossing_encounter) if s.way.movement == "left")
    course = drive(left, np.zeros(SIZE), crossing_encounter)
    assert math.cos(course.heading[-1]) == pytest.approx(-1.0, abs=0.01)  # west
    assert course.y[-1] == pytest.approx(-2.0, abs=1.5)  # nothing brings it back to the middle of the lane
    assert gates(slow, course) == ()


@given(st.lists(st.floats(-4.0, 4.0), min_size=SIZE, max_size=SIZE), st.floats(0.5, 25.0))
def test_any_controls_keep_the_limits(vector: list[float], speed: float) -> None:
    bv = neighbour(speed=speed)
    neighbour_encounter = encounter([bv])
    assert gates(bv, drive(starts(neighbour_encounter)[0], vector, neighbour_encounter)) == ()


def test_a_motion_ends_where_it_leaves_the_road() -> None:
    from shapely.geometry import box

    bv = neighbour()
    road = Drivable(box(-100.0, -2.0, 1000.0, 5.0))
    narrow_road = replace(encounter([bv]), drivable=road)
    left = [4.0] * 6 + [0.0] * 6
    course = drive(starts(narrow_road)[0], left, narrow_road)
    # The box is 2 m wide and may stick out by 0.15 m: a corner is over the line from y = 4.15 on, sooner as it turns.
    assert 3.2 < course.y[-3] < course.y[-2] < 4.3
    assert course.y[-1] == course.y[-2]
    assert (course.speed[-1], course.x[-1]) == (0.0, course.x[-2])
    assert len(course.x) < 120


@pytest.mark.parametrize(
    ("verdict", "value"),
    [
        ({"collided": True, "valid": True, "min_distance": 0.0, "min_ttc": 0.0}, 0.0),
        ({"collided": True, "valid": False, "min_distance": 0.0, "min_ttc": 0.0}, 1.0),
        ({"min_distance": 10.0, "min_ttc": 5.0}, 2.0 + 1.0 + 0.5),
        ({"min_distance": math.inf, "min_ttc": math.inf}, 2.0 + 5.0 + 1.0),
        ({"collided": True, "rear_end": True, "min_distance": 0.0, "min_ttc": 0.0}, 2.0 + 3.0),
        ({"collided": True, "feasible": False, "rear_end": True, "min_distance": 0.0, "min_ttc": 0.0}, 2.0 + 3.0 + 3.0),
    ],
)
def test_the_objective_prefers_valid_then_what_counts_then_nearness(verdict: dict[str, Any], value: float) -> None:
    plan = first_proposals(_begun(RandomSearch(), encounter([neighbour()])), 1)[0]
    assert objective(attempt(plan, **verdict).verdict) == pytest.approx(value)


def _begun(row: Any, encounter: Encounter) -> Any:
    row.begin(encounter)
    return row


def test_random_search_takes_vehicles_ways_and_delays_in_turn() -> None:
    row = _begun(RandomSearch(), encounter([crossing()], delays=(0.0, 1.5)))
    plans = first_proposals(row, 8)
    assert [p.delay for p in plans] == [0.0, 0.0, 1.5, 1.5] * 2  # two ways each
    assert len({tuple(course_of(p).x) for p in plans}) == 8
    again = first_proposals(_begun(RandomSearch(), encounter([crossing()], delays=(0.0, 1.5))), 8)
    assert all((course_of(a).x == course_of(b).x).all() for a, b in zip(plans, again, strict=True))


def test_cma_learns_from_its_attempts() -> None:
    """Told that only slow motions come near, it makes them slower."""
    row = _begun(Cma(), encounter([neighbour()], seed=1))
    tried: list[Any] = []
    for _ in range(8 * POPULATION):
        plan = row.propose(tried)
        mean = float(course_of(plan).speed.mean())
        tried.append(attempt(plan, len(tried), min_distance=mean))
    means = [float(course_of(a.proposal).speed.mean()) for a in tried]
    assert np.mean(means[-POPULATION:]) < np.mean(means[:POPULATION]) - 2.0  # m/s
    assert {a.proposal.bv for a in tried} == {"bv"}


def test_cma_is_the_same_for_a_seed() -> None:
    first, again, other_seed = (
        [course_of(p).x.tolist() for p in first_proposals(_begun(Cma(), encounter([leader()], seed=seed)), 8)]
        for seed in (5, 5, 6)
    )
    assert first == again != other_seed


# -- resampling


def beside() -> Target:
    """A car 12 m ahead in the lane to the left of the ego's, as fast as it."""
    return replace(neighbour(x=12.0, speed=10.0), sides=((-3.2, "same"),))


def test_what_is_resampled_is_within_limits_and_reaches_the_ego_it_predicts() -> None:
    bv = beside()
    row = _begun(Resampling(), encounter([bv], model=REPLAY))
    for plan in first_proposals(row, 3):
        course = course_of(plan)
        assert gates(bv, course) == ()
        ego_x = 10.0 * DT * np.arange(1, len(course.x) + 1)
        near = np.hypot(course.x - ego_x, course.y)
        assert near.min() < 5.4  # m: two cars of 5 x 2 m can touch at most half diagonals apart


def test_it_never_tries_the_same_twice() -> None:
    row = _begun(Resampling(), encounter([beside()]))
    plans = first_proposals(row, 30)
    assert len({course_of(p).x.tobytes() + course_of(p).y.tobytes() for p in plans}) == 30


def test_futures_that_foretold_otherwise_lose_weight() -> None:
    row = _begun(Resampling(), encounter([beside()]))
    plan = row.propose([])
    before = row._weights([])
    assert before == pytest.approx(list(FUTURES.values()))
    i, k = row._places[0]
    foretold = row._drawn[i].hits[:, k] > 0
    assert foretold.any()  # some future of the best one collides
    missed = row._weights([attempt(plan)])
    hit = row._weights([attempt(plan, collided=True, min_distance=0.0)])
    if foretold.all():
        assert missed == pytest.approx(before)
    else:
        assert (missed[foretold] < before[foretold]).all() and (missed[~foretold] > before[~foretold]).all()
        assert (hit[foretold] > before[foretold]).all() and (hit[~foretold] < before[~foretold]).all()


def test_a_motion_into_a_third_vehicle_is_unlikely() -> None:
    """A wall of a car beside the ego all along: a vehicle that moves over hits it first."""
    open_road = encounter([beside()])
    time = 100.0 + DT * np.arange(121)
    n = len(time)
    wall = Track(
        "wall", Role.BACKGROUND, time, 12.0 + 10.0 * (time - 100.0), np.full(n, 1.2), np.zeros(n), np.full(n, 10.0),
        np.zeros(n), 60.0, 0.2,
    )  # fmt: skip
    free = _begun(Resampling(), open_road)._drawn[0].prior.sum()
    walled = replace(open_road, situations={0.0: changed(open_road.situations[0.0], others=(wall,))})
    assert _begun(Resampling(), walled)._drawn[0].prior.sum() < 0.8 * free


# -- the Transformer


def test_predicted_motions_are_feasible_and_the_most_dangerous_comes_first() -> None:
    """A car 20 m ahead in the lane to the left: six modes and three draws of each, at one delay."""
    from sumo_adv.benchmark.rows.transformer import DRAWN, Transformer
    from sumo_adv.transformer.model import MODES

    bv, row = neighbour(), Transformer()
    row.begin(encounter([bv]))
    proposals = first_proposals(row, 100)
    assert len(proposals) == MODES * (1 + DRAWN)
    assert all(p.bv == "bv" and p.by == "transformer" for p in proposals)
    assert [gates(bv, course_of(p)) for p in proposals[:8]] == [()] * 8
    again = Transformer()
    again.begin(encounter([bv]))
    assert course_of(again.propose([])).x.tolist() == course_of(proposals[0]).x.tolist()
    # Against an ego that keeps its 10 m/s, the first ones come as near as the last ones, to a centimetre.
    ego_x = 10.0 * DT * np.arange(1, 120)
    nearest = [float(np.hypot(course_of(p).x - ego_x, course_of(p).y).min()) for p in proposals]
    assert min(nearest[:6]) <= min(nearest[-6:]) + 0.01


def test_an_encounter_without_vehicles_of_the_shortlist_has_nothing_to_try() -> None:
    from sumo_adv.benchmark.rows.transformer import Transformer

    row = Transformer()
    row.begin(replace(encounter([neighbour()]), situations={}))
    assert row.propose([]) is None
