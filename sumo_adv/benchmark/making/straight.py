"""Encounters on roads without junctions: the ego keeps its lane; a vehicle is ahead, beside, behind or oncoming."""

from __future__ import annotations

from dataclasses import dataclass
from random import Random

from sumo_adv.benchmark.making.drafts import Car, Draft, apart

KINDS = ("leader", "neighbour_ahead", "neighbour_behind", "oncoming", "follower")
TRAFFIC = {"no": 0, "light": 3, "medium": 7, "dense": 12}
"""How many other vehicles, by the word for it."""

SIZES = ((4.8, 1.8), (4.4, 1.8), (5.0, 1.9), (6.0, 2.1))  # m, the last one a van
STAYS = 16.0  # s that the ego must have road for after the trigger
OWN_SPACE = 24.0  # m around the ego in which only the intended vehicle drives beside it


@dataclass(frozen=True, slots=True)
class Road:
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
        Road("straight_2lane", "eastbound", "", 2, 900.0, 8.0, 16.5),
        Road("straight_3lane", "eastbound", "", 3, 1200.0, 10.0, 21.8),
        Road("straight_4lane", "eastbound", "", 4, 1300.0, 14.0, 24.8),
        Road("motorway", "eastbound", "", 3, 2030.0, 18.0, 25.0),
        Road("two_way", "eastbound", "westbound", 1, 1000.0, 8.0, 21.0),
        Road("two_way_4lane", "eastbound", "westbound", 2, 1500.0, 8.0, 21.8),
        Road("curved_road", "eastbound", "westbound", 1, 946.0, 8.0, 16.5),
        Road("curved_4lane", "eastbound", "westbound", 2, 1209.0, 8.0, 19.2),
    )
}
WIDE = ("straight_3lane", "two_way_4lane", "motorway", "straight_2lane", "curved_4lane", "straight_4lane")
MEETING = ("two_way", "curved_road", "two_way_4lane", "curved_4lane")


def draw_straight(kind: str, number: int, draw: Random) -> Draft:
    """One encounter of a kind; ``number`` (from 0) of that kind decides network, lane and traffic."""
    networks = MEETING if kind == "oncoming" else WIDE
    road = ROADS[networks[number % len(networks)]]
    lane = (number + number // len(networks)) % road.lanes
    word = tuple(TRAFFIC)[(number + number // 4) % len(TRAFFIC)]
    trigger = draw.choice((4.0, 4.5, 5.0, 5.5, 6.0, 7.0))
    speed = draw.uniform(road.slowest, road.fastest)
    room = road.length - speed * (trigger + STAYS)
    ego = Car((road.edge,), lane, draw.uniform(0.35, 0.85) * min(room, 320.0), speed, 0.0, draw.choice(SIZES[:3]))
    ego = ego.rounded()
    bv = _other(kind, road, ego, trigger, draw).rounded()
    others = _traffic(road, ego, bv, TRAFFIC[word], draw)
    words = f"the ego in lane {lane} of {road.lanes} of {road.network} at {ego.speed:g} m/s, {word} other traffic."
    return Draft(kind, road.network, ego, bv, others, trigger, words)


def _other(kind: str, road: Road, ego: Car, trigger: float, draw: Random) -> Car:
    """The vehicle that is meant: where it is at the trigger, taken back to the departure."""
    size, v = draw.choice(SIZES), ego.speed
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


def _traffic(road: Road, ego: Car, bv: Car, count: int, draw: Random) -> tuple[Car, ...]:
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
                  draw.choice(SIZES)).rounded()  # fmt: skip
        beside = not towards and abs(car.place - ego.place) < OWN_SPACE
        if not beside and 8.0 < car.place < road.length - 150.0 and apart(car, (ego, bv, *placed)):
            placed.append(car)
    return tuple(placed)
