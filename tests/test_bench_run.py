"""Benches through the real command line: cells, tables, resuming, rows that learn, what is refused."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cli_samples import ROOT, Done, Program
from typer.testing import CliRunner

from sumo_adv.benchmark.bench import read_cells
from sumo_adv.cli.bench import _settings
from sumo_adv.cli.main import app
from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.files import held

MOTORWAY, TEE, OPEN = (
    f"scenarios/{n}.toml" for n in ("motorway_cut_in_left", "t_junction_left_from_stem", "motorway_cut_in_right")
)
SMALL = (
    "bench", "table", "--suite", MOTORWAY, "--suite", TEE, "--ego", "idm", "--attempts", "3", "--set", "proposals=30",
    "--workers", "2", "--row", "raw", "--row", "llm-f", "--row", "expert", "--row", "random",
)  # fmt: skip
ROWS = ("raw", "expert", "llm-f", "random")


def cell(folder: Path, case: str, row: str) -> dict[str, Any]:
    file = folder / "cells" / "idm" / case / f"{row}.json"
    stored: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return stored


def unhurried(cell: dict[str, Any]) -> dict[str, Any]:
    """A cell without what a clock says."""
    return {k: v for k, v in cell.items() if k != "timing"} | {"llm": {**cell["llm"], "seconds": None}}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, caches: Path) -> Iterator[tuple[Program, Done]]:
    """The small table, undisturbed."""
    program = Program(tmp_path_factory.mktemp("bench"), caches)
    yield program, program.here(*SMALL, "--out", "out")


def test_a_table_is_made_of_cells_and_says_what_it_means(whole: tuple[Program, Done]) -> None:
    program, done = whole
    assert done.status == 0, done.err
    out = program.folder / "out"
    assert {p.name for p in out.iterdir()} >= {"bench.json", "cells", "table.md", "table.csv", "table.json"}
    raw, expert = (cell(out, "motorway_cut_in_left", row) for row in ("raw", "expert"))
    assert raw["outcome"]["collided"] is False and raw["attempts"] == []
    assert 1 <= len(expert["attempts"]) <= 3 and expert["outcome"]["collided"] in (True, False)
    assert expert["recall"] == "hit" and len(expert["motion"]["adversary"]["speed"]) > 10
    # two encounters, neither of which a bank of following and braking can do anything about
    assert cell(out, "t_junction_left_from_stem", "llm-f")["ending"] == "no_encounter"
    assert "llm-f   2  .00 [.00,.66]" in done.out  # Wilson's interval of 0 of 2
    assert (
        max(map(len, done.out.splitlines())) <= 100 and f"All columns, groups and differences: {out.name}" in done.out
    )
    assert "| `llm-f` | 2 | 0.00 (0.00–0.66) |" in (out / "table.md").read_text(encoding="utf-8")
    assert "The bank of the row expert grows from encounter to encounter" in " ".join(done.out.split())


def test_attacks_on_examples_are_drawn_and_others_are_not(whole: tuple[Program, Done]) -> None:
    """Both encounters are a suite's first; there is no attack in ``raw``, and ``llm-f`` has nothing for the T
    junction.
    """
    figures = whole[0].folder / "out" / "figures"
    drawn = {p.name for p in figures.glob("example-*.png")}
    attacked = {
        f"example-idm-{row}-{case}.png" for case in ("motorway_cut_in_left", "t_junction_left_from_stem")
        for row in ROWS if cell(figures.parent, case, row)["best"] is not None
    }  # fmt: skip
    assert drawn == attacked and len(drawn) >= 4
    assert "example-idm-llm-f-t_junction_left_from_stem.png" not in drawn
    assert all((figures / name).read_bytes().startswith(b"\x89PNG") for name in drawn)


def test_every_row_attacks_the_same_encounter(whole: tuple[Program, Done]) -> None:
    out = whole[0].folder / "out"
    for case in ("motorway_cut_in_left", "t_junction_left_from_stem"):
        met = [cell(out, case, row)["encounter"] for row in ("expert", "random")]
        assert met[0] == met[1] and met[0]["time"] > 0


def test_a_cell_that_is_gone_is_made_again_and_is_the_same(whole: tuple[Program, Done]) -> None:
    program, _ = whole
    out = program.folder / "resumed"
    shutil.copytree(program.folder / "out", out)
    before = {row: cell(out, "t_junction_left_from_stem", row) for row in ROWS}
    for row in ("expert", "random"):
        (out / "cells" / "idm" / "t_junction_left_from_stem" / f"{row}.json").unlink()
    kept = (out / "cells" / "idm" / "motorway_cut_in_left" / "expert.json").stat().st_mtime_ns
    done = program.here(*SMALL, "--out", "resumed")
    assert done.status == 0 and "8 cells, 6 of them done before." in done.err
    after = {row: cell(out, "t_junction_left_from_stem", row) for row in ROWS}
    assert {r: unhurried(c) for r, c in after.items()} == {r: unhurried(c) for r, c in before.items()}
    assert (out / "cells" / "idm" / "motorway_cut_in_left" / "expert.json").stat().st_mtime_ns == kept


def test_a_row_that_learns_has_a_bank_that_grew_and_others_have_not(whole: tuple[Program, Done]) -> None:
    out = whole[0].folder / "out"
    first, second = (cell(out, c, "expert") for c in ("motorway_cut_in_left", "t_junction_left_from_stem"))
    frozen = json.loads((out / "bench.json").read_text(encoding="utf-8"))["bank_hash"]
    assert first["bank_hash"] == frozen != second["bank_hash"]  # what the first encounter taught is there in the second
    assert sorted(p.name for p in (out / "banks" / "idm" / "expert").iterdir()) == ["1.sqlite", "2.sqlite"]


def test_a_folder_holds_the_cells_of_one_bench_only(whole: tuple[Program, Done]) -> None:
    program, _ = whole
    done = program.here(*SMALL, "--seed", "1", "--out", "out")
    assert done.status == 2
    assert done.err == "sumo-adv: out holds cells of another seed: they cannot share a table; give another --out.\n"
    (program.folder / "mine").mkdir()
    (program.folder / "mine" / "thesis.tex").write_text("")
    done = program.here(*SMALL, "--out", "mine")
    assert (done.status, "mine is not empty and not the folder of a bench" in done.err) == (2, True)


def test_two_benches_do_not_write_into_one_folder_at_once(whole: tuple[Program, Done]) -> None:
    program, _ = whole
    before = {p: p.stat().st_mtime_ns for p in (program.folder / "out").rglob("*.json")}
    with held(program.folder / "out" / "bench.lock") as alone:  # as another bench does
        done = program.here(*SMALL, "--out", "out")
    assert (alone, done.status) == (True, 2)
    assert done.err == "sumo-adv: Another bench writes into out; wait for it, or give another --out.\n"
    assert {p: p.stat().st_mtime_ns for p in (program.folder / "out").rglob("*.json")} == before


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (("--row", "nobody"), "There is no row 'nobody'"),
        (("--row", "expert+tunr=off"), "The row 'expert+tunr=off' changes 'tunr', which is not a setting"),
        (("--row", "expert+seed=3"), "which is the same for all rows of a table"),
        (("--row", "expert+replan=soon"), "Setting 'replan' cannot be 'soon'"),
        (("--row", "llm-a"), "The row llm-a needs a model"),
        (("--row", "llm-a:deepseek-chat"), "The model 'deepseek-chat' needs a key"),
        (("--memory", "nowhere.sqlite"), "The memory bank nowhere.sqlite does not exist."),
        (("--row", "raw+tuner=off"), "The row 'raw+tuner=off' has no settings to change"),
        (("--row", "transformer:nowhere.npz"), "nowhere.npz cannot be read as weights"),
        (("--ego", "ghost"), "ghost"),
        (("--ego", ","), "--ego names no driver"),
        (("--set", "proposals"), "--set takes NAME=VALUE"),
        (("--suite", "nowhere.toml"), "nowhere.toml"),
        (("--suite", "smoke"), "The suite smoke cannot be combined with others"),
        (("--set", "seed=3"), "--set seed cannot apply to all rows of a table; use --seed."),
        (("--set", "learn=off"), "use a row, expert+learn=off."),
        (("--row", "expert+ttc=3"), "changes 'ttc', which is the same for all rows"),
        (("--row", "expert+llm=some"), "give llm-a:NAME or llm-f:NAME for a row with a model"),
        (("--row", "llm-f+learn=on"), "the bank of llm-f stays fixed"),
        (("--row", "expert+shift=nan"), "not a number of seconds"),
        (("--reference", "oracle"), "--reference 'oracle' is not a row of the table; choose one of: "),
    ],
)
def test_what_there_is_not_is_refused_before_anything_runs(
    program: Program, given: tuple[str, ...], sentence: str
) -> None:
    """In this process; the tests above show how the program prints such a sentence, and its exit status."""
    out = program.folder / "out"
    unset = {name: None for name in os.environ if name.startswith("SUMO_ADV_")}
    done = CliRunner().invoke(app, [*SMALL, "--out", str(out), *given], env=unset | program.environment())
    assert isinstance(done.exception, SumoAdvError) and done.exception.exit_status == 2, done.output
    assert sentence in str(done.exception) and "\n" not in str(done.exception)
    assert not out.exists()


def test_a_scenario_that_breaks_is_a_failed_cell_and_the_rest_goes_on(program: Program) -> None:
    text = (ROOT / MOTORWAY).read_text(encoding="utf-8").replace('"../networks', f'"{ROOT}/networks')
    text = text.replace('"demand/', f'"{ROOT}/scenarios/demand/').replace("trigger = 5.0", "trigger = 500.0")
    assert "trigger = 500.0" in text  # long after its end
    (program.folder / "broken.toml").write_text(text)
    done = program.here(
        "bench", "table", "--suite", "broken.toml", "--suite", MOTORWAY, "--row", "random", "--row", "expert",
        "--attempts", "1", "--set", "proposals=20", "--out", "out", "--workers", "1",
    )  # fmt: skip
    assert done.status == 0
    assert "sumo-adv: 2 of 4 cells failed, for instance broken (expert): " in done.err and "500 s" in done.err
    assert "random  2" in done.out and "expert  2" in done.out  # it stays in the denominator
    assert cell(program.folder / "out", "motorway_cut_in_left", "expert")["attempts"]  # a row that learns goes on


def test_where_the_trigger_is_open_a_row_shifts_the_one_that_the_others_find(program: Program) -> None:
    assert 'trigger = "auto"' in (ROOT / OPEN).read_text(encoding="utf-8")
    done = program.here(
        "bench", "table", "--suite", OPEN, "--row", "random", "--row", "llm-f+shift=0.5", "--row", "llm-f+shift=-500",
        "--attempts", "1", "--set", "proposals=20", "--out", "out",
    )  # fmt: skip
    assert done.status == 0
    by_row = {c["row"]: c for c in read_cells(program.folder / "out")}
    when = {row: c["encounter"]["time"] for row, c in by_row.items()}
    assert when["llm-f+shift=0.5"] == pytest.approx(when["random"] + 0.5)
    assert 0.0 <= when["llm-f+shift=-500"] < 0.5  # not before the beginning


def test_a_budget_in_seconds_alone_is_not_cut_short_after_25_attempts(program: Program) -> None:
    raw = ("bench", "table", "--suite", MOTORWAY, "--row", "raw", "--out", "out")
    assert program.here(*raw, "--seconds", "60").status == 0
    kept = json.loads((program.folder / "out" / "bench.json").read_text(encoding="utf-8"))
    assert (kept["settings"]["seconds"], kept["settings"]["attempts"]) == (60.0, 400)
    again = program.here(*raw)  # 25 attempts
    assert (again.status, "out holds cells of another settings" in again.err) == (2, True)


def test_variables_are_settings_of_all_rows_but_for_what_a_table_says_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """``--set`` goes before a variable; the ego and the players are never a variable's."""
    for name, value in {"PROPOSALS": "30", "REPLAN": "2", "EGO": "careful", "LLM": "some", "LLM_API_KEY": "k"}.items():
        monkeypatch.setenv(f"SUMO_ADV_{name}", value)
    assert _settings(["proposals=40"]) == {"proposals": 40, "replan": 2.0}
    monkeypatch.setenv("SUMO_ADV_PROPOSALS", "many")
    with pytest.raises(UsageError, match="Setting 'proposals' cannot be 'many'"):
        _settings([])


def test_a_suite_that_cannot_be_written_is_a_sentence(program: Program) -> None:
    (program.folder / "file").write_text("")
    done = program.here("bench", "make", "--seed", "1", "--out", "file/suite")
    assert (done.status, done.err.count("\n")) == (2, 1)
    assert done.err.startswith("sumo-adv: The results in file/suite cannot be written (")
