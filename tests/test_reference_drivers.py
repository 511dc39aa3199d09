"""Reference drivers on encounters with numbers worked out by hand, and the rules that none of them may break."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from metrics_tracks import DT, TIME, car, cruise, drift

from sumo_adv.datatypes import Boxes, Level, Track, Verdict
from sumo_adv.metrics.case import Case
from sumo_adv.metrics.own_data import CASE_COLUMNS, judge_cut_ins
from sumo_adv.metrics.preventability import preventability
from sumo_adv.metrics.reference import BRAKERS, REFERENCE_DRIVERS, SAME_DIRECTION_ONLY
from sumo_adv.metrics.reference.brakers import FULL_BRAKING_M_S2, critical, proactive, speed_lost
from sumo_adv.metrics.reference.counterfactual import Counterfactual, Encounters
from sumo_adv.metrics.reference.view import EgoPaths
from sumo_adv.metrics.verdict import judge_attempt, with_answers

METRICS = Path(__file__).resolve().parent.parent / "sumo_adv" / "metrics"
EGO = cruise("ego", 0, 0, 15)
SLOW_DRIFT = drift("adversary", 50, 3.2, 9, 2.0, 5.0, 0.0)  # 45 m ahead, 6 m/s slower, changes lane over 5 s


def row(track: Track) -> Boxes:
    return Boxes(track.x[None], track.y[None], track.heading[None], track.speed[None], track.length, track.width)


def judged(ego: Track, adversary: Track, *others: Track, trigger: float = 1.0) -> Verdict:
    return judge_attempt(Case(ego, adversary, others, trigger))


# ---- the rules


def test_the_careful_driver_brakes_as_the_regulation_says() -> None:
    assert pytest.approx(7.593, abs=1e-3) == FULL_BRAKING_M_S2
    assert speed_lost(np.array([-1.0, 0.0])).tolist() == [0.0, 0.0]
    assert float(speed_lost(np.array(0.6))) == pytest.approx(7.593 * 0.3, abs=1e-3)  # half of it within the ramp
    assert float(speed_lost(np.array(1.6))) == pytest.approx(7.593 * 1.3, abs=1e-3)


def test_the_careful_driver_is_alarmed_at_a_cut_in_when_two_seconds_are_left() -> None:
    """6 m/s closer each second: the gap of 45 m at 0 s is 12 m, 2 s, at 5.5 s; it wandered 0.375 m long before."""
    check = Counterfactual(Encounters(row(EGO), row(SLOW_DRIFT), np.array([10]), np.array([75]), DT))
    station, speed, alarm = check.roll_out(BRAKERS["cc_human"])
    assert alarm[0] == pytest.approx(5.5)
    assert speed[0, 62] == 15.0 and speed[0, 64] < 15.0  # 0.75 s later
    assert station[0, -1] < 15.0 * check.time[-1]


def pausing_cut_in(pause: float) -> Track:
    """From 3.2 m beside, 43 m ahead and 8 m/s slower than the ego; over at 1 m/s from 1 s on, to 1.6 m; there it keeps
    its place for ``pause`` s, 0.6 m over the line of the lane; then it goes on to 0."""
    sideways = np.where((TIME > 1.0) & (TIME <= 2.6) | (2.6 + pause < TIME) & (4.2 + pause >= TIME), 1.0, 0.0)
    y = 3.2 - np.cumsum(sideways) * DT
    return car("adversary", 43.0 + 7.0 * TIME, np.maximum(y, 0.0), 7.0)


@pytest.mark.parametrize("pause", [0.0, 0.6, 1.2])
def test_a_danger_over_the_line_is_not_forgotten_while_it_pauses(pause: float) -> None:
    """8 m/s closer each second: the gap of 38 m at 0 s is 16 m, 2 s, at 2.75 s; the driver brakes 0.75 s later, also if
    the vehicle has been pausing since 2.6 s, and goes on braking."""
    foe = pausing_cut_in(pause)
    check = Counterfactual(Encounters(row(EGO), row(foe), np.array([10]), np.array([60]), DT))
    _, speed, alarm = check.roll_out(BRAKERS["cc_human"])
    assert alarm[0] == pytest.approx(2.8, abs=0.11)
    braking = np.diff(speed[0])[36:44]  # from 3.6 s to 4.4 s
    assert (braking < -1e-6).all()
    assert check.braking(BRAKERS["cc_human"]).avoids[0]


def test_a_vehicle_that_has_gone_back_is_no_danger_any_more() -> None:
    """It comes 0.6 m over the line as above and goes back at once: the driver lets go."""
    there = pausing_cut_in(0.0)
    y = np.where(TIME <= 2.6, there.y, np.minimum(1.6 + (TIME - 2.6), 3.2))
    check = Counterfactual(
        Encounters(row(EGO), row(car("adversary", there.x, y, 7.0)), np.array([10]), np.array([60]), DT)
    )
    _, speed, _ = check.roll_out(BRAKERS["cc_human"])
    assert (np.diff(speed[0])[50:] >= 0.0).all()


def test_a_collision_that_only_rss_avoids_is_not_valid() -> None:
    """RSS and the fuzzy model brake without need in ordinary traffic; ``reg157`` makes the same collision valid."""
    hit = judged(EGO, SLOW_DRIFT)
    assert hit.preventability is not None

    def with_avoiding(*names: str) -> Level:
        answers = {n: "avoids" if n in names else "collides" for n in REFERENCE_DRIVERS}
        return with_answers(hit, replace(hit.preventability, answers=answers)).level

    assert with_avoiding("rss", "fsm") is Level.COLLISION
    assert with_avoiding("rss", "reg157") is Level.VALID


def test_a_driver_must_avoid_it_in_the_loop_too() -> None:
    """Kinematically all avoid it. In the loop ``cc_human`` does not: valid by ``manoeuvre``, not strict; and if no
    driver does there, it is a collision."""
    hit = judged(EGO, SLOW_DRIFT)
    assert hit.preventability is not None and hit.level is Level.SERIOUS

    def in_loop(**answers: str) -> Verdict:
        return with_answers(hit, replace(hit.preventability, in_loop=answers))

    assert in_loop(cc_human="collides", manoeuvre="avoids").level is Level.VALID
    assert in_loop(cc_human="collides", manoeuvre="collides", reg157="collides").level is Level.COLLISION
    prevention = in_loop(cc_human="avoids").preventability
    assert prevention is not None and prevention.by == ("cc_human",)


def test_reg157_brakes_at_six_after_0_35_s() -> None:
    check = Counterfactual(Encounters(row(EGO), row(SLOW_DRIFT), np.array([10]), np.array([75]), DT))
    _, speed, alarm = check.roll_out(BRAKERS["reg157"])
    assert alarm[0] == pytest.approx(5.5)  # 2 s before it reaches the vehicle that has intruded
    assert speed[0, 58] == 15.0
    assert speed[0, 59] == pytest.approx(15.0 - 6.0 * 0.05)  # from 5.85 s on
    assert speed[0, 60] == pytest.approx(15.0 - 6.0 * 0.15)


def test_the_fuzzy_metrics_at_their_ends() -> None:
    """20 m/s behind 20 m/s: 0.75 s are 15 m, comfortable braking 50 m, hard braking 33.3 m, the leader's 28.6 m."""
    gap = np.array([15 + 50 - 28.571 + 2.0, 15 + 33.333 - 28.571])
    assert proactive(gap, np.array([20.0]), np.array([20.0])) == pytest.approx([0.0, 1.0], abs=1e-3)
    # 20 m/s behind 10 m/s: 7.5 m nearer within 0.75 s, then 100 / 8 = 12.5 m or 100 / 12 = 8.33 m
    gap = np.array([7.5 + 12.5, 7.5 + 8.333])
    assert critical(gap, np.array([20.0]), np.array([10.0]), np.array([0.0])) == pytest.approx([0.0, 1.0], abs=1e-3)
    assert critical(np.array([1.0]), np.array([10.0]), np.array([12.0]), np.array([0.0])).tolist() == [0.0]


