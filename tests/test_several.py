"""Attacks of several adversaries: predicted, judged, searched for, remembered, and run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np
import pytest
from metrics_tracks import cruise
from several_samples import pinch
from situation_samples import EGO_PATH, car, line, situation, target

import sumo_adv.app as app
from sumo_adv.config import load_settings
from sumo_adv.datatypes import (
    Duty,
    Endpoint,
    Level,
    LibraryEntry,
    Limits,
    ObservedMotion,
    Planner,
    Prediction,
    Proposal,
    Verdict,
)
from sumo_adv.drivers.prediction import PredictedEgos
from sumo_adv.episode.task import make_task
from sumo_adv.errors import BankError
from sumo_adv.memory.bank import MemoryBank, compositions, retrieve_composition
from sumo_adv.memory.records import MAX_FAILURES_IN_A_ROW, Composition, Part
from sumo_adv.metrics.case import Case, make_case
from sumo_adv.metrics.verdict import judge_attempt
from sumo_adv.planners.answers import Answer, PlannerObservation
from sumo_adv.planners.text import make_planner
from sumo_adv.report.folder import write_run
from sumo_adv.report.manifest import RecordedRun, read_manifest
from sumo_adv.report.staging import staged
from sumo_adv.search.rollouts import predict
from sumo_adv.search.search import AttackSearch
from sumo_adv.search.settings import EvolutionSettings, SearchSettings
from sumo_adv.search.support_intents import SUPPORT_INTENTS, can_do_duty
from sumo_adv.search.supports import Supports, composition_label, duties_against, observed_escape
from sumo_adv.simulation.sumo_rules import SituationBatch
from sumo_adv.situation import Target

PLANNER = Planner("Shift", "side", "", (), "seed")
MISS = Verdict(10.0, 30.0, False, False, True, False)


def beside(name: str, x: float, y: float, speed: float = 10.0, relation: str = "neighbour") -> Target:
    """A car that goes east along y, from x on."""
    way = line((x, y), (x + 250.0, y))
    return target(car(name, x, y, speed=speed), relation, [(way, "none", math.inf)], EGO_PATH)


LEFT, RIGHT, AHEAD = beside("left", 0.0, 3.2), beside("right", 0.0, -3.2), beside("ahead", 30.0, 0.0, 0.0, "leader")
SCENE = situation([LEFT, RIGHT, AHEAD])


def attack(bv: str, *supports: tuple[str, Duty], planner: Planner = PLANNER) -> Proposal:
    """A collider with supports."""
    helpers = tuple(Proposal(name, planner.label, planner, {}, 0.0, 0.0, duty=duty) for name, duty in supports)
    return Proposal(bv, planner.label, planner, {}, 0.0, 0.0, supports=helpers)


# ---- predictions


def egos_after(seconds: float, *adversaries: Sequence[Target]) -> PredictedEgos:
    """Egos at 10 m/s after some time; ``adversaries``: the first ones of all egos, then the second ones."""
    pairs = [t for those in adversaries for t in those]
    sizes = np.full(len(pairs), 5.0), np.full(len(pairs), 2.0)
    egos = PredictedEgos(SituationBatch([SCENE] * len(pairs)), *sizes, each=len(adversaries))
    states = np.array([(t.state.x, t.state.y, t.state.speed) for t in pairs])
    for k in range(round(seconds / 0.1)):
        place = (states[:, 0] + states[:, 2] * 0.1 * k, states[:, 1], 0.0 * states[:, 0])
        egos.step(0.1 * k, place, states[:, 2])
    return egos


def test_an_ego_reacts_to_each_of_its_adversaries_whichever_comes_first() -> None:
    """One ego has a standing car ahead as its second adversary, the other one as its first; the third has none."""
    alone = egos_after(2.0, [AHEAD])
    three = egos_after(2.0, [LEFT, AHEAD, LEFT], [AHEAD, LEFT, RIGHT])
    assert alone.v[0] < 8.0
    assert three.v == pytest.approx([alone.v[0], alone.v[0], 10.0])
    assert three.s[2] == pytest.approx(20.0)


def test_supports_are_rolled_out_beside_their_colliders() -> None:
    """All go straight on; a support has its own row in a set of motions of its own."""

    def on(rows: Sequence[int], observations: Sequence[PlannerObservation]) -> list[Answer | None]:
        ends = [Answer(Endpoint(o[0]["x"] + 20.0, o[0]["y"], 0.0, 10.0, 2.0)) if o[0] else None for o in observations]
        return [ends[k] if k in rows else None for k in range(len(observations))]

    tried = [attack("left", ("right", Duty.BLOCK_RIGHT)), attack("right", ("left", Duty.BLOCK_LEFT))]
    rollouts = predict({0.0: SCENE}, tried, on, limits=Limits(), steps=11, replan=5)
    (supports,) = rollouts.supports
    assert rollouts.adversary[1][:, 10] == pytest.approx([3.2, -3.2], abs=0.01)
    assert supports[1][:, 10] == pytest.approx([-3.2, 3.2], abs=0.01)
    assert rollouts.ego[0][:, 10] == pytest.approx([10.0, 10.0])
    with pytest.raises(ValueError):
        predict({0.0: SCENE}, [tried[0], attack("left")], on, limits=Limits(), steps=11, replan=5)


# ---- verdicts


EGO, COLLIDER = cruise("ego", 0, 0, 15), cruise("collider", 40, 0, 5)  # the ego runs into it after 3.5 s
BESIDE = cruise("support", 5, 3.2, 15)


def test_a_support_that_keeps_clear_fails_nothing_and_one_that_touches_the_ego_first_fails() -> None:
    assert judge_attempt(Case(EGO, COLLIDER, (BESIDE,), 1.0, supports=(BESIDE,))).failed_gates == ()
    drifting = replace(BESIDE, y=np.maximum(3.2 - np.maximum(EGO.time - 1.5, 0.0), 0.5), x=EGO.x - 2.0)
    verdict = judge_attempt(Case(EGO, COLLIDER, (drifting,), 1.0, supports=(drifting,)))
    assert "third_party" in verdict.failed_gates
    assert not verdict.feasible
    assert "third_party" not in judge_attempt(Case(EGO, COLLIDER, (drifting,), 1.0)).failed_gates


def test_adversaries_that_touch_each_other_fail() -> None:
    into = cruise("support", 25, 0, 12)  # 10 m behind the collider, 7 m/s faster: they touch after 1.5 s
    verdict = judge_attempt(Case(EGO, COLLIDER, (into,), 1.0, supports=(into,)))
    assert verdict.failed_gates == ("third_party",)


def test_a_support_that_brakes_harder_than_a_car_can_fails_the_attempt() -> None:
    braking = replace(BESIDE, acceleration=np.where(BESIDE.time > 2.0, -12.0, 0.0))
    failed = judge_attempt(Case(EGO, COLLIDER, (braking,), 1.0, supports=(braking,))).failed_gates
    assert "longitudinal" in failed


def test_a_case_holds_the_supports_with_what_they_planned() -> None:
    until, after = BESIDE.between(0.0, 2.0), BESIDE.between(2.05, 4.0)
    tracks = [EGO, COLLIDER, until]
    case = make_case(tracks, "ego", ["collider", "support", "gone"], 1.0, {"support": after})
    assert case is not None
    (support,) = case.supports
    assert support.time[-1] == pytest.approx(4.0)
    assert [t.id for t in case.others] == ["support"]


# ---- the search


def test_the_escape_says_which_support_is_needed() -> None:
    assert duties_against(0.9, 10.0, 10.0) == (Duty.BLOCK_LEFT,)
    assert duties_against(-0.5, 5.0, 10.0) == (Duty.BLOCK_RIGHT,)  # it swerves and brakes
    assert duties_against(0.3, 9.0, 10.0) == (Duty.SLOW, Duty.HIDE)
    assert duties_against(0.0, 10.0, 10.0) == ()


def test_the_widest_swerve_of_an_attempt_counts_and_what_was_not_seen_does_not() -> None:
    d, v = np.array([0.0, 0.5, 1.2, 0.1, -3.0]), np.full(5, 10.0)
    assert observed_escape(SCENE, ObservedMotion(10.0 * np.arange(5), d, v, 4)) == (Duty.BLOCK_LEFT,)
    braked = ObservedMotion(10.0 * np.arange(5), 0.0 * d, v - [0, 0, 2, 0, 0], 4)
    assert observed_escape(SCENE, braked) == (Duty.SLOW, Duty.HIDE)


def test_a_support_fits_where_it_can_do_its_duty() -> None:
    keep, oncoming = SUPPORT_INTENTS[Duty.BLOCK_LEFT]
    assert can_do_duty(Duty.BLOCK_LEFT, keep, LEFT)
    assert not can_do_duty(Duty.BLOCK_LEFT, keep, RIGHT)
    assert not can_do_duty(
        Duty.BLOCK_LEFT, keep, replace(LEFT, offset=-7.0)
    )  # it has gone from 3.2 m left to 3.8 m right
    assert can_do_duty(Duty.BLOCK_LEFT, keep, AHEAD)  # it has a lane to the left (situation_samples)
    assert not can_do_duty(Duty.BLOCK_RIGHT, SUPPORT_INTENTS[Duty.BLOCK_RIGHT][0], AHEAD)
    assert can_do_duty(Duty.BLOCK_LEFT, oncoming, replace(LEFT, relation="oncoming"))
    assert not can_do_duty(Duty.SLOW, SUPPORT_INTENTS[Duty.SLOW][0], LEFT)


TABLE = 'PARAMETERS = {"gap": (2.0, -3.0, 4.0, "m", "where")}\n\n\n'
SOURCE = 'def endpoint(bv, ego, road, parameters, acc, horizon):\n    return {"x": 0.0, "y": 0.0, "heading": 0.0, "speed": 1.0, "time": 1.0}\n'  # noqa: E501
SHIFT = LibraryEntry("Shift", "It shifts.", ("neighbour",), (make_planner("Shift", "side", TABLE + SOURCE, "seed"),))


class Saved:
    """A swerve to the left saves the ego from each candidate, unless a support blocks the left side."""

    def score(self, proposals: Sequence[Proposal]) -> list[Proposal]:
        hit, miss = Prediction(hit=True, level=Level.STRICT, min_ttc=0.0), Prediction(min_ttc=1.0, gap=1.0)
        blocked = [any(s.duty is Duty.BLOCK_LEFT for s in p.supports) for p in proposals]
        return [
            replace(p, score=0.4 if b else 1.9, prediction=hit if b else miss)
            for p, b in zip(proposals, blocked, strict=True)
        ]


def first(adversaries: int, colliders: tuple[str, ...] = ()) -> Proposal:
    """The first candidate that a search proposes by prediction."""
    settings = SearchSettings(proposals=10)
    search = AttackSearch(
        Saved(), {0.0: SCENE}, [SHIFT], settings, seed=0, adversaries=adversaries, colliders=colliders
    )  # fmt: skip
    search.follow(search.ranking([SHIFT]), [SHIFT])
    (proposed,) = search.propose(1)
    return proposed


def test_where_no_collider_alone_promises_anything_supports_are_predicted() -> None:
    assert first(1).supports == ()
    proposed = first(2, ("right",))
    assert proposed.bv == "right"
    (support,) = proposed.supports
    assert support.duty is Duty.BLOCK_LEFT
    assert support.bv in ("left", "ahead")
    assert proposed.bvs == ("right", support.bv)
    assert proposed.composition == "Shift + Escape Block Left"


def supports(most: int = 2, seed: int = 0) -> Supports:
    return Supports({0.0: SCENE}, Random(seed), most)


def test_a_variation_gets_a_support_against_the_escape_of_its_attempt() -> None:
    """On the left only two vehicles can block: the neighbour there, and the leader, which has a lane to the left."""
    alone = attack("right")
    given = [supports(seed=k).changed(alone, (Duty.BLOCK_LEFT,)) for k in range(20)]
    assert {(p.supports[0].duty, p.supports[0].bv) for p in given} == {
        (Duty.BLOCK_LEFT, "left"), (Duty.BLOCK_LEFT, "ahead"),
    }  # fmt: skip
    any_duty = {supports(seed=k).changed(alone, ()).supports[0].duty for k in range(60)}
    assert any_duty >= {Duty.BLOCK_LEFT, Duty.SLOW, Duty.OPEN}
    assert Duty.HIDE not in any_duty  # a collider beside the ego cannot be hidden by another one


def test_a_candidate_with_all_its_adversaries_loses_a_support_again() -> None:
    helped = attack("right", ("left", Duty.BLOCK_LEFT))
    assert supports(2).changed(helped, ()).supports == ()
    three = [supports(3, seed=k).changed(helped, (Duty.SLOW,)) for k in range(20)]
    assert {p.bvs for p in three} == {("right",), ("right", "left", "ahead")}


def test_an_attempt_that_a_swerve_saved_is_varied_with_the_left_side_blocked() -> None:
    """Nothing is predicted: the search asks, sees the ego swerve to the left, and blocks it there."""
    settings = SearchSettings(evolution=EvolutionSettings(first=1, anew=0.0, accompany=1.0))
    search = AttackSearch(
        Saved(), {0.0: SCENE}, [SHIFT], settings, seed=0, adversaries=2, colliders=("right",), predicts=False
    )  # fmt: skip
    search.follow(search.ranking([SHIFT]), [SHIFT])
    swerved = ObservedMotion(10.0 * np.arange(5), np.array([0.0, 0.5, 1.2, 1.2, 1.2]), np.full(5, 10.0), 4)
    seen = []
    for _ in range(12):
        (tried,) = search.propose(1)
        seen += [s.duty for s in tried.supports]
        search.observe(tried, swerved, MISS)
    assert set(seen) == {Duty.BLOCK_LEFT}


# ---- compositions


PARTS = (Part(Duty.COLLIDER, "Aggressive Cut-in", "side"), Part(Duty.BLOCK_LEFT, "Escape Block Left", "beside"))
SQUEEZE = Composition("Squeeze", "One vehicle cuts in from the right and another one blocks the left side.", PARTS)


def test_a_composition_is_learnt_by_a_success_found_by_its_description_and_forgotten_after_failures(
    tmp_path: Path,
) -> None:
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        before = bank.content_hash()
        assert not bank.record_composition(SQUEEZE, [False, False])
        assert bank.content_hash() == before
        assert bank.record_composition(SQUEEZE, [False, True])
        assert compositions(bank) == [replace(SQUEEZE, succeeded=1)]
        text = "A vehicle cuts in from the right while another vehicle blocks the left side."
        nearest = retrieve_composition(bank, "Pinch", text)
        assert nearest is not None and nearest.label == "Squeeze"
        assert retrieve_composition(bank, "U-turn", "The vehicle turns round on a bridge at night.") is None
        bank.record_composition(SQUEEZE, [False] * MAX_FAILURES_IN_A_ROW)
        assert compositions(bank) == []


def test_a_composition_has_one_collider_and_at_most_two_supports() -> None:
    for parts in (PARTS[:1], PARTS[::-1], (PARTS[0], PARTS[0]), (PARTS[0], *PARTS[1:] * 3)):
        with pytest.raises(BankError):
            Composition("Squeeze", "Two vehicles.", parts)


def test_parts_in_any_order_have_the_composition_s_name() -> None:
    collider = replace(attack("right"), label="Aggressive Cut-in")
    block = replace(attack("left"), label="Escape Block Left", duty=Duty.BLOCK_LEFT)
    slow = replace(attack("ahead"), label="Slow Leader", duty=Duty.SLOW)
    assert composition_label(collider, [block], [SQUEEZE]) == "Squeeze"
    assert composition_label(collider, [slow], [SQUEEZE]) == "Aggressive Cut-in + Slow Leader"


# ---- a run


def test_all_adversaries_are_driven_stored_and_replayed(tmp_path: Path) -> None:
    """Of a scenario with a vehicle ahead on the left and one behind on the right, both attack."""
    both = pinch("left_ahead", "right_behind", "side")
    run_input = app.load(Path("neighbour_ahead_left"), None)
    settings = load_settings(None, duration=6.0, delays=(0.0,), adversaries=2)
    recorded = RecordedRun(run_input, settings, make_task(run_input, settings, tmp_path), both, 0)
    run = app.replay(recorded)
    assert run.best is not None
    (attempt,) = run.best.attempts
    assert attempt.ending in ("contact", "time_limit"), attempt.message
    with staged(tmp_path / "run", force=False) as folder:
        document = write_run(folder, run, figure=False)
        folder.keep(force=False)
    assert [(a["id"], a["role"]) for a in document["adversaries"]] == [
        ("left_ahead", "collider"), ("right_behind", "block_right"),
    ]  # fmt: skip
    assert document["attempts"][0]["composition"] == "Pinch"
    again = read_manifest(tmp_path / "run")
    assert again.proposal.members == both.members
    repeated = app.replay(again).best
    assert repeated is not None and repeated.attempts[0].verdict == attempt.verdict
    last, first_ = (r.results[0].snapshots[-1].raw for r in (repeated, run.best))
    assert last == first_
