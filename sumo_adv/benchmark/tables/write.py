"""Tables as files: Markdown for people, CSV and JSON for programs, a manifest of their ingredients."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from sumo_adv.benchmark.nouns import Cell
from sumo_adv.benchmark.tables.cells import names
from sumo_adv.benchmark.tables.compute import Entry, Table
from sumo_adv.benchmark.tables.markdown import to_markdown
from sumo_adv.files import sentences, write_text

SCHEMA = 1
DIGESTED = ("case", "ego", "row", "seed", "ending", "raw", "attempts", "best", "outcome", "intents")
COLUMNS = (
    "ego", "part", "row", "column", "figure", "value", "low", "high", "n", "difference", "difference_low",
    "difference_high", "p", "pairs",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class About:
    """What the tables were made with, for the manifest. ``content``: SHA-256 over the suite's files."""

    command: str
    suite: str
    version: str
    content: str
    versions: Mapping[str, str]
    settings: Mapping[str, Any]
    seed: int
    bank_hash: str | None
    further: Mapping[str, Any] = field(default_factory=dict)


def write_table(table: Table, cells: Sequence[Cell], folder: Path, about: About, name: str = "table") -> list[Path]:
    """``NAME.md``, ``.csv``, ``.json`` and ``NAME.manifest.json`` in ``folder``, each whole or not at all.

    Raises:
        UsageError: the folder cannot be written.
    """
    texts = {f"{name}.md": to_markdown(table), f"{name}.csv": _csv(table), f"{name}.json": as_json(_document(table))}
    texts[f"{name}.manifest.json"] = as_json(manifest(about, cells, list(texts)))
    return write_texts(folder, texts)


def write_texts(folder: Path, texts: Mapping[str, str]) -> list[Path]:
    """Text files of a folder, each whole or not at all. Raises UsageError where they cannot be written."""
    with sentences(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            write_text(folder / name, text)
    return [folder / name for name in texts]


def manifest(about: About, cells: Sequence[Cell], files: Sequence[str]) -> dict[str, Any]:
    """What the tables were made of: the suite, versions, settings, and a digest of every cell's verdicts."""
    described = asdict(about)
    further = described.pop("further")
    return {
        "schema": SCHEMA, **described, **further, "files": list(files), "egos": names(cells, "ego"),
        "rows": names(cells, "row"), "cells": len(cells), "cells_digest": digest(cells),
    }  # fmt: skip


def digest(cells: Iterable[Cell]) -> str:
    """SHA-256 over the outcomes of the cells, in any order: equal where only seconds differ."""
    kept = [{k: cell.get(k) for k in DIGESTED} for cell in cells]
    lines = sorted(json.dumps(cell, sort_keys=True, ensure_ascii=False, default=str) for cell in kept)
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def as_json(value: Any) -> str:
    """JSON with null for what is not a number."""
    return json.dumps(_finite(value), indent=2, ensure_ascii=False, allow_nan=False, default=str) + "\n"


def as_csv(head: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """CSV with an empty field for what is not there."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, head, lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: _finite(v) for k, v in row.items()} for row in rows)
    return buffer.getvalue()


def _finite(value: Any) -> Any:
    """Rounded to 6 decimals; a number that is not finite becomes None."""
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return value


def _record(entry: Entry, figures: Mapping[str, str]) -> dict[str, Any]:
    e, d = entry.estimate, entry.difference
    return {
        "ego": entry.ego, "part": entry.part, "row": entry.row, "column": entry.column,
        "figure": figures[entry.column], "value": e.value, "low": e.low, "high": e.high, "n": e.n,
        "difference": d.difference if d else None, "difference_low": d.low if d else None,
        "difference_high": d.high if d else None, "p": d.p if d else None, "pairs": d.n if d else None,
    }  # fmt: skip


def _records(table: Table) -> list[dict[str, Any]]:
    figures = {c.key: "pooled" if c.pooled else c.summary for c in table.columns}
    return [_record(entry, figures) for entry in table.entries.values()]


def _csv(table: Table) -> str:
    return as_csv(COLUMNS, _records(table))


def _document(table: Table) -> dict[str, Any]:
    columns = [{"key": c.key, "title": c.title, "section": c.section, "meaning": c.meaning} for c in table.columns]
    sizes = [{"ego": e, "part": p, "row": r, "cells": n} for (e, p, r), n in table.sizes.items()]
    return {
        "schema": SCHEMA, "title": table.title, "reference": table.reference, "rows": table.rows,
        "words": dict(table.words), "notes": table.notes, "columns": columns,
        "sizes": sizes, "entries": _records(table),
    }  # fmt: skip
