"""8 processes write 500 episodes each to one bank, one of them is killed again and again: 4,000 rows, each once."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from memory_writers import storm


@pytest.mark.soak
def test_eight_writers_of_five_hundred_episodes_and_one_is_killed_again_and_again(tmp_path: Path) -> None:
    assert storm(tmp_path / "bank.sqlite", writers=8, count=500, kills=25) >= 10
