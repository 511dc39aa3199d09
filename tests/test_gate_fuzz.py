"""The gate's fuzzer in small: 400 messages of each of two seeds (the long run is ``tests/soak/fuzz_gate.py``)."""

from __future__ import annotations

from pathlib import Path

import pytest
from gate_fuzzer import messages
from gate_samples import needs_sumo
from soak.fuzz_gate import fuzz


def test_a_seed_says_what_is_sent() -> None:
    first, again, other_seed = messages(1), messages(1), messages(2)
    sent = [next(first) for _ in range(50)]
    assert sent == [next(again) for _ in range(50)] != [next(other_seed) for _ in range(50)]
    assert 5 < sum(not whole for _, whole in sent) < 25  # one in four is mutated


@needs_sumo
@pytest.mark.parametrize("seed", [101, 102])
def test_sumo_outlives_the_messages(tmp_path: Path, seed: int) -> None:
    counts = fuzz(tmp_path, seed, 60.0, most=400)
    assert counts["answered"] > 0 and counts["refused"] < counts["answered"]
    assert counts["mutated, cut"] > 0
