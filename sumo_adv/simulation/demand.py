"""Generate seeded traffic for a network that has none: passenger cars on quickest routes from fringe to fringe.

Origins and destinations are fringe edges: nothing leads into an origin, and nothing leads out of a destination. They
are drawn in proportion to the number of lanes. Departures are a jittered regular stream. The same arguments give the
same bytes. If these routes cover less than half of the network (such as a closed test track), routes between inner
edges are added.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

from sumo_adv.errors import UsageError

FREE_DEPARTURES_PER_MIN = 10.0  # departures per minute and origin lane if no route yields: a third of a lane's capacity
YIELDING_DEPARTURES_PER_MIN = 4.0  # the same if some route must yield or stop at lights
MAX_DEFAULT_DEPARTURES_PER_MIN = 30.0  # departures per minute over the whole network
INNER_DEPARTURES_PER_MIN = 12.0  # departures per minute over a network without a fringe
MIN_INNER_ROUTE_LENGTH_M = 150.0  # minimum length of a route between inner edges
# Minimum length of an edge on which a vehicle can start; shorter fringe edges are stumps of a cut map.
MIN_ORIGIN_LENGTH_M = 8.0
MIN_FRINGE_SHARE = 0.5  # inner routes are added if fringe routes cover a smaller share of the network's length
MAX_PAIR_TRIES = 400
DEMAND_PART_S = 120.0  # traffic is drawn in parts of this length, so that a later end does not change earlier traffic

_HEADER = """<?xml version="1.0" encoding="UTF-8"?>

<routes>
    <vType id="bv" vClass="passenger" carFollowModel="Krauss" sigma="0.5" speedDev="0" length="4.8" width="1.8"/>
