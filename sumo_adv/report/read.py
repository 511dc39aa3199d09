"""Read a run's folder: its outcome, its manifest, and the tracks of its attempts."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import Role, Track
from sumo_adv.drivers.protocol import DriverInside
from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.files import json_text, refuse_links, sentences, write_text, write_whole
from sumo_adv.outcome_schema import check_schema, migrated
from sumo_adv.parsing import MAX_UNPACKED_BYTES, read_json, read_text
from sumo_adv.report.folder import FIRST, INSIDE, SIGNALS
from sumo_adv.report.outcome import ATTACKS
from sumo_adv.report.tables import HEIGHT, STATES_HEADER
from sumo_adv.simulation.signals import SignalLog, read_signals

OUTCOME_FILE, MANIFEST_FILE = "outcome.json", "manifest.json"
MAX_TABLE_ROWS = 4_000_000  # 1,000 vehicles over 400 s
TRACK_COLUMNS = ("time", "x", "y", "heading", "speed", "acceleration", "length", "width")


@dataclass(frozen=True, slots=True)
class RunRead:
    """A run, as its files record it.

    Attributes:
        folder: The run's folder.
        outcome: The content of ``outcome.json``.
        manifest: The content of ``manifest.json``; empty if there is none.
        best: The attempt that counts from the start of its simulation on, or the unattacked run if there was no
            attempt.
        raw: The unattacked run.
        first: Ego and adversaries of the first attempt, if it is not the one that counts.
        attacks: The index and the tracks of each further attempt that succeeded with an attack of another kind.
        lights: The states of traffic lights near the ego in the attempt that counts.
        inside: Plans and notes of the ego's driver in the attempt that counts.
    """

    folder: Path
    outcome: Mapping[str, Any]
    manifest: Mapping[str, Any]
    best: Sequence[Track]
    raw: Sequence[Track]
    first: Sequence[Track]
    attacks: Sequence[tuple[int, Sequence[Track]]] = ()
    lights: SignalLog = SignalLog({})  # noqa: RUF009 - frozen
    inside: Sequence[DriverInside] = ()


def read_run(folder: Path) -> RunRead:
    """Read all that a page shows of a run.

    Args:
        folder: The run's folder.

    Returns:
        The run. Tracks are empty if the run has no file for them.

    Raises:
        UsageError: The folder holds no run, or a file is damaged.
    """
    outcome = read_outcome(folder)
    manifest = _json(folder / MANIFEST_FILE) if (folder / MANIFEST_FILE).is_file() else {}
    best, raw, first = (_tracks(folder / name) for name in ("states.csv.gz", "raw.csv.gz", FIRST))
    lights = read_signals(folder / SIGNALS, with_gaps=True) if (folder / SIGNALS).is_file() else SignalLog({})
    inside = read_inside(folder / INSIDE) if (folder / INSIDE).is_file() else []
    return RunRead(folder, outcome, manifest, best, raw, first, _attacks(folder, outcome), lights, inside)


def read_inside(file: Path) -> list[DriverInside]:
    """Read the plans and notes of the ego's driver.

    Args:
        file: The run's ``driver.jsonl.gz``.

    Returns:
        The plans and notes, one entry for each recorded answer.

    Raises:
        UsageError: The file is damaged.
    """
    try:
        lines = [json.loads(line) for line in read_text(file).splitlines()]
        return [
            DriverInside(
                float(line["time"]), tuple((float(x), float(y)) for x, y in line["plan"]),
                {str(name): float(value) for name, value in line["notes"].items()},
            )
            for line in lines
        ]  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise damaged(file, error) from error


def read_outcome(folder: Path) -> dict[str, Any]:
    """Read the ``outcome.json`` of a run.

    Args:
        folder: The run's folder.

    Returns:
        The content.

    Raises:
        UsageError: The folder holds no run, the file is damaged, or it has schema 1.
    """
    refuse_links(folder)
    if not (folder / OUTCOME_FILE).is_file():
        raise UsageError(f"{folder} holds no {OUTCOME_FILE}; give the folder of a run.")
    document = _json(folder / OUTCOME_FILE)
    check_schema(document, folder / OUTCOME_FILE)
    return document


def bring_up_to_date(folder: Path) -> None:
    """Rewrite a run's ``outcome.json`` of schema 1, and those of its further attacks, as schema 2.

    Args:
        folder: The run's folder.

    Raises:
        UsageError: The file is damaged, so old that it has no levels, or cannot be written.
    """
    refuse_links(folder)
    for file in (folder / OUTCOME_FILE, *sorted(folder.glob(f"{ATTACKS}/*/{OUTCOME_FILE}"))):
        document = _json(file)
        if document.get("schema") == 1:
            with sentences(file):
                write_text(file, json_text(migrated(document, file), 2))


def _attacks(folder: Path, outcome: Mapping[str, Any]) -> list[tuple[int, list[Track]]]:
    """Read the tracks of the further attacks, with the index of each attempt."""
    try:
        others = [int(s["attempt"]) for s in outcome.get("successes") or () if s["folder"] is not None]
    except (KeyError, TypeError, ValueError) as error:
        raise damaged(folder / OUTCOME_FILE, error) from error
    return [(k, _tracks(folder / ATTACKS / str(k + 1) / "states.csv.gz")) for k in others]


def _json(file: Path) -> dict[str, Any]:
    try:
        value = read_json(file)
    except (OSError, ValueError) as error:
        raise damaged(file, error) from error
    if not isinstance(value, dict):
        raise damaged(file, "not an object")
    return value


def damaged(file: Path, error: Exception | str) -> UsageError:
    """Return the error that says that a file cannot be used."""
    return UsageError(f"{file} is damaged ({error}); rerun it, or restore the file from a copy.")


@contextmanager
def reading(folder: Path) -> Iterator[None]:
    """Turn unexpected errors while a run's files are used into a UsageError that names the folder.

    The files hold hundreds of values that other programs and people may have changed.

    Args:
        folder: The run's folder.

    Raises:
        UsageError: The code inside raised an error other than ``SumoAdvError``, OSError or MemoryError.
    """
    try:
        yield
    except (SumoAdvError, OSError, MemoryError):
        raise
    except Exception as error:
        message = f"{type(error).__name__}: {error}"[:200].replace("\n", " ")
        raise UsageError(f"The run in {folder} is not as this program writes it ({message}); rerun it.") from error


def columns_of(file: Path, expected: str = STATES_HEADER) -> dict[str, tuple[str, ...]]:
    """Read the columns of a table as text.

    Args:
        file: The table.
        expected: The header that the table must have. A last column with heights may follow.

    Returns:
        The columns by name; empty columns if there is no such file.

    Raises:
        UsageError: The file is damaged.
    """
    names = expected.strip().split(",")
    if not file.is_file():
        return dict.fromkeys(names, ())
    try:
        table = csv.reader(io.StringIO(read_text(file, MAX_UNPACKED_BYTES), newline=""))
        header, *rows = islice(table, MAX_TABLE_ROWS)
        if next(table, None) is not None:
            raise ValueError(f"it has more than {MAX_TABLE_ROWS:,} rows")
        if header not in (names, [*names, HEIGHT]):
            raise ValueError("its columns are others")
        return dict(zip(header, zip(*rows, strict=True), strict=True)) if rows else dict.fromkeys(header, ())
    except (OSError, ValueError, csv.Error) as error:
        raise damaged(file, error) from error


def _tracks(file: Path) -> list[Track]:
    """Read tracks in the order of first appearance; return none if there is no such file."""
    columns = columns_of(file)
    places: dict[str, list[int]] = {}
    for place, name in enumerate(columns["id"]):
        places.setdefault(name, []).append(place)
    try:
        high = [HEIGHT] if HEIGHT in columns else []
        values = {name: np.array(columns[name], dtype=np.float64) for name in (*TRACK_COLUMNS, *high)}
        if not all(np.isfinite(v).all() for v in values.values()):
            raise ValueError("a number is not finite")
        tracks = []
        for name, of in places.items():
            time, x, y, heading, speed, acceleration = (values[n][of] for n in TRACK_COLUMNS[:6])
            length, width = (float(values[n][of[0]]) for n in TRACK_COLUMNS[6:])
            role, lane = Role(columns["role"][of[0]]), tuple(columns["lane"][i] for i in of)
            z = values[HEIGHT][of] if high else 0.0
            tracks.append(Track(name, role, time, x, y, heading, speed, acceleration, length, width, lane, z))
        return tracks
    except ValueError as error:
        raise damaged(file, error) from error


def write_states_parquet(target: Path, runs: Iterable[tuple[str, Path]]) -> None:
    """Write the states of runs as one Parquet file, whole or not at all.

    The columns are ``run``, those of ``states.csv.gz``, and ``z``, which is 0 in a flat network. This needs pyarrow.

    Args:
        target: The file.
        runs: The id and the folder of each run.

    Raises:
        UsageError: A table is damaged.
        OSError: The file cannot be written.
    """
    import pyarrow as pa
    from pyarrow import parquet

    names, numbers = [*STATES_HEADER.strip().split(","), HEIGHT], (*TRACK_COLUMNS, HEIGHT)
    kinds = {name: pa.float64() if name in numbers else pa.string() for name in names}
    schema = pa.schema({"run": pa.string(), **kinds})

    def write(part: Path) -> None:
        with parquet.ParquetWriter(part, schema, compression="zstd") as writer:
            for run, folder in runs:
                columns = columns_of(folder / "states.csv.gz")
                if columns["time"]:
                    columns.setdefault(HEIGHT, ("0",) * len(columns["time"]))
                    values = {n: [float(v) for v in columns[n]] if n in numbers else list(columns[n]) for n in names}
                    writer.write_table(pa.table({"run": [run] * len(columns["time"]), **values}, schema))

    write_whole(target, write)
