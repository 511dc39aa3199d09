"""Hand-made encounters, each with the tier and the class it must get and why."""

from __future__ import annotations

import time as clock
from dataclasses import replace

import numpy as np
import pytest
from metrics_tracks import DT, TIME, braking, car, cruise, drift

from sumo_adv.datatypes import Bools, Boxes, Floats, Track
from sumo_adv.errors import UsageError
from sumo_adv.metrics.avoidance import CAREFUL_BRAKING, avoidance
from sumo_adv.metrics.boxes import at_time
from sumo_adv.metrics.contact import CollisionClass, Side, collision_class, impact, rear_end
from sumo_adv.metrics.criticality import CRITICALITY_COLUMNS, series
from sumo_adv.metrics.fault import longitudinal_safe_distance, rss_opinion
from sumo_adv.metrics.full import full_judge
from sumo_adv.metrics.validity import Kind, align, hazard_of, judge

EGO = cruise("ego", 0, 0, 15)
LATE_CUT_IN = drift("adversary", 3, 3.2, 15, 2.0, 2.5, 0.0)  # beside the ego, drifting into it
SLOW_DRIFT = drift("adversary", 50, 3.2, 9, 2.0, 5.0, 0.0)  # 45 m ahead, 6 m/s slower, changes lane over 5 s
CROSSING = cruise("adversary", 50, -60, 12, np.pi / 2)
ONCOMING = cruise("adversary", 100, 0, 10, np.pi)


def soft_braking(start: float, rate: float, x0: float) -> Track:
    """A leader at 15 m/s that builds its braking up over 1 s and holds it to a stand."""
    acceleration = -rate * np.clip(TIME - start, 0.0, 1.0)
    speed = np.maximum(15 + np.concatenate([[0], np.cumsum((acceleration[1:] + acceleration[:-1]) / 2 * DT)]), 0.0)
    x = x0 + np.concatenate([[0], np.cumsum((speed[1:] + speed[:-1]) / 2 * DT)])
    return car("adversary", x, 0.0, speed)


def test_a_late_cut_in_from_beside_nobody_avoids() -> None:
    """1.2 m lie between the cars; from 0.375 m to 1.2 m of a 2.5 s drift pass 0.4 s: no driver has begun to brake."""
    v = judge(EGO, LATE_CUT_IN, [], trigger_time=1.0)
    assert v.collided and v.feasible and not v.rear_end
    assert v.hazard_time == pytest.approx(2.7) and v.contact_time == pytest.approx(3.11, abs=0.01)
    assert (v.avoidable, v.valid, v.strict) == ("unavoidable", False, False)


def test_a_slow_drift_far_ahead_anybody_avoids() -> None:
    v = judge(EGO, SLOW_DRIFT, [], trigger_time=1.0)
    assert v.contact_time == pytest.approx(7.5)  # 45 m at 6 m/s
    assert v.hazard_time == pytest.approx(3.4)  # 0.375 of 3.2 m at 27 % of the quintic's 5 s
    assert (v.avoidable, v.valid, v.strict, v.failed_gates) == ("careful_driver", True, True, ())
    assert (v.min_ttc, v.min_distance, v.min_pet) == (0.0, 0.0, 0.0)


def test_a_standing_ego_hit_from_behind_is_a_rear_end_and_never_valid() -> None:
    ego, adversary = cruise("ego", 60, 0, 0), cruise("adversary", 0, 0, 10)
    v = judge(ego, adversary, [], trigger_time=1.0)
    assert v.contact_time == pytest.approx(5.5) and v.rear_end and v.valid is False and v.fault == "adversary"
    assert collision_class(ego, adversary, 5.5) is CollisionClass.STOPPED_EGO


def test_a_moving_ego_hit_from_behind_is_nuplan_s_rear_class() -> None:
    ego, adversary = cruise("ego", 30, 0, 5), cruise("adversary", 0, 0.5, 10)
    assert rear_end(at_time(ego, 5.0), at_time(adversary, 5.0))
    assert collision_class(ego, adversary, 5.0) is CollisionClass.ACTIVE_REAR
    assert judge(ego, adversary, [], trigger_time=1.0).fault == "adversary"


def test_many_contacts_are_rear_ends_by_the_same_rule() -> None:
    """The ego at the origin, 5 x 2 m at 5 m/s eastwards; the adversary touches its rear or its flank, or is slower."""
    ego = Boxes(np.zeros(5), np.zeros(5), np.zeros(5), np.full(5, 5.0), 5.0, 2.0)
    x, y = np.array([-5.0, -5.0, 0.0, 5.0, -3.5]), np.array([0.5, 0.5, 2.0, 0.0, 0.0])
    heading, speed = np.array([0.0, 0.0, 0.0, np.pi, np.pi / 2]), np.array([10.0, 4.0, 10.0, 10.0, 10.0])
    assert rear_end(ego, Boxes(x, y, heading, speed, 5.0, 2.0)).tolist() == [True, False, False, False, False]


