"""A few tries of each attack of ``tests/soak``, and that an attack tells when something breaks."""

from __future__ import annotations

import random
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent / "soak"))
import fuzz_banks
import fuzz_planners
import fuzz_records
import fuzz_runs
import fuzz_toml
from fuzz import hold, wrong_bytes, wrong_values

from sumo_adv.errors import UsageError


@pytest.mark.parametrize(
    ("attack", "count"),
    [
        (fuzz_banks.attack, 60), (fuzz_toml.attack, 100), (fuzz_records.attack, 40), (fuzz_runs.attack, 3),
        (fuzz_planners.attack, 8),
    ],
    ids=["banks", "TOML", "records", "runs", "planners"],
)  # fmt: skip
def test_a_few_tries_break_nothing(attack: Callable[[random.Random, Path], str], count: int) -> None:
    if attack is fuzz_runs.attack:
        fuzz_runs.sample()
    tally = hold(attack, seed=7, count=count)
    assert tally.broken == {}
    assert sum(tally.words.values()) == count


def test_what_breaks_is_told_with_its_number() -> None:
    def attack(rng: random.Random, folder: Path) -> str:
        fate = rng.choice(("taken", "sentence", "no sentence", "crash"))
        if fate == "sentence":
            raise UsageError("The file is wrong; give another.")
        if fate == "no sentence":
            raise UsageError("oops")
        return fate if fate == "taken" else str(1 // 0)

    tally = hold(attack, seed=0, count=200)
    assert set(tally.words) == {"taken", "refused"}
    crashes = [number for number, why in tally.broken.items() if "ZeroDivisionError" in why]
    assert 20 < len(crashes) < 80
    again = hold(attack, seed=0, count=1, first=crashes[3])
    assert list(again.broken) == [crashes[3]]
    assert any("no sentence: 'oops'" in why for why in tally.broken.values())


def test_input_is_made_of_the_seed_alone() -> None:
    made = []
    for _ in range(2):
        rng, table = random.Random(3), {"a": [1, {"b": 2}], "c": "d"}
        wrong_values(rng, table)
        made.append((repr(table), wrong_bytes(rng, b"some bytes that are long enough")))
    assert made[0] == made[1] and made[0][0] != "{'a': [1, {'b': 2}], 'c': 'd'}"
