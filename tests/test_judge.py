"""``judge``: stored runs, a user's tracks, standard cut-ins, and what is refused."""

from __future__ import annotations

import copy
import csv
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_samples import Program, Runs
from metrics_tracks import TIME, car, cruise, drift
from run_samples import run_folder

import sumo_adv
from sumo_adv.datatypes import Level, Track
from sumo_adv.errors import UsageError
from sumo_adv.metrics.fault import fault, nuplan_fault
from sumo_adv.outcome_schema import GONE_FROM_ATTEMPTS, GONE_FROM_IMPACT, GONE_FROM_OUTCOME, OUTCOME_SCHEMA
from sumo_adv.report.judging import judge_files

HEAD = "ego_kmh,other_kmh,gap_m,lateral_ms\n"


def columns(track: Track) -> dict[str, object]:
    names = ("time", "x", "y", "heading", "speed")
    return {n: getattr(track, n).tolist() for n in names} | {
        "length": [5.0] * len(track.time),
        "width": [2.0] * len(TIME),
    }


# ---- stored runs


def test_a_run_says_its_level_and_stores_the_plan(runs: Runs) -> None:
    outcome = runs["first"].outcome
    best = outcome["outcome"]
    assert outcome["schema"] == OUTCOME_SCHEMA
    assert best["level"] in ("collision", "valid", "strict", "serious") and best["simulated"] is True
    assert best["valid"] is (Level[best["level"].upper()] >= Level.VALID)
    assert set(best["references"]) == {"cc_human", "manoeuvre", "reg157", "rss", "fsm"}
    assert (runs["first"].folder / "plan.csv.gz").is_file()


def test_the_careful_driver_does_not_avoid_its_own_collision(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(run_folder("crossing"), folder)
    assert "cc_human" in judge_files(folder).now["preventable_by"]  # of a collision of SUMO's driver
    outcome = json.loads((folder / "outcome.json").read_text(encoding="utf-8"))
    outcome["ego"]["controller"] = "careful"
    (folder / "outcome.json").write_text(json.dumps(outcome), encoding="utf-8")
    now = judge_files(folder).now
    assert "cc_human" not in now["preventable_by"] and now["level"] == "valid"


def test_a_run_is_judged_from_its_files_alone() -> None:
    folder = run_folder("crossing")
    recorded = json.loads((folder / "outcome.json").read_text(encoding="utf-8"))["outcome"]
    verdict = judge_files(folder).now
    assert verdict["delta_v"] == pytest.approx(recorded["delta_v"], abs=0.01)
    assert (verdict["ego_stationary"], verdict["humanlike"], verdict["severity"]) == (
        recorded["ego_stationary"], recorded["humanlike"], recorded["severity"],
    )  # fmt: skip
    same = [name for name in recorded["references"] if verdict["references"][name] == recorded["references"][name]]
    assert len(same) >= 4  # in the simulation other traffic reacts


def test_the_command_prints_a_line_a_run_and_counts(program: Program, runs: Runs) -> None:
    done = program.here("judge", runs["first"].folder)
    assert done.status == 0 and done.err == ""
    first, count = done.out.splitlines()
    assert str(runs["first"].folder) in first and "delta-v" in first
    assert count.startswith("idm: runs 1, valid before ")


def test_a_run_is_simulated_again_on_request(program: Program, runs: Runs) -> None:
    done = program.here("judge", runs["first"].folder, "--replay", "--json")
    assert done.status == 0, done.err
    (row,) = json.loads(done.out)["runs"]
    assert (row["how"], row["level"], row["simulated"]) == ("replay", runs["first"].outcome["outcome"]["level"], True)


def as_schema_1(folder: Path, runs: Runs, **changes: object) -> dict[str, Any]:
    """A run's folder as it was with schema 1; gives back what it held of schema 2."""
    shutil.copytree(runs["first"].folder, folder)
    new = json.loads((folder / "outcome.json").read_text(encoding="utf-8"))
    old = copy.deepcopy(new) | {"schema": 1, "verdict_version": 2} | changes
    verdict = old["outcome"]
    verdict |= dict.fromkeys(GONE_FROM_OUTCOME, 1.5)
    verdict["impact"] |= dict.fromkeys(GONE_FROM_IMPACT, 3.0)
    for attempt in old["attempts"]:
        attempt |= dict.fromkeys(GONE_FROM_ATTEMPTS, 1.0)
    (folder / "outcome.json").write_text(json.dumps(old), encoding="utf-8")
    return dict(new)


def test_a_run_of_schema_1_is_rewritten_once(program: Program, runs: Runs, tmp_path: Path) -> None:
    new = as_schema_1(tmp_path / "old", runs)
    done = program.here("judge", tmp_path / "old")
    assert done.status == 0 and done.err == ""
    assert json.loads((tmp_path / "old" / "outcome.json").read_text(encoding="utf-8")) == new


def test_other_commands_say_how_to_bring_a_run_of_schema_1_up_to_date(
    program: Program, runs: Runs, tmp_path: Path
) -> None:
    folder = tmp_path / "old"
    as_schema_1(folder, runs)
    for command in (("report",), ("figure", "--out", "a.png"), ("export", "--format", "womd", "--out", "a"),
                    ("compare", folder)):  # fmt: skip
        done = program.here(*command, folder)
        assert done.status == 2
        assert (
            done.err
            == f"sumo-adv: {folder / 'outcome.json'} has schema 1: judge it again with 'sumo-adv judge {folder}'.\n"
        )


def test_a_run_without_levels_is_too_old(program: Program, runs: Runs, tmp_path: Path) -> None:
    as_schema_1(tmp_path / "old", runs, verdict_version=1)
    done = program.here("judge", tmp_path / "old")
    assert done.status == 1 and "was written before verdicts had levels: rerun it." in done.err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((), "Give folders of runs, or --cut-ins FILE"),
        (("nowhere",), "is not a folder"),
        (("--cut-ins", "nowhere.csv"), "cannot be read"),
        (("home", "--cut-ins", "nowhere.csv"), "not both"),
    ],
)
def test_what_cannot_be_judged_is_refused(program: Program, arguments: tuple[str, ...], says: str) -> None:
    done = program.here("judge", *arguments)
    assert done.status == 2 and says in done.err and len(done.err.splitlines()) == 1


