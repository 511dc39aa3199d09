"""Read the warnings of SUMO and netconvert from their output, count them by kind, and describe them.

A kind is a message with its ids and numbers replaced, so that a thousand teleports are one kind. Both programs begin a
warning with ``Warning:``, and continue it in lines that begin with a blank.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

WARNINGS_FILE = "warnings.txt"  # file in a run's folder
MAX_SHOWN_WARNINGS = 6  # maximum number of kinds with their own sentence
MAX_WARNING_CHARACTERS = 300  # maximum length of a warning in a sentence
_WARNING_PREFIX = "Warning: "
_VARYING_PART = re.compile(r"'[^']*'|\"[^\"]*\"|(?<![A-Za-z])[-+]?\d[\d.:,]*(?:[eE][-+]?\d+)?")


@dataclass(frozen=True, slots=True)
class WarningKind:
    """Warnings that differ only in ids and numbers.

    Attributes:
        first: The first of them.
        count: Their number.
    """

    first: str
    count: int


def warnings_in(printed: str) -> tuple[str, ...]:
    """Return the warnings in the error output of SUMO or netconvert, in order."""
    found: list[str] = []
    within = False
    for line in printed.splitlines():
        if line.startswith(_WARNING_PREFIX):
            found.append(line.removeprefix(_WARNING_PREFIX).strip())
            within = True
        elif within and line.startswith(" ") and line.strip():
            found[-1] += f" {line.strip()}"
        else:
            within = False
    return tuple(found)


def with_names(text: str, names: Mapping[str, str]) -> str:
    """Replace the names of copies in a warning by those of the user's files.

    Args:
        text: The warning.
        names: The file's name by the copy's name.

    Returns:
        The warning.
    """
    for name, shown in names.items():
        text = text.replace(name, shown)
    return text


def kinds_of(warnings: Iterable[str]) -> tuple[WarningKind, ...]:
    """Return the kinds of warnings, in the order of their first occurrence."""
    first: dict[str, str] = {}
    count: dict[str, int] = {}
    for text in warnings:
        kind = _VARYING_PART.sub("*", text)
        first.setdefault(kind, text)
        count[kind] = count.get(kind, 0) + 1
    return tuple(WarningKind(first[kind], count[kind]) for kind in first)


def kinds_below(folder: Path) -> tuple[WarningKind, ...]:
    """Return the kinds of all warnings in the runs below a folder."""
    files = sorted(folder.rglob(WARNINGS_FILE))
    return kinds_of(line for file in files for line in file.read_text(encoding="utf-8").splitlines())


def said_of(kinds: Sequence[WarningKind], program: str = "SUMO") -> tuple[str, ...]:
    """Return sentences that describe kinds of warnings.

    Args:
        kinds: The kinds.
        program: The program that warned.

    Returns:
        A sentence for each of the first ``MAX_SHOWN_WARNINGS`` kinds, with the first warning and the count, and one for
        the others. Empty if there are no kinds.
    """
    shown = [f"{program} warns{times(kind.count)}: {_short(kind.first)}" for kind in kinds[:MAX_SHOWN_WARNINGS]]
    more = len(kinds) - MAX_SHOWN_WARNINGS
    if more > 0:
        rest = sum(kind.count for kind in kinds[MAX_SHOWN_WARNINGS:])
        shown.append(f"{program} warns{times(rest)} of {more} further kinds.")
    return tuple(shown)


def times(count: int) -> str:
    """Return a count in brackets, such as `` (7 times)``; empty for 1."""
    return f" ({count} times)" if count > 1 else ""


def _short(text: str) -> str:
    whole = text if len(text) <= MAX_WARNING_CHARACTERS else f"{text[:MAX_WARNING_CHARACTERS]}..."
    return whole if whole.endswith((".", "!", "?")) else f"{whole}."


def about(warnings: Iterable[str], name: str) -> str | None:
    """Return the warning that explains why ``name`` is not in the simulation.

    Returns:
        The first warning that names it, otherwise the first that says that SUMO ignores something, otherwise None.
    """
    ignoring = None
    for text in warnings:
        if f"'{name}'" in text:
            return text
        if ignoring is None and "ignoring" in text.lower():
            ignoring = text
    return ignoring
