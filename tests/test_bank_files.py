"""Opening a memory bank: blank, old, newer, foreign, damaged, read-only, no room; the shipped bank is never touched."""

from __future__ import annotations

import contextlib
import os
import sqlite3
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from bank_samples import BRAKE_PLANNER, BRAKING, evidence

from sumo_adv.errors import BankError
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.migrations import APPLICATION_ID, MIGRATIONS, Migration, migrate
from sumo_adv.memory.store import bank_error, publish

TESTS = Path(__file__).parent
MIGRATIONS_TABLE = "CREATE TABLE IF NOT EXISTS migrations (name TEXT PRIMARY KEY, applied TEXT NOT NULL) STRICT"


def tables(path: Path) -> set[str]:
    with contextlib.closing(sqlite3.connect(path)) as connection:
        return {row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}


def by_hand(path: Path, application: int, version: int, *statements: str) -> Path:
    """A SQLite file with these marks and statements."""
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute(f"PRAGMA application_id = {application}")
        connection.execute(f"PRAGMA user_version = {version}")
        for statement in statements:
            connection.execute(statement)
        connection.commit()
    return path


def test_a_path_that_does_not_exist_becomes_a_migrated_bank(tmp_path: Path) -> None:
    path = tmp_path / "bank.sqlite"
    with MemoryBank.open(path):
        pass
    assert tables(path) == {"intents", "planners", "evidence", "settings", "migrations"}
    with contextlib.closing(sqlite3.connect(path)) as connection:
        assert connection.execute("PRAGMA user_version").fetchone() == (len(MIGRATIONS),)
        assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)
        assert connection.execute("SELECT name FROM migrations").fetchall() == [(m.name,) for m in MIGRATIONS]
        with pytest.raises(sqlite3.IntegrityError):
            connection.execute("INSERT INTO settings VALUES ('k', 'not json')")
        strict = connection.execute("SELECT name FROM pragma_table_list WHERE schema = 'main' AND strict").fetchall()
        assert len(strict) == 5
    with pytest.raises(BankError, match="does not exist"):
        MemoryBank.open(tmp_path / "other", read_only=True)


def test_an_old_file_made_by_hand_is_migrated(tmp_path: Path) -> None:
    path = by_hand(tmp_path / "old.sqlite", APPLICATION_ID, 0, *MIGRATIONS[0].statements, MIGRATIONS_TABLE)
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute("INSERT INTO migrations VALUES (?, '2026-01-01')", (MIGRATIONS[0].name,))
        connection.execute("PRAGMA user_version = 1")
        connection.commit()
    with pytest.raises(BankError, match="read-only"):
        MemoryBank.open(path, read_only=True)
    with MemoryBank.open(path) as bank:
        bank.record(evidence(), intent=BRAKING, planner=BRAKE_PLANNER)
        assert len(bank.evidence()) == 1


def test_a_later_migration_keeps_rows_and_one_that_fails_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "bank.sqlite"
    with MemoryBank.open(path) as bank:
        bank.record(evidence(), intent=BRAKING, planner=BRAKE_PLANNER)
    later = Migration("9998_note", ("ALTER TABLE intents ADD COLUMN note TEXT",))
    broken = Migration("9999_broken", ("CREATE TABLE half (x)", "INSERT INTO nowhere VALUES (1)"))
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as connection:
        assert migrate(connection, "bank", migrations=(*MIGRATIONS, later)) == ["9998_note"]
        assert migrate(connection, "bank", migrations=(*MIGRATIONS, later)) == []
        with pytest.raises(sqlite3.OperationalError, match="nowhere"):
            migrate(connection, "bank", migrations=(*MIGRATIONS, later, broken))
        assert connection.execute("PRAGMA user_version").fetchone() == (len(MIGRATIONS) + 1,)
        assert connection.execute("SELECT label, note FROM intents").fetchall() == [("Emergency Braking", None)]
        with pytest.raises(BankError, match="another branch"):
            migrate(connection, "bank", migrations=(*MIGRATIONS, broken))
    assert "half" not in tables(path)
    with pytest.raises(BankError, match="install a newer"):
        MemoryBank.open(path)


