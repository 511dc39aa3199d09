"""Neighbours of an attack tell whether it holds: an ego that arrives a little otherwise, or slightly other numbers."""

from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np
import pytest

import sumo_adv
from sumo_adv.datatypes import Attempt, Level, PrescribedMotion, Proposal
from sumo_adv.episode.assessment import NO_MOTION_VERDICT
from sumo_adv.episode.attempt import Driven
from sumo_adv.episode.neighbours import Robustness, holds, neighbours, recorded_course, retimed
from sumo_adv.episode.task import AttemptResult
from sumo_adv.goal import Goal
from sumo_adv.planners.text import make_planner
from sumo_adv.simulation.sumo_states import Snapshot

TEXT = """
PARAMETERS = {"gap": (0.5, -3.0, 4.0, "m", "where"), "drift": (3.0, 2.0, 6.0, "m/s", "how fast")}

def endpoint(bv, ego, road, parameters, acc, horizon):
    return {"x": 0.0, "y": 0.0, "heading": 0.0, "speed": 1.0, "time": 1.0}
"""
EAST = PrescribedMotion(
    np.arange(1.0, 61.0), np.zeros(60), np.zeros(60), np.full(60, 10.0)
)  # 6 s to the east at 10 m/s, a state each 0.1 s


def test_a_slower_clock_is_taken_over_one_second() -> None:
    slow = retimed(EAST, 0.9, 0.1)
    # at 1 s the clock shows 1 - 0.1 / 2 = 0.95 s, at 6 s another 5 * 0.9 = 4.5 s
    assert slow.x[9] == pytest.approx(9.5)
    assert slow.x[59] == pytest.approx(54.5)
    assert (slow.speed[9], slow.speed[59]) == pytest.approx((9.0, 9.0))
    assert np.diff(slow.speed).min() > -0.11  # 1 m/s over 1 s: no jump


def test_after_the_recorded_motion_a_faster_one_goes_straight_on() -> None:
    fast = retimed(EAST, 1.1, 0.1)
    # the clock shows 1.05 + 5 * 1.1 = 6.55 s: 60 m and 0.55 s at 10 m/s
    assert fast.x[59] == pytest.approx(65.5)
    assert fast.y[59] == 0.0


def attack(contact: float) -> tuple[Attempt, AttemptResult]:
    """A vehicle of 5 m that goes east at 10 m/s from 100 s on and hits the ego ``contact`` s later."""
    planner = make_planner("Shift", "side", TEXT, "seed")
    proposal = Proposal("bv", "Shift", planner, {"gap": 0.5, "drift": 3.0}, 0.0, 0.0)
    verdict = replace(NO_MOTION_VERDICT, level=Level.VALID, collided=True, contact_time=100.0 + contact)
    snapshots = [Snapshot(100.0 + 0.1 * k, {"bv": (2.5 + k, 0.0, 90.0, 10.0, "a")}) for k in range(61)]
    result = AttemptResult(Driven("contact", ""), None, 100.0, snapshots, {"bv": (5.0, 2.0)})
    return Attempt(0, "tuner", proposal, 100.0, verdict, "contact", ""), result


def test_in_four_neighbours_the_ego_arrives_earlier_later_faster_and_slower() -> None:
    four = neighbours(*attack(4.0), Random(1), 0.1, displaces=True)[:4]
    assert [(p.arrival.earlier, p.arrival.pace) for p in four] == [(0.3, 1.0), (-0.3, 1.0), (0.0, 1.05), (0.0, 0.95)]
    assert all(p.parameters == {"gap": 0.5, "drift": 3.0} and p.course is None for p in four)


def test_the_others_have_other_numbers_within_a_twentieth_of_their_ranges() -> None:
    """The gap's range is -3 to 4 m, so it is at most 0.35 m away; the drift's is 2 to 6 m/s, so 0.2 m/s."""
    assert len(neighbours(*attack(4.0), Random(1), 0.1, displaces=True)) == 6
    others = neighbours(*attack(4.0), Random(1), 0.1, displaces=False)[2:]
    gaps, drifts = ([p.parameters[name] for p in others] for name in ("gap", "drift"))
    assert len(set(gaps)) == 4 and max(abs(g - 0.5) for g in gaps) <= 0.35
    assert len(set(drifts)) == 4 and max(abs(d - 3.0) for d in drifts) <= 0.2


def test_where_a_log_moves_the_ego_the_adversary_comes_earlier_and_later() -> None:
    """The contact is at 4 s, at 40 m. At an even clock that would be after 3.7 and 4.3 s; the clock takes a second to
    get there, so it is short of that by half a second at the difference of the rates, 3 in 37 and 3 in 43."""
    early, late = neighbours(*attack(4.0), Random(1), 0.1, displaces=False)[:2]
    assert early.course is not None and late.course is not None
    assert early.course.x[36] == pytest.approx(40.0 - 0.5 * 10 * 3 / 37, abs=0.01)
    assert late.course.x[42] == pytest.approx(40.0 + 0.5 * 10 * 3 / 43, abs=0.01)


@pytest.mark.parametrize("dt", [0.04, 0.1])
def test_the_motion_to_repeat_begins_after_the_takeover(dt: float) -> None:
    """At 10 m/s from 0 m, the first state after the takeover is at 10 dt."""
    given, result = attack(4.0)
    snapshots = [Snapshot(100.0 + dt * k, {"bv": (2.5 + 10 * dt * k, 0.0, 90.0, 10.0, "a")}) for k in range(60)]
    assert recorded_course(given, replace(result, snapshots=snapshots), dt).x[0] == pytest.approx(10 * dt)


def test_at_once_no_other_timing_of_a_log_is_possible() -> None:
    near = neighbours(*attack(0.1), Random(1), 0.1, displaces=False)
    assert len(near) == 4 and all(p.course is None for p in near)


def test_an_attack_is_robust_if_four_of_six_neighbours_succeed() -> None:
    assert [Robustness(held, 6).enough for held in (3, 4)] == [False, True]
    assert [Robustness(held, 4).enough for held in (2, 3)] == [False, True]  # two thirds of four are more than 2


def test_a_neighbour_of_a_serious_attack_holds_if_it_is_valid() -> None:
    valid, mild = replace(NO_MOTION_VERDICT, level=Level.VALID), replace(NO_MOTION_VERDICT, level=Level.COLLISION)
    assert holds(valid, Goal(Level.SERIOUS)) and not holds(mild, Goal(Level.SERIOUS))
    assert holds(mild, Goal(Level.COLLISION)) and not holds(mild, Goal(Level.VALID))


def test_a_run_says_in_how_many_neighbours_its_attack_holds(tmp_path: Path) -> None:
    """The neighbours are no attempts: they are tried also if the last attempt allowed is the success."""
    result = sumo_adv.run("leader_brakes_hard", until="serious", learn="off", attempts=20, out=tmp_path / "a")
    robust = result.outcome.document["robust"]
    assert robust["of"] == 6 and robust["robust"] == (robust["held"] >= 4)
    last = len(result.outcome.attempts)
    assert last <= 20
    short = sumo_adv.run("leader_brakes_hard", until="critical", learn="off", attempts=1, out=tmp_path / "b")
    assert len(short.outcome.attempts) == 1 and short.outcome.document["robust"]["of"] == 6
