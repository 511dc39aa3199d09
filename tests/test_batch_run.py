"""Batches through the real command line: the table, any number of workers, resuming, faults, Ctrl-C, learning."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
import time
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import pytest
from batch_samples import CRASHED, INPUTS, QUICK, RUN, SETTINGS_FILE, SMALL, clean, summary, table, workers_of
from cli_samples import (
    PATIENCE,
    ROOT,
    TRAIL,
    Done,
    Program,
    bank_with,
    files_of,
    lacking,
    refused,
    tiny_disk,
    untimed,
    without_progress,
)
from test_cli_bad_input import powerless, shelf  # noqa: F401 - a fixture
from test_interrupt import alive, children_of, wait_until

from sumo_adv.campaigns.local import _work
from sumo_adv.campaigns.results import CLOCK_COLUMNS, RESULT_COLUMNS
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.simulation.processes import check_parent


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, caches: Path) -> Iterator[tuple[Program, Done]]:
    """The small plan on two workers, undisturbed."""
    program = Program(tmp_path_factory.mktemp("whole"), caches)
    yield program, program(*SMALL, "--workers", "2")


TAUGHT = (*SMALL, "--learn", "after", "--memory", "bank.sqlite")


@pytest.fixture(scope="module")
def taught(tmp_path_factory: pytest.TempPathFactory, caches: Path) -> list[tuple[Program, dict[str, Any]]]:
    """The small plan twice, each with a bank of its own, and what was said: on one worker, recycled, and on two."""
    done = []
    for k, workers in enumerate((("1", "--recycle", "2"), ("2",))):
        program = Program(tmp_path_factory.mktemp(f"taught{k}"), caches)
        shutil.copy(ROOT / "memory_bank.sqlite", program.folder / "bank.sqlite")
        done.append((program, summary(program.here(*TAUGHT, "--workers", *workers, "--json"))))
    return done


def again(program: Program, whole: tuple[Program, Done]) -> Path:
    """A copy of the undisturbed batch's folder for another program."""
    shutil.copytree(whole[1].folder, program.folder / "out")
    return program.folder / "out"


# -- the table


def test_a_scenario_brings_its_sensors_and_attackers_unless_the_plan_has_its_own(program: Program) -> None:
    """As in ``run``: the ego of one scenario sees 80 m with 0.3 m of noise, and the other has two attackers."""
    text = (ROOT / "scenarios" / f"{INPUTS[0]}.toml").read_text(encoding="utf-8")
    text = text.replace('"../', f'"{ROOT}/').replace('"demand/', f'"{ROOT}/scenarios/demand/')
    sensing = "[ego.sensing]\nposition_noise = 0.3\nrange = 80.0\n"
    attackers = "".join(f'[[attackers]]\nid = "{name}"\n' for name in ("left_ahead", "right_ahead"))
    for name, more in (("sensing", sensing), ("attackers", attackers)):
        (program.folder / f"{name}.toml").write_text(f"{text}\n{more}", encoding="utf-8")

    def settings(out: str, *options: str) -> dict[str, dict[str, Any]]:
        inputs = ("sensing.toml", "attackers.toml", "--egos", "ego_samples:CalmEgo")
        done = program.here("batch", *inputs, *QUICK, *options, "--workers", "1", "--out", out, "--json")
        assert summary(done)["failed"] == 0
        manifests = [json.loads(file.read_text()) for file in (program.folder / out).glob("runs/*/manifest.json")]
        return {each["name"]: each["settings"] for each in manifests}

    (program.folder / "own.settings.toml").write_text("[ego_sensing]\nrange = 60.0\n", encoding="utf-8")
    theirs, own = settings("out"), settings("own", "--settings", "own.settings.toml")
    assert theirs["attackers"]["adversaries"] == 2 and theirs["sensing"]["adversaries"] == 1
    seen = [each["sensing"]["ego_sensing"] for each in (theirs, own)]
    assert [(each["position_noise"], each["range"]) for each in seen] == [(0.3, 80.0), (0.0, 60.0)]