def test_files_that_are_not_ours_are_refused_and_stay_as_they_are(tmp_path: Path) -> None:
    foreign = by_hand(tmp_path / "foreign.sqlite", 0, 0, "CREATE TABLE theirs (x)")
    newer = by_hand(tmp_path / "newer.sqlite", APPLICATION_ID, 99)
    text = tmp_path / "notes.txt"
    text.write_text("not a database, but long enough to hold a header\n" * 100)
    empty = tmp_path / "empty.sqlite"
    empty.touch()
    cases = {foreign: "another program", newer: "version 99", text: "not a SQLite file", empty: "empty file"}
    for path, sentence in cases.items():
        before = path.read_bytes()
        with pytest.raises(BankError, match=sentence):
            MemoryBank.open(path)
        assert path.read_bytes() == before
    with pytest.raises(BankError, match="is a folder"):
        MemoryBank.open(tmp_path)
    assert {file.name for file in tmp_path.iterdir()} == {path.name for path in cases}


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bank.sqlite"
    with MemoryBank.open(path) as bank:
        for seed in range(50):
            bank.record(evidence(seed=seed), intent=BRAKING, planner=BRAKE_PLANNER)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(BankError, match="damaged"):
        MemoryBank.open(path)
    path.write_bytes(whole[:4096] + b"\xa5" * (len(whole) - 4096))
    with pytest.raises(BankError, match="damaged"):
        MemoryBank.open(path)


def test_the_shipped_bank_is_copied_and_never_written(tmp_path: Path) -> None:
    shipped = tmp_path / "shipped" / "memory_bank.sqlite"
    with MemoryBank.open(shipped) as bank:
        bank.add(BRAKING, [BRAKE_PLANNER])
    before = shipped.read_bytes()
    own_copy = tmp_path / "mine" / "bank.sqlite"
    with MemoryBank.open(own_copy, seed_from=shipped) as bank:
        assert bank.intents() == [BRAKING]
        bank.record(evidence())
    with MemoryBank.open(own_copy, seed_from=shipped) as bank:
        assert len(bank.evidence()) == 1
    with MemoryBank.open(shipped, seed_from=shipped) as bank, pytest.raises(BankError, match="read-only"):
        bank.record(evidence())
    assert shipped.read_bytes() == before
    assert [file.name for file in shipped.parent.iterdir()] == ["memory_bank.sqlite"]
    assert [file.name for file in own_copy.parent.iterdir()] == ["bank.sqlite"]


def test_a_seed_that_is_not_a_bank_leaves_nothing_behind(tmp_path: Path) -> None:
    seed = tmp_path / "seed.sqlite"
    seed.write_text("x" * 200)
    with pytest.raises(BankError, match=r"seed\.sqlite is not a SQLite file"):
        MemoryBank.open(tmp_path / "mine.sqlite", seed_from=seed)
    with pytest.raises(BankError, match="lacking"):
        MemoryBank.open(tmp_path / "mine.sqlite", seed_from=tmp_path / "lacking.sqlite")
    assert list(tmp_path.iterdir()) == [seed]


def test_of_two_that_make_the_same_bank_the_first_is_kept(tmp_path: Path) -> None:
    first, second, path = tmp_path / "first", tmp_path / "second", tmp_path / "bank"
    first.write_text("first")
    second.write_text("second")
    publish(first, path)
    publish(second, path)
    assert path.read_text() == "first"


@contextlib.contextmanager
def ordinary_user() -> Iterator[Path]:
    """A folder, and within the block no rights of root, which may write read-only files."""
    if not hasattr(os, "geteuid"):
        pytest.skip("rights of files are another thing here")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        root = os.geteuid() == 0
        if root:
            os.seteuid(65534)
        try:
            if not os.access(folder, os.R_OK, effective_ids=True):
                pytest.skip("an ordinary user cannot reach the folder for temporary files")
            yield folder
        finally:
            if root:
                os.seteuid(0)
            folder.chmod(0o755)


