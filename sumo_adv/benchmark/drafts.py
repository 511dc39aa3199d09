"""Draw encounters on the shipped networks, on straight roads and at junctions, and write the two files of each.

The files do not reveal which vehicle is meant as the adversary, or for what: ids are numbers in the order of departure
and position.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from random import Random

from sumo_adv.geometry import Path as Line
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.network import RoadMap, read_network
from sumo_adv.situation import PathConflict, relate

EGO_ID = "ego"
SCENARIO_HORIZON_S = 10.0
ALLOWED_SIMULATION_S = 60.0  # simulation time that a scenario allows
CAR_SIZE_M = (4.8, 1.8)  # length, width

_TYPE = (
    '    <vType id="{id}" vClass="passenger" carFollowModel="Krauss" sigma="0.5" tau="1" speedDev="0" '
    'maxSpeed="{speed:g}" length="{length:g}" width="{width:g}" lcKeepRight="0" lcSpeedGain="0"/>\n'
)
_VEHICLE = (
    '    <vehicle id="{id}" type="{type}" depart="{depart:g}" departLane="{lane}" departPos="{place:g}" '
    'departSpeed="{speed:g}">\n        <route edges="{edges}"/>\n    </vehicle>\n'
)


@dataclass(frozen=True, slots=True)
class Car:
    """A vehicle at its departure.

    Attributes:
        edges: The edges of its route.
        lane: The index of the lane on the first edge.
        place: The position of the front bumper on that lane [m].
        speed: The speed at departure, which is also the maximum speed [m/s].
        depart: The departure after the scenario's begin [s].
        size: Length and width [m].
    """

    edges: tuple[str, ...]
    lane: int
    place: float
    speed: float
    depart: float = 0.0
    size: tuple[float, float] = CAR_SIZE_M

    def rounded(self) -> Car:
        """Return the vehicle with position, speed and departure rounded to one decimal."""
        return replace(self, place=round(self.place, 1), speed=round(self.speed, 1), depart=round(self.depart, 1))


@dataclass(frozen=True, slots=True)
class EncounterDraft:
    """An encounter that was drawn.

    Attributes:
        kind: The kind of encounter.
        network: The name of the shipped network.
        ego: The ego.
        bv: The vehicle that is meant to be the adversary.
        others: The other vehicles.
        trigger: The trigger after ``begin`` [s].
        words: The encounter in words.
        begin: The begin of the simulation [s].
    """

    kind: str
    network: str
    ego: Car
    bv: Car
    others: tuple[Car, ...]
    trigger: float
    words: str
    begin: float = 0.0

    def named(self) -> dict[str, Car]:
        """Return all vehicles by id, in the order that SUMO needs; ``self.bv`` is among them."""
        cars = sorted((self.bv, *self.others), key=lambda c: (c.depart, c.edges, c.lane, c.place))
        return {EGO_ID: self.ego, **{f"v{k}": car for k, car in enumerate(cars, 1)}}

    def bv_id(self) -> str:
        """Return the id of the vehicle that is meant to be the adversary."""
        return next(name for name, car in self.named().items() if car is self.bv)


def write_draft(draft: EncounterDraft, name: str, folder: Path) -> Path:
    """Write ``<name>.toml`` and ``demand/<name>.rou.xml``.

    Args:
        draft: The encounter.
        name: The name.
        folder: The folder, which must hold ``networks``.

    Returns:
        The scenario file.
    """
    demand = folder / "demand" / f"{name}.rou.xml"
    _write(demand, _demand(draft))
    scenario = folder / f"{name}.toml"
    _write(scenario, _scenario(draft, name))
    return scenario


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8", newline="\n")


def _scenario(draft: EncounterDraft, name: str) -> str:
    return f"""# {name}: {draft.words}
schema = 1
network = "networks/{draft.network}.net.xml"

[demand]
files = ["demand/{name}.rou.xml"]
begin = {draft.begin:.1f}
end = {draft.begin + ALLOWED_SIMULATION_S:.1f}

[ego]
id = "{EGO_ID}"

