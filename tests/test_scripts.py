"""Scripts: a list of actions becomes a planner that remembers where it is, and a scenario file with one runs."""

from __future__ import annotations

import csv
import gzip
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from cli_samples import ROOT, Program
from pydantic import ValidationError
from situation_samples import leader, situation

from sumo_adv.datatypes import Limits, Planner, Proposal
from sumo_adv.errors import PlannerResultError
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.records import RELATIONS
from sumo_adv.planners.answers import Answer, world_endpoint
from sumo_adv.planners.results import check_endpoint, notes_of
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.scripts import script_planner
from sumo_adv.planners.sessions import InProcessSession, Roads, is_trusted, road_key
from sumo_adv.planners.text import make_planner
from sumo_adv.planners.trial import TRIAL_HORIZON_S, Probe, probes, trial
from sumo_adv.script import Action, Script
from sumo_adv.search.rollouts import predict
from sumo_adv.simulation.inputs import load_input

AHEAD = probes("leader")[6]  # 18 m ahead of the ego at y = 0, at 25 m/s; the ego drives 24 m/s
BESIDE = probes("neighbour")[6]  # the same 4 m ahead and in the lane on the left, at y = 3.2
CROSSES = next(p for p in probes("crossing_straight") if p.bv["travelled"] == 0.0)  # 40 m before the conflict, 7 m/s
LABEL = "Script: brake, speed, brake"


def script(*actions: Mapping[str, Any], applies: tuple[str, ...] = ("leader",)) -> Script:
    return Script.model_validate({"applies": applies, "actions": actions})


def exact(value: float) -> dict[str, float]:
    """A number that is not tuned."""
    return {"default": value, "low": value, "high": value}


TWICE = script(
    {"verb": "brake", "rate": exact(5), "speed": exact(15)},
    {"verb": "speed", "speed": exact(20)},  # with 2 m/s2
    {"verb": "brake", "rate": exact(6)},
)


def answer(
    sandbox: Sandbox, planner: Planner, probe: Probe, changes: Mapping[str, Any], ego: Mapping[str, Any] | None = None
) -> dict[str, float]:
    with sandbox.session(planner, {"here": probe.road}) as session:
        return session.endpoint(
            "here", {**probe.bv, **changes}, {**probe.ego, **(ego or {})}, planner.defaults(), 0.0, TRIAL_HORIZON_S
        )


def at_action(number: int, since: float, stands: float = 0.0) -> dict[str, float]:
    """The last endpoint of a script whose action of this number began then."""
    last = {"x": 0.0, "y": 0.0, "heading": 0.0, "speed": 9.0, "time": 1.5}
    return {**last, "note_action": float(number), "note_since": since, "note_stands": stands}


# ---- the first story: it brakes, drives on, and brakes again


def test_it_brakes_drives_on_and_brakes_again(sandbox: Sandbox) -> None:
    """It looks 1.5 s ahead: 25 - 1.5 * 5, 15.2 + 1.5 * 2 and 19.8 - 1.5 * 6 m/s."""
    p = script_planner(TWICE)
    first = answer(sandbox, p, AHEAD, {})
    assert (first["speed"], first["time"], first["y"]) == pytest.approx((17.5, 1.5, 0.0))
    assert first["x"] == pytest.approx(18.0 + (25.0 + 17.5) / 2 * 1.5)
    assert notes_of(first) == {"note_action": 0.0, "note_since": 0.0, "note_stands": 0.0}
    still = answer(sandbox, p, AHEAD, {"time": 1.5, "speed": 17.0, "last": at_action(0, 0.0)})
    assert (still["note_action"], still["speed"]) == pytest.approx((0.0, 15.0))  # not below 15 m/s
    second = answer(sandbox, p, AHEAD, {"time": 2.0, "speed": 15.2, "last": at_action(0, 0.0)})
    assert (second["note_action"], second["note_since"], second["speed"]) == pytest.approx((1.0, 2.0, 18.2))
    third = answer(sandbox, p, AHEAD, {"time": 5.0, "speed": 19.8, "last": at_action(1, 2.0)})
    assert (third["note_action"], third["note_since"], third["speed"]) == pytest.approx((2.0, 5.0, 10.8))


