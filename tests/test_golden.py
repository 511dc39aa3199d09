"""A small set of golden runs: attempts, verdicts and states are the same as when they were recorded.

Made by ``benchmarks/golden.py record tests/data/golden.json`` with the scenarios and egos that the file names. A change
that is meant to change results records them again and says in its commit what changed.
"""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent
FILE = ROOT / "tests" / "data" / "golden.json"


@pytest.fixture(scope="module")
def golden() -> Any:
    """The benchmark as a module."""
    spec = importlib.util.spec_from_file_location("golden", ROOT / "benchmarks" / "golden.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_golden_runs_are_the_same(golden: Any) -> None:
    table = json.loads(FILE.read_text())
    if (table["numpy"], table["instructions"]) != (np.__version__, golden.instructions()):
        pytest.skip("recorded with another numpy or on a processor with other vector instructions")
    runs = {f"{source} {ego}": golden.run_one((source, ego)) for source, ego in table["cases"]}
    assert golden.differences(table["runs"], runs) == []


def test_a_difference_is_named_by_run_and_part(golden: Any) -> None:
    before = {"a idm": {"attempts": "1", "verdicts": "2", "states": "3"}}
    after = {"a idm": {"attempts": "1", "verdicts": "9", "states": "8"}}
    assert golden.differences(before, after) == ["a idm: verdicts, states differ"]
    assert golden.differences(before, before) == []
