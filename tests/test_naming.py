"""Named scenarios of hand-made tracks: the ego drives eastward with 10 m/s on a straight way."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from test_words_motion import BEND, turning_ego

from sumo_adv.datatypes import Floats, NamedScenario, RoadGeometry, Role, Track
from sumo_adv.geometry import Path, make_path
from sumo_adv.words.motion import Scene, follow
from sumo_adv.words.naming import NamingContext, named

TIME = np.round(np.arange(0.0, 6.01, 0.1), 3)
STILL = 0.0 * TIME
WAY = make_path([(-50.0, 0.0), (250.0, 0.0)])
CAR, MOTORCYCLE, BICYCLE, PERSON = (4.8, 1.8), (2.2, 0.9), (1.8, 0.65), (0.5, 0.5)


def track(
    name: str, x: Floats, y: Floats, heading: Floats | float, speed: Floats | float, size: tuple[float, float] = CAR
) -> Track:
    headings, speeds = np.broadcast_to(heading, TIME.shape), np.broadcast_to(speed, TIME.shape)
    return Track(name, Role.ADVERSARY, TIME, x, y, headings, speeds, STILL, *size)


EGO = track("ego", 10.0 * TIME, STILL, 0.0, 10.0)
NEIGHBOUR, ONCOMING, CROSSING = NamingContext("neighbour"), NamingContext("oncoming"), NamingContext("crossing")
JUNCTION = NamingContext("crossing", junction=True, geometry=None)


def name_of(
    adversary: Track, around: NamingContext, *, contact: bool = False, ego: Track = EGO, way: Path = WAY
) -> NamedScenario:
    side = "front" if contact else None
    course = follow(Scene(ego, adversary, (), way, around.relation, around.hidden, side, 0.0))
    assert course is not None
    return named(course, around, contact=contact)


def ahead(speed: Floats, gap: float = 20.0, size: tuple[float, float] = CAR) -> Track:
    """A vehicle in the ego's lane."""
    x = gap + np.concatenate([[0.0], np.cumsum(speed[:-1] * 0.1)])
    return track("leader", x, STILL, 0.0, speed, size)


@pytest.mark.parametrize(
    ("speed", "size", "number", "name", "motion"),
    [
        (STILL, CAR, 26, "CCRs", "leader stands"),
        (STILL + 5.0, CAR, 24, "CCRm", "leader drives slower"),
        (10.0 - TIME, CAR, 25, "CCRb", "leader brakes"),  # 4 m/s at the end
        (np.maximum(10.0 - 3.0 * TIME, 0.0), CAR, 26, "CCRb", "leader brakes to a standstill"),  # after 3.3 s
        (5.0 + TIME, CAR, 23, "", "leader speeds up"),
        (STILL, MOTORCYCLE, 26, "CMRs", "leader stands"),
    ],
)
def test_a_leader_is_named_by_its_speed(
    speed: Floats, size: tuple[float, float], number: int, name: str, motion: str
) -> None:
    """A braking leader is a leader, whatever the intent was called."""
    scenario = name_of(ahead(speed, size=size), NamingContext("leader"), contact=True)
    assert (scenario.nhtsa, scenario.euro_ncap, scenario.motion) == (number, name, motion)


def test_disturbances_of_iso_34502_name_the_road_the_ego_and_the_other() -> None:
    slower = ahead(STILL + 5.0)
    around = NamingContext("leader", geometry=RoadGeometry.MERGE, changes_lane=True)
    scenario = name_of(slower, around, contact=True)
    assert scenario.iso_34502 == "merge zone, lane change, deceleration"
    assert scenario.nhtsa == 22  # the following vehicle makes a manoeuvre
    assert name_of(slower, NamingContext("leader", geometry=None), contact=True).iso_34502 == ""  # ways cross there


@pytest.mark.parametrize(("sideways", "number", "motion"), [(1.2, 18, "cuts in"), (0.4, 19, "drifts in")])
def test_a_vehicle_that_comes_from_the_side_changes_lanes_or_drifts(sideways: float, number: int, motion: str) -> None:
    """From 2.6 m beside the ego's way; it is in the way below 0.9 + 0.9 m."""
    y = np.maximum(2.6 - sideways * TIME, 0.0)
    scenario = name_of(track("n", 8.0 + EGO.x, y, 0.0, 10.0), NEIGHBOUR)
    assert scenario == NamedScenario(f"{motion} from the left", number, "main roadway, lane keep, cut-in", "cut-in")


