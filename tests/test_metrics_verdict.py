"""Hand-made encounters, each with the verdict it must get and why."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from metrics_tracks import DT, TIME, braking, car, cruise, drift

from sumo_adv.datatypes import Bools, Boxes, Floats, Level, Preventability, Track, Verdict
from sumo_adv.errors import UsageError
from sumo_adv.metrics.avoidance import OnRoad
from sumo_adv.metrics.boxes import at_time
from sumo_adv.metrics.case import Case
from sumo_adv.metrics.contact import CollisionClass, Side, collision_class, rear_end
from sumo_adv.metrics.criticality import CRITICALITY_COLUMNS, series
from sumo_adv.metrics.fault import longitudinal_safe_distance, rss_opinion
from sumo_adv.metrics.further import further_figures
from sumo_adv.metrics.verdict import judge_attempt, with_answers

EGO = cruise("ego", 0, 0, 15)
LATE_CUT_IN = drift("adversary", 3, 3.2, 15, 2.0, 2.5, 0.0)  # beside the ego, drifting into it
SLOW_DRIFT = drift("adversary", 50, 3.2, 9, 2.0, 5.0, 0.0)  # 45 m ahead, 6 m/s slower, changes lane over 5 s
CROSSING = cruise("adversary", 50, -60, 12, np.pi / 2)
ONCOMING = cruise("adversary", 100, 0, 10, np.pi)
COMES_OVER = replace(drift("adversary", 100, 3.2, -10, 1.5, 2.5, 0.0), heading=ONCOMING.heading, speed=ONCOMING.speed)
"""Towards the ego at 10 m/s; from 1.5 s to 4.0 s it comes over into the ego's lane."""


def judged(ego: Track, adversary: Track, *others: Track, start: float = 1.0) -> Verdict:
    return judge_attempt(Case(ego, adversary, others, start))


def answers(verdict: Verdict) -> tuple[str, str]:
    """What ``cc_human`` and ``manoeuvre`` make of it."""
    assert verdict.preventability is not None
    return verdict.preventability.answers["cc_human"], verdict.preventability.answers["manoeuvre"]


def soft_braking(start: float, rate: float, x0: float) -> Track:
    """A leader at 15 m/s that builds its braking up over 1 s and holds it to a stand."""
    acceleration = -rate * np.clip(TIME - start, 0.0, 1.0)
    speed = np.maximum(15 + np.concatenate([[0], np.cumsum((acceleration[1:] + acceleration[:-1]) / 2 * DT)]), 0.0)
    x = x0 + np.concatenate([[0], np.cumsum((speed[1:] + speed[:-1]) / 2 * DT)])
    return car("adversary", x, 0.0, speed)


def test_a_late_cut_in_from_beside_nobody_avoids() -> None:
    """1.2 m lie between the cars; from 0.375 m to 1.2 m of a 2.5 s drift pass 0.4 s: no driver has begun to brake."""
    v = judged(EGO, LATE_CUT_IN)
    assert v.collided and v.feasible and not v.rear_end
    assert v.contact_time == v.min_ttc_time == pytest.approx(3.11, abs=0.01)
    assert answers(v) == ("collides", "collides")
    assert (v.level, v.valid, v.strict) == (Level.COLLISION, False, False)


def test_a_slow_drift_far_ahead_anybody_avoids() -> None:
    v = judged(EGO, SLOW_DRIFT)
    assert v.contact_time == pytest.approx(7.5)  # 45 m at 6 m/s
    assert (v.level, v.valid, v.strict, v.failed_gates) == (Level.SERIOUS, True, True, ())
    assert (v.min_ttc, v.min_distance, v.min_pet) == (0.0, 0.0, 0.0)


def test_a_collision_of_the_careful_driver_itself_is_not_strict() -> None:
    """Its path and lane are not those of the kinematic check, in which it avoids the collision."""
    v = judge_attempt(Case(EGO, SLOW_DRIFT, (), 1.0), driver="cc_human")
    assert answers(v) == ("collides", "avoids")
    assert v.level is Level.VALID


