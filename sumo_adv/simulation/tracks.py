"""Recorded tracks: the motion of vehicles, pedestrians, cyclists and others on one even time grid.

The file is a CSV, gzipped or not, with the header ``time,id,kind,valid,x,y,heading,speed,length,width`` and a row for
each object and step. Units: time of the simulation [s]; x and y of the box centre [m]; heading [rad]; speed [m/s]. A
step without a row, or with ``valid`` 0 (its numbers may be empty), says nothing of the object: the object may appear
late, disappear early and be unseen in between. Sizes vary in recordings. An object has one size here, the median of its
valid rows.
"""

from __future__ import annotations

import csv
import gzip
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sumo_adv.consistency import GivenMotion, even_grid, find_fault, off_grid, steps_over
from sumo_adv.datatypes import Bools, Floats, Role, Track
from sumo_adv.errors import UsageError
from sumo_adv.geometry import wrap_below_pi
from sumo_adv.simulation.scan import read_sumo_text
from sumo_adv.simulation.sumo_states import RawState, Snapshot, headings_of
from sumo_adv.times import seconds_text

TRACK_COLUMNS = ("time", "id", "kind", "valid", "x", "y", "heading", "speed", "length", "width")
OBJECT_KINDS = ("vehicle", "pedestrian", "cyclist", "other")
TRACK_TIME_TOLERANCE_S = 2e-3  # maximum distance of a row's time from the grid
MAX_TRACK_STEPS = 1_000_000

Row = tuple[float, float, float, float, float, float, int]  # x, y, heading, speed, length, width, line


@dataclass(frozen=True, slots=True)
class LoggedTrack:
    """One object over the whole grid of its log.

    Arrays have shape ``(n,)``. Where ``valid`` is False, the other values mean nothing.

    Attributes:
        id: The id of the object.
        kind: Its kind (``OBJECT_KINDS``).
        valid: Whether its state is known.
        x: x of the box centre [m].
        y: y of the box centre [m].
        heading: Heading [rad].
        speed: Speed along the heading [m/s].
        length: Length [m].
        width: Width [m].
    """

    id: str
    kind: str
    valid: Bools
    x: Floats
    y: Floats
    heading: Floats
    speed: Floats
    length: float
    width: float

    def motion(self, time: Floats) -> GivenMotion:
        """Return the valid states for a consistency check.

        Args:
            time: The grid of the log, ``(n,)`` [s].

        Returns:
            The states.
        """
        v = self.valid
        return GivenMotion(
            self.id, self.kind, time[v], self.x[v], self.y[v], self.heading[v], self.speed[v], self.length, self.width
        )

    def spans(self) -> tuple[tuple[int, int], ...]:
        """Return the first and last index of every stretch of valid states."""
        edges = np.flatnonzero(np.diff(np.concatenate([[False], self.valid, [False]]).astype(np.int8)))
        return tuple((int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True))


