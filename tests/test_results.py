"""``make results`` on one encounter: it measures, resumes, and writes a copy of the page, with revision and command."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from cli_samples import ROOT, Program

from sumo_adv.benchmark.columns import TABLE_COLUMNS

SCRIPT = ROOT / "benchmarks" / "results.py"
PAGE = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
TABLES = tomllib.loads(SCRIPT.with_suffix(".toml").read_text(encoding="utf-8"))["table"]


def results(program: Program, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(SCRIPT), *arguments], cwd=program.folder, env=program.environment(),
        capture_output=True, text=True, timeout=120.0, check=False,
    )  # fmt: skip


def test_a_trial_writes_a_copy_of_the_page_and_goes_on_where_it_stopped(program: Program) -> None:
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("results name a revision, and this is no checkout of git")
    trial = ("--table", "drivers", "--ego", "blind", "--attempts", "1", "--out", "out")
    trial += ("--suite", str(ROOT / "suites" / "suite81" / "straight-18.toml"))
    done = results(program, *trial)
    assert done.returncode == 0, done.stderr
    (page,) = program.folder.glob("out/*/trial-*/results.md")
    written = page.read_text(encoding="utf-8").split("<!-- results: drivers -->")[1].split("<!-- end: drivers -->")[0]
    assert page.parent.parent.name in written.splitlines()[2]  # the revision
    assert "    sumo-adv bench table --suite " in written and "--ego blind --until serious" in written
    (row,) = [line.split(" | ") for line in written.splitlines() if line.startswith("| blind")]
    assert row[1] == "`expert+learn=off`" and row[2] == "1.00 [0.21, 1.00]"  # Wilson's interval of one of one
    assert page.read_text(encoding="utf-8").split("## Methods")[1] == PAGE.split("## Methods")[1]
    cells = {file: file.stat().st_mtime_ns for file in page.parent.rglob("cells/**/*.json")}
    assert len(cells) == 1
    assert results(program, *trial).returncode == 0
    assert {file: file.stat().st_mtime_ns for file in page.parent.rglob("cells/**/*.json")} == cells


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table["name"])
def test_every_table_has_its_place_and_known_columns(table: dict[str, object]) -> None:
    for mark in ("results", "end"):
        assert PAGE.count(f"<!-- {mark}: {table['name']} -->") == 1
    assert set(table["columns"]) <= {column.key for column in TABLE_COLUMNS}


def test_recorded_rows_have_the_answers_of_each_encounter() -> None:
    (table,) = (table for table in TABLES if table["name"] == "model")
    recorded = {file.stem for file in (ROOT / "examples" / "recorded_model").glob("*.jsonl")}
    assert {Path(file).stem for file in table["suite"]} == recorded
