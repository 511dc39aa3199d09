"""Thousands of wrong banks, records, run folders, TOML files and planners: each is taken or refused in a sentence.

``test_soak_gate.py`` runs ``fuzz_gate``. ``SOAK_SEED`` (default 0) chooses other tries.
Each attack is a program of its own, with a bound on its memory.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
SEED = os.environ.get("SOAK_SEED", "0")
PATIENCE = 1800.0  # s: on an idle machine none takes two minutes


@pytest.mark.soak
@pytest.mark.parametrize("attack", sorted(p.stem for p in HERE.glob("fuzz_*.py") if p.stem != "fuzz_gate"))
def test_no_try_breaks_the_program(attack: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(HERE / f"{attack}.py"), "--seed", SEED],
        cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE,
    )  # fmt: skip
    print(f"\n{attack}, seed {SEED}: {done.stdout}")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout.splitlines()[-1])
    assert said["broken"] == [] and said["tries"] > 0
