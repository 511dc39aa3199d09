"""Compositions that a language model proposes: asked for, checked, looked up in the bank, and tried."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from cli_samples import Program
from model_samples import Answers
from model_server import Asked, ModelServer
from scripted_models import intent
from situation_samples import EGO_PATH, car, line, situation, target

from sumo_adv.agents.analyzer import Analysis, Choice, ModelAnalyzer, TeamAnalysis, analyzer_prompt
from sumo_adv.agents.teams import Teamwork
from sumo_adv.datatypes import Duty, Level, LibraryEntry, Limits, Prediction, Proposal
from sumo_adv.episode.memory_access import known_casts
from sumo_adv.errors import ModelError
from sumo_adv.llm.asking import MeteredModel
from sumo_adv.llm.chat import Ledger
from sumo_adv.llm.prompts import Prompts
from sumo_adv.memory.bank import MemoryBank, compositions
from sumo_adv.memory.records import Composition, Part
from sumo_adv.planners.text import make_planner
from sumo_adv.search.search import AttackSearch
from sumo_adv.search.settings import SearchSettings
from sumo_adv.search.supports import ANY_FITTING, Cast, description_of
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.situation import Target

TEXT = (
    "PARAMETERS = {}\n\n\ndef endpoint(bv, ego, road, parameters, acc, horizon):\n"
    '    return {"x": 0.0, "y": 0.0, "heading": 0.0, "speed": 1.0, "time": 1.0}\n'
)
SHIFT = LibraryEntry("Shift", "It shifts.", ("neighbour",), (make_planner("Shift", "side", TEXT, "seed"),))
WORDS = "One vehicle shifts over from the right while another one keeps the left side shut."


def beside(name: str, y: float, risk: float) -> Target:
    """A car beside the ego that goes the same way. The one with the higher risk is BV1."""
    way = line((0.0, y), (250.0, y))
    return replace(target(car(name, 0.0, y), "neighbour", [(way, "none", math.inf)], EGO_PATH), risk=risk)


SCENE = situation([beside("right", -3.2, 0.9), beside("left", 3.2, 0.5)])


def team(*parts: tuple[str, str, str], label: str = "Pinch", description: str = WORDS) -> dict[str, Any]:
    """A composition as a model writes it."""
    return {
        "label": label, "description": description,
        "parts": [{"bv": bv, "role": role, "label": intent} for bv, role, intent in parts],
    }  # fmt: skip


COLLIDER, BLOCK = ("BV1", "collider", "Shift"), ("BV2", "block_left", "escape block left")
PINCH = Composition(
    "Pinch", WORDS, (Part(Duty.COLLIDER, "Shift", ANY_FITTING), Part(Duty.BLOCK_LEFT, "Escape Block Left", ANY_FITTING))
)


def analyzer(model: Answers, teamwork: Teamwork | None) -> ModelAnalyzer:
    prompts = Prompts(data_folder("prompts"))
    return ModelAnalyzer(MeteredModel(model, Ledger()), prompts, Limits(), teamwork=teamwork)


def answer(*teams: dict[str, Any], bv: str = "BV1") -> TeamAnalysis:
    intent = Choice(bv=bv, label="Shift", risk="high")
    return TeamAnalysis.model_validate({"intents": [intent.model_dump()], "compositions": list(teams)})


def test_a_model_is_asked_for_compositions_only_where_several_adversaries_are_allowed() -> None:
    prompts = Prompts(data_folder("prompts"))
    alone = analyzer_prompt(prompts, {0.0: SCENE}, [SHIFT], Limits())
    bank = replace(PINCH, label="Squeeze")
    two = analyzer_prompt(prompts, {0.0: SCENE}, [SHIFT], Limits(), teamwork=Teamwork(2, ("right",), (bank,)))
    assert two.system == alone.system and two.user.startswith(alone.user)
    added = two.user.removeprefix(alone.user)
    assert "up to 2 BVs" in added
    assert "BV1: collider, attack, block_right (Escape Block Right), hide (View Screen)" in added
    assert "BV2: block_left (Escape Block Left), hide (View Screen), open (Gap Opening)" in added  # it may not collide
    assert f"- Squeeze: {WORDS} Parts: collider Shift, block_left Escape Block Left" in added
    assert "Blocked Escape" in added and "Box-in" not in added  # of three vehicles
    model = Answers(Analysis(intents=[]), answer())
    analyzer(model, None).analyze({0.0: SCENE}, [SHIFT])
    analyzer(model, Teamwork(2)).analyze({0.0: SCENE}, [SHIFT])
    assert [request.schema_name for request in model.asked] == ["Analysis", "TeamAnalysis"]


def test_a_proposed_composition_comes_with_its_vehicles() -> None:
    asking = analyzer(Answers(answer(team(COLLIDER, BLOCK))), Teamwork(2))
    asking.analyze({0.0: SCENE}, [SHIFT])
    assert asking.casts == (Cast(PINCH, ("right", "left")),)


def test_a_vehicle_may_attack_as_well_with_an_intent_of_the_library() -> None:
    both = team(COLLIDER, ("BV2", "attack", "Shift"))
    asking = analyzer(Answers(answer(both)), Teamwork(2))
    asking.analyze({0.0: SCENE}, [SHIFT])
    (cast,) = asking.casts
    assert [(str(part.duty), part.intent) for part in cast.composition.parts] == [
        ("collider", "Shift"), ("attack", "Shift"),
    ]  # fmt: skip
    assert cast.vehicles == ("right", "left")


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (team(COLLIDER), "has 1 parts; it must have 2 to 2"),
        (team(COLLIDER, BLOCK, ("BV3", "slow", "Slow Leader")), "has 3 parts"),
        (team(BLOCK, COLLIDER), "first part of the composition 'Pinch' must be the collider"),
        (team(COLLIDER, ("BV1", "block_right", "Escape Block Right")), "has two parts"),
        (team(COLLIDER, BLOCK, description="Two vehicles."), "needs a description"),
        (team(COLLIDER, ("V1", "block_left", "Escape Block Left")), "no vehicle 'V1' that may take part"),
        (team(COLLIDER, ("BV2", "honk", "Horn")), "no role 'honk'; choose collider, attack, block_left"),
        (team(COLLIDER, ("BV2", "block_left", "Slow Leader")), "choose Escape Block Left, Oncoming Block Left"),
        (team(COLLIDER, ("BV2", "block_right", "Escape Block Right")), "BV2 cannot carry out 'Escape Block Right'"),
        (team(("BV2", "collider", "Shift"), ("BV1", "open", "Gap Opening")), "BV2 may not be the collider"),
        (team(("BV1", "collider", "Brake"), BLOCK), "'Brake' does not apply to BV1"),
    ],
)
def test_an_unusable_composition_is_sent_back_with_its_fault(wrong: dict[str, Any], sentence: str) -> None:
    brake = LibraryEntry("Brake", "It brakes.", ("leader",), ())
    model = Answers(answer(wrong), answer())
    asking = analyzer(model, Teamwork(2, ("right",)))
    asking.analyze({0.0: SCENE}, [SHIFT, brake])
    assert sentence in model.asked[1].messages[-1][1]
    assert asking.casts == ()


def test_a_vehicle_that_may_only_support_is_no_choice_by_itself() -> None:
    with pytest.raises(ModelError, match="BV2 may only be a support"):
        analyzer(Answers(*[answer(bv="BV2")] * 2), Teamwork(2, ("right",))).analyze({0.0: SCENE}, [SHIFT])


def test_a_composition_that_the_bank_knows_is_retrieved_and_another_one_is_composed(tmp_path: Path) -> None:
    """The bank's has its own parts: the vehicle that was proposed for a role has it, any other part is open."""
    parts = (
        Part(Duty.COLLIDER, "Shift", "side"), Part(Duty.SLOW, "Slow Leader", "pace"),
        Part(Duty.BLOCK_LEFT, "Escape Block Left", "beside"),
    )  # fmt: skip
    squeeze = Composition("Squeeze", WORDS, parts)
    proposed = Cast(PINCH, ("right", "left"))
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        assert known_casts([proposed], bank) == [proposed]
        bank.record_composition(squeeze, [True])
        assert known_casts([proposed], bank) == [Cast(replace(squeeze, succeeded=1), ("right", ANY_FITTING, "left"))]
        unknown = Cast(replace(PINCH, description="A tractor turns round on a bridge at night."), ("right", "left"))
        assert known_casts([unknown], bank) == [unknown]


