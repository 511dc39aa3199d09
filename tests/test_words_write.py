"""``write``: a model makes a scenario of words; it is built, runs, and is compared with the words."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from cli_samples import ROOT, Program
from model_server import Asked, ModelServer

from sumo_adv.memory.bank import MemoryBank

CUT_IN = "On the motorway a van squeezes in right in front of me from the left lane."
QUICK = ("--attempts", "40", "--seconds", "3600", "--memory", "bank.sqlite", "--out", "my.toml", "--run-out", "run")
HOLDS = {"part": "squeezes in from the left", "shown": "A comes from the left into EGO's way", "holds": True}
READ = {"happened": "A vehicle comes into the lane of EGO from the left and touches it.", "parts": [HOLDS]}


def cut_in(**changed: Any) -> dict[str, Any]:
    """A van 2 m ahead of the ego in the left lane of a motorway."""
    van = {"id": "van", "type": "van", "route": ["forward", "forward"], "lane": 1, "speed": 105, "gap": 2} | changed
    return {
        "understood": "A van changes from the left lane into the gap ahead of the ego.",
        "left_out": "", "cannot": "",
        "scene": {
            "road": {"kind": "straight", "lanes": 2, "lanes_back": 0, "speed_limit": 120, "length": 1500},
            "ego": {"route": ["forward", "forward"], "lane": 0, "speed": 100},
            "vehicles": [van],
            "attack": {
                "adversary": "van", "intents": ["Aggressive Cut-in", "Straight Lane Shift"],
                "asked": {"relation": "neighbour", "events": ["enters_from_left"]},
            },
        },
    }  # fmt: skip


def program(folder: Path, server: ModelServer | None = None) -> Program:
    made = Program(folder, folder)
    made.variables.update(server.environment() if server is not None else {})
    return made


def is_reader(request: Asked) -> bool:
    return request.system.startswith("You compare a recorded")


def test_words_become_a_scenario_that_runs_and_fits(tmp_path: Path) -> None:
    with ModelServer(lambda request: READ if is_reader(request) else cut_in()) as server:
        done = program(tmp_path, server).here("write", CUT_IN, "--llm", "gpt-test", *QUICK)
    assert done.status == 0, done.err
    built, happened, fits = done.out.strip().splitlines()
    assert built.startswith("Built: A van changes") and "my.toml" in built
    assert happened.startswith("Happened: level ") and READ["happened"] in happened
    assert fits == "Fits: yes, by the rules and to a reader."
    scenario = tomllib.loads((tmp_path / "my.toml").read_text())
    assert scenario["written"]["words"] == CUT_IN and scenario["written"]["model"] == "gpt-test"
    assert scenario["asked"] == {"relation": "neighbour", "events": ["enters_from_left"]}
    outcome = json.loads((tmp_path / "run" / "outcome.json").read_text())
    assert outcome["asked"]["fits"] and "from the left into EGO's way" in outcome["asked"]["motion"]
    assert [is_reader(request) for request in server.asked] == [False, True]
    assert "squeezes in" in server.asked[1].last and "neighbour" not in server.asked[1].last  # it sees no plan


NO_ANSWER = {"happened": "A vehicle comes over.", "parts": []}  # a reading needs a part of the request


@pytest.mark.parametrize(("most_calls", "readings"), [(20, 2), (1, 0)])
def test_what_ran_and_fits_is_kept_if_the_reader_fails(tmp_path: Path, most_calls: int, readings: int) -> None:
    """The reader gives no usable answer, twice; or the only call was that of the draft."""
    (tmp_path / "settings.toml").write_text(f"llm_max_calls = {most_calls}\n")
    with ModelServer(lambda request: NO_ANSWER if is_reader(request) else cut_in()) as server:
        more = ("--settings", "settings.toml")
        done = program(tmp_path, server).here("write", CUT_IN, "--llm", "gpt-test", *QUICK, *more)
    assert done.status == 0, done.err
    assert "Fits: yes, by the rules" in done.out and (tmp_path / "my.toml").is_file()
    assert [is_reader(request) for request in server.asked] == [False] + [True] * readings
    assert ("the rules alone decide, because the reader failed" in done.err) == (readings > 0)


def test_the_exact_error_goes_back_to_the_model(tmp_path: Path) -> None:
    drafts = iter([cut_in(route=["forward", "backwards"]), cut_in(gap=-90), cut_in()])
    with ModelServer(lambda request: READ if is_reader(request) else next(drafts)) as server:
        done = program(tmp_path, server).here("write", CUT_IN, "--llm", "gpt-test", *QUICK, "--json")
    assert done.status == 0, done.err
    faults = [request.last for request in server.asked if not is_reader(request)][1:]
    assert "There is no edge 'backwards' for 'van'; there are forward." in faults[0]
    assert json.loads(done.out)["fits"] is True
    assert len(faults) == 2 and "no vehicle near could endanger the ego" in faults[1]
    assert "the ego: van 8" in faults[1] and " m behind and 4 m to the left, at 29 m/s." in faults[1], faults[1]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("!!! 123", "The request holds no words"),
        ("ignore all " * 1000, "at most 6000 are read"),
    ],
)
def test_words_that_cannot_be_a_request_are_refused(tmp_path: Path, words: str, says: str) -> None:
    done = program(tmp_path).here("write", words, "--llm", "gpt-test", "--out", "my.toml")
    assert (done.status, says in done.err, len(done.err.splitlines())) == (2, True, 1)
    assert not (tmp_path / "my.toml").exists()


def test_what_no_road_can_hold_ends_in_a_sentence(tmp_path: Path) -> None:
    cannot = {"understood": "A plane.", "left_out": "", "cannot": "A plane that lands is no road user.", "scene": None}
    with ModelServer(lambda _: cannot) as server:
        done = program(tmp_path, server).here("write", "A plane lands on me.", "--llm", "gpt-test", *QUICK)
    assert done.status == 1
    assert done.err.strip() == ("sumo-adv: There is no scenario for these words: A plane that lands is no road user.")
    assert not (tmp_path / "my.toml").exists() and not (tmp_path / "run").exists()


def test_without_a_model_the_nearest_shipped_scenarios_are_named(tmp_path: Path) -> None:
    done = program(tmp_path).here("write", "A pedestrian runs out from behind a parked van.", "--out", "my.toml")
    assert done.status == 2
    assert "needs a language model" in done.err and "pedestrian_from_behind_parked" in done.err


def test_a_report_is_read_from_a_file_and_nothing_is_overwritten(tmp_path: Path) -> None:
    (tmp_path / "report.txt").write_text(CUT_IN)
    (tmp_path / "my.rou.xml").write_text("mine")
    (tmp_path / "my.add.xml").write_text("mine, and not a part of what was written")
    with ModelServer(lambda request: READ if is_reader(request) else cut_in()) as server:
        run = program(tmp_path, server)
        taken = run.here("write", "--report", "report.txt", "--llm", "gpt-test", *QUICK)
        assert (taken.status, "my.rou.xml already exists" in taken.err, server.asked) == (2, True, [])
        both = run.here("write", CUT_IN, "--report", "report.txt", "--llm", "gpt-test", *QUICK)
        assert both.status == 2 and "not both" in both.err
        missing = run.here("write", "--report", "none.txt", "--llm", "gpt-test", *QUICK)
        assert missing.status == 2 and "The report none.txt cannot be read" in missing.err
        done = run.here("write", "--report", "report.txt", "--llm", "gpt-test", *QUICK, "--force")
    assert done.status == 0, done.err
    assert tomllib.loads((tmp_path / "my.toml").read_text())["written"]["words"] == CUT_IN
    assert "<routes" in (tmp_path / "my.rou.xml").read_text()
    assert (tmp_path / "my.add.xml").read_text().startswith("mine")


def test_force_replaces_what_was_written_and_no_file_that_is_given(tmp_path: Path) -> None:
    """The first scenario has a road of its own in my.net.xml. The second one has the user's road."""
    on_my_road = cut_in()
    on_my_road["scene"]["road"] = {"kind": "given"}
    drafts = iter([cut_in(), on_my_road])
    with ModelServer(lambda request: READ if is_reader(request) else next(drafts)) as server:
        run = program(tmp_path, server)
        assert run.here("write", CUT_IN, "--llm", "gpt-test", *QUICK).status == 0
        road = (tmp_path / "my.net.xml").read_bytes()
        (tmp_path / "town.net.xml").write_bytes(road)
        (tmp_path / "town.txt").write_text(CUT_IN)
        (tmp_path / "town.rou.xml").hardlink_to(tmp_path / "town.txt")
        asked = len(server.asked)
        options = ("--llm", "gpt-test", "--out", "town.toml", "--run-out", "run", "--force")
        for given in ((CUT_IN, "--network", "town.net.xml"), ("--report", "town.txt")):
            done = run.here("write", *given, *options)
            assert done.status == 2 and "which you gave as an input; give another --out." in done.err, done.err
        assert len(server.asked) == asked and (tmp_path / "town.net.xml").read_bytes() == road
        done = run.here("write", CUT_IN, "--network", "town.net.xml", "--llm", "gpt-test", *QUICK, "--force")
    assert done.status == 0, done.err
    assert not (tmp_path / "my.net.xml").exists() and (tmp_path / "town.net.xml").read_bytes() == road


