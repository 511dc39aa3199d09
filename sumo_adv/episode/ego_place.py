"""Where the ego is on the lanes of its route.

On a junction SUMO takes a moved vehicle to be on whichever of the overlapping lanes fits best, and may rewrite its
route. For the ego's driver the way over a junction stays the one of the route until the ego is past the junction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np

from sumo_adv.datatypes import VehicleState
from sumo_adv.geometry import along
from sumo_adv.simulation.meetings import Link, Meetings
from sumo_adv.simulation.network import Lane, RoadMap
from sumo_adv.simulation.simulation import Simulation


@dataclass(frozen=True, slots=True)
class Place:
    """lane: the ego's; front: metres along its centreline to the front bumper; route: the edges from the present one
    on; link: on a junction, the way over it."""

    lane: Lane
    front: float
    route: tuple[str, ...]
    link: Link | None = None


class EgoPlace:
    """Finds the ego's place. State: its route, and its way over the next junction."""

    def __init__(self, road: RoadMap, meetings: Meetings, simulation: Simulation) -> None:
        self._road, self._meetings, self._simulation = road, meetings, simulation
        self._routes: dict[str, tuple[str, ...]] = {}
        self._link: Link | None = None

    def __call__(self, ego: VehicleState, *, steered: bool) -> Place | None:
        """None while the ego is off all lanes. ``steered``: its driver, not SUMO, moved it in the last step."""
        lane = self._road.lanes.get(ego.lane)
        if lane is None:
            return None
        route = self._route(ego.id, lane.edge, steered=steered)
        if not lane.internal:
            onward = self._road.onward(lane, route)
            self._link = onward[0].link if onward else None
            return Place(lane, self._front(lane, ego), route)
        here = self._meetings.link_of.get(lane.id)
        if self._link not in self._meetings.ways or (not steered and here is not None):
            self._link = here
        elif here != self._link:
            lane = min((self._road.lanes[n] for n in self._meetings.ways[self._link].via), key=partial(_distance, ego))
        return Place(lane, self._front(lane, ego), route, self._link)

    def _front(self, lane: Lane, ego: VehicleState) -> float:
        ahead = ego.length / 2
        x, y = ego.x + ahead * math.cos(ego.heading), ego.y + ahead * math.sin(ego.heading)
        return float(along(lane.shape, x, y))

    def _route(self, ego: str, edge: str, *, steered: bool) -> tuple[str, ...]:
        """The edges to come. A steered ego keeps its route: on ``edge`` it gets it back if SUMO has replaced it."""
        present, at = self._simulation.route(ego)
        kept = self._routes.setdefault(ego, present)
        if not steered or present[-1:] == kept[-1:]:
            if not steered:
                self._routes[ego] = present
            return present[max(at, 0) :]
        if edge in kept:
            self._simulation.set_route(ego, kept[kept.index(edge) :])
            return kept[kept.index(edge) :]
        return kept if self._road.lanes[self._road.edges[edge][0]].internal else present[max(at, 0) :]


def _distance(ego: VehicleState, lane: Lane) -> float:
    """Metres between the ego's centre and a lane's centreline."""
    station = float(along(lane.shape, ego.x, ego.y))
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(lane.shape, axis=0).T))])
    x, y = (np.interp(station, lengths, lane.shape[:, k]) for k in range(2))
    return float(np.hypot(x - ego.x, y - ego.y))
