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
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import pytest
from cli_samples import PATIENCE
from test_interrupt import children_of

from sumo_adv.datatypes import Level

INPUTS = ("motorway_cut_in_left", "neighbour_ahead_left", "leader_brakes_hard", "priority_crossing", "two_way_4lane")
KILLS = 10
LONGEST = 12.0  # s that a hunt may run before it is killed, besides waiting for its first run


def finished(hunt: Path) -> set[str]:
    """The runs of a hunt and their further attacks that are whole; those that are being written are hidden."""
    names = {file.parent.relative_to(hunt) for file in (hunt / "rounds").rglob("outcome.json")}
    return {name.as_posix() for name in names if not any(part.startswith(".") for part in name.parts)}


def level_of(run: Path) -> Level:
    """The level of an attack."""
    judged = json.loads((run / "outcome.json").read_text(encoding="utf-8"))["outcome"]
    return Level.NONE if judged is None else Level[judged["level"].upper()]


def start_and_kill(command: Sequence[str], place: Path, seconds: float, *, after_a_run: bool) -> None:
    """Kill a hunt with all of its processes ``seconds`` after it was started, or after its first run is whole.

    An encounter takes as long as the machine lets it: by the clock alone, ten kills may all come before a run is whole.
    """
    with subprocess.Popen(
        command, cwd=place, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    ) as process:
        deadline = time.monotonic() + PATIENCE
        while after_a_run and not finished(place / "hunt") and time.monotonic() < deadline:
            time.sleep(0.1)
        time.sleep(seconds)
        family = children_of(process.pid)
        os.kill(process.pid, signal.SIGKILL)
        for pid in family:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


@pytest.mark.soak
def test_a_hunt_that_is_killed_ten_times_loses_nothing(tmp_path: Path) -> None:
    """A run that was finished before a kill is there after the next start, and the table at the end counts them all."""
    command = [sys.executable, "-m", "sumo_adv", "hunt", *INPUTS, "--ego", "idm", "--minutes", "0.5", "--out", "hunt"]
    draw, before, hunt = random.Random(7), set[str](), tmp_path / "hunt"
    for k in range(KILLS):
        start_and_kill(command, tmp_path, draw.uniform(0.0, LONGEST), after_a_run=k == 0)
        now = finished(hunt)
        assert before <= now
        before = now
    assert before
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert before <= finished(hunt)
    valid = [name for name in finished(hunt) if level_of(hunt / name) >= Level.VALID]
    with (hunt / "results.csv").open(newline="", encoding="utf-8") as text:
        rows = list(csv.DictReader(text))
    assert sum(int(row["count"]) for row in rows) == len(valid)
    assert len(list((hunt / "failures").glob("*"))) == len(rows)
