"""Banks with wrong content: statements on their tables and their schema, and wrong bytes in their file.

``python tests/soak/fuzz_banks.py --seed 1 --count 500``
"""

from __future__ import annotations

import json
import random
import sqlite3
from functools import cache
from pathlib import Path

from fuzz import NASTY, main, one_of, wrong_bytes, wrong_values

from bank_samples import evidence  # isort: skip
from hostile_banks import WRONG, bank_of, spoil  # isort: skip

from sumo_adv.errors import BankError
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.curate import hopeless, near_duplicates, planner_counts, statistics
from sumo_adv.memory.exchange import export_bank
from sumo_adv.memory.records import SceneSignature

COLUMNS = {
    "intents": ("id", "key", "label", "description", "applies", "status", "created"),
    "planners": ("id", "intent", "mode", "source", "parameters", "hash", "parent", "origin", "status", "created"),
    "evidence": (
        "id", "intent", "planner", "geometry", "relation", "relative", "controller", "parameters", "acceleration",
        "delay", "attempts", "min_ttc", "collided", "critical", "feasible", "rear_end", "valid", "strict", "version",
        "network", "seed", "created", "knots",
    ),
    "settings": ("key", "value"),
    "migrations": ("name", "applied"),
}  # fmt: skip
JSON_COLUMNS = ("applies", "parameters", "relative", "knots", "value")


@cache
def sample() -> bytes:
    """The file of a small bank."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        return bank_of(Path(folder) / "bank.sqlite").read_bytes()


def attack(rng: random.Random, folder: Path) -> str:
    """Spoil a bank and do with it what the commands do."""
    path = folder / "bank.sqlite"
    damage = rng.randrange(4)
    path.write_bytes(wrong_bytes(rng, sample()) if damage == 0 else sample())
    if damage == 1:
        for name in rng.sample(list(WRONG), rng.randint(1, 2)):
            _quietly(path, WRONG[name])
    if damage >= 2:
        for _ in range(rng.randint(1, 3)):
            _change(rng, path)
    with MemoryBank.open(path) as bank:
        _use(bank, folder)
        before = bank.content_hash()
    with MemoryBank.open(path, read_only=True) as again:  # what was written can be read
        assert again.content_hash() == before
    return "taken"


def _change(rng: random.Random, path: Path) -> None:
    """A value in a column of a table; texts of JSON are changed within."""
    table = one_of(rng, list(COLUMNS))
    column = one_of(rng, COLUMNS[table])
    with sqlite3.connect(path) as connection:
        held = connection.execute(f"SELECT {column} FROM {table}").fetchone()
    connection.close()
    value = one_of(rng, NASTY)
    if column in JSON_COLUMNS and held is not None and held[0] and rng.random() < 0.7:
        whole = [json.loads(held[0])]
        wrong_values(rng, whole)
        value = json.dumps(whole[0] if whole else None)
    elif isinstance(value, list | dict) or (isinstance(value, int) and abs(value) >= 2**63):
        value = str(value)
    _quietly(path, ((f"UPDATE {table} SET {column} = ?", value),))


def _quietly(path: Path, statements: tuple[object, ...]) -> None:
    """Statements of which the database takes what it takes."""
    for each in statements:
        try:
            if isinstance(each, str):
                spoil(path, (each,))
            else:
                text, value = each  # type: ignore[misc]
                connection = sqlite3.connect(path, isolation_level=None)
                connection.execute("PRAGMA foreign_keys = OFF")
                connection.execute("PRAGMA ignore_check_constraints = ON")
                connection.execute(text, (value,))
                connection.close()
        except (sqlite3.Error, OverflowError, UnicodeEncodeError):
            continue


def _use(bank: MemoryBank, folder: Path) -> None:
    """All commands that read a bank, and a command that writes."""
    bank.epsilon()
    statistics(bank)
    near_duplicates(bank)
    hopeless(bank, 1)
    planner_counts(bank)
    for record in bank.intents():
        bank.retrieve(record.label, record.description)
    for piece in bank.evidence():
        bank.recall_scene(piece.scene)
    bank.recall_scene(SceneSignature("straight", "leader", {"ahead": 1.0}, "idm"))
    export_bank(bank, folder / "export")
    try:
        bank.record(evidence(seed=8))
    except BankError:
        bank.refresh()


if __name__ == "__main__":
    main(attack, 500)
