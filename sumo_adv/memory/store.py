"""The bank's file: create it, open it, refuse files of other programs, and turn SQLite's errors into sentences."""

from __future__ import annotations

import contextlib
import os
import sqlite3
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from sumo_adv.errors import BankError
from sumo_adv.files import refuse_super_journal, user_folder
from sumo_adv.memory import rows
from sumo_adv.memory.migrations import (
    APPLICATION_ID,
    MIGRATIONS,
    REPAIR_ADVICE,
    Clock,
    check_bank_schema,
    check_identity,
    check_references,
    migrate,
)

BUSY_TIMEOUT_MS = 10_000  # how long a writer waits for another one
_SQLITE_MAGIC = b"SQLite format 3\0"
BANK_FILE_NAME = "memory_bank.sqlite"


def bank_error(error: sqlite3.Error, path: Path) -> BankError:
    """Turn an error of SQLite into a BankError that says what to do.

    Args:
        error: SQLite's error.
        path: The path of the bank.
    """
    code = getattr(error, "sqlite_errorcode", None)
    sentences = {
        sqlite3.SQLITE_FULL: "has no room to grow: the disk is full; free some space and run again, nothing was lost",
        sqlite3.SQLITE_IOERR: "could not be read or written; check the disk and its space, nothing was lost",
        sqlite3.SQLITE_READONLY: "is read-only; give another path, or make the file and its folder writable",
        sqlite3.SQLITE_CANTOPEN: "cannot be opened; check that you may read the file and write in its folder",
        sqlite3.SQLITE_BUSY: f"was in use by another process for over {BUSY_TIMEOUT_MS / 1000:.0f} s; try again",
        sqlite3.SQLITE_CORRUPT: f"is damaged; {REPAIR_ADVICE}",
        sqlite3.SQLITE_NOTADB: "is not a SQLite file; give the path of a memory bank",
    }
    if code is None and isinstance(error, sqlite3.OperationalError):
        code = sqlite3.SQLITE_CORRUPT  # Python's own error: text that is not UTF-8
    sentence = sentences.get(code & 0xFF) if isinstance(code, int) else None
    return BankError(f"The memory bank {path} {sentence or f'failed: {error}'}.")


@contextlib.contextmanager
def as_bank_errors(path: Path) -> Iterator[None]:
    """Raise errors of SQLite and of the file system about ``path`` as BankError.

    Args:
        path: The path of the bank.
    """
    try:
        yield
    except sqlite3.Error as error:
        raise bank_error(error, path) from error
    except UnicodeDecodeError as error:  # in the schema, or in a message about it
        raise BankError(f"The memory bank {path} is damaged; {REPAIR_ADVICE}.") from error
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise BankError(
            f"The memory bank {path} cannot be used: {reason}; give another path or correct that."
        ) from error


def open_database(path: Path, mode: str) -> sqlite3.Connection:
    """Connect in autocommit mode with foreign keys on.

    Args:
        path: The path of the file.
        mode: The query part of SQLite's file URI.

    Raises:
        UsageError: A journal beside the file does not belong to this program.
        OSError: The file cannot be opened.
        sqlite3.Error: SQLite refuses the file.
    """
    refuse_super_journal(path)
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?{mode}", uri=True, isolation_level=None, timeout=BUSY_TIMEOUT_MS / 1000
    )
    connection.execute("PRAGMA foreign_keys = ON")
    connection.execute(f"PRAGMA busy_timeout = {BUSY_TIMEOUT_MS}")
    return connection


def open_file(path: Path, *, seed_from: Path | None, read_only: bool, clock: Clock) -> tuple[sqlite3.Connection, bool]:
    """Open a bank and bring it to the newest version.

    A missing file is created first, except with ``read_only``. The shipped bank itself is opened read-only.

    Args:
        path: The path of the file.
        seed_from: The bank that a missing file is copied from; None creates a blank one.
        read_only: Whether to create and change no file.
        clock: Returns the time stamp of new rows.

    Returns:
        The connection, and whether the bank can be written.

    Raises:
        BankError: The file is no bank, is damaged, or cannot be opened.
    """
    with as_bank_errors(path):
        if seed_from is not None and path.exists() and seed_from.exists() and path.samefile(seed_from):
            read_only = True
        if not path.exists():
            if read_only:
                raise BankError(f"The memory bank {path} does not exist.")
            _create(path, seed_from, clock)
        _check_header(path)
        connection = None if read_only else _open_writable(path, clock)
        return (connection, True) if connection is not None else (_open_readable(path), False)


def _check_header(path: Path) -> None:
    """Refuse folders, empty files and non-SQLite files before SQLite touches them; raise BankError or OSError."""
    if path.is_dir():
        raise BankError(f"The memory bank {path} is a folder; give the path of a file.")
    with path.open("rb") as file:
        head = file.read(len(_SQLITE_MAGIC))
    if not head:
        raise BankError(f"The memory bank {path} is an empty file; delete it and a new bank will be made there.")
    if head != _SQLITE_MAGIC:
        raise BankError(f"The memory bank {path} is not a SQLite file; give the path of a memory bank.")


