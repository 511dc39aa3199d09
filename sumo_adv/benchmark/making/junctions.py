"""Draws encounters at junctions: ways of two vehicles that meet, both timed to be there at about the same time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random

from sumo_adv.benchmark.making.drafts import Car, Draft, apart
from sumo_adv.benchmark.making.straight import SIZES
from sumo_adv.geometry import Path as Line
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.network import RoadMap, read_network
from sumo_adv.situation import Conflict, relate

NETWORKS = {
    "crossing_priority": ("priority_crossing", "rural_crossing", "priority_crossing", "dual_left_turn"),
    "crossing_allway": ("allway_stop",),
    "crossing_signals": ("signalised_crossing", "signalised_wide"),
    "crossing_t": ("t_junction", "t_junction_wide"),
    "crossing_roundabout": ("roundabout", "roundabout_large"),
    "crossing_merge": ("yield_merge",),
}
KINDS = tuple(NETWORKS)
GREEN = {"signalised_crossing": {"south": 36.0, "north": 36.0}, "signalised_wide": {"south": 50.0, "north": 50.0}}
"""Begin of the simulation [s] at which an approach has green, where that is not 0 (and lasts for 30 s)."""

TRAFFIC = {"no": 0, "light": 2, "medium": 5, "dense": 9}
MANOEUVRES = ("straight", "left", "straight", "right", "left", "straight", "straight")  # seven: networks take turns
SLOWEST, FASTEST = 8.0, 22.0  # m/s
MOST_ROUTE = 6  # edges
DEEPEST = 65.0  # m behind the stop line that ways may meet: a quarter of a roundabout
APPROACH = 30.0  # m before the stop line that both start at least
COMFORT = 3.0  # m/s2: SUMO inserts no vehicle nearer to a junction than it could stop at
BEFORE = 6.0  # m from a lane's begin to a front bumper at least
LATE_TRAFFIC = 9.0  # s after the begin until which others depart


@dataclass(frozen=True, slots=True)
class Approach:
    """A route from the edge of the map to its edge, from one lane; ``line``: its path from the lane's begin on;
    ``ends``: length of the first lane [m]; ``limit``: its speed [m/s]; ``yields``: whether it gives way there."""

    edges: tuple[str, ...]
    lane: int
    movement: str
    yields: bool
    line: Line
    ends: float
    limit: float


@dataclass(frozen=True, slots=True)
class Meeting:
    """Ways of the ego and of another that cross or merge."""

    ego: Approach
    bv: Approach
    conflict: Conflict


@cache
def approaches(network: str) -> tuple[Approach, ...]:
    """All routes through a shipped network of a single junction, in the order of their names."""
    road = read_network(data_folder("networks") / Path(f"{network}.net.xml"))
    routes = []
    for route in _routes(road):
        for name in road.edges[route[0]]:
            lane = road.lanes[name]
            to = [c for c in lane.connections if road.lanes[c.to].edge == route[1]]
            if not to:
                continue
            reach = sum(road.lanes[road.edges[edge][0]].length for edge in route) + 30.0
            way = road.ways(name, 0.0, reach, route)[0]
            routes.append(Approach(route, lane.index, way.movement, way.gives_way, way.path, lane.length, lane.speed))
    return tuple(routes)


def _routes(road: RoadMap) -> list[tuple[str, ...]]:
    """Routes of two edges or more from fringe to fringe, none of them twice through an edge."""
    onward = {
        edge: sorted({road.lanes[c.to].edge for name in lanes for c in road.lanes[name].connections})
        for edge, lanes in road.edges.items() if not edge.startswith(":")
    }  # fmt: skip
    reached = {to for many in onward.values() for to in many}

    def walk(route: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
        if not onward[route[-1]]:
            yield route
        for to in onward[route[-1]]:
            if to not in route and len(route) < MOST_ROUTE:
                yield from walk((*route, to))

    return [route for edge in sorted(onward) if edge not in reached for route in walk((edge,)) if len(route) > 1]


@cache
def meetings(network: str) -> tuple[Meeting, ...]:
    """All pairs of routes from different edges that meet."""
    pairs = []
    for ego in approaches(network):
        for bv in approaches(network):
            if bv.edges[0] == ego.edges[0]:
                continue
            conflict = relate(bv.line, bv.movement, bv.ends, bv.yields, ego.line).conflict
            if conflict is not None and all(
                -1.0 < station - way.ends < DEEPEST for way, station in ((ego, conflict.ego_s), (bv, conflict.bv_s))
            ):
                pairs.append(Meeting(ego, bv, conflict))
    return tuple(pairs)


def draw_junction(kind: str, number: int, draw: Random) -> Draft:
    """One encounter of a kind; ``number`` (from 0) decides network, manoeuvre, right of way and traffic."""
    networks = NETWORKS[kind]
    network = networks[number % len(networks)]
    word = tuple(TRAFFIC)[(number + number // 4 + 1) % len(TRAFFIC)]
    meeting = draw.choice(_wanted(meetings(network), number))
    trigger = draw.choice((4.0, 4.5, 5.0, 5.5, 6.0))
    ego, bv = _timed(meeting, trigger, draw)
    others = _traffic(network, meeting, ego, bv, TRAFFIC[word], draw)
    way = meeting.ego
    words = (
        f"the ego on {' '.join(way.edges)} of {network} ({way.movement}, lane {way.lane}) at {ego.speed:g} m/s, "
        f"{word} other traffic."
    )
    begin = GREEN.get(network, {}).get(way.edges[0].removesuffix("_in"), 0.0)
    return Draft(kind, network, ego, bv, others, trigger, words, begin)


def _wanted(meetings: Sequence[Meeting], number: int) -> Sequence[Meeting]:
    """Those with the manoeuvre and (two of three) the right of way that is next, as far as there are any."""
    manoeuvre, yields = MANOEUVRES[number % len(MANOEUVRES)], number % 3 == 2
    by_movement = [m for m in meetings if m.ego.movement == manoeuvre] or list(meetings)
    return [m for m in by_movement if m.ego.yields == yields] or by_movement


def _timed(meeting: Meeting, trigger: float, draw: Random) -> tuple[Car, Car]:
    """Both vehicles, so placed that they would be at the conflict at about the same time at constant speeds."""
    ego_time = draw.uniform(3.8, 6.5)
    bv_time = ego_time + draw.uniform(-1.5, 0.8)
    cars = []
    for way, station, time, sizes in (
        (meeting.ego, meeting.conflict.ego_s, ego_time, SIZES[:3]),
        (meeting.bv, meeting.conflict.bv_s, bv_time, SIZES),
    ):
        fastest = min(0.98 * way.limit, FASTEST, (station - BEFORE) / (time + trigger))
        slowest = max(SLOWEST, 0.6 * fastest, (station - way.ends + APPROACH) / (time + trigger))
        speed = draw.uniform(min(slowest, fastest), fastest)
        place = min(station - speed * (time + trigger), way.ends - APPROACH)
        cars.append(Car(way.edges, way.lane, place, speed, 0.0, draw.choice(sizes)).rounded())
    return cars[0], cars[1]


def _traffic(network: str, meeting: Meeting, ego: Car, bv: Car, count: int, draw: Random) -> tuple[Car, ...]:
    """Others on any route through the junction, half of them on the road from the first, half of them to come."""
    placed: list[Car] = []
    ways = approaches(network)
    for _ in range(count * 12):
        if len(placed) == count:
            break
        way = draw.choice(ways)
        speed = draw.uniform(0.7, 0.98) * min(way.limit, FASTEST)
        later = draw.random() < 0.5
        place = BEFORE if later else draw.uniform(BEFORE, way.ends - max(APPROACH, speed**2 / (2 * COMFORT)))
        depart = draw.uniform(1.5, LATE_TRAFFIC) if later else 0.0
        car = Car(way.edges, way.lane, place, speed, depart, draw.choice(SIZES)).rounded()
        if later or apart(car, (ego, bv, *placed)):
            placed.append(car)
    return tuple(placed)