def test_a_prediction_carries_the_notes_on() -> None:
    """At 10 m/s: 2 s of braking with 2.5 m/s2 to 5 m/s, then up to 8 m/s, then to a stand. Without notes it would begin
    again and again, and stay at 5 m/s."""
    planner = script_planner(
        script(
            {"verb": "brake", "rate": exact(2.5), "speed": exact(5)},
            {"verb": "speed", "speed": exact(8)},
            {"verb": "brake", "rate": exact(3)},
        )
    )
    here = situation([leader(gap=60.0, speed=10.0)])
    candidate = Proposal("bv", planner.label, planner, planner.defaults(), 0.0, 0.0)
    roads = Roads({0.0: here}).of([candidate])
    session = InProcessSession(planner, roads, lambda: pytest.fail("it is trusted"))

    def ask(rows: Any, observations: Any) -> list[Answer]:
        end = session.endpoint(road_key(candidate), *observations[0], candidate.parameters, 0.0, 8.0)
        return [Answer(world_endpoint(here, end), notes=notes_of(end))]

    speed = predict({0.0: here}, [candidate], ask, limits=Limits(), steps=100, replan=5).adversary[3][0]
    low = int(speed[:35].argmin())
    assert speed[low] == pytest.approx(5.0, abs=0.6) and 1.5 <= low * 0.1 <= 3.5
    assert speed[low:].max() == pytest.approx(8.0, abs=0.8)
    assert speed[-1] == pytest.approx(0.0, abs=0.1)


def test_a_scenario_with_a_script_runs_without_a_model_and_enters_the_bank(tmp_path: Path) -> None:
    shipped = (ROOT / "scenarios" / "leader_brakes_hard.toml").read_text(encoding="utf-8")
    demand = ROOT / "scenarios" / "demand" / "leader_brakes_hard.rou.xml"
    text = shipped[: shipped.index("[adversary]")].replace("../networks/two_way.net.xml", "two_way")
    text = text.replace("demand/leader_brakes_hard.rou.xml", str(demand)) + (
        f'[adversary]\ncandidates = ["leader"]\nintents = ["{LABEL}"]\n\n'
        '[[scripts]]\napplies = ["leader"]\nactions = [\n'
        '  { verb = "brake", rate = 4.0, speed = 14.0 }, { verb = "speed", speed = 17.0 },\n'
        '  { verb = "brake", rate = { default = 6.0, low = 4.0, high = 8.0 } },\n]\n\n'
        '[asked]\nevents = ["brakes", "speeds_up", "brakes"]\n'
    )
    (tmp_path / "twice.toml").write_text(text, encoding="utf-8")
    (script,) = load_input(tmp_path / "twice.toml").scripts
    run = Program(tmp_path, tmp_path)
    done = run.here(
        "run", "twice.toml", "--memory", "bank.sqlite", "--attempts", "20", "--seconds", "900", "--json", "--out", "out"
    )  # fmt: skip
    assert done.status == 0, done.err
    assert done.outcome["asked"]["fits"] and done.outcome["asked"]["misfits"] == []
    assert {attempt["intent"] for attempt in done.outcome["attempts"]} == {LABEL}
    table = csv.DictReader(io.StringIO(gzip.decompress((tmp_path / "out" / "states.csv.gz").read_bytes()).decode()))
    speeds = [float(row["speed"]) for row in table if row["id"] == "leader" and float(row["time"]) >= 5.0]
    low = min(range(30), key=lambda k: speeds[k])  # within 3 s
    assert speeds[low] < 16.0 and max(speeds[low:]) > speeds[low] + 2.0 and speeds[-1] < 1.0
    with MemoryBank.open(tmp_path / "bank.sqlite", read_only=True) as bank:
        record = bank.intent(LABEL)
        assert record is not None and record.applies == ("leader",) and record.description == script.description
        assert [p.hash for p in bank.planners(LABEL)] == [script_planner(script).hash]


# ---- the other verbs and conditions


def test_it_stands_for_a_while_and_drives_on(sandbox: Sandbox) -> None:
    """It has stood since 3.0 s: at 4.9 s not for 2 s, at 5.0 s it drives on, up to 4.5 m/s 1.5 s later."""
    p = script_planner(
        script({"verb": "stop_for", "seconds": exact(2)}, {"verb": "speed", "speed": 9, "rate": exact(3)})
    )
    brakes = answer(sandbox, p, AHEAD, {"time": 1.0, "speed": 9.0, "last": at_action(0, 0.0)})
    assert brakes["speed"] == pytest.approx(4.5)  # with 3 m/s2
    stands = answer(sandbox, p, AHEAD, {"time": 4.9, "speed": 0.0, "last": at_action(0, 0.0, 3.0)})
    assert (stands["speed"], stands["note_action"], stands["note_stands"]) == (0.0, 0.0, 3.0)
    drives = answer(sandbox, p, AHEAD, {"time": 5.0, "speed": 0.0, "last": at_action(0, 0.0, 3.0)})
    assert (drives["speed"], drives["note_action"]) == (4.5, 1.0)


