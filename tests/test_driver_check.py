"""The check of a driver: what it finds in motions made by hand, in a right adapter, and in wrong ones."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from cli_samples import ROOT, Program

from sumo_adv import app
from sumo_adv.config import load_settings
from sumo_adv.datatypes import Role, Track, VehicleState
from sumo_adv.driver_check import Checked, FindingKind, by_name, shipped_drive, twelve
from sumo_adv.driver_check.drive import PassedLine, UnattackedDrive
from sumo_adv.driver_check.findings import answer_times, find_faults, first_separation, longest
from sumo_adv.drivers import Pose
from sumo_adv.errors import UsageError

STEPS = 301  # 30 s

# ---- motions made by hand, along x


def track(id: str, speed: float, x: float = 0.0, y: float = 0.0, *, stop: float = math.inf) -> Track:
    """A car of 5 m x 2 m with an even speed, which stands from ``stop`` [s] on."""
    time = np.arange(STEPS) / 10
    moving = np.minimum(time, stop)
    speeds = np.where(time < stop, speed, 0.0)
    zero = np.zeros(STEPS)
    return Track(id, Role.EGO, time, x + speed * moving, zero + y, zero, speeds, zero, 5.0, 2.0)


def driven(ego: Track, *others: Track) -> UnattackedDrive:
    return UnattackedDrive(ego, others, np.zeros((STEPS, 4)), np.zeros(STEPS), (), np.zeros(0))


IDM = driven(track("ego", 10.0))


def test_a_driver_that_keeps_its_lane_and_its_distance_is_good() -> None:
    assert find_faults(driven(track("ego", 10.0), track("leader", 10.0, x=20.0)), IDM) == []


def test_a_collision_names_the_other_the_sides_and_the_speeds() -> None:
    (finding,) = find_faults(driven(track("ego", 10.0), track("leader", 4.0, x=35.0)), IDM)
    assert (finding.kind, finding.time) == (FindingKind.COLLIDES, pytest.approx(5.0, abs=1e-6))  # 30 m at 6 m/s
    assert finding.words == "its front meets the rear of 'leader' (ego 10.0 m/s, other 4.0 m/s)"


def test_half_a_second_off_the_road_is_allowed_and_more_is_not() -> None:
    for steps, kinds in ((5, []), (6, [FindingKind.LEAVES_ROAD])):
        off = np.zeros((STEPS, 4))
        off[100 : 100 + steps, 2] = 0.4
        assert [f.kind for f in find_faults(replace(IDM, off_road=off), IDM)] == kinds
    off_lane = np.zeros(STEPS)
    off_lane[100:] = 1.5
    (finding,) = find_faults(replace(IDM, off_lane=off_lane), IDM)
    assert (finding.kind, finding.time, finding.words) == (
        FindingKind.LEAVES_LANE,
        10.0,
        "its centre is up to 1.5 m outside",
    )


def test_standing_counts_from_ten_seconds_more_than_sumos_driver_on() -> None:
    assert find_faults(driven(track("ego", 10.0, stop=20.1)), IDM) == []  # 100 steps
    (finding,) = find_faults(driven(track("ego", 10.0, stop=10.0)), IDM)
    assert (finding.kind, finding.time) == (FindingKind.STANDS, 10.0)
    assert find_faults(driven(track("ego", 10.0, stop=10.0)), driven(track("ego", 10.0, stop=18.0))) == []


def test_less_than_half_the_way_is_slow() -> None:
    assert find_faults(driven(track("ego", 5.1)), IDM) == []
    (finding,) = find_faults(driven(track("ego", 4.9)), IDM)
    assert (finding.kind, finding.words) == (FindingKind.SLOW, "it has come 147 m, SUMO's idm 300 m")


def test_a_pose_that_no_car_reaches_is_a_jump() -> None:
    before = VehicleState("ego", 0.0, 0.0, 0.0, 10.0, 0.0, 5.0, 2.0, "")
    assert find_faults(replace(IDM, poses=((before, Pose(1.0, 0.0, 0.0, 10.0)),)), IDM) == []
    (ahead,) = find_faults(replace(IDM, poses=((before, Pose(3.5, 0.0, 0.0, 10.0)),)), IDM)  # 2.5 m too far
    assert ahead.kind is FindingKind.JUMPS
    assert ahead.words.endswith("at 10.0 m/s, half its length too far: is that its front bumper?")
    for pose in (Pose(1.0, 0.5, 0.0, 10.0), Pose(1.08, 0.0, 0.0, 11.5)):  # sideways; 15 m/s2
        (finding,) = find_faults(replace(IDM, poses=((before, pose),)), IDM)
        assert (finding.kind, "bumper" in finding.words) == (FindingKind.JUMPS, False)


def test_a_line_that_it_had_to_wait_at() -> None:
    (finding,) = find_faults(replace(IDM, lines=(PassedLine(4.0, "red"),)), IDM)
    assert (finding.kind, finding.words) == (FindingKind.LINE, "it passes a line of a light that is red")


def test_motions_are_apart_from_where_they_part() -> None:
    same = track("ego", 10.0)
    assert first_separation(same, same, 1e-6) == (math.inf, 0.0)
    when, far = first_separation(same, track("ego", 10.5), 1.0)
    assert (when, far) == (2.1, pytest.approx(15.0))  # 0.5 m/s: 1.05 m after 2.1 s, 15 m after 30 s
    assert first_separation(same, same.between(0.0, 20.0), 1.0) == (20.1, math.inf)


def test_a_planner_that_plans_in_each_fifth_step_has_the_mean_of_its_plans() -> None:
    """60 ms in each fifth step and 1 ms in the others: (60 + 4 * 1) / 5 = 12.8 ms on average."""
    times = answer_times([replace(IDM, act=np.tile([0.06, 0.001, 0.001, 0.001, 0.001], 20))])
    assert times is not None and (times.count, times.plans) == (100, 20)
    assert (times.mean, times.median, times.p99, times.plan_mean) == pytest.approx((12.8, 1.0, 60.0, 60.0))
    words = "An answer takes 12.8 ms on average (median 1 ms, 99 % within 60 ms)."
    assert times.words == f"{words} One in 5 is a plan, which takes 60 ms on average."
    assert answer_times([IDM]) is None


def test_a_check_that_is_stopped_keeps_what_it_has() -> None:
    """Ctrl-C comes when the first of two scenarios is done."""

    def interrupt(checked: Checked) -> None:
        raise KeyboardInterrupt

    inputs = twelve()[:2]
    done = app.check_driver(inputs, load_settings(None, ego="careful"), interrupt, seconds=5.0)
    assert done.stopped and [checked.scenario for checked in done.scenarios] == [inputs[0].name]


def test_the_longest_run() -> None:
    assert longest(np.array([1, 0, 1, 1, 0], bool)) == (2, 2)
    assert longest(np.zeros(3, bool)) == (0, 0)


# ---- real drives

STOP_AND_GO, RED_LIGHT, TURNS_LEFT = (
    ("check/stop_and_go", "ego"), ("signals_red_light", "red_south"), ("t_junction_left_from_stem", "from_south"),
)  # fmt: skip


@pytest.fixture(autouse=True, scope="module")
def examples_on_path() -> Iterator[None]:
    for folder in (ROOT / "examples" / "bring_a_planner", ROOT / "tests"):
        sys.path.insert(0, str(folder))
    yield
    for folder in (ROOT / "examples" / "bring_a_planner", ROOT / "tests"):
        sys.path.remove(str(folder))


def checked(ego: str, *scenarios: tuple[str, str], seconds: float) -> tuple[Checked, ...]:
    inputs = [shipped_drive(*scenario) for scenario in scenarios]
    return app.check_driver(inputs, load_settings(None, ego=ego), lambda checked: None, seconds).scenarios


def test_a_right_adapter_is_good() -> None:
    done = checked("adapter:BroughtPlanner", STOP_AND_GO, RED_LIGHT, TURNS_LEFT, seconds=20.0)
    assert [(each.scenario, each.findings) for each in done] == [
        ("stop_and_go:ego", ()), ("signals_red_light:red_south", ()), ("t_junction_left_from_stem:from_south", ()),
    ]  # fmt: skip
    assert done[0].metres > 100.0


@pytest.mark.parametrize(
    ("driver", "scenario", "seconds", "kinds"),
    [
        ("AbsoluteTime", STOP_AND_GO, 6.0, {FindingKind.TIME_BASE, FindingKind.JUMPS}),
        ("PlanByClock", STOP_AND_GO, 6.0, {FindingKind.TIME_BASE}),
        ("Degrees", TURNS_LEFT, 3.0, {FindingKind.JUMPS}),
        ("FrontBumper", STOP_AND_GO, 3.0, {FindingKind.JUMPS}),
        ("NoLines", RED_LIGHT, 20.0, {FindingKind.LINE}),
        ("NoLines", STOP_AND_GO, 12.0, {FindingKind.COLLIDES}),
        ("OtherSide", STOP_AND_GO, 8.0, {FindingKind.LEAVES_LANE}),
        ("Stands", STOP_AND_GO, 20.0, {FindingKind.STANDS}),
        ("Slow", RED_LIGHT, 10.0, {FindingKind.SLOW}),
        ("Remembers", STOP_AND_GO, 4.0, {FindingKind.RESET}),
        ("Dices", STOP_AND_GO, 4.0, {FindingKind.RANDOM}),
        ("Fails", STOP_AND_GO, 4.0, {FindingKind.FAILS}),
    ],
)
def test_a_wrong_driver_is_caught(
    driver: str, scenario: tuple[str, str], seconds: float, kinds: set[FindingKind]
) -> None:
    (done,) = checked(f"wrong_drivers:{driver}", scenario, seconds=seconds)
    assert kinds <= {finding.kind for finding in done.findings}


def test_a_front_bumper_for_the_centre_is_named() -> None:
    (done,) = checked("wrong_drivers:FrontBumper", STOP_AND_GO, seconds=2.0)
    assert "is that its front bumper?" in next(f.words for f in done.findings if f.kind is FindingKind.JUMPS)


def test_a_scenario_of_the_table_is_found_by_its_name() -> None:
    found = by_name("stop_and_go:ego")
    assert found is not None and (found.name, found.ego) == ("stop_and_go:ego", "ego")
    assert by_name("stop_and_go") == found  # it lies in a subfolder, so no other input has that name
    assert by_name("t_junction_left_from_stem") is None and by_name("stop_and_go:nobody") is None


def test_there_are_twelve_scenarios() -> None:
    assert len({given.name for given in twelve()}) == 12


def test_the_command_says_what_is_wrong_and_exits_with_3(program: Program) -> None:
    scenario = ROOT / "scenarios" / "check" / "stop_and_go.toml"
    good = program.here("doctor", "--ego", "ego_samples:CalmEgo", "--scenario", scenario)
    assert (good.status, good.out.splitlines()[-1]) == (0, "ego_samples:CalmEgo drives well in the one scenario.")
    wrong = program.here("doctor", "--ego", "ego_samples:FailingEgo", "--scenario", scenario, "--json")
    report = json.loads(wrong.out)
    assert (wrong.status, report["ok"], list(report["findings"])) == (3, False, ["fails"])
    assert "the driver fell asleep" in report["scenarios"][0]["findings"][0]["words"]


def test_wrong_use_of_the_command(program: Program) -> None:
    done = program.here("doctor", "--scenario", "leader_two_lanes")
    assert (done.status, "give --ego, too" in done.err) == (2, True)
    done = program.here("doctor", "--ego", "idm", "--llm", "mine")
    assert (done.status, "leave out --llm and --memory" in done.err) == (2, True)
    with pytest.raises(UsageError, match="There is no ego 'wild'"):
        checked("wild", STOP_AND_GO, seconds=1.0)