def _open_writable(path: Path, clock: Clock) -> sqlite3.Connection | None:
    """Connect in WAL mode and migrate to the newest version; return None if the file or its folder is read-only."""
    connection = open_database(path, "mode=rw")
    try:
        _check(connection, path)
        if connection.execute("PRAGMA journal_mode").fetchone()[0] != "wal":
            connection.execute("PRAGMA journal_mode = WAL").fetchone()
        connection.execute("PRAGMA synchronous = NORMAL")
        connection.execute("BEGIN IMMEDIATE")
        connection.execute("ROLLBACK")
        migrate(connection, str(path), clock)
    except sqlite3.OperationalError as error:
        connection.close()
        code = getattr(error, "sqlite_errorcode", 0)  # see bank_error
        if code & 0xFF in (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN):
            return None
        raise
    except BaseException:
        connection.close()
        raise
    return connection


def _connect_readable(path: Path) -> sqlite3.Connection:
    """Connect read-only, without making a file beside the bank unless another process has a log there."""
    log = path.with_name(path.name + "-wal")
    pending = log.exists() and log.stat().st_size > 0
    return open_database(path, "mode=ro" if pending else "mode=ro&immutable=1")


def _open_readable(path: Path) -> sqlite3.Connection:
    """Connect read-only to a bank of the newest version; raise BankError for an older one."""
    connection = _connect_readable(path)
    try:
        if _check(connection, path) < len(MIGRATIONS):
            raise BankError(
                f"The memory bank {path} must be brought to the newest version but is read-only; copy it elsewhere."
            )
    except BaseException:
        connection.close()
        raise
    return connection


def _check(connection: sqlite3.Connection, path: Path) -> int:
    """Return the version of the file, which is not changed.

    Raises:
        BankError: The file belongs to another program, is newer, has another schema or is damaged.
    """
    version = check_identity(connection, str(path))
    check_bank_schema(connection, str(path), version)
    if connection.execute("PRAGMA quick_check(1)").fetchall() != [("ok",)]:
        raise BankError(f"The memory bank {path} is damaged; {REPAIR_ADVICE}.")
    check_references(connection, str(path))
    return version


def make_file(path: Path, fill: Callable[[sqlite3.Connection], None], *, replace: bool = False) -> None:
    """Make a new file that ``fill`` turns into a bank; it appears whole or not at all.

    A file that exists, or that another process makes meanwhile, is kept unless ``replace``.

    Args:
        path: The path of the file.
        fill: Writes the content through a connection.
        replace: Whether to replace an existing file.

    Raises:
        BankError: ``fill`` refuses the content.
        OSError: The file cannot be written.
        sqlite3.Error: SQLite cannot write the file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.name}-", suffix=".new", dir=path.parent)
    os.close(handle)
    fresh = Path(name)
    try:
        with contextlib.closing(open_database(fresh, "mode=rw")) as connection:
            fill(connection)
        fresh.chmod(0o644)
        if replace:
            fresh.replace(path)
        else:
            publish(fresh, path)
    finally:
        for leftover in (fresh, *(Path(name + end) for end in ("-wal", "-shm", "-journal"))):
            leftover.unlink(missing_ok=True)


def _create(path: Path, seed_from: Path | None, clock: Clock) -> None:
    """Create a bank in WAL mode, blank or as a copy of ``seed_from``, which is only read."""

    def fill(connection: sqlite3.Connection) -> None:
        if seed_from is None:
            connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        else:
            with as_bank_errors(seed_from):
                _check_header(seed_from)
                with contextlib.closing(_connect_readable(seed_from)) as seed_bank:
                    _check(seed_bank, seed_from)
                    seed_bank.backup(connection)
        connection.execute("PRAGMA journal_mode = WAL").fetchone()
        migrate(connection, str(seed_from or path), clock)
        if seed_from is not None:
            rows.read_snapshot(connection)  # refuses content that no bank can have, before the copy gets its name

    make_file(path, fill)


def publish(fresh: Path, path: Path) -> None:
    """Give a file its final name unless that exists; without hard links, move it.

    Args:
        fresh: The file.
        path: Its final name.
    """
    try:
        os.link(fresh, path)
    except FileExistsError:
        return
    except OSError:
        if not path.exists():
            fresh.replace(path)


def default_bank_path(
    environ: Mapping[str, str] = os.environ, platform: str = sys.platform, home: Path | None = None
) -> Path:
    """Return the path of the bank in the user's data folder (:func:`~sumo_adv.files.user_folder`). Nothing is created.

    Args:
        environ: The environment variables.
        platform: The platform, as in ``sys.platform``.
        home: The home folder; None looks it up.
    """
    return user_folder("data", environ, platform, home) / BANK_FILE_NAME
