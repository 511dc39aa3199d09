"""The benchmark's tables: which part of a cell counts, with which interval, against which row, and how gaps are
named.
"""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest
from bench_cells import Cell, attempt, cell, unattacked

from sumo_adv.benchmark.nouns import SuiteCase
from sumo_adv.benchmark.table import BenchTable, counterpart, make_table, to_markdown
from sumo_adv.benchmark.write import write_table
from sumo_adv.errors import UsageError

ABOUT = {
    "command": "sumo-adv bench table", "suite": "made", "version": "1", "content": "c0ffee",
    "versions": {"sumo_adv": "0"}, "settings": {"attempts": 25}, "seed": 0, "bank_hash": "ba4c",
}  # fmt: skip


def four(row: str = "expert") -> list[Cell]:
    """A valid collision at the second attempt, one that is not, a near miss at 4 s, a crash of the simulation."""
    return [
        cell("straight-1", row, attempt(min_ttc=0.8), attempt(strict=True)),
        cell("straight-2", row, attempt(collided=True)),
        cell("crossing-1", row, attempt(min_ttc=4.0)),
        cell("crossing-2", row, ending="simulation_failed", reason="It broke."),
    ]


def value(table: BenchTable, column: str, row: str = "expert", part: str = "all", ego: str = "idm") -> Any:
    entry = table.entry(ego, part, row, column)
    return None if entry is None else entry.estimate.value


def test_a_failure_stays_in_the_denominator() -> None:
    table = make_table(four(), title="Made")
    shares = {k: value(table, k) for k in ("collision", "no_rear", "valid", "strict", "critical", "failed")}
    assert shares == {"collision": 0.5, "no_rear": 0.5, "valid": 0.25, "strict": 0.25, "critical": 0.5, "failed": 0.25}
    assert value(table, "no_attack") == 0
    entry = table.entry("idm", "all", "expert", "valid")
    assert entry is not None and entry.estimate.n == 4
    # Wilson for 1 of 4: (0.25 + 0.4802 -+ 1.96 sqrt(0.046875 + 0.06003)) / 1.9604
    assert (entry.estimate.low, entry.estimate.high) == pytest.approx((0.0456, 0.6994), abs=1e-4)


def test_what_a_failed_run_had_found_does_not_count() -> None:
    stopped = cell("straight-1", "expert", attempt(valid=True), ending="budget_exhausted")
    table = make_table([stopped], title="Made")
    assert (value(table, "valid"), value(table, "valid_25"), value(table, "mean_min_ttc")) == (0, 0, 10)


def test_min_ttc_counts_a_collision_as_zero_and_never_as_ten() -> None:
    table = make_table([*four(), cell("crossing-3", "expert", attempt(min_ttc=30.0))], title="Made")
    assert value(table, "mean_min_ttc") == pytest.approx((0 + 0 + 4 + 10 + 10) / 5)
    assert value(table, "median_min_ttc") == 4
    apart = table.entry("idm", "all", "expert", "mean_min_ttc_apart")
    assert apart is not None and (apart.estimate.value, apart.estimate.n) == (8, 3)


def test_attempts_and_modification() -> None:
    cells = [
        cell("straight-1", "expert", attempt(min_ttc=3.0), attempt(min_ttc=0.9), attempt(valid=True, phase="modifier")),
        cell("straight-2", "expert", attempt(valid=True)),
        cell("straight-3", "expert", *[attempt(min_ttc=2.0)] * 5, attempt(collided=True, rear_end=True)),
    ]
    table = make_table(cells, title="Made")
    assert [value(table, f"valid_{k}") for k in (1, 5, 10, 25)] == pytest.approx([1 / 3, 2 / 3, 2 / 3, 2 / 3])
    assert value(table, "attempts") == 2  # the median of 3 and 1
    steps = ("critical_raw", "critical_first", "critical_unmodified", "critical_modified")
    assert [value(table, k) for k in steps] == pytest.approx([0, 1 / 3, 2 / 3, 2 / 3])
    assert value(table, "rear_end") == pytest.approx(1 / 3)


def test_the_gates_and_the_papers_criterion() -> None:
    near = attempt(min_ttc=0.4, paper_centre_distance={"minimum": 3.0})
    off = attempt(collided=True, feasible=False, failed_gates=["off_road", "third_party"])
    table = make_table([cell("straight-1", "expert", near), cell("straight-2", "expert", off)], title="Made")
    keys = ("collision", "no_rear", "paper_collision", "paper_collision_2_5", "off_road", "third_party", "infeasible")
    assert [value(table, k) for k in keys] == [0.5, 0, 1, 0.5, 0.5, 0.5, 0.5]
    assert (value(table, "mean_min_ttc"), value(table, "mean_min_ttc_paper")) == (pytest.approx(0.2), 0)


