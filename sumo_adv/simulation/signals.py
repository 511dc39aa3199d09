"""Traffic lights: those of a log, and those near a place, which a run records for its replay page.

A log is a CSV ``time,tls,state`` in SUMO's letters, gzipped or not. A state holds until the light's next row. In what a
run records, an empty state says that the light is no longer near. After the end of the log that it belongs to, a light
shows its own program.
"""

from __future__ import annotations

import csv
import io
import math
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from sumo_adv.errors import UsageError
from sumo_adv.simulation.network import RoadMap
from sumo_adv.simulation.scan import read_sumo_text
from sumo_adv.simulation.simulation import Simulation

SIGNAL_COLUMNS = ("time", "tls", "state")
SIGNAL_LETTERS = frozenset("GgYyRrsuoO")


@dataclass(frozen=True, slots=True)
class SignalLog:
    """What each light showed.

    Attributes:
        lights: For each light, ascending times [s] and the state from each time on.
    """

    lights: Mapping[str, tuple[tuple[float, ...], tuple[str, ...]]]

    def states(self, time: float) -> dict[str, str]:
        """Return the state of every light that has a row at or before a time [s] and was near then."""
        shown = {}
        for name, (times, states) in self.lights.items():
            k = bisect_right(times, time + 1e-6)
            if k and states[k - 1]:
                shown[name] = states[k - 1]
        return shown


def read_signals(path: Path, *, with_gaps: bool = False) -> SignalLog:
    """Read recorded traffic lights.

    Args:
        path: The file.
        with_gaps: Whether states may be empty.

    Returns:
        The log.

    Raises:
        UsageError: The file is wrong or damaged. The message is one sentence with file and, for a bad row, its line.
    """
    reader = csv.reader(io.StringIO(read_sumo_text(path, "The signals")))
    if tuple(next(reader, [])) != SIGNAL_COLUMNS:
        raise UsageError(f"The signals {path} begin with another header: line 1 must be '{','.join(SIGNAL_COLUMNS)}'.")
    lights: dict[str, list[tuple[float, str]]] = {}
    for fields in reader:
        time, name, state = _row(path, reader.line_num, fields, with_gaps=with_gaps)
        lights.setdefault(name, []).append((time, state))
    for name, rows in lights.items():
        if any(b[0] <= a[0] for a, b in pairwise(rows)):
            raise UsageError(f"The signals {path} are out of order: the times of '{name}' must rise.")
    return SignalLog({name: (tuple(r[0] for r in rows), tuple(r[1] for r in rows)) for name, rows in lights.items()})


def _row(path: Path, line: int, fields: list[str], *, with_gaps: bool) -> tuple[float, str, str]:
    """Return time [s], light and state of one row."""
    try:
        time, name, state = float(fields[0]), fields[1], fields[2]
    except (ValueError, IndexError):
        time, name, state = math.nan, "", ""
    known = set(state) <= SIGNAL_LETTERS and bool(state or with_gaps)
    if not math.isfinite(time) or not name or not known:
        raise UsageError(f"The signals {path} cannot be used: line {line} is not a time, a light and its SUMO letters.")
    return time, name, state


SIGNAL_DISTANCE_M = 250.0  # a light farther away is not in the picture of the encounter


class LightsNear:
    """Finds a network's traffic lights by the places of their stop lines."""

    def __init__(self, road: RoadMap) -> None:
        """Collect the stop lines of a network."""
        lines = [
            (connection.light[0], lane.shape[-1])
            for lane in road.lanes.values()
            if not lane.internal
            for connection in lane.connections
            if connection.light[0]
        ]
        self._names = [name for name, _ in lines]
        self._places = np.array([place for _, place in lines]).reshape(-1, 2)

    def __len__(self) -> int:
        return len(self._names)

    def states(self, simulation: Simulation, x: float, y: float) -> dict[str, str]:
        """Return the states of lights near a place.

        Args:
            simulation: The simulation.
            x: The x of the place [m].
            y: The y of the place [m].

        Returns:
            The state, in SUMO's letters, of each light with a stop line within ``SIGNAL_DISTANCE_M``.
        """
        near = np.flatnonzero(np.hypot(self._places[:, 0] - x, self._places[:, 1] - y) <= SIGNAL_DISTANCE_M)
        return {name: simulation.light(name) for name in sorted({self._names[k] for k in near})}
