"""Scripts of pedestrians and cyclists: they go across the ego's way, stand there, go on, and turn back."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_samples import Program, read_states
from pydantic import ValidationError
from situation_samples import EGO_PATH, situation

from sumo_adv.datatypes import Proposal, Role, Track, VehicleState
from sumo_adv.episode.attempt import PlannedAdversary
from sumo_adv.episode.unprotected import unprotected_ways, ways_back
from sumo_adv.errors import UsageError
from sumo_adv.metrics.gates import kinematic_gates
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.script_checks import Walker, check_walker_script
from sumo_adv.planners.scripts import script_planner
from sumo_adv.planners.sessions import ask_trusted, is_trusted
from sumo_adv.planners.trial import trial
from sumo_adv.road_users import UNPROTECTED_LIMITS, RoadUser, road_user
from sumo_adv.script import Script
from sumo_adv.situation import Target

PERSON, BICYCLE = (0.5, 0.5), (1.8, 0.6)
NORTH = math.pi / 2
EGO_SPEED_M_S = 60.0 / 11.0  # it drives to the walker at x = 60 within 11 s, whatever happens


def script(*actions: Mapping[str, Any], applies: tuple[str, ...] = ("pedestrian",)) -> Script:
    return Script.model_validate({"applies": applies, "actions": actions})


def exact(value: float) -> dict[str, float]:
    """A number that is not tuned."""
    return {"default": value, "low": value, "high": value}


def at(value: float) -> dict[str, Any]:
    return {"kind": "time", "value": exact(value)}


def stands(y: float) -> VehicleState:
    """A pedestrian that stands at x = 60 beside the ego's way, y = 0."""
    return VehicleState("walker", 60.0, y, 0.0, 0.0, 0.0, *PERSON, "")


def moves(y: float, heading: float, speed: float, size: tuple[float, float] = PERSON) -> VehicleState:
    return replace(stands(y), heading=heading, speed=speed, length=size[0], width=size[1])


def played(state: VehicleState, *actions: Mapping[str, Any]) -> Track:
    """What a walker with a script does for 14 s; no gate on the motion itself is broken."""
    kind = road_user(state)
    planner = script_planner(script(*actions, applies=(str(kind),)))
    ways = unprotected_ways(state, EGO_PATH)
    target = Target(state, "crossing", (*ways, *ways_back(state, ways, EGO_PATH)), 0.0, 0.0, 0.0, ())
    k = np.arange(201.0)
    given = situation([target])
    ego = replace(given.baseline, s=0.1 * EGO_SPEED_M_S * k, v=0.0 * k + EGO_SPEED_M_S, a=0.0 * k)
    given = replace(given, baseline=ego)
    proposal = Proposal("walker", planner.label, planner, planner.defaults(), 0.0, 0.0)
    asked = ask_trusted(proposal, given, lambda _: "the planner failed")
    control = PlannedAdversary(given, "walker", UNPROTECTED_LIMITS[kind], asked)
    rows: list[tuple[float, ...]] = []
    for step in range(140):
        if step % 5 == 0:
            assert control.replan(0.1 * step, (0.1 * EGO_SPEED_M_S * step, 0.0, EGO_SPEED_M_S, 0.0)) is None
        there = control.advance()
        rows.append((0.1 * (step + 1), there.x, there.y, there.heading, there.speed, control.acceleration))
    time, x, y, heading, speed, acceleration = np.array(rows).T
    track = Track("walker", Role.ADVERSARY, time, x, y, heading, speed, acceleration, state.length, state.width)
    gates = kinematic_gates(track.boxes(), acceleration, time, UNPROTECTED_LIMITS[kind])
    assert [gate for gate, bad in gates.items() if bad[1:].any()] == []
    return track


def when(track: Track, y: float) -> float:
    """The first time at which the walker is north of ``y`` [s]."""
    return float(track.time[np.argmax(track.y >= y)])


def standing(track: Track) -> tuple[float, float]:
    """From when to when the walker stands after it has begun to go, and before it goes on or the end [s]."""
    still = track.speed < 0.3
    first = int(np.argmax(still & (track.time > 1.5)))
    onward = np.flatnonzero(~still[first:])
    return float(track.time[first]), float(track.time[first + onward[0] if len(onward) else -1])


# ---- short stories


