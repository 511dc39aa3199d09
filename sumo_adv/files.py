"""Write files whole or not at all, describe storage errors, and handle folders that others may have made."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from sumo_adv.errors import SumoAdvError, UsageError

FULL = (errno.ENOSPC, errno.EDQUOT)
FORMULA = ("=", "+", "-", "@", "\t", "\r")
WRITE_REFUSED = (errno.EROFS, errno.EACCES, errno.EPERM, errno.EFBIG, errno.EIO)

USER_FOLDERS = {
    # variable and folder on Linux and other systems, folder on macOS
    "data": ("XDG_DATA_HOME", ".local/share", "Library/Application Support"),
    "cache": ("XDG_CACHE_HOME", ".cache", "Library/Caches"),
}


def user_folder(kind: Literal["data", "cache"], environ: Mapping[str, str], platform: str, home: Path | None) -> Path:
    """Return the user's folder for the program's data or cache. Nothing is created.

    On Linux and other systems, it is below ``$XDG_DATA_HOME`` or ``$XDG_CACHE_HOME``. These must be absolute, as the
    XDG base directory specification demands; otherwise ``~/.local/share`` or ``~/.cache`` is used. On macOS, it is
    below ``~/Library/Application Support`` or ``~/Library/Caches``; on Windows, below ``%LOCALAPPDATA%`` or
    ``~/AppData/Local``.

    Args:
        kind: The content of the folder.
        environ: The environment variables.
        platform: The value of ``sys.platform``.
        home: The home folder; None for the user's.
    """
    home = Path.home() if home is None else home
    variable, elsewhere, on_macos = USER_FOLDERS[kind]
    if platform == "win32":
        given = environ.get("LOCALAPPDATA", "")
        folder = Path(given) if given else home / "AppData" / "Local"
    elif platform == "darwin":
        folder = home / on_macos
    else:
        given = environ.get(variable, "")
        folder = Path(given) if given and Path(given).is_absolute() else home / elsewhere
    return folder / "sumo_adv"


def is_plain_name(name: Any) -> bool:
    """Return whether a value names an entry of a folder, and nothing elsewhere."""
    return isinstance(name, str) and name not in ("", ".", "..") and not set(name) & {"/", "\\", "\0"}


def refuse_links(folder: Path) -> None:
    """Refuse a folder of a campaign, suite or run that contains a link.

    The program reads, moves and deletes the contents of such a folder. Others may have made the folder, and a link
    would lead the program elsewhere. The folder itself may be a link of the user's. A missing folder is fine.

    Args:
        folder: The folder.

    Raises:
        UsageError: There is a link anywhere in the folder.
    """
    left = [folder]
    while left:
        try:
            with os.scandir(left.pop()) as entries:
                for entry in entries:
                    if entry.is_symlink():
                        raise UsageError(f"{entry.path} is a link, which is not followed: put a copy in its place.")
                    if entry.is_dir(follow_symlinks=False):
                        left.append(Path(entry.path))
        except (FileNotFoundError, NotADirectoryError):
            continue


_SCRATCH = re.compile(r"sumo_adv-(\d+)-(\d+)-.*")


def scratch_prefix() -> str:
    """Return the beginning of the names of this process's scratch folders, for ``tempfile``.

    ``sweep_scratch`` reads from it whether the process still runs.
    """
    return f"sumo_adv-{_process_space()}-{os.getpid()}-"


def sweep_scratch() -> None:
    """Remove this user's scratch folders whose processes no longer exist, for instance because they were killed."""
    if not hasattr(os, "getuid"):
        return
    with suppress(OSError), os.scandir(tempfile.gettempdir()) as entries:
        for entry in entries:
            named = _SCRATCH.fullmatch(entry.name)
            if named is None or int(named[1]) != _process_space() or _runs(int(named[2])):
                continue
            if entry.is_dir(follow_symlinks=False) and entry.stat(follow_symlinks=False).st_uid == os.getuid():
                shutil.rmtree(entry.path, ignore_errors=True)


def _process_space() -> int:
    """Return the number of the namespace of process ids, 0 if unknown.

    Containers that share a temporary folder have different namespaces.
    """
    try:
        return Path("/proc/self/ns/pid").stat().st_ino
    except OSError:
        return 0


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def plain_cell(value: Any) -> Any:
    """Return a cell of a table for people.

    A text that a spreadsheet would take as a formula gets an apostrophe in front.
    """
    if not isinstance(value, str) or not value.startswith(FORMULA):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value


def cell_text(cell: str) -> str:
    """Return the text that ``plain_cell`` was given, from the text of a cell."""
    return cell[1:] if cell.startswith("'") and cell[1:].startswith(FORMULA) else cell


class StorageError(SumoAdvError):
    """The disk is full, so no episode can write its results."""


def storage_error(error: OSError, place: Path) -> SumoAdvError:
    """Describe an error of the file system in a sentence about ``place``.

    Returns:
        A StorageError if the disk is full, otherwise a UsageError.
    """
    if error.errno in FULL:
        return StorageError(
            f"There is no space left to write {place}; free some and rerun the same command: finished work is kept."
        )
    return UsageError(f"The results in {place} cannot be written ({error.strerror or error}); give another --out.")


