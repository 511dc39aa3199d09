"""Many processes that write to one bank while one of them is killed again and again.

As a program, ``python memory_writers.py BANK COUNT NAME DIE``: a writer that goes on where an earlier one of its name
was killed, one piece of evidence an episode, until the bank holds COUNT of its own; a line after each.  If DIE is not 0
it kills itself within its DIE-th transaction.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from bank_samples import BRAKE_PLANNER, BRAKING, evidence

from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.curate import statistics
from sumo_adv.memory.migrations import utc_now


def deadly_clock(calls: int) -> Callable[[], str]:
    """A clock that kills the process when it is asked for the ``calls``-th time; the bank asks within a transaction."""
    calls_made = 0

    def clock() -> str:
        nonlocal calls_made
        calls_made += 1
        if calls_made == calls:
            os.kill(os.getpid(), signal.SIGKILL)
        return utc_now()

    return clock


def write(path: Path, count: int, name: str, die: int) -> None:
    """What the program does. Every third episode failed."""
    with MemoryBank.open(path, clock=deadly_clock(die)) as bank:
        done = sum(e.network == name for e in bank.evidence())
        for number in range(done, count):
            failed = {"critical": False, "collided": False, "valid": None} if number % 3 == 2 else {}
            bank.record(evidence(seed=number, network=name, **failed), intent=BRAKING, planner=BRAKE_PLANNER)
            sys.stdout.write(f"{number}\n")
            sys.stdout.flush()


def start(path: Path, count: int, name: str, die: int = 0) -> subprocess.Popen[str]:
    """A writer in a process of its own."""
    return subprocess.Popen(
        [sys.executable, __file__, str(path), str(count), name, str(die)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=Path(__file__).parent.parent,
    )  # fmt: skip


def storm(path: Path, writers: int, count: int, kills: int) -> int:
    """``writers`` processes write ``count`` episodes each, one of them killed ``kills`` times and started again: by
    itself within a transaction, and, every second time, from outside at any point.

    Returns how often it was killed before it was done. Every writer must end well, and every row be there once.
    """
    with MemoryBank.open(path) as bank:
        bank.add(BRAKING, [BRAKE_PLANNER])
    others = [start(path, count, f"writer {i}") for i in range(1, writers)]
    rng, killed = random.Random(0), 0
    for i in range(kills):
        lines = rng.randint(1, max(1, count // kills))
        with start(path, count, "victim", 0 if i % 2 else lines) as victim:
            assert victim.stdout is not None
            for _ in range(lines):
                victim.stdout.readline()
            if i % 2:
                victim.kill()
        killed += victim.returncode != 0
    for process in (*others, start(path, count, "victim")):
        out, err = process.communicate(timeout=600)
        assert (process.returncode, err) == (0, ""), out[-200:]
    with MemoryBank.open(path) as bank:
        rows = Counter((e.network, e.seed) for e in bank.evidence())
        successes = statistics(bank)["by_label"][BRAKING.label]["successes"]
    names = ["victim", *(f"writer {i}" for i in range(1, writers))]
    assert rows == Counter({(name, number): 1 for name in names for number in range(count)})
    assert successes == writers * (count - count // 3)
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    return killed


if __name__ == "__main__":
    write(Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3], int(sys.argv[4]))
