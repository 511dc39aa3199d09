"""Schemas in which vehicles, behaviours and modes are enums, as the grammar of a model's server needs them."""

from __future__ import annotations

from typing import Any

from model_server import ModelServer, Say, StepClock
from test_prompts import LIMITS, SHIFT
from test_teams import SCENE

from sumo_adv.agents.analyzer import Analysis, ModelAnalyzer, Same, TeamAnalysis
from sumo_adv.agents.choices import analysis_schema, change_schema, same_schema
from sumo_adv.agents.modifier import Changed
from sumo_adv.agents.teams import Teamwork
from sumo_adv.datatypes import LibraryEntry
from sumo_adv.llm.asking import MeteredModel
from sumo_adv.llm.chat import Ledger
from sumo_adv.llm.client import open_model
from sumo_adv.llm.prompts import Prompts
from sumo_adv.simulation.inputs import data_folder

BRAKE = LibraryEntry("Brake", "It brakes.", ("leader",), ())
LABELS, MODES = ["Straight Lane Shift", "Brake"], list(dict.fromkeys(p.mode for p in SHIFT.planners))


def enums(schema: dict[str, Any], owner: str) -> dict[str, Any]:
    """The enums of a class by property."""
    return {k: v["enum"] for k, v in schema["$defs"][owner]["properties"].items() if "enum" in v}


def test_a_known_intent_is_one_of_the_library_and_a_new_one_has_any_label() -> None:
    schema = analysis_schema(Analysis, ["BV1", "BV2"], [SHIFT, BRAKE], novel=True)
    known = enums(schema, "Choice")
    assert (known["bv"], known["label"], known["novel"]) == (["BV1", "BV2"], LABELS, [False])
    assert enums(schema, "HowTo") == {"mode": MODES}
    new = enums(schema, "NovelChoice")
    assert (new["bv"], new["novel"], "label" in new) == (["BV1", "BV2"], [True], False)
    either = schema["properties"]["intents"]["items"]["anyOf"]
    assert either == [{"$ref": "#/$defs/Choice"}, {"$ref": "#/$defs/NovelChoice"}]
    assert "NovelChoice" not in analysis_schema(Analysis, ["BV1"], [SHIFT], novel=False)["$defs"]


def test_the_parts_of_a_composition_are_enums_too() -> None:
    schema = analysis_schema(TeamAnalysis, ["BV1", "BV2"], [SHIFT], Teamwork(2), ["BV2"], novel=False)
    member = enums(schema, "Member")
    assert enums(schema, "Choice")["bv"] == ["BV2"] and member["bv"] == ["BV1", "BV2"]
    assert member["role"][0] == "collider" and "block_left" in member["role"]
    assert member["label"][0] == "Straight Lane Shift" and len(member["label"]) > 1


def test_what_may_be_null_stays_so_and_what_has_no_values_is_left() -> None:
    same = same_schema(Same, [SHIFT])["properties"]["same_as"]
    assert same == {"anyOf": [{"type": "string", "enum": ["Straight Lane Shift"]}, {"type": "null"}]}
    changed = change_schema(Changed, {"BV1": (SHIFT,), "BV2": ()})
    assert enums(changed, "Instead") == {"mode": MODES, "bv": ["BV1", "BV2"], "label": ["Straight Lane Shift"]}
    assert "enum" not in same_schema(Same, [BRAKE])["$defs"]["HowTo"]["properties"]["mode"]


def test_a_server_gets_the_enums_of_the_scene() -> None:
    answer = {"intents": [{"bv": "BV1", "label": "Straight Lane Shift", "risk": "high"}]}
    ledger = Ledger()
    with ModelServer([Say(answer)]) as server:
        model = open_model("test-model", server.settings(), ledger, clock=StepClock())
        analyzer = ModelAnalyzer(MeteredModel(model, ledger), Prompts(data_folder("prompts")), LIMITS)
        assert [intent.bv for intent in analyzer.analyze({0.0: SCENE}, [SHIFT])] == ["right"]
    sent = server.asked[0].body["response_format"]["json_schema"]["schema"]
    assert enums(sent, "Choice")["bv"] == ["BV1", "BV2"]
    assert enums(sent, "Choice")["label"] == ["Straight Lane Shift"]
