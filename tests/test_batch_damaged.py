"""A batch with a damaged folder: missing runs are run again, and a loss that cannot be made good is a sentence."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from batch_samples import QUICK, clean, summary, table
from cli_samples import Program

from sumo_adv.campaigns.results import read_row
from sumo_adv.campaigns.store import open_store, packed_rows, packed_texts, unpack_runs
from sumo_adv.campaigns.worker import lessons_of
from sumo_adv.errors import UsageError
from sumo_adv.report.staging import staged

ONE = ("batch", "motorway_cut_in_left", "--seeds", "5", *QUICK, "--out", "out", "--json")
DEEP = "[" * 100_000


def no_outcome(run: Path) -> None:
    (run / "outcome.json").unlink()


def a_file(run: Path) -> None:
    shutil.rmtree(run)
    run.write_text("not a folder")


def half_an_outcome(run: Path) -> None:
    text = (run / "outcome.json").read_text(encoding="utf-8")
    (run / "outcome.json").write_text(text[: len(text) // 2], encoding="utf-8")


def other_kinds(run: Path) -> None:
    outcome = json.loads((run / "outcome.json").read_text(encoding="utf-8"))
    (run / "outcome.json").write_text(json.dumps(outcome | {"intent": "text", "seed": [1]}), encoding="utf-8")


def nested(run: Path) -> None:
    (run / "outcome.json").write_text(DEEP, encoding="utf-8")


DAMAGES: tuple[Callable[[Path], None], ...] = (
    no_outcome, a_file, half_an_outcome, other_kinds, nested,
)  # fmt: skip


@pytest.mark.soak
def test_a_campaign_with_damaged_runs_is_resumed(program: Program) -> None:
    """Five runs, each damaged in another way, and run again: the table is the same."""
    summary(program(*ONE))
    before = table(program.folder / "out")
    runs = sorted((program.folder / "out" / "runs").iterdir())
    for damage, run in zip(DAMAGES, runs, strict=True):
        damage(run)
        assert read_row(run) is None
    report = summary(program(*ONE))
    assert (report["ran"], report["finished"], report["failed"]) == (5, 5, 0)
    assert table(program.folder / "out") == before
    clean(program)


@pytest.mark.parametrize(
    "text",
    ["{", "[]", "7", "{}", '{"schema": 1, "inputs": 7}', DEEP, "\xff",
     '{"schema": 1, "inputs": [7], "egos": [], "seeds": [], "settings": []}'],
    ids=["cut", "a list", "a number", "empty", "no list", "deep", "no UTF-8", "an input that is a number"],
)  # fmt: skip
def test_a_damaged_plan_is_a_sentence(tmp_path: Path, text: str) -> None:
    (tmp_path / "plan.json").write_bytes(text.encode("latin-1"))
    with open_store(tmp_path, staged) as (store, _), pytest.raises(UsageError, match=r"plan\.json is not the plan of"):
        store.known_plan()


@pytest.mark.parametrize(
    "text", ["{", "7", "[7]", '[{"evidence": {}}]', DEEP], ids=["cut", "a number", "numbers", "empty", "deep"]
)
def test_damaged_lessons_are_a_sentence(text: str) -> None:
    with pytest.raises(UsageError, match=r"The file x is damaged .* delete the run's folder"):
        lessons_of(text, "The file x")


@pytest.mark.parametrize(
    "runs",
    [7, {"a": 7}, {"a": {"row": {}, "inputs": []}},
     {"a": {"row": {}, "inputs": ["../../secret"]}}],
    ids=["a number", "no entry", "no row", "an input elsewhere"],
)  # fmt: skip
def test_a_damaged_index_of_a_pack_is_a_sentence(tmp_path: Path, runs: object) -> None:
    (tmp_path / "packs").mkdir()
    (tmp_path / "packs" / "0000.json").write_text(json.dumps({"runs": runs}), encoding="utf-8")
    with pytest.raises(UsageError, match="of a pack is damaged"):
        packed_rows(tmp_path)


def test_a_pack_writes_nothing_outside_of_its_run(tmp_path: Path) -> None:
    outcome = {
        "outcome": None, "raw": None, "intent": None, "network": "n", "seed": 0, "ego": {"controller": "idm"},
        "ending": "no_encounter", "attempts": [], "timing": {}, "encounter": None,
        "best": None, "adversaries": [],
    }  # fmt: skip
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "outcome.json").write_text(json.dumps(outcome), encoding="utf-8")
    row = read_row(tmp_path / "run")
    packs = tmp_path / "packs"
    packs.mkdir()
    (packs / "0000.json").write_text(json.dumps({"runs": {"a": {"row": row, "inputs": []}}}), encoding="utf-8")
    with zipfile.ZipFile(packs / "0000.zip", "w") as out:
        out.writestr("a/outcome.json", "{}")
        out.writestr("a/../../outside", "mine")
    with pytest.raises(UsageError, match="something other than a file in a run's folder"):
        unpack_runs(tmp_path, ["a"], tmp_path / "into", staged)
    assert not (tmp_path / "outside").exists() and not (tmp_path / "into").exists()
    (packs / "0000.zip").write_bytes((packs / "0000.zip").read_bytes()[:-30])
    with pytest.raises(UsageError, match="missing or damaged"):
        packed_texts(tmp_path, "outcome.json")