# ---- cut-ins


def test_cut_ins_come_back_with_the_answers(program: Program) -> None:
    (program.folder / "cases.csv").write_text(HEAD + "50,50,10,1.0\n60,5,20,1.8\n50,30,55,1\n", encoding="utf-8")
    done = program.here("judge", "--cut-ins", "cases.csv", "--out", "answers.csv")
    assert done.status == 0, done.err
    with (program.folder / "answers.csv").open(newline="", encoding="utf-8") as text:
        rows = list(csv.DictReader(text))
    assert [row["unchanged"] for row in rows] == ["none", "front_to_rear", "front_to_rear"]
    assert [row["cc_human"] for row in rows] == ["none", "front_to_rear", "none"]
    assert "3 cut-ins into answers.csv" in done.out


@pytest.mark.parametrize(
    ("text", "says"),
    [("a,b\n1,2\n", "needs rows with the columns"), (HEAD + "50,fast,1,1\n", "not a number"),
     (HEAD + "50,40,-3,1\n", "a gap and a lateral speed above 0")],
)  # fmt: skip
def test_bad_cut_ins_are_refused(program: Program, text: str, says: str) -> None:
    (program.folder / "cases.csv").write_text(text, encoding="utf-8")
    done = program.here("judge", "--cut-ins", "cases.csv")
    assert done.status == 2 and says in done.err


# ---- a user's tracks


def test_a_user_s_tracks_are_judged() -> None:
    ego, foe = cruise("ego", 0, 0, 15), drift("adversary", 50, 3.2, 9, 2.0, 5.0, 0.0)
    verdict = sumo_adv.judge(columns(ego), columns(foe), trigger_time=1.0)
    assert verdict.contact_time == pytest.approx(7.5) and verdict.level is Level.SERIOUS
    both = {name: [*columns(ego)[name], *columns(foe)[name]] for name in ("time", "x", "y", "heading", "speed")}  # type: ignore[misc]
    both |= {
        "id": ["a"] * len(TIME) + ["b"] * len(TIME),
        "length": [5.0] * 2 * len(TIME),
        "width": [2.0] * 2 * len(TIME),
    }
    assert sumo_adv.judge("a", "b", both, trigger_time=1.0) == verdict


@pytest.mark.parametrize(
    ("change", "says"),
    [({"x": None}, "no column 'x'"), ({"y": [np.nan] * len(TIME)}, "not finite"), ({"time": [0, 1, 3]}, "one length"),
     ({"time": (TIME**1.1).tolist()}, "even steps")],
)  # fmt: skip
def test_bad_tracks_are_refused(change: dict[str, object], says: str) -> None:
    given = columns(cruise("ego", 0, 0, 15)) | change
    given = {name: value for name, value in given.items() if value is not None}
    with pytest.raises(UsageError, match=says):
        sumo_adv.judge(given, columns(cruise("adversary", 50, 0, 9)))


def test_an_id_that_is_not_in_the_table_is_named() -> None:
    table = columns(cruise("ego", 0, 0, 15)) | {"id": ["a"] * len(TIME)}
    with pytest.raises(UsageError, match="no vehicle 'b'"):
        sumo_adv.judge("a", "b", table)


# ---- levels and fault