def test_an_ego_that_runs_into_a_braking_leader_is_at_fault_and_could_have_braked() -> None:
    """At 1.5 m/s2 the TTC falls below 3 s with 41 m left until where the leader will stand (36.5 needed); at 5 not."""
    leader = soft_braking(3.0, 1.5, 45.0)
    v = judge(EGO, leader, [], trigger_time=1.0)
    assert v.collided and v.feasible and not v.rear_end and v.fault == "ego"
    assert v.avoidable == "careful_driver" and v.strict
    assert judge(EGO, soft_braking(3.0, 5.0, 45.0), [], trigger_time=1.0).avoidable == "any_manoeuvre"
    assert hazard_of(align(EGO, leader, 1.0, contact_time=v.contact_time))[1] is Kind.OTHER


def test_a_side_swipe_from_behind_is_not_a_rear_end() -> None:
    """The adversary overtakes and touches the ego's flank with its own: lateral, at any speeds."""
    adversary = drift("adversary", -8, 3.2, 18, 2.0, 3.0, 0.0)
    v = judge(EGO, adversary, [], trigger_time=1.0)
    assert v.collided and not v.rear_end
    assert v.contact_time is not None and impact(EGO, adversary, v.contact_time).ego_side is Side.LEFT


def test_a_red_light_runner_leaves_time_to_swerve_or_brake_hard_but_not_for_the_careful_driver() -> None:
    """From 24 m (12^2 / 2 / 3) before the corridor it cannot stop: hazard 2 s before contact at 10 m/s."""
    ego = cruise("ego", 0, 0, 10)
    v = judge(ego, CROSSING, [], trigger_time=1.0)
    assert v.contact_time == pytest.approx(56.5 / 12)  # its front needs 60 - 1 - 2.5 m
    assert v.hazard_time == pytest.approx(2.7, abs=0.051)
    assert (v.avoidable, v.valid, v.strict) == ("any_manoeuvre", True, False)
    assert hazard_of(align(ego, CROSSING, 1.0))[1] is Kind.CROSSING


def test_an_oncoming_car_in_the_ego_s_lane_braking_cannot_avoid_a_swerve_can() -> None:
    ego = cruise("ego", 0, 0, 10)
    v = judge(ego, ONCOMING, [], trigger_time=1.0)
    assert v.contact_time == pytest.approx(4.75) and v.hazard_time == 1.0  # in the lane from the trigger on
    assert (v.avoidable, v.valid, v.strict) == ("any_manoeuvre", True, False)


def test_an_oncoming_hazard_shows_when_the_box_crosses_the_edge_of_the_lane() -> None:
    """Half width 1: over 1.6 m when its centre passes 2.6 m, which 1 m/s from 3.65 m does after 1.05 s."""
    y = np.maximum(3.65 - np.maximum(TIME - 2.0, 0), 0.0)
    adversary = car("adversary", 120 - 10 * TIME, y, 10, np.pi)
    when, kind = hazard_of(align(cruise("ego", 0, 0, 10), adversary, 1.0))
    assert kind is Kind.ONCOMING and when == pytest.approx(3.1, abs=0.01)


def road(half_width: float) -> object:
    def on_road(x: Floats, y: Floats) -> Bools:
        return np.abs(y) <= half_width

    return on_road


def test_an_escape_must_stay_on_the_road() -> None:
    ego = cruise("ego", 0, 0, 10)
    wide = judge(ego, ONCOMING, [], trigger_time=1.0, on_road=road(6.0))  # type: ignore[arg-type]
    narrow = judge(ego, ONCOMING, [], trigger_time=1.0, on_road=road(1.5))  # type: ignore[arg-type]
    assert (wide.avoidable, narrow.avoidable) == ("any_manoeuvre", "unavoidable")


def test_an_escape_must_stay_clear_of_others_but_not_of_who_follows() -> None:
    ego = cruise("ego", 0, 0, 10)
    left, right = cruise("left", 2, 3.2, 10), cruise("right", 2, -3.2, 10)
    walled = judge(ego, ONCOMING, [left, right], trigger_time=1.0)
    followed = judge(ego, ONCOMING, [cruise("behind", -12, 0, 10)], trigger_time=1.0)
    assert (walled.avoidable, followed.avoidable) == ("unavoidable", "any_manoeuvre")


