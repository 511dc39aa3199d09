"""A real hunt, a suite that is run, and a packed campaign: each of their runs is exported."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from batch_samples import QUICK
from cli_samples import Program
from typer.testing import CliRunner

import sumo_adv
from sumo_adv.cli.main import app
from sumo_adv.errors import UsageError


@pytest.fixture(scope="module")
def hunted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a hunt that ends with the first failures."""
    home = tmp_path_factory.mktemp("hunt")
    found = sumo_adv.hunt(
        "motorway_cut_in_left", ego="idm", minutes=2.0, distinct=1, workers=1, out=home / "hunt",
        memory=home / "bank.sqlite", pages=False, until="valid", attempts=1, proposals=24,
    )  # fmt: skip
    assert found.rows
    return home / "hunt"


def exported(folder: Path, format: str) -> list[dict[str, Any]]:
    done = CliRunner().invoke(app, ["export", str(folder), "--format", format, "--json"])
    assert done.exit_code == 0, (done.stderr, done.exception)
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_a_hunt_writes_each_failure(hunted: Path) -> None:
    failures = sorted(p.name for p in (hunted / "failures").iterdir())
    for format, ending in (("commonroad", "-commonroad"), ("csv", ".csv")):
        made = exported(hunted, format)
        assert [Path(each["out"]).name for each in made] == [f"{name}{ending}" for name in failures]
        assert all(Path(each["out"]).exists() and each["adversary"] for each in made)
        assert {Path(each["out"]).parent.name for each in made} == {"hunt-exports"}


def test_a_suite_of_them_is_exported_once_it_has_run(hunted: Path, program: Program) -> None:
    kept = program.here("keep", hunted / "failures", "--suite", "suite")
    assert kept.status == 0, kept.err
    error = CliRunner().invoke(app, ["export", str(program.folder / "suite"), "--format", "csv"]).exception
    assert isinstance(error, UsageError) and "the results of regress" in str(error)
    assert program.here("regress", "suite", "--ego", "idm", "--workers", "1", "--out", "ran").status in (0, 3)
    made = exported(program.folder / "ran", "csv")
    assert {Path(each["out"]).stem for each in made} == {p.name for p in (program.folder / "ran" / "runs").iterdir()}


@pytest.mark.parametrize("given", ["suite", "suite/crossing"])
def test_of_a_suite_the_message_names_what_to_export(program: Program, given: str) -> None:
    case = program.folder / "suite" / "crossing"
    case.mkdir(parents=True)
    (case / "case.toml").touch()
    done = program.here("export", given, "--format", "csv")
    results = f"runs/regress-{Path(given).name}"
    assert (
        done.status == 2
        and f"run sumo-adv regress {given} --ego EGO, and give the results of regress: {results}." in done.err
    )


def test_a_packed_campaign_needs_no_unpacking(program: Program) -> None:
    batch = program.here("batch", "motorway_cut_in_left", *QUICK, "--seeds", "2", "--workers", "1", "--out", "out")
    assert batch.status == 0
    names = {run.name for run in (batch.folder / "runs").iterdir()}
    assert program.here("batch", "pack", "out").status == 0
    assert not list((batch.folder / "runs").iterdir())
    made = exported(batch.folder, "fcd")
    assert {Path(each["out"]).name for each in made} == {f"{name}.fcd.xml" for name in names} and len(names) == 2
