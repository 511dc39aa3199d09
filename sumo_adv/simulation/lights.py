"""Which traffic lights are near a place, and what they show: recorded with a run, for its replay page."""

from __future__ import annotations

import numpy as np

from sumo_adv.simulation.network import RoadMap
from sumo_adv.simulation.simulation import Simulation

REACH = 250.0  # m: a light further away is on no picture of the encounter


class LightsNear:
    """Knows where the stop lines of a network's lights are."""

    def __init__(self, road: RoadMap) -> None:
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
        """The states of the lights with a stop line within ``REACH`` of (x, y) [m], in SUMO's letters."""
        near = np.flatnonzero(np.hypot(self._places[:, 0] - x, self._places[:, 1] - y) <= REACH)
        return {name: simulation.light(name) for name in sorted({self._names[k] for k in near})}