def test_drivers_are_asked_only_as_far_as_the_level_depends_on_them() -> None:
    few, every = (judge_attempt(Case(EGO, SLOW_DRIFT, (), 1.0), all_drivers=asked) for asked in (False, True))
    assert few.preventability is not None and every.preventability is not None
    assert few.preventability.answers.items() < every.preventability.answers.items()
    assert few.level is every.level is Level.SERIOUS


def test_new_answers_change_the_level_and_nothing_else() -> None:
    """A serious collision of which the check in the loop says that only ``manoeuvre`` avoids it."""
    v = judged(EGO, SLOW_DRIFT)
    both = {"cc_human": "avoids", "manoeuvre": "avoids"}
    again = with_answers(v, Preventability(both, {}, in_loop=both | {"cc_human": "collides"}))
    assert (again.level, again.valid, again.strict) == (Level.VALID, True, False)
    assert replace(again, level=v.level, preventability=v.preventability) == v


def test_a_standing_ego_hit_from_behind_is_a_rear_end_and_never_valid() -> None:
    ego, adversary = cruise("ego", 60, 0, 0), cruise("adversary", 0, 0, 10)
    v = judged(ego, adversary)
    assert v.contact_time == pytest.approx(5.5) and v.rear_end and v.fault == "adversary"
    assert (v.level, v.valid) == (Level.NONE, False)
    assert collision_class(ego, adversary, 5.5) is CollisionClass.STOPPED_EGO


def test_a_moving_ego_hit_from_behind_is_nuplan_s_rear_class() -> None:
    ego, adversary = cruise("ego", 30, 0, 5), cruise("adversary", 0, 0.5, 10)
    assert rear_end(at_time(ego, 5.0), at_time(adversary, 5.0))
    assert collision_class(ego, adversary, 5.0) is CollisionClass.ACTIVE_REAR
    assert judged(ego, adversary).fault == "adversary"


def test_many_contacts_are_rear_ends_by_the_same_rule() -> None:
    """The ego at the origin, 5 x 2 m at 5 m/s eastwards; the adversary touches its rear or its flank, or is slower."""
    ego = Boxes(np.zeros(5), np.zeros(5), np.zeros(5), np.full(5, 5.0), 5.0, 2.0)
    x, y = np.array([-5.0, -5.0, 0.0, 5.0, -3.5]), np.array([0.5, 0.5, 2.0, 0.0, 0.0])
    heading, speed = np.array([0.0, 0.0, 0.0, np.pi, np.pi / 2]), np.array([10.0, 4.0, 10.0, 10.0, 10.0])
    assert rear_end(ego, Boxes(x, y, heading, speed, 5.0, 2.0)).tolist() == [True, False, False, False, False]


def test_an_ego_that_runs_into_a_leader_that_brakes_hard_is_at_fault_and_could_have_braked() -> None:
    v = judged(EGO, soft_braking(3.0, 5.0, 45.0))
    assert v.collided and v.feasible and not v.rear_end and v.fault == "ego"
    assert answers(v) == ("avoids", "avoids") and v.strict


def test_a_side_swipe_from_behind_is_not_a_rear_end() -> None:
    """The adversary overtakes and touches the ego's flank with its own: lateral, at any speeds."""
    adversary = drift("adversary", -8, 3.2, 18, 2.0, 3.0, 0.0)
    v = judged(EGO, adversary)
    assert v.collided and not v.rear_end
    assert v.contact_side == Side.LEFT


def test_a_red_light_runner_leaves_time_to_swerve_or_brake_hard_but_not_for_the_careful_driver() -> None:
    """From 24 m (12^2 / 2 / 3) before the corridor it cannot stop: 2 s before contact at 10 m/s."""
    v = judged(cruise("ego", 0, 0, 10), CROSSING)
    assert v.contact_time == pytest.approx(56.5 / 12)  # its front needs 60 - 1 - 2.5 m
    assert answers(v) == ("collides", "avoids")
    assert (v.level, v.valid, v.strict) == (Level.VALID, True, False)


