"""SUMO's floating car data: where each vehicle's front bumper is, step by step, as ``sumo --fcd-output`` writes it."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from xml.sax.saxutils import quoteattr

import numpy as np

from sumo_adv.datatypes import Track
from sumo_adv.report.export.piece import Piece
from sumo_adv.simulation.network import Lane, RoadMap, read_network
from sumo_adv.simulation.simulation import angle_deg_of

HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n<fcd-export>\n'


@dataclass(frozen=True, slots=True)
class Row:
    """A vehicle at a time [s]: front bumper x, y [m], SUMO's angle [deg], speed [m/s], lane and place on it [m]."""

    time: float
    id: str
    kind: str
    x: float
    y: float
    angle: float
    speed: float
    acceleration: float
    lane: str
    position: float

    def text(self) -> str:
        """The ``vehicle`` element."""
        return (
            f'        <vehicle id={quoteattr(self.id)} x="{self.x:.4f}" y="{self.y:.4f}" angle="{self.angle:.4f}" '
            f'type={quoteattr(self.kind)} speed="{self.speed:.4f}" pos="{self.position:.4f}" '
            f'lane={quoteattr(self.lane)} slope="0.00" acceleration="{self.acceleration:.4f}"/>\n'
        )


def fcd(piece: Piece) -> str:
    """The piece as FCD. ``lane`` is empty and ``pos`` 0 off the road. Raises UsageError: the network is unreadable."""
    road = read_network(piece.network)
    rows = (
        row for track in piece.tracks for row in track_rows(track, road, lambda track, k, road: _lane(track, k, road))
    )
    return fcd_text(rows, piece)


def _lane(track: Track, k: int, road: RoadMap) -> Lane | None:
    return road.lanes.get(track.lane[k])


def track_rows(track: Track, road: RoadMap, lane_of: Callable[[Track, int, RoadMap], Lane | None]) -> Iterator[Row]:
    """A row a state; ``lane_of`` says on which lane SUMO has it."""
    kind = type_name(track)
    for k in range(len(track.time)):
        x, y = front(track, k)
        lane = lane_of(track, k, road)
        yield Row(
            float(track.time[k]), track.id, kind, x, y, angle_deg_of(float(track.heading[k])), float(track.speed[k]),
            float(track.acceleration[k]), lane.id if lane else "", place_on(lane, x, y) if lane else 0.0,
        )  # fmt: skip


def fcd_text(rows: Iterator[Row] | Sequence[Row], piece: Piece) -> str:
    """Rows by time; a step without vehicles has none."""
    steps: dict[int, list[Row]] = defaultdict(list)
    for row in rows:
        steps[round(row.time / piece.step)].append(row)
    parts = [HEAD]
    for step in sorted(steps):
        parts.append(f'    <timestep time="{steps[step][0].time:.2f}">\n')
        parts += [row.text() for row in steps[step]]
        parts.append("    </timestep>\n")
    parts.append("</fcd-export>\n")
    return "".join(parts)


def front(track: Track, k: int) -> tuple[float, float]:
    """The middle of the front bumper [m]: SUMO's reference point."""
    ahead, heading = track.length / 2, float(track.heading[k])
    return float(track.x[k]) + ahead * math.cos(heading), float(track.y[k]) + ahead * math.sin(heading)


def type_name(track: Track) -> str:
    """A vehicle type for each role and size."""
    return f"{track.role}_{track.length:.2f}x{track.width:.2f}"


def place_on(lane: Lane, x: float, y: float) -> float:
    """How far along a lane a point is, in SUMO's length of the lane [m], which may differ from its line's."""
    a, along = lane.shape[:-1], np.diff(lane.shape, axis=0)
    length = np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)
    t = np.clip(((x - a[:, 0]) * along[:, 0] + (y - a[:, 1]) * along[:, 1]) / length**2, 0.0, 1.0)
    away = np.hypot(a[:, 0] + t * along[:, 0] - x, a[:, 1] + t * along[:, 1] - y)
    i = int(np.argmin(away))
    return float(length[:i].sum() + t[i] * length[i]) * lane.length / float(length.sum())
