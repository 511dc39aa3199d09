"""The states of all vehicles of many runs as one Parquet file: a row a vehicle and step, a row group a run."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sumo_adv.files import write_whole
from sumo_adv.report.page.read import NUMBERS, columns_of
from sumo_adv.report.tables import HEADER


def write_states_parquet(target: Path, runs: Iterable[tuple[str, Path]]) -> int:
    """Write the states of runs, given by id and folder, whole or not at all; the number of rows.

    The columns are ``run`` and those of ``states.csv.gz``. A run that recorded nothing has no rows. Needs pyarrow.
    Raises UsageError: a table is damaged; OSError.
    """
    import pyarrow as pa
    from pyarrow import parquet

    names = HEADER.strip().split(",")
    kinds = {name: pa.float64() if name in NUMBERS else pa.string() for name in names}
    schema = pa.schema({"run": pa.string(), **kinds})
    rows = 0

    def write(part: Path) -> None:
        nonlocal rows
        with parquet.ParquetWriter(part, schema, compression="zstd") as writer:
            for run, folder in runs:
                columns = columns_of(folder / "states.csv.gz")
                count = len(columns["time"])
                if count:
                    values = {name: _typed(name, columns[name]) for name in names}
                    writer.write_table(pa.table({"run": [run] * count, **values}, schema))
                    rows += count

    write_whole(target, write)
    return rows


def _typed(name: str, values: tuple[str, ...]) -> list[Any]:
    return [float(value) for value in values] if name in NUMBERS else list(values)
