"""``keep`` and ``regress``: the contents of a case, its outcome against other drivers, and refusals."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import tomllib
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_samples import ROOT, Done, Program, files_of, without_progress
from metrics_tracks import cruise
from regression_samples import FOUND, LOOPS, answers_of, attacked, results, suite_in

from sumo_adv.errors import UsageError
from sumo_adv.files import toml_lines
from sumo_adv.metrics.contact import first_other_contact
from sumo_adv.regression.case import Expectation, KeptCase, read_case, read_suite
from sumo_adv.regression.keep import keep_run
from sumo_adv.regression.runner import CaseMeasurements, CaseResult, JudgedCase, judged
from sumo_adv.regression.suite import SuiteRun, junit, lines
from sumo_adv.simulation.inputs import load_input

CALM = CaseMeasurements("one", "mine", min_ttc=2.0)
HIT = CaseMeasurements("one", "mine", level="strict", collided=True, min_ttc=0.0, delta_v=3.0)


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A suite of one case."""
    return suite_in(tmp_path_factory.mktemp("kept"))


def case_of(suite: Path, **expect: Any) -> KeptCase:
    (case,) = read_suite(suite)
    return KeptCase(case.name, case.folder, case.run_input, case.proposal, case.relations, Expectation(**expect))


def regress(program: Program, suite: Path, *options: str | Path) -> Done:
    return program.here("regress", suite, "--workers", "1", "--out", "out", *options)


# -- what is expected of the ego


@pytest.mark.parametrize(
    ("expect", "measured", "result"),
    [
        ({"avoid": "collision"}, HIT, CaseResult.FAIL),
        ({"avoid": "serious"}, HIT, CaseResult.PASS),  # strict is below serious
        ({"avoid": "collision"}, CALM, CaseResult.PASS),
        ({"min_ttc": 1.5}, CALM, CaseResult.PASS),
        ({"min_ttc": 2.0}, CALM, CaseResult.FAIL),  # it must stay above
        ({"avoid": "collision", "min_ttc": 3.0}, CALM, CaseResult.FAIL),  # both must hold
        ({"min_ttc": 1.5}, CaseMeasurements("one", "mine"), CaseResult.PASS),  # never
    ],
)  # fmt: skip
def test_an_expectation_is_met_or_not(suite: Path, expect: Any, measured: CaseMeasurements, result: CaseResult) -> None:
    assert judged(case_of(suite, **expect), measured, None).result is result


def test_a_failed_case_says_whose_fault_it_is_and_whether_the_contact_is_a_near_touch(suite: Path) -> None:
    case = case_of(suite, avoid="collision")

    def why(**more: Any) -> str:
        return judged(case, CaseMeasurements("one", "mine", level="valid", collided=True, **more), None).why

    below = "; it must stay below collision."
    assert why(delta_v=3.0, fault="ego") == f"The attack reaches valid (fault: ego){below}"
    assert why(delta_v=0.4, fault="adversary") == f"The attack reaches valid (a near-touch, fault: adversary){below}"
    # hitting a pedestrian never is negligible, however little it slows a car
    assert why(delta_v=0.1, impact_speed=5.0, fault="ego") == f"The attack reaches valid (fault: ego){below}"


def test_what_says_nothing_about_the_ego_has_a_result_of_its_own(suite: Path) -> None:
    case = case_of(suite, avoid="collision")
    behind = CaseMeasurements("one", "mine", collided=True, rear_end=True, min_ttc=0.0)
    assert judged(case, behind, None).result is CaseResult.PASS
    assert "ego's back" in judged(case, behind, None).why
    flown = CaseMeasurements("one", "mine", collided=True, failed_gates=("off_road",), min_ttc=0.0)
    assert judged(case, flown, None).result is CaseResult.INVALID
    over = CaseMeasurements("one", "mine", failed_gates=("off_road",), min_ttc=0.2)  # near, and as no car can drive
    assert judged(case_of(suite, avoid="critical"), over, None).result is CaseResult.INVALID
    assert judged(case_of(suite, min_ttc=1.0), over, None).result is CaseResult.INVALID
    assert judged(case, over, None).result is CaseResult.PASS  # whatever the adversary did, there was no contact
    assert judged(case, CaseMeasurements("one", "mine", planner="It loops."), None).result is CaseResult.INVALID
    assert (
        judged(case, CaseMeasurements("one", "mine", broken="Gone.", missed=True), None).result
        is CaseResult.NO_ENCOUNTER
    )
    assert judged(case, CaseMeasurements("one", "mine", broken="It raised."), None).result is CaseResult.ERROR
    swerved = CaseMeasurements("one", "mine", touched="parked0")
    assert judged(case, swerved, None) == JudgedCase(swerved, CaseResult.FAIL, "The ego ran into parked0.")