def test_strict_is_refused_against_the_driver_that_it_is_judged_by(program: Program) -> None:
    done = program.here("run", "motorway_cut_in_left", "--ego", "careful", "--until", "strict")
    assert done.status == 2 and "--until strict cannot be reached against the ego 'careful'" in done.err


def test_head_on_the_vehicle_that_left_its_side_is_at_fault() -> None:
    """Both meet head-on in one lane; once the adversary came over, once the ego. nuPlan blames the ego each time."""
    over = drift("adversary", 100, 3.2, -10, 2.0, 3.0, 0.0)
    foe = Track(
        "adversary", over.role, TIME, over.x, over.y, np.full(len(TIME), np.pi), np.full(len(TIME), 10.0),
        np.zeros(len(TIME)), 5.0, 2.0,
    )  # fmt: skip
    assert fault(cruise("ego", 0, 0, 10), foe, 4.75) == "adversary"
    assert nuplan_fault(cruise("ego", 0, 0, 10), foe, 4.75) == "ego"
    ego = drift("ego", 0, 0, 10, 2.0, 3.0, 3.2)
    assert fault(ego, cruise("adversary", 100, 3.2, 10, np.pi), 4.75) == "ego"


def test_a_vehicle_that_came_over_and_waits_there_is_at_fault() -> None:
    """The adversary comes 3.2 m over within 40 m and stops at x = 100 m, at 4 s, askew by 0.06 rad. The front of the
    ego reaches the adversary's, at 97.5 m, after 9.5 s at 10 m/s."""
    u = np.clip(TIME / 4.0, 0.0, 1.0)
    x, y = 140.0 - 40.0 * (1 - (1 - u) ** 2), 3.2 * (1 - u**2 * (3 - 2 * u))
    stopped = car("adversary", x, y, 20.0 * (1 - u), np.pi + 0.06)
    assert fault(cruise("ego", 0.0, 0.0, 10.0), stopped, 9.5) == "adversary"


@pytest.mark.parametrize("speed", [0.0, 4.0])
def test_a_slow_ego_in_its_lane_is_not_at_fault_for_a_vehicle_that_comes_over(speed: float) -> None:
    """The adversary drives at 10 m/s from x = 60 m and comes 3.2 m over from 1.1 s to 4.1 s. The boxes of 5 m meet
    after (60 - 5) / (10 + speed) s: 5.5 s if the ego stands, 3.93 s at 4 m/s, when it has driven 16 m."""
    y = drift("adversary", 0, 3.2, 10, 1.1, 3.0, 0.0).y
    heading = np.unwrap(np.arctan2(np.gradient(y, TIME), np.full(len(TIME), -10.0)))
    over = car("adversary", 60.0 - 10.0 * TIME, y, 10.0, heading)
    assert fault(cruise("ego", 0.0, 0.0, speed), over, 55.0 / (10.0 + speed)) == "adversary"


def test_a_vehicle_that_turned_across_from_a_side_road_is_at_fault() -> None:
    """The adversary comes from the south and turns left into the ego's lane, on a radius of 10 m. It has turned after
    4.07 s at x = 47.5 m, and the fronts meet at 4.15 s and about 44.1 m: 41.5 + 2.5 m, and 46.7 - 2.5 m."""
    angle = np.clip((TIME - 2.5) * 1.0, 0.0, np.pi / 2)
    s = np.maximum(TIME - 2.5 - np.pi / 2, 0.0) * 10.0
    x, y = 57.5 - 10.0 * (1 - np.cos(angle)) - s, -10.0 + 10.0 * np.sin(angle) + np.minimum(TIME - 2.5, 0.0) * 10.0
    assert fault(cruise("ego", 0.0, 0.0, 10.0), car("adversary", x, y, 10.0, np.pi / 2 + angle), 4.15) == "adversary"


@pytest.mark.parametrize(("who", "shift"), [("adversary", (0.0, -3.2)), ("ego", (3.2, 0.0))])
def test_in_a_bend_the_vehicle_that_kept_its_lane_is_not_at_fault(who: str, shift: tuple[float, float]) -> None:
    """Radius 100 m to the left, lanes 3.2 m apart. The ego drives at 15 m/s, the other towards it at 5 m/s, and they
    meet at 6 s; one of them comes over within the last 2 s."""
    since = np.clip((TIME - 4.0) / 2.0, 0.0, 1.0)
    tracks = []
    for name, lane, speed, over in (("ego", 100.0, 15.0, -shift[0]), ("adversary", 96.8, -5.0, -shift[1])):
        angle, radius = speed / 100.0 * (TIME - 6.0), lane + over * since
        x, y = radius * np.sin(angle), -radius * np.cos(angle)
        tracks.append(car(name, x, y, abs(speed), np.unwrap(angle + (np.pi if speed < 0 else 0.0))))
    assert fault(*tracks, 6.0) == who
