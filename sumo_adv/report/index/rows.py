"""The rows of a batch's ``results.csv``, read back with their types."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sumo_adv.errors import UsageError

RESULTS = "results.csv"
WORDS = (
    "id", "network", "ego", "intent", "ending", "failure", "level", "severity", "relation", "road", "preventable_by",
)  # fmt: skip
LATER = ("cause", "cause_sentence")  # words that tables of earlier versions lack
NUMBERS = ("seed", "raw_min_ttc", "min_ttc", "attempts", "seconds", "delta_v")
TRUTHS = ("collided", "valid", "critical")
VARIED = "set_"


@dataclass(frozen=True, slots=True)
class Table:
    """The rows in the batch's order, and the names of the settings that vary (``set_NAME``)."""

    rows: Sequence[Mapping[str, Any]]
    varied: Sequence[str] = ()


def table_of(rows: Iterable[Mapping[str, Any]]) -> Table:
    """The table of rows that were made here, not read from a file."""
    return Table([{**row, **{name: row[name] or "" for name in WORDS}} for row in rows])


def read_rows(file: Path) -> Table:
    """The table of a batch. Raises UsageError: it is no such table."""
    try:
        with file.open(newline="", encoding="utf-8") as text:
            reader = csv.DictReader(text)
            names = list(reader.fieldnames or [])
            lacking = [n for n in (*WORDS, *NUMBERS, *TRUTHS) if n not in names]
            if lacking:
                raise ValueError(f"it has no column {lacking[0]}")
            varied = tuple(n for n in names if n.startswith(VARIED))
            return Table([_row(row, varied) for row in reader], varied)
    except (OSError, ValueError, csv.Error) as error:
        raise UsageError(f"{file} is not the table of a batch ({error}); say the batch's command again.") from error


def _row(row: Mapping[str, str | None], varied: Sequence[str]) -> dict[str, Any]:
    made: dict[str, Any] = {name: row.get(name) or "" for name in (*WORDS, *LATER, *varied)}
    made |= {name: _number(row[name]) for name in NUMBERS}
    return made | {name: {"true": True, "false": False}.get(row[name] or "") for name in TRUTHS}


def _number(text: str | None) -> float | None:
    value = float(text) if text else math.nan
    return value if math.isfinite(value) else None