def test_the_scenario_asks_for_its_attack_again(tmp_path: Path) -> None:
    """Without a model: the rules in the file decide, and its level is the goal."""
    with ModelServer(lambda request: READ if is_reader(request) else cut_in()) as server:
        run = program(tmp_path, server)
        assert run.here("write", CUT_IN, "--llm", "gpt-test", *QUICK).status == 0
        questions = len(server.asked)
        text = (tmp_path / "my.toml").read_text()
        (tmp_path / "my.toml").write_text(text.replace("[asked]", '[asked]\nlevel = "near_miss"'))
        done = run.here(
            "run", "my.toml", "--learn", "off", "--attempts", "40", "--seconds", "3600", "--out", "out", "--json"
        )
        repeated = run.here("run", "--replay", "out", "--out", "again", "--json")
    assert done.status == 0 and len(server.asked) == questions
    assert done.outcome["goal"] == "near miss with a min TTC of 0.2 to 1.5 s"
    assert done.outcome["ending"] == "critical" and done.outcome["asked"]["fits"]
    again = json.loads((tmp_path / "again" / "outcome.json").read_text())
    assert repeated.status == 0 and again["asked"]["motion"] == done.outcome["asked"]["motion"]
    assert again["asked"]["fits"]


def test_a_behaviour_that_no_intent_has_gets_a_planner_which_enters_the_bank(tmp_path: Path) -> None:
    """The model's first planner has a fault, which goes back to it; the second one is that of a known cut-in."""
    novel = {
        "label": "Swerving Squeeze", "applies": ["neighbour"],
        "description": "It drives beside the ego, swerves away from it, and then squeezes into the lane before it.",
    }  # fmt: skip
    draft = cut_in()
    draft["scene"]["attack"] |= {"intents": [], "novel": novel}
    with MemoryBank.open(ROOT / "memory_bank.sqlite", read_only=True) as shipped:
        good = next(p.text for p in shipped.planners("Aggressive Cut-in") if p.mode == "side")
    planners = iter(["PARAMETERS = {}\n", good])

    def script(request: Asked) -> dict[str, Any]:
        if request.system.startswith("You write planners"):
            return {"mode": "direct", "source": next(planners)}
        return READ if is_reader(request) else draft

    with ModelServer(script) as server:
        done = program(tmp_path, server).here("write", CUT_IN, "--llm", "gpt-test", *QUICK)
    assert done.status == 0, done.err
    assert "a planner for 'Swerving Squeeze' is written." in done.err
    outcome = json.loads((tmp_path / "run" / "outcome.json").read_text())
    assert {attempt["intent"] for attempt in outcome["attempts"]} == {"Swerving Squeeze"} and outcome["asked"]["fits"]
    assert "squeezes into the lane" in server.asked[1].last  # the description is what the planner is written from
    assert tomllib.loads((tmp_path / "my.toml").read_text())["adversary"]["intents"] == ["Swerving Squeeze"]
    with MemoryBank.open(tmp_path / "bank.sqlite", read_only=True) as bank:
        record = bank.intent("Swerving Squeeze")
        assert record is not None and record.description == novel["description"]
        assert [planner.origin for planner in bank.planners(record.label)] == ["gpt-test"]


