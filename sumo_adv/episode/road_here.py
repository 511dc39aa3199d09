"""What an ego's driver that plans for itself is told of the road at the ego."""

from __future__ import annotations

from sumo_adv.datatypes import VehicleState
from sumo_adv.drivers import Road
from sumo_adv.simulation.network import RoadMap
from sumo_adv.simulation.simulation import Simulation

SLOW, AT_LINE = 1.0, 10.0  # m/s, m: slower and nearer to its lane's end, the ego is told whether it may go:
# SUMO's advice is given to one who creeps as it was asked to, and so would have it creep on
LEAVING = 0.3  # s before its front is at its route's end, the ego is told that it leaves


class RoadHere:
    """Makes ``Road`` for one simulation; the last one serves while the ego is off all lanes."""

    def __init__(self, road: RoadMap, simulation: Simulation) -> None:
        self._map, self._simulation = road, simulation
        self._last: Road | None = None
        self._sides: dict[str, tuple[float, ...]] = {}
        self._routes: dict[str, tuple[str, ...]] = {}

    def __call__(self, ego: VehicleState, drove: bool) -> Road | None:
        """``drove``: the ego moved itself in the last step, so that SUMO's advice means something."""
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
        """The edges that the ego had when it was first asked about: moveToXY gives it others where lanes overlap in a
        junction; on ``edge`` it gets its own back."""
        now = self._simulation.route(ego)[0]
        kept = self._routes.setdefault(ego, now)
        if now[-1:] != kept[-1:] and edge in kept:
            self._simulation.set_route(ego, kept[kept.index(edge) :])
        return kept