def test_it_changes_lanes_and_moves_in_its_lane_while_it_brakes(sandbox: Sandbox) -> None:
    p = script_planner(
        script(
            {"verb": "lane_change", "side": "right", "seconds": exact(5)},
            {"verb": "brake", "rate": exact(4), "when": {"kind": "time", "value": exact(1)}},
            {"verb": "lateral_offset", "offset": exact(-0.5)},
            applies=("neighbour",),
        )
    )
    first = answer(sandbox, p, BESIDE, {})
    assert (first["y"], first["time"], first["speed"]) == pytest.approx((0.0, 5.0, 25.0))
    moved = {"time": 1.0, "offset": -0.5, "lateral_time": 4.0, "last": at_action(0, 0.0)}
    both = answer(sandbox, p, BESIDE, moved)
    assert (both["y"], both["time"], both["speed"], both["note_action"]) == pytest.approx((0.0, 1.5, 19.0, 1.0))
    stands = {"time": 8.0, "offset": -3.2, "speed": 0.0, "last": at_action(1, 1.0)}
    aside = answer(sandbox, p, BESIDE, stands)
    assert (aside["y"], aside["time"], aside["note_action"]) == pytest.approx((-0.5, 3.0, 2.0))


@pytest.mark.parametrize(
    ("when", "changes", "ego", "begins"),
    [
        ({"kind": "distance_to_ego", "value": exact(13.1)}, {}, {}, True),  # 18 m less two halves of 5 m
        ({"kind": "distance_to_ego", "value": exact(12.9)}, {}, {}, False),
        ({"kind": "distance_to_ego", "value": exact(12.9), "rule": "above"}, {}, {}, True),
        ({"kind": "ahead_of_ego", "value": exact(-4), "rule": "above"}, {"ahead": 2.0}, {}, True),  # 3 m behind
        ({"kind": "ahead_of_ego", "value": exact(-2), "rule": "above"}, {"ahead": 2.0}, {}, False),
        ({"kind": "time", "value": exact(2)}, {"time": 2.0}, {}, True),
        ({"kind": "time", "value": exact(2)}, {"time": 1.9}, {}, False),
        ({"kind": "time_to_meet", "value": exact(2.7)}, {"speed_along": 19.0}, {}, True),  # 13 m at 5 m/s: 2.6 s
        ({"kind": "time_to_meet", "value": exact(2.5)}, {"speed_along": 19.0}, {}, False),
        ({"kind": "time_to_meet", "value": exact(2.5), "rule": "above"}, {}, {}, True),  # it gets away
        ({"kind": "after"}, {}, {}, True),
    ],
)
def test_an_action_begins_with_its_condition(
    sandbox: Sandbox, when: Mapping[str, Any], changes: Mapping[str, Any], ego: Mapping[str, Any], begins: bool
) -> None:
    end = answer(
        sandbox, script_planner(script({"verb": "brake", "rate": exact(4), "when": when})), AHEAD, changes, ego
    )
    assert end["note_action"] == (0.0 if begins else -1.0)
    assert end["speed"] == pytest.approx(19.0 if begins else 25.0)


def test_a_crossing_vehicle_begins_when_the_ego_is_near_where_they_meet(sandbox: Sandbox) -> None:
    when = {"kind": "time_to_meet", "value": exact(2)}
    p = script_planner(script({"verb": "brake", "rate": exact(4), "when": when}, applies=("crossing_straight",)))
    early, late, over = (answer(sandbox, p, CROSSES, {}, {"arrivals": [t]}) for t in (2.1, 1.9, -0.1))
    assert [end["note_action"] for end in (early, late, over)] == [-1.0, 0.0, -1.0]


def test_a_turn_takes_the_way_of_its_side() -> None:
    assert '("turn", 1.0, 0.0, "after", 0.0)' in script_planner(script({"verb": "turn", "side": "left"})).text
    assert '("turn", -1.0, 0.0, "after", 0.0)' in script_planner(script({"verb": "turn", "side": "right"})).text


# ---- a script is an intent, and its planner a shipped text


EVERYTHING = script(
    {"verb": "speed", "speed": 9, "when": {"kind": "time", "value": 1}},
    {"verb": "lane_change", "side": "left", "when": {"kind": "time_to_meet", "value": 4}},
    {"verb": "lateral_offset", "offset": -0.6, "when": {"kind": "distance_to_ego", "value": 20}},
    {"verb": "wait", "seconds": exact(1)},
    {"verb": "turn", "side": "left", "when": {"kind": "ahead_of_ego", "value": 2, "rule": "above"}},
    {"verb": "stop_for", "seconds": exact(1)},
    {"verb": "brake", "rate": 4},
)


def test_its_label_and_description_are_made_of_its_actions() -> None:
    assert TWICE.label == LABEL
    assert TWICE.description == (
        "The vehicle brakes with 5 m/s2 to 15 m/s, then drives on at 20 m/s, then brakes with 6 m/s2 to a stand."
    )
    assert EVERYTHING.label == "Script: speed, lane change left, lateral offset, wait, turn left, stop for, brake"
    assert "moves 0.6 m to the right in its lane when the ego is nearer than 20 m" in EVERYTHING.description


