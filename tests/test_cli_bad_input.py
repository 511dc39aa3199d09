"""Bad input through the real command line: one sentence, exit 2 or 1, no traceback, no folder left half-made."""

from __future__ import annotations

import ctypes
import json
import os
import resource
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from cli_samples import (
    BAD_PLANNERS,
    ROOT,
    RUN_FILES,
    TRAIL,
    Done,
    Program,
    Runs,
    bank_with,
    files_of,
    lacking,
    let_interrupt,
    refused,
    tiny_disk,
)  # fmt: skip

from sumo_adv.datatypes import Ending

QUICK = ("motorway_cut_in_left", "--attempts", "2")


def misused(done: Done, says: str) -> None:
    """The command line itself is wrong: the usual usage text."""
    assert (done.status, done.out) == (2, "")
    assert "Usage:" in done.err and says in done.err
    assert "Traceback" not in done.err


# -- inputs


def not_xml(folder: Path) -> Path:
    (folder / "noise.net.xml").write_bytes(bytes(range(256)))
    return folder / "noise.net.xml"


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda folder: folder / "missing.net.xml", "missing.net.xml"), (lambda folder: folder, "is a folder"),
        (not_xml, "not valid XML"),
    ],
    ids=["missing", "a folder", "not XML"],
)  # fmt: skip
def test_what_cannot_be_run_is_refused(program: Program, make: Callable[[Path], Path], says: str) -> None:
    given = program.folder / "given"
    given.mkdir()
    refused(program.here("run", make(given), "--out", "new/out"), 2, says)
    assert program.leftovers() == ["given"]
    assert not (program.home / "data").exists()


# -- options and settings


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--attempts", "0"), "attempts"), (("--ttc", "-1", "1"), "ttc"), (("--seed", "-1"), "seed"),
        (("--tuner", "best"), "tuner"), (("--ego", "nobody"), "nobody"), (("--end", "inf"), "end"),
        (("--ego", "no_such_module:Ego"), "no_such_module"), (("--ego", "ego_samples:NoEgo"), "NoEgo"),
        (("--ego-id", "nobody"), "nobody"), (("--adversary", "nobody"), "nobody"),
        (("--settings", "missing.toml"), "missing.toml"), (("--trigger", "nan"), "trigger"),
        (("--adversary", "nobody", "--trigger", "5"), "nobody"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)  # fmt: skip
def test_what_makes_no_sense_is_refused(program: Program, options: tuple[str, ...], says: str) -> None:
    refused(program.here("run", "leader_two_lanes", "--out", "new/out", *options), 2, says)
    assert program.leftovers() == []


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("run", "motorway_cut_in_left", "--until", "nonsense"), "nonsense"), (("run", "--colour", "red"), "--colour"),
        (("run", "motorway_cut_in_left", "--attempts", "many"), "--attempts"), (("dance",), "dance"),
    ],
    ids=["until", "unknown option", "not a number", "unknown command"],
)  # fmt: skip
def test_misuse_gets_the_usage(program: Program, options: tuple[str, ...], says: str) -> None:
    misused(program.here(*options), says)
    assert program.leftovers() == []


@pytest.mark.parametrize(
    ("text", "says"),
    [("colour = 'red'\n", "colour"), ("attempts = [\n", "settings"), ("attempts = 'all'\n", "attempts"),
     ("[limits]\nbraking = 99\n", "limits.braking")],
    ids=["unknown key", "broken TOML", "wrong type", "out of range"],
)  # fmt: skip
def test_a_bad_settings_file_is_refused(program: Program, text: str, says: str) -> None:
    (program.folder / "settings.toml").write_text(text)
    refused(program.here("run", "motorway_cut_in_left", "--out", "new/out", "--settings", "settings.toml"), 2, says)
    assert program.leftovers() == ["settings.toml"]


def test_input_and_replay_exclude_one_another(program: Program) -> None:
    refused(program.here("run", "motorway_cut_in_left", "--replay", "somewhere"), 2, "--replay")
    refused(program.here("run"), 2, "INPUT")
    refused(program.here("run", "--replay", "somewhere"), 2, "manifest.json")
    assert program.leftovers() == []


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--ego", "idm", "--attempts", "3"), "--attempts has no effect on a replay"),
        (("--seed", "1"), "--seed has no effect on a replay"),
        (("--no-fork",), "--no-fork has no effect on a replay"),
    ],
)
def test_a_replay_refuses_what_it_would_ignore(program: Program, options: tuple[str, ...], says: str) -> None:
    refused(program.here("run", "--replay", "somewhere", *options), 2, says)