@contextlib.contextmanager
def as_owner() -> Iterator[None]:
    """Back to the rights that the tests started with."""
    user = os.geteuid()
    os.seteuid(os.getuid())
    try:
        yield
    finally:
        os.seteuid(user)


def test_a_read_only_bank_is_read_and_refuses_to_be_written() -> None:
    with ordinary_user() as folder:
        path = folder / "bank.sqlite"
        with as_owner():
            with MemoryBank.open(path) as bank:
                bank.record(evidence(), intent=BRAKING, planner=BRAKE_PLANNER)
            path.chmod(stat.S_IRUSR | stat.S_IRGRP | stat.S_IROTH)
            folder.chmod(0o555)
        with MemoryBank.open(path) as bank:
            assert not bank.writable
            assert bank.retrieve("emergency braking").hit == "Emergency Braking"
            with pytest.raises(BankError, match="read-only"):
                bank.record(evidence(seed=8))
        with pytest.raises(BankError, match="cannot be used: permission denied"):
            MemoryBank.open(folder / "new.sqlite")
        assert [file.name for file in folder.iterdir()] == ["bank.sqlite"]


def test_a_read_only_file_in_a_writable_folder_refuses_to_be_written() -> None:
    with ordinary_user() as folder:
        with as_owner():
            folder.chmod(0o777)
        path = folder / "bank.sqlite"
        with MemoryBank.open(path) as bank:
            bank.record(evidence(), intent=BRAKING, planner=BRAKE_PLANNER)
        path.chmod(0o444)
        with MemoryBank.open(path) as bank:
            assert len(bank.evidence()) == 1
            with pytest.raises(BankError, match="read-only"):
                bank.record(evidence(seed=8))


def test_each_error_of_sqlite_is_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "full.sqlite"
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE t (x)")
        connection.execute("PRAGMA max_page_count = 2")
        with pytest.raises(sqlite3.OperationalError) as full:
            connection.execute("INSERT INTO t VALUES (zeroblob(100000))")
    message = str(bank_error(full.value, path))
    assert "the disk is full; free some space" in message
    assert message.startswith(f"The memory bank {path} ")
    assert str(bank_error(sqlite3.ProgrammingError("odd"), path)).endswith("failed: odd.")


LIMITED = """
import resource, sys
from pathlib import Path
from bank_samples import evidence
from sumo_adv.errors import BankError
from sumo_adv.memory.bank import MemoryBank
with MemoryBank.open(Path(sys.argv[1])) as bank:
    resource.setrlimit(resource.RLIMIT_FSIZE, (16384, resource.RLIM_INFINITY))
    try:
        bank.record(evidence(network="n" * 60_000))
    except BankError as error:
        print(len(bank.evidence()), error)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no limit on file sizes to set here")
def test_no_room_for_a_row_is_a_sentence_and_loses_nothing(tmp_path: Path) -> None:
    path = tmp_path / "bank.sqlite"
    with MemoryBank.open(path) as bank:
        bank.record(evidence(), intent=BRAKING, planner=BRAKE_PLANNER)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(TESTS), str(TESTS.parent)))}
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(path)], env=environment, capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("1 The memory bank")
    assert "nothing was lost" in done.stdout
    with MemoryBank.open(path) as bank:
        assert bank.evidence() == [evidence()]


def test_a_busy_bank_waits_for_the_other_writer(tmp_path: Path) -> None:
    path = tmp_path / "bank.sqlite"
    with MemoryBank.open(path) as bank, contextlib.closing(sqlite3.connect(path, isolation_level=None)) as writer:
        writer.execute("BEGIN IMMEDIATE")
        assert bank.retrieve("Emergency Braking").hit is None
        bank.refresh()
        writer.execute("ROLLBACK")
        bank.record(evidence(), intent=BRAKING, planner=BRAKE_PLANNER)
        assert len(bank.evidence()) == 1
