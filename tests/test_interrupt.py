"""Ctrl-C in a terminal goes to the whole process group: whole files or none are left, and no process lives on."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from cli_samples import PATIENCE, RUN_FILES, Done, Program, lacking

GONE_WITHIN = 5.0  # s


def processes_of(session: int) -> set[int]:
    """Living processes of a session (``setsid``), zombies not counted."""
    pids = set()
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue  # it ended meanwhile
        if fields[0] != "Z" and int(fields[3]) == session:
            pids.add(int(entry.name))
    return pids


def children_of(root: int) -> set[int]:
    """The process and all below it, also those that made a session of their own."""
    family, new = set[int](), {root}
    while new:
        family |= new
        new = {child for parent in new for child in _children(parent)} - family
    return family


def _children(parent: int) -> set[int]:
    try:
        files = list(Path(f"/proc/{parent}/task").glob("*/children"))
        return {int(word) for file in files for word in file.read_text().split()}
    except OSError:
        return set()


def alive(pids: set[int]) -> set[int]:
    """Those that still run."""
    return {pid for pid in pids if _state(pid) not in ("", "Z")}


def _state(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return ""


def interrupted(
    program: Program, process: subprocess.Popen[str], sent: signal.Signals = signal.SIGINT, *, group: bool = True
) -> Done:
    """Press Ctrl-C, or send another signal, to all of its processes or to itself alone; wait for the end, and see that
    nothing of the run lives on."""
    family = children_of(process.pid) | processes_of(process.pid)
    (os.killpg if group else os.kill)(process.pid, sent)
    try:
        out, err = process.communicate(timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        raise
    deadline = time.monotonic() + GONE_WITHIN
    while (left := alive(family) | processes_of(process.pid)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert left == set(), "something of the run lives on"
    return Done(process.returncode, out, err, program.folder / "out")


def read_until(process: subprocess.Popen[str], mark: str) -> None:
    """Read the program's lines up to one with ``mark``."""
    assert process.stdout is not None
    for line in process.stdout:
        if mark in line:
            return
    raise AssertionError(f"the program ended without saying {mark!r}")


def wait_until(process: subprocess.Popen[str], holds: Callable[[], bool]) -> None:
    """Until something holds, or the program has ended."""
    deadline = time.monotonic() + PATIENCE
    while not holds() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.005)


def whole_or_nothing(program: Program, done: Done, others: list[str]) -> None:
    """Exit 1, a sentence, and either all files of an interrupted run or no folder."""
    assert done.status == 1, done.err
    assert "Traceback" not in done.err
    if done.folder.exists():
        outcome = done.outcome
        assert outcome["ending"] == "interrupted"
        assert "interrupted" in done.err
        expected = RUN_FILES if outcome["attempts"] else RUN_FILES - {"encounter.png"}
        expected = expected if outcome["encounter"] else {"outcome.json", "manifest.json", "inputs"}
        assert lacking(done.folder, expected) == set()
        assert done.manifest["schema"] == 1
    assert program.leftovers() == sorted([*others, "out"] if done.folder.exists() else others)


def test_ctrl_c_while_an_encounter_is_looked_for(program: Program) -> None:
    """Two lonely vehicles a minute, looked at for ten hours."""
    options = ("--density", "2", "--end", "36000", "--out", "out")
    with program.start("run", "straight_3lane", *options) as process:
        wait_until(process, lambda: any(program.folder.glob(".out.*")))
        time.sleep(1.5)
        done = interrupted(program, process)
    whole_or_nothing(program, done, [])


@pytest.mark.parametrize("mark", ["Encounter at", pytest.param("Most dangerous", marks=pytest.mark.soak), "attempt  1"])
def test_ctrl_c_in_the_middle(program: Program, mark: str) -> None:
    """Twenty kinds of attacks are more than there are, so there is always another candidate to look for."""
    options = ("--diverse", "20", "--until", "valid", "--memory", "bank.sqlite", "--out", "out")
    with program.start("run", "oncoming_four_lanes", *options) as process:
        read_until(process, mark)
        done = interrupted(program, process)
    whole_or_nothing(program, done, ["bank.sqlite"])
    assert done.folder.exists()  # the run had begun
    if mark.startswith("attempt"):
        assert len(done.outcome["attempts"]) >= int(mark.split()[1])


@pytest.mark.parametrize(
    ("mark", "group"),
    [("Encounter at", False), ("attempt  1", True)],
    ids=["to the program", "to all of its processes"],
)
def test_sigterm_in_the_middle(program: Program, mark: str, group: bool) -> None:
    """As services, containers and time limits end a program."""
    options = ("--diverse", "20", "--until", "valid", "--memory", "bank.sqlite", "--out", "out")
    with program.start("run", "oncoming_four_lanes", *options) as process:
        read_until(process, mark)
        done = interrupted(program, process, signal.SIGTERM, group=group)
    whole_or_nothing(program, done, ["bank.sqlite"])
    assert done.folder.exists()


def test_sigterm_of_a_table_leaves_no_temporary_folder(program: Program) -> None:
    options = ("--suite", "smoke", "--row", "expert", "--out", "out", "--workers", "1")
    with program.start("bench", "table", *options) as process:
        wait_until(process, lambda: any(program.temporary.iterdir()))
        done = interrupted(program, process, signal.SIGTERM, group=False)
    assert done.status == 1 and "Traceback" not in done.err
    assert list(program.temporary.iterdir()) == []


def has_handler(process: subprocess.Popen[str]) -> bool:
    """Whether the program has begun, so that SIGTERM is caught (Python itself does not catch it)."""
    try:
        status = Path(f"/proc/{process.pid}/status").read_text()
    except OSError:
        return False
    caught = next(int(line.split()[1], 16) for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(caught >> (signal.SIGTERM - 1) & 1)


@pytest.mark.parametrize(
    ("delay", "sent"),
    [(0.0, signal.SIGINT), (0.03, signal.SIGTERM), (0.1, signal.SIGINT), (0.2, signal.SIGTERM), (0.3, signal.SIGINT)],
)
def test_a_signal_in_the_first_moments(program: Program, delay: float, sent: signal.Signals) -> None:
    """While its modules are loaded, from its first instruction on."""
    with program.start("run", "motorway_cut_in_left", "--out", "out") as process:
        wait_until(process, lambda: has_handler(process))
        time.sleep(delay)
        done = interrupted(program, process, sent)
    assert (done.status, done.err) == (1, "sumo-adv: interrupted.\n")
    assert program.leftovers() == []


def test_ctrl_c_while_it_starts(program: Program) -> None:
    with program.start("run", "motorway_cut_in_left", "--out", "new/out") as process:
        wait_until(process, (program.folder / "new").exists)
        done = interrupted(program, process)
    assert done.status == 1 and "Traceback" not in done.err
    assert program.leftovers() in ([], ["new"])
    assert not (program.folder / "new").exists() or [p.name for p in (program.folder / "new").iterdir()] == ["out"]


def test_ctrl_c_while_files_are_written_leaves_whole_files(program: Program) -> None:
    with program.start("run", "motorway_cut_in_left", "--out", "out") as process:
        wait_until(process, lambda: any(program.folder.glob(".out.*/inputs")))
        done = interrupted(program, process)
    assert "Traceback" not in done.err
    assert done.folder.exists()
    assert lacking(done.folder) == set()
    assert program.leftovers() == ["out"]