def test_a_near_miss_has_no_validity_but_ttc_pet_and_distance() -> None:
    """Parallel drift that stops 0.4 m beside the ego."""
    v = judge(EGO, drift("adversary", 0, 3.2, 15, 2.0, 3.0, 2.4), [], trigger_time=1.0)
    assert not v.collided and v.valid is None and v.strict is None and v.avoidable is None and v.fault is None
    assert v.min_distance == pytest.approx(0.4, abs=0.05) and 0 < v.min_ttc <= 1.3


def test_criticality_runs_from_the_trigger_and_stops_at_the_end_given() -> None:
    ego = cruise("ego", 0, 0, 10)
    assert judge(ego.between(0.0, 4.0), ONCOMING, [], trigger_time=1.0).min_ttc == pytest.approx(0.75)
    assert judge(ego, CROSSING, [], trigger_time=6.5).min_ttc == np.inf
    with pytest.raises(UsageError, match="no step in common"):
        judge(ego.between(0, 2), ONCOMING, [], trigger_time=5.0)


def test_min_ttc_any_sees_the_others() -> None:
    ego = cruise("ego", 0, 0, 10)
    standing = cruise("standing", 130, 0, 0)
    v = judge(ego, cruise("adversary", 0, 40, 10), [standing], trigger_time=1.0)
    assert v.min_ttc == np.inf and v.min_ttc_any == pytest.approx(0.5)  # at 12 s: 5 m to go at 10 m/s


def avoids(tier: str, ego: Track, adversary: Track, hazard: float) -> bool:
    """Whether a tier avoids the collision of which the hazard shows at a time [s]."""
    e = align(ego, adversary, hazard)
    return bool(avoidance(e.ego, e.adversary, np.array([e.trigger]), e.dt, delays=(0.8,))[tier].all())


def test_the_planned_continuation_past_the_contact_decides_whether_braking_helps() -> None:
    """Braking lets a crossing car pass if it goes on, and hits it if it stops in the way."""
    ego = cruise("ego", 0, 0, 10)
    contact = 56.5 / 12
    goes_on = judge(ego.between(0, 4.7), CROSSING, [], trigger_time=1.0)
    y = np.minimum(-60 + 12 * TIME, -60 + 12 * 4.8)
    stops = replace(CROSSING, y=y, speed=np.where(TIME < 4.85, 12.0, 0.0))
    assert goes_on.collided is False  # the ego's track ends 8 ms before
    early = 1.2
    assert avoids("careful", ego.between(0, 4.8), CROSSING, early)
    assert judge(ego, CROSSING, [], trigger_time=1.0).contact_time == pytest.approx(contact)
    assert not avoids("careful", ego.between(0, 4.8), stops, 2.7)
    assert avoids("manoeuvre", ego.between(0, 4.8), CROSSING, 2.7)


def test_the_careful_driver_s_stopping_distance() -> None:
    """15 m/s: 1.15 s without, 0.6 s ramp, then 7.593 m/s2: 17.25 + 8.54 + 12.73^2 / 15.19 = 36.46 m."""
    ramp_loss = CAREFUL_BRAKING * 0.6 / 2
    distance = 15 * 1.75 - CAREFUL_BRAKING * 0.36 / 6 + (15 - ramp_loss) ** 2 / (2 * CAREFUL_BRAKING)
    assert distance == pytest.approx(36.46, abs=0.01)
    ego = cruise("ego", 0, 0, 15)
    for margin, expected in ((-0.3, False), (0.3, True)):
        wall = cruise("adversary", 15 * 2.0 + distance + 5.0 + margin, 0, 0)
        assert avoids("careful", ego, wall, 2.0) is expected


def stack(tracks: list[Track]) -> Boxes:
    arrays = [np.stack([getattr(t, n) for t in tracks]) for n in ("x", "y", "heading", "speed")]
    return Boxes(arrays[0], arrays[1], arrays[2], arrays[3], 5.0, 2.0)


def test_the_batch_says_what_the_judge_says() -> None:
    pairs = [(EGO, LATE_CUT_IN), (EGO, SLOW_DRIFT), (cruise("ego", 0, 0, 10), ONCOMING)]
    verdicts = [judge(e, a, [], trigger_time=1.0) for e, a in pairs]
    hazards = np.array([int(np.rint((v.hazard_time or 0.0) / DT)) for v in verdicts])
    answer = avoidance(stack([e for e, _ in pairs]), stack([a for _, a in pairs]), hazards, DT)
    assert answer["careful"].tolist() == [False, True, False]
    assert answer["manoeuvre"].shape == (3, 3)
    assert answer["manoeuvre"][:, 1].tolist() == [v.avoidable != "unavoidable" for v in verdicts]
    assert (answer["manoeuvre"][:, 0] >= answer["manoeuvre"][:, 2]).all()  # earlier is not worse


