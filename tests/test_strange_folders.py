"""Folders of others: no link leads out of them, and --force deletes nothing that this program did not write."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from cli_samples import Program
from regression_samples import attacked, results, suite_in

from sumo_adv.campaigns.store import open_store, packed_rows, unpack_runs
from sumo_adv.errors import UsageError
from sumo_adv.files import refuse_links, scratch_prefix, sweep_scratch
from sumo_adv.regression.case import read_suite
from sumo_adv.regression.suite import read_results
from sumo_adv.report.manifest import read_manifest
from sumo_adv.report.read import read_run
from sumo_adv.report.staging import staged

QUICK = ("motorway", "--total-seconds", "0", "--learn", "off")


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """A folder of the user's, elsewhere."""
    folder = tmp_path / "mine"
    (folder / "0f3a5c6e7d8b9a10").mkdir(parents=True)
    (folder / "thesis.txt").write_text("years of work", encoding="utf-8")
    (folder / "0f3a5c6e7d8b9a10" / "data.txt").write_text("more", encoding="utf-8")
    return folder


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    """A stranger's campaign, as far as a plan and its folders."""
    folder = tmp_path / "theirs"
    folder.mkdir()
    (folder / "plan.json").write_text("{}", encoding="utf-8")
    return folder


@pytest.mark.parametrize("name", ["runs", "inputs", ".lock", "packs", "report", "unpacked", "results.csv"])
def test_no_link_is_followed_in_a_campaign(campaign: Path, mine: Path, name: str) -> None:
    (campaign / name).symlink_to(mine / "thesis.txt" if "." in name else mine)
    before = {str(path): path.stat().st_mtime_ns for path in mine.rglob("*")}
    with pytest.raises(UsageError, match=f"{name} is a link, which is not followed"), open_store(campaign, staged):
        pytest.fail("it was opened")
    assert {str(path): path.stat().st_mtime_ns for path in mine.rglob("*")} == before


def test_commands_refuse_links_before_they_write(program: Program, mine: Path) -> None:
    campaign = program.folder / "theirs"
    campaign.mkdir()
    (campaign / "plan.json").write_text("{}", encoding="utf-8")
    (campaign / "results.csv").write_text("id\n", encoding="utf-8")
    (campaign / "runs").symlink_to(mine)
    for command in (("batch", "pack", "theirs"), ("batch", "unpack", "theirs"), ("report", "theirs")):
        done = program.here(*command)
        assert (done.status, done.out) == (2, "")
        assert "runs is a link, which is not followed" in done.err
    assert (mine / "thesis.txt").read_text() == "years of work"


def test_the_text_of_a_lock_names_nothing_to_delete(campaign: Path, tmp_path: Path) -> None:
    victim = tmp_path / "sumo_adv-batch-victim"
    victim.mkdir()
    (campaign / ".lock").write_text(str(victim), encoding="utf-8")
    with open_store(campaign, staged):
        pass
    assert victim.is_dir()


@pytest.mark.parametrize("name", ["..", "../x", "/etc", "a/b", ""])
def test_names_in_an_index_stay_in_the_folder(campaign: Path, name: str) -> None:
    (campaign / "packs").mkdir()
    index = {"schema": 1, "runs": {name: {"row": {}, "inputs": []}}}
    (campaign / "packs" / "0000.json").write_text(json.dumps(index), encoding="utf-8")
    for read in (packed_rows, lambda folder: unpack_runs(folder, [], folder / "unpacked", staged)):
        with pytest.raises(UsageError, match="it names something other than a file in a folder"):
            read(campaign)