@dataclass(frozen=True, slots=True)
class TrackLog:
    """All objects of a log.

    Attributes:
        time: The evenly spaced grid, ``(n,)`` [s].
        tracks: The tracks by id.
    """

    time: Floats
    tracks: Mapping[str, LoggedTrack]

    @property
    def end(self) -> float:
        """The last time of the grid [s]."""
        return float(self.time[-1])

    def first(self, name: str) -> float:
        """Return when an object is first seen [s]."""
        return float(self.time[self.tracks[name].spans()[0][0]])

    def resampled(self, begin: float, step: float) -> TrackLog:
        """Return the log on another grid, by linear interpolation.

        Headings turn the shorter way. A state is valid if those on both sides are valid.

        Args:
            begin: The beginning of the grid [s].
            step: Its step [s].

        Returns:
            The log from ``begin`` up to its end.
        """
        count = int((self.end - begin) / step + 1e-6) + 1
        time = np.asarray(begin + step * np.arange(max(count, 1)), float)
        even = self.time[1] - self.time[0] if len(self.time) > 1 else step
        u = (time - self.time[0]) / even
        nearest = np.rint(u)
        u = np.where(np.abs(u - nearest) * even < TRACK_TIME_TOLERANCE_S, nearest, u)
        inside = (u >= 0) & (u <= len(self.time) - 1)
        low = np.clip(np.floor(u), 0, len(self.time) - 1).astype(np.intp)
        high = np.clip(np.ceil(u), 0, len(self.time) - 1).astype(np.intp)
        share = u - low
        return TrackLog(time, {n: _between(t, low, high, share, inside) for n, t in self.tracks.items()})

    def track(self, name: str, role: Role = Role.BACKGROUND) -> Track:
        """Return the valid steps of an object as a track.

        Args:
            name: The id of the object.
            role: The role of the track.

        Returns:
            The track. It has gaps in time where the object was not seen, and its accelerations are 0.
        """
        t = self.tracks[name]
        keep = t.valid
        time = self.time[keep]
        return Track(
            name, role, time, t.x[keep], t.y[keep], t.heading[keep], t.speed[keep], np.zeros(len(time)), t.length,
            t.width,
        )  # fmt: skip


def _between(t: LoggedTrack, low: Floats, high: Floats, share: Floats, inside: Bools) -> LoggedTrack:
    """Return a track interpolated between its samples ``low`` and ``high``."""

    def linear(values: Floats) -> Floats:
        return np.asarray(np.where(share == 0.0, values[low], values[low] * (1 - share) + values[high] * share))

    turn = wrap_below_pi(t.heading[high] - t.heading[low])
    heading = np.where(share == 0.0, t.heading[low], t.heading[low] + share * turn)
    valid = t.valid[low] & t.valid[high] & inside
    return replace(t, valid=valid, x=linear(t.x), y=linear(t.y), heading=heading, speed=linear(t.speed))


# -- reading --------------------------------------------------------------------------------------------------------


def read_tracks(path: Path) -> TrackLog:
    """Read a log.

    Args:
        path: The file.

    Returns:
        The log.

    Raises:
        UsageError: The file is unreadable, has another header, lacks a number, has two rows for one object and time, is
            not on an even grid, has no valid row, or contains impossible motion (``consistency.py``). The message is
            one sentence with file and, for a bad row, its line.
    """
    kinds: dict[str, str] = {}
    rows: dict[str, dict[float, Row]] = {}
    times: set[float] = set()
    for line, fields in _lines(path):
        time, name, kind, row = _row(path, line, fields)
        if kinds.setdefault(name, kind) != kind:
            raise _wrong(path, line, f"calls '{name}' a {kind}, which was a {kinds[name]} before")
        times.add(time)
        if row is not None and rows.setdefault(name, {}).setdefault(time, row) is not row:
            raise _wrong(path, line, f"is the second for '{name}' at {time:g} s")
    if not rows:
        raise UsageError(f"The tracks {path} hold no valid row; give a log with at least one.")
    grid = _grid(path, times)
    log = TrackLog(grid, {name: _logged(name, kinds[name], seen, grid) for name, seen in rows.items()})
    if fault := find_fault([t.motion(grid) for t in log.tracks.values()], noisy=True):
        time = round(fault.time, 6)
        near = min(rows[fault.motion.name].items(), key=lambda row: abs(row[0] - time))
        raise _wrong(path, near[1][-1], f"{fault.says} (at {near[0]:g} s)")
    return log


def _lines(path: Path) -> Iterable[tuple[int, list[str]]]:
    """Yield line numbers and fields of the rows under the header."""
    reader = csv.reader(io.StringIO(read_sumo_text(path, "The tracks")))
    try:
        header = next(reader, [])
        if tuple(header) != TRACK_COLUMNS:
            raise UsageError(
                f"The tracks {path} begin with another header: line 1 must be '{','.join(TRACK_COLUMNS)}'."
            )
        for fields in reader:
            yield reader.line_num, fields
    except csv.Error as error:
        raise _wrong(path, reader.line_num, f"is not CSV ({error})") from error


