"""Runs of the real program for the tests of the command line, what they leave behind, and banks to run them with."""

from __future__ import annotations

import csv
import gzip
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from sumo_adv.errors import SumoAdvError
from sumo_adv.files import held, write_text
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.records import IntentRecord
from sumo_adv.planners.text import make_planner

TESTS = Path(__file__).resolve().parent
ROOT = TESTS.parent
PATIENCE = 180.0  # s: no run of the tests takes a tenth of it

LEADER = ("run", "leader_two_lanes", "--until", "valid", "--attempts", "8")
AHEAD_BANK = "ahead.sqlite"
AHEAD_OF_IT = (
    "run", "motorway_cut_in_left", "--attempts", "1", "--tuner", "off", "--adversary", "left_ahead",
    "--memory", AHEAD_BANK, "--learn", "off", "--json",
)  # fmt: skip
SAMPLES: Mapping[str, Sequence[str]] = {
    "first": (*LEADER, "--json"),
    "again": LEADER,
    "loaded": (*LEADER, "--json", "--no-fork"),
    "other seed": (*LEADER, "--json", "--seed", "1"),
    "calm": (*AHEAD_OF_IT, "--ego", "ego_samples:CalmEgo"),
    "braking": (*AHEAD_OF_IT, "--ego", "ego_samples:BrakingEgo"),
    "nothing": ("run", "straight_3lane", "--density", "1", "--end", "20", "--json"),
    "krauss": ("run", "neighbour_ahead_left", "--ego", "krauss", "--json"),
    "eidm": ("run", "follower_with_free_lane", "--ego", "eidm", "--attempts", "3", "--json"),
    "replay": ("run", "motorway_cut_in_right", "--ego", "replay", "--attempts", "3", "--json"),
    "careful": ("run", "oncoming_country_road", "--ego", "careful", "--attempts", "3", "--json"),
}
"""Arguments by name; each gets its own home and ``--out out``."""


def own_memory(pid: int) -> float:
    """Resident memory [MB] without pages of files, which the kernel drops and reads again; 0 after the end."""
    try:
        resident, shared = map(int, Path(f"/proc/{pid}/statm").read_text().split()[1:3])
    except OSError:
        return 0.0
    return (resident - shared) * os.sysconf("SC_PAGE_SIZE") / 1e6


@dataclass(frozen=True)
class Done:
    """A program that has ended."""

    status: int
    out: str
    err: str
    folder: Path

    @property
    def outcome(self) -> dict[str, Any]:
        """``outcome.json`` of the run."""
        return dict(json.loads((self.folder / "outcome.json").read_text(encoding="utf-8")))

    @property
    def manifest(self) -> dict[str, Any]:
        """``manifest.json`` of the run."""
        return dict(json.loads((self.folder / "manifest.json").read_text(encoding="utf-8")))


