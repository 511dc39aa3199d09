"""Write tables as files (Markdown, CSV, JSON, and a manifest of their ingredients), and in short for the terminal."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sumo_adv.benchmark.cells import names
from sumo_adv.benchmark.columns import TABLE_COLUMNS
from sumo_adv.benchmark.nouns import Cell
from sumo_adv.benchmark.table import BenchTable, TableEntry, to_markdown
from sumo_adv.files import sentences, write_text
from sumo_adv.metrics.statistics import Estimate

TABLE_SCHEMA = 1
DIGESTED = ("case", "ego", "row", "seed", "ending", "raw", "attempts", "best", "outcome", "intents")
CSV_FIELDS = (
    "ego", "part", "row", "column", "figure", "value", "low", "high", "n", "difference", "difference_low",
    "difference_high", "p", "pairs",
)  # fmt: skip


def write_table(
    table: BenchTable, cells: Sequence[Cell], folder: Path, about: Mapping[str, Any], name: str = "table"
) -> list[Path]:
    """Write ``NAME.md``, ``.csv``, ``.json`` and ``NAME.manifest.json``.

    Args:
        table: The table.
        cells: The cells that it was made of.
        folder: The folder.
        about: What the manifest says about the table.
        name: The name of the files.

    Returns:
        The files.

    Raises:
        UsageError: The folder cannot be written.
    """
    texts = {".md": to_markdown(table), ".csv": as_csv(CSV_FIELDS, _records(table)), ".json": as_json(_document(table))}
    return write_files(folder, name, texts, cells, about)


def write_files(
    folder: Path, name: str, texts: Mapping[str, str], cells: Sequence[Cell], about: Mapping[str, Any]
) -> list[Path]:
    """Write texts and a manifest of their ingredients, each file whole or not at all.

    The manifest contains ``about`` and a digest of the cells' verdicts.

    Args:
        folder: The folder.
        name: The name of the files.
        texts: The texts, by the ending that is added to ``name``.
        cells: The cells that the texts were made of.
        about: What the manifest says: suite, versions, settings ...

    Returns:
        The files; ``NAME.manifest.json`` is the last one.

    Raises:
        UsageError: The folder cannot be written.
    """
    files = {f"{name}{ending}": text for ending, text in texts.items()}
    manifest = {
        **about, "files": list(files), "egos": names(cells, "ego"), "rows": names(cells, "row"), "cells": len(cells),
        "cells_digest": digest(cells),
    }  # fmt: skip
    files[f"{name}.manifest.json"] = as_json(manifest)
    with sentences(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for file, text in files.items():
            write_text(folder / file, text)
    return [folder / file for file in files]


def digest(cells: Iterable[Cell]) -> str:
    """Return the SHA-256 of the outcomes of cells, in any order; it is equal if only times differ."""
    kept = [{k: cell.get(k) for k in DIGESTED} for cell in cells]
    lines = sorted(json.dumps(cell, sort_keys=True, ensure_ascii=False, default=str) for cell in kept)
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def as_json(value: Any) -> str:
    """Format a value as JSON; numbers are rounded, and those that are not finite become null."""
    return json.dumps(_finite(value), indent=2, ensure_ascii=False, allow_nan=False, default=str) + "\n"


def as_csv(head: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """Format rows as CSV; numbers are rounded, and those that are not finite become empty."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, head, lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: _finite(v) for k, v in row.items()} for row in rows)
    return buffer.getvalue()


def _finite(value: Any) -> Any:
    """Round numbers to 6 decimals; those that are not finite become None."""
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return value


def _record(entry: TableEntry, figures: Mapping[str, str]) -> dict[str, Any]:
    e, d = entry.estimate, entry.difference
    return {
        "ego": entry.ego, "part": entry.part, "row": entry.row, "column": entry.column,
        "figure": figures[entry.column], "value": e.value, "low": e.low, "high": e.high, "n": e.n,
        "difference": d.difference if d else None, "difference_low": d.low if d else None,
        "difference_high": d.high if d else None, "p": d.p if d else None, "pairs": d.n if d else None,
    }  # fmt: skip


