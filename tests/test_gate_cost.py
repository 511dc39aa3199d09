"""The gate's benchmark in miniature: it runs and prints figures of the right size; bounds are not checked here."""

from __future__ import annotations

import subprocess
import sys

from cli_samples import ROOT
from gate_samples import needs_sumo


@needs_sumo
def test_gate_cost_has_a_row_for_steps_and_getters() -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / "gate_cost.py"), "--vehicles", "12", "--pairs", "2",
         "--steps", "5", "--getters", "20"],
        capture_output=True, text=True, timeout=120.0, check=False,
    )  # fmt: skip
    assert done.returncode in (0, 1) and done.stderr == "", done.stderr[-2000:]
    header, *rows = (line.split() for line in done.stdout.splitlines())
    assert header[:2] == ["vehicles", "what"]
    assert [row[:2] for row in rows] == [["12", "step"], ["12", "getter"]]
    for row in rows:
        native, gated, low, middle, high = map(float, row[2:7])
        assert 1.0 < native < 100_000.0 and 1.0 < gated < 100_000.0 and 0.0 < low <= middle <= high
