"""A hunt that is killed ten times at random moments loses nothing that it has found."""

from __future__ import annotations

import csv
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from test_interrupt import children_of

from sumo_adv.datatypes import Level

INPUTS = ("motorway_cut_in_left", "neighbour_ahead_left", "leader_brakes_hard", "priority_crossing", "two_way_4lane")
KILLS = 10


def finished(hunt: Path) -> set[str]:
    """The runs of a hunt and their further attacks that are whole."""
    return {file.parent.relative_to(hunt).as_posix() for file in (hunt / "rounds").rglob("outcome.json")}


def level_of(run: Path) -> Level:
    """The level of an attack."""
    judged = json.loads((run / "outcome.json").read_text(encoding="utf-8"))["outcome"]
    return Level.NONE if judged is None else Level[judged["level"].upper()]


@pytest.mark.soak
def test_a_hunt_that_is_killed_ten_times_loses_nothing(tmp_path: Path) -> None:
    """A run that was finished before a kill is there after the next start, and the table at the end counts them all."""
    command = [sys.executable, "-m", "sumo_adv", "hunt", *INPUTS, "--ego", "idm", "--minutes", "3", "--out", "hunt"]
    draw, before = random.Random(7), set[str]()
    for _ in range(KILLS):
        with subprocess.Popen(
            command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        ) as process:
            time.sleep(draw.uniform(10.0, 40.0))
            family = children_of(process.pid)
            os.kill(process.pid, signal.SIGKILL)
            for pid in family:
                try:
                    os.kill(pid, signal.SIGKILL)
                except ProcessLookupError:
                    continue
        now = finished(tmp_path / "hunt")
        assert before <= now
        before = now
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert before and before <= finished(tmp_path / "hunt")
    valid = [folder for folder in finished(tmp_path / "hunt") if level_of(tmp_path / "hunt" / folder) >= Level.VALID]
    with (tmp_path / "hunt" / "results.csv").open(newline="", encoding="utf-8") as text:
        rows = list(csv.DictReader(text))
    assert sum(int(row["count"]) for row in rows) == len(valid)
    assert len(list((tmp_path / "hunt" / "failures").iterdir())) == len(rows)