"""


@dataclass(frozen=True, slots=True)
class Journey:
    """One route.

    Attributes:
        edges: The edge ids from first to last.
        lanes: The number of passenger lanes on the first edge, which is its weight when routes are drawn.
        yields: Whether it must give way or obey lights somewhere.
        fringe: Whether it enters from outside the network.
    """

    edges: tuple[str, ...]
    lanes: int
    yields: bool
    fringe: bool


def generate_demand(
    network: Path, target: Path, *, seed: int, density: float | None = None, begin: float = 0.0, end: float
) -> Path:
    """Write random traffic for a network.

    The vehicles are called ``bv0``, ``bv1`` and so on.

    Args:
        network: The network file.
        target: The route file to write.
        seed: The seed of the random draws.
        density: Departures per minute over the whole network; None means ``default_density``.
        begin: The time of the first departures [s].
        end: The time before which all vehicles depart [s].

    Returns:
        The path ``target``.

    Raises:
        UsageError: No route exists, the density is not a positive number, or the end is not after the beginning.
    """
    if end <= begin:
        raise UsageError(f"Traffic cannot be generated from {begin:g} to {end:g} s: the end must be later.")
    draw = random.Random(seed)
    routes, density = _routes_and_density(network, draw, density)
    lines, weights = [_HEADER], [journey.lanes for journey in routes]
    drawn = list[tuple[float, Journey]]()
    for part in range(math.ceil((end - begin) / DEMAND_PART_S)):
        first = begin + part * DEMAND_PART_S
        departs = _departures(draw, density, first, min(first + DEMAND_PART_S, end))
        drawn += [(depart, draw.choices(routes, weights=weights)[0]) for depart in departs]
    for number, (depart, journey) in enumerate(drawn):
        lines.append(
            f'    <vehicle id="bv{number}" type="bv" depart="{depart:.2f}" departLane="best" departPos="base" '
            f'departSpeed="max"><route edges={quoteattr(" ".join(journey.edges))}/></vehicle>\n'
        )
    unfinished = target.with_name(f"{target.name}.part")
    unfinished.write_text("".join([*lines, "</routes>\n"]), encoding="utf-8", newline="\n")
    return unfinished.replace(target)


def generate_flows(network: Path, target: Path, *, density: float | None = None, end: float) -> Path:
    """Write random traffic for a network that varies with SUMO's seed.

    Departures are a Poisson process on each route. The standard deviation of desired speeds is 10 %.

    Args:
        network: The network file.
        target: The route file to write.
        density: Departures per minute over the whole network; None means ``default_density``.
        end: The time until which vehicles depart, from 0 [s].

    Returns:
        The path ``target``.

    Raises:
        UsageError: No route exists, or the density is not a positive number.
    """
    routes, per_minute = _routes_and_density(network, random.Random(0), density)
    lanes = sum(journey.lanes for journey in routes)
    lines = [_HEADER.replace('speedDev="0"', 'speedDev="0.1"')]
    for number, journey in enumerate(routes):
        every = per_minute * journey.lanes / lanes / 60.0
        lines.append(
            f'    <flow id="bv{number}" type="bv" begin="0" end="{end:g}" period="exp({every:.6g})" '
            f'departLane="random" departPos="base" departSpeed="max">'
            f"<route edges={quoteattr(' '.join(journey.edges))}/></flow>\n"
        )
    target.write_text("".join([*lines, "</routes>\n"]), encoding="utf-8", newline="\n")
    return target


def _routes_and_density(network: Path, draw: random.Random, density: float | None) -> tuple[list[Journey], float]:
    """Return the routes and the departures per minute, checked."""
    if density is not None and not 0.0 < density < float("inf"):
        raise UsageError(f"A density of {density:g} departures per minute cannot be used: give a positive number.")
    routes = journeys(network, draw)
    return routes, default_density(routes) if density is None else density


def default_density(found: list[Journey]) -> float:
    """Return a density that gives lively but free traffic.

    It is proportional to the number of lanes on which vehicles enter.

    Args:
        found: The routes of the network.

    Returns:
        Departures per minute over the whole network.
    """
    lanes = {journey.edges[0]: journey.lanes for journey in found if journey.fringe}
    share = YIELDING_DEPARTURES_PER_MIN if any(journey.yields for journey in found) else FREE_DEPARTURES_PER_MIN
    return min(share * sum(lanes.values()), MAX_DEFAULT_DEPARTURES_PER_MIN) or INNER_DEPARTURES_PER_MIN


def journeys(network: Path, draw: random.Random) -> list[Journey]:
    """Return quickest routes from fringe to fringe.

    Routes between inner edges are added if the fringe routes cover too little. In a big network, pairs of edges are
    sampled.

    Args:
        network: The network file.
        draw: The random generator.

    Returns:
        The routes.

    Raises:
        UsageError: There is no route, or the network file lacks data.
    """
    import sumolib

    try:
        net = sumolib.net.readNet(str(network))
    except (KeyError, ValueError) as error:
        raise UsageError(f"The network {network} lacks what traffic is made from ({error}): rebuild it.") from error
    edges = sorted((edge for edge in net.getEdges() if edge.allows("passenger")), key=lambda edge: str(edge.getID()))
    origins = [edge for edge in edges if not _passable(edge.getIncoming())]
    origins = [edge for edge in origins if edge.getLength() >= MIN_ORIGIN_LENGTH_M] or origins
    destinations = [edge for edge in edges if not _passable(edge.getOutgoing())]
    routes = _routes(net, _pairs(origins, destinations, draw), fringe=True)
    covered = {edge for journey in routes for edge in journey.edges}
    length = sum(edge.getLength() for edge in edges)
    if sum(edge.getLength() for edge in edges if edge.getID() in covered) < MIN_FRINGE_SHARE * length or not routes:
        routes += _routes(net, _pairs(edges, edges, draw), fringe=False)
    if not routes:
        raise UsageError(f"No route leads through the network {network}: give a demand of your own.")
    return routes


def _passable(neighbours: Any) -> list[Any]:
    """Return an edge's neighbours that cars can reach without a u-turn, from sumolib's dict of connections."""
    return [
        edge
        for edge, connections in neighbours.items()
        if edge.allows("passenger") and any(not _turns_round(connection) for connection in connections)
    ]


def _turns_round(connection: Any) -> bool:
    """Return whether a connection of sumolib is a u-turn: ``t``, or ``T`` in left-hand traffic."""
    return str(connection.getDirection()).lower() == "t"


def _pairs(origins: list[Any], destinations: list[Any], draw: random.Random) -> list[tuple[Any, Any]]:
    """Return all pairs of different edges, or a seeded sample if there are more than MAX_PAIR_TRIES."""
    if len(origins) * len(destinations) <= MAX_PAIR_TRIES:
        return [(a, b) for a in origins for b in destinations if a is not b or not _passable(a.getOutgoing())]
    drawn = [(draw.choice(origins), draw.choice(destinations)) for _ in range(MAX_PAIR_TRIES)]
    return [(a, b) for a, b in drawn if a is not b]


def _routes(net: Any, pairs: list[tuple[Any, Any]], *, fringe: bool) -> list[Journey]:
    """Return the quickest route of each pair, unless there is none, it is too short, or it contains a u-turn."""
    routes = []
    for origin, destination in pairs:
        route, _ = net.getFastestPath(origin, destination, vClass="passenger")
        if route is None or (not fringe and sum(edge.getLength() for edge in route) < MIN_INNER_ROUTE_LENGTH_M):
            continue
        if any(_turns_round(link) for a, b in pairwise(route) for link in a.getConnections(b)):
            continue
        lanes = sum(lane.allows("passenger") for lane in route[0].getLanes())
        yields = any(link.getState() != "M" for a, b in pairwise(route) for link in a.getConnections(b))
        routes.append(Journey(tuple(str(edge.getID()) for edge in route), lanes, yields, fringe))
    return routes


def _departures(draw: random.Random, density: float, begin: float, end: float) -> list[float]:
    """Return ordered times in [begin, end) [s] at ``density`` per minute, each moved by up to one headway."""
    headway = 60.0 / density
    times: list[float] = []
    slot = begin
    while slot < end:
        times.append(min(slot + draw.random() * headway, end - 0.01))
        slot += headway
    return times
