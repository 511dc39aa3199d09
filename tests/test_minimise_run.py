"""``run --diverse`` and ``minimise`` on a real encounter: what they find, and what lies in the folders."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli_samples import Program

import sumo_adv

LEVELS = ("none", "critical", "collision", "valid", "strict", "serious")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that looks for valid attacks of two kinds."""
    home = tmp_path_factory.mktemp("diverse")
    settings = {"until": "valid", "diverse": 2, "attempts": 8, "learn": "off", "memory": home / "bank.sqlite"}
    return sumo_adv.run("oncoming_four_lanes", out=home / "run", **settings).folder


def outcome(folder: Path) -> dict[str, object]:
    return json.loads((folder / "outcome.json").read_text(encoding="utf-8"))


def test_each_kind_has_its_files_and_its_place_on_the_page(run: Path) -> None:
    document = outcome(run)
    successes = document["successes"]
    assert len(successes) == 2 and len({s["kind"] for s in successes}) == 2
    best, (alternative,) = document["best"], [s for s in successes if s["folder"] is not None]
    assert [s["attempt"] for s in successes if s["folder"] is None] == [best]
    inner = outcome(run / alternative["folder"])
    assert inner["best"] == alternative["attempt"] and LEVELS.index(inner["outcome"]["level"]) >= LEVELS.index("valid")
    page = sumo_adv.load(run).show()._repr_html_()
    assert f"attack {alternative['attempt'] + 1}: {alternative['kind']}" in page


def test_the_mildest_variant_keeps_the_level_and_is_no_harder(run: Path, program: Program) -> None:
    before = outcome(run)["outcome"]
    done = program.here("minimise", str(run), "--attempts", "5", "--out", "mild", "--json")
    assert done.status == 0, done.err
    after = json.loads(done.out)
    assert LEVELS.index(after["outcome"]["level"]) >= LEVELS.index(before["level"])
    assert len(after["attempts"]) <= 5 and after["attempts"][0]["delta_v"] == before["delta_v"]
    again = program.here("run", "--replay", "mild", "--out", "again", "--json")
    assert json.loads(again.out)["outcome"]["contact_time"] == after["outcome"]["contact_time"]


def test_what_cannot_be_minimised_is_said_in_one_sentence(run: Path, program: Program) -> None:
    no_run = program.here("minimise", "nothing")
    assert (no_run.status, no_run.err.count("\n")) == (2, 1) and "manifest.json" in no_run.err
    low = program.here("minimise", str(run), "--until", "critical")
    assert low.status == 2 and "keeps a collision" in low.err
