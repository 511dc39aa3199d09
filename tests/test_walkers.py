"""Pedestrians and cyclists who turn back, ride against the traffic, or only walk through a scene."""

from __future__ import annotations

import csv
import gzip
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_samples import Done, Program, read_states
from situation_samples import EGO_PATH, situation

from sumo_adv.datatypes import Proposal, Role, Track, VehicleState
from sumo_adv.episode.attempt import PlannedAdversary
from sumo_adv.episode.memory_access import unprotected_library
from sumo_adv.episode.unprotected import TURNS_BACK_M, unprotected_ways, ways_back
from sumo_adv.metrics.gates import failed_gates, kinematic_gates, motion
from sumo_adv.planners.sessions import ask_trusted
from sumo_adv.road_users import UNPROTECTED_LIMITS, RoadUser, road_user
from sumo_adv.situation import Target, relate

PERSON, BICYCLE = (0.5, 0.5), (1.8, 0.6)
NORTH = math.pi / 2
FOOT, BY_BICYCLE = "Pedestrian Turns Back", "Cyclist Turns Back"


def walker(y: float, heading: float, speed: float, size: tuple[float, float] = PERSON) -> VehicleState:
    return VehicleState("walker", 60.0, y, heading, speed, 0.0, *size, "")


def target_of(state: VehicleState) -> Target:
    ways = unprotected_ways(state, EGO_PATH)
    return Target(state, "crossing", (*ways, *ways_back(state, ways, EGO_PATH)), 0.0, 0.0, 0.0, ())


def walked(state: VehicleState, label: str, **values: float) -> Track:
    """What the walker does for 14 s with a shipped planner, while the ego comes along y = 0.

    The ego drives 60 m in 11 s, whatever happens.
    """
    (planner,) = next(e.planners for e in unprotected_library() if e.label == label)
    proposal = Proposal("walker", label, planner, {**planner.defaults(), **values}, 0.0, 0.0)
    ego_speed, k = 60.0 / 11.0, np.arange(201.0)
    given = situation([target_of(state)])
    given = replace(
        given, baseline=replace(given.baseline, s=0.1 * ego_speed * k, v=0.0 * k + ego_speed, a=0.0 * k)
    )  # fmt: skip
    limits = UNPROTECTED_LIMITS[road_user(state)]
    control = PlannedAdversary(given, "walker", limits, ask_trusted(proposal, given, lambda _: "the planner failed"))
    rows: list[tuple[float, ...]] = []
    for step in range(140):
        if step % 5 == 0:
            assert control.replan(0.1 * step, (0.1 * ego_speed * step, 0.0, ego_speed, 0.0)) is None
        there = control.advance()
        rows.append((0.1 * (step + 1), there.x, there.y, there.heading, there.speed, control.acceleration))
    time, x, y, heading, speed, acceleration = np.array(rows).T
    return Track("walker", Role.ADVERSARY, time, x, y, heading, speed, acceleration, state.length, state.width)


# ---- ways that lead back


def test_a_way_back_crosses_the_egos_path_twice_and_its_conflict_is_the_second_place() -> None:
    """From y = -4 to 2 m past the middle are 6 m. A half turn on foot takes 0.5 m; 2 m later it is in the middle."""
    back = [
        way for way in target_of(walker(-4.0, 0.0, 0.0)).ways if way.movement == "back" and way.conflict is not None
    ]
    assert len(back) == len(TURNS_BACK_M)
    way = back[TURNS_BACK_M.index(2.0)]
    assert way.turn == (6.0, 6.5) and way.conflict is not None
    assert way.conflict.bv_s == pytest.approx(8.5, abs=0.5)
    assert way.conflict.angle == pytest.approx(-NORTH, abs=0.01)  # southwards
    assert way.path.y.max() == pytest.approx(2.0)
    assert way.path.x[-1] == pytest.approx(60.0 + 2 * 0.5 / math.pi)  # to its right: east
    assert {round(float(w.path.x[-1]), 2) for w in back} == {59.68, 60.32, 59.36, 60.64}  # none lies on another


def test_further_ways_back_turn_round_before_that_and_come_last() -> None:
    """From y = -4 to 1 m before the middle are 3 m. Those at -3 and -2 m turn by 0.06 rad less than half round."""
    ways = target_of(walker(-4.0, 0.0, 0.0)).ways
    early = ways[-4:]
    assert [way.turn for way in early] == [(1.0, 1.5), (2.0, 2.5), (3.0, 3.5), (4.0, 4.5)]
    assert all(way.conflict is None and way.movement == "back" for way in early)
    assert [round(float(way.path.y.max()), 1) for way in early] == [-3.0, -2.0, -1.0, 0.0]
    leads = [math.cos(way.path.heading[-1] + NORTH) for way in early]
    assert leads == pytest.approx([math.cos(0.06), math.cos(0.06), math.cos(0.12), math.cos(0.12)])
    near = target_of(walker(-1.6, 0.0, 0.0)).ways
    assert [way.turn for way in near if way.conflict is None] == [(0.5, 1.0), (1.5, 2.0)]  # those still ahead


