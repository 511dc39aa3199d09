"""Large batches: a thousand episodes on two workers and on one; kill -9, twenty times, at random times."""

from __future__ import annotations

import os
import random
import signal
import statistics
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest
from batch_samples import QUICK, clean, finished, patient, summary, table, thin_out, workers_of
from cli_samples import ROOT, Program, own_memory
from test_interrupt import alive, children_of

INPUTS = ("motorway_cut_in_left", "neighbour_ahead_left", "follower_with_free_lane", "t_junction_left_into_stem")
ROUNDS = 5  # times that a large batch goes through all of them
SHORT = (*QUICK, "--out", "out", "--json")
EPISODES = int(os.environ.get("SOAK_EPISODES", "1000"))
KILLS = 20
ROLES = ("front", "workers", "engines and sandboxes")
FLAT = 0.05  # share of its memory by which a role may grow after the first two fifths of a run
ROW_MB = 0.006  # the front keeps the row of each finished episode; measured: 4.4 kB
LOOK = 0.5  # s between looks at the memory

Sizes = Mapping[tuple[str, int], float]  # memory of its own [MB] by role and process


def sizes_of(parent: int) -> Sizes:
    """The memory of a batch's front, of its workers and of all that these have started."""
    workers = set(workers_of(parent))
    roles = {pid: ROLES[0] if pid == parent else ROLES[1 if pid in workers else 2] for pid in children_of(parent)}
    return {(role, pid): own_memory(pid) for pid, role in roles.items()}


def lasting(seen: Sequence[Sizes], role: str) -> list[float]:
    """Memory [MB] of a role's processes that last, at each look: forks, which end with their episode, left out."""
    looks = Counter(process for sizes in seen for process in sizes)
    last = {process for process, n in looks.items() if process[0] == role and n >= 0.9 * len(seen)}
    return [sum(sizes.get(process, 0.0) for process in last) for sizes in seen]


def fifths(values: Sequence[float]) -> list[float]:
    """Medians of the fifths of a series."""
    length = len(values) // 5
    return [statistics.median(values[k * length : (k + 1) * length]) for k in range(5)]


def folder_of(program: Program, name: str) -> Program:
    """Another home for the same program."""
    return Program(program.folder / name, program._caches)


def rounds_of(folder: Path) -> list[Path]:
    """Copies of the scenarios, each with a content of its own, so that all are run in each fifth of a batch."""
    made = []
    for k in range(ROUNDS):
        for name in INPUTS:
            text = (ROOT / "scenarios" / f"{name}.toml").read_text(encoding="utf-8")
            text = text.replace('"../', f'"{ROOT}/').replace('"demand/', f'"{ROOT}/scenarios/demand/')
            made.append(folder / f"{name}_{k}.toml")
            made[-1].write_text(f"# {k}\n{text}", encoding="utf-8")
    return made


def watched(program: Program, *plan: str) -> tuple[list[Sizes], float]:
    """A batch to its end: its memory as it went on, once it had begun; and the seconds it took."""
    seen: list[Sizes] = []
    began = time.monotonic()
    with program.start(*plan) as process:
        while process.poll() is None:
            if finished(program):
                seen.append(sizes_of(process.pid))
            time.sleep(LOOK)
        said = summary(patient(program, process))
    assert (said["finished"], said["failed"]) == (EPISODES, 0)
    return seen[:-2], time.monotonic() - began  # at the very end workers have left already


@pytest.mark.soak
def test_many_episodes_none_lost_and_the_same_on_one_worker(program: Program) -> None:
    inputs = rounds_of(program.home)
    plan = ("batch", *map(str, inputs), "--seeds", str(EPISODES // len(inputs)), *SHORT, "--recycle", "100000")
    tables = []
    for workers in (2, 1):
        mine = folder_of(program, str(workers))
        seen, seconds = watched(mine, *plan, "--workers", str(workers))
        tables.append(table(mine.folder / "out"))
        print(f"\n{EPISODES} episodes, {workers} workers: {seconds:.0f} s, {len(seen)} looks")
        for role in ROLES:
            parts = fifths(lasting(seen, role))
            print(f"{role}: {', '.join(f'{p:.1f}' for p in parts)} MB (medians of the fifths)")
            rows = ROW_MB * EPISODES * 3 / 5 if role == ROLES[0] else 0.0
            assert max(parts[2:]) - parts[1] <= FLAT * parts[1] + rows, (role, parts)
        counts = [len(sizes) for sizes in seen]
        print(f"processes: {fifths(counts)}, most {max(counts)}; all: most {max(sum(s.values()) for s in seen):.0f} MB")
        assert max(counts[len(counts) // 2 :]) <= max(counts[: len(counts) // 2]) + 1, "processes pile up"
        clean(mine)
    two, one = tables
    assert len({r["id"] for r in two}) == EPISODES
    assert one == two
    print(Counter(r["ending"] for r in two))


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
        if kills < KILLS:  # where it finished all the same: once more, with half of it missing
            thin_out(broken)
    with broken.start(*plan, "--retry-failed") as process:
        said = summary(patient(broken, process))
    assert said["finished"] == 80
    assert table(broken.folder / "out") == table(whole.folder / "out")
    clean(broken)
