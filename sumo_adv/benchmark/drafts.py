"""Draws encounters on the shipped networks, on straight roads and at junctions, and writes the two files of each.

Nothing in the files tells which vehicle was meant or as what: ids are numbers in the order of departure and place.
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
ALLOWED_SIMULATION_S = 60.0  # s of simulation that a scenario allows
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
    """A vehicle at its departure: front bumper at ``place`` [m] of a lane of the first edge, ``speed`` [m/s] (also the
    most it drives), ``depart`` in s after the scenario's begin; ``size``: length and width [m]."""

    edges: tuple[str, ...]
    lane: int
    place: float
    speed: float
    depart: float = 0.0
    size: tuple[float, float] = CAR_SIZE_M

    def rounded(self) -> Car:
        return replace(self, place=round(self.place, 1), speed=round(self.speed, 1), depart=round(self.depart, 1))


@dataclass(frozen=True, slots=True)
class EncounterDraft:
    """An encounter as it was drawn. ``bv``: the vehicle meant to be the adversary; ``trigger`` in s after ``begin``."""

    kind: str
    network: str
    ego: Car
    bv: Car
    others: tuple[Car, ...]
    trigger: float
    words: str
    begin: float = 0.0

    def named(self) -> dict[str, Car]:
        """All vehicles by id, in the order in which SUMO wants them; ``self.bv`` is among them."""
        cars = sorted((self.bv, *self.others), key=lambda c: (c.depart, c.edges, c.lane, c.place))
        return {EGO_ID: self.ego, **{f"v{k}": car for k, car in enumerate(cars, 1)}}

    def bv_id(self) -> str:
        return next(name for name, car in self.named().items() if car is self.bv)


def write_draft(draft: EncounterDraft, name: str, folder: Path) -> Path:
    """Writes ``<name>.toml`` and ``demand/<name>.rou.xml`` into ``folder``, which must hold ``networks``."""
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
    """Whether a vehicle that departs at once has room in its lane: as much as SUMO wants to insert it, and a little."""
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
"""How many other vehicles, by the word for it."""

TRAFFIC_SIZES_M = ((4.8, 1.8), (4.4, 1.8), (5.0, 1.9), (6.0, 2.1))  # the last one a van
EGO_ROAD_AFTER_TRIGGER_S = 16.0  # s that the ego must have road for after the trigger
CLEAR_RADIUS_M = 24.0  # m around the ego in which only the intended vehicle drives beside it


@dataclass(frozen=True, slots=True)
class DraftRoad:
    """A road: name of the network, edge of the ego and the one towards it, lanes each way, length [m], speeds [m/s]."""

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
    """One encounter of a kind; ``number`` (from 0) of that kind decides network, lane and traffic."""
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
    """The vehicle that is meant: where it is at the trigger, taken back to the departure."""
    size, v = draw.choice(TRAFFIC_SIZES_M), ego.speed
    if kind == "oncoming":
        own = min(max(v + draw.uniform(-3.0, 3.0), road.slowest), road.fastest)
        apart_then = (v + own) * draw.uniform(3.2, 6.5)
        place = ego.place + apart_then + (v + own) * trigger
        lane = draw.randrange(road.lanes) if ego.lane else road.lanes - 1  # two lanes between are too many
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
    """Others, with room around the ego; as many as find a place."""
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
"""Begin of the simulation [s] at which an approach has green, where that is not 0 (and lasts for 30 s)."""

JUNCTION_TRAFFIC = {"no": 0, "light": 2, "medium": 5, "dense": 9}
MANOEUVRES = ("straight", "left", "straight", "right", "left", "straight", "straight")  # seven: networks take turns
MIN_JUNCTION_SPEED_M_S, MAX_JUNCTION_SPEED_M_S = 8.0, 22.0
MAX_ROUTE_EDGES = 6
MAX_MEETING_DEPTH_M = 65.0  # m behind the stop line that ways may meet: a quarter of a roundabout
MIN_APPROACH_M = 30.0  # m before the stop line that both start at least
INSERTION_BRAKING_M_S2 = 3.0  # SUMO inserts no vehicle nearer to a junction than it could stop at
MIN_DEPART_POSITION_M = 6.0  # m from a lane's begin to a front bumper at least
LAST_TRAFFIC_DEPARTURE_S = 9.0  # s after the begin until which others depart


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
class JunctionMeeting:
    """Ways of the ego and of another that cross or merge."""

    ego: Approach
    bv: Approach
    conflict: PathConflict


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
            if to not in route and len(route) < MAX_ROUTE_EDGES:
                yield from walk((*route, to))

    return [route for edge in sorted(onward) if edge not in reached for route in walk((edge,)) if len(route) > 1]


@cache
def meetings(network: str) -> tuple[JunctionMeeting, ...]:
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
    """One encounter of a kind; ``number`` (from 0) decides network, manoeuvre, right of way and traffic."""
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
    """Those with the manoeuvre and (two of three) the right of way that is next, as far as there are any."""
    manoeuvre, yields = MANOEUVRES[number % len(MANOEUVRES)], number % 3 == 2
    by_movement = [m for m in meetings if m.ego.movement == manoeuvre] or list(meetings)
    return [m for m in by_movement if m.ego.yields == yields] or by_movement


def _timed(meeting: JunctionMeeting, trigger: float, draw: Random) -> tuple[Car, Car]:
    """Both vehicles, so placed that they would be at the conflict at about the same time at constant speeds."""
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
    """Others on any route through the junction, half of them on the road from the first, half of them to come."""
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