def _row(path: Path, line: int, fields: list[str]) -> tuple[float, str, str, Row | None]:
    """Return time, id and kind of one row and, if it is valid, its numbers."""
    if len(fields) != len(TRACK_COLUMNS):
        raise _wrong(path, line, f"has {len(fields)} fields, not {len(TRACK_COLUMNS)}")
    _, name, kind, valid, *numbers = fields
    if not name or kind not in OBJECT_KINDS or valid not in ("0", "1"):
        column = "id" if not name else "kind" if kind not in OBJECT_KINDS else "valid"
        rule = {"id": "one", "kind": f"one of {', '.join(OBJECT_KINDS)}", "valid": "0 or 1"}[column]
        raise _wrong(path, line, f"has no usable {column}, which must be {rule}")
    time = round(_number(path, line, "time", fields[0]), 6)
    if valid == "0":
        return time, name, kind, None
    x, y, heading, speed, length, width = (
        _number(path, line, c, n) for c, n in zip(TRACK_COLUMNS[4:], numbers, strict=True)
    )
    if length <= 0 or width <= 0:
        raise _wrong(path, line, f"gives '{name}' a size of {length:g} by {width:g} m")
    return time, name, kind, (x, y, heading, speed, length, width, line)


def _number(path: Path, line: int, column: str, text: str) -> float:
    """Return a field as a finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise _wrong(path, line, f"has '{text}' for {column}, which is not a finite number")
    return value


def _wrong(path: Path, line: int, what: str) -> UsageError:
    """Return the error for a row."""
    return UsageError(f"The tracks {path} cannot be used: line {line} {what}.")


def _grid(path: Path, times: set[float]) -> Floats:
    """Return the even grid that holds all times; its step is the smallest difference between two of them."""
    grid = np.array(sorted(times))
    if len(grid) == 1:
        return grid
    step = float(np.diff(grid).min())
    if steps_over(grid) > MAX_TRACK_STEPS:
        raise UsageError(f"The tracks {path} span too much time for their step of {step:g} s; write an even grid.")
    if (worst := off_grid(grid)) is not None:
        raise UsageError(
            f"The tracks {path} are not on an even time grid: {grid[worst]:g} s is off the step of {step:g} s."
        )
    return even_grid(grid)[0]


def _logged(name: str, kind: str, seen: Mapping[float, Row], grid: Floats) -> LoggedTrack:
    """Return the rows of one object as a track on the grid."""
    step = grid[1] - grid[0] if len(grid) > 1 else 1.0
    at = np.rint((np.array(list(seen)) - grid[0]) / step).astype(np.intp)
    values = np.array(list(seen.values()))
    valid = np.zeros(len(grid), bool)
    valid[at] = True
    columns = np.zeros((4, len(grid)))
    columns[:, at] = values[:, :4].T
    x, y, heading, speed = columns
    length, width = (float(np.median(values[:, k])) for k in (4, 5))
    return LoggedTrack(name, kind, valid, x, y, heading, speed, length, width)


# -- writing --------------------------------------------------------------------------------------------------------


def write_tracks(path: Path, log: TrackLog) -> None:
    """Write a log as a file that :func:`read_tracks` reads.

    Only valid steps are written. Times have as many decimals as they need. Equal logs give equal bytes.

    Args:
        path: The file; it is gzipped if its name ends in .gz.
        log: The log.
    """
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    out.writerow(TRACK_COLUMNS)
    for k, time in enumerate(log.time.tolist()):
        for t in log.tracks.values():
            if t.valid[k]:
                row = [seconds_text(time), t.id, t.kind, "1", f"{t.x[k]:.4f}", f"{t.y[k]:.4f}", f"{t.heading[k]:.6f}"]
                out.writerow([*row, f"{t.speed[k]:.4f}", f"{t.length:.3f}", f"{t.width:.3f}"])
    data = text.getvalue().encode()
    path.write_bytes(gzip.compress(data, mtime=0) if path.name.endswith(".gz") else data)


# -- recorded by this program ---------------------------------------------------------------------------------------


class Recording:
    """The snapshots of a simulation, in order.

    Attributes:
        step_length: The step length [s].
        snapshots: The snapshots.
    """

    def __init__(self, step_length: float) -> None:
        """Start without snapshots."""
        self.step_length = step_length
        self.snapshots: list[Snapshot] = []

    def forget(self, keep: int) -> None:
        """Drop all but the newest ``keep`` snapshots."""
        del self.snapshots[: max(0, len(self.snapshots) - keep)]

    def append(self, snapshot: Snapshot) -> None:
        """Add the newest snapshot."""
        self.snapshots.append(snapshot)

    @property
    def before(self) -> Snapshot | None:
        """The snapshot before the newest one; None if there is none."""
        return self.snapshots[-2] if len(self.snapshots) > 1 else None

    def acceleration(self, vehicle: str) -> float:
        """Return a vehicle's acceleration over the last step [m/s2]; 0 if the vehicle has just appeared."""
        return acceleration(vehicle, self.snapshots[-1], self.before, self.step_length) if self.snapshots else 0.0