def test_a_run_with_a_link_is_not_read(tmp_path: Path, mine: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(attacked(), run)
    read_run(run)
    (run / "inputs" / "more").symlink_to(mine)
    with pytest.raises(UsageError, match="more is a link, which is not followed"):
        read_run(run)
    refuse_links(tmp_path / "nowhere")


# -- --force ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["{}", '{"program": "sumo_adv", "files": []}', '{"name": "web", "schema": 1}'])
def test_force_leaves_a_web_project_alone(program: Program, text: str) -> None:
    project = program.folder / "out"
    project.mkdir()
    (project / "manifest.json").write_text(text, encoding="utf-8")
    (project / "index.html").write_text("<p>", encoding="utf-8")
    done = program.here("run", *QUICK, "--out", "out", "--force")
    assert done.status == 2
    assert "is not the folder of a run or a conversion, so --force does not replace it" in done.err
    assert sorted(p.name for p in project.iterdir()) == ["index.html", "manifest.json"]


def test_force_replaces_a_run_but_not_what_the_user_put_there(program: Program) -> None:
    program.here("run", *QUICK, "--out", "out")
    again = program.here("run", *QUICK, "--out", "out", "--force")
    assert "--force" not in again.err
    (program.folder / "out" / "inputs" / "notes.txt").write_text("mine", encoding="utf-8")
    done = program.here("run", *QUICK, "--out", "out", "--force")
    assert done.status == 2
    assert "out holds notes.txt, which this program did not write" in done.err
    assert (program.folder / "out" / "inputs" / "notes.txt").read_text() == "mine"


def test_a_link_as_the_folder_is_refused_before_the_run(program: Program, mine: Path) -> None:
    (program.folder / "out").symlink_to(mine)
    done = program.here("run", *QUICK, "--out", "out", "--force")
    assert done.status == 2
    assert "out is a link, so --force does not replace it" in done.err


# -- scratch folders --------------------------------------------------------------------------------------------------


def test_scratch_folders_of_killed_processes_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    code = "import os; from sumo_adv.files import scratch_prefix; print(scratch_prefix())"
    gone = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.strip()
    mine, theirs = tmp_path / f"{scratch_prefix()}a", tmp_path / f"{gone}b"
    for folder in (mine, theirs, tmp_path / "sumo_adv-of-others"):
        folder.mkdir()
    sweep_scratch()
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([mine.name, "sumo_adv-of-others"])


# -- suites -----------------------------------------------------------------------------------------------------------


def test_linked_cases_are_refused_and_those_of_one_name_told_apart(tmp_path: Path) -> None:
    """Two folders ``case`` elsewhere, linked as ``a`` and ``b``: both would have had the name and result of one."""
    suite = suite_in(tmp_path, "a", "b")
    assert [case.name for case in read_suite(suite)] == ["a", "b"]
    assert [case.name for case in read_suite(suite / "a")] == ["a"]
    (tmp_path / "x").mkdir()
    (suite / "b").rename(tmp_path / "x" / "a")
    (suite / "b").symlink_to(tmp_path / "x" / "a")
    with pytest.raises(UsageError, match="b is a link, which is not followed"):
        read_suite(suite)


def test_there_are_as_many_results_as_cases(program: Program) -> None:
    suite_in(program.folder, "a", "b", "c")
    done = program.here("regress", "suite", "--ego", "idm", "--workers", "1", "--out", "out")
    assert "3 cases of suite against idm" in done.out
    assert [case["case"] for case in results(program.folder / "out")] == ["a", "b", "c"]
    document = json.loads((program.folder / "out" / "regress.json").read_text(encoding="utf-8"))
    assert sum(document["counts"].values()) == len(document["cases"]) == 3


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"level": "cosmic"}, "has a bad 'level'"), ({"case": "../../mine"}, "names the case '../../mine'"),
        ({"min_ttc": "soon"}, "has a bad 'min_ttc'"), ({"case": 3}, "has a bad 'case'"),
    ],
)  # fmt: skip
def test_a_strange_baseline_is_a_sentence(program: Program, change: dict[str, object], says: str) -> None:
    row = {"case": "a", "ego": "idm", "level": "none", **change}
    file = program.folder / "regress.json"
    file.write_text(json.dumps({"schema": 1, "suite": "s", "ego": "idm", "cases": [row]}), encoding="utf-8")
    with pytest.raises(UsageError, match=says):
        read_results(file)
    suite_in(program.folder, "a")
    for command in (("regress", "suite", "--ego", "idm", "--baseline", "regress.json", "--out", "o"),
                    ("compare", "regress.json", "regress.json", "--out", "o")):  # fmt: skip
        done = program.here(*command)
        assert done.status == 2
        assert says in done.err
    assert not (program.folder / "o").exists()


def test_links_are_what_the_system_calls_so(tmp_path: Path) -> None:
    """Hard links are how campaigns keep each input once: they stay."""
    (tmp_path / "a").write_text("x", encoding="utf-8")
    os.link(tmp_path / "a", tmp_path / "b")
    refuse_links(tmp_path)


def test_a_case_in_a_case_is_not_passed_over(tmp_path: Path) -> None:
    """A suite with a case file of its own was one case, and none of the others was run."""
    suite = suite_in(tmp_path, "a", "b")
    for file in (suite / "a").iterdir():
        shutil.copyfile(file, suite / file.name)
    with pytest.raises(UsageError, match="suite is a case and holds the case a: move one of them"):
        read_suite(suite)


@pytest.mark.parametrize("ranking", [[1], [{"id": "a"}], [{"id": [], "relation": "leader"}], {"a": 1}])
def test_a_strange_run_is_not_kept_but_a_sentence(program: Program, ranking: object) -> None:
    run = program.folder / "run"
    shutil.copytree(attacked(), run)
    outcome = json.loads((run / "outcome.json").read_text(encoding="utf-8"))
    outcome["encounter"]["ranking"] = ranking
    (run / "outcome.json").write_text(json.dumps(outcome), encoding="utf-8")
    done = program.here("keep", "run", "--suite", "suite")
    assert (done.status, done.err.count("\n")) == (2, 1)
    assert "is not as this program writes it" in done.err


def test_a_run_folder_takes_down_no_wall_of_the_sandbox(tmp_path: Path) -> None:
    """Its planners are a stranger's."""
    run = shutil.copytree(attacked(), tmp_path / "run")
    manifest = json.loads((run / "manifest.json").read_text(encoding="utf-8"))
    manifest["settings"]["bubblewrap"] = False
    (run / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
    assert read_manifest(run).settings.bubblewrap