def test_a_batch_leaves_whole_folders_and_a_table_in_the_plans_order(whole: tuple[Program, Done]) -> None:
    program, done = whole
    assert (done.status, without_progress(done.err)) == (0, "")  # no bar, nothing but the summary: this is a pipe
    assert done.out.startswith("4 of 4 episodes: ") and done.out.splitlines()[-1] == "Files: out/results.csv"
    assert "kB per episode" in done.out
    rows = table(done.folder)
    assert [(r["network"], r["seed"]) for r in rows] == [(i, s) for i in INPUTS for s in "01"]
    assert list(rows[0]) == [c for c in RESULT_COLUMNS if c not in CLOCK_COLUMNS]
    assert {p.name for p in (done.folder / "runs").iterdir()} == {r["id"] for r in rows}
    for row in rows:
        folder = done.folder / "runs" / row["id"]
        assert lacking(folder, RUN) == set()
        outcome = json.loads((folder / "outcome.json").read_text(encoding="utf-8"))
        assert (row["ending"], row["ego"]) == (outcome["ending"], "idm")
        assert row["intent"] == outcome["intent"]["label"]
        assert (row["critical"] == "true") is outcome["outcome"]["critical"]
    clean(program)


def test_an_episode_is_what_run_makes_of_it(program: Program, whole: tuple[Program, Done]) -> None:
    (program.folder / "quick.toml").write_text(SETTINGS_FILE)
    options = ("--seed", "1", "--learn", "off", "--settings", "quick.toml", "--out", "alone")
    program.here("run", INPUTS[0], *options)
    folder = whole[1].folder / "runs" / table(whole[1].folder)[1]["id"]
    ours, alone = files_of(folder), files_of(program.folder / "alone")
    assert set(alone) - set(ours) == {"encounter.png", "files.json"} and set(ours) <= set(alone)
    assert untimed(json.loads(ours.pop("outcome.json"))) == untimed(json.loads(alone["outcome.json"]))
    assert {name: data for name, data in ours.items() if alone[name] != data} == {}


def test_any_number_of_workers_gives_the_same_rows(
    whole: tuple[Program, Done], taught: list[tuple[Program, dict[str, Any]]]
) -> None:
    """One worker, recycled after every second episode, and two: what they learnt the others did not see either."""
    for program, report in taught:
        assert (report["finished"], report["ran"], report["failed"]) == (4, 4, 0)
        assert table(program.folder / "out") == table(whole[1].folder)
        clean(program, "bank.sqlite")


def test_a_dry_run_prints_the_episodes_and_runs_none(program: Program, whole: tuple[Program, Done]) -> None:
    report = summary(program.here(*SMALL, "--dry-run", "--json"))
    assert [e["id"] for e in report["episodes"]] == [r["id"] for r in table(whole[1].folder)]
    done = program.here(*SMALL, "--dry-run")
    assert done.out.splitlines()[-1] == "4 episodes, into out."
    assert program.leftovers() == []


def test_a_plan_file_is_the_same_as_its_options(program: Program, whole: tuple[Program, Done]) -> None:
    text = f"inputs = {json.dumps(INPUTS)}\nseeds = [0, 1]\n[settings]\n{SETTINGS_FILE}"
    (program.folder / "plan.toml").write_text(text)
    report = summary(program.here("batch", "plan.toml", "--dry-run", "--json"))
    assert [e["id"] for e in report["episodes"]] == [r["id"] for r in table(whole[1].folder)]
    assert report["out"] == "runs/plan"


# -- going on


def test_the_same_again_does_only_what_is_missing(program: Program, whole: tuple[Program, Done]) -> None:
    out = again(program, whole)
    before = table(out)
    shutil.rmtree(out / "runs" / before[2]["id"])
    (out / "runs" / f".{before[2]['id']}.half").mkdir()  # what a kill leaves
    (out / "runs" / before[0]["id"] / "outcome.json").write_text("{")  # damaged
    (out / "results.csv").unlink()
    report = summary(program.here(*SMALL, "--workers", "1", "--json"))
    assert (report["finished"], report["ran"]) == (4, 2)
    assert table(out) == before
    assert summary(program.here(*SMALL, "--json"))["ran"] == 0
    clean(program)


def test_another_plan_in_the_same_folder_says_what_differs(program: Program, whole: tuple[Program, Done]) -> None:
    out = again(program, whole)
    more = ("batch", *INPUTS, "--seeds", "3", *QUICK, "--out", "out")
    refused(program.here(*more), 2, "seeds were 0, 1, now 0, 1, 2", "--force")
    refused(program.here(*SMALL, "--learn", "after"), 2, "learn: off then, after now", "another --out")
    before = table(out)
    report = summary(program.here(*more, "--force", "--json"))
    assert (report["episodes"], report["ran"]) == (6, 2)
    assert [r for r in table(out) if r["seed"] != "2"] == before


