"""What came off elsewhere: which of it is taken for a vehicle, and that what is shipped fits the planners."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np
import pytest
from bank_samples import evidence
from cli_samples import LEADER, Program, Runs
from situation_samples import crossing, leader, neighbour, situation

from sumo_adv.agents.experience import Experience, Worked, apart, driver_class, read_experience
from sumo_adv.agents.expert import Expert
from sumo_adv.agents.ways import families
from sumo_adv.datatypes import EgoCourse, LibraryEntry, Proposal
from sumo_adv.episode.knowledge import EXPERIENCE, experience
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.records import SceneSignature
from sumo_adv.planning.source import make_planner
from sumo_adv.world.inputs import data_folder

TEXT = """
PARAMETERS = {"gap": (2.0, -3.0, 5.0, "m", "where"), "drift": (3.0, 2.0, 6.0, "s", "how long")}


def endpoint(bv, ego, road, parameters, acc, horizon):
    return {"x": 0.0, "y": 0.0, "heading": 0.0, "speed": 1.0, "time": 1.0}
"""
SIDE = make_planner("Shift", "side", TEXT, "seed")
LIBRARY = [LibraryEntry("Shift", "It comes over.", ("neighbour", "leader"), (SIDE,))]
BESIDE = (20.0, 3.2, 0.0, 12.0, 10.0)  # the scene of ``neighbour()``


def worked(gap: float, scene: tuple[float, ...] = BESIDE, *, relation: str = "neighbour", driver: str = "") -> Worked:
    return Worked(driver or "brakes", relation, "side", scene, {"gap": gap, "drift": 4.0}, 0.0)


def drawn(known: Sequence[Worked], count: int = 200, driver: str = "brakes") -> list[Proposal]:
    situations = {0.0: situation([neighbour()])}
    return Experience(known, driver).draw(situations, families(situations, LIBRARY), count, Random(1))


def test_proposals_lie_near_what_came_off() -> None:
    gaps = [p.parameters["gap"] for p in drawn([worked(1.0)])]
    assert len(gaps) == 200
    assert np.mean(gaps) == pytest.approx(1.0, abs=0.15)
    assert np.std(gaps) == pytest.approx(0.06 * 8.0, rel=0.2)  # of the range from -3 to 5 m
    assert all(-3.0 <= g <= 5.0 for g in (p.parameters["gap"] for p in drawn([worked(4.9)])))


def test_what_came_off_in_the_most_similar_scene_is_taken() -> None:
    """One of eight is taken: the other scene alone is drawn once in 2^8."""
    far = (60.0, 3.2, 0.0, 12.0, 10.0)
    gaps = [p.parameters["gap"] for p in drawn([worked(4.0, far), worked(-2.0)])]
    assert sum(g < 1.0 for g in gaps) >= 195


def test_nothing_is_drawn_of_another_relation_or_of_numbers_the_planner_has_not() -> None:
    assert drawn([worked(1.0, relation="oncoming")]) == []
    assert drawn([replace(worked(1.0), parameters={"gap": 1.0})]) == []
    assert drawn([replace(worked(1.0), mode="push")]) == []
    assert drawn([]) == []


def test_vehicles_and_moments_have_their_turns() -> None:
    other = replace(leader(), state=replace(leader().state, id="other"))
    situations = {delay: situation([neighbour(), other]) for delay in (0.0, 1.5)}
    known = [worked(1.0), worked(2.0), worked(3.0), worked(0.0, relation="leader")]
    found = Experience(known, "brakes").draw(situations, families(situations, LIBRARY), 40, Random(1))
    assert Counter((p.bv, p.delay) for p in found) == dict.fromkeys(
        [("bv", 0.0), ("bv", 1.5), ("other", 0.0), ("other", 1.5)], 10
    )


def test_what_came_off_against_such_drivers_comes_before_what_did_against_others() -> None:
    known = [worked(-2.0, driver="lattice"), worked(4.0)]
    assert all(p.parameters["gap"] < 1.0 for p in drawn(known, driver="lattice"))
    assert all(p.parameters["gap"] > 1.0 for p in drawn(known, driver="brakes"))
    assert len(drawn(known, driver="replay")) == 200  # nothing came off against a replay: all of it counts
    assert [driver_class(d) for d in ("replay", "lattice", "idm", "mine:Driver")] == [
        "replay", "lattice", "brakes", "brakes",
    ]  # fmt: skip


def test_scenes_differ_by_clear_changes_and_headings_by_the_shorter_way_round() -> None:
    here = (0.0, 0.0, math.pi - 0.1, 10.0, 10.0)
    scenes = np.array([here, (30.0, 0.0, here[2], 10.0, 22.0), (0.0, 0.0, 0.1 - math.pi, 10.0, 10.0)])
    assert apart(scenes, here) == pytest.approx([0.0, 5.0, 0.5])  # 3 and 4 changes; 0.2 of 0.4 rad


class Kept:
    """A brake avoids every proposal, so no more are drawn; what was asked is kept."""

    def __init__(self) -> None:
        self.asked: list[Proposal] = []

    def score(self, proposals: Sequence[Proposal], seen: Sequence[EgoCourse] | None = None) -> list[Proposal]:
        self.asked += proposals
        return [replace(p, score=0.05, predicted={"alone": 0.05}) for p in proposals]

    def heard(self, tried: Proposal, course: EgoCourse) -> bool:
        return False


def test_the_expert_draws_three_quarters_of_its_first_proposals_near_what_came_off() -> None:
    scorer, situations = Kept(), {delay: situation([neighbour()]) for delay in (0.0, 1.5)}
    known = Experience([worked(1.0)], "brakes")
    Expert(scorer, proposals=40, seed=1, experience=known).predict(situations, LIBRARY)
    assert len(scorer.asked) == 40
    assert scorer.asked[0].parameters == {"gap": 2.0, "drift": 3.0}  # the author's, at the first moment alone
    near = scorer.asked[1:31]
    assert np.std([p.parameters["gap"] for p in near]) < 1.0 < np.std([p.parameters["gap"] for p in scorer.asked[31:]])


def test_where_what_was_remembered_fails_more_is_drawn_near_what_came_off() -> None:
    scorer, situations = Kept(), {0.0: situation([neighbour()])}
    expert = Expert(scorer, proposals=40, seed=1, experience=Experience([worked(1.0)], "brakes"))
    ways = families(situations, LIBRARY)
    expert.recall(situations, ways[0].proposal(None))
    assert scorer.asked == [] and len(expert.pool) == 1
    expert.more(ways, expert.pool)
    assert len(scorer.asked) == 150
    assert np.std([p.parameters["gap"] for p in scorer.asked[:50]]) < 1.0  # a third of them


def test_without_experience_the_expert_draws_of_any_way() -> None:
    scorer = Kept()
    Expert(scorer, proposals=40, seed=1).predict({0.0: situation([crossing(), neighbour()])}, LIBRARY)
    assert len(scorer.asked) == 40 and {p.bv for p in scorer.asked} == {"bv"}


def test_experience_can_be_switched_off(runs: Runs, program: Program) -> None:
    """Of even draws other shares are predicted to collide."""
    program.variables["SUMO_ADV_EXPERIENCE"] = "off"
    without = program(*LEADER, "--json", "--out", "out")
    assert without.status == 0, without.err
    reasons = [[i["reason"] for i in done.outcome["intents"]] for done in (runs["first"], without)]
    assert reasons[0] != reasons[1]
    assert without.manifest["settings"]["experience"] == "off"


# ---- what is shipped, and what the bank learns


def test_what_is_shipped_are_numbers_of_shipped_planners() -> None:
    found = read_experience(data_folder(EXPERIENCE))
    assert {w.driver for w in found} == {"brakes", "lattice", "replay"}
    with MemoryBank.open(data_folder("memory_bank.sqlite"), read_only=True) as bank:
        planners = [p for intent in bank.intents() for p in bank.planners(intent.label)]
    bounds: dict[tuple[str, frozenset[str], str], tuple[float, float]] = {}
    for p in planners:  # one mode of two intents may have two ranges: what is drawn stays within the planner's own
        for q in p.parameters:
            key = (p.mode, frozenset(p.defaults()), q.name)
            low, high = bounds.get(key, (q.low, q.high))
            bounds[key] = min(low, q.low), max(high, q.high)
    for one in found:
        for name, value in one.parameters.items():
            low, high = bounds[one.mode, frozenset(one.parameters), name]
            assert low - 1e-3 <= value <= high + 1e-3
        assert len(one.scene) == 5 and all(map(math.isfinite, one.scene))


def test_a_broken_file_is_not_half_read(tmp_path: Path) -> None:
    file = tmp_path / "experience.json"
    table = {
        "driver": "brakes",
        "relation": "leader",
        "mode": "side",
        "parameters": ["gap"],
        "rows": [[1, 2, 3, 4, 5, 0]],
    }
    file.write_text(json.dumps({"modes": [table]}))
    with pytest.raises(ValueError):
        read_experience(file)


def test_valid_collisions_that_the_bank_has_learnt_count_as_well(tmp_path: Path) -> None:
    with MemoryBank.open(tmp_path / "bank.sqlite", seed_from=data_folder("memory_bank.sqlite")) as bank:
        record = next(i for i in bank.intents() if "neighbour" in i.applies)
        planner = bank.planners(record.label)[0]
        entry = LibraryEntry(record.label, record.description, record.applies, (planner,))
        scene = dict(
            zip(("ahead", "left", "heading", "speed", "ego_speed"), (500.0, 3.2, 0.0, 12.0, 10.0), strict=True)
        )
        for valid, relative in ((True, scene), (False, scene), (True, {"ahead": 1.0})):
            seen = SceneSignature("straight", "neighbour", relative, "idm")
            numbers = {"label": record.label, "planner_hash": planner.hash, "parameters": planner.defaults()}
            bank.record(evidence(scene=seen, valid=valid, **numbers))
        situations = {0.0: situation([neighbour(x=500.0)])}
        known = experience(bank, [entry], "idm")
        found = known.draw(situations, families(situations, [entry]), 300, Random(1))
    mine = planner.defaults()
    near = [
        p
        for p in found
        if all(abs(p.parameters[q.name] - mine[q.name]) <= 0.25 * (q.high - q.low) for q in planner.parameters)
    ]
    assert 1 <= len(near) < 300  # one such scene among the many that are shipped, none of which is 500 m ahead
