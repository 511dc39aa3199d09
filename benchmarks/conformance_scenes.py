"""Random scenes that show how SUMO's drivers react: where two cars start, and how the adversary moves after that.

Each situation exercises a few of the rules that ``sumo_adv/drivers`` copies from SUMO. ``conformance.py`` drives the
scenes, and so does ``tests/test_conformance.py``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.simulation.inputs import RunInput, data_folder
from sumo_adv.situation import Situation, Target

Draw = np.random.Generator
TRIGGER = 1.2  # s: the ego's driver and the adversary's have driven so long when the adversary is taken over
STEEPEST = 0.3  # sine of the largest angle between the adversary's heading and its lane
Bounds = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
INF = float("inf")
EGO, ADVERSARY, THIRD = "ego", "adversary", "third"


@dataclass(frozen=True, slots=True)
class Car:
    """Where a car starts: edges, lane index, front bumper [m] along the first edge (negative: before its end), speed
    [m/s]; the speed that it never exceeds [m/s]; width and length [m]; SUMO's class."""

    edges: str
    lane: int
    position: float
    speed: float
    fastest: float = 60.0
    width: float = 1.8
    length: float = 5.0
    kind: str = "passenger"

    def xml(self, name: str) -> str:
        """A type and a vehicle in SUMO's words: a driver without noise that never changes lanes by itself."""
        return (
            f'<vType id="{name}" vClass="{self.kind}" sigma="0" length="{self.length:g}" width="{self.width:g}" '
            f'maxSpeed="{max(self.fastest, 0.1):.2f}" lcSpeedGain="0" lcKeepRight="0"/>'
            f'<vehicle id="{name}" type="{name}" depart="0" insertionChecks="none" departLane="{self.lane}" '
            f'departPos="{self.position:.2f}" departSpeed="{self.speed:.2f}"><route edges="{self.edges}"/></vehicle>'
        )


