"""Episodes in a row in one process, as a user's script would run them; a line of JSON for each.

``python soak_episodes.py COUNT [FIRST]``: the shipped scenarios in turn, each time with another seed and driver.  A
line tells the ending and the remains once the episode's engine and sandbox are closed.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

from sumo_adv.cli.main import app
from sumo_adv.simulation.inputs import data_folder

EGOS = ("idm", "careful", "krauss", "replay", "eidm")
ATTEMPTS = 4
OUT = Path("out")


def children() -> int:
    """Processes of our own that are still there, zombies included (-1 where there is no /proc)."""
    listed = list(Path("/proc/self/task").glob("*/children"))
    return sum(len(file.read_text().split()) for file in listed) if listed else -1


def left() -> dict[str, int]:
    """What this process holds: children, temporary files, open files, threads, resident memory [MB]."""
    descriptors = Path("/proc/self/fd")
    pages = int(Path("/proc/self/statm").read_text().split()[1]) if descriptors.is_dir() else 0
    return {
        "children": children(),
        "temporary": len(list(Path(tempfile.gettempdir()).iterdir())),
        "descriptors": len(list(descriptors.iterdir())) if descriptors.is_dir() else 0,
        "threads": threading.active_count(),
        "megabytes": pages * os.sysconf("SC_PAGE_SIZE") // 2**20,
    }


def episode(k: int) -> dict[str, Any]:
    """The ``k``-th episode: its ending and what it leaves."""
    scenarios = sorted(data_folder("scenarios").glob("*.toml"))
    scenario, ego = scenarios[k % len(scenarios)], EGOS[k % len(EGOS)]
    output = io.StringIO()
    arguments = ["run", str(scenario), "--seed", str(k), "--ego", ego, "--attempts", str(ATTEMPTS), "--json"]
    with contextlib.redirect_stdout(output):
        status = app([*arguments, "--out", str(OUT), "--force"], standalone_mode=False)
    files = sorted(p.name for p in OUT.iterdir())
    shutil.rmtree(OUT)
    row = {"scenario": scenario.stem, "ego": ego, "seed": k, "status": status or 0}
    return row | {"ending": json.loads(output.getvalue())["ending"], "files": files} | left()


def main() -> None:
    """The episodes asked for."""
    count, first = int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0
    for k in range(first, first + count):
        print(json.dumps(episode(k)), flush=True)


if __name__ == "__main__":
    main()