def test_numbers_are_tuned_unless_they_are_exact_or_zero() -> None:
    p = script_planner(script({"verb": "brake", "rate": 4, "speed": 0}, {"verb": "lateral_offset", "offset": -1}))
    assert {q.name: (q.default, q.low, q.high, q.unit) for q in p.parameters} == {
        "brake_1_rate": (4.0, 2.4, 6.0, "m/s2"), "lateral_offset_2_offset": (-1.0, -1.5, -0.6, "m"),
    }  # fmt: skip
    assert script_planner(TWICE).parameters == ()


@pytest.mark.parametrize("relation", RELATIONS)
def test_it_passes_the_trial_and_is_trusted(sandbox: Sandbox, relation: str) -> None:
    p = script_planner(EVERYTHING)
    assert is_trusted(p) and trial(sandbox, p, [relation]) is None


@pytest.mark.parametrize(
    "row", ['("speed", open("x"), 2.0, "after", 0.0),', "(print, 1.0, 2.0, 3.0, 4.0),", '("wait", 1.0, 0.0),']
)
def test_a_table_with_anything_but_words_and_numbers_is_not_trusted(row: str) -> None:
    text = script_planner(TWICE).text.replace('("speed", 20.0, 2.0, "after", 0.0),', row)
    assert row in text and not is_trusted(make_planner("Any", "any", text, "somebody"))


@pytest.mark.parametrize(
    ("action", "says"),
    [
        ({"verb": "brake"}, "the action brake needs rate"),
        ({"verb": "brake", "rate": 4, "seconds": 2}, "the action brake takes no seconds"),
        ({"verb": "brake", "rate": 9}, "the action brake takes a rate of 0.2 to 8"),
        ({"verb": "lane_change"}, "the action lane_change needs side"),
        ({"verb": "speed", "speed": {"default": 9, "low": 10, "high": 12}}, "low <= default <= high"),
        ({"verb": "wait", "seconds": 1, "when": {"kind": "time"}}, "the condition time needs a value"),
        ({"verb": "wait", "seconds": 1, "when": {"kind": "after", "value": 1}}, "the condition after takes no value"),
        ({"verb": "wait", "seconds": 1, "when": {"kind": "time", "value": -1}}, "takes a value of 0 to 300"),
        ({"verb": "fly"}, "Input should be 'speed', 'brake'"),
    ],
)
def test_an_action_with_a_fault_is_refused(action: Mapping[str, Any], says: str) -> None:
    with pytest.raises(ValidationError, match=says.replace("<", r"\<")):
        Action.model_validate(action)


def test_a_script_has_at_most_twelve_numbers_to_tune_and_one_turn() -> None:
    with pytest.raises(ValidationError, match="may have 12 numbers to tune, and this one has 14"):
        script(*[{"verb": "speed", "speed": 9, "rate": 1}] * 7)
    with pytest.raises(ValidationError, match="may have one turn"):
        script({"verb": "turn", "side": "left"}, {"verb": "turn", "side": "left"})


# ---- notes


FIVE = (1.0, 2.0, 0.5, 3.0, 1.5)


def test_a_planner_gets_its_notes_back(sandbox: Sandbox) -> None:
    text = (
        "PARAMETERS = {}\n\n\ndef endpoint(bv, ego, road, parameters, acc, horizon):\n"
        '    count = bv["last"]["note_count"] + 1 if bv["last"] is not None else 1\n'
        '    return {"x": 1.0, "y": 0.0, "heading": 0.0, "speed": 3.0, "time": 1.0, "note_count": count}\n'
    )
    p = make_planner("Any", "any", text, "somebody")
    assert answer(sandbox, p, AHEAD, {"last": None})["note_count"] == 1.0
    assert answer(sandbox, p, AHEAD, {"last": {"note_count": 1.0}})["note_count"] == 2.0


@pytest.mark.parametrize(
    ("notes", "says"),
    [
        ((("note_a", float("nan")),), "note_a must be a number within"),
        ((("other", 1.0),), "further keys are note_"),
        ((("note_a", "x"),), "note_a must be a number"),
        (((1, 2.0),), "not what a planner may return"),
        ((("note_a", 1.0),) * 5, "not what a planner may return"),
    ],
)
def test_notes_are_checked_in_this_process_too(notes: Any, says: str) -> None:
    assert check_endpoint("Planner", (*FIVE, (("note_a", 1),)))["note_a"] == 1.0
    with pytest.raises(PlannerResultError, match=says):
        check_endpoint("Planner", (*FIVE, notes))
