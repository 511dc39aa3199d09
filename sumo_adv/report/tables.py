"""CSV tables of states: fixed decimals, gzip without a time stamp, so that equal runs give equal bytes."""

from __future__ import annotations

import gzip
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sumo_adv.datatypes import Role
from sumo_adv.world.simulation import Snapshot, tracks_of

HEADER = "time,id,role,x,y,heading,speed,acceleration,length,width,lane\n"


def write_states(
    target: Path,
    snapshots: Sequence[Snapshot],
    sizes: Mapping[str, tuple[float, float]],
    roles: Mapping[str, Role],
    step_length: float,
) -> None:
    """``states.csv.gz``: a row a vehicle and step, by time, then by first appearance. Units s, m, rad, m/s, m/s2."""
    rows: list[tuple[float, int, str]] = []
    for order, track in enumerate(tracks_of(snapshots, sizes, roles, step_length)):
        name = _quoted(track.id)
        numbers = np.column_stack([track.x, track.y, track.heading, track.speed, track.acceleration]).tolist()
        size = f"{track.length:.2f},{track.width:.2f}"
        for time, (x, y, heading, speed, acceleration), lane in zip(
            track.time.tolist(), numbers, track.lane, strict=True
        ):
            text = (
                f"{time:.2f},{name},{track.role},{x + 0.0:.4f},{y + 0.0:.4f},{heading:.6f},{speed:.4f},"
                f"{acceleration + 0.0:.4f},{size},{_quoted(lane)}\n"
            )
            rows.append((time, order, text))
    rows.sort(key=lambda r: (r[0], r[1]))
    write_gzip(target, HEADER + "".join(r[2] for r in rows))


def _quoted(text: str) -> str:
    """A CSV field (RFC 4180)."""
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\n\r') else text


def write_gzip(target: Path, text: str) -> None:
    """Text as gzip, the same bytes for the same text."""
    buffer = io.BytesIO()
    with gzip.GzipFile(filename="", mode="wb", fileobj=buffer, mtime=0, compresslevel=6) as file:
        file.write(text.encode())
    target.write_bytes(buffer.getvalue())
