"""CSV tables of states: fixed decimals, gzip without a time stamp, so that equal runs give equal bytes."""

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
"""The last column of states where roads have heights: that of the road under the vehicle [m]."""
SERIES = ("ttc", "gap", "drac", "btn", "headway", "required_lateral", "centre_distance")
SERIES_HEADER = f"time,id,{','.join(SERIES)}\n"
SERIES_CAPS = {
    "drac": LARGEST_DRAC_M_S2, "btn": LARGEST_DRAC_M_S2 / AVAILABLE_BRAKING_M_S2, "required_lateral": LARGEST_DRAC_M_S2,
}  # at contact they have none  # fmt: skip


def write_states(
    target: Path,
    snapshots: Sequence[Snapshot],
    sizes: Mapping[str, tuple[float, float]],
    roles: Mapping[str, Role],
    step_length: float,
    only: Sequence[str] | None = None,
) -> None:
    """``states.csv.gz``: a row a vehicle and step, by time, then by first appearance. Units s, m, rad, m/s, m/s2.

    The column ``z`` is there only where roads have heights.

    ``only``: the vehicles to write, all by default.
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
    """``driver.jsonl.gz``: a JSON object for each answer with which the driver showed its inside.

    Its keys are ``time`` [s], ``plan`` (points (x, y) [m]) and ``notes``. Nothing is written if there is none.
    """
    lines = [
        {"time": round(each.time, 6), "plan": [[round(x, 3), round(y, 3)] for x, y in each.plan], "notes": each.notes}
        for each in inside
    ]
    if lines:
        write_gzip(target, "".join(f"{json.dumps(line)}\n" for line in lines))


def write_signals(target: Path, snapshots: Sequence[Snapshot]) -> None:
    """``signals.csv.gz``: a row whenever a light near the ego changes, as ``simulation/signals.py`` reads it.

    Nothing is written where no light was near.
    """
    shown: dict[str, str] = {}
    rows = []
    for snapshot in snapshots:
        for name, state in snapshot.lights.items():
            if shown.get(name) != state:
                shown[name] = state
                rows.append(f"{seconds_text(snapshot.time)},{quoted(name)},{state}\n")
    if rows:
        write_gzip(target, ",".join(SIGNAL_COLUMNS) + "\n" + "".join(rows))


PLAN_HEADER = "time,x,y,heading,speed,acceleration\n"


def write_plan(target: Path, beyond: Track) -> None:
    """``plan.csv.gz``: the adversary's planned motion after the contact, a row a step; box centres, s, m, rad, m/s."""
    columns = (beyond.time, beyond.x, beyond.y, beyond.heading, beyond.speed, beyond.acceleration)
    rows = (",".join(f"{v:.6f}" for v in row) + "\n" for row in zip(*(c.tolist() for c in columns), strict=True))
    write_gzip(target, PLAN_HEADER + "".join(rows))


def series_rows(ego: Track, tracks: Sequence[Track], adversary: str) -> list[str]:
    """Rows of ``criticality.csv.gz``: the ego against others, by time, then by first appearance.

    The adversary at every step of the ego's track at which it is there, others at those at which their centre is within
    60 m.  Never is empty; what has no bound at a contact is cut as in the outcome.
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
    """A CSV field (RFC 4180)."""
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\n\r') else text


def plain_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row of a table for people, without formulas."""
    return {name: plain_cell(value) for name, value in row.items()}


def csv_text(columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """A table with a head, as CSV. Raises ValueError: a row has another column."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def write_gzip(target: Path, text: str) -> None:
    """Text as gzip, the same bytes for the same text."""
    buffer = io.BytesIO()
    with gzip.GzipFile(filename="", mode="wb", fileobj=buffer, mtime=0, compresslevel=6) as file:
        file.write(text.encode())
    target.write_bytes(buffer.getvalue())
