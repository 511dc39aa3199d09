"""TOML and JSON from any source: plain data, or ValueError with a reason in a few words.

Python's own parsers also take what no format allows or nothing later can hold: whole numbers of any length, NaN,
characters that end a path, tables that nest until the interpreter's stack ends.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sumo_adv.errors import UsageError

LARGEST_WHOLE = 2**63 - 1  # of TOML and SQLite; within any float


def parse_toml(text: str) -> dict[str, Any]:
    """The table of a TOML text, without the character NUL, which no path may hold. Raises ValueError."""
    return dict(_checked(tomllib.loads, text))


def parse_json(text: str) -> Any:
    """The value of a JSON text (RFC 8259: no NaN, no infinity). Raises ValueError."""
    return _checked(json.loads, text)


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """The table of the TOML file at ``path``. Raises UsageError: a sentence with ``what``, such as "The scenario"."""
    try:
        return parse_toml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"{what} {path} cannot be read: {error.strerror or error}.") from error
    except ValueError as error:
        raise UsageError(f"{what} {path} is not valid TOML: {error}.") from error


def _checked(parse: Callable[[str], Any], text: str) -> Any:
    try:
        value = parse(text)
    except RecursionError as error:
        raise ValueError("it nests too deeply") from error
    left = [value]
    while left:
        each = left.pop()
        if isinstance(each, dict):
            left += [*each.keys(), *each.values()]
        elif isinstance(each, list):
            left += each
        elif isinstance(each, str) and "\0" in each and parse is tomllib.loads:  # it may be a path
            raise ValueError("a text in it holds the character NUL")
        elif isinstance(each, int) and abs(each) > LARGEST_WHOLE:
            raise ValueError("a whole number in it has more than 64 bits")
        elif isinstance(each, float) and not math.isfinite(each) and parse is json.loads:
            raise ValueError("a number in it is not finite")
    return value