def test_cost_with_and_without_the_model() -> None:
    usage = {"model": "m", "calls": 3, "prompt_tokens": 900, "completion_tokens": 100, "seconds": 1.5}
    timing = {"total": 2.0, "waited": 0.6, "first_valid": 0.5}  # three questions of 0.5 s each, nearly all at once
    cells = [
        cell("straight-1", "llm-a", attempt(valid=True, level="valid"), llm=usage, recall="hit", timing=timing),
        cell("straight-2", "llm-a", attempt(min_ttc=2.0), recall="generated"),
        cell("straight-3", "llm-a", attempt(min_ttc=2.0)),
    ]
    table = make_table(cells, title="Made")
    values = {k: value(table, k, "llm-a") for k in ("seconds", "seconds_model", "seconds_valid", "calls", "memory_hit")}
    assert values.pop("seconds") == pytest.approx(1.8)
    assert values == {"seconds_model": 2, "seconds_valid": 0.5, "calls": 1, "memory_hit": 0.5}
    assert value(table, "tokens", "llm-a") == pytest.approx(1000 / 3)


def test_robust_is_asked_of_valid_winners_only() -> None:
    held = {"valid": 4, "of": 6, "robust": True}
    lost = {"valid": 3, "of": 6, "robust": False}
    cells = [
        cell("straight-1", "expert", attempt(strict=True)) | {"robust": held},
        cell("straight-2", "expert", attempt(valid=True)) | {"robust": lost},
        cell("straight-3", "expert", attempt(collided=True)) | {"robust": None},
    ]
    assert value(make_table(cells, title="Made"), "robust") == 0.5


def test_realism_pools_steps() -> None:
    motion = {
        "adversary": {"speed": [10.2] * 20, "acceleration": [1.1] * 20},
        "raw": {"speed": [13.2] * 100, "acceleration": [1.1] * 100},
    }
    few, many = ({"abnormal_lateral_share": s, "steps": n} for s, n in ((0.5, 10), (0.0, 90)))
    cells = [
        cell("straight-1", "expert", attempt(valid=True), motion=motion, realism=few),
        cell("straight-2", "expert", attempt(valid=True), realism=many),
    ]
    table = make_table(cells, title="Made")
    assert value(table, "speed_wasserstein") == pytest.approx(3)
    assert value(table, "acceleration_wasserstein") == pytest.approx(0)
    assert value(table, "speed_kl") > 3  # 20 of 20 steps where the reference has 0.1 of 104
    assert value(table, "abnormal_lateral") == pytest.approx(0.05)
    entry = table.entry("idm", "all", "expert", "speed_kl")
    assert entry is not None and entry.estimate.n == 1


@pytest.mark.parametrize(
    ("row", "of_the_paper"),
    [
        ("raw", "Raw"), ("expert", "LLM-A (R1)"), ("llm-a:deepseek-reasoner", "LLM-A (R1)"), ("llm-f", "LLM-F (V3)"),
        ("llm-a:deepseek-chat", "LLM-A (V3)"), ("llm-a:qwen3", "LLM-A (R1)"), ("random", None),
        ("expert+tuner=off", None),
    ],
)  # fmt: skip
def test_which_row_of_the_paper_a_row_stands_beside(row: str, of_the_paper: str | None) -> None:
    assert counterpart(row) == of_the_paper


def test_w1_and_its_interval_reach_beyond_the_histogram() -> None:
    """-20 m/s2 where others do not brake, a histogram that ends at -8: W1 is 20, in every resample."""
    motion = {who: {"speed": [9.0] * 5, "acceleration": [a] * 5} for who, a in (("adversary", -20.0), ("raw", 0.0))}
    cells = [cell(f"straight-{k}", "expert", attempt(valid=True), motion=motion) for k in range(3)]
    entry = make_table(cells, title="Made").entry("idm", "all", "expert", "acceleration_wasserstein")
    assert entry is not None and entry.estimate.value == pytest.approx(20)
    assert (entry.estimate.low, entry.estimate.high) == (pytest.approx(20, abs=0.02), pytest.approx(20, abs=0.02))