def test_a_pedestrian_walks_half_across_waits_and_walks_on() -> None:
    """From y = -4 to 0 at 1.4 m/s are 2.9 s, and half a second each to set off and to stop. It waits for 1 s: its
    planner is asked every 0.5 s. It is 3 m farther after 2.1 s, and half a second to set off."""
    track = played(
        stands(-4.0),
        {"verb": "walk_to", "offset": 0},
        {"verb": "wait", "seconds": exact(1)},
        {"verb": "walk_to", "offset": exact(4)},
    )
    begins, ends = standing(track)
    assert 3.2 < begins < 4.2 and 1.0 <= ends - begins <= 1.8
    assert track.y[int(10 * begins)] == pytest.approx(0.0, abs=0.25)
    assert track.speed[10:25] == pytest.approx(1.4, abs=0.06)
    assert when(track, 3.0) == pytest.approx(ends + 3.0 / 1.4 + 0.3, abs=0.4)
    assert (track.y[-1], track.speed[-1]) == pytest.approx((4.0, 0.0), abs=0.1)
    assert track.x == pytest.approx(60.0, abs=0.01)


def test_a_pedestrian_stops_in_the_middle_and_goes_back() -> None:
    """It turns half round slower than 0.5 m/s, 0.5 m long: 1.1 s. It comes back on a way that leads a little aside."""
    track = played(
        stands(-4.0),
        {"verb": "walk_to", "offset": 0},
        {"verb": "turn_back"},
        {"verb": "walk_to", "offset": exact(-5), "speed": exact(2)},
    )
    assert track.y.max() == pytest.approx(0.0, abs=0.1)
    turning = np.abs(np.diff(np.unwrap(track.heading))) > 0.05
    assert turning.any() and track.speed[1:][turning].max() < 0.5
    assert track.heading[-1] == pytest.approx(-NORTH, abs=0.13)
    assert (track.y[-1], track.speed[-1]) == pytest.approx((-5.0, 0.0), abs=0.1)
    assert track.speed[int(10 * when(track, -0.2)) + 20 :].max() == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize(
    ("after", "turns"), [(1.0, -1.0), (2.0, 2.0)]
)  # after 1 s it is at -2.8 m and needs 1 m to stop; after 2 s at -0.4 m and needs 1.6 m
def test_a_pedestrian_that_runs_turns_back_at_the_next_place_at_which_it_can(after: float, turns: float) -> None:
    """At 2.5 m/s. The places are -3, -2, -1, 0, 0.5, 2, 3.5 and 5 m; from each on it turns. It runs back as fast."""
    track = played(
        stands(-4.0),
        {"verb": "walk_to", "offset": exact(6), "speed": exact(2.5)},
        {"verb": "turn_back", "when": at(after)},
    )
    assert track.y.max() == pytest.approx(turns, abs=0.1)
    assert track.speed[-1] == pytest.approx(2.5, abs=0.05) and track.y[-1] < -10.0


def test_a_pedestrian_hesitates_and_runs_on_without_an_end() -> None:
    """One that walks northwards stops for 1 s as soon as 2 s have passed, where it is, and then runs on."""
    track = played(
        moves(-8.0, NORTH, 1.4),
        {"verb": "wait", "seconds": exact(1), "when": at(2)},
        {"verb": "speed", "speed": exact(3)},
    )
    begins, ends = standing(track)
    assert 2.3 < begins < 3.0 and 1.0 <= ends - begins <= 1.8
    assert track.y[int(10 * begins)] == pytest.approx(-8.0 + 2.0 * 1.4 + 1.4**2 / 4.0, abs=0.25)  # stops with 2 m/s2
    assert track.speed[-30:] == pytest.approx(3.0, abs=0.05)


def test_two_walks_in_one_direction_are_one_walk_without_a_stop() -> None:
    track = played(
        stands(-4.0),
        {"verb": "walk_to", "offset": exact(-1)},
        {"verb": "walk_to", "offset": exact(3), "speed": exact(3)},
    )
    on_its_way = track.speed[(track.y > -3.0) & (track.y < 1.0)]
    assert on_its_way.min() > 1.2 and on_its_way.max() > 2.5
    assert track.y[-1] == pytest.approx(3.0, abs=0.05)


def test_one_that_walks_along_the_road_turns_across_it_at_a_time() -> None:
    """After 2.5 s at 1.4 m/s it is at x = 63.5; ways across turn at 1 m, and then every 1.4 m: at 63.8 m."""
    track = played(moves(-4.0, 0.0, 1.4), {"verb": "walk_to", "offset": exact(2), "when": at(2.5)})
    assert track.y[:25] == pytest.approx(-4.0, abs=0.05)
    assert track.x[-1] == pytest.approx(60.0 + 1.0 + 2 * 1.4 + 0.78, abs=0.2)  # and the radius, 1.4^2 / 2.5 m
    assert (track.y[-1], track.speed[-1]) == pytest.approx((2.0, 0.0), abs=0.05)


