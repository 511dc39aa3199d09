"""The folder of a Ray worker process goes with it, also where the process is killed; no Ray is needed for that."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

WORKER = """\
import gc, subprocess, sys
from sumo_adv.campaigns.cluster import desk_folder
folder = desk_folder()
(folder / "bank").write_text("full")
gc.collect()
subprocess.run([sys.executable, "-c", ""], check=True)
print(folder, folder.is_dir(), flush=True)
sys.stdin.read()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Ray's workers there have no fork")
def test_the_folder_of_a_killed_worker_is_removed() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", WORKER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as worker:
        assert worker.stdout is not None
        folder, there = worker.stdout.readline().split()
        assert there == "True"
        worker.kill()
    until = time.monotonic() + 30.0
    while Path(folder).exists() and time.monotonic() < until:
        time.sleep(0.1)
    assert not Path(folder).exists()