def test_one_that_never_crosses_the_egos_path_has_no_way_back() -> None:
    """A cyclist 4 m beside the ego's path whose only way leads along it."""
    state = walker(-4.0, 0.0, 4.0, BICYCLE)
    onward = [w for w in unprotected_ways(state, EGO_PATH) if w.movement == "along"]
    assert ways_back(state, onward, EGO_PATH) == ()


@pytest.mark.parametrize("where", [0.0, 1.0, 2.0, 3.0])
@pytest.mark.parametrize(("y", "heading", "speed"), [(-4.0, 0.0, 0.0), (-9.0, NORTH, 1.5)])
def test_a_pedestrian_turns_slower_than_half_a_metre_per_second_and_comes_back(
    y: float, heading: float, speed: float, where: float
) -> None:
    """It turns where it is told, breaks no gate, and is in the ego's path again about when the ego is (11 s)."""
    track = walked(walker(y, heading, speed), FOOT, pace=2.5, where=where)
    top = int(np.argmax(track.y))
    assert track.y[top] == pytest.approx(TURNS_BACK_M[int(where)] + 0.32 * (where >= 2), abs=0.05)
    turning = np.abs(motion(track).yaw_rate) > 0.5
    assert turning.any() and track.speed[turning].max() < 0.5
    again = track.time[top:][track.y[top:] < 0.0]
    assert 9.5 < again[0] < 14.0
    assert broken(track) == []


def test_one_that_has_no_time_to_go_there_and_back_stays_or_goes_on() -> None:
    """5 m past the middle are 9 m there and 5 m back: at 0.9 m/s 15.6 s, and the ego is there after 11 s."""
    stays, walks = (walked(walker(-4.0, 0.0, v), FOOT, pace=0.9, where=3.0) for v in (0.0, 1.4))
    assert np.ptp(stays.y) < 0.1 and broken(stays) == []
    assert walks.x[-1] == pytest.approx(60.0 + 1.4 * 14.0, abs=0.2) and np.ptp(walks.y) < 0.1


@pytest.mark.parametrize("where", [0.0, 1.0, 2.0, 3.0])
def test_a_cyclist_turns_with_a_radius(where: float) -> None:
    """Its radius is 15 or 17 steps of 0.5 m over pi: 2.39 m or 2.71 m, so it is at most 3.2 m/s fast in the turn."""
    track = walked(walker(-9.0, NORTH, 4.0, BICYCLE), BY_BICYCLE, pace=4.0, where=where)
    radius = (7.5 if where < 2 else 8.5) / math.pi
    assert track.y.max() == pytest.approx(TURNS_BACK_M[int(where)] + radius, abs=0.1)
    assert 1.0 / motion(track).curvature.max() == pytest.approx(radius, abs=0.2)
    assert broken(track) == []


def broken(track: Track) -> list[str]:
    """The gates on the motion itself that a walker breaks."""
    steps = kinematic_gates(track.boxes(), track.acceleration, track.time, UNPROTECTED_LIMITS[road_user(track)])
    return [gate for gate, bad in steps.items() if bad[1:].any()]


# ---- against the traffic


def test_the_intent_for_an_ego_that_turns_applies_where_the_egos_path_crosses_the_cyclists_way() -> None:
    """The cyclist rides west along y = -4. The ego turns south at x = 40, over that line; or it goes straight on."""
    state = walker(-4.0, math.pi, 4.0, BICYCLE)
    turning = relate(
        unprotected_ways(state, EGO_PATH)[0].path, "along", math.inf, False,
        replace(EGO_PATH, x=np.full(80, 40.0), y=20.0 - 0.5 * np.arange(80), heading=np.full(80, -NORTH)),
    )  # fmt: skip
    target = target_of(state)
    assert target.applies() == ("cyclist",)
    assert replace(target, ways=(turning, *target.ways)).applies() == ("cyclist", "cyclist_straight")


def test_no_gate_asks_which_way_a_cyclist_rides() -> None:
    """It rides west on the right side of a road for eastbound traffic, and also beside the road."""
    time = np.round(np.arange(0.0, 3.05, 0.1), 3)
    still = 0.0 * time
    for y in (-1.5, -5.0):
        rides = Track(
            "rider", Role.ADVERSARY, time, 60.0 - 4.0 * time, still + y, still + math.pi, still + 4.0, still, *BICYCLE
        )
        ego = Track("ego", Role.EGO, time, 10.0 * time, still + 3.0, still, still + 10.0, still, 5.0, 2.0)
        limits = UNPROTECTED_LIMITS[RoadUser.CYCLIST]
        assert failed_gates(rides, limits, on_road=lambda x, y: np.abs(y) < 3.2, ego=ego, others=(), end=3.0) == ()