def test_a_cyclist_rides_across_stands_and_turns_back() -> None:
    """It begins the half turn at -1 m with a radius of 15 steps of 0.5 m over pi - 0.12."""
    track = played(
        moves(-9.0, NORTH, 4.0, BICYCLE),
        {"verb": "walk_to", "offset": exact(-1), "speed": exact(4)},
        {"verb": "wait", "seconds": exact(1)},
        {"verb": "turn_back"},
    )
    begins, ends = standing(track)
    assert 1.0 <= ends - begins <= 2.0 and track.y[int(10 * begins)] == pytest.approx(-1.1, abs=0.3)
    assert track.y.max() == pytest.approx(-1.0 + 7.5 / (math.pi - 0.12), abs=0.15)
    assert track.speed[-1] == pytest.approx(4.0, abs=0.1) and track.y[-1] < -8.0


def test_a_scenario_with_a_walkers_script_runs(tmp_path: Path, caches: Path) -> None:
    """The ego's lane has its middle at y = -1.6. The pedestrian at y = -6.4 walks 4.8 m, waits for 1 s in the ego's
    lane, and walks on to y = 4.4 m. It is just missed."""
    (tmp_path / "half.toml").write_text(
        'schema = 1\nnetwork = "two_way"\n'
        "pedestrians = [{ x = 240.0, y = -6.4, heading = 1.57, length = 0.5, width = 0.5 }]\n"
        '[ego]\nroute = ["eastbound"]\ndepart = 0.0\nposition = 100.0\nspeed = 11.0\n'
        "[window]\nwarm_up = 2.0\ntrigger = 3.0\nhorizon = 12.0\n"
        '[adversary]\ncandidates = ["pedestrian0"]\nintents = ["Script: walk to, wait, walk to"]\n'
        '[[scripts]]\napplies = ["pedestrian"]\nactions = [\n'
        '  { verb = "walk_to", offset = 0.0 }, { verb = "wait", seconds = { default = 1.0, low = 1.0, high = 1.0 } },\n'
        '  { verb = "walk_to", offset = { default = 6.0, low = 6.0, high = 6.0 } },\n]\n'
        '[asked]\nuser = "pedestrian"\nlevel = "near_miss"\n',
        encoding="utf-8",
    )
    done = Program(tmp_path, caches).here(
        "run", "half.toml", "--ego", "idm", "--attempts", "8", "--learn", "off", "--json", "--out", "out"
    )
    assert done.status in (0, 1), done.err
    attempt = done.outcome["attempts"][-1]
    assert attempt["intent"] == "Script: walk to, wait, walk to" and done.outcome["outcome"]["failed_gates"] == []
    rows = list(read_states(done.folder / "states.csv.gz")["pedestrian0"].values())
    time, y, speed = (np.array([float(row[key]) for row in rows]) for key in ("time", "y", "speed"))
    inside = np.flatnonzero((speed < 0.3) & (np.abs(y + 1.6) < 0.3))
    sets_off, stops, goes_on = time[np.argmax(speed > 0.0)], time[inside[0]], time[inside[-1]]
    assert 3.4 < stops - sets_off < 4.6  # 4.8 m at 1.4 m/s are 3.4 s, and it sets off and stops
    assert 0.8 <= goes_on - stops <= 1.8
    arrives = time[np.argmax(y > 3.5)]
    assert arrives - goes_on == pytest.approx(5.1 / 1.4 + 0.4, abs=0.5)  # and no stop until then
    assert y.max() == pytest.approx(4.4, abs=0.1)


# ---- a walker's script is an intent of its own kind


EVERYTHING = (
    {"verb": "walk_to", "offset": -1, "when": {"kind": "time_to_meet", "value": 5}},
    {"verb": "wait", "seconds": 1},
    {"verb": "speed", "speed": 2, "when": {"kind": "distance_to_ego", "value": 20}},
    {"verb": "turn_back", "when": {"kind": "ahead_of_ego", "value": 8}},
    {"verb": "walk_to", "offset": -4, "speed": 1},
)


@pytest.mark.parametrize(
    "relation", ["pedestrian", "pedestrian_hidden", "cyclist", "cyclist_straight", "cyclist_hidden"]
)
def test_it_passes_the_trial_and_is_trusted(sandbox: Sandbox, relation: str) -> None:
    p = script_planner(script(*EVERYTHING, applies=(relation,)))
    assert is_trusted(p) and trial(sandbox, p, [relation]) is None