def test_packed_runs_count_as_done_and_come_back_as_they_were(program: Program, whole: tuple[Program, Done]) -> None:
    out = again(program, whole)
    before, rows = files_of(out / "runs"), table(out)
    assert json.loads(program.here("batch", "pack", "out", "--json").out)["files"] == [len(before), 2]
    (out / "results.csv").unlink()
    assert summary(program.here(*SMALL, "--json"))["ran"] == 0
    assert table(out) == rows
    program.here("batch", "unpack", "out")
    assert files_of(out / "unpacked") == before
    refused(program.here("batch", "unpack", "out", "nothing"), 2, "holds the run nothing")
    refused(program.here("batch", "pack", "home"), 2, "is not the folder of a batch")


# -- faults


EGOS = ("ego_samples:CalmEgo", "batch_samples:CrashingEgo", "batch_samples:OnceCrashingEgo", "ego_samples:NoEgo")


@pytest.fixture(scope="module")
def broken(tmp_path_factory: pytest.TempPathFactory, caches: Path) -> tuple[Program, Done]:
    """A corrupt network, a corrupt record, and four drivers: a good one, one crashing always, one crashing only once,
    and a missing one."""
    program = Program(tmp_path_factory.mktemp("broken"), caches)
    (program.folder / "bad.tfrecord").write_bytes(b"\x05" * 40)
    (program.folder / "cut.net.xml").write_text("<net>")
    options = ("--egos", ",".join(EGOS), *QUICK, "--workers", "2", "--out", "out")
    return program, program("batch", INPUTS[0], "cut.net.xml", "bad.tfrecord", *options)


def test_broken_members_fail_by_name_and_the_rest_completes(broken: tuple[Program, Done]) -> None:
    program, done = broken
    assert done.status == 0 and "Traceback" not in done.err
    rows = table(done.folder)
    calm, crashing, once, none = rows[:4]
    failed = [crashing, none, *rows[4:]]
    assert len(rows) == 12 and len(without_progress(done.err).splitlines()) == len(failed)  # a sentence for each
    assert all(r["failure"] and r["ending"] == "simulation_failed" for r in failed)
    assert calm["failure"] == once["failure"] == "" and calm["ending"] in ("critical", "attempts_exhausted")
    assert (
        "ended the simulation process (killed by SIGSEGV" in crashing["failure"]
    )  # in the fork that runs on unattacked
    assert "NoEgo" in none["failure"]
    assert all("cut.net.xml" in r["failure"] for r in rows[4:8])
    assert all("bad.tfrecord" in r["failure"] for r in rows[8:])
    for row in failed:
        assert (done.folder / row["traceback"]).read_text(encoding="utf-8").strip()
    assert "Segmentation fault" in (done.folder / crashing["traceback"]).read_text(encoding="utf-8")
    clean(program, "bad.tfrecord", "cut.net.xml", CRASHED.name)


def test_what_crashes_once_is_tried_again_and_is_as_if_it_had_not(broken: tuple[Program, Done]) -> None:
    program, done = broken
    calm, once = (r for r in table(done.folder) if r["ending"] != "simulation_failed")
    assert (program.folder / CRASHED).exists() and once["traceback"] == ""
    apart = ("id", "ego")
    assert {k: v for k, v in once.items() if k not in apart} == {k: v for k, v in calm.items() if k not in apart}


def test_drivers_that_hang_are_ended_twice_and_fail_by_name(program: Program) -> None:
    options = ("--seeds", "2", "--workers", "2", "--deadline", "3", "--out", "out")
    with program.start("batch", INPUTS[0], "--egos", "batch_samples:HangingEgo", *QUICK, *options) as process:
        family = set[int]()
        while process.poll() is None:
            family |= children_of(process.pid)
            time.sleep(0.1)
        out, err = process.communicate()
    assert process.returncode == 1 and "Traceback" not in err and out.startswith("2 of 2 episodes")
    for row in table(program.folder / "out"):
        assert row["failure"] == "It failed 2 times: it did not finish within 3 s."
    assert left_of(family) == set()
    clean(program)