# ---- in SUMO

SCENARIO = """schema = 1
network = "{network}"
{walkers}
[demand]
files = ["none.rou.xml"]

[ego]
route = {route}
depart = 0.0
position = {position}
speed = {speed}
type = "car"

[window]
warm_up = 2.0
trigger = 3.0

[adversary]
candidates = ["{adversary}"]
"""


def scenario(folder: Path, **values: object) -> Path:
    """A scenario with an ego of at most 12 m/s and no other vehicle."""
    folder.mkdir(parents=True, exist_ok=True)
    car = '<vType id="car" vClass="passenger" maxSpeed="12" length="5" width="1.8"/>'
    (folder / "none.rou.xml").write_text(f"<routes>{car}</routes>", encoding="utf-8")
    path = folder / "case.toml"
    path.write_text(SCENARIO.format(**values), encoding="utf-8")
    return path


def box(kind: str, x: float, y: float, heading: float, size: tuple[float, float], speed: float) -> str:
    place = f"x = {x}\ny = {y}\nheading = {heading}\n"
    return f"[[{kind}]]\n{place}length = {size[0]}\nwidth = {size[1]}\nspeed = {speed}\n"


def test_a_cyclist_on_the_wrong_side_meets_an_ego_that_turns_right(tmp_path: Path, caches: Path) -> None:
    """The cyclist rides west at y = -7.6, beside the eastbound lanes. The ego comes from the west and turns south."""
    case = scenario(
        tmp_path, network="priority_crossing", route='["west_in", "south_out"]', position=120.0, speed=11.0,
        adversary="cyclist0", walkers=box("cyclists", 39.0, -7.6, math.pi, BICYCLE, 4.0),
    )  # fmt: skip
    done = Program(tmp_path / "run", caches).here(
        "run", case, "--ego", "idm", "--intents", "Cyclist Rides On", "--until", "valid", "--attempts", "20", "--learn",
        "off", "--json", "--out", "out",
    )  # fmt: skip
    document = done.outcome
    assert document["ending"] == "critical", document["reason"]
    best = document["outcome"]
    assert best["collided"] and best["failed_gates"] == []
    attempt = next(a for a in document["attempts"] if a["level"] == best["level"])
    assert attempt["intent"] == "Cyclist Rides On" and "oncoming" in attempt["kind"]
    rows = list(read_states(done.folder / "states.csv.gz")["cyclist0"].values())
    assert {abs(round(float(row["heading"]), 1)) for row in rows} == {3.1}  # against the lanes all the time


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory, caches: Path) -> Done:
    """Two pedestrians cross the road, 4 m apart; the nearer one turns back."""
    folder = tmp_path_factory.mktemp("two")
    walkers = "".join(box("pedestrians", x, -8.6, 1.5708, PERSON, 1.39) for x in (160.0, 164.0))
    case = scenario(
        folder, network="two_way", route='["eastbound"]', position=60.0, speed=12.0, adversary="pedestrian0",
        walkers=walkers,
    )  # fmt: skip
    asked = '[asked]\nuser = "pedestrian"\nevents = ["crosses_from_right", "leaves", "crosses_from_left"]\n'
    with case.open("a", encoding="utf-8") as file:
        file.write(asked)
    return Program(folder / "run", caches).here(
        "run", case, "--ego", "idm", "--intents", FOOT, "--until", "collision", "--attempts", "60", "--learn", "off",
        "--json", "--out", "out",
    )  # fmt: skip


def test_one_of_two_pedestrians_turns_back_and_is_hit(two: Done) -> None:
    assert two.outcome["ending"] == "critical" and two.outcome["asked"]["fits"]
    assert two.outcome["outcome"]["failed_gates"] == []
    rows = list(read_states(two.folder / "states.csv.gz")["pedestrian0"].values())
    y = [float(row["y"]) for row in rows]
    assert max(y) > y[-1] + 0.5 and float(rows[-1]["heading"]) < 0.0  # it came back, southwards


def test_the_other_one_keeps_going_in_every_state(two: Done) -> None:
    """It walks north at 1.39 m/s from y = -8.6."""
    rows = read_states(two.folder / "states.csv.gz")["pedestrian1"]
    assert len(rows) > 50
    for time, row in rows.items():
        place = float(row["x"]), float(row["y"]), float(row["speed"])
        assert place == pytest.approx((164.0, -8.6 + 1.39 * float(time), 1.39), abs=0.01)


def test_sumos_drivers_brake_for_a_pedestrian_who_only_walks_through(two: Done) -> None:
    """The two are in the ego's lane from about 4 to 6.5 s."""
    with gzip.open(two.folder / "states.csv.gz", "rt", encoding="utf-8") as file:
        ego = [row for row in csv.DictReader(file) if row["id"] == "ego" and 3.5 < float(row["time"]) < 6.5]
    assert min(float(row["acceleration"]) for row in ego) < -0.3