def test_its_description_and_its_numbers() -> None:
    """A speed that is left out is 1.4 m/s on foot and 4 m/s by bicycle, and is not tuned."""
    there = {"verb": "walk_to", "offset": -1}
    walk, ride = (script(there, {"verb": "turn_back"}, applies=(kind,)) for kind in ("pedestrian", "cyclist"))
    assert walk.label == "Script: walk to, turn back"
    assert walk.description == (
        "The pedestrian goes to 1 m right of the middle of the ego's way at 1.4 m/s, then turns round and goes back."
    )
    assert "The cyclist goes" in ride.description and "at 4 m/s" in ride.description
    p = script_planner(walk)
    assert '("walk", "walk_to_1_offset", 1.4, "after", 0.0)' in p.text
    assert [(q.name, q.default, q.low, q.high, q.unit) for q in p.parameters] == [
        ("walk_to_1_offset", -1.0, -1.5, -0.6, "m")
    ]
    assert '("walk", "walk_to_1_offset", 4.0, "after", 0.0)' in script_planner(ride).text


@pytest.mark.parametrize(
    ("applies", "actions", "says"),
    [
        (("pedestrian", "leader"), [{"verb": "wait", "seconds": 1}], "it applies to one of them only"),
        (("pedestrian",), [{"verb": "brake", "rate": 4}], r"action 1 \(brake\) is for vehicles only: a pedestrian has"),
        (("leader",), [{"verb": "turn_back"}], r"action 1 \(turn_back\) is for pedestrians and cyclists only"),
        (("cyclist",), [{"verb": "speed", "speed": 3, "rate": 1}], r"action 1 \(speed\) of a cyclist takes no rate"),
        (("pedestrian",), [{"verb": "walk_to", "offset": 25}], "walk_to takes a offset of -20 to 20"),
        (("pedestrian",), [{"verb": "turn_back"}] * 2, "a script may have one turn_back"),
    ],
)
def test_a_script_of_the_wrong_kind_is_refused(applies: tuple[str, ...], actions: list[Any], says: str) -> None:
    with pytest.raises(ValidationError, match=says):
        script(*actions, applies=applies)


FOOT = Walker(RoadUser.PEDESTRIAN, 0.0, -4.0, True)
ALONG = Walker(RoadUser.CYCLIST, 4.0, -3.0, False)
MIDDLE = {"verb": "walk_to", "offset": 0}


@pytest.mark.parametrize(
    ("walker", "actions", "says"),
    [
        (FOOT, [{"verb": "walk_to", "offset": 0, "speed": 5}],
         "Action 1 of the script (walk_to) goes at 5 m/s, and a pedestrian can at 4 at most."),
        (FOOT, [{"verb": "walk_to", "offset": -6}],
         "Action 1 of the script (walk_to) leads to -6 m, which lies behind 'p' at -4 m: give turn_back before it."),
        (FOOT, [MIDDLE, {"verb": "turn_back"}, {"verb": "walk_to", "offset": 3}],
         "Action 3 of the script (walk_to) leads to 3 m, which lies behind 'p' at 0 m: it has turned back already."),
        (FOOT, [{"verb": "turn_back"}], "Action 1 of the script (turn_back) begins when 'p' has not gone yet"),
        (FOOT, [{"verb": "walk_to", "offset": 8}, {"verb": "turn_back"}],
         "Action 2 of the script (turn_back) begins when 'p' is at 8 m, and it can turn back from 3.5 m before the"),
        (FOOT, [{"verb": "walk_to", "offset": 10}, {"verb": "wait", "seconds": 1}],
         "Action 2 of the script (wait) begins after 10 s at the earliest"),  # 14 m at 1.4 m/s are 10.0 s
        (ALONG, [{**MIDDLE, "when": at(2)}, {"verb": "turn_back"}],
         "Action 2 of the script (turn_back) needs a way across from the beginning: let 'p' walk_to first, at once."),
    ],
)  # fmt: skip
def test_a_script_that_cannot_be_walked_is_one_sentence(walker: Walker, actions: list[Any], says: str) -> None:
    with pytest.raises(UsageError) as raised:
        check_walker_script(script(*actions, applies=(str(walker.user),)), "'p'", walker, 9.9)
    assert says in str(raised.value), raised.value


def test_a_script_that_can_be_walked_has_no_fault() -> None:
    actions = [MIDDLE, {"verb": "wait", "seconds": 1}, {"verb": "turn_back"}, {"verb": "walk_to", "offset": -4}]
    check_walker_script(script(*actions), "'p'", FOOT, 10.0)
    check_walker_script(script(*actions, applies=("cyclist",)), "'p'", replace_offset(ALONG), 10.0)


def replace_offset(walker: Walker) -> Walker:
    """The same rider on a lane, whose place beside the ego's way is unknown."""
    return walker._replace(offset=None)
