"""Is a file of the bank's format laid out as a bank, with all that refers to something referring to what is there?

A file with the bank's application id and version may hold anything else: a view in place of a table (which may never
end), a trigger, a table without its checks.  So its schema is compared with that of the migrations.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from functools import lru_cache

from sumo_adv.errors import BankError
from sumo_adv.memory.migrations import APPLICATION_ID, MIGRATIONS, migrate

REPAIR = "restore a copy, or move it away to start from the shipped one"

_OBJECTS = "SELECT type, name, tbl_name, sql FROM sqlite_master WHERE name NOT LIKE 'sqlite\\_%' ESCAPE '\\'"

Schema = frozenset[tuple[str, str, str, str]]
"""Type, name, table and statement of each object."""


def check_schema(connection: sqlite3.Connection, name: str, version: int) -> None:
    """Refuse a file with another schema than that of ``version``. No table is read. Raises BankError, sqlite3.Error."""
    present, expected = _schema(connection), _schema_of(version)
    if present != expected:
        difference = sorted(f"{kind} {each}" for kind, each, *_ in present ^ expected)[0]
        raise BankError(f"The memory bank {name} is not laid out as one (it differs in the {difference}); {REPAIR}.")


def check_references(connection: sqlite3.Connection, name: str) -> None:
    """Refuse planners without their intent and evidence without its planner. Raises BankError, sqlite3.Error."""
    orphan = connection.execute("PRAGMA foreign_key_check").fetchone()
    if orphan is not None:
        table, row, parent, _ = orphan
        raise BankError(
            f"The memory bank {name} is damaged: row {row} of its {table} belongs to none of its {parent}; {REPAIR}."
        )


def _schema(connection: sqlite3.Connection) -> Schema:
    rows = connection.execute(_OBJECTS)
    return frozenset((kind, name, table, " ".join(str(sql).split())) for kind, name, table, sql in rows)


@lru_cache
def _schema_of(version: int) -> Schema:
    """What the first ``version`` migrations make of a blank file."""
    if version == 0:
        return frozenset()
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as blank:
        blank.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        migrate(blank, "blank", migrations=MIGRATIONS[:version])
        return _schema(blank)