class Program:
    """``python -m sumo_adv`` in ``folder``, with its home and its temporary files in there; ``variables`` are
    set in its environment."""

    def __init__(self, folder: Path, caches: Path) -> None:
        self.folder = folder
        self.temporary = folder / "temporary"
        self.home = folder / "home"
        self.variables: dict[str, str] = {}
        self._caches = caches
        for made in (self.temporary, self.home):
            made.mkdir(parents=True, exist_ok=True)

    def environment(self) -> dict[str, str]:
        """Nothing of the tester's own settings, bank or home."""
        kept = {k: v for k, v in os.environ.items() if not k.startswith(("SUMO_ADV_", "XDG_", "MPL"))}
        return {
            **kept, "HOME": str(self.home), "XDG_DATA_HOME": str(self.home / "data"), "MPLCONFIGDIR": str(self._caches),
            "TMPDIR": str(self.temporary), "PYTHONPATH": os.pathsep.join((str(ROOT), str(TESTS))), "NO_COLOR": "1",
            **self.variables,
        }  # fmt: skip

    def start(self, *arguments: str | Path, before: Sequence[str] = (), **options: Any) -> subprocess.Popen[str]:
        """A process (and a process group) of its own; ``before`` is put in front of the command."""
        command = [*before, sys.executable, "-m", "sumo_adv", *map(str, arguments)]
        return subprocess.Popen(
            command, cwd=self.folder, env=self.environment(), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True, start_new_session=True,
            **{"preexec_fn": let_interrupt, **options},
        )  # fmt: skip

    def __call__(self, *arguments: str | Path, **options: Any) -> Done:
        """Run to the end; a run's files are expected in ``out``."""
        with self.start(*arguments, **options) as process:
            try:
                out, err = process.communicate(timeout=PATIENCE)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                raise
        return Done(process.returncode, out, err, self.folder / "out")

    def here(self, *arguments: str | Path) -> Done:
        """The same in this process, which saves a start of Python: for tests that ask nothing of the process itself,
        of its signals, and of what SUMO says on its own stderr. ``Runs`` and the tests of interrupts show those."""
        from typer.testing import CliRunner

        from sumo_adv.cli.main import app

        unset = dict.fromkeys(name for name in os.environ if name.startswith(("SUMO_ADV_", "XDG_", "MPL")))
        before, tempfile.tempdir = tempfile.tempdir, str(self.temporary)
        try:
            with chdir(self.folder):
                done = CliRunner().invoke(app, [*map(str, arguments)], env={**unset, **self.environment()})
        finally:
            tempfile.tempdir = before
        status, err = done.exit_code, done.stderr
        if isinstance(done.exception, SumoAdvError):
            status, err = done.exception.exit_status, f"{err}sumo-adv: {done.exception}\n"
        elif done.exception is not None and not isinstance(done.exception, SystemExit):
            raise done.exception
        return Done(status, done.stdout, err, self.folder / "out")

    def leftovers(self) -> list[str]:
        """What lies in the folder besides the home and the temporary folder, and what lies in the latter."""
        own = sorted(p.name for p in self.folder.iterdir() if p not in (self.home, self.temporary))
        return own + sorted(f"temporary/{p.name}" for p in self.temporary.iterdir())


def tiny_disk(folder: Path, size: str, then: str) -> tuple[str, ...]:
    """What to put before a command to give it a disk of a ``size`` in ``folder``, and a line of shell for after
    it. Skips the test where nothing can be mounted."""
    folder.mkdir()
    if not shutil.which("unshare") or subprocess.run(["unshare", "-rm", "true"], capture_output=True).returncode:
        pytest.skip("no tiny disk can be mounted here (unshare is missing or not allowed)")
    mount = f'mount -t tmpfs -o size={size} tmpfs "{folder}"'
    if subprocess.run(["unshare", "-rm", "sh", "-c", mount], capture_output=True).returncode:
        pytest.skip("no tiny disk can be mounted here (mount is not allowed)")
    return ("unshare", "-rm", "sh", "-c", f'{mount} || exit 77; "$@"; status=$?; {then}; exit $status', "sh")


def let_interrupt() -> None:
    """In the child, before it starts: Ctrl-C is not ignored, as it is in a shell's background jobs."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class Runs:
    """``runs["first"]``: the sample of that name. The first process that asks runs it; others wait for it."""

    def __init__(self, folder: Path, caches: Path) -> None:
        self._folder, self._caches = folder, caches
        folder.mkdir(exist_ok=True)

    def __getitem__(self, name: str) -> Done:
        folder = self._folder / name.replace(" ", "_")
        said = folder.with_suffix(".json")
        while not said.exists():
            with held(folder.with_suffix(".lock")) as mine:
                if mine and not said.exists():
                    program = Program(folder, self._caches)
                    if AHEAD_BANK in SAMPLES[name]:
                        bank_with(folder / AHEAD_BANK, AHEAD)
                    done = program(*SAMPLES[name], "--out", "out")
                    write_text(said, json.dumps([done.status, done.out, done.err]))
            time.sleep(0.0 if mine else 0.1)
        status, out, err = json.loads(said.read_text(encoding="utf-8"))
        return Done(status, out, err, folder / "out")


# -- what runs leave behind --------------------------------------------------------------------------------------------

RUN_FILES = {"outcome.json", "manifest.json", "states.csv.gz", "raw.csv.gz", "encounter.png", "inputs"}
"""Of the contract; others may be added."""
States = dict[str, dict[float, dict[str, str]]]


def lacking(folder: Path, files: set[str] = RUN_FILES) -> set[str]:
    """Files that a run's folder lacks, and files that it must not have: hidden and half-written ones."""
    present = {p.name for p in folder.iterdir()}
    return (files - present) | {name for name in present if name.startswith(".") or name.endswith((".part", ".tmp"))}