@dataclass(frozen=True, slots=True)
class Start:
    """The network and its cars by name at time 0."""

    network: str
    cars: Mapping[str, Car]

    def source(self, folder: Path) -> RunInput:
        """The input of a run; its demand file is written into ``folder``."""
        demand = folder / "conformance.rou.xml"
        demand.write_text(f"<routes>{''.join(car.xml(name) for name, car in self.cars.items())}</routes>")
        network = data_folder("networks") / f"{self.network}.net.xml"
        return RunInput(
            "conformance", network, network, (demand,), begin=0.0, end=60.0, ego=EGO, trigger=TRIGGER,
            candidates=(ADVERSARY,),
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Plan:
    """The adversary's motion along one of its ways. pulls: start [s], duration [s], acceleration [m/s2]; moves: start
    [s], duration [s], the offset from the way that it ends at [m, left positive]."""

    way: int
    pulls: Sequence[tuple[float, float, float]]
    moves: Sequence[tuple[float, float, float]] = ()

    def speeds(self, speed: float, time: Floats) -> Floats:
        """Speeds [m/s] at evenly spaced times [s], both ``(k,)``."""
        step = time[1] - time[0]
        pulls = (a * ((time >= begin) & (time < begin + span)) for begin, span, a in self.pulls)
        pulled = sum(pulls, start=np.zeros(len(time)))
        profile, current = np.empty(len(time)), speed
        for k in range(len(time)):
            profile[k] = current
            current = max(current + float(pulled[k]) * step, 0.0)
        return profile

    def offsets(self, offset: float, speed: Floats, time: Floats) -> Floats:
        """Offsets [m] at the times [s], ``(k,)``; the angle to the way stays below ``STEEPEST``."""
        step, planned, last = time[1] - time[0], np.full(len(time), offset), offset
        for begin, span, end in self.moves:
            u = np.clip((time - begin) / span, 0.0, 1.0)
            planned += (end - last) * u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
            last = end
        limited = np.empty(len(time))
        current = offset
        for k in range(len(time)):
            limited[k] = current
            if k + 1 < len(time):
                most = STEEPEST * speed[k + 1] * step
                current += float(np.clip(planned[k + 1] - current, -most, most))
        return limited


@dataclass(frozen=True, slots=True)
class Kind:
    """A situation: the rules that it exercises, how a scene of it starts, and how the adversary moves.

    bounds: of the errors along the path [m], sideways [m] and of the speed [m/s]: their median, 90 % quantile and
    maximum over the scenes. drivers: of the egos that the bounds are for. agree: the least share of scenes in which
    SUMO's ego waits before the junction if, and only if, the predicted one does; the errors are then those of the
    scenes in which both decide alike. 0 = errors of all scenes. missed: the greatest share in which only SUMO's waits.
    small: the seeds of the tests' two encounters, with the first and the last driver.
    """

    rules: str
    start: Callable[[Draw], Start]
    plan: Callable[[Draw, Situation, Target], Plan]
    bounds: Bounds = ((INF, INF, INF),) * 3
    drivers: tuple[str, ...] = ("krauss", "idm")
    agree: float = 0.0
    missed: float = 1.0
    small: tuple[int, int] = (0, 1)


@dataclass(frozen=True, slots=True)
class Chosen:
    """One scene of a situation, for constants that few scenes depend on: ``plan`` is its number among the motions that
    are drawn with the seed. bounds: of the errors along the path [m], sideways [m] and of the speed [m/s]."""

    constants: tuple[str, ...]
    kind: str
    driver: str
    seed: int
    plan: int
    bounds: tuple[float, float, float]


# -- starts -------------------------------------------------------------------------------------------------------

STRAIGHT = (("straight_2lane", 2, 16.7), ("straight_3lane", 3, 22.0), ("motorway", 3, 33.0))
FIRST = 60.0  # m along the edge: where the ego starts
BELOW_JAM, ABOVE_JAM = (8.0, 16.0), (17.5, 30.0)  # m/s: speeds below and above 60 km/h
WIDTHS = (1.53, 1.57, 1.68, 1.7, 1.8, 1.83, 1.87, 2.0)  # m: some end just within a strip, some just beyond it


def _ego(draw: Draw, edges: str, lane: int, position: float, speed: float) -> Car:
    """Half of the egos go no faster than they start."""
    fastest = speed if draw.random() < 0.5 else 60.0
    return Car(edges, lane, position, speed, fastest, float(draw.choice(WIDTHS)))


def _along(
    draw: Draw, ahead: tuple[float, float], side: int, slower: tuple[float, float], speeds: tuple[float, float],
    roads: Sequence[tuple[str, int, float]] = STRAIGHT, steady: bool = False,
) -> Start:  # fmt: skip
    """Two cars of one direction. ``ahead``: from the ego's front to the adversary's rear [m]; ``side``: the adversary's
    lane is this number of lanes to the left of the ego's, 2: to either side; ``slower``: by how much it drives less
    [m/s]; ``steady``: the ego goes no faster than it starts."""
    network, lanes, limit = roads[draw.integers(len(roads))]
    side = int(draw.choice((-1, 1))) if side == 2 else side
    lane = int(draw.integers(max(0, -side), min(lanes, lanes - side)))
    speed = draw.uniform(speeds[0], min(speeds[1], limit))
    adversary_speed = min(max(speed - draw.uniform(*slower), 2.0), limit)
    ego, at = _ego(draw, "eastbound", lane, FIRST, speed), FIRST + 5.0 + draw.uniform(*ahead)
    ego = replace(ego, fastest=speed) if steady else ego
    return Start(network, {EGO: ego, ADVERSARY: Car("eastbound", lane + side, at, adversary_speed, adversary_speed)})


def _following(draw: Draw) -> Start:
    return _along(draw, (6.0, 45.0), 0, (-3.0, 3.0), (8.0, 30.0))


def _cut_in(draw: Draw) -> Start:
    return _along(draw, (-8.0, 25.0), 2, (-4.0, 4.0), BELOW_JAM, steady=True)


def _beside(draw: Draw) -> Start:
    return _along(draw, (4.0, 14.0), 2, (-1.0, 2.0), BELOW_JAM, steady=True)


def _left(draw: Draw) -> Start:
    return _along(draw, (5.0, 35.0), 1, (0.5, 5.0), ABOVE_JAM, STRAIGHT[1:])


def _left_faster(draw: Draw) -> Start:
    return _along(draw, (3.0, 20.0), 1, (-4.0, -0.5), ABOVE_JAM, STRAIGHT[2:], steady=True)


def _behind_another(draw: Draw) -> Start:
    """A third car between the two; or the adversary is beside that one."""
    start = _along(draw, (14.0, 30.0), 0 if draw.random() < 0.5 else 2, (-2.0, 2.0), BELOW_JAM, steady=True)
    ego, adversary = start.cars[EGO], start.cars[ADVERSARY]
    third = Car("eastbound", ego.lane, adversary.position, adversary.speed, adversary.speed)
    adversary = Car(
        "eastbound", adversary.lane, adversary.position + draw.uniform(10.0, 25.0), adversary.speed, adversary.speed
    )
    return Start(start.network, {EGO: ego, ADVERSARY: adversary, THIRD: third})


MIDDLE = (("two_way_4lane", "eastbound", 1, 22.0), ("curved_4lane", "eastbound", 1, 19.4),
          ("rural_crossing", "west_in east_out", 0, 22.2), ("two_way", "eastbound", 0, 22.0))  # fmt: skip


def _in_the_middle(draw: Draw, speeds: tuple[float, float]) -> Start:
    network, edges, lane, limit = MIDDLE[draw.integers(2)]
    speed, at = draw.uniform(speeds[0], min(speeds[1], limit)), FIRST + 5.0 + draw.uniform(8.0, 30.0)
    adversary_speed = min(speed - draw.uniform(-1.0, 3.0), limit)
    ego = replace(_ego(draw, edges, lane, FIRST, speed), fastest=speed)
    return Start(network, {EGO: ego, ADVERSARY: Car(edges, lane, at, adversary_speed, adversary_speed)})


def _over_the_middle(draw: Draw) -> Start:
    return _in_the_middle(draw, BELOW_JAM)


def _over_the_middle_fast(draw: Draw) -> Start:
    return _in_the_middle(draw, ABOVE_JAM)


def _oncoming(draw: Draw) -> Start:
    network, edges, lane, _ = MIDDLE[draw.choice((0, 1, 3))]
    ego_speed, adversary_speed = draw.uniform(*BELOW_JAM, 2)
    apart = (ego_speed + adversary_speed) * (TRIGGER + draw.uniform(2.5, 5.5))
    length = {"two_way": 1000.0, "two_way_4lane": 1500.0, "curved_4lane": 1211.0}[network]
    ego = replace(_ego(draw, edges, lane, FIRST, ego_speed), fastest=ego_speed)
    return Start(
        network, {EGO: ego, ADVERSARY: Car("westbound", lane, length - FIRST - apart, adversary_speed, adversary_speed)}
    )


CROSSING = (
    ("priority_crossing", "west_in east_out", 0, "north_in south_out", 0),
    ("priority_crossing", "west_in east_out", 1, "south_in north_out", 1),
    ("t_junction", "west_in east_out", 0, "south_in west_out", 0),
    ("t_junction", "west_in east_out", 0, "east_in south_out", 0),
    ("rural_crossing", "west_in east_out", 0, "south_in north_out", 0),
)
MERGING = (
    ("yield_merge", "main onward", 0, "ramp onward", 0),
    ("t_junction", "west_in east_out", 0, "south_in east_out", 0),
    ("priority_crossing", "west_in east_out", 0, "south_in east_out", 0),
)
GIVING_WAY = (
    ("priority_crossing", "south_in north_out", 0, "west_in east_out", 0),
    ("priority_crossing", "north_in south_out", 1, "west_in east_out", 1),
    ("priority_crossing", "east_in south_out", 1, "west_in east_out", 0),
    ("t_junction", "east_in south_out", 0, "west_in east_out", 0),
    ("t_junction", "south_in east_out", 0, "west_in east_out", 0),
    ("yield_merge", "ramp onward", 0, "main onward", 0),
)


def _meeting(
    ways: Sequence[tuple[str, str, int, str, int]], later: tuple[float, float]
) -> Callable[[Draw], Start]:  # fmt: skip
    """Both come to a junction; ``later``: how long after the ego the adversary does [s]."""

    def start(draw: Draw) -> Start:
        network, ego_edges, lane, adversary_edges, adversary_lane = ways[draw.integers(len(ways))]
        ego_speed, adversary_speed, to = draw.uniform(8.0, 13.5), draw.uniform(7.0, 13.5), draw.uniform(40.0, 90.0)
        away = float(np.clip(adversary_speed * (to / ego_speed + draw.uniform(*later)), 20.0, 180.0))
        cars = {
            EGO: _ego(draw, ego_edges, lane, -to, ego_speed),
            ADVERSARY: Car(adversary_edges, adversary_lane, -away, adversary_speed, adversary_speed),
        }
        return Start(network, cars)

    return start


# -- motions ------------------------------------------------------------------------------------------------------


def _bicycle(draw: Draw) -> Start:
    """A bicycle on the cycle track beside the ego's lane."""
    ego, speed = _ego(draw, "eastbound", 2, FIRST, draw.uniform(7.0, 13.5)), draw.uniform(3.0, 6.0)
    at = FIRST + draw.uniform(25.0, 50.0)
    bicycle = Car("eastbound", 1, at, speed, speed, width=0.6, length=1.8, kind="bicycle")
    return Start("urban_street", {EGO: replace(ego, fastest=ego.speed), ADVERSARY: bicycle})


def _cross(draw: Draw, situation: Situation, target: Target) -> Plan:
    """Over the ego's path at a right angle, at an even pace or a changing one."""
    across = [k for k, way in enumerate(target.ways) if way.movement == "across"]
    return Plan(int(draw.choice(across)), [_pull(draw, (0.5, 2.0), (0.5, 2.0), (-1.0, 1.0))])


def _swing(draw: Draw, situation: Situation, target: Target) -> Plan:
    """Into the ego's lane, to any place in it."""
    to = draw.uniform(-1.2, 1.2) - float(target.ways[0].ego_d[0])
    return Plan(0, [], [(draw.uniform(0.5, 3.0), draw.uniform(1.5, 4.0), to)])


def _pull(draw: Draw, begin: tuple[float, float], span: tuple[float, float], a: tuple[float, float]) -> tuple[
    float, float, float
]:  # fmt: skip
    return draw.uniform(*begin), draw.uniform(*span), draw.uniform(*a)


def _brake_or_go(draw: Draw) -> list[tuple[float, float, float]]:
    first = ((-9.0, -4.0), (-3.5, -0.5), (0.5, 2.0))[draw.integers(3)]
    return [_pull(draw, (0.0, 1.5), (0.5, 3.0), first), _pull(draw, (4.5, 5.5), (1.0, 3.0), (-3.0, 3.0))]


def _follow(draw: Draw, situation: Situation, target: Target) -> Plan:
    return Plan(0, _brake_or_go(draw))


def _into(situation: Situation, target: Target) -> float:
    """The offset from its way of the middle of the ego's lane [m]."""
    side = np.sign(target.ways[0].ego_d[0])
    return float(-side * situation.road.lane_width) if abs(target.ways[0].ego_d[0]) > 1.0 else 0.0


def _cut(draw: Draw, situation: Situation, target: Target) -> Plan:
    into = _into(situation, target) * draw.uniform(0.4, 1.1)
    return Plan(0, _brake_or_go(draw), [_pull(draw, (0.0, 2.0), (1.5, 4.0), (into, into))])


def _come_back(draw: Draw, situation: Situation, target: Target) -> Plan:
    """Into the ego's lane, out of it until the ego is beside it, and back over the line."""
    into = _into(situation, target)
    out, back = into * draw.uniform(0.0, 0.4), into * draw.uniform(0.2, 0.6)
    moves = [
        (0.0, draw.uniform(1.5, 2.2), into),
        (draw.uniform(2.3, 3.0), 1.5, out),
        (draw.uniform(4.5, 5.5), 1.5, back),
    ]
    return Plan(0, [_pull(draw, (2.0, 3.5), (1.0, 2.0), (-4.0, -0.5)), (5.0, 2.0, draw.uniform(0.0, 1.5))], moves)


def _in_the_left(draw: Draw, situation: Situation, target: Target) -> Plan:
    moves = [_pull(draw, (0.0, 2.0), (1.5, 3.0), (-1.7, 1.7))] if draw.random() < 0.4 else []
    return Plan(0, [_pull(draw, (0.0, 1.5), (0.5, 2.5), (-4.0, 0.0)), (4.5, 2.0, draw.uniform(-2.0, 0.5))], moves)


def _go_over(draw: Draw, situation: Situation, target: Target) -> Plan:
    out, back = draw.uniform(1.4, 2.6), draw.uniform(0.0, 1.7)
    moves = [
        (draw.uniform(0.0, 1.0), draw.uniform(1.5, 3.0), out),
        (draw.uniform(4.0, 5.0), draw.uniform(1.5, 3.0), back),
    ]
    return Plan(0, [_pull(draw, (0.0, 2.0), (1.0, 3.0), (-2.5, 0.0))], moves)


def _intrude(draw: Draw, situation: Situation, target: Target) -> Plan:
    moves = [(draw.uniform(0.0, 1.5), draw.uniform(1.5, 3.0), draw.uniform(0.5, 3.4))]
    moves += [(draw.uniform(4.5, 5.5), 2.0, 0.0)] if draw.random() < 0.5 else []
    return Plan(0, [_pull(draw, (0.0, 2.0), (1.0, 3.0), (-3.0, 1.0))], moves)


def _cut_in_further_on(draw: Draw, situation: Situation, target: Target) -> Plan:
    into = _into(situation, target)
    moves = [_pull(draw, (0.0, 1.5), (1.5, 3.0), (into, into))] if into else []
    return Plan(0, [_pull(draw, (1.0, 3.0), (1.0, 3.0), (-6.0, -1.0))], moves)


def _pass(draw: Draw, situation: Situation, target: Target) -> Plan:
    return Plan(0, [_pull(draw, (0.0, 3.0), (1.0, 3.0), (-0.5, 2.0))])


def _rush(first: tuple[float, float], *kinds: str) -> Callable[[Draw, Situation, Target], Plan]:
    """Over the junction, with an acceleration of ``first`` [m/s2] to begin with."""

    def plan(draw: Draw, situation: Situation, target: Target) -> Plan:
        meets = [k for k, w in enumerate(target.ways) if w.conflict is not None and w.conflict.kind in kinds]
        way = int(draw.choice(meets)) if meets else 0
        return Plan(way, [
            _pull(draw, (0.0, 1.5), (1.0, 2.5), first), _pull(draw, (2.5, 5.0), (1.0, 3.0), (-4.0, 3.0)),
        ])  # fmt: skip

    return plan


KINDS: Mapping[str, Kind] = {
    "following": Kind("car following (car_following.py)", _following, _follow,
        ((0.02, 0.04, 0.06), (0.02, 0.02, 0.02), (0.02, 0.03, 0.03))),
    "cut_in": Kind("which vehicle is a leader, by the lines of the lane (prediction.py)", _cut_in, _cut,
        ((0.02, 0.02, 0.02), (0.02, 0.02, 0.09), (0.01, 0.02, 0.02))),
    "beside": Kind("making room within the lane, and the strips that are looked at (lateral_gap.py, prediction.py)",
        _beside, _come_back,
        ((0.02, 0.02, 0.03), (0.02, 0.02, 0.65), (0.02, 0.02, 0.07))),
    "left": Kind("not overtaking on the right above 60 km/h (leaders.py: JAM)", _left, _in_the_left,
        ((0.02, 0.02, 0.27), (0.02, 0.02, 0.02), (0.02, 0.02, 0.66))),
    "over_the_middle": Kind("going over to a lane of the other direction (prediction.py: OVER, TURNED, BACK)",
        _over_the_middle, _go_over,
        ((0.03, 0.52, 0.72), (0.02, 0.02, 0.02), (0.08, 0.6, 1.05))),
    "left_faster": Kind("overtaking a faster vehicle on the right (prediction.py: desired speed)", _left_faster, _pass,
        ((0.04, 0.08, 0.1), (0.02, 0.02, 0.02), (0.02, 0.02, 0.03))),
    "over_the_middle_fast": Kind("passing a vehicle in a lane of the other direction (prediction.py: has_left)",
        _over_the_middle_fast, _go_over,
        ((0.04, 0.1, 0.4), (0.02, 0.03, 0.03), (0.03, 0.06, 0.6))),
    "oncoming_intrusion": Kind("oncoming vehicles in the lane (prediction.py: ACROSS)", _oncoming, _intrude,
        ((0.02, 0.3, 0.6), (0.02, 0.02, 0.02), (0.02, 2.5, 3.2))),
    "behind_another": Kind("other leaders, which brake for the adversary (leaders.py)",
        _behind_another, _cut_in_further_on,
        ((0.02, 0.02, 0.05), (0.02, 0.02, 0.02), (0.02, 0.02, 0.05))),
    "crossing": Kind("crossing on a junction (junctions.py)",
        _meeting(CROSSING, (-2.5, 1.0)), _rush((-3.0, 2.5), "crossing"),
        ((0.02, 0.5, 2.65), (0.02, 0.02, 0.02), (0.02, 1.0, 2.6))),
    "merging": Kind("merging on a junction (junctions.py)",
        _meeting(MERGING, (-2.5, 1.0)), _rush((-3.0, 2.5), "merging"),
        ((0.02, 0.1, 0.59), (0.02, 0.02, 0.02), (0.02, 0.07, 2.09))),
    "giving_way": Kind("waiting at the line where the ego gives way (junctions.py)",
        _meeting(GIVING_WAY, (4.0, 7.0)), _rush((0.5, 3.5), "crossing", "merging"),
        ((0.05, 0.15, 2.0), (0.03, 0.06, 0.06), (0.05, 0.15, 3.5)), ("krauss",), 0.5, 0.5, (0, 9)),
    "giving_way_idm": Kind("waiting at the line where an IDM driver gives way (junctions.py)",
        _meeting(GIVING_WAY, (4.0, 7.0)), _rush((0.5, 3.5), "crossing", "merging"),
        ((7.0, 17.0, 24.0), (0.03, 0.06, 0.06), (3.5, 6.5, 8.0)), ("idm",), 0.88, 0.1, (0, 2)),
    "gave_way": Kind("waiting at the line where the ego gave way unattacked, too (junctions.py)",
        _meeting(GIVING_WAY, (-2.5, 1.0)), _rush((-3.0, 2.5), "crossing", "merging"),
        ((2.2, 12.0, 19.0), (0.02, 0.06, 0.06), (1.6, 5.2, 9.5)), agree=0.8, missed=0.02, small=(1, 2)),
    "bicycle_crosses": Kind("a bicycle across the lane (prediction.py: ACROSS, over_kerb)", _bicycle, _cross,
        ((0.02, 0.1, 0.65), (0.02, 0.03, 0.08), (0.02, 0.1, 2.3))),
    "bicycle_swings": Kind("a bicycle that comes into the lane (prediction.py: over_kerb)", _bicycle, _swing,
        ((0.4, 1.6, 4.8), (0.02, 0.2, 0.4), (0.6, 3.8, 7.5))),
}  # fmt: skip
"""What the prediction copies."""
CHOSEN: Mapping[str, Chosen] = {
    "a foe speeds up": Chosen(("FOE_ACCELERATION", "FOE_SPEED", "AHEAD", "CLEARANCE"), "giving_way", "krauss", 17, 0,
        (0.02, 0.02, 0.02)),
    "the line is in sight": Chosen(("SEES", "STOPS_BEFORE"), "giving_way", "krauss", 14, 2, (0.015, 0.02, 0.02)),
    "a vehicle turns across": Chosen(("ACROSS",), "crossing", "krauss", 13, 2, (0.02, 0.02, 0.02)),
    "an emergency": Chosen(("AMPLIFIED",), "cut_in", "krauss", 2, 1, (0.02, 0.02, 0.02)),
    "back over the middle": Chosen(("BACK",), "over_the_middle", "idm", 4, 4, (0.03, 0.02, 0.03)),
    "room to one side": Chosen(("GAP",), "beside", "idm", 19, 2, (0.02, 0.02, 0.02)),
    "room is made fast": Chosen(("LATERAL_ACCELERATION",), "beside", "krauss", 4, 2, (0.02, 0.02, 0.02)),
    "where ways part": Chosen(("SUMO_TURN_COST", "SUMO_LOYALTY"), "crossing", "idm", 20, 5, (0.02, 0.02, 0.02)),
}  # fmt: skip
"""Single scenes, by what they show."""