def test_a_driver_sees_only_what_has_happened() -> None:
    """Two cut-ins that are one up to 6 s, and then differ: the alarm and all speeds up to then are the same."""
    later = car("adversary", SLOW_DRIFT.x, SLOW_DRIFT.y + np.where(TIME > 6.0, TIME - 6.0, 0.0), 9.0)
    for driver in BRAKERS.values():
        first, second = (
            Counterfactual(Encounters(row(EGO), row(foe), np.array([10]), np.array([75]), DT)).roll_out(driver)
            for foe in (car("adversary", SLOW_DRIFT.x, SLOW_DRIFT.y, 9.0), later)
        )
        assert first[1][0, :60] == pytest.approx(second[1][0, :60])


# ---- verdicts


def test_a_slow_drift_far_ahead_is_avoided_by_everybody() -> None:
    v = judged(EGO, SLOW_DRIFT)
    assert v.preventability is not None
    assert v.preventability.by == REFERENCE_DRIVERS
    assert v.preventability.alarms["cc_human"] == pytest.approx(5.5)
    assert (v.level, v.valid, v.strict) == (Level.SERIOUS, True, True)
    assert v.delta_v == pytest.approx(1.1 * 6.0 / 2, abs=0.01)  # equal cars, 6 m/s, restitution 0.1