def is_storage_error(error: BaseException) -> bool:
    """Return whether an error, or its cause, comes from a disk that is full or not writable."""
    cause = error if isinstance(error, OSError) else error.__cause__
    return isinstance(cause, OSError) and cause.errno in (*FULL, *WRITE_REFUSED)


def keep_newest(folders: Iterable[Path], count: int) -> None:
    """Remove all but the ``count`` newest of a cache's folders, as far as the file system allows."""
    with suppress(OSError):
        for old in sorted(folders, key=lambda folder: folder.stat().st_mtime)[:-count]:
            shutil.rmtree(old, ignore_errors=True)


@contextmanager
def sentences(place: Path) -> Iterator[None]:
    """Raise errors of the file system as sentences about ``place``.

    Raises:
        StorageError: The disk is full.
        UsageError: ``place`` cannot be written.
        BrokenPipeError: The reader of this program's output has gone. It is raised unchanged.
    """
    try:
        yield
    except BrokenPipeError:  # the reader of our output has gone
        raise
    except OSError as error:
        raise storage_error(error, place) from error


def write_whole(target: Path, write: Callable[[Path], Any]) -> None:
    """Write a file whole or not at all.

    Args:
        target: The file. An existing file is replaced.
        write: Fills a temporary file beside ``target``, which then takes its place.

    Raises:
        OSError: The file cannot be written. Nothing half-written is left.
    """
    handle, name = tempfile.mkstemp(prefix=f".{target.stem}.", suffix=target.suffix, dir=target.parent)
    os.close(handle)
    part = Path(name)
    try:
        part.chmod(0o644)
        write(part)
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        part.replace(target)
    finally:
        with suppress(FileNotFoundError):
            part.unlink()


def write_text(target: Path, text: str) -> None:
    """Write a text file whole or not at all.

    Raises:
        OSError: The file cannot be written.
    """
    write_whole(target, lambda part: part.write_text(text, encoding="utf-8"))


def json_text(value: Any, indent: int | None = None) -> str:
    """Return JSON that any reader accepts, with a line end.

    Numbers that are not finite become null. Values of unknown types become text.
    """
    return json.dumps(_plain(value), indent=indent, ensure_ascii=False, allow_nan=False, default=str) + "\n"


def toml_text(text: str) -> str:
    """Return a text as a basic string of TOML, which is JSON's with DEL escaped as well."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_value(value: Any) -> str:
    """Return a string, truth value, number or list as TOML. A mapping becomes an inline table."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return toml_text(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{toml_text(str(k))} = {toml_value(v)}' for k, v in value.items())} }}"
    return repr(value)


def toml_lines(table: Mapping[str, Any]) -> list[str]:
    """Return the keys of a table as lines of TOML. Keys with the value None are left out.

    Args:
        table: The table. Its keys must be bare: letters, digits, ``_`` and ``-``.
    """
    return [f"{key} = {toml_value(value)}" for key, value in table.items() if value is not None]


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return value


_SUPER_JOURNAL = bytes.fromhex("d9d505f920a163d7")


def refuse_super_journal(database: Path) -> None:
    """Refuse a SQLite database whose journal names a file that SQLite would delete.

    When SQLite opens a database, it undoes the changes in a journal beside it. If the last bytes of the journal name
    the super-journal of a transaction over several databases, SQLite then deletes the file of that name, whatever it
    is. This program makes no such transaction.

    Source: "File Format For SQLite Databases", section 3; ``readSuperJournal`` and ``pager_delsuper`` in pager.c.

    Args:
        database: The database.

    Raises:
        UsageError: The journal names another file.
        OSError: The journal cannot be read.
    """
    place = database.resolve()
    journal = place.with_name(f"{place.name}-journal")
    try:
        with journal.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - len(_SUPER_JOURNAL)))
            names_another = file.read() == _SUPER_JOURNAL
    except FileNotFoundError:
        return
    if names_another:
        raise UsageError(
            f"{journal} would have SQLite delete a file elsewhere, and this program never writes such a journal: "
            "delete it."
        )


@contextmanager
def held(file: Path) -> Iterator[bool]:
    """Try to hold a file against other processes until the context, or at the latest this process, ends.

    SQLite's lock is used because every system has it. On a disk without locks, other processes are not noticed. The
    file stays behind, empty.

    Args:
        file: The file; it is made if it is missing.

    Yields:
        Whether no other process holds the file.

    Raises:
        OSError: The file cannot be made.
        UsageError: A journal beside the file is not from this program.
    """
    file.touch()
    refuse_super_journal(file)
    with closing(sqlite3.connect(file, timeout=0.0, isolation_level=None)) as lock:
        try:
            lock.execute("BEGIN EXCLUSIVE")
            alone = True
        except sqlite3.OperationalError as error:
            alone = error.sqlite_errorcode != sqlite3.SQLITE_BUSY
        yield alone
