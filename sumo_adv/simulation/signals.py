"""Recorded traffic lights: a CSV ``time,tls,state`` in SUMO's letters, packed by gzip or not.

A state holds until the light's next row; after the end of the log that it belongs to a light shows its own program.
"""

from __future__ import annotations

import csv
import gzip
import io
import math
import zlib
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from sumo_adv.errors import UsageError

COLUMNS = ("time", "tls", "state")
LETTERS = frozenset("GgYyRrsuoO")


@dataclass(frozen=True, slots=True)
class SignalLog:
    """What each light showed: times [s], rising, and the state from each on."""

    lights: Mapping[str, tuple[tuple[float, ...], tuple[str, ...]]]

    def states(self, time: float) -> dict[str, str]:
        """The state of every light with a row at or before ``time`` [s]."""
        shown = {}
        for name, (times, states) in self.lights.items():
            k = bisect_right(times, time + 1e-6)
            if k:
                shown[name] = states[k - 1]
        return shown


def read_signals(path: Path) -> SignalLog:
    """The recorded lights in ``path``.

    Raises:
        UsageError: one sentence with file and line for whatever is wrong.
    """
    try:
        data = path.read_bytes()
        text = (gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data).decode()
    except OSError as error:
        raise UsageError(f"The signals {path} cannot be read: {error.strerror or error}.") from error
    except (EOFError, zlib.error, gzip.BadGzipFile, UnicodeDecodeError) as error:
        raise UsageError(f"The signals {path} are damaged or no text: write them again.") from error
    reader = csv.reader(io.StringIO(text))
    if tuple(next(reader, [])) != COLUMNS:
        raise UsageError(f"The signals {path} begin with another header: line 1 must be '{','.join(COLUMNS)}'.")
    lights: dict[str, list[tuple[float, str]]] = {}
    for fields in reader:
        time, name, state = _row(path, reader.line_num, fields)
        lights.setdefault(name, []).append((time, state))
    for name, rows in lights.items():
        if any(b[0] <= a[0] for a, b in pairwise(rows)):
            raise UsageError(f"The signals {path} are out of order: the times of '{name}' must rise.")
    return SignalLog({name: (tuple(r[0] for r in rows), tuple(r[1] for r in rows)) for name, rows in lights.items()})


def _row(path: Path, line: int, fields: list[str]) -> tuple[float, str, str]:
    try:
        time, name, state = float(fields[0]), fields[1], fields[2]
    except (ValueError, IndexError):
        time, name, state = math.nan, "", ""
    if not math.isfinite(time) or not name or not state or not set(state) <= LETTERS:
        raise UsageError(f"The signals {path} cannot be used: line {line} is not a time, a light and its SUMO letters.")
    return time, name, state