def test_crossing_leaves_out_the_drivers_for_one_direction() -> None:
    v = judged(cruise("ego", 0, 0, 14), cruise("adversary", 44, -39.6, 12, np.pi / 2))
    assert v.collided and v.preventability is not None
    answers = v.preventability.answers
    assert all(answers[name] == "not_applicable" for name in SAME_DIRECTION_ONLY)
    assert answers["cc_human"] in ("avoids", "collides")


@pytest.mark.parametrize(("length", "width", "ruled"), [(0.5, 0.5, False), (1.8, 0.6, True), (4.5, 1.8, True)])
def test_the_drivers_for_one_direction_have_no_rule_for_pedestrians(length: float, width: float, ruled: bool) -> None:
    """All go the ego's way, 40 m ahead and 12.5 m/s slower; the pedestrian is judged by two drivers alone."""
    ahead = replace(cruise("adversary", 40, 0, 1.5), length=length, width=width)
    v = judged(cruise("ego", 0, 0, 14), ahead)
    assert v.collided and v.preventability is not None
    answers = v.preventability.answers
    assert {answers[name] for name in SAME_DIRECTION_ONLY} <= ({"avoids", "collides"} if ruled else {"not_applicable"})
    assert {answers[name] for name in ("cc_human", "manoeuvre")} <= {"avoids", "collides"}


def test_a_rammed_standing_ego_says_nothing_about_it() -> None:
    """It stands throughout the last second; no driver can do anything."""
    v = judged(cruise("ego", 60, 0, 0), drift("adversary", 0, 3.2, 10, 2.0, 3.0, 0.5))
    assert v.collided and v.ego_stationary is True
    assert v.level <= Level.COLLISION and not v.valid


def test_an_ego_that_drives_into_a_standing_car_takes_part() -> None:
    v = judged(EGO, cruise("adversary", 105, 0, 0))
    assert v.collided and v.ego_stationary is False and v.level >= Level.STRICT


def test_a_car_that_creeps_over_at_0_09_m_s_is_no_reason_to_have_braked() -> None:
    """0.09 m/s is lane keeping, so ``cc_human`` is not alarmed before the touch."""
    creeping = car("adversary", 2.0 + 15.0 * TIME, 2.9 - 0.09 * TIME, 15.0)
    v = judged(EGO, creeping)
    assert v.contact_time == pytest.approx(10.0, abs=0.1)
    assert v.preventability is not None and not v.strict
    assert "cc_human" not in v.preventability.alarms and v.preventability.answers["cc_human"] == "collides"