def test_a_replay_with_another_ego_is_refused(program: Program, runs: Runs) -> None:
    refused(program.here("run", "--replay", runs["first"].folder, "--ego", "krauss"), 2, "was driven by 'idm'")


def test_a_run_folder_runs_no_class_that_the_command_line_does_not_name(program: Program, runs: Runs) -> None:
    """The manifest of a stranger: its driver is a shell command, then a class that is there but was not named."""
    for name in files_of(runs["calm"].folder):
        (program.folder / "copy" / name).parent.mkdir(parents=True, exist_ok=True)
        (program.folder / "copy" / name).write_bytes(files_of(runs["calm"].folder)[name])
    replay = ("run", "--replay", program.folder / "copy", "--out", "again")
    refused(program.here(*replay), 2, "name it yourself with --ego ego_samples:CalmEgo")
    manifest = json.loads((program.folder / "copy" / "manifest.json").read_text(encoding="utf-8"))
    manifest |= {"ego_driver": "subprocess:Popen", "ego_parameters": {"args": "touch proof", "shell": True}}
    (program.folder / "copy" / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
    refused(program.here(*replay), 2, "name it yourself with --ego subprocess:Popen")
    named = program.here(*replay, "--ego", "subprocess:Popen")
    assert named.status != 0 and "is a class of Python's standard library" in named.err
    assert program.leftovers() == ["copy"]


def test_a_scenario_runs_no_class_that_the_command_line_does_not_name(program: Program) -> None:
    network = ROOT / "networks" / "motorway.net.xml"
    table = "[ego]\ncontroller = 'subprocess:Popen'\nparameters = { args = 'touch proof', shell = true }\n"
    (program.folder / "strange.toml").write_text(f"schema = 1\nnetwork = '{network}'\n{table}", encoding="utf-8")
    refused(program.here("run", "strange.toml"), 2, "name it yourself with --ego subprocess:Popen")
    assert program.leftovers() == ["strange.toml"]


# -- the memory bank


def test_a_bank_that_is_not_sqlite_is_refused_and_left_alone(program: Program) -> None:
    (program.folder / "bank.sqlite").write_text("Dear diary, ...\n" * 100)
    refused(program("run", *QUICK, "--out", "new/out", "--memory", "bank.sqlite"), 2, "bank.sqlite")
    assert (program.folder / "bank.sqlite").read_text() == "Dear diary, ...\n" * 100
    assert program.leftovers() == ["bank.sqlite"]


# -- the output folder


def test_a_folder_that_is_taken_needs_force(program: Program, runs: Runs) -> None:
    shutil.copytree(runs["nothing"].folder, program.folder / "out")
    (program.folder / "out" / "outcome.json").write_text("old")
    arguments = ("run", "straight_3lane", "--density", "1", "--end", "15", "--out", "out")
    refused(program.here(*arguments), 2, "--force")
    assert (program.folder / "out" / "outcome.json").read_text() == "old"
    done = program(*arguments, "--force")
    assert (done.status, done.err) == (0, "")
    assert "15 s" in done.outcome["reason"]
    assert program.leftovers() == ["out"]


def test_force_does_not_replace_what_is_no_run(program: Program) -> None:
    (program.folder / "out").mkdir()
    (program.folder / "out" / "thesis.txt").write_text("five years of work")
    refused(program.here("run", *QUICK, "--out", "out", "--force"), 2, "is not the folder of a run")
    assert (program.folder / "out" / "thesis.txt").read_text() == "five years of work"
    (program.folder / "file").write_text("a file")
    refused(program.here("run", *QUICK, "--out", "file", "--force"), 2, "file")
    refused(program.here("run", *QUICK, "--out", "file/out"), 2, "file/out")
    assert program.leftovers() == ["file", "out"]


def small_files() -> None:
    """In the child: no file may grow beyond 40 kB."""
    let_interrupt()
    resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, 40_000))


