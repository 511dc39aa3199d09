"""The benchmark's pictures and the growth of the bank."""

from __future__ import annotations

import csv
import json
import struct
from pathlib import Path

import pytest
from bench_cells import Cell, attempt, cell, unattacked

from sumo_adv.benchmark.analysis import analyze
from sumo_adv.benchmark.league import growth, write_growth
from sumo_adv.benchmark.nouns import SuiteCase
from sumo_adv.benchmark.plots import draw_all, draw_confusions, draw_growth, file_name
from sumo_adv.errors import UsageError

ABOUT = {
    "command": "sumo-adv bench growth", "suite": "made", "version": "1", "content": "c0ffee",
    "versions": {}, "settings": {}, "seed": 0, "bank_hash": None,
}  # fmt: skip
MOTION = {
    "adversary": {"speed": [9.0, 10.0, 11.0], "acceleration": [0.5, -9.0, 1.0]},
    "raw": {"speed": [12.0, 12.5], "acceleration": [0.0, 0.1]},
}
CASES = [SuiteCase(f"straight-{k}", Path("x"), None, "leader", "straight") for k in range(6)]


def size(picture: Path) -> tuple[int, int]:
    """Width and height of a PNG."""
    data = picture.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", data[16:24])
    return width, height


def some(row: str = "a$b:c/d") -> list[Cell]:
    intents = [{"bv": "1", "label": "Aggressive Cut-in", "risk": "high"}]
    return [
        unattacked("straight-1"),
        cell("straight-1", row, attempt(valid=True), motion=MOTION, intents=intents),
        cell("straight-2", row, ending="simulation_failed", timing={}),
    ]


def test_pictures_of_a_table(tmp_path: Path) -> None:
    pictures = draw_all(some(), tmp_path / "figures")
    names = {"ttc-idm.png", "seconds-idm.png", "distributions-idm-a-b-c-d.png"}
    assert {p.name for p in pictures} == names == {p.name for p in (tmp_path / "figures").iterdir()}
    assert all(size(p)[0] >= 1300 for p in pictures)


def test_equal_cells_give_equal_pictures(tmp_path: Path) -> None:
    first, second = draw_all(some(), tmp_path / "a"), draw_all(some(), tmp_path / "b")
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in second]


def test_a_confusion_for_every_analyzer(tmp_path: Path) -> None:
    label = {"idm": {"valid": ("Aggressive Cut-in",)}}
    cases = [SuiteCase("straight-1", Path("x"), None, "leader", "straight", label)]
    pictures = draw_confusions(analyze(some("expert"), cases, title="Made"), tmp_path)
    assert [p.name for p in pictures] == [file_name("confusion", "idm", "valid", "expert")]


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="cannot be written"):
        draw_all(some(), tmp_path / "file" / "figures")


def learning() -> list[Cell]:
    """Six encounters out of order: generated, generated, hit, (none), hit, hit; 4 s, then 2 s."""
    recall = ["generated", "generated", "hit", None, "hit", "hit"]
    cells = [
        cell(f"straight-{k}", "llm-a:m", attempt(valid=True), recall=r, timing={"row": 4.0 if k < 3 else 2.0})
        for k, r in enumerate(recall)
    ]
    return cells[::-1]


def test_growth_goes_through_the_suite_in_order() -> None:
    steps = growth(learning(), CASES)
    assert [s.place for s in steps] == [1, 2, 3, 4, 5, 6]
    assert [s.hit for s in steps] == [False, False, True, None, True, True]
    assert [s.hit_rate for s in steps] == pytest.approx([0, 0, 1 / 3, 1 / 3, 1 / 2, 3 / 5])
    assert [s.seconds_window for s in steps] == pytest.approx([4, 4, 4, 3.5, 3.2, 3])


def test_growth_by_scenes_counts_attacks_that_were_remembered() -> None:
    remembered = {"recall": "hit", "intent": {"label": "Straight Lane Shift", "recall": "scene"}}
    cells = [
        cell("straight-0", "expert+recall=scene", attempt(valid=True, by="tuner"), **remembered),
        cell("straight-1", "expert+recall=scene", attempt(valid=True, by="memory"), **remembered),
    ]
    assert [s.hit for s in growth(cells, CASES)] == [False, True]


def test_a_missing_encounter_leaves_a_gap() -> None:
    cells = [c for c in learning() if c["case"] != "straight-2"]
    assert [s.place for s in growth(cells, CASES)] == [1, 2, 4, 5, 6]


def test_growth_as_files(tmp_path: Path) -> None:
    steps = growth(learning(), CASES)
    write_growth(steps, learning(), tmp_path, ABOUT)
    text = (tmp_path / "growth.md").read_text()
    assert "| `llm-a:m` | idm | 0 | last third | 2 | 1.00 (0.34–1.00) | 2.00 (2.00–2.00) |" in text
    with (tmp_path / "growth.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [r["hit"] for r in rows] == ["False", "False", "True", "", "True", "True"]
    third = json.loads((tmp_path / "growth.json").read_text())["thirds"][2]
    assert (third["encounters"], third["n"], third["hits"]["value"], third["hits"]["n"]) == ("last third", 2, 1, 2)
    assert size(draw_growth(tmp_path / "growth.png", steps, "Growth")) == (1650, 1020)