@pytest.mark.parametrize("apart", [0.075, 0.033])
def test_a_contact_between_two_samples_is_a_contact(apart: float) -> None:
    """Both at 10 m/s across: the boxes overlap from 2.5 s + apart / 10 to 2.6 s - apart / 10, at no sample."""
    ego = cruise("ego", 0.0, 0.0, 10.0)
    foe = cruise("adversary", 22.5 - apart, -28.5 - apart, 10.0, np.pi / 2)
    check = Counterfactual(Encounters(row(ego), row(foe), np.array([10]), np.array([len(TIME) - 1]), DT))
    assert check.unchanged().contact[0] == pytest.approx(2.5 + apart / 10, abs=1e-3)
    assert judged(ego, foe).contact_time == pytest.approx(2.5 + apart / 10, abs=1e-3)


def test_without_a_plan_it_is_inconclusive() -> None:
    contact = judged(EGO, SLOW_DRIFT).contact_time
    assert contact is not None
    cut = SLOW_DRIFT.between(0.0, contact + 0.1)
    judged_cut = preventability(Case(EGO, cut, (), 1.0), contact)
    assert judged_cut.inconclusive == "no_plan"


def test_a_follower_that_runs_into_the_braking_ego_does_not_count() -> None:
    """8 m behind at the ego's own speed, and it does not react: the ego brakes by 6 m/s, and is hit from behind."""
    v = judged(EGO, SLOW_DRIFT, cruise("follower", -8.0, 0.0, 15.0))
    assert v.preventability is not None and "cc_human" in v.preventability.by


# ---- metamorphic


def moved(track: Track, angle: float, x: float, y: float, mirror: bool) -> Track:
    side = -1.0 if mirror else 1.0
    c, s = np.cos(angle), np.sin(angle)
    px, py, h = track.x, side * track.y, side * track.heading
    heading = (h + angle + np.pi) % (2 * np.pi) - np.pi
    return Track(
        track.id, track.role, track.time, c * px - s * py + x, s * px + c * py + y, heading, track.speed,
        track.acceleration, track.length, track.width,
    )  # fmt: skip


def finer(track: Track) -> Track:
    time = np.round(np.arange(track.time[0], track.time[-1] + 0.02, 0.05), 3)
    x, y, heading, speed = (np.interp(time, track.time, v) for v in (track.x, track.y, track.heading, track.speed))
    rate = np.diff(speed, prepend=speed[0]) / 0.05
    return Track(track.id, track.role, time, x, y, heading, speed, rate, track.length, track.width)


STORIES = {
    "slow drift": (EGO, SLOW_DRIFT),
    "crossing": (cruise("ego", 0, 0, 14), cruise("adversary", 44, -39.6, 12, np.pi / 2)),
    "from beside": (EGO, drift("adversary", 3, 3.2, 15, 2.0, 2.5, 0.0)),
    "cut-in": (EGO, drift("adversary", 30, 3.2, 9, 2.0, 2.0, 0.0)),
}


def said(v: Verdict) -> tuple[object, ...]:
    assert v.preventability is not None
    return (v.level, dict(v.preventability.answers), v.preventability.inconclusive, v.ego_stationary, v.severity)


@pytest.mark.parametrize("story", STORIES)
@settings(max_examples=15, deadline=None, derandomize=True)
@given(angle=st.floats(-3.1, 3.1), x=st.floats(-500, 500), y=st.floats(-500, 500), mirror=st.booleans())
def test_where_the_scene_lies_changes_nothing(story: str, angle: float, x: float, y: float, mirror: bool) -> None:
    ego, foe = STORIES[story]
    plain, other_frame = judged(ego, foe), judged(moved(ego, angle, x, y, mirror), moved(foe, angle, x, y, mirror))
    assert said(plain) == said(other_frame)
    assert other_frame.delta_v == pytest.approx(plain.delta_v, abs=1e-6)


@pytest.mark.parametrize("story", STORIES)
def test_half_the_step_changes_nothing(story: str) -> None:
    ego, foe = STORIES[story]
    assert said(judged(ego, foe)) == said(judged(finer(ego), finer(foe)))


# ---- standard cut-ins


