"""Banks of the right format and wrong content: a real bank, and statements that a stranger ran on it."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import struct
from collections.abc import Mapping
from pathlib import Path

from bank_samples import BRAKE_PLANNER, BRAKING, evidence

from sumo_adv.memory.bank import MemoryBank

HUGE = "1" + "0" * 400  # a whole number of 401 digits, which no float holds
REPEATED = ", ".join(3000 * ['"leader"'])
DEEP = "[" * 900 + "]" * 900

ENDLESS = (
    "DROP TABLE settings",
    "CREATE VIEW settings AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS key, '1' AS"
    " value FROM n",
)
"""In place of a table, a view that never ends."""

WRONG: Mapping[str, tuple[str, ...]] = {
    "parameters are no list": ("UPDATE planners SET parameters = '7'",),
    "a parameter is no list": ("UPDATE planners SET parameters = '[7]'",),
    "a parameter is too short": ("""UPDATE planners SET parameters = '[["a", 1]]'""",),
    "a parameter has texts for numbers": ("""UPDATE planners SET parameters = '[["a", "x", "y", "z", "m"]]'""",),
    "a parameter of 401 digits": (f"""UPDATE planners SET parameters = '[["a", {HUGE}, 0, {HUGE}, "m"]]'""",),
    "a parameter without order": ("""UPDATE planners SET parameters = '[["a", 5, 8, 9, "m"]]'""",),
    "parameters nest deeply": (f"UPDATE planners SET parameters = '{DEEP}'",),
    "a text that does not match its hash": ("UPDATE planners SET source = 'import os'",),
    "applies to a number": ("UPDATE intents SET applies = '7'",),
    "applies to numbers": ("UPDATE intents SET applies = '[7]'",),
    "applies to lists": ("UPDATE intents SET applies = '[[]]'",),
    "applies to one thing 3,000 times": (f"UPDATE intents SET applies = '[{REPEATED}]'",),
    "no description": ("UPDATE intents SET description = ' '",),
    "another key": ("UPDATE intents SET key = 'other'",),
    "a relative state of texts": ("""UPDATE evidence SET relative = '{"ahead": "far"}'""",),
    "a relative state that is a list": ("UPDATE evidence SET relative = '[1, 2]'",),
    "a relative state of 401 digits": (f"""UPDATE evidence SET relative = '{{"ahead": {HUGE}}}'""",),
    "parameters of evidence beyond numbers": ("""UPDATE evidence SET parameters = '{"hardness": 1e999}'""",),
    "an endless acceleration": ("UPDATE evidence SET acceleration = 9e999",),
    "knots that are a text": ("""UPDATE evidence SET knots = '"fast"'""",),
    "an endless delay": ("UPDATE evidence SET delay = -9e999",),
    "an epsilon that is a list": ("INSERT INTO settings VALUES ('epsilon.tfidf-1', '[1]')",),
    "an epsilon without numbers": ("""INSERT INTO settings VALUES ('epsilon.tfidf-1', '{"epsilon": 1e999}')""",),
    "merged into a number": ("INSERT INTO settings VALUES ('merged.emergencybraking', '7')",),
    "a setting nests deeply": (f"INSERT INTO settings VALUES ('driver.idm', '{DEEP}')",),
    "evidence without its planner": ("DELETE FROM planners",),
    "planners without their intent": ("DELETE FROM intents",),
    "a view in place of a table": ENDLESS,
    "a trigger": ("CREATE TRIGGER t AFTER INSERT ON evidence BEGIN DELETE FROM planners; END",),
    "a table without its checks": ("DROP TABLE settings", "CREATE TABLE settings (key, value)"),
    "a column more": ("ALTER TABLE intents ADD COLUMN more TEXT",),
    "a table more": ("CREATE TABLE more (x)",),
    "an index of its own": ("CREATE INDEX own ON evidence (abs(seed))",),
}  # fmt: skip
"""What is wrong -> statements, run without SQLite's own checks."""


def bank_of(path: Path) -> Path:
    """A bank with an intent, its planner and a piece of evidence, in one file."""
    with MemoryBank.open(path) as bank:
        bank.record(evidence(), intent=BRAKING, planner=BRAKE_PLANNER)
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
    return path


def spoil(path: Path, statements: tuple[str, ...]) -> None:
    """Run statements on a bank, with foreign keys and checks off."""
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA foreign_keys = OFF")
        connection.execute("PRAGMA ignore_check_constraints = ON")
        for statement in statements:
            connection.execute(statement)


def dump(path: Path) -> list[tuple[object, ...]]:
    """Everything in the file but its journal mode: schema and rows, up to ten of each."""
    with contextlib.closing(sqlite3.connect(path)) as connection:
        tables = connection.execute("SELECT type, name, sql FROM sqlite_master ORDER BY type, name").fetchall()
        rows = [
            connection.execute(f"SELECT * FROM {name}").fetchmany(10) for kind, name, _ in tables if kind == "table"
        ]
    return [*tables, *(row for each in rows for row in each)]


def with_super_journal(database: Path, other: Path) -> Path:
    """Break off a transaction of ``database``, and name ``other`` as its super-journal: SQLite undoes the transaction
    when it opens the database, and then deletes ``other``.

    Source: "File Format For SQLite Databases", section 3: page, name, length and checksum of the name, magic.
    """
    journal, saved = database.with_name(f"{database.name}-journal"), database.with_name("saved")
    with contextlib.closing(sqlite3.connect(database, isolation_level=None)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE").fetchone()
        connection.execute("CREATE TABLE IF NOT EXISTS plain (x)")
        connection.execute("PRAGMA cache_size = 1")  # pages go to the file, and so to the journal, before the end
        connection.execute("BEGIN IMMEDIATE")
        connection.execute("CREATE TABLE half_made (x)")
        connection.executemany("INSERT INTO half_made VALUES (?)", 100 * [("x" * 2000,)])
        shutil.copyfile(database, saved)
        broken_off = journal.read_bytes()
        connection.execute("ROLLBACK")
    saved.replace(database)
    name = bytes(other)
    lock_page = 2**30 // 4096 + 1
    tail = struct.pack(f">I{len(name)}sII", lock_page, name, len(name), sum(name)) + broken_off[:8]
    journal.write_bytes(broken_off + tail)
    return database