def test_from_an_oncoming_car_in_its_lane_the_ego_can_swerve_but_not_brake() -> None:
    v = judged(cruise("ego", 0, 0, 10), COMES_OVER)
    assert v.contact_time == pytest.approx(4.75)  # 95 m at 20 m/s
    assert answers(v) == ("collides", "avoids")


def road(half_width: float) -> OnRoad:
    def on_road(x: Floats, y: Floats) -> Bools:
        return np.abs(y) <= half_width

    return on_road


def test_an_escape_must_stay_on_the_road() -> None:
    case = Case(cruise("ego", 0, 0, 10), COMES_OVER, (), 1.0)
    wide, narrow = (judge_attempt(replace(case, on_road=road(half_width))) for half_width in (6.0, 1.5))
    assert (answers(wide)[1], answers(narrow)[1]) == ("avoids", "collides")


def test_an_escape_from_one_vehicle_and_then_from_another_must_stay_on_the_road() -> None:
    """Braking avoids the adversary and is hit by a second car from the right, and the road is too narrow to pass."""
    adversary, second = cruise("adversary", 50, -54.6, 12, np.pi / 2), cruise("second", 45.5, -73.3, 12, np.pi / 2)

    def crossing(x: Any, y: Any) -> Any:
        return (np.abs(y) <= 1.5) | (np.abs(x - 50.0) <= 4.0)

    case = Case(cruise("ego", 0, 0, 12), adversary, (second,), 1.0)
    open_ground, narrow = judge_attempt(case), judge_attempt(replace(case, on_road=crossing))
    assert (answers(open_ground)[1], answers(narrow)[1]) == ("avoids", "collides")
    assert narrow.level is Level.COLLISION


def test_a_vehicle_that_reverses_does_not_stand() -> None:
    """An adversary backs out at 2 m/s into the flank of an ego at 8 m/s, at 4.5 s and 36 m. An ego reverses at 3 m/s
    into a crossing car, once with the heading of its front and once, as a car that drives forwards, of its rear."""
    ego, backing = cruise("ego", 0, 0, 8), cruise("adversary", 36, -12.5, -2, -np.pi / 2)
    out = judged(ego, backing)
    assert out.collided and out.fault == "adversary"
    crossing = cruise("adversary", -15, -24, 6, np.pi / 2)
    for reversing in (cruise("ego", 0, 0, -3), cruise("ego", 0, 0, 3, np.pi)):
        hit = judged(reversing, crossing)
        assert hit.collided and not hit.ego_stationary


def test_an_escape_must_stay_clear_of_others_but_not_of_those_that_follow() -> None:
    ego = cruise("ego", 0, 0, 10)
    walled = judged(ego, COMES_OVER, cruise("left", 2, 3.2, 10), cruise("right", 2, -3.2, 10))
    followed = judged(ego, COMES_OVER, cruise("behind", -12, 0, 10))
    assert (answers(walled)[1], answers(followed)[1]) == ("collides", "avoids")


def test_figures_of_a_contact_within_the_first_step_are_of_that_step() -> None:
    """A leader 25 m ahead and 8 m/s slower is hit after 3.125 s. At 3.1 s, 0.2 m are left: 0.0133 s at 15 m/s."""
    figures = further_figures(Case(EGO, cruise("adversary", 30, 0, 7), (), 3.1))
    assert figures.min_headway == pytest.approx(0.2 / 15, abs=1e-6) and figures.max_btn > 1.0


def test_a_near_miss_has_no_validity_but_ttc_pet_and_distance() -> None:
    """Parallel drift that stops 0.4 m beside the ego."""
    v = judged(EGO, drift("adversary", 0, 3.2, 15, 2.0, 3.0, 2.4))
    assert not v.collided and v.valid is None and v.strict is None and v.preventability is None and v.fault is None
    assert v.min_distance == pytest.approx(0.4, abs=0.05) and 0 < v.min_ttc <= 1.3


def test_criticality_runs_from_the_trigger_and_stops_at_the_end_given() -> None:
    ego = cruise("ego", 0, 0, 10)
    assert judged(ego.between(0.0, 4.0), ONCOMING).min_ttc == pytest.approx(0.75)
    assert judged(ego, CROSSING, start=6.5).min_ttc == np.inf
    with pytest.raises(UsageError, match="no step in common"):
        judged(ego.between(0, 2), ONCOMING, start=5.0)


