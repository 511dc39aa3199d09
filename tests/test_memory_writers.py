"""A small storm of writers: the large one is ``tests/soak/test_soak_bank.py``."""

from __future__ import annotations

from pathlib import Path

from memory_writers import storm


def test_three_writers_of_twenty_episodes_and_one_is_killed(tmp_path: Path) -> None:
    assert storm(tmp_path / "bank.sqlite", writers=3, count=20, kills=1) == 1
