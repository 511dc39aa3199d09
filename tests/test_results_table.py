"""The table of a campaign, as a test engineer reads it: its columns from a run's outcome, and its types in pandas."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from page_samples import attempt, outcome

from sumo_adv.campaigns.results import result_row, write_csv, write_parquet

HIT: dict[str, Any] = {
    "collided": True, "valid": True, "strict": True, "level": "serious", "preventable_by": ["cc_human", "fsm"],
    "inconclusive": None, "ego_stationary": False, "humanlike": True, "delta_v": 4.1, "severity": "minor",
    "fault": "adversary", "contact_time": 9.7, "min_ttc": 0.0,
    "cause": {"kind": "late", "sentence": "Your driver was late."},
}  # fmt: skip


def hit(**other: Any) -> dict[str, Any]:
    """The outcome of a run with a serious collision in its second attempt."""
    document = outcome(attempts=[attempt(0, "a"), attempt(1, "a", kind="Cut-in / neighbour / left")], best=1, **other)
    document["outcome"] |= HIT
    document["encounter"] |= {"road": "motorway", "ego_speed": 27.6}
    return document


def test_a_row_says_who_attacked_and_where() -> None:
    row = result_row("a", hit(), False)
    assert (row["level"], row["strict"], row["serious"]) == ("serious", True, True)
    assert (row["fault"], row["delta_v"], row["contact_time"]) == ("adversary", 4.1, 9.7)
    assert row["preventable_by"] == "cc_human fsm"
    assert (row["cause"], row["cause_sentence"]) == ("late", "Your driver was late.")
    assert (row["adversary"], row["relation"]) == ("adversary", "neighbour")
    assert row["kind"] == "Cut-in / neighbour / left"
    assert (row["road"], row["ego_speed"], row["ego_stationary"]) == ("motorway", 27.6, False)


def test_a_row_names_the_supports_and_their_composition() -> None:
    run = hit()
    run["adversaries"] += [{"id": "left", "role": "block_left"}, {"id": "front", "role": "slow"}]
    run["attempts"][1]["composition"] = "Box-in"
    row = result_row("a", run, False)
    assert (row["adversary"], row["supports"], row["composition"]) == (
        "adversary",
        "left:block_left front:slow",
        "Box-in",
    )
    alone = result_row("a", hit(), False)
    assert (alone["supports"], alone["composition"]) == (None, None)


def test_without_a_collision_the_questions_about_one_do_not_arise() -> None:
    row = result_row("a", outcome(), False)
    columns = ("strict", "serious", "preventable_by", "fault", "contact_time", "road", "cause")
    assert {row[name] for name in columns} == {None}
    assert (row["level"], row["kind"]) == ("critical", "")
    assert (row["adversary"], row["relation"]) == ("adversary", "neighbour")


def test_pandas_reads_the_table_with_its_types(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas", reason="pandas is not installed (extra dev)")
    rows = [result_row("a", hit(), False), result_row("b", outcome(), False)]
    write_csv(tmp_path / "results.csv", rows, ())
    frame = pandas.read_csv(tmp_path / "results.csv", index_col="id")
    assert frame.delta_v.max() == 4.1 and frame.min_ttc.dtype == float
    assert frame[frame.serious == True].index.tolist() == ["a"]  # noqa: E712 - a column
    assert frame.collided.tolist() == [True, False] and frame.serious.isna().tolist() == [False, True]
    assert frame.groupby("ego").collided.mean()["idm"] == 0.5


def test_parquet_has_the_same_types(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed (extra batch)")
    rows = [result_row("a", hit(), False), result_row("b", outcome(), False)]
    write_parquet(tmp_path / "results.parquet", rows, ())
    first, second = parquet.read_table(tmp_path / "results.parquet").to_pylist()
    assert (first["serious"], first["contact_time"], first["ego_speed"]) == (True, 9.7, 27.6)
    assert (second["serious"], second["contact_time"], second["road"]) == (None, None, None)