class Near:
    """All candidates are predicted to be valid collisions."""

    def score(self, proposals: Sequence[Proposal]) -> list[Proposal]:
        hit = Prediction(hit=True, level=Level.VALID, min_ttc=0.0)
        return [replace(p, score=0.6, prediction=hit) for p in proposals]


def search(adversaries: int) -> AttackSearch:
    return AttackSearch(
        Near(), {0.0: SCENE}, [SHIFT], SearchSettings(proposals=10), seed=0, adversaries=adversaries,
        colliders=("right",),
    )  # fmt: skip


def test_a_proposed_composition_is_tried_with_its_vehicles_under_its_label_and_its_proposer() -> None:
    with_cast = search(2)
    with_cast.add_casts([Cast(PINCH, ("right", "left"))], "scripted")
    made = [p for p in with_cast.pool if p.supports]
    assert {p.bvs for p in made} == {("right", "left")}
    assert {(p.composition, p.by) for p in made} == {("Pinch", "scripted")}
    assert made[0].supports[0].duty is Duty.BLOCK_LEFT
    assert description_of(made[0], [SHIFT], [Cast(PINCH)]) == WORDS
    assert description_of(made[0], [SHIFT]).startswith("It shifts. The vehicle keeps beside the ego")


@pytest.mark.parametrize("cast", [Cast(PINCH, ("left", "right")), Cast(PINCH, ("right", "gone"))])
def test_a_composition_without_its_vehicles_is_not_tried(cast: Cast) -> None:
    """The one on the left may not be the collider here, and a vehicle that has gone can do nothing."""
    without = search(2)
    without.add_casts([cast], "scripted")
    assert not any(p.supports for p in without.pool)