def test_a_leader_that_leaves_and_a_follower() -> None:
    y = np.clip(1.2 * (TIME - 0.5), 0.0, 3.5)
    leaves = name_of(track("l", 12.0 + EGO.x, y, 0.0, 10.0), NamingContext("leader"))
    assert (leaves.motion, leaves.euro_ncap) == ("leader leaves the lane", "cut-out")
    assert leaves.iso_34502 == "main roadway, lane keep, cut-out"
    behind = name_of(track("f", -20.0 + 12.0 * TIME, STILL, 0.0, 12.0), NamingContext("follower"))
    assert behind == NamedScenario("follower closes up", 24, "main roadway, lane keep, acceleration")
    beside = name_of(track("b", EGO.x, STILL + 3.5, 0.0, 10.0), NEIGHBOUR)
    assert beside == NamedScenario("stays beside the ego")  # no list has a name for what is no conflict


def test_oncoming_vehicles() -> None:
    """They meet at 60 m after 3 s: in the ego's lane from the first, changing lanes, drifting, and passing."""
    x, west = 120.0 - 20.0 * TIME, math.pi
    in_lane = track("o", x, STILL, west, 20.0)
    assert name_of(in_lane, ONCOMING) == NamedScenario("oncoming vehicle in the ego's lane", 21, "", "CCFhos")
    comes = track("o", x, np.maximum(3.4 - TIME, 0.0), west, 20.0)
    assert name_of(comes, ONCOMING) == NamedScenario("oncoming vehicle comes over", 20, "", "CCFhol")
    drifts = track("o", x, np.maximum(2.5 - 0.3 * TIME, 0.0), west, 20.0)
    assert name_of(drifts, ONCOMING) == NamedScenario("oncoming vehicle drifts over", 21)
    assert name_of(track("o", x, STILL + 3.4, west, 20.0), ONCOMING) == NamedScenario("oncoming vehicle passes")


def test_turns_across_the_path_of_oncoming_traffic() -> None:
    """The ego turns left: CCFtap. The other turns left: Euro NCAP has no name for it. In left-hand traffic, right."""
    straight = track("o", 120.0 - 20.0 * TIME, STILL + 3.4, math.pi, 20.0)
    turning = NamingContext("oncoming", junction=True, geometry=None, ego_turn=math.radians(90))
    tap = name_of(straight, turning, contact=True)
    assert (tap.nhtsa, tap.euro_ncap) == (29, "CCFtap")
    lights = NamingContext("oncoming", junction=True, signalised=True, geometry=None, movements=frozenset({"left"}))
    crosses = name_of(track("o", 120.0 - 20.0 * TIME, 3.4 - TIME, math.pi, 20.0), lights, contact=True)
    assert (crosses.nhtsa, crosses.euro_ncap) == (27, "")
    assert crosses.motion == "oncoming vehicle turns left across the ego's way"
    mirrored = NamingContext("oncoming", junction=True, geometry=None, ego_turn=-math.radians(90), hand=-1.0)
    assert name_of(straight, mirrored, contact=True).euro_ncap == "CCFtap"


@pytest.mark.parametrize(("signalised", "number"), [(False, 29), (True, 27)])
def test_an_ego_that_turns_left_across_an_oncoming_vehicle(signalised: bool, number: int) -> None:
    """The nearest place of the ego's path to a vehicle far ahead is behind the turn, where they differ by 94 degrees.

    40 m before the turn at first, the ego is 8 m into it after 6 s: 8 / 9.6 rad or 48 degrees.
    """
    ego, west = turning_ego(40.0), track("o", 10.9 + 12.0 * (6.0 - TIME), STILL + 3.5, math.pi, 12.0)
    turn = math.radians(90)
    may = frozenset({"straight", "left"})
    around = NamingContext("crossing", False, True, signalised, geometry=None, ego_turn=turn, movements=may)
    scenario = name_of(west, around, contact=True, ego=ego, way=BEND)
    tap = "oncoming vehicle, the ego turns left across its way"
    assert scenario == NamedScenario(tap, number, euro_ncap="CCFtap")


