"""Tables for the terminal: at most 100 characters, rates with intervals, and the file that holds the rest."""

from __future__ import annotations

from pathlib import Path

from bench_cells import attempt, cell

from sumo_adv.benchmark.league import league, league_text
from sumo_adv.benchmark.table import make_table
from sumo_adv.benchmark.write import SCREEN_CHARACTERS, aligned, rate, table_text
from sumo_adv.metrics.statistics import Estimate

LONG = "expert+replan=60+forecast=constant+learn=off"
FILE = Path("out") / "table.md"


def test_a_rate_is_short() -> None:
    assert rate(Estimate(0.75, 0.7, 0.804, 100)) == ".75 [.70,.80]"
    assert rate(Estimate(1.0, 0.96, 1.0, 100)) == "1.0 [.96,1.0]"
    assert rate(None) == "-"


def test_a_long_name_has_a_line_of_its_own() -> None:
    assert aligned(["row", "n"], [[LONG, "81"], ["raw", "9"]]) == [
        f"{'row':26}   n", LONG, f"{'':26}  81", f"{'raw':26}   9"
    ]  # fmt: skip


def test_the_main_columns_fit_a_terminal_and_name_the_file() -> None:
    cells = [cell(f"straight-{k}", row, attempt(valid=k < 2)) for k in range(3) for row in ("expert", LONG)]
    lines = table_text(make_table(cells, title="Made"), FILE).splitlines()
    assert max(map(len, lines)) <= SCREEN_CHARACTERS and lines[-1].endswith(str(FILE))
    assert any(line.startswith("expert ") and ".67 [.21,.94]" in line for line in lines)  # Wilson of 2 of 3
    places, _ = league(cells[::2], 25)
    assert max(map(len, league_text(places, "Made", FILE).splitlines())) <= SCREEN_CHARACTERS