def acceleration(vehicle: str, newest: Snapshot, before: Snapshot | None, step_length: float) -> float:
    """Return the change of a vehicle's speed over a step [m/s2].

    Args:
        vehicle: The id of the vehicle.
        newest: The later snapshot.
        before: The earlier snapshot.
        step_length: The step length [s].

    Returns:
        The acceleration [m/s2]; 0 if the vehicle is not in both snapshots.
    """
    if before is None:
        return 0.0
    now, then = newest.raw.get(vehicle), before.raw.get(vehicle)
    return 0.0 if now is None or then is None else (now[3] - then[3]) / step_length


def tracks_of(
    snapshots: Sequence[Snapshot], sizes: Mapping[str, tuple[float, float]], roles: Mapping[str, Role],
    step_length: float, only: Sequence[str] | None = None,
) -> list[Track]:  # fmt: skip
    """Return the motion in snapshots as tracks.

    The acceleration is the change of speed over the step. It is 0 at the first state and after a gap.

    Args:
        snapshots: The snapshots, in order.
        sizes: Length and width by id [m].
        roles: The roles by id; all others are background vehicles.
        step_length: The step length [s].
        only: The ids to include; None includes all.

    Returns:
        One track for each vehicle, ordered by first appearance.
    """
    rows: dict[str, list[tuple[float, RawState]]] = {}
    heights: dict[str, list[float]] = {}
    names = None if only is None else set(only)
    for snapshot in snapshots:
        for name, raw in snapshot.raw.items():
            if names is None or name in names:
                rows.setdefault(name, []).append((snapshot.time, raw))
                if snapshot.heights:
                    heights.setdefault(name, []).append(snapshot.heights[name])
    tracks = (_track(n, r, sizes[n], roles.get(n, Role.BACKGROUND), step_length) for n, r in rows.items())
    return [replace(t, z=np.array(heights[t.id])) if t.id in heights else t for t in tracks]


def _track(
    name: str, rows: list[tuple[float, RawState]], size: tuple[float, float], role: Role, step_length: float
) -> Track:
    """Return the states of one vehicle as a track of box centres."""
    times, states = zip(*rows, strict=True)
    *columns, lane = zip(*states, strict=True)
    time, x, y, angle_deg, speed = (np.array(c) for c in (times, *columns))
    heading = headings_of(angle_deg)
    back = size[0] / 2
    acceleration = np.zeros(len(time))
    acceleration[1:] = np.where(np.diff(time) < 1.5 * step_length, np.diff(speed) / step_length, 0.0)
    return Track(
        name, role, time, x - back * np.cos(heading), y - back * np.sin(heading), heading, speed, acceleration,
        size[0], size[1], lane,
    )  # fmt: skip
