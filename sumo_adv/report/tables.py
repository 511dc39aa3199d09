"""Write CSV tables with fixed decimals as gzip without a time stamp, so that equal runs give equal bytes."""

from __future__ import annotations

import csv
import gzip
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import Role, Track
from sumo_adv.drivers.protocol import DriverInside
from sumo_adv.files import plain_cell
from sumo_adv.metrics.case import THIRD_PARTY_DISTANCE_M
from sumo_adv.metrics.criticality import AVAILABLE_BRAKING_M_S2, series
from sumo_adv.metrics.verdict import LARGEST_DRAC_M_S2
from sumo_adv.simulation.signals import SIGNAL_COLUMNS
from sumo_adv.simulation.sumo_states import Snapshot
from sumo_adv.simulation.tracks import tracks_of
from sumo_adv.times import seconds_text

STATES_HEADER = "time,id,role,x,y,heading,speed,acceleration,length,width,lane\n"
HEIGHT = "z"
"""The last column of states if roads have heights: the height of the road under the vehicle [m]."""
SERIES = ("ttc", "gap", "drac", "btn", "headway", "required_lateral", "centre_distance")
SERIES_HEADER = f"time,id,{','.join(SERIES)}\n"
SERIES_CAPS = {
    "drac": LARGEST_DRAC_M_S2, "btn": LARGEST_DRAC_M_S2 / AVAILABLE_BRAKING_M_S2, "required_lateral": LARGEST_DRAC_M_S2,
}  # at contact they have no bound  # fmt: skip


def write_states(
    target: Path,
    snapshots: Sequence[Snapshot],
    sizes: Mapping[str, tuple[float, float]],
    roles: Mapping[str, Role],
    step_length: float,
    only: Sequence[str] | None = None,
) -> None:
    """Write ``states.csv.gz``: a row for each vehicle and step, by time and then by first appearance.

    Units are s, m, rad, m/s and m/s2; x and y are box centres. The column ``z`` is only written if a vehicle's height
    is not 0.

    Args:
        target: The file.
        snapshots: The states.
        sizes: Length and width of each vehicle [m].
        roles: The role of each vehicle.
        step_length: The time between snapshots [s].
        only: The vehicles to write; None writes all.
    """
    rows: list[tuple[float, int, str]] = []
    tracks = tracks_of(snapshots, sizes, roles, step_length, only)
    high = any(np.any(track.z) for track in tracks)
    for order, track in enumerate(tracks):
        name = quoted(track.id)
        numbers = np.column_stack([track.x, track.y, track.heading, track.speed, track.acceleration]).tolist()
        size = f"{track.length:.2f},{track.width:.2f}"
        heights = [f",{z:.3f}" if high else "" for z in np.broadcast_to(track.z, track.x.shape).tolist()]
        for time, (x, y, heading, speed, acceleration), lane, z in zip(
            track.time.tolist(), numbers, track.lane, heights, strict=True
        ):
            text = (
                f"{seconds_text(time)},{name},{track.role},{x + 0.0:.4f},{y + 0.0:.4f},{heading:.6f},{speed:.4f},"
                f"{acceleration + 0.0:.4f},{size},{quoted(lane)}{z}\n"
            )
            rows.append((time, order, text))
    rows.sort(key=lambda r: (r[0], r[1]))
    header = f"{STATES_HEADER.strip()},{HEIGHT}\n" if high else STATES_HEADER
    write_gzip(target, header + "".join(r[2] for r in rows))


def write_inside(target: Path, inside: Sequence[DriverInside]) -> None:
    """Write ``driver.jsonl.gz``: a JSON object for each answer with which the driver reported its plan or notes.

    Its keys are ``time`` [s], ``plan`` (points (x, y) [m]) and ``notes``. Nothing is written if there is no such
    answer.

    Args:
        target: The file.
        inside: The plans and notes.
    """
    lines = [
        {"time": round(each.time, 6), "plan": [[round(x, 3), round(y, 3)] for x, y in each.plan], "notes": each.notes}
        for each in inside
    ]
    if lines:
        write_gzip(target, "".join(f"{json.dumps(line)}\n" for line in lines))