[window]
trigger = {draft.begin + draft.trigger:.1f}
horizon = {SCENARIO_HORIZON_S:.1f}
"""


def _demand(draft: EncounterDraft) -> str:
    cars = draft.named()
    types = {_type_id(car): car for car in cars.values()}
    lines = ['<?xml version="1.0" encoding="UTF-8"?>\n\n<routes>\n']
    for name, car in sorted(types.items()):
        lines.append(_TYPE.format(id=name, speed=car.speed, length=car.size[0], width=car.size[1]))
    for name, car in cars.items():
        lines.append(
            _VEHICLE.format(
                id=name, type=_type_id(car), depart=draft.begin + car.depart, lane=car.lane, place=car.place,
                speed=car.speed, edges=" ".join(car.edges),
            )
        )  # fmt: skip
    return "".join([*lines, "</routes>\n"])


def _type_id(car: Car) -> str:
    return f"car_{car.speed:g}_{car.size[0]:g}".replace(".", "p")


def keep_apart(car: Car, others: Sequence[Car]) -> bool:
    """Check whether a vehicle has room in its lane at its departure.

    The room is what SUMO needs to insert the vehicle, and a little more.

    Args:
        car: The vehicle.
        others: The vehicles that are there.

    Returns:
        Whether there is room.
    """
    for neighbour in others:
        if neighbour.edges[0] != car.edges[0] or neighbour.lane != car.lane or neighbour.depart != car.depart:
            continue
        behind = car if car.place < neighbour.place else neighbour
        if abs(car.place - neighbour.place) < 1.15 * behind.speed + 9.0:
            return False
    return True


# -- straight roads: the ego keeps its lane; a vehicle is ahead, beside, behind or oncoming


STRAIGHT_KINDS = ("leader", "neighbour_ahead", "neighbour_behind", "oncoming", "follower")
TRAFFIC_COUNTS = {"no": 0, "light": 3, "medium": 7, "dense": 12}
"""The number of other vehicles for each word."""

TRAFFIC_SIZES_M = ((4.8, 1.8), (4.4, 1.8), (5.0, 1.9), (6.0, 2.1))  # the last one is a van
EGO_ROAD_AFTER_TRIGGER_S = 16.0  # the ego must have road for this long after the trigger
CLEAR_RADIUS_M = 24.0  # only the intended vehicle drives beside the ego within this distance


@dataclass(frozen=True, slots=True)
class DraftRoad:
    """A straight or curved road.

    Attributes:
        network: The name of the network.
        edge: The edge of the ego.
        back: The edge in the opposite direction; '' if there is none.
        lanes: The number of lanes in each direction.
        length: The length [m].
        slowest: The minimum speed of the ego [m/s].
        fastest: The maximum speed [m/s].
    """

    network: str
    edge: str
    back: str
    lanes: int
    length: float
    slowest: float
    fastest: float


ROADS = {
    road.network: road
    for road in (
        DraftRoad("straight_2lane", "eastbound", "", 2, 900.0, 8.0, 16.5),
        DraftRoad("straight_3lane", "eastbound", "", 3, 1200.0, 10.0, 21.8),
        DraftRoad("straight_4lane", "eastbound", "", 4, 1300.0, 14.0, 24.8),
        DraftRoad("motorway", "eastbound", "", 3, 2030.0, 18.0, 25.0),
        DraftRoad("two_way", "eastbound", "westbound", 1, 1000.0, 8.0, 21.0),
        DraftRoad("two_way_4lane", "eastbound", "westbound", 2, 1500.0, 8.0, 21.8),
        DraftRoad("curved_road", "eastbound", "westbound", 1, 946.0, 8.0, 16.5),
        DraftRoad("curved_4lane", "eastbound", "westbound", 2, 1209.0, 8.0, 19.2),
    )
}
MULTI_LANE_NETWORKS = (
    "straight_3lane",
    "two_way_4lane",
    "motorway",
    "straight_2lane",
    "curved_4lane",
    "straight_4lane",
)
TWO_WAY_NETWORKS = ("two_way", "curved_road", "two_way_4lane", "curved_4lane")


def draw_straight(kind: str, number: int, draw: Random) -> EncounterDraft:
    """Draw one encounter on a straight or curved road.

    Args:
        kind: One of ``STRAIGHT_KINDS``.
        number: The number of the encounter within its kind, from 0. It decides network, lane and traffic.
        draw: The random generator.

    Returns:
        The encounter.
    """
    networks = TWO_WAY_NETWORKS if kind == "oncoming" else MULTI_LANE_NETWORKS
    road = ROADS[networks[number % len(networks)]]
    lane = (number + number // len(networks)) % road.lanes
    word = tuple(TRAFFIC_COUNTS)[(number + number // 4) % len(TRAFFIC_COUNTS)]
    trigger = draw.choice((4.0, 4.5, 5.0, 5.5, 6.0, 7.0))
    speed = draw.uniform(road.slowest, road.fastest)
    room = road.length - speed * (trigger + EGO_ROAD_AFTER_TRIGGER_S)
    ego = Car(
        (road.edge,), lane, draw.uniform(0.35, 0.85) * min(room, 320.0), speed, 0.0, draw.choice(TRAFFIC_SIZES_M[:3])
    )
    ego = ego.rounded()
    bv = _other(kind, road, ego, trigger, draw).rounded()
    others = _traffic(road, ego, bv, TRAFFIC_COUNTS[word], draw)
    words = f"the ego in lane {lane} of {road.lanes} of {road.network} at {ego.speed:g} m/s, {word} other traffic."
    return EncounterDraft(kind, road.network, ego, bv, others, trigger, words)


def _other(kind: str, road: DraftRoad, ego: Car, trigger: float, draw: Random) -> Car:
    """Draw the vehicle that is meant: its position at the trigger, moved back to the departure."""
    size, v = draw.choice(TRAFFIC_SIZES_M), ego.speed
    if kind == "oncoming":
        own = min(max(v + draw.uniform(-3.0, 3.0), road.slowest), road.fastest)
        apart_then = (v + own) * draw.uniform(3.2, 6.5)
        place = ego.place + apart_then + (v + own) * trigger
        lane = draw.randrange(road.lanes) if ego.lane else road.lanes - 1  # two lanes in between are too many
        return Car((road.back,), lane, road.length - place, own, 0.0, size)
    if kind in ("leader", "follower"):
        gap = v * draw.uniform(1.2, 2.0) + 9.0
        faster = draw.uniform(-0.4, 0.8) if kind == "leader" else draw.uniform(-0.8, 0.3)
        lane, then = ego.lane, gap if kind == "leader" else -gap
    else:
        ahead = kind == "neighbour_ahead"
        then = draw.uniform(5.0, 28.0) if ahead else draw.uniform(-26.0, -4.0)
        faster = draw.uniform(-2.5, 1.2) if ahead else draw.uniform(-1.0, 2.5)
        lane = draw.choice([beside for beside in (ego.lane - 1, ego.lane + 1) if 0 <= beside < road.lanes])
    own = min(max(v + faster, road.slowest - 1.0), road.fastest)
    return Car((road.edge,), lane, ego.place + then - (own - v) * trigger, own, 0.0, size)


def _traffic(road: DraftRoad, ego: Car, bv: Car, count: int, draw: Random) -> tuple[Car, ...]:
    """Draw other vehicles, with room around the ego; those that find no place are left out."""
    placed: list[Car] = []
    for _ in range(count * 12):
        if len(placed) == count:
            break
        towards = bool(road.back) and draw.random() < 0.45
        speed = min(max(ego.speed + draw.uniform(-1.5, 1.5), road.slowest - 1.0), road.fastest)
        place = ego.place + draw.uniform(-150.0, 220.0)
        if towards:
            place = road.length - (ego.place + draw.uniform(60.0, 600.0))
        car = Car((road.back if towards else road.edge,), draw.randrange(road.lanes), place, speed, 0.0,
                  draw.choice(TRAFFIC_SIZES_M)).rounded()  # fmt: skip
        beside = not towards and abs(car.place - ego.place) < CLEAR_RADIUS_M
        if not beside and 8.0 < car.place < road.length - 150.0 and keep_apart(car, (ego, bv, *placed)):
            placed.append(car)
    return tuple(placed)


# -- junctions: ways of two vehicles that meet, both timed to be there at about the same time


JUNCTION_NETWORKS = {
    "crossing_priority": ("priority_crossing", "rural_crossing", "priority_crossing", "dual_left_turn"),
    "crossing_allway": ("allway_stop",),
    "crossing_signals": ("signalised_crossing", "signalised_wide"),
    "crossing_t": ("t_junction", "t_junction_wide"),
    "crossing_roundabout": ("roundabout", "roundabout_large"),
    "crossing_merge": ("yield_merge",),
}
JUNCTION_KINDS = tuple(JUNCTION_NETWORKS)
GREEN_BEGINS_S = {
    "signalised_crossing": {"south": 36.0, "north": 36.0},
    "signalised_wide": {"south": 50.0, "north": 50.0},
}
"""The begin of the simulation [s] at which an approach has green (for 30 s), if that is not 0."""

JUNCTION_TRAFFIC = {"no": 0, "light": 2, "medium": 5, "dense": 9}
MANOEUVRES = ("straight", "left", "straight", "right", "left", "straight", "straight")  # seven: networks take turns
MIN_JUNCTION_SPEED_M_S, MAX_JUNCTION_SPEED_M_S = 8.0, 22.0
MAX_ROUTE_EDGES = 6
MAX_MEETING_DEPTH_M = 65.0  # from the stop line to where paths meet, at most: a quarter of a roundabout
MIN_APPROACH_M = 30.0  # minimum distance before the stop line at which both start
INSERTION_BRAKING_M_S2 = 3.0  # SUMO inserts no vehicle nearer to a junction than it could stop at
MIN_DEPART_POSITION_M = 6.0  # minimum distance from a lane's begin to a front bumper
LAST_TRAFFIC_DEPARTURE_S = 9.0  # others depart up to this time after the begin


@dataclass(frozen=True, slots=True)
class Approach:
    """A route from one edge of the map to another, from one lane.

    Attributes:
        edges: The edges.
        lane: The index of the lane on the first edge.
        movement: The movement at the junction.
        yields: Whether it gives way at the junction.
        line: The path from the lane's begin on.
        ends: The length of the first lane [m].
        limit: The speed limit of the first lane [m/s].
    """

    edges: tuple[str, ...]
    lane: int
    movement: str
    yields: bool
    line: Line
    ends: float
    limit: float


@dataclass(frozen=True, slots=True)
class JunctionMeeting:
    """The paths of the ego and another vehicle, which cross or merge.

    Attributes:
        ego: The ego's approach.
        bv: The other vehicle's approach.
        conflict: Where their paths meet.
    """

    ego: Approach
    bv: Approach
    conflict: PathConflict


@cache
def approaches(network: str) -> tuple[Approach, ...]:
    """Return all routes through a shipped network with a single junction, in the order of their names."""
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
    """Return the routes of two or more edges from fringe to fringe that use no edge twice."""
    onward = {
        edge: sorted({road.lanes[c.to].edge for name in lanes for c in road.lanes[name].connections})
        for edge, lanes in road.edges.items() if not edge.startswith(":")
    }  # fmt: skip
    reached = {to for many in onward.values() for to in many}

    def walk(route: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
        if not onward[route[-1]]:
            yield route
        for to in onward[route[-1]]:
            if to not in route and len(route) < MAX_ROUTE_EDGES:
                yield from walk((*route, to))

    return [route for edge in sorted(onward) if edge not in reached for route in walk((edge,)) if len(route) > 1]


@cache
def meetings(network: str) -> tuple[JunctionMeeting, ...]:
    """Return the pairs of approaches whose paths meet near the junction of a shipped network."""
    pairs = []
    for ego in approaches(network):
        for bv in approaches(network):
            if bv.edges[0] == ego.edges[0]:
                continue
            conflict = relate(bv.line, bv.movement, bv.ends, bv.yields, ego.line).conflict
            if conflict is not None and all(
                -1.0 < station - way.ends < MAX_MEETING_DEPTH_M
                for way, station in ((ego, conflict.ego_s), (bv, conflict.bv_s))
            ):
                pairs.append(JunctionMeeting(ego, bv, conflict))
    return tuple(pairs)


def draw_junction(kind: str, number: int, draw: Random) -> EncounterDraft:
    """Draw one encounter at a junction.

    Args:
        kind: One of ``JUNCTION_KINDS``.
        number: The number of the encounter within its kind, from 0. It decides network, manoeuvre, right of way and
            traffic.
        draw: The random generator.

    Returns:
        The encounter.
    """
    networks = JUNCTION_NETWORKS[kind]
    network = networks[number % len(networks)]
    word = tuple(JUNCTION_TRAFFIC)[(number + number // 4 + 1) % len(JUNCTION_TRAFFIC)]
    meeting = draw.choice(_wanted(meetings(network), number))
    trigger = draw.choice((4.0, 4.5, 5.0, 5.5, 6.0))
    ego, bv = _timed(meeting, trigger, draw)
    others = _junction_traffic(network, meeting, ego, bv, JUNCTION_TRAFFIC[word], draw)
    way = meeting.ego
    words = (
        f"the ego on {' '.join(way.edges)} of {network} ({way.movement}, lane {way.lane}) at {ego.speed:g} m/s, "
        f"{word} other traffic."
    )
    begin = GREEN_BEGINS_S.get(network, {}).get(way.edges[0].removesuffix("_in"), 0.0)
    return EncounterDraft(kind, network, ego, bv, others, trigger, words, begin)


def _wanted(meetings: Sequence[JunctionMeeting], number: int) -> Sequence[JunctionMeeting]:
    """Keep the meetings with the next manoeuvre and right of way, if there are any; every third ego gives way."""
    manoeuvre, yields = MANOEUVRES[number % len(MANOEUVRES)], number % 3 == 2
    by_movement = [m for m in meetings if m.ego.movement == manoeuvre] or list(meetings)
    return [m for m in by_movement if m.ego.yields == yields] or by_movement


def _timed(meeting: JunctionMeeting, trigger: float, draw: Random) -> tuple[Car, Car]:
    """Place both vehicles so that, at constant speeds, they reach the conflict at about the same time."""
    ego_time = draw.uniform(3.8, 6.5)
    bv_time = ego_time + draw.uniform(-1.5, 0.8)
    cars = []
    for way, station, time, sizes in (
        (meeting.ego, meeting.conflict.ego_s, ego_time, TRAFFIC_SIZES_M[:3]),
        (meeting.bv, meeting.conflict.bv_s, bv_time, TRAFFIC_SIZES_M),
    ):
        fastest = min(0.98 * way.limit, MAX_JUNCTION_SPEED_M_S, (station - MIN_DEPART_POSITION_M) / (time + trigger))
        slowest = max(MIN_JUNCTION_SPEED_M_S, 0.6 * fastest, (station - way.ends + MIN_APPROACH_M) / (time + trigger))
        speed = draw.uniform(min(slowest, fastest), fastest)
        place = min(station - speed * (time + trigger), way.ends - MIN_APPROACH_M)
        cars.append(Car(way.edges, way.lane, place, speed, 0.0, draw.choice(sizes)).rounded())
    return cars[0], cars[1]


def _junction_traffic(
    network: str, meeting: JunctionMeeting, ego: Car, bv: Car, count: int, draw: Random
) -> tuple[Car, ...]:
    """Draw other vehicles on routes through the junction; about half are there at once, the others come later."""
    placed: list[Car] = []
    ways = approaches(network)
    for _ in range(count * 12):
        if len(placed) == count:
            break
        way = draw.choice(ways)
        speed = draw.uniform(0.7, 0.98) * min(way.limit, MAX_JUNCTION_SPEED_M_S)
        later = draw.random() < 0.5
        place = (
            MIN_DEPART_POSITION_M
            if later
            else draw.uniform(
                MIN_DEPART_POSITION_M, way.ends - max(MIN_APPROACH_M, speed**2 / (2 * INSERTION_BRAKING_M_S2))
            )
        )
        depart = draw.uniform(1.5, LAST_TRAFFIC_DEPARTURE_S) if later else 0.0
        car = Car(way.edges, way.lane, place, speed, depart, draw.choice(TRAFFIC_SIZES_M)).rounded()
        if later or keep_apart(car, (ego, bv, *placed)):
            placed.append(car)
    return tuple(placed)
