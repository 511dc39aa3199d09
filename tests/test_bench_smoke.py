"""The shipped suites as they are, and the table of the small one from the command to the file."""

from __future__ import annotations

import csv
from collections import Counter

import pytest
from cli_samples import Program

from sumo_adv.benchmark.suites import load_suite


def test_suite81_has_fifty_straight_and_thirty_one_intersection_encounters() -> None:
    suite = load_suite("suite81")
    assert Counter(case.group for case in suite.cases) == {"straight": 50, "intersection": 31}
    assert len({case.name for case in suite.cases}) == 81
    small = load_suite("smoke")
    assert Counter(case.group for case in small.cases) == {"straight": 3, "intersection": 3}
    assert {case.name for case in small.cases} <= {case.name for case in suite.cases}


@pytest.mark.soak
def test_the_table_of_smoke(program: Program) -> None:
    """In no encounter the ego is in danger unattacked; with three attempts the expert makes most of them critical."""
    done = program(
        "bench", "table", "--suite", "smoke", "--ego", "idm", "--row", "raw", "--row", "expert",
        "--row", "transformer", "--attempts", "3", "--set", "proposals=40", "--out", "out",
    )  # fmt: skip
    assert done.status == 0, done.err
    with (program.folder / "out" / "table.csv").open(newline="", encoding="utf-8") as file:
        figures = {(r["row"], r["column"]): r for r in csv.DictReader(file) if r["part"] == "all"}
    assert {figures[row, "critical"]["n"] for row in ("raw", "expert")} == {"6"}
    assert float(figures["raw", "critical"]["value"]) == 0.0
    assert float(figures["expert", "critical"]["value"]) >= 3 / 6
    assert all(float(figures[r, "failed"]["value"]) == 0.0 for r in ("raw", "expert", "transformer"))
    assert float(figures["transformer", "critical"]["value"]) >= 1 / 6
    text = (program.folder / "out" / "table.md").read_text(encoding="utf-8")
    assert "| Transformer | 1.73 | 0.41 | `transformer` |" in text
    assert len(list((program.folder / "out" / "figures").glob("*.png"))) >= 3
