"""The road at the ego, for drivers that plan for themselves."""

from __future__ import annotations

from sumo_adv.datatypes import VehicleState
from sumo_adv.drivers import Road
from sumo_adv.simulation.network import RoadMap
from sumo_adv.simulation.simulation import Simulation

SLOW, AT_LINE = 1.0, 10.0  # m/s, m: a slower ego nearer to the end of its lane gets no advised speed, but whether it
# is held. SUMO's advice is at most the speed that the ego was given, so a creeping ego would creep on.
LEAVING = 0.3  # s before its front bumper reaches the end of its route the ego leaves


class RoadHere:
    """Makes ``Road`` for one simulation. While the ego is off all lanes the last one is returned."""

    def __init__(self, road: RoadMap, simulation: Simulation) -> None:
        self._map, self._simulation = road, simulation
        self._last: Road | None = None
        self._sides: dict[str, tuple[float, ...]] = {}
        self._routes: dict[str, tuple[str, ...]] = {}

    def __call__(self, ego: VehicleState, drove: bool) -> Road | None:
        """``drove``: the ego's driver steered in the last step; only then does SUMO's advice apply."""
        lane = self._map.lanes.get(ego.lane)
        if lane is None:
            return self._last
        simulation = self._simulation
        if lane.id not in self._sides:
            beside = self._map.side_offsets(lane.id, ego.x, ego.y, ego.heading)
            self._sides[lane.id] = tuple(offset for offset, way in beside if way == "same")
        left = lane.length - simulation.lane_position(ego.id)
        at_line = ego.speed < SLOW and left < AT_LINE and not lane.internal
        route = self._kept_route(ego.id, lane.edge)
        leaves = left < LEAVING * ego.speed + 0.5 and route[-1:] == (lane.edge,)
        self._last = Road(
            limit=simulation.limit(ego.id),
            sides=self._sides[lane.id],
            until=left + ego.length / 2,
            width=lane.width,
            advised=simulation.advised(ego.id) if drove and not at_line else None,
            held=at_line and not simulation.may_go(ego.id),
            leaves=leaves,
        )
        return self._last

    def _kept_route(self, ego: str, edge: str) -> tuple[str, ...]:
        """The ego's first route. On ``edge`` the ego gets it back if SUMO has replaced it.

        SUMO's moveToXY replaces a route where lanes overlap on a junction.
        """
        present = self._simulation.route(ego)[0]
        kept = self._routes.setdefault(ego, present)
        if present[-1:] != kept[-1:] and edge in kept:
            self._simulation.set_route(ego, kept[kept.index(edge) :])
        return kept