def test_a_novel_behaviour_that_is_known_goes_back_to_the_model(tmp_path: Path) -> None:
    known = cut_in()
    known["scene"]["attack"]["novel"] = {
        "label": "Aggressive cut-in", "applies": ["neighbour"], "description": "It cuts in before the ego, very near."
    }  # fmt: skip
    drafts = iter([known, cut_in()])
    with ModelServer(lambda request: READ if is_reader(request) else next(drafts)) as server:
        done = program(tmp_path, server).here("write", CUT_IN, "--llm", "gpt-test", *QUICK)
    assert done.status == 0, done.err
    assert "'Aggressive cut-in' is an intent of the list" in server.asked[1].last


def test_a_script_is_played_and_enters_the_bank_without_a_planner_of_the_model(tmp_path: Path) -> None:
    """The first draft changes to a lane that is not there; the second brakes and changes to the ego's."""
    soon = {"kind": "time", "value": {"default": 1, "low": 0, "high": 3}}
    actions = [
        {"verb": "brake", "rate": 4, "speed": {"default": 24, "low": 18, "high": 27}},
        {"verb": "lane_change", "side": "right", "when": soon},
    ]
    draft, wrong = cut_in(), cut_in()
    draft["scene"]["attack"] |= {"intents": [], "script": {"applies": ["neighbour"], "actions": actions}}
    draft["scene"]["attack"]["asked"]["level"] = "near_miss"
    left = [{"verb": "lane_change", "side": "left"}]
    wrong["scene"]["attack"] |= {"intents": [], "script": {"applies": ["neighbour"], "actions": left}}
    drafts = iter([wrong, draft])
    with ModelServer(lambda request: READ if is_reader(request) else next(drafts)) as server:
        done = program(tmp_path, server).here("write", CUT_IN, "--llm", "gpt-test", *QUICK)
    assert done.status == 0, done.err
    assert "Action 1 of the script (lane_change) has no lane to its left" in server.asked[1].last
    label = "Script: brake, lane change right"
    outcome = json.loads((tmp_path / "run" / "outcome.json").read_text())
    assert {attempt["intent"] for attempt in outcome["attempts"]} == {label} and outcome["asked"]["fits"]
    assert tomllib.loads((tmp_path / "my.toml").read_text())["adversary"]["intents"] == [label]
    with MemoryBank.open(tmp_path / "bank.sqlite", read_only=True) as bank:
        record = bank.intent(label)
        assert record is not None and record.applies == ("neighbour",)
        assert [planner.origin for planner in bank.planners(label)] == ["script"]
