"""TOML, JSON and packed files from any source: plain data within limits, or an error with a reason in a few words.

Python's own parsers also take what no format allows or nothing later can hold: whole numbers of any length, NaN,
characters that end a path, tables that nest until the interpreter's stack ends; and they unpack 3 MB into 3 GB.
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

MAX_INTEGER = 2**63 - 1  # of TOML and SQLite; within any float
MAX_NESTING = 100  # tables and lists within one another
MAX_DOCUMENT_BYTES = 64 * 2**20  # of a TOML or JSON file
MAX_UNPACKED_BYTES = 512 * 2**20  # of a packed table
MAX_SUMO_FILE_BYTES = 4 * 2**30  # of a network or demand, unpacked: those of large cities have 1 GB
_UNPACKED_PART_BYTES = 2**20  # that are unpacked at a time
GZIP = b"\x1f\x8b"  # first bytes of a file packed by gzip
BAD_GZIP = (gzip.BadGzipFile, EOFError, zlib.error)


def parse_toml(text: str) -> dict[str, Any]:
    """The table of a TOML text, without the character NUL, which no path may hold. Raises ValueError."""
    return dict(_checked(tomllib.loads, text))


def parse_json(text: str) -> Any:
    """The value of a JSON text (RFC 8259: no NaN, no infinity). Raises ValueError."""
    return _checked(json.loads, text)


_CHOICES = ("literal[", "constr", "constrained", "tuple[")  # how pydantic names the choices of a union in a location


def first_fault(error: ValidationError, known: Iterable[str] = ()) -> str:
    """Return the first thing wrong with a file as the end of a sentence that begins with the file's name.

    Args:
        error: What pydantic found.
        known: The keys that the file may have, to name them beside an unknown one.
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
    """The table of the TOML file at ``path``. Raises UsageError: a sentence with ``what``, such as "The scenario"."""
    try:
        return parse_toml(read_text(path))
    except OSError as error:
        raise UsageError(f"{what} {path} cannot be read: {error.strerror or error}.") from error
    except ValueError as error:
        raise UsageError(f"{what} {path} is not valid TOML: {error}.") from error


def read_json(path: Path) -> Any:
    """The value of the JSON file at ``path``. Raises OSError; ValueError: it is no JSON, or beyond the limits."""
    return parse_json(read_text(path))


def read_object(path: Path, what: str) -> dict[str, Any]:
    """The object in the JSON file at ``path``. Raises UsageError: a sentence with ``what``, such as "The plan"."""
    try:
        value = read_json(path)
    except OSError as error:
        raise UsageError(f"{what} {path} cannot be read: {error.strerror or error}.") from error
    except ValueError as error:
        raise UsageError(f"{what} {path} is damaged ({error}): restore it from a copy.") from error
    if not isinstance(value, dict):
        raise UsageError(f"{what} {path} is damaged (it is no object): restore it from a copy.")
    return value


def read_text(path: Path, most: int = MAX_DOCUMENT_BYTES) -> str:
    """The text of a file, packed by gzip or not. Raises OSError; ValueError: it is no UTF-8, is damaged, or has
    more than ``most`` bytes."""
    return read_bytes(path, most).decode()


def read_bytes(path: Path, most: int = MAX_UNPACKED_BYTES) -> bytes:
    """What a file holds, unpacked if gzip has packed it. Raises OSError; ValueError: it is damaged, or has more than
    ``most`` bytes."""
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