def write_signals(target: Path, snapshots: Sequence[Snapshot]) -> None:
    """Write ``signals.csv.gz``: a row whenever a traffic light near the ego changes, or is no longer near (no state).

    ``simulation/signals.py`` reads the file. Nothing is written if no light was near.

    Args:
        target: The file.
        snapshots: The states.
    """
    shown: dict[str, str] = {}
    rows = []
    for snapshot in snapshots:
        gone = dict.fromkeys((name for name, state in shown.items() if state and name not in snapshot.lights), "")
        for name, state in {**snapshot.lights, **gone}.items():
            if shown.get(name) != state:
                shown[name] = state
                rows.append(f"{seconds_text(snapshot.time)},{quoted(name)},{state}\n")
    if rows:
        write_gzip(target, ",".join(SIGNAL_COLUMNS) + "\n" + "".join(rows))


PLAN_HEADER = "time,x,y,heading,speed,acceleration\n"


def write_plan(target: Path, beyond: Track) -> None:
    """Write ``plan.csv.gz``: the adversary's planned motion after the contact, a row for each step.

    Args:
        target: The file.
        beyond: The motion of the box's centre [s, m, rad, m/s, m/s2].
    """
    columns = (beyond.time, beyond.x, beyond.y, beyond.heading, beyond.speed, beyond.acceleration)
    rows = (",".join(f"{v:.6f}" for v in row) + "\n" for row in zip(*(c.tolist() for c in columns), strict=True))
    write_gzip(target, PLAN_HEADER + "".join(rows))


def series_rows(ego: Track, tracks: Sequence[Track], adversary: str) -> list[str]:
    """Make the rows of ``criticality.csv.gz``: the ego against other vehicles, by time and then by first appearance.

    The adversary has a row at every step at which both it and the ego exist. Other vehicles have rows while their
    centre is within 60 m of the ego's. An infinite value is an empty cell. Values without a bound at contact are
    capped, as in the outcome.

    Args:
        ego: The ego.
        tracks: All vehicles.
        adversary: The id of the adversary.

    Returns:
        The lines.
    """
    others = [t for t in tracks if t.id != ego.id]
    if not others or not len(ego.time):
        return []
    measures = series(ego, others)
    values = np.stack([np.minimum(measures[n], SERIES_CAPS.get(n, np.inf)) for n in SERIES], axis=-1)
    radius = np.where([[t.id == adversary] for t in others], np.inf, THIRD_PARTY_DISTANCE_M)
    there = np.isfinite(measures["centre_distance"]) & (measures["centre_distance"] <= radius)
    times, names = measures["time"].tolist(), [quoted(t.id) for t in others]
    rows = []
    for step, vehicle in np.argwhere(there.T).tolist():
        fields = ",".join(f"{v:.4f}" if np.isfinite(v) else "" for v in values[vehicle, step].tolist())
        rows.append(f"{seconds_text(times[step])},{names[vehicle]},{fields}\n")
    return rows


def quoted(text: str) -> str:
    """Quote a CSV field if it needs quotes (RFC 4180)."""
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\n\r') else text


def plain_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the row with cells that no spreadsheet takes for formulas."""
    return {name: plain_cell(value) for name, value in row.items()}


def csv_text(columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """Format rows as CSV with a header.

    Args:
        columns: The columns.
        rows: The rows; a missing column gives an empty cell.

    Returns:
        The text.

    Raises:
        ValueError: A row has another column.
    """
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def write_gzip(target: Path, text: str) -> None:
    """Write text as gzip; the same text gives the same bytes."""
    buffer = io.BytesIO()
    with gzip.GzipFile(filename="", mode="wb", fileobj=buffer, mtime=0, compresslevel=6) as file:
        file.write(text.encode())
    target.write_bytes(buffer.getvalue())
