"""Many episodes in a row in one process: none fails, and nothing piles up."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from cli_samples import Program

from sumo_adv.datatypes import Ending

SCRIPT = Path(__file__).with_name("soak_episodes.py")
CONTRACT = {"outcome.json", "manifest.json", "states.csv.gz", "raw.csv.gz"}
HONEST = {Ending.GOAL_MET, Ending.ATTEMPTS_EXHAUSTED, Ending.NO_ENCOUNTER}
GROWTH = 150  # MB from the first ten episodes to the last ten; most of it settles within the first few


def rows_of(program: Program, count: int, first: int, patience: float) -> list[dict[str, Any]]:
    """A line for each episode; the process itself must end well."""
    errors = program.folder / "errors.txt"
    with errors.open("w") as file:
        done = subprocess.run(
            [sys.executable, str(SCRIPT), str(count), str(first)], cwd=program.folder, env=program.environment(),
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=file, text=True, timeout=patience, check=False,
        )  # fmt: skip
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    said = errors.read_text()
    errors.unlink()
    assert (done.returncode, len(rows), said) == (0, count, ""), f"after {rows[-1:]}: {said[-2000:]}"
    return rows


def nothing_fails_or_piles_up(rows: list[dict[str, Any]]) -> None:
    """Honest endings, whole folders, and after each episode no more than after the first."""
    bad = [(r["scenario"], r["ego"], r["seed"], r["ending"]) for r in rows if r["ending"] not in HONEST or r["status"]]
    assert bad == []
    assert [r for r in rows if r["ending"] != "no_encounter" and not set(r["files"]) >= CONTRACT] == []
    for what in ("children", "temporary", "descriptors", "threads"):
        first, most = rows[0][what], max(r[what] for r in rows)
        assert most <= first, f"{what} grew from {first} to {most}: {Counter(r[what] for r in rows)}"


def test_a_few_episodes_in_a_row_leave_nothing_behind(program: Program) -> None:
    nothing_fails_or_piles_up(rows_of(program, 2, 0, 120.0))
    assert program.leftovers() == []


@pytest.mark.soak
def test_sixty_episodes_in_a_row_leave_nothing_behind(program: Program) -> None:
    rows = rows_of(program, 60, 0, 1800.0)
    nothing_fails_or_piles_up(rows)
    early, late = (max(r["megabytes"] for r in part) for part in (rows[:10], rows[-10:]))
    assert late - early < GROWTH, f"resident memory grew from {early} to {late} MB"
    critical = [r for r in rows if r["ending"] == "critical"]
    assert len(critical) >= 30, Counter(r["ending"] for r in rows)
    assert program.leftovers() == []