def test_planners_that_hang_cost_their_attempts(program: Program) -> None:
    loops = "".join(TRAIL.partition("    pose")[:1]) + "    while True:\n        pass\n"
    bank_with(program.folder / "bank.sqlite", loops)
    done = program.here("batch", INPUTS[0], *QUICK, "--memory", "bank.sqlite", "--out", "out")
    (row,) = table(done.folder)
    assert done.status == 1 and row["ending"] in ("planner_failed", "no_encounter") and row["failure"]


def test_a_worker_that_starts_as_its_parent_dies_ends_without_a_word(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Another worker has removed the scratch folder by then."""
    context = multiprocessing.get_context("spawn")
    _, child_end = context.Pipe()
    process = context.Process(target=_work, args=(child_end, None, tmp_path / "gone" / "worker-1" / "log"))
    process.start()
    process.join(PATIENCE)
    assert process.exitcode == 0 and capfd.readouterr().err == ""


def _outlive(child_end: Connection, words: Path) -> None:
    """Check the parent while it runs, and when it has ended."""
    check_parent()
    child_end.send("it runs")
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    try:
        check_parent()
    except EOFError as error:
        words.with_suffix(".new").write_text(str(error), encoding="utf-8")
        words.with_suffix(".new").rename(words)


def _die(words: Path) -> None:
    """Start a process that outlives this one."""
    context = multiprocessing.get_context("spawn")
    own_end, child_end = context.Pipe()
    context.Process(target=_outlive, args=(child_end, words)).start()
    assert own_end.recv() == "it runs"
    os._exit(0)


def test_a_worker_that_outlives_its_parent_learns_it(tmp_path: Path) -> None:
    """Its scratch folder may be gone by then, so it must not keep a result."""
    words = tmp_path / "words"
    process = multiprocessing.get_context("spawn").Process(target=_die, args=(words,))
    process.start()
    process.join(PATIENCE)
    until = time.monotonic() + PATIENCE
    while not words.exists() and time.monotonic() < until:
        time.sleep(0.05)
    assert words.read_text(encoding="utf-8") == "The process that started this one has ended."


@pytest.mark.parametrize("victim", [pytest.param("worker", marks=pytest.mark.soak), "parent"])
def test_kill_9_loses_nothing(program: Program, whole: tuple[Program, Done], victim: str) -> None:
    with program.start(*SMALL, "--workers", "2") as process:
        runs = program.folder / "out" / "runs"
        wait_until(process, lambda: runs.is_dir() and any(not p.name.startswith(".") for p in runs.iterdir()))
        wait_until(process, lambda: len(workers_of(process.pid)) == 2)
        family = children_of(process.pid)
        os.kill(workers_of(process.pid)[0] if victim == "worker" else process.pid, signal.SIGKILL)
        process.communicate(timeout=PATIENCE)
    assert left_of(family) == set()
    assert process.returncode == (0 if victim == "worker" else -signal.SIGKILL)
    report = summary(program.here(*SMALL, "--json"))
    assert report["ran"] == 0 if victim == "worker" else 0 < report["ran"] < 4
    assert table(program.folder / "out") == table(whole[1].folder)
    clean(program)


def test_ctrl_c_lets_finish_what_runs(program: Program, whole: tuple[Program, Done]) -> None:
    done = pressed(program, 1)
    assert done.status == 1 and "rerun the same command to run the rest" in done.err
    kept = table(done.folder)
    assert 0 < len(kept) < 4 and [r for r in table(whole[1].folder) if r in kept] == kept
    clean(program)
    report = summary(program.here(*SMALL, "--json"))
    assert report["ran"] == 4 - len(kept)
    assert table(done.folder) == table(whole[1].folder)


def test_ctrl_c_twice_stops_now(program: Program, whole: tuple[Program, Done]) -> None:
    done = pressed(program, 2)
    assert done.status == 1 and "Stopping now." in done.err
    assert [r for r in table(whole[1].folder) if r in table(done.folder)] == table(done.folder)
    clean(program)


def left_of(family: set[int], patience: float = 5.0) -> set[int]:
    """Those that still run after ``patience`` seconds: the last ones end once they see that their parent has."""
    end = time.monotonic() + patience
    while alive(family) and time.monotonic() < end:
        time.sleep(0.02)
    return alive(family)


def pressed(program: Program, times: int) -> Done:
    """Ctrl-C as soon as an episode has begun in one worker."""
    with program.start(*SMALL, "--workers", "1") as process:
        runs = program.folder / "out" / "runs"
        wait_until(process, lambda: runs.is_dir() and any(runs.iterdir()))
        family = children_of(process.pid)
        for _ in range(times):
            os.killpg(process.pid, signal.SIGINT)
            time.sleep(0.3)
        out, err = process.communicate(timeout=PATIENCE)
    assert left_of(family) == set() and "Traceback" not in err
    return Done(process.returncode, out, err, program.folder / "out")


def test_no_right_to_write_is_a_sentence(program: Program, shelf: Path) -> None:  # noqa: F811
    done = program(*SMALL[:-1], shelf / "new", preexec_fn=powerless)
    refused(done, 2, "cannot be written", "another --out")
    assert [p.name for p in shelf.iterdir()] == ["bank.sqlite"]


def test_a_folder_that_becomes_read_only_stops_the_batch(program: Program, whole: tuple[Program, Done]) -> None:
    out = again(program, whole)
    shutil.rmtree(out / "runs" / table(out)[0]["id"])
    (out / "runs").chmod(0o555)
    done = program(*SMALL, "--workers", "1", preexec_fn=powerless)
    (out / "runs").chmod(0o755)
    if done.status == 0:
        pytest.skip("this user may write everywhere, and cannot give that up")
    refused(done, 2, "cannot be written")
    assert len(table(out)) == 3


def test_a_full_disk_is_a_sentence_and_nothing_is_half_written(program: Program) -> None:
    disk = program.folder / "disk"
    before = tiny_disk(disk, "300k", f'find "{disk}/out/runs" -mindepth 1 -maxdepth 1 -name ".*"')
    done = program(*SMALL[:-1], disk / "out", "--workers", "1", before=before)
    refused(done, 1, "no space left")


# -- learning


def test_off_learns_nothing_and_after_learns_in_the_plans_order(
    whole: tuple[Program, Done], taught: list[tuple[Program, dict[str, Any]]]
) -> None:
    first, second = (evidence_of(program.folder / "bank.sqlite") for program, _ in taught)
    assert first == second and [report["learnt"] for _, report in taught] == [len(first), len(second)]
    assert first
    program, _ = taught[0]
    again = summary(program.here(*TAUGHT, "--json"))
    assert (again["ran"], again["learnt"]) == (0, 0) and evidence_of(program.folder / "bank.sqlite") == first
    assert evidence_of(whole[0].home / "data" / "sumo_adv" / "memory_bank.sqlite") == []


@pytest.mark.parametrize("of_an_earlier_version", [False, True])
def test_episodes_that_come_later_are_taught_too_and_only_they(
    program: Program, taught: list[tuple[Program, dict[str, Any]]], of_an_earlier_version: bool
) -> None:
    """The bank is as before the first four episodes, so it shows what the two of the third seed teach."""
    before = taught[0][0].folder
    shutil.copytree(before / "out", program.folder / "out")
    plan = program.folder / "out" / "plan.json"
    plan.write_text(plan.read_text().replace(str(before), str(program.folder)))  # where the bank is
    shutil.copy(ROOT / "memory_bank.sqlite", program.folder / "bank.sqlite")
    if of_an_earlier_version:
        (program.folder / "out" / "taught.json").write_text('{"written": 4, "bank": "bank.sqlite"}', encoding="utf-8")
    more = (*TAUGHT, "--seeds", "3", "--force", "--json")
    report = summary(program.here(*more))
    learnt = evidence_of(program.folder / "bank.sqlite")
    assert report["ran"] == 2 and report["learnt"] == len(learnt) > 0
    assert {evidence.seed for evidence in learnt} == {2}
    again = summary(program.here(*more))
    assert (again["ran"], again["learnt"]) == (0, 0)
    assert evidence_of(program.folder / "bank.sqlite") == learnt


def evidence_of(bank: Path) -> Sequence[Any]:
    """What a bank has learnt."""
    with MemoryBank.open(bank, read_only=True) as opened:
        return opened.evidence()


def test_during_is_said_aloud(program: Program) -> None:
    shutil.copy(ROOT / "memory_bank.sqlite", program.folder / "bank.sqlite")
    options = ("--seeds", "1", *QUICK, "--learn", "during", "--memory", "bank.sqlite", "--out", "out")
    done = program.here("batch", INPUTS[0], *options)
    assert done.status == 0 and "depend on the order" in done.err
    with MemoryBank.open(program.folder / "bank.sqlite", read_only=True) as bank:
        assert bank.evidence()