def test_what_is_not_oncoming_to_an_ego_that_turns_left() -> None:
    """A vehicle that comes southward from the left, one from the right, a leader in the turn, and a neighbour."""
    ego = turning_ego(40.0)
    around = NamingContext("crossing", junction=True, geometry=None, ego_turn=math.radians(90))
    south = track("c", STILL + 6.0, 8.0 + 8.0 * (6.0 - TIME), -math.pi / 2, 8.0)
    scenario = name_of(south, around, contact=True, ego=ego, way=BEND)
    assert (scenario.motion, scenario.nhtsa) == ("comes from the left, the ego turns left", 31)
    north = track("c", STILL + 10.0, -1.5 - 8.0 * (6.0 - TIME), math.pi / 2, 8.0)
    assert name_of(north, around, contact=True, ego=ego, way=BEND).motion == "comes from the right, the ego turns left"
    leader = track("l", STILL + 9.6, 12.0 + 0.5 * TIME, math.pi / 2, 0.5)
    ahead_of_it = replace(around, relation="leader")
    assert name_of(leader, ahead_of_it, contact=True, ego=ego, way=BEND).motion == "leader drives slower"
    inner = turning_ego(40.0)  # 3 m to the left of the ego
    beside = track(
        "n", inner.x - 3.0 * np.sin(inner.heading), inner.y + 3.0 * np.cos(inner.heading), inner.heading, 8.0
    )
    next_to_it = replace(around, relation="neighbour")
    assert name_of(beside, next_to_it, ego=ego, way=BEND).motion == "is beside an ego that turns left"


def test_crossing_paths() -> None:
    """Northward with 8 m/s from 24 m on the right: there after 3 s, as the ego."""
    right = track("c", STILL + 30.0, -24.0 + 8.0 * TIME, math.pi / 2, 8.0)
    assert name_of(right, JUNCTION) == NamedScenario("crosses from the right", 30, "", "CCCscp")
    red = NamingContext("crossing", junction=True, signalised=True, red=True, geometry=None)
    assert name_of(right, red).nhtsa == 4
    green = NamingContext("crossing", junction=True, signalised=True, geometry=None)
    assert name_of(right, green).nhtsa == 37
    only = NamingContext("merging", junction=True, geometry=None, movements=frozenset({"right"}))
    turns = name_of(right, only)
    assert (turns.nhtsa, turns.motion) == (31, "comes from the right and turns right")


@pytest.mark.parametrize(
    ("y", "around", "size", "name", "number"),
    [
        (-6.0, CROSSING, PERSON, "CPNA", 12),
        (6.0, CROSSING, PERSON, "CPFA", 12),
        (-6.0, NamingContext("crossing", hidden=True), PERSON, "CPNCO", 12),
        (-6.0, NamingContext("crossing", hidden=True), BICYCLE, "CBNAO", 14),
        (-6.0, NamingContext("crossing", hand=-1.0), PERSON, "CPFA", 12),  # the kerb is on the left
        (-6.0, NamingContext("crossing", junction=True, ego_turn=1.2), BICYCLE, "CBTA", 13),
    ],
)
def test_pedestrians_and_cyclists(
    y: float, around: NamingContext, size: tuple[float, float], name: str, number: int
) -> None:
    """With 2 m/s towards the ego's way, 30 m ahead."""
    walks = track("p", STILL + 30.0, y - math.copysign(2.0, y) * TIME, -math.copysign(math.pi / 2, y), 2.0, size)
    scenario = name_of(walks, around)
    assert (scenario.euro_ncap, scenario.nhtsa, scenario.iso_34502) == (name, number, "")


def test_a_cyclist_ahead_goes_along_the_way() -> None:
    assert name_of(track("b", 20.0 + 4.0 * TIME, STILL - 0.5, 0.0, 4.0, BICYCLE), CROSSING).euro_ncap == "CBLA"
