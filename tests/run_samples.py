"""Small runs of the program from Python, each made once for all tests of one process."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path

import sumo_adv

GEOMETRIES = {"straight": "motorway_cut_in_left", "crossing": "priority_left_turn_oncoming", "bend": "oncoming_in_bend"}


@cache
def run_folder(geometry: str) -> Path:
    """The folder of a run until a collision."""
    home = Path(tempfile.mkdtemp(prefix="sumo_adv-tests-"))
    atexit.register(shutil.rmtree, home, ignore_errors=True)
    result = sumo_adv.run(
        GEOMETRIES[geometry],
        out=home / "run",
        until="collision",
        attempts=20,
        proposals=24,
        learn="off",
        memory=home / "bank.sqlite",
    )
    return result.folder