def _records(table: BenchTable) -> list[dict[str, Any]]:
    figures = {c.key: "pooled" if c.pooled else c.summary for c in TABLE_COLUMNS}
    return [_record(entry, figures) for entry in table.entries.values()]


def _document(table: BenchTable) -> dict[str, Any]:
    columns = [{"key": c.key, "title": c.title, "section": c.section, "meaning": c.meaning} for c in TABLE_COLUMNS]
    sizes = [{"ego": e, "part": p, "row": r, "cells": n} for (e, p, r), n in table.sizes.items()]
    return {
        "schema": TABLE_SCHEMA, "title": table.title, "reference": table.reference, "rows": table.rows,
        "words": dict(table.words), "notes": table.notes, "columns": columns,
        "sizes": sizes, "entries": _records(table),
    }  # fmt: skip


SCREEN_CHARACTERS = 100
NAME_CHARACTERS = 26  # a longer name has a line of its own above its figures
NO_VALUE_ON_SCREEN = "-"
MAIN = ("collision", "valid", "strict", "serious")
INTERVALS_NOTE = "Rates with Wilson's 95 % intervals."


def table_text(table: BenchTable, file: Path) -> str:
    """Format the table for the terminal: level rates, the median of attempts until the first valid one, and notes."""
    sections = []
    for ego in table.egos:
        rows = []
        for row in table.rows:
            size = table.sizes.get((ego, "all", row), 0)
            entries = [table.entry(ego, "all", row, key) for key in (*MAIN, "attempts")]
            if any(entries):
                *rates, attempts = [e.estimate if e is not None else None for e in entries]
                rows.append([row, str(size), *map(rate, rates), plain(attempts)])
        sections.append((f"Against {ego}", aligned(["row", "n", *MAIN, "attempts"], rows)))
    return on_screen(table.title, sections, ["Attempts: median until the first valid one.", *table.notes], file)


def on_screen(title: str, sections: Sequence[tuple[str, Sequence[str]]], notes: Sequence[str], file: Path) -> str:
    """Format sections for the terminal.

    Args:
        title: The title.
        sections: The heading and the aligned rows of each section.
        notes: The notes; the first one follows the note on intervals.
        file: The file with all figures.

    Returns:
        The text.
    """
    lines = [title]
    for heading, rows in sections:
        lines += ["", *([heading] if heading else []), *rows]
    lines.append("")
    for note in (f"{INTERVALS_NOTE} {notes[0]}", *notes[1:]):
        lines += textwrap.wrap(note, SCREEN_CHARACTERS, break_long_words=False)
    return "\n".join([*lines, f"All columns, groups and differences: {file}"])


def aligned(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Align rows in columns, numbers to the right. A long name has a line of its own, above its figures.

    Args:
        head: The header.
        rows: The rows.

    Returns:
        The lines.
    """
    widths = [max(len(line[k]) for line in (head, *rows)) for k in range(1, len(head))]
    first = min(max(len(line[0]) for line in (head, *rows)), NAME_CHARACTERS)
    lines = []
    for name, *figures in (head, *rows):
        if len(name) > first:
            lines.append(name)
        shown = "  ".join(f"{value:>{width}}" for value, width in zip(figures, widths, strict=True))
        lines.append(f"{name if len(name) <= first else '':{first}}  {shown}")
    return lines


def rate(estimate: Estimate | None) -> str:
    """Format a rate as ``.75 [.70,.80]``; a dash if there is none."""
    if estimate is None:
        return NO_VALUE_ON_SCREEN
    value, low, high = (_short(v) for v in (estimate.value, estimate.low, estimate.high))
    return f"{value} [{low},{high}]"


def _short(value: float) -> str:
    return f"{value:.2f}".replace("0.", ".", 1) if abs(value) < 1 else f"{value:.1f}"


def plain(estimate: Estimate | None) -> str:
    """Format a value with one decimal; a dash if there is none."""
    return NO_VALUE_ON_SCREEN if estimate is None else f"{estimate.value:.1f}"
