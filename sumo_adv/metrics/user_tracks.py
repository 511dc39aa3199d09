"""A user's own tracks, from arrays or a table, as the tracks that verdicts take."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats, Role, Track
from sumo_adv.errors import UsageError
from sumo_adv.geometry import wrap_below_pi

NEEDED = ("time", "x", "y", "heading", "speed")
LENGTH, WIDTH = 4.8, 1.8  # m, where a table does not say
LEAST = 4  # states


def track_of(name: str, columns: Mapping[str, Any], role: Role) -> Track:
    """A track from columns by name: time [s] on a regular grid, x, y of the box's centre [m], heading [rad], speed
    [m/s], and if given length and width [m] and lane.

    Raises:
        UsageError: a column is missing, too short, of another length or not finite, or times are not regular.
    """
    values = {}
    for key in NEEDED:
        if key not in columns:
            raise UsageError(f"The track of {name!r} has no column '{key}': it needs {', '.join(NEEDED)}.")
        values[key] = _numbers(name, key, columns[key])
    time = values["time"]
    if len(time) < LEAST or any(len(v) != len(time) for v in values.values()):
        raise UsageError(f"The track of {name!r} needs {LEAST} states or more, and columns of one length.")
    steps = np.diff(time)
    if not (steps > 0).all() or float(np.ptp(steps)) > 1e-3:
        raise UsageError(f"The times of {name!r} must ascend in even steps: resample the track.")
    dt = float(np.mean(steps))
    length = _size(name, "length", columns, LENGTH)
    width = _size(name, "width", columns, WIDTH)
    acceleration = np.diff(values["speed"], prepend=values["speed"][:1]) / dt
    lane = tuple(str(v) for v in columns["lane"]) if "lane" in columns else ()
    heading = wrap_below_pi(values["heading"])
    return Track(
        name, role, np.round(time, 6), values["x"], values["y"], heading, values["speed"], acceleration, length, width,
        lane,
    )  # fmt: skip


def split(table: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The columns of each vehicle of a table with the column ``id``, in order of appearance. Raises UsageError."""
    if "id" not in table:
        raise UsageError("The table has no column 'id': it tells the vehicles apart.")
    names = np.array([str(v) for v in table["id"]])
    given = [key for key in (*NEEDED, "length", "width", "lane") if key in table]
    uneven = [key for key in given if np.size(table[key]) != len(names)]
    if uneven:
        raise UsageError(f"The table's column '{uneven[0]}' is not as long as its column 'id'.")
    columns_of: dict[str, dict[str, Any]] = {}
    for name in dict.fromkeys(names.tolist()):
        rows = names == name
        columns_of[name] = {key: np.asarray(table[key])[rows] for key in given}
    return columns_of


def _numbers(name: str, key: str, values: Any) -> Floats:
    try:
        numbers = np.asarray(values, dtype=np.float64).ravel()
    except (TypeError, ValueError) as error:
        raise UsageError(f"The column '{key}' of {name!r} must hold numbers ({error}).") from error
    if not np.isfinite(numbers).all():
        raise UsageError(f"The column '{key}' of {name!r} holds a number that is not finite: leave those states out.")
    return numbers


def _size(name: str, key: str, columns: Mapping[str, Any], default: float) -> float:
    if key not in columns:
        return default
    size = float(_numbers(name, key, columns[key])[0])
    if not 0.1 < size < 60.0:
        raise UsageError(f"The {key} of {name!r} is {size:g} m: give one between 0.1 and 60 m.")
    return size
