"""Plans: the product of their lists, ids made of content, what is refused, what differs; the table; packs; lessons."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from cli_samples import ROOT, TRAIL, files_of

from sumo_adv.app import batch_parts
from sumo_adv.campaigns.plan import CampaignPlan, is_plan, make_plan, plan_differences, read_plan
from sumo_adv.campaigns.results import RESULT_COLUMNS, EpisodeJob, result_row, results_table, write_csv, write_failure
from sumo_adv.campaigns.store import open_store, pack_runs, packed_rows, packed_texts, unpack_runs
from sumo_adv.campaigns.worker import (
    Collector,
    CompositionLesson,
    Lesson,
    as_text,
    lessons_of,
    share,
    teach,
)
from sumo_adv.datatypes import Duty
from sumo_adv.errors import UsageError
from sumo_adv.memory.bank import MemoryBank, compositions
from sumo_adv.memory.records import Composition, Evidence, IntentRecord, Part, SceneSignature
from sumo_adv.planners.text import make_planner
from sumo_adv.report.staging import staged
from sumo_adv.womd.reader import choice_of, find_record

SCENARIOS = ROOT / "scenarios"


def plan_of(folder: Path = ROOT, **table: Any) -> CampaignPlan:
    return make_plan(table, folder, "The plan", batch_parts())


# -- the product


@pytest.mark.parametrize("here", [".", ""])
def test_the_folder_of_the_plan_can_be_an_input(tmp_path: Path, here: str) -> None:
    with pytest.raises(UsageError, match=r"holds no scenario, \.sumocfg or network\.$"):
        plan_of(tmp_path, inputs=[here])
    shutil.copy(SCENARIOS / "leader_two_lanes.toml", tmp_path / "mine.toml")
    assert [job.input.path for job in plan_of(tmp_path, inputs=[here]).jobs] == [tmp_path / "mine.toml"]


def test_the_product_is_in_the_order_of_the_lists() -> None:
    plan = plan_of(
        inputs=["motorway_cut_in_left", "leader_two_lanes"], egos=["idm", "krauss"], seeds=2,
        vary={"attempts": [1, 5]},
    )  # fmt: skip
    combinations = [(j.input.name, j.ego, plan.varied[j.variant]["attempts"], j.seed) for j in plan.jobs]
    assert len(combinations) == len({j.id for j in plan.jobs}) == plan.size == 16
    assert combinations[:5] == [
        ("motorway_cut_in_left", "idm", 1, 0), ("motorway_cut_in_left", "idm", 1, 1),
        ("motorway_cut_in_left", "idm", 5, 0), ("motorway_cut_in_left", "idm", 5, 1),
        ("motorway_cut_in_left", "krauss", 1, 0),
    ]  # fmt: skip
    assert combinations[8][0] == "leader_two_lanes"


def test_patterns_folders_and_paths_count_from_the_plan(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "networks", tmp_path / "nets", ignore=shutil.ignore_patterns("src", "*.py"))
    nets = len(list((tmp_path / "nets").glob("*.net.xml")))
    assert len(plan_of(tmp_path, inputs=["nets/*.net.xml"]).jobs) == nets
    assert len(plan_of(tmp_path, inputs=["nets"]).jobs) == nets
    assert [j.input.name for j in plan_of(tmp_path, inputs=["nets/motorway.net.xml"]).jobs] == ["motorway"]
    with pytest.raises(UsageError, match=r"Nothing matches 'nets/\*\.toml'"):
        plan_of(tmp_path, inputs=["nets/*.toml"])


def test_an_id_is_made_of_content_and_not_of_places(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "networks", tmp_path / "a")
    shutil.copytree(ROOT / "networks", tmp_path / "b")
    (tmp_path / "b" / "motorway.net.xml").rename(tmp_path / "b" / "other.net.xml")
    here = plan_of(tmp_path, inputs=["a/motorway.net.xml"]).jobs
    there = plan_of(tmp_path, inputs=["b/other.net.xml"]).jobs
    assert [j.id for j in here] == [j.id for j in there]
    text = (tmp_path / "b" / "other.net.xml").read_text(encoding="utf-8")
    (tmp_path / "b" / "other.net.xml").write_text(text + "\n", encoding="utf-8")
    assert [j.id for j in plan_of(tmp_path, inputs=["b/other.net.xml"]).jobs] != [j.id for j in here]
    assert len(plan_of(tmp_path, inputs=["a/motorway.net.xml", "a/*motorway*"]).jobs) == 1  # the same twice


def test_an_id_hangs_on_all_that_shapes_an_episode_and_on_nothing_else() -> None:
    base = {"inputs": ["motorway_cut_in_left"]}
    ids = [
        plan_of(**base, **more).jobs[0].id
        for more in (
            {}, {"seeds": [1]}, {"egos": ["idm"]}, {"settings": {"attempts": 3}}, {"settings": {"recall": "scene"}},
        )
    ]  # fmt: skip
    assert len(set(ids)) == 5
    same = ({"learn": "after"}, {"memory": "x.sqlite"}, {"figures": True}, {"settings": {"attempts": 400}})
    assert {plan_of(**base, **more).jobs[0].id for more in same} == {ids[0]}


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ({"inputs": ["motorway"], "sedes": 3}, "unknown key 'sedes'; known keys are schema, inputs"),
        ({"seeds": 3}, "lacks the key 'inputs'"),
        ({"inputs": []}, "bad 'inputs'"),
        ({"inputs": ["motorway"], "seeds": 0}, "bad 'seeds"),
        ({"inputs": ["motorway"], "seeds": [-1]}, "bad 'seeds"),
        ({"inputs": ["motorway"], "learn": "always"}, "bad 'learn'"),
        ({"inputs": ["motorway"], "schema": 2}, "bad 'schema'"),
        ({"inputs": ["motorway"], "settings": {"atempts": 3}}, "'atempts'"),
        ({"inputs": ["motorway"], "vary": {"atempts": [3]}}, "'atempts'"),
        ({"inputs": ["motorway"], "vary": {"attempts": []}}, "bad 'vary.attempts'"),
        ({"inputs": ["motorway"], "settings": {"ego": "idm"}}, "in a plan, write 'egos' instead"),
        ({"inputs": ["motorway"], "vary": {"seed": [1]}}, "in a plan, write 'seeds' instead"),
        ({"inputs": ["motorway"], "settings": {"attempts": 3}, "vary": {"attempts": [1]}}, "keep one"),
    ],
)
def test_a_bad_plan_is_refused_by_name(table: dict[str, Any], says: str) -> None:
    with pytest.raises(UsageError) as refusal:
        plan_of(**table)
    assert says in str(refusal.value)


def test_plans_and_scenarios_are_told_apart(tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text('inputs = ["motorway"]\nmemory = "bank.sqlite"\n')
    assert is_plan(plan) and not is_plan(SCENARIOS / "leader_two_lanes.toml") and not is_plan(tmp_path)
    assert read_plan(plan)["memory"] == str(tmp_path / "bank.sqlite")
    plan.write_text("inputs = [\n")
    with pytest.raises(UsageError, match="is not valid TOML"):
        read_plan(plan)


def test_a_broken_input_is_an_episode_that_cannot_be_run(tmp_path: Path) -> None:
    (tmp_path / "bad.tfrecord").write_bytes(b"\x05" * 40)
    (tmp_path / "cut.net.xml").write_text("<net>")
    jobs = plan_of(tmp_path, inputs=["cut.net.xml", "motorway", "bad.tfrecord"], seeds=2).jobs
    assert [bool(j.input.error) for j in jobs] == [True, True, False, False, True, True]
    assert "cut.net.xml is not valid XML" in jobs[0].input.error and "bad.tfrecord" in jobs[4].input.error
    assert len({j.id for j in jobs}) == 6


def test_waymo_records_are_inputs_by_their_ids(tmp_path: Path) -> None:
    womd_samples = pytest.importorskip("womd_samples")
    file = womd_samples.write(tmp_path / "two.tfrecord", womd_samples.straight("one"), womd_samples.straight("two"))
    assert [(j.input.name, j.input.record) for j in plan_of(inputs=[str(file)]).jobs] == [("one",) * 2, ("two",) * 2]
    assert [j.input.name for j in plan_of(inputs=[str(file)], records=[1]).jobs] == ["two"]
    with pytest.raises(UsageError, match="No record 'three' that can be read"):
        plan_of(inputs=[str(file)], records=["one", "three"])


def test_a_record_is_found_past_one_that_cannot_be_read(tmp_path: Path) -> None:
    womd_samples = pytest.importorskip("womd_samples")
    file = womd_samples.write(tmp_path / "two.tfrecord", womd_samples.straight("one"), womd_samples.straight("two"))
    file.write_bytes(womd_samples.frame(b"no scenario") + file.read_bytes())
    plan = plan_of(inputs=[str(file)])
    assert [(j.input.name, bool(j.input.error)) for j in plan.jobs] == [
        ("two[0]", True),
        ("one", False),
        ("two", False),
    ]
    assert find_record(file, choice_of("two")).scenario_id == "two"
    with pytest.raises(UsageError, match=r"no record 'three' among its 3 that can be read\. Record 0 of .* is no"):
        find_record(file, choice_of("three"))


# -- what differs


def test_two_plans_differ_in_words(tmp_path: Path) -> None:
    before = plan_of(inputs=["motorway", "two_way"], seeds=3)
    after = plan_of(inputs=["motorway", "curved_road"], seeds=[0, 1], egos=["idm"], settings={"attempts": 3})
    changes, common = plan_differences(before.as_dict(), after.as_dict())
    assert changes == [
        "inputs no longer there: two_way", "inputs new: curved_road", "egos were as the input says, now idm",
        "seeds were 0, 1, 2, now 0, 1", "settings changed: attempts",
    ]  # fmt: skip
    assert common == []
    versions = {"versions": {"sumo_adv": "0"}}, {"versions": {"sumo_adv": "1"}}
    _, common = plan_differences(before.as_dict() | versions[0], before.as_dict() | versions[1])
    assert common == ["versions: sumo_adv 0 then, sumo_adv 1 now"]


def test_an_input_that_was_mended_is_no_other_plan(tmp_path: Path) -> None:
    (tmp_path / "late.net.xml").write_text("<net>")
    before = plan_of(tmp_path, inputs=["late.net.xml", "motorway"]).as_dict()
    shutil.copy(ROOT / "networks" / "two_way.net.xml", tmp_path / "late.net.xml")
    after = plan_of(tmp_path, inputs=["late.net.xml", "motorway"]).as_dict()
    assert plan_differences(before, after) == ([], [])
    assert plan_differences(after, before)[0] == ["inputs changed: late"]


# -- rows and folders


def job(name: str) -> EpisodeJob:
    given = plan_of(inputs=["motorway"]).inputs[0]
    return EpisodeJob(name, given, "idm", 0, 0)


def test_a_failure_has_a_row_and_its_traceback(tmp_path: Path) -> None:
    row = write_failure(tmp_path, job("ab"), "It hung.", "Traceback ...")
    assert (row["ending"], row["failure"], row["critical"]) == ("simulation_failed", "It hung.", None)
    assert row["traceback"] == "runs/ab/traceback.txt"
    outcome = json.loads((tmp_path / "outcome.json").read_text(encoding="utf-8"))
    assert result_row("ab", outcome, True) == row
    assert (tmp_path / "traceback.txt").read_text() == "Traceback ..."


def test_the_table_is_in_the_plans_order_and_never_is_empty(tmp_path: Path) -> None:
    jobs = [job("b"), job("a"), job("c")]
    rows = {name: write_failure(tmp_path, job(name), "x", "") for name in ("a", "b")}
    write_csv(tmp_path / "results.csv", results_table(jobs, rows, [{"attempts": 3}]), ["attempts"])
    with (tmp_path / "results.csv").open(newline="") as file:
        written = list(csv.DictReader(file))
    assert [r["id"] for r in written] == ["b", "a"]
    assert list(written[0]) == [*RESULT_COLUMNS, "set_attempts"]
    assert (written[0]["min_ttc"], written[0]["attempts"], written[0]["set_attempts"]) == ("", "0", "3")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["outcome.json", "results.csv", "traceback.txt"]


def test_parquet_says_what_it_needs_or_holds_the_same(tmp_path: Path) -> None:
    from sumo_adv.campaigns.results import write_parquet

    table = results_table([job("a")], {"a": write_failure(tmp_path, job("a"), "x", "")}, [{"attempts": 3}])
    try:
        from pyarrow import parquet
    except ImportError:
        with pytest.raises(UsageError, match=r"pip install 'sumo-adv\[batch\]'"):
            write_parquet(tmp_path / "t.parquet", table, ["attempts"])
        return
    write_parquet(tmp_path / "t.parquet", table, ["attempts"])
    (row,) = parquet.read_table(tmp_path / "t.parquet").to_pylist()
    assert (row["id"], row["seed"], row["min_ttc"], row["set_attempts"]) == ("a", 0, None, "3")


def test_inputs_are_kept_once(tmp_path: Path) -> None:
    shared = tmp_path / "inputs"
    for run in ("a", "b"):
        (tmp_path / run).mkdir()
        (tmp_path / run / "123-net.xml").write_text("the same")
        share(tmp_path / run, shared)
    assert len({(tmp_path / run / "123-net.xml").stat().st_ino for run in ("a", "b", "inputs")}) == 1
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b") == {"123-net.xml": b"the same"}


def runs_in(folder: Path, names: str) -> dict[str, dict[str, bytes]]:
    """Finished runs as a batch leaves them, with a shared input; their files."""
    (folder / "runs").mkdir(parents=True)
    (folder / "plan.json").write_text("{}")
    for name in names:
        run = folder / "runs" / name
        (run / "inputs").mkdir(parents=True)
        write_failure(run, job(name), f"{name} failed", "because")
        (run / "learnt.json").write_text(f'["{name}"]')
        (run / "inputs" / "123-net.xml").write_text("road " * 1000)
        share(run / "inputs", folder / "inputs")
    return {name: files_of(folder / "runs" / name) for name in names}


def test_packs_give_back_what_they_got(tmp_path: Path) -> None:
    before = runs_in(tmp_path, "abcde")
    done = pack_runs(tmp_path, most=2)
    assert (done.runs, done.files) == (5, (20, 6))
    assert sorted(p.name for p in (tmp_path / "packs").iterdir()) == [
        "0000.json", "0000.zip", "0001.json", "0001.zip", "0002.json", "0002.zip",
    ]  # fmt: skip
    assert list((tmp_path / "runs").iterdir()) == [] and list((tmp_path / "inputs").iterdir()) == []
    assert set(packed_rows(tmp_path)) == set("abcde") and packed_rows(tmp_path)["c"]["failure"] == "c failed"
    assert packed_texts(tmp_path, "learnt.json")["b"] == '["b"]'
    assert [p.name for p in unpack_runs(tmp_path, ["d"], tmp_path / "one", staged)] == ["d"]
    unpack_runs(tmp_path, [], tmp_path / "all", staged)
    assert {name: files_of(tmp_path / "all" / name) for name in "abcde"} == before
    assert unpack_runs(tmp_path, [], tmp_path / "all", staged) == []  # they are there already
    assert pack_runs(tmp_path, most=2).runs == 0


def test_a_pack_that_was_broken_off_is_packed_again(tmp_path: Path) -> None:
    runs_in(tmp_path, "ab")
    kept = tmp_path / "kept"
    shutil.copytree(tmp_path / "runs" / "a", kept)
    pack_runs(tmp_path)
    shutil.copytree(kept, tmp_path / "runs" / "a")  # killed before it was removed
    (tmp_path / "packs" / "0001.zip").write_bytes(b"half")  # killed before its index was there
    assert pack_runs(tmp_path).runs == 0 and list((tmp_path / "runs").iterdir()) == []
    shutil.copytree(kept, tmp_path / "runs" / "z")
    assert pack_runs(tmp_path).runs == 1 and set(packed_rows(tmp_path)) == {"a", "b", "z"}


def test_a_run_that_was_made_again_goes_into_a_later_pack_which_counts(tmp_path: Path) -> None:
    """Run "a" is packed as a failure, is run again, and is packed again; "b" is only in the first pack.

    The packs have the numbers 9999 and 10000, whose names are not in the order of their letters.
    """
    runs_in(tmp_path, "ab")
    pack_runs(tmp_path)
    for ending in ("json", "zip"):
        (tmp_path / "packs" / f"0000.{ending}").rename(tmp_path / "packs" / f"9999.{ending}")
    run = tmp_path / "runs" / "a"
    run.mkdir()
    write_failure(run, job("a"), "a failed in another way", "because")
    assert pack_runs(tmp_path).runs == 1 and not run.exists()
    assert sorted(p.name for p in (tmp_path / "packs").glob("*.json")) == ["10000.json", "9999.json"]
    failures = {name: row["failure"] for name, row in packed_rows(tmp_path).items()}
    assert failures == {"a": "a failed in another way", "b": "b failed"}
    assert packed_texts(tmp_path, "learnt.json") == {"b": '["b"]'}  # the new run "a" learnt nothing
    unpack_runs(tmp_path, ["b", "a"], tmp_path / "all", staged)
    assert "in another way" in (tmp_path / "all" / "a" / "outcome.json").read_text()
    assert (tmp_path / "all" / "b" / "learnt.json").exists()


def test_only_numbered_files_are_packs_and_a_pack_stays_readable(tmp_path: Path) -> None:
    runs_in(tmp_path, "ab")
    with pytest.raises(UsageError, match="at most 10000 runs, not 10001; give a smaller --most"):
        pack_runs(tmp_path, most=10_001)
    pack_runs(tmp_path, most=10_000)
    (tmp_path / "packs" / ".0001.x7q2.json").write_text('{"schema": 1, "ru')  # killed while its index was written
    assert set(packed_rows(tmp_path)) == set(packed_texts(tmp_path, "outcome.json")) == {"a", "b"}
    assert len(unpack_runs(tmp_path, [], tmp_path / "all", staged)) == 2


def test_damaged_packs_are_a_sentence(tmp_path: Path) -> None:
    runs_in(tmp_path, "ab")
    pack_runs(tmp_path)
    with pytest.raises(UsageError, match=r"No pack .* holds the run x"):
        unpack_runs(tmp_path, ["x"], tmp_path / "all", staged)
    (tmp_path / "packs" / "0000.zip").write_bytes(b"not a zip")
    with pytest.raises(UsageError, match="missing or damaged"):
        unpack_runs(tmp_path, ["a"], tmp_path / "all", staged)
    (tmp_path / "packs" / "0000.json").write_text("{")
    with pytest.raises(UsageError, match=r"index .* damaged"):
        packed_rows(tmp_path)


def test_one_batch_at_a_time_and_no_other_folder(tmp_path: Path) -> None:
    with open_store(tmp_path / "out", staged) as (_, scratch):
        assert scratch.is_dir()
        with pytest.raises(UsageError, match="Another batch"), open_store(tmp_path / "out", staged):
            pass
    assert not (tmp_path / "out").exists()  # nothing was asked for
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "dog.png").touch()
    with pytest.raises(UsageError, match="something other than"), open_store(tmp_path / "photos", staged):
        pass
    assert [p.name for p in (tmp_path / "photos").iterdir()] == ["dog.png"]


# -- lessons


def lesson(seed: int, *, success: bool = True, source: str = TRAIL) -> Lesson:
    planner = make_planner("Odd Driving", "odd", source, "person")
    scene = SceneSignature("straight", "leader", {"ahead": 4.0}, "idm")
    evidence = Evidence(
        label="Odd Driving", planner_hash=planner.hash, scene=scene, attempts=1,
        min_ttc=0.5 if success else float("inf"), collided=False, critical=success, feasible=True, rear_end=False,
        valid=None, strict=None, version="0", network="n", seed=seed, parameters={"gap": 3.0},
        acceleration=((0.0, 1.0), (2.0, -1.0)),
    )  # fmt: skip
    return Lesson(evidence, IntentRecord("Odd Driving", "Drives in an odd way.", ("leader",)), planner)


PARTS = (Part(Duty.COLLIDER, "Odd Driving", "odd"), Part(Duty.SLOW, "Slow Leader", "pace"))
ODD_PAIR = Composition("Odd Pair", "One vehicle slows down and the other drives in an odd way.", PARTS)


def test_lessons_survive_as_text() -> None:
    lessons = [
        lesson(0),
        lesson(1, success=False),
        Lesson(lesson(2).evidence, None, None),
        CompositionLesson(ODD_PAIR, (True, False)),
    ]
    assert lessons_of(as_text(lessons), "it") == lessons
    assert "Infinity" not in as_text(lessons)


def test_compositions_are_learnt_after_the_runs(tmp_path: Path) -> None:
    file = tmp_path / "bank.sqlite"
    MemoryBank.open(file).close()
    with Collector.open(file, read_only=True) as collector:
        collector.lessons = []
        assert not collector.record_composition(ODD_PAIR, [False])
        assert collector.record_composition(ODD_PAIR, [False, True])
        assert collector.record_composition(ODD_PAIR, [True, False])
        lessons = lessons_of(as_text(collector.lessons), "it")
    with MemoryBank.open(file) as bank:
        assert compositions(bank) == []  # a collector only reads
        assert teach(bank, lessons) == 2  # the first one had no success, and the bank did not know it
        assert compositions(bank) == [replace(ODD_PAIR, succeeded=2, failed=1)]


def test_teaching_twice_teaches_once(tmp_path: Path) -> None:
    lessons = [lesson(0), lesson(1), lesson(2)]
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        assert teach(bank, lessons[:2]) == 2  # broken off
        assert teach(bank, lessons) == 1
        assert teach(bank, lessons) == 0
        assert [e.seed for e in bank.evidence("Odd Driving")] == [0, 1, 2]
        assert len(bank.planners("Odd Driving")) == 1