def test_no_worse_than_a_baseline_allows_for_a_step_of_ttc_and_a_mile_an_hour(suite: Path) -> None:
    case = case_of(suite, no_worse=True)

    def hit(delta_v: float) -> CaseMeasurements:
        return CaseMeasurements("one", "mine", level="strict", collided=True, min_ttc=0.0, delta_v=delta_v)

    def near(min_ttc: float | None) -> CaseMeasurements:
        return CaseMeasurements("one", "mine", min_ttc=min_ttc)

    def result(now: CaseMeasurements, before: CaseMeasurements) -> CaseResult:
        return judged(case, now, before).result

    assert result(HIT, CALM) is CaseResult.FAIL  # hit now, not before
    assert result(CALM, HIT) is CaseResult.PASS
    assert (result(hit(3.4), HIT), result(hit(3.5), HIT)) == (
        CaseResult.PASS,
        CaseResult.FAIL,
    )  # 0.4 and 0.5 m/s harder
    assert (result(near(1.95), CALM), result(near(1.85), CALM)) == (CaseResult.PASS, CaseResult.FAIL)
    assert result(near(4.5), near(None)) is CaseResult.PASS  # above 4 s nothing is compared
    flown = CaseMeasurements("one", "mine", collided=True, failed_gates=("off_road",), min_ttc=0.0, delta_v=6.0)
    assert result(HIT, flown) is CaseResult.FAIL  # the baseline was hit by an impossible adversary
    missed = CaseMeasurements("one", "mine", broken="Gone.", missed=True)
    assert (result(HIT, missed), result(CALM, missed)) == (CaseResult.FAIL, CaseResult.PASS)


def test_the_ego_touches_a_third_vehicle_unless_that_runs_into_its_back() -> None:
    ego = cruise("ego", 0.0, 0.0, 10.0)
    ahead, behind = cruise("ahead", 20.0, 0.0, 2.0), cruise("behind", -20.0, 0.0, 18.0)
    gap, closing = 20.0 - (ego.length + ahead.length) / 2, 8.0
    touched = first_other_contact(ego, [behind, ahead], 0.0)
    assert touched is not None and touched[0] == "ahead" and touched[1] == pytest.approx(gap / closing, abs=1e-6)
    assert first_other_contact(ego, [behind], 0.0) is None
    assert first_other_contact(ego, [cruise("apart", 0.0, 5.0, 10.0)], 0.0) is None
    assert first_other_contact(ego, [cruise("inside", 1.0, 0.0, 10.0)], 0.0) is None  # an error of a log


# -- what a case holds


def test_a_case_is_text_without_any_path_of_this_machine(suite: Path) -> None:
    folder = suite / "crossing"
    assert set(files_of(suite)) == {
        f"crossing/{name}" for name in ("case.toml", "scenario.toml", "planner.py", f"{FOUND}.rou.xml")
    }
    for name, content in files_of(folder).items():
        assert not re.search(r"(^|[\"' ])/\w", content.decode().split("<routes", 1)[0]), name
    assert 'network = "priority_crossing"' in (folder / "scenario.toml").read_text()  # shipped: by its name
    assert load_input(folder / "scenario.toml").network.parent == ROOT / "networks"


def test_a_case_moves_with_its_suite(suite: Path, tmp_path: Path) -> None:
    shutil.copytree(suite, tmp_path / "elsewhere")
    here, there = read_case(suite / "crossing"), read_case(tmp_path / "elsewhere" / "crossing")
    assert here.proposal == there.proposal and here.settings == there.settings
    assert there.run_input.routes == (tmp_path / "elsewhere" / "crossing" / f"{FOUND}.rou.xml",)