def test_files_that_cannot_grow_leave_no_folder(program: Program) -> None:
    bank = bank_with(program.folder / "bank.sqlite", TRAIL)
    done = program(
        "run", *QUICK, "--learn", "off", "--memory", bank, "--out", "new/out", "--json", preexec_fn=small_files
    )
    refused(done, 2, "new/out", "cannot be written")
    assert program.leftovers() == ["bank.sqlite"]


def test_a_full_disk_leaves_no_folder(program: Program) -> None:
    disk = program.folder / "disk"
    before = tiny_disk(disk, "48k", f'ls -A "{disk}"')
    done = program("run", *QUICK, "--out", disk / "out", "--json", before=before)
    refused(done, 1, "no space left")
    assert program.leftovers() == ["disk"]


def powerless() -> None:
    """In the child: root, too, may only write where the permissions say so (no capability to override them)."""
    let_interrupt()
    if os.geteuid() == 0:
        libc = ctypes.CDLL(None, use_errno=True)
        for capability in (1, 2, 3):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH, CAP_FOWNER
            libc.prctl(24, capability, 0, 0, 0)  # PR_CAPBSET_DROP; what exec gives to root is cut down to this set


@pytest.fixture
def shelf(program: Program) -> Iterator[Path]:
    """A folder that may be read only, with the shipped bank in it."""
    folder = program.folder / "shelf"
    folder.mkdir()
    shutil.copy(ROOT / "memory_bank.sqlite", folder / "bank.sqlite")
    (folder / "bank.sqlite").chmod(0o444)
    folder.chmod(0o555)
    if subprocess.run(["touch", folder / "new"], preexec_fn=powerless, capture_output=True).returncode == 0:
        pytest.skip("this user may write everywhere, and cannot give that up")
    yield folder
    folder.chmod(0o755)


def test_a_bank_that_cannot_be_written_is_only_a_note(program: Program, shelf: Path) -> None:
    bank = shelf / "bank.sqlite"
    options = ("--critical-ttc", "20", "--memory", bank, "--out", "out", "--json")
    done = program("run", "motorway_cut_in_left", *options, preexec_fn=powerless)
    assert (done.status, done.err) == (0, "")
    assert done.outcome["ending"] == "critical" and done.outcome["learnt"] is False
    assert "read-only" in " ".join(done.outcome["notes"])
    assert bank.read_bytes() == (ROOT / "memory_bank.sqlite").read_bytes()
    assert [p.name for p in shelf.iterdir()] == ["bank.sqlite"]


def test_no_right_to_write_is_a_sentence(program: Program, shelf: Path) -> None:
    done = program("run", *QUICK, "--out", shelf / "new" / "out", preexec_fn=powerless)
    refused(done, 2, "cannot be written")
    assert [p.name for p in shelf.iterdir()] == ["bank.sqlite"]


# -- planners


IN_EVERY_TEST = ("loops", "teleports", "raises")  # the sandbox's own tests have all kinds


@pytest.mark.parametrize(
    "wrong", [pytest.param(wrong, marks=[] if wrong in IN_EVERY_TEST else pytest.mark.soak) for wrong in BAD_PLANNERS]
)
def test_a_bad_planner_cannot_break_a_run(program: Program, wrong: str) -> None:
    """It is the only one of its bank."""
    bank = bank_with(program.folder / "bank.sqlite", BAD_PLANNERS[wrong])
    (program.folder / "few.toml").write_text("proposals = 4\n")
    options = ("--memory", bank, "--settings", "few.toml", "--tuner", "off", "--out", "out", "--json")
    done = program("run", *QUICK, *options)
    assert program.leftovers() == ["bank.sqlite", "few.toml", "out"]
    outcome = done.outcome
    assert outcome["ending"] in set(Ending) and outcome["reason"]
    assert done.status == (1 if outcome["ending"] == "planner_failed" else 0), done.err
    assert "Traceback" not in done.err and len(done.err.splitlines()) <= 1
    assert {a["intent"] for a in outcome["attempts"]} <= {"Odd Driving"}
    if wrong == "teleports":
        assert outcome["attempts"]
        assert [a for a in outcome["attempts"] if a["critical"] and a["feasible"]] == []
        assert outcome["outcome"]["min_distance"] > 0
    else:
        assert outcome["ending"] == "planner_failed"
        assert all(a["ending"] == "planner_failed" and a["message"] for a in outcome["attempts"])
    assert lacking(done.folder, RUN_FILES - {"encounter.png"}) == set()