def test_rows_are_compared_over_the_encounters_both_have() -> None:
    better = [cell(f"straight-{k}", "expert", attempt(valid=True)) for k in range(6)]
    worse = [cell(f"straight-{k}", "random", attempt(min_ttc=5.0)) for k in range(5)]
    table = make_table([*better, *worse], title="Made", reference="expert")
    entry = table.entry("idm", "all", "random", "valid")
    assert entry is not None and entry.difference is not None
    assert (entry.difference.difference, entry.difference.n) == (-1, 5)
    assert entry.difference.p == pytest.approx(2 / 2**5)  # McNemar: 5 discordant pairs, all one way
    ttc = table.entry("idm", "all", "random", "mean_min_ttc")
    assert ttc is not None and ttc.difference is not None and ttc.difference.difference == 5
    assert value(table, "valid") == 1 and table.entry("idm", "all", "expert", "valid").difference is None  # type: ignore[union-attr]


def test_egos_groups_and_kinds_stand_for_themselves() -> None:
    cells = [*four(), *(c | {"ego": "replay"} for c in four()[:1])]
    table = make_table(cells, title="Made")
    assert table.egos == ("idm", "replay")
    assert value(table, "valid", ego="replay") == 1 and value(table, "valid") == 0.25
    assert table.parts("idm") == ["all", "straight", "intersection", "leader", "crossing_priority"]
    assert value(table, "valid", part="straight") == 0.5 and value(table, "valid", part="crossing_priority") == 0
    assert value(table, "tokens", part="straight") is None  # only the main columns by part


def test_the_unattacked_row_has_what_it_can_have() -> None:
    table = make_table([unattacked("straight-1"), unattacked("straight-2", min_ttc=3.0), *four()], title="Made")
    assert value(table, "mean_min_ttc", "raw") == 6.5 and value(table, "collision", "raw") == 0
    assert value(table, "valid", "raw") is None and value(table, "calls", "raw") is None
    assert table.reference == "expert"


def test_missing_cells_are_told() -> None:
    cases = [SuiteCase(f"straight-{k}", Path("x"), None, "leader", "straight") for k in range(9)]
    cells = [cell("straight-0", "expert", attempt(valid=True))]
    table = make_table(cells, title="Made", cases=cases, rows=["expert", "random"], egos=["idm", "eidm"])
    assert len(table.notes) == 5  # each ego and row; what no row made valid
    assert table.notes[4] == "No row makes 0 of 1 encounters valid against idm: 0.00 (0.00-0.79)."
    assert table.notes[0].startswith("expert against idm: 8 of 9 cells are missing (straight-1, straight-2,")
    assert "and 2 more" in table.notes[0] and table.notes[1].startswith("random against idm: 9 of 9")
    assert table.notes[0] in to_markdown(table)
    assert not any("missing" in note for note in make_table(cells, title="Made", cases=cases[:1]).notes)


def test_files(tmp_path: Path) -> None:
    cells = [unattacked("straight-1"), *four()]
    table = make_table(cells, title="Made up")
    written = write_table(table, cells, tmp_path / "out", ABOUT)
    assert {p.name for p in written} == {p.name for p in (tmp_path / "out").iterdir()}
    text = (tmp_path / "out/table.md").read_text()
    assert "| `expert` | 4 | 0.50 (0.15–0.85) | 0.50 (0.15–0.85) | 0.25 (0.05–0.70) |" in text
    assert "| LLM-A (R1) | 1.08 | 0.75 |" in text and "| Raw | 1.62 | 0.00 | `raw` | 10.00 (10.00–10.00) |" in text
    with (tmp_path / "out/table.csv").open() as file:
        rows = {(r["part"], r["row"], r["column"]): r for r in csv.DictReader(file)}
    assert float(rows["all", "expert", "valid"]["value"]) == 0.25 and rows["all", "expert", "valid"]["n"] == "4"
    document = json.loads((tmp_path / "out/table.json").read_text())
    assert len(document["entries"]) == len(rows)
    manifest = json.loads((tmp_path / "out/table.manifest.json").read_text())
    assert manifest["content"] == "c0ffee" and manifest["cells"] == 5 and manifest["bank_hash"] == "ba4c"


def test_rows_may_be_explained() -> None:
    cells = [*four("expert"), *four("expert+replan=60")]
    table = make_table(cells, title="Made", reference="expert", words={"expert+replan=60": "no replanning"})
    text = to_markdown(table)
    assert "| `expert+replan=60` | no replanning |" in text
    assert "### Differences to `expert`" in text


def test_equal_cells_give_equal_bytes(tmp_path: Path) -> None:
    cells = four()
    slower = [c | {"timing": {"total": 9.0}} for c in cells[::-1]]
    first = write_table(make_table(cells, title="Made"), cells, tmp_path / "a", ABOUT)
    write_table(make_table(cells, title="Made"), slower, tmp_path / "b", ABOUT)
    for path in first:
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="cannot be written"):
        write_table(make_table(four(), title="Made"), four(), tmp_path / "file" / "out", ABOUT)
