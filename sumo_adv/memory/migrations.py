"""The schema of the memory bank, as an append-only list of named migrations.

A released migration is never edited: add a new one at the end. Each runs in one transaction together with its row in
``migrations`` and the new ``user_version`` (the number of migrations applied), so that a file is always at exactly one
version. The pattern is that of llm's ``migrations.py`` and sqlite-utils.

A file with the bank's application id and version may still hold anything: a view in place of a table (which may never
end), a trigger, or a table without its checks. Therefore its schema is compared with that of the migrations.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache

from sumo_adv.errors import BankError

APPLICATION_ID = 0x53414442  # "SADB", in bytes 68-71 of the file: marks a bank of this program

Clock = Callable[[], str]
REPAIR_ADVICE = "restore a copy, or move it away to start from the shipped one"
_SCHEMA_OBJECTS_QUERY = (
    "SELECT type, name, tbl_name, sql FROM sqlite_master WHERE name NOT LIKE 'sqlite\\_%' ESCAPE '\\'"
)
Schema = frozenset[tuple[str, str, str, str]]
"""The type, name, table and statement of each object."""


@dataclass(frozen=True, slots=True)
class Migration:
    """A step of the schema.

    Attributes:
        name: The name, which never changes.
        statements: The SQL statements, run in order.
    """

    name: str
    statements: tuple[str, ...]


MIGRATIONS: tuple[Migration, ...] = (
    Migration(
        "0001_intents_planners_evidence_settings",
        (
            """
            CREATE TABLE intents (
                id          INTEGER PRIMARY KEY,
                key         TEXT NOT NULL UNIQUE,  -- the label without case, spaces and signs
                label       TEXT NOT NULL UNIQUE,
                description TEXT NOT NULL,
                applies     TEXT NOT NULL CHECK (json_valid(applies)),  -- list of relations
                status      TEXT NOT NULL CHECK (status IN ('active', 'retired')),
                created     TEXT NOT NULL
            ) STRICT
            """,
            """
            CREATE TABLE planners (
                id         INTEGER PRIMARY KEY,
                intent     INTEGER NOT NULL REFERENCES intents (id),
                mode       TEXT NOT NULL,
                source     TEXT NOT NULL,
                parameters TEXT NOT NULL CHECK (json_valid(parameters)),  -- list of [name, default, low, ..]
                hash       TEXT NOT NULL,  -- SHA-256 of the source
                parent     TEXT,           -- hash of the version it was made from, which need not be in this bank
                origin     TEXT NOT NULL,
                status     TEXT NOT NULL CHECK (status IN ('active', 'retired')),
                created    TEXT NOT NULL,
                UNIQUE (intent, hash)
            ) STRICT
            """,
            """
            CREATE TABLE evidence (
                id           INTEGER PRIMARY KEY,
                intent       INTEGER NOT NULL REFERENCES intents (id),
                planner      TEXT NOT NULL,  -- planners.hash
                geometry     TEXT NOT NULL,
                relation     TEXT NOT NULL,
                relative     TEXT NOT NULL CHECK (json_valid(relative)),  -- named numbers
                controller   TEXT NOT NULL,
                parameters   TEXT NOT NULL CHECK (json_valid(parameters)),  -- named numbers
                acceleration REAL NOT NULL,
                delay        REAL NOT NULL,
                attempts     INTEGER NOT NULL CHECK (attempts >= 1),
                min_ttc      REAL CHECK (min_ttc >= 0),  -- NULL: never
                collided     INTEGER NOT NULL CHECK (collided IN (0, 1)),
                critical     INTEGER NOT NULL CHECK (critical IN (0, 1)),
                feasible     INTEGER NOT NULL CHECK (feasible IN (0, 1)),
                rear_end     INTEGER NOT NULL CHECK (rear_end IN (0, 1)),
                valid        INTEGER CHECK (valid IN (0, 1)),   -- NULL: no collision
                strict       INTEGER CHECK (strict IN (0, 1)),
                version      TEXT NOT NULL,
                network      TEXT NOT NULL,
                seed         INTEGER NOT NULL,
                created      TEXT NOT NULL,
                FOREIGN KEY (intent, planner) REFERENCES planners (intent, hash)
            ) STRICT
            """,
            "CREATE INDEX evidence_by_intent ON evidence (intent, planner)",
            """
            CREATE TABLE settings (
                key   TEXT PRIMARY KEY,
                value TEXT NOT NULL CHECK (json_valid(value))
            ) STRICT
            """,
        ),
    ),
    Migration(
        "0002_acceleration_knots",
        (
            # list of [time, m/s2]; NULL if evidence.acceleration holds throughout, otherwise that is the first entry's
            "ALTER TABLE evidence ADD COLUMN knots TEXT CHECK (knots IS NULL OR json_valid(knots))",
        ),
    ),
    Migration(
        "0003_no_driver_weights",  # unknown drivers are explored by attempts, so no driver weights are kept
        ("DELETE FROM settings WHERE key LIKE 'driver.%'",),
    ),
)


def utc_now() -> str:
    """Return the current time as ISO 8601 in UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def check_identity(connection: sqlite3.Connection, name: str, known: int = len(MIGRATIONS)) -> int:
    """Return the version of the file; 0 is a blank bank.

    Args:
        connection: The connection to the file.
        name: The file's name, for error messages.
        known: The number of migrations that are known.

    Raises:
        BankError: The file belongs to another program, or is newer than ``known`` migrations.
    """
    if connection.execute("PRAGMA application_id").fetchone()[0] != APPLICATION_ID:
        raise BankError(
            f"{name} is a SQLite file of another program, not a memory bank; give the path of a memory bank."
        )
    version = int(connection.execute("PRAGMA user_version").fetchone()[0])
    if version > known:
        raise BankError(
            f"The memory bank {name} has version {version} and this program knows up to {known};"
            " install a newer sumo-adv."
        )
    return version