def test_an_attack_is_kept_once_and_its_expectation_may_be_edited(tmp_path: Path) -> None:
    suite = suite_in(tmp_path)
    file = suite / "crossing" / "case.toml"
    file.write_text(file.read_text().replace('avoid = "collision"', "min_ttc = 1.5"))
    edited = files_of(suite)
    folder, new = keep_run(attacked(), suite, Expectation(avoid="collision"), "crossing")
    assert (folder, new, files_of(suite)) == (suite / "crossing", False, edited)
    assert read_case(folder).expect == Expectation(min_ttc=1.5)


def test_a_network_of_ones_own_is_copied_once(tmp_path: Path) -> None:
    network = tmp_path / "town.net.xml"
    network.write_text((ROOT / "networks" / "priority_crossing.net.xml").read_text() + "<!-- mine -->\n")
    own = tmp_path / "run"
    shutil.copytree(attacked(), own)
    manifest = json.loads((own / "manifest.json").read_text())
    (own / "inputs" / manifest["network"]).unlink()
    manifest["network"] = f"{hashlib.sha256(network.read_bytes()).hexdigest()[:12]}-town.net.xml"
    shutil.copy(network, own / "inputs" / manifest["network"])
    (own / "manifest.json").write_text(json.dumps(manifest))
    for name in ("one", "two"):
        keep_run(own, tmp_path / "suite", Expectation(avoid="collision"), name)
    assert [p.name for p in (tmp_path / "suite" / "networks").iterdir()] == ["town.net.xml"]
    case = read_case(tmp_path / "suite" / "one")
    assert case.run_input.network.resolve() == (tmp_path / "suite" / "networks" / "town.net.xml").resolve()
    assert case.notes == ()
    network = tmp_path / "suite" / "networks" / "town.net.xml"
    network.write_text(network.read_text() + "<!-- another -->\n")
    assert "town.net.xml is not the one" in read_case(tmp_path / "suite" / "one").notes[0]


def test_a_case_keeps_the_options_of_the_simulation_that_it_was_found_in(tmp_path: Path) -> None:
    """A .sumocfg with a speed deviation of SUMO's own and half the demand; the other options are those of a network."""
    assert (
        "sumo_options"
        not in read_case(keep_run(attacked(), tmp_path / "suite", Expectation(avoid="collision"), "plain")[0]).settings
    )
    own = tmp_path / "run"
    shutil.copytree(attacked(), own)
    manifest = json.loads((own / "manifest.json").read_text())
    del manifest["sumo_options"]["default.speeddev"]
    manifest["sumo_options"]["scale"] = "0.5"
    (own / "manifest.json").write_text(json.dumps(manifest))
    case = read_case(keep_run(own, tmp_path / "suite", Expectation(avoid="collision"), "own")[0])
    assert case.settings["sumo_options"] == {"default.speeddev": "-1", "scale": "0.5"}


# -- the commands


def test_the_driver_of_the_run_meets_the_attack_as_it_was_found(program: Program, suite: Path) -> None:
    original = json.loads((attacked() / "outcome.json").read_text())["outcome"]
    done = regress(program, suite, "--ego", "idm", "--junit", "out.xml")
    assert (done.status, without_progress(done.err)) == (3, "")
    assert "1 case of suite against idm: 0 pass, 1 fail." in done.out
    (case,) = results(program.folder / "out")
    assert (case["result"], case["level"]) == ("fail", original["level"])
    assert [case[key] for key in ("contact_time", "delta_v", "preventable_by")] == [
        original[key] for key in ("contact_time", "delta_v", "preventable_by")
    ]
    again = program.here("run", "--replay", "out/runs/crossing", "--out", "again", "--json")
    assert json.loads(again.out)["outcome"]["contact_time"] == original["contact_time"]
    (test,) = ElementTree.parse(program.folder / "out.xml").iter("testcase")
    assert test.find("failure") is not None and test.get("name") == "crossing"


