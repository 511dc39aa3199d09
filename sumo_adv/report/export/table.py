"""One tidy CSV: a row a vehicle and step, with units in the names of its columns."""

from __future__ import annotations

import numpy as np

from sumo_adv.datatypes import Role
from sumo_adv.report.export.piece import Piece
from sumo_adv.report.tables import quoted

HEADER = (
    "time_s,vehicle,role,x_m,y_m,heading_rad,speed_m_s,acceleration_m_s2,length_m,width_m,lane,driven_by_attack,"
    "distance_to_ego_m\n"
)


def table(piece: Piece) -> str:
    """x, y are box centres; the distance is between centres, empty while the ego is not there.

    ``driven_by_attack``: 1 for an adversary after the takeover, else 0. Rows by time, then by first appearance.
    """
    ego = piece.track(piece.ego)
    rows: list[tuple[float, int, str]] = []
    for order, track in enumerate(piece.tracks):
        distance = np.hypot(
            track.x - np.interp(track.time, ego.time, ego.x), track.y - np.interp(track.time, ego.time, ego.y)
        )
        there = (track.time > ego.time[0] - piece.step / 2) & (track.time < ego.time[-1] + piece.step / 2)
        for k, time in enumerate(track.time.tolist()):
            numbers = f"{track.x[k]:.4f},{track.y[k]:.4f},{track.heading[k]:.6f},{track.speed[k]:.4f}"
            driven = track.role is Role.ADVERSARY and piece.takeover is not None and time > piece.takeover + 5e-4
            text = (
                f"{time:.2f},{quoted(track.id)},{track.role},{numbers},{track.acceleration[k]:.4f},{track.length:.2f},"
                f"{track.width:.2f},{quoted(track.lane[k])},{int(driven)},{f'{distance[k]:.4f}' if there[k] else ''}\n"
            )
            rows.append((time, order, text))
    rows.sort(key=lambda row: row[:2])
    return HEADER + "".join(row[2] for row in rows)
