"""Large batches: a thousand episodes on two workers and on one; kill -9, twenty times, at random times."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import time
from collections import Counter
from pathlib import Path

import pytest
from batch_samples import clean, summary, table, workers_of
from cli_samples import Done, Program
from test_interrupt import alive, children_of

INPUTS = ("motorway_cut_in_left", "leader_two_lanes", "neighbour_ahead_left", "oncoming_country_road")
SHORT = ("--set", "attempts=1", "--set", "proposals=8", "--set", "duration=6.0", "--out", "out", "--json")
EPISODES = int(os.environ.get("SOAK_EPISODES", "1000"))
KILLS = 20
LONGEST = 4 * 3600.0  # s
GROWTH = 120  # MB from the second tenth of the episodes to the last, of a worker that is never recycled


def memory_of(pids: set[int]) -> int:
    """Resident memory of processes, MB."""
    total = 0
    for pid in pids:
        try:
            total += int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        except OSError:
            continue
    return total * os.sysconf("SC_PAGE_SIZE") // 2**20


def finished(program: Program) -> int:
    """Runs that are whole."""
    runs = program.folder / "out" / "runs"
    return sum(not p.name.startswith(".") for p in runs.iterdir()) if runs.is_dir() else 0


def patient(program: Program, process: subprocess.Popen[str]) -> Done:
    out, err = process.communicate(timeout=LONGEST)
    return Done(process.returncode, out, err, program.folder / "out")


def folder_of(program: Program, name: str) -> Program:
    """Another home for the same program."""
    return Program(program.folder / name, program._caches)


@pytest.mark.soak
def test_many_episodes_none_lost_and_the_same_on_one_worker(program: Program) -> None:
    plan = ("batch", *INPUTS, "--seeds", str(EPISODES // len(INPUTS)), *SHORT, "--recycle", "100000")
    two, one = folder_of(program, "two"), folder_of(program, "one")
    seen: list[tuple[int, int]] = []
    with two.start(*plan, "--workers", "2") as process:
        while process.poll() is None:
            seen.append((finished(two), max((memory_of({w}) for w in workers_of(process.pid)), default=0)))
            time.sleep(2.0)
        said = summary(patient(two, process))
    assert (said["finished"], said["failed"]) == (EPISODES, 0)
    rows = table(two.folder / "out")
    assert len({r["id"] for r in rows}) == EPISODES
    early = max(m for n, m in seen if 0.1 * EPISODES <= n <= 0.2 * EPISODES)
    late = max(m for n, m in seen if n >= 0.9 * EPISODES)
    assert late - early < GROWTH, f"a worker grew from {early} to {late} MB"
    print(f"memory of a worker: {early} MB early, {late} MB late")
    clean(two)
    with one.start(*plan, "--workers", "1") as process:
        summary(patient(one, process))
    assert table(one.folder / "out") == rows, Counter(r["ending"] for r in rows)


@pytest.mark.soak
@pytest.mark.parametrize("victim", ["worker", "parent"])
def test_killed_twenty_times_at_random_times(program: Program, victim: str) -> None:
    """A worker is killed while the others go on; the parent is started again each time."""
    plan = ("batch", *INPUTS, "--seeds", "20", *SHORT, "--workers", "2")
    whole, broken = folder_of(program, "whole"), folder_of(program, "broken")
    with whole.start(*plan) as process:
        summary(patient(whole, process))
    rng, kills = random.Random(8), 0
    while kills < KILLS:
        with broken.start(*plan) as process:
            family: set[int] = set()
            while kills < KILLS and process.poll() is None:
                time.sleep(rng.uniform(0.5, 6.0))
                family |= children_of(process.pid)
                victims = workers_of(process.pid) if victim == "worker" else [process.pid]
                if victims and process.poll() is None:
                    os.kill(rng.choice(victims), signal.SIGKILL)
                    kills += 1
                if victim == "parent":
                    break
            done = patient(broken, process)
            assert "Traceback" not in done.err
        deadline = time.monotonic() + 5.0
        while alive(family) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert alive(family) == set()
        if victim == "worker" and kills < KILLS:  # it finished all the same: once more from the start
            for run in list((broken.folder / "out" / "runs").iterdir())[::2]:
                subprocess.run(["rm", "-r", str(run)], check=True)
    with broken.start(*plan, "--retry-failed") as process:
        said = summary(patient(broken, process))
    assert said["finished"] == 80
    assert table(broken.folder / "out") == table(whole.folder / "out")
    clean(broken)
