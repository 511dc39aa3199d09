"""Files are written whole, and odd values cost themselves alone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from sumo_adv.files import json_text


def test_values_that_json_does_not_know_become_null_or_text() -> None:
    value = {"never": float("inf"), "list": [1.5, float("nan"), (np.float64("-inf"), 2)], 3: Path("a/b")}
    assert json.loads(json_text(value)) == {"never": None, "list": [1.5, None, [None, 2]], "3": "a/b"}