def test_an_ego_that_looks_around_passes_and_is_compared_with_the_baseline(program: Program, tmp_path: Path) -> None:
    suite = suite_in(program.folder, expect=Expectation(no_worse=True))
    lacking = regress(program, suite, "--ego", "careful")
    assert (lacking.status, lacking.err.count("\n")) == (2, 1) and "give --baseline FILE" in lacking.err
    baseline = {"schema": 1, "cases": [{"case": "crossing", "ego": "idm", "collided": True, "level": "serious"}]}
    (program.folder / "before.json").write_text(json.dumps(baseline))
    done = regress(program, suite, "--ego", "careful", "--baseline", "before.json")
    assert (done.status, without_progress(done.err)) == (0, "")
    assert "baseline" in done.out.splitlines()[0] and "serious" in done.out.splitlines()[1]


def test_a_case_repeated_on_any_number_of_processes_gives_one_answer(program: Program) -> None:
    answers = answers_of(program, 2)  # more of them: tests/soak/test_soak_regress.py
    assert (sum(answers.values()), len(answers)) == (2, 1)


def test_an_ego_that_never_comes_there_has_had_no_encounter(program: Program, suite: Path) -> None:
    missed = regress(program, suite, "--ego", "regression_samples:StandingEgo", "--junit", "out.xml")
    assert missed.status == 3 and "no encounter" in missed.out.splitlines()[1]
    assert results(program.folder / "out")[0]["missed"] is True
    allowed = ("--allow-untested", "--force", "--junit", "out.xml")
    assert regress(program, suite, "--ego", "regression_samples:StandingEgo", *allowed).status == 0
    (test,) = ElementTree.parse(program.folder / "out.xml").iter("testcase")
    assert test.find("skipped") is not None


def test_a_driver_that_breaks_is_an_error_of_its_case(program: Program, suite: Path) -> None:
    done = regress(program, suite, "--ego", "regression_samples:BrokenEgo", "--junit", "out.xml")
    assert (done.status, without_progress(done.err)) == (3, "")
    assert "the driver fell asleep" in done.out
    (test,) = ElementTree.parse(program.folder / "out.xml").iter("testcase")
    assert test.find("error") is not None


def test_a_driver_that_breaks_in_the_attack_is_an_error_and_no_case_that_was_not_reached(
    program: Program, suite: Path
) -> None:
    done = regress(program, suite, "--ego", "regression_samples:BreakingDownEgo", "--allow-untested")
    assert done.status == 3 and "0 pass, 1 error." in done.out and "the driver lost its head" in done.out


def test_a_hostile_planner_stays_in_the_sandbox(program: Program) -> None:
    suite = suite_in(program.folder)
    (suite / "crossing" / "planner.py").write_text(LOOPS)
    file = suite / "crossing" / "case.toml"
    file.write_text(re.sub(r"(?s)\[attack.parameters\].*?\n\n", "[attack.parameters]\n\n", file.read_text()))
    done = regress(program, suite, "--ego", "idm")
    assert done.status == 3 and "invalid" in done.out and "planner failed" in done.out


def test_keep_takes_what_reached_a_level_from_a_folder_of_runs(program: Program) -> None:
    shutil.copytree(attacked(), program.folder / "runs" / "first")
    kept = program.here("keep", "runs", "--suite", "suite")
    assert (kept.status, without_progress(kept.err)) == (0, "")
    assert kept.out.splitlines() == [f"Kept suite/{FOUND}-0 from first", "1 case into suite."]
    again = json.loads(program.here("keep", "runs", "--suite", "suite", "--json").out)
    assert again == {
        "suite": "suite", "kept": [], "there_already": [f"suite/{FOUND}-0"], "left_out": [], "not_passed": []
    }  # fmt: skip


# -- what is refused