def migrate(
    connection: sqlite3.Connection, name: str, clock: Clock = utc_now, migrations: Sequence[Migration] = MIGRATIONS
) -> list[str]:
    """Bring a bank to the newest version.

    Args:
        connection: The connection to the file, in autocommit mode.
        name: The file's name, for error messages.
        clock: Returns the time stamp of the migrations.
        migrations: All migrations, oldest first.

    Returns:
        The names of the migrations that were applied.

    Raises:
        BankError: The file is refused by ``check_identity``, or its migrations are not the first of ``migrations``.
    """
    applied: list[str] = []
    while (version := check_identity(connection, name, len(migrations))) < len(migrations):
        step = migrations[version]
        with connection:  # commits, or rolls back on any error
            connection.execute("BEGIN IMMEDIATE")
            if connection.execute("PRAGMA user_version").fetchone()[0] != version:
                continue  # another process was faster
            connection.execute(
                "CREATE TABLE IF NOT EXISTS migrations (name TEXT PRIMARY KEY, applied TEXT NOT NULL) STRICT"
            )
            for statement in step.statements:
                connection.execute(statement)
            connection.execute("INSERT INTO migrations VALUES (?, ?)", (step.name, clock()))
            connection.execute(f"PRAGMA user_version = {version + 1}")
        applied.append(step.name)
    rows = connection.execute("SELECT name FROM migrations ORDER BY name").fetchall()
    if [row[0] for row in rows] != sorted(m.name for m in migrations):
        raise BankError(
            f"The memory bank {name} was made by another branch of this program: export it there, import it here."
        )
    return applied


def check_bank_schema(connection: sqlite3.Connection, name: str, version: int) -> None:
    """Refuse a file whose schema is not that of its version. No table is read.

    Args:
        connection: The connection to the file.
        name: The file's name, for error messages.
        version: The version of the file.

    Raises:
        BankError: The schema differs.
        sqlite3.Error: The file cannot be read.
    """
    present, expected = _schema(connection), _schema_of(version)
    if present != expected:
        difference = sorted(f"{kind} {each}" for kind, each, *_ in present ^ expected)[0]
        raise BankError(
            f"The memory bank {name} is not laid out as one (it differs in the {difference}); {REPAIR_ADVICE}."
        )


def check_references(connection: sqlite3.Connection, name: str) -> None:
    """Refuse planners without their intent and evidence without its planner.

    Args:
        connection: The connection to the file.
        name: The file's name, for error messages.

    Raises:
        BankError: A row refers to a missing one.
        sqlite3.Error: The file cannot be read.
    """
    orphan = connection.execute("PRAGMA foreign_key_check").fetchone()
    if orphan is not None:
        table, row, parent, _ = orphan
        raise BankError(
            f"The memory bank {name} is damaged: row {row} of its {table} belongs to none of its {parent}; "
            f"{REPAIR_ADVICE}."
        )


def _schema(connection: sqlite3.Connection) -> Schema:
    """Return the schema of a file."""
    rows = connection.execute(_SCHEMA_OBJECTS_QUERY)
    return frozenset((kind, name, table, " ".join(str(sql).split())) for kind, name, table, sql in rows)


@lru_cache
def _schema_of(version: int) -> Schema:
    """Return the schema that the first ``version`` migrations give a blank file."""
    if version == 0:
        return frozenset()
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as blank:
        blank.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        migrate(blank, "blank", migrations=MIGRATIONS[:version])
        return _schema(blank)
