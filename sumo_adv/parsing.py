"""Parse TOML, JSON and packed files from any source into plain data within limits.

Python's own parsers also accept what no format allows or later code cannot hold: whole numbers of any length, NaN,
characters that end a path, and tables that nest until the interpreter's stack ends. They unpack 3 MB into 3 GB. Errors
give the reason in a few words.
"""

from __future__ import annotations

import gzip
import io
import json
import math
import tomllib
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sumo_adv.errors import UsageError

if TYPE_CHECKING:
    from pydantic import ValidationError

MAX_INTEGER = 2**63 - 1  # largest integer of TOML and SQLite; within the range of a float
MAX_NESTING = 100  # levels of tables and lists
MAX_DOCUMENT_BYTES = 64 * 2**20  # largest TOML or JSON file
MAX_UNPACKED_BYTES = 512 * 2**20  # largest packed table, unpacked
MAX_SUMO_FILE_BYTES = 4 * 2**30  # largest network or demand, unpacked: large cities have 1 GB
_UNPACKED_PART_BYTES = 2**20  # unpacked at a time
GZIP = b"\x1f\x8b"  # first bytes of a file packed by gzip
BAD_GZIP = (gzip.BadGzipFile, EOFError, zlib.error)


def parse_toml(text: str) -> dict[str, Any]:
    """Parse a TOML text.

    Raises:
        ValueError: The text is not TOML, exceeds a limit, or contains the character NUL, which no path may hold.
    """
    return dict(_checked(tomllib.loads, text))


def parse_json(text: str) -> Any:
    """Parse a JSON text (RFC 8259: no NaN, no infinity).

    Raises:
        ValueError: The text is not JSON, or exceeds a limit.
    """
    return _checked(json.loads, text)


_CHOICES = ("literal[", "constr", "constrained", "tuple[")  # pydantic's names of a union's choices in a location


def first_fault(error: ValidationError, known: Iterable[str] = ()) -> str:
    """Describe the first fault of a file, as the end of a sentence that begins with the file's name.

    Args:
        error: The error from pydantic.
        known: The keys that the file may have. They are listed if a key is unknown.
    """
    detail = error.errors()[0]
    key = dotted(detail["loc"])
    if detail["type"] == "extra_forbidden":
        names = ", ".join(known)
        return f"has an unknown key '{key}'{f'; known keys are {names}' if names else ''}."
    if detail["type"] == "missing":
        return f"lacks the key '{key}'."
    reason = detail["msg"].removeprefix("Value error, ")
    return f"has a bad '{key}': {reason[:1].lower()}{reason[1:]}."


def dotted(location: Iterable[int | str]) -> str:
    """Return pydantic's location of a value as a key with dots."""
    return ".".join(str(part) for part in location if not (isinstance(part, str) and part.startswith(_CHOICES)))


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """Read a TOML file.

    Args:
        path: The file.
        what: The kind of file, for errors, such as "The scenario".

    Raises:
        UsageError: The file cannot be read, or is not valid TOML.
    """
    try:
        return parse_toml(read_text(path))
    except OSError as error:
        raise UsageError(f"{what} {path} cannot be read: {error.strerror or error}.") from error
    except ValueError as error:
        raise UsageError(f"{what} {path} is not valid TOML: {error}.") from error


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        OSError: The file cannot be read.
        ValueError: The file is not JSON, or exceeds a limit.
    """
    return parse_json(read_text(path))


def read_object(path: Path, what: str) -> dict[str, Any]:
    """Read the object in a JSON file.

    Args:
        path: The file.
        what: The kind of file, for errors, such as "The plan".

    Raises:
        UsageError: The file cannot be read, or holds no object.
    """
    try:
        value = read_json(path)
    except OSError as error:
        raise UsageError(f"{what} {path} cannot be read: {error.strerror or error}.") from error
    except ValueError as error:
        raise UsageError(f"{what} {path} is damaged ({error}): restore it from a copy.") from error
    if not isinstance(value, dict):
        raise UsageError(f"{what} {path} is damaged (it is not an object): restore it from a copy.")
    return value


def read_text(path: Path, most: int = MAX_DOCUMENT_BYTES) -> str:
    """Read a text file, packed by gzip or not.

    Args:
        path: The file.
        most: The largest size, unpacked [bytes].

    Raises:
        OSError: The file cannot be read.
        ValueError: The text is not UTF-8, the file is damaged, or it is larger than ``most``.
    """
    return read_bytes(path, most).decode()


def read_bytes(path: Path, most: int = MAX_UNPACKED_BYTES) -> bytes:
    """Read a file, and unpack it if gzip has packed it.

    Args:
        path: The file.
        most: The largest size, unpacked [bytes].

    Raises:
        OSError: The file cannot be read.
        ValueError: The file is damaged, or larger than ``most``.
    """
    with path.open("rb") as file:
        packed = file.read(len(GZIP)) == GZIP
        file.seek(0)
        source = gzip.GzipFile(fileobj=file) if packed else file
        whole = io.BytesIO()
        try:
            while part := source.read(_UNPACKED_PART_BYTES):
                whole.write(part)
                if whole.tell() > most:
                    raise ValueError(f"it holds more than {most // 2**20} MiB")
        except BAD_GZIP as error:
            raise ValueError("it is a damaged or truncated gzip file") from error
    return whole.getvalue()


def _checked(parse: Callable[[str], Any], text: str) -> Any:
    if len(text) > MAX_DOCUMENT_BYTES:
        raise ValueError(f"it holds more than {MAX_DOCUMENT_BYTES // 2**20} MiB")
    try:
        value = parse(text)
    except RecursionError as error:
        raise ValueError("it nests too deeply") from error
    left = [(value, 0)]
    while left:
        each, depth = left.pop()
        if depth >= MAX_NESTING and isinstance(each, dict | list):
            raise ValueError("it nests too deeply")
        if isinstance(each, dict):
            left += [(inside, depth + 1) for pair in each.items() for inside in pair]
        elif isinstance(each, list):
            left += [(inside, depth + 1) for inside in each]
        elif isinstance(each, str) and "\0" in each and parse is tomllib.loads:  # it may be a path
            raise ValueError("a text in it holds the character NUL")
        elif isinstance(each, int) and abs(each) > MAX_INTEGER:
            raise ValueError("a whole number in it has more than 64 bits")
        elif isinstance(each, float) and not math.isfinite(each) and parse is json.loads:
            raise ValueError("a number in it is not finite")
    return value