def test_verdicts_do_not_depend_on_where_north_is() -> None:
    def turned(t: Track, by: float = 2.1) -> Track:
        c, s = np.cos(by), np.sin(by)
        heading = (t.heading + by + np.pi) % (2 * np.pi) - np.pi
        return replace(t, x=c * t.x - s * t.y + 100, y=s * t.x + c * t.y - 70, heading=heading)

    crossing = cruise("adversary", 50, -60.5, 12, np.pi / 2)
    for ego, adversary in ((EGO, SLOW_DRIFT), (EGO, LATE_CUT_IN), (cruise("ego", 0, 0, 10), crossing)):
        a = judge(ego, adversary, [], trigger_time=1.0)
        b = judge(turned(ego), turned(adversary), [], trigger_time=1.0)
        same = ("collided", "avoidable", "valid", "strict", "rear_end", "failed_gates", "fault", "hazard_time")
        assert [getattr(a, n) for n in same] == [getattr(b, n) for n in same]
        assert a.contact_time == pytest.approx(b.contact_time, abs=1e-3)


def test_the_full_verdict_adds_sensitivity_last_moments_severity_and_a_second_opinion() -> None:
    full = full_judge(EGO, SLOW_DRIFT, [], trigger_time=1.0)
    assert full.kind is Kind.SAME_DIRECTION and full.collision_class is CollisionClass.ACTIVE_FRONT
    assert full.verdict.fault == "ego"  # nuPlan looks at the bumper alone
    assert full.rss is not None and (full.rss.trigger, full.rss.blame) == ("lateral", "adversary")
    assert all(full.sensitivity.values()) and len(full.sensitivity) == 4
    assert full.impact is not None and full.impact.speed == pytest.approx(6.0)
    assert full.impact.delta_v == pytest.approx(3.0)  # equal masses
    assert full.impact.ego_point == pytest.approx((2.5, 0.0)) and full.impact.adversary_point == pytest.approx(
        (-2.5, 0.0)
    )
    assert full.latest_careful is not None and 0.4 <= full.latest_careful <= 1.0
    assert full.latest_manoeuvre is not None and full.latest_manoeuvre <= full.latest_careful
    late = full_judge(EGO, LATE_CUT_IN, [], trigger_time=1.0)
    assert late.reacting == "unavoidable" and not any(late.sensitivity.values())


def test_the_last_moment_to_brake_for_a_closing_speed_of_six() -> None:
    """6 m/s are lost in t = 6 / 7.593 + 0.3 s; the distance closed until then is the gap at which to begin."""
    full = full_judge(EGO, SLOW_DRIFT, [], trigger_time=1.0)
    t = 6.0 / CAREFUL_BRAKING + 0.3
    needed = 6.0 * t - CAREFUL_BRAKING * (0.06 + (t - 0.6) * 0.3 + (t - 0.6) ** 2 / 2)
    assert full.latest_careful == pytest.approx(needed / 6.0, abs=0.11)


def test_rss_blames_the_follower_who_does_not_brake_and_frees_the_one_who_does() -> None:
    leader = soft_braking(3.0, 5.0, 40.0)
    contact = judge(EGO, leader, [], trigger_time=1.0).contact_time
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


def test_a_gate_verdict_is_quick_enough_for_the_search() -> None:
    others = [cruise(f"o{i}", 20 * i - 50, -3.2 * (i % 3 + 1) - 1, 14) for i in range(10)]
    judge(EGO, SLOW_DRIFT, others, trigger_time=1.0)
    took = []
    for _ in range(5):
        start = clock.process_time()
        judge(EGO, SLOW_DRIFT, others, trigger_time=1.0)
        took.append(clock.process_time() - start)
    assert min(took) < 0.015  # 5 ms on an idle core; benchmarks/verdict_speed.py has the figure


def test_a_hard_braking_adversary_is_braking_and_its_contact_is_exact() -> None:
    """From 25 m ahead, 15 m/s, braking with 6 it stands after 2.5 s and 18.75 m, just before the ego arrives."""
    v = judge(EGO, braking("adversary", 25, 0, 15, 3, 6), [], trigger_time=1.0)
    standing = 3 + (25 - 5 + 15 * 2.5 / 2) / 15  # s
    assert v.contact_time == pytest.approx(standing, abs=0.002) and v.failed_gates == ("jerk",)
