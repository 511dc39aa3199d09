"""Snapshots in order, and the tracks that they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sumo_adv.datatypes import Role, Track
from sumo_adv.geometry import wrap
from sumo_adv.simulation.remote import RawState
from sumo_adv.simulation.simulation import Snapshot


class Recording:
    """Snapshots in order, turned into tracks all at once."""

    def __init__(self, step_length: float) -> None:
        self.step_length = step_length
        self.snapshots: list[Snapshot] = []

    def forget(self, keep: int) -> None:
        """Drop all but the last ``keep`` snapshots."""
        del self.snapshots[: max(0, len(self.snapshots) - keep)]

    def append(self, snapshot: Snapshot) -> None:
        """Keep one more snapshot."""
        self.snapshots.append(snapshot)

    def acceleration(self, vehicle: str) -> float:
        """The last step's change of speed over time [m/s2]; 0 for a vehicle that has just come."""
        if len(self.snapshots) < 2:
            return 0.0
        newest, before = self.snapshots[-1].raw.get(vehicle), self.snapshots[-2].raw.get(vehicle)
        return 0.0 if newest is None or before is None else (newest[3] - before[3]) / self.step_length

    def tracks(
        self, sizes: Mapping[str, tuple[float, float]], roles: Mapping[str, Role], only: Sequence[str] | None = None
    ) -> list[Track]:
        """One track a vehicle, ordered by its first appearance."""
        return tracks_of(self.snapshots, sizes, roles, self.step_length, only)


def tracks_of(
    snapshots: Sequence[Snapshot],
    sizes: Mapping[str, tuple[float, float]],
    roles: Mapping[str, Role],
    step_length: float,
    only: Sequence[str] | None = None,
) -> list[Track]:
    """Tracks from snapshots; acceleration is the difference of speeds over the step (0 at the first state)."""
    rows: dict[str, list[tuple[float, RawState]]] = {}
    names = None if only is None else set(only)
    for snapshot in snapshots:
        for name, raw in snapshot.raw.items():
            if names is None or name in names:
                rows.setdefault(name, []).append((snapshot.time, raw))
    return [_track(n, r, sizes[n], roles.get(n, Role.BACKGROUND), step_length) for n, r in rows.items()]


def _track(
    name: str, rows: list[tuple[float, RawState]], size: tuple[float, float], role: Role, step_length: float
) -> Track:
    times, states = zip(*rows, strict=True)
    *columns, lane = zip(*states, strict=True)
    time, x, y, angle_deg, speed = (np.array(c) for c in (times, *columns))
    heading = wrap(np.radians(90.0 - angle_deg))
    back = size[0] / 2
    acceleration = np.zeros(len(time))
    acceleration[1:] = np.where(np.diff(time) < 1.5 * step_length, np.diff(speed) / step_length, 0.0)
    return Track(
        name, role, time, x - back * np.cos(heading), y - back * np.sin(heading), heading, speed, acceleration,
        size[0], size[1], lane,
    )  # fmt: skip