def test_min_ttc_any_sees_the_others() -> None:
    ego = cruise("ego", 0, 0, 10)
    standing = cruise("standing", 130, 0, 0)
    v = judged(ego, cruise("adversary", 0, 40, 10), standing)
    assert v.min_ttc == np.inf and v.min_ttc_any == pytest.approx(0.5)  # at 12 s: 5 m to go at 10 m/s


def test_verdicts_do_not_depend_on_where_north_is() -> None:
    def turned(t: Track, by: float = 2.1) -> Track:
        c, s = np.cos(by), np.sin(by)
        heading = (t.heading + by + np.pi) % (2 * np.pi) - np.pi
        return replace(t, x=c * t.x - s * t.y + 100, y=s * t.x + c * t.y - 70, heading=heading)

    crossing = cruise("adversary", 50, -60.5, 12, np.pi / 2)
    for ego, adversary in ((EGO, SLOW_DRIFT), (EGO, LATE_CUT_IN), (cruise("ego", 0, 0, 10), crossing)):
        a = judged(ego, adversary)
        b = judged(turned(ego), turned(adversary))
        same = ("collided", "level", "rear_end", "failed_gates", "fault")
        assert [getattr(a, n) for n in same] == [getattr(b, n) for n in same]
        assert answers(a) == answers(b)
        assert a.contact_time == pytest.approx(b.contact_time, abs=1e-3)


def test_further_figures_say_how_they_met_and_give_a_second_opinion() -> None:
    case = Case(EGO, SLOW_DRIFT, (), 1.0)
    further = further_figures(case)
    assert further.collision_class is CollisionClass.ACTIVE_FRONT
    assert judge_attempt(case).fault == "ego"  # nuPlan looks at the bumper alone
    assert further.rss is not None and (further.rss.trigger, further.rss.blame) == ("lateral", "adversary")
    impact = further.impact
    assert impact is not None and impact.speed == pytest.approx(6.0) and impact.adversary_side is Side.REAR
    assert impact.ego_point == pytest.approx((2.5, 0.0)) and impact.adversary_point == pytest.approx((-2.5, 0.0))


def test_rss_blames_the_follower_who_does_not_brake_and_frees_the_one_who_does() -> None:
    leader = soft_braking(3.0, 5.0, 40.0)
    contact = judged(EGO, leader).contact_time
    assert contact is not None
    opinion = rss_opinion(EGO, leader, contact)
    assert opinion is not None and (opinion.trigger, opinion.blame) == ("longitudinal", "ego")
    assert rss_opinion(cruise("ego", 0, 0, 10), CROSSING, 4.7) is None
    safe = longitudinal_safe_distance(np.array(15.0), np.array(15.0))
    assert float(safe) == pytest.approx(15 + 1.75 + 18.5**2 / 8 - 225 / 16)


def test_series_has_every_measure_for_every_pair_and_step() -> None:
    late = cruise("late", 40, 0, 5).between(2.0, 6.0)
    measures = series(EGO, [ONCOMING, late])
    assert all(measures[name].shape == (2, len(TIME)) for name in CRITICALITY_COLUMNS)
    assert measures["ttc"][0, 0] == pytest.approx(95 / 25) and measures["ttc"][1, 0] == np.inf
    assert measures["gap"][1, 20] == pytest.approx(40 + 10 - 30 - 5)
    assert not np.isnan(np.concatenate([measures[n].ravel() for n in CRITICALITY_COLUMNS])).any()


def test_a_hard_braking_adversary_is_braking_and_its_contact_is_exact() -> None:
    """From 25 m ahead, 15 m/s, braking with 6 it stands after 2.5 s and 18.75 m, just before the ego arrives."""
    v = judged(EGO, braking("adversary", 25, 0, 15, 3, 6))
    standing = 3 + (25 - 5 + 15 * 2.5 / 2) / 15  # s
    assert v.contact_time == pytest.approx(standing, abs=0.002) and v.failed_gates == ("jerk",)
