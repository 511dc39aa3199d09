"""Warnings of SUMO and netconvert: read from what they print, counted by kind, and said in words.

A kind is a message with its ids and numbers replaced, so that a thousand teleports are one kind. Both programs begin a
warning with ``Warning:``, and go on in lines that begin with a blank.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

WARNINGS_FILE = "warnings.txt"  # of a run's folder
MAX_SHOWN_WARNINGS = 6  # kinds that a sentence each is given
MAX_WARNING_CHARACTERS = 300  # of a warning in a sentence
_WARNING_PREFIX = "Warning: "
_VARYING_PART = re.compile(r"'[^']*'|\"[^\"]*\"|(?<![A-Za-z])[-+]?\d[\d.:,]*(?:[eE][-+]?\d+)?")


@dataclass(frozen=True, slots=True)
class WarningKind:
    """Warnings that differ in ids and numbers alone: the first of them, and how many there were."""

    first: str
    count: int


def warnings_in(printed: str) -> tuple[str, ...]:
    """The warnings in what SUMO or netconvert wrote to its error output, in order."""
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
    """A warning with the user's files instead of their copies. ``names``: the file's name by the copy's."""
    for name, shown in names.items():
        text = text.replace(name, shown)
    return text


def kinds_of(warnings: Iterable[str]) -> tuple[WarningKind, ...]:
    """The kinds of warnings, each where its first one came."""
    first: dict[str, str] = {}
    count: dict[str, int] = {}
    for text in warnings:
        kind = _VARYING_PART.sub("*", text)
        first.setdefault(kind, text)
        count[kind] = count.get(kind, 0) + 1
    return tuple(WarningKind(first[kind], count[kind]) for kind in first)


def kinds_below(folder: Path) -> tuple[WarningKind, ...]:
    """The kinds of all warnings in the runs below a folder."""
    files = sorted(folder.rglob(WARNINGS_FILE))
    return kinds_of(line for file in files for line in file.read_text(encoding="utf-8").splitlines())


def said_of(kinds: Sequence[WarningKind], program: str = "SUMO") -> tuple[str, ...]:
    """A sentence for each kind of warning: the first one, and how many there were. Nothing where there were none."""
    shown = [f"{program} warns{times(kind.count)}: {_short(kind.first)}" for kind in kinds[:MAX_SHOWN_WARNINGS]]
    more = len(kinds) - MAX_SHOWN_WARNINGS
    if more > 0:
        rest = sum(kind.count for kind in kinds[MAX_SHOWN_WARNINGS:])
        shown.append(f"{program} warns{times(rest)} of {more} further kinds.")
    return tuple(shown)


def times(count: int) -> str:
    """`` (7 times)``; nothing for once."""
    return f" ({count} times)" if count > 1 else ""


def _short(text: str) -> str:
    whole = text if len(text) <= MAX_WARNING_CHARACTERS else f"{text[:MAX_WARNING_CHARACTERS]}..."
    return whole if whole.endswith((".", "!", "?")) else f"{whole}."


def about(warnings: Iterable[str], name: str) -> str | None:
    """The warning that says why ``name`` is not in the simulation: one that names it, else one that SUMO ignores
    something. None if there is none."""
    ignoring = None
    for text in warnings:
        if f"'{name}'" in text:
            return text
        if ignoring is None and "ignoring" in text.lower():
            ignoring = text
    return ignoring