def test_cut_ins_with_known_answers() -> None:
    """At equal speeds there is no contact; 60 against 5 km/h at 12 m is too late; from 55 m off all avoid it."""
    cases = np.array([[50.0, 50.0, 10.0, 1.0], [60.0, 5.0, 12.0, 1.8], [50.0, 30.0, 55.0, 1.0]])
    same, near, far = judge_cut_ins(cases)
    assert set(same.values()) == {"none"}
    assert near["unchanged"] != "none" and near["cc_human"] == near["unchanged"]
    assert far == {"unchanged": "front_to_rear"} | dict.fromkeys(REFERENCE_DRIVERS, "none")
    assert len(CASE_COLUMNS) == cases.shape[1]


SLOW = np.array([[58.0, 24.0, 33.0, 0.4], [37.0, 5.0, 29.0, 0.5], [58.0, 11.0, 47.0, 0.4], [25.0, 8.0, 12.0, 0.6]])
NEAR = np.array([[33.0, 6.0, 13.0, 1.3], [47.0, 24.0, 11.0, 0.9], [58.0, 24.0, 33.0, 0.4], [31.0, 7.0, 13.0, 0.8]])


def test_cut_ins_as_the_public_implementation_answers_them() -> None:
    """ec-jrc/JRC-FSM: its careful driver perceives a slow drift too late, its RSS driver brakes in time."""
    assert all(row["cc_human"] != "none" for row in judge_cut_ins(SLOW))
    assert all(row["rss"] == "none" for row in judge_cut_ins(NEAR))


# ---- blindness


def test_no_code_of_the_verdict_reads_names_intents_or_methods() -> None:
    forbidden = {"label", "intent", "method", "controller", "origin", "by_model"}
    for path in METRICS.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        read = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
        assert not read & forbidden, (path.name, read & forbidden)
        names = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
        assert not names & {"idm", "krauss", "lattice", "Aggressive Cut-in"}, path.name


def test_the_search_never_asks_the_unseen_judges() -> None:
    unseen = ("reg157", "rss", "fsm")
    package = METRICS.parent
    for folder in ("agents", "planning", "memory"):
        for path in (package / folder).rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            assert not any(f"reference.{name}" in text or f'"{name}"' in text for name in unseen), path


# ---- paths


@given(
    turn=st.floats(-0.02, 0.02), station=st.floats(1.0, 90.0), left=st.floats(-15.0, 15.0)
)  # fmt: skip
def test_a_place_beside_a_path_is_found_again(turn: float, station: float, left: float) -> None:
    s = np.arange(0.0, 101.0, 1.0)
    heading = turn * s
    x = np.concatenate([[0.0], np.cumsum(np.cos(heading[:-1] + turn / 2))])
    y = np.concatenate([[0.0], np.cumsum(np.sin(heading[:-1] + turn / 2))])
    paths = EgoPaths(Boxes(x[None], y[None], heading[None], 0.0 * x[None], 5.0, 2.0))
    px, py, h = (float(v[0, 0]) for v in paths.poses(np.array([[station]])))
    qx, qy = px - left * np.sin(h), py + left * np.cos(h)
    at, off, _ = (float(v[0, 0]) for v in paths.locate(np.array([[qx]]), np.array([[qy]])))
    assert at == pytest.approx(station, abs=0.05 + 0.02 * abs(left))
    assert off == pytest.approx(left, abs=0.05)


def test_a_path_that_ends_standing_goes_on_in_its_direction() -> None:
    """The ego drives 10 m along x and stands; a car 30 m on is at station 35, not at the end."""
    x = np.concatenate([np.arange(0.0, 11.0), np.full(20, 10.0)])
    paths = EgoPaths(Boxes(x[None], 0.0 * x[None], 0.0 * x[None], 0.0 * x[None], 5.0, 2.0))
    at, off, _ = (v[0] for v in paths.locate(np.array([[35.0, -5.0, 10.2]]), np.array([[1.0, -2.0, 3.0]])))
    assert at == pytest.approx([35.0, -5.0, 10.2]) and off == pytest.approx([1.0, -2.0, 3.0])