def test_a_composition_of_more_vehicles_than_allowed_is_not_tried() -> None:
    alone = search(1)
    alone.add_casts([Cast(PINCH, ("right", "left"))], "scripted")
    assert not any(p.supports for p in alone.pool)


# ---- a run

SQUEEZE = "The leader slows down until a vehicle on the right comes level with the ego again and cuts in."


def squeezing(asked: Asked) -> Mapping[str, Any]:
    """A model that has the leader hold the ego up for a cut-in of the vehicle on the right."""
    collider, leader = (
        re.search(rf"^(BV\d+): .*{may}", asked.last, re.MULTILINE) for may in (r"\bcollider\b", r"slow \(Slow Leader\)")
    )
    assert collider is not None and leader is not None
    parts = ((collider[1], "collider", "Aggressive Cut-in"), (leader[1], "slow", "Slow Leader"))
    return {
        "intents": [intent(collider[1], "Aggressive Cut-in")],
        "compositions": [team(*parts, label="Held-up Cut-in", description=SQUEEZE)],
    }


def test_what_succeeds_beside_a_models_composition_is_learnt_under_its_label(tmp_path: Path) -> None:
    """The vehicle on the right is too slow to reach the ego alone."""
    program = Program(tmp_path, tmp_path / "caches")
    with ModelServer(squeezing) as server:
        program.variables = server.environment()
        done = program.here(
            "run", "box_in_motorway", "--adversaries", "2", "--until", "valid", "--attempts", "3", "--llm", "scripted",
            "--out", "out", "--memory", "bank.sqlite",
        )  # fmt: skip
    assert done.status == 0, done.err
    attempt = done.outcome["attempts"][-1]
    assert (attempt["level"], attempt["composition"]) == ("valid", "Held-up Cut-in")
    assert done.outcome["llm"]["bought"][0]["what"].endswith(", compositions: 1")
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        (kept,) = compositions(bank)
    assert (kept.label, kept.succeeded) == ("Held-up Cut-in", 1)
    assert [part.intent for part in kept.parts] == ["Aggressive Cut-in", "Slow Leader"]