def read_states(file: Path) -> States:
    """A table of states as vehicle -> time [s] -> row."""
    states: States = {}
    with gzip.open(file, "rt", newline="", encoding="utf-8") as text:
        for row in csv.DictReader(text):
            states.setdefault(row["id"], {})[float(row["time"])] = row
    return states


def position(row: Mapping[str, str]) -> tuple[float, float]:
    """x, y [m]."""
    return float(row["x"]), float(row["y"])


def refused(done: Done, status: int, *says: str) -> None:
    """One sentence on stderr, nothing on stdout, no traceback."""
    assert (done.status, done.out) == (status, ""), done.err
    assert done.err.startswith("sumo-adv: ") and len(done.err.splitlines()) == 1, done.err
    assert done.err.rstrip().endswith("."), done.err
    assert [word for word in says if word not in done.err] == []


def refusal_of(program: Program, *options: str) -> str:
    """The sentence that refuses a command before anything has begun."""
    before = program.leftovers()
    done = program.here(*options)
    refused(done, 2)
    assert program.leftovers() == before
    return done.err


def moves(row: Mapping[str, str]) -> tuple[str, ...]:
    """All of a row but the role."""
    return tuple(value for key, value in row.items() if key != "role")


def files_of(folder: Path) -> dict[str, bytes]:
    """All files below a folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def untimed(outcome: Mapping[str, Any]) -> dict[str, Any]:
    """An outcome without what the clock says."""
    return {k: v for k, v in outcome.items() if k != "timing"}


# -- banks -------------------------------------------------------------------------------------------------------------

HEAD = """\
PARAMETERS = {"gap": (3.0, 1.0, 9.0, "m", "how far ahead of where the ego will be")}


def endpoint(bv, ego, road, parameters, acc, horizon):
"""
TRAIL = (
    HEAD
    + """\
    pose = at(ego["path"], 3.0)
    x, y = offset(pose, bv["ahead"] + parameters["gap"], bv["left"])
    return {"x": x, "y": y, "heading": pose[2], "speed": pose[3], "time": 3.0}
"""
)
AHEAD = (
    HEAD
    + """\
    ahead = ego["x"] + 3.0 * ego["speed"] + 20.0
    return {"x": ahead, "y": road["left"], "heading": 0.0, "speed": ego["speed"], "time": 3.0}
"""
)
"""Goes by where the ego is and how fast, not by what is foreseen of it: that is another for each driver."""
BAD_PLANNERS: Mapping[str, str] = {
    "loops": HEAD + "    while True:\n        pass\n",
    "allocates": HEAD + "    return [0] * 10**9\n",
    "not a number": HEAD + '    return {"x": float("nan"), "y": 0.0, "heading": 0.0, "speed": 5.0, "time": 2.0}\n',
    "teleports": HEAD + '    return {"x": 1e4, "y": 0.0, "heading": 0.0, "speed": 5.0, "time": 0.2}\n',
    "another type": HEAD + '    return "over there"\n',
    "raises": HEAD + "    return 1 / 0\n",
}
"""Planners by what is wrong with them. TRAIL has nothing wrong with it, but it only drives beside the ego."""


def bank_with(path: Path, source: str) -> Path:
    """A bank with ``source`` as its only planner."""
    intent = IntentRecord("Odd Driving", "A vehicle near the ego drives in an odd way.", ("neighbour", "leader"))
    with MemoryBank.open(path) as bank:
        bank.add(intent, [make_planner(intent.label, "odd", source, "person")])
    return path


def without_progress(err: str) -> str:
    """Return what a program wrote to stderr, without the lines of progress that come if it takes over 20 s."""
    return re.sub(r"^\d+ of (at most )?\d+ .*done.*\n", "", err, flags=re.MULTILINE)
