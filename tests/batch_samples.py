"""Batches for the tests: a small plan, drivers that misbehave, and what a batch's folder holds."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cli_samples import Done, Program
from ego_samples import BRAKES_AT, CalmEgo

from sumo_adv.campaigns.results import CLOCK_COLUMNS
from sumo_adv.drivers import LaneSpeed, Observation

INPUTS = ("motorway_cut_in_left", "t_junction_left_into_stem")
SETTINGS: Mapping[str, Any] = {"attempts": 1, "proposals": 8, "duration": 6.0, "delays": [0.0], "shortlist": 2}
"""An episode costs less than half a second of core with them, so the start of processes is most of a test."""
SETTINGS_FILE = "".join(f"{name} = {value}\n" for name, value in SETTINGS.items())
QUICK = tuple(word for name, value in SETTINGS.items() for word in ("--set", f"{name}={value}"))
SMALL = ("batch", *INPUTS, "--seeds", "2", *QUICK, "--out", "out")
RUN = {"outcome.json", "manifest.json", "states.csv.gz", "raw.csv.gz", "criticality.csv.gz", "inputs"}
CRASHED = Path("crashed")  # in the folder that the program runs in


class HangingEgo(CalmEgo):
    """Sleeps for an hour at 6 s."""

    name = "hanging"

    def act(self, seen: Observation) -> LaneSpeed | None:
        """Hangs when it is time."""
        if seen.time > BRAKES_AT:
            time.sleep(3600.0)
        return None


class CrashingEgo(CalmEgo):
    """Takes its process down with it at 6 s."""

    name = "crashing"

    def act(self, seen: Observation) -> LaneSpeed | None:
        """Crashes when it is time."""
        if seen.time > BRAKES_AT:
            os.kill(os.getpid(), signal.SIGSEGV)
        return None


class OnceCrashingEgo(CalmEgo):
    """Crashes the first time that it ever drives."""

    name = "calm"

    def act(self, seen: Observation) -> LaneSpeed | None:
        """Crashes unless it did before."""
        if not CRASHED.exists():
            CRASHED.touch()
            os.kill(os.getpid(), signal.SIGSEGV)
        return None


def table(folder: Path) -> list[dict[str, str]]:
    """``results.csv`` without what the clock says."""
    with (folder / "results.csv").open(newline="", encoding="utf-8") as file:
        return [{k: v for k, v in row.items() if k not in CLOCK_COLUMNS} for row in csv.DictReader(file)]


def summary(done: Done) -> dict[str, Any]:
    """What ``--json`` said, of a batch that went well."""
    assert (done.status, done.err) == (0, ""), done.err
    return dict(json.loads(done.out))


def clean(program: Program, *others: str) -> None:
    """Nothing is left of a batch but its folder, and that holds nothing half-written."""
    assert program.leftovers() == sorted([*others, "out"])
    left = [p.name for p in (program.folder / "out").rglob("*") if p.name.startswith(".")]
    assert left == []


def workers_of(parent: int) -> list[int]:
    """The worker processes of a batch: its children that lead a process group."""
    try:
        children = [int(w) for f in Path(f"/proc/{parent}/task").glob("*/children") for w in f.read_text().split()]
        return [pid for pid in children if pid == os.getpgid(pid)]
    except OSError:
        return []


# -- batches of the soak tests -----------------------------------------------------------------------------------------

LONGEST = 4 * 3600.0  # s


def finished(program: Program) -> int:
    """Runs that are whole."""
    runs = program.folder / "out" / "runs"
    return sum(not p.name.startswith(".") for p in runs.iterdir()) if runs.is_dir() else 0


def patient(program: Program, process: subprocess.Popen[str]) -> Done:
    """The program once it has ended."""
    out, err = process.communicate(timeout=LONGEST)
    return Done(process.returncode, out, err, program.folder / "out")


def thin_out(program: Program) -> None:
    """Lose every second run, if all are there."""
    runs = sorted(p for p in (program.folder / "out" / "runs").iterdir() if not p.name.startswith("."))
    if (program.folder / "out" / "results.csv").is_file() and len(table(program.folder / "out")) == len(runs):
        for run in runs[::2]:
            shutil.rmtree(run)
