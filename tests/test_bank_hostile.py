"""A bank of the right format and wrong content, and folders to import that cost more than they say: one sentence."""

from __future__ import annotations

import contextlib
import sqlite3
import tracemalloc
from pathlib import Path

import pytest
from bank_samples import BRAKE_PLANNER, BRAKING, evidence
from hostile_banks import HUGE, WRONG, bank_of, dump, spoil, with_super_journal

from sumo_adv.datatypes import Parameter, Planner
from sumo_adv.errors import BankError, UsageError
from sumo_adv.files import held
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.build import read_folder
from sumo_adv.memory.exchange import export_bank
from sumo_adv.planners.text import parse_parameters


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("read_only", [False, True], ids=["to write", "to read"])
def test_a_bank_with_wrong_content_is_refused_in_a_sentence_and_stays_as_it_is(
    tmp_path: Path, wrong: str, read_only: bool
) -> None:
    path = bank_of(tmp_path / "bank.sqlite")
    spoil(path, WRONG[wrong])
    before = dump(path)
    with pytest.raises(BankError, match=r"bank\.sqlite .*(damaged|not laid out).*; restore a copy, or move it away"):
        MemoryBank.open(path, read_only=read_only)
    assert dump(path) == before
    with pytest.raises(BankError):
        MemoryBank.open(tmp_path / "mine.sqlite", seed_from=path)
    assert not (tmp_path / "mine.sqlite").exists()


@pytest.mark.parametrize("text", [b"CREATE TABLE intents", b"geometry     TEXT"], ids=["a name", "a column"])
def test_a_schema_that_is_no_text_is_damage(tmp_path: Path, text: bytes) -> None:
    path = bank_of(tmp_path / "bank.sqlite")
    data = path.read_bytes()
    assert data.count(text) == 1
    path.write_bytes(data.replace(text, text.replace(b"e", b"\xe3", 1)))
    with pytest.raises(BankError, match="is damaged; restore a copy"):
        MemoryBank.open(path)


def test_what_no_bank_may_hold_is_not_written_to_one(tmp_path: Path) -> None:
    """Else the bank could not be opened again."""
    backwards = Planner(BRAKING.label, "odd", "# odd\n", (Parameter("a", 5.0, 8.0, 9.0, "m"),), "person")
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        with pytest.raises(BankError, match="low <= default <= high"):
            bank.add(BRAKING, [backwards])
        bank.add(BRAKING, [BRAKE_PLANNER])
        for changes in ({"parameters": {"hardness": 1e10}}, {"delay": float("nan")}, {"seed": 2**63}, {"attempts": 0}):
            with pytest.raises(BankError, match="cannot be used"):
                bank.record(evidence(**changes))
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        assert bank.evidence() == []


@pytest.fixture
def export(tmp_path: Path) -> Path:
    """The folder of an exported bank with one intent and a piece of evidence."""
    with MemoryBank.open(bank_of(tmp_path / "bank.sqlite")) as bank:
        export_bank(bank, tmp_path / "export")
    return tmp_path / "export"


def test_a_relation_that_is_named_again_and_again_is_refused_before_anything_is_tried(export: Path) -> None:
    file = export / "emergency_braking" / "intent.toml"
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace('"leader"', ", ".join(["'leader'"] * 3000)), encoding="utf-8")
    tracemalloc.start()
    with pytest.raises(BankError, match="names a relation twice"):
        read_folder(export, parse_parameters)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10e6  # bytes


@pytest.mark.parametrize("linked", ["an intent", "the shared texts"])
def test_an_import_follows_no_linked_folder(export: Path, tmp_path: Path, linked: str) -> None:
    elsewhere = tmp_path / "elsewhere"
    if linked == "an intent":
        (export / "emergency_braking").rename(elsewhere)
        (export / "emergency_braking").symlink_to(elsewhere)
    else:
        elsewhere.mkdir()
        (elsewhere / "brake.template").write_text(BRAKE_PLANNER.text, encoding="utf-8")
        (export / "planners").symlink_to(elsewhere)
        file = export / "emergency_braking" / "intent.toml"
        file.write_text(file.read_text(encoding="utf-8") + "\n[shared]\nbrake = {}\n", encoding="utf-8")
    with pytest.raises(BankError, match="is a link"):
        read_folder(export, parse_parameters)


def test_evidence_with_a_number_of_401_digits_is_refused_by_its_line(export: Path) -> None:
    file = export / "emergency_braking" / "evidence.csv"
    text = file.read_text(encoding="utf-8")
    assert '""gap"": 12.5' in text
    file.write_text(text.replace('""gap"": 12.5', f'""gap"": {HUGE}'), encoding="utf-8")
    with pytest.raises(
        BankError, match=r"evidence\.csv, line 2, is not evidence: a whole number in it has more than 64"
    ):
        read_folder(export, lambda _: BRAKE_PLANNER.parameters)


def test_a_journal_beside_a_database_has_no_file_elsewhere_deleted(tmp_path: Path) -> None:
    """A bank, and the lock of a campaign's folder, with journals of a stranger; another database shows what they do."""
    other = tmp_path / "other.txt"
    other.write_text("kept", encoding="utf-8")
    bank, lock = with_super_journal(bank_of(tmp_path / "bank.sqlite"), other), tmp_path / "lock"
    with_super_journal(lock, other)
    with pytest.raises(UsageError, match=r"bank\.sqlite-journal would have SQLite delete a file elsewhere"):
        MemoryBank.open(bank)
    with pytest.raises(UsageError, match="lock-journal would have SQLite delete"), held(lock):
        pass
    assert other.read_text(encoding="utf-8") == "kept"
    with contextlib.closing(sqlite3.connect(lock)) as connection:
        connection.execute("SELECT * FROM plain")
    assert not other.exists()