def edited(suite: Path, old: str, new: str) -> None:
    file = suite / "crossing" / "case.toml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('avoid = "collision"', 'avoid = "everything"', "bad 'expect.avoid'"),
        ('avoid = "collision"', "avoided = 1", "unknown key 'expect.avoided'"),
        ('avoid = "collision"', "", "give avoid, min_ttc or no_worse"),
        ("delay = ", "later = ", "unknown key 'attack.later'|lacks the key 'attack.delay'"),
        ("[settings]", "[settings]\nbubblewrap = false", "sets 'bubblewrap', which a case does not"),
        ("[attack.parameters]", "[attack.parameters]\nwings = 2.0", "parameter 'wings'"),
        ("schema = 1", "schema = 9", "bad 'schema'"),
        ('adversary = "', 'adversary = "x', "only candidate 'x"),
    ],
)  # fmt: skip
def test_a_damaged_case_is_one_sentence_with_its_file(tmp_path: Path, old: str, new: str, said: str) -> None:
    suite = suite_in(tmp_path)
    edited(suite, old, new)
    with pytest.raises(UsageError, match=said):
        read_suite(suite)


def test_a_path_may_have_a_colon(tmp_path: Path, caches: Path) -> None:
    """SUMO would read the path of a state file as HOST:PORT. The temporary folder is below the path, too."""
    program = Program(tmp_path / "host:port", caches)
    done = program.here("regress", suite_in(program.folder), "--ego", "blind", "--out", "x:ne", "--workers", "1")
    assert (done.status, without_progress(done.err)) == (3, "")
    (case,) = results(program.folder / "x:ne")
    assert (case["result"], case["broken"]) == ("fail", "")  # a driver that sees nobody is hit


def test_bad_input_is_refused_before_anything_runs(program: Program, suite: Path) -> None:
    cases = {
        "There is no folder nowhere.": ("regress", "nowhere", "--ego", "idm"),
        "holds no case": ("regress", ".", "--ego", "idm"),
        "no ego 'idmm'": ("regress", suite, "--ego", "idmm"),
        "not what sumo-adv regress writes": ("regress", suite, "--ego", "idm", "--baseline", "no.json"),
        "is not a folder": ("keep", "nowhere", "--suite", "s"),
    }
    for message, command in cases.items():
        done = program.here(*command)
        assert (done.status, done.err.count("\n")) == (2, 1) and message in done.err, done.err
    assert program.leftovers() == []


def test_junit_holds_any_text(suite: Path) -> None:
    hostile = "a \x00 b <&> \"'"
    run = SuiteRun(
        "s", "mine", [JudgedCase(CaseMeasurements("c<1>", "mine", broken=hostile), CaseResult.ERROR, hostile)]
    )
    (test,) = ElementTree.fromstring(junit(run, allow_untested=False)).iter("testcase")
    error = test.find("error")
    assert test.get("name") == "c<1>" and error is not None
    assert error.get("message") == "a \ufffd b <&> \"'"


def test_a_failing_case_says_why_in_the_table_and_in_junit() -> None:
    """A case that passes has nothing to explain, and an ego that ran into another vehicle another fault."""
    late = CaseMeasurements("one", "mine", level="strict", cause="late", cause_sentence="Your driver was late.")
    cases = [
        JudgedCase(late, CaseResult.FAIL, "It is hit."), JudgedCase(late, CaseResult.PASS, ""),
        JudgedCase(replace(late, touched="wall"), CaseResult.FAIL, "The ego ran into wall."),
    ]  # fmt: skip
    assert [case.sentence for case in cases] == ["It is hit. Your driver was late.", "", "The ego ran into wall."]
    run = SuiteRun("s", "mine", cases[:1])
    (failure,) = ElementTree.fromstring(junit(run, allow_untested=False)).iter("failure")
    assert failure.get("message") == "It is hit. Your driver was late."
    assert lines(run)[1].endswith("It is hit. Your driver was late.")
    assert (cases[0].row()["cause"], cases[0].row()["cause_sentence"]) == ("late", "Your driver was late.")


def test_toml_is_written_as_it_is_read() -> None:
    table = {"text": 'a "b" \\ \n \x7f é', "truth": True, "number": 1e-9, "list": [1, [2.5, 3.0]], "none": None}
    read = tomllib.loads("\n".join(toml_lines({**table, "inline": {"odd key": 1.0}})))
    assert read == {k: v for k, v in table.items() if v is not None} | {"inline": {"odd key": 1.0}}
    assert np.isinf(tomllib.loads("\n".join(toml_lines({"never": float("inf")})))["never"])
