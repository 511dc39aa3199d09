"""The benchmark's opponents that give a motion in advance: resampling and the predicted futures."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bench_rows_samples import attempt, encounter, first_proposals
from situation_samples import KRAUSS, changed, neighbour

from sumo_adv.benchmark.nouns import Encounter
from sumo_adv.benchmark.resampling import FUTURES, Resampling
from sumo_adv.datatypes import Limits, PrescribedMotion, Proposal, Role, Track
from sumo_adv.metrics.gates import failed_gates
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


def _begun(row: Any, encounter: Encounter) -> Any:
    row.begin(encounter)
    return row


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
    from sumo_adv.benchmark.transformer import DRAWS_PER_MODE, Transformer
    from sumo_adv.transformer.model import MODE_COUNT

    bv, row = neighbour(), Transformer()
    row.begin(encounter([bv]))
    proposals = first_proposals(row, 100)
    assert len(proposals) == MODE_COUNT * (1 + DRAWS_PER_MODE)
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
    from sumo_adv.benchmark.transformer import Transformer

    row = Transformer()
    row.begin(replace(encounter([neighbour()]), situations={}))
    assert row.propose([]) is None
