"""Scenes seen before, and the choice among planners: by hand, deterministic, fast."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bank_samples import BRAKE_PLANNER, BRAKING, CUT_IN, CUT_PLANNER, evidence

from sumo_adv.datatypes import Planner
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.recall import SceneIndex, drawn_order, explain, likeness, signature_distance
from sumo_adv.memory.records import SceneSignature

HERE = {"ahead": 12.0, "left": 3.2, "heading": 0.0, "speed": 14.0, "ego_speed": 15.0}
SCENE = SceneSignature("straight", "neighbour", HERE, "idm")
FAILED = {"critical": False, "collided": False, "valid": None, "strict": None, "min_ttc": 4.0}


def moved(**changes: float) -> SceneSignature:
    return replace(SCENE, relative={**HERE, **changes})


def test_distances_by_hand() -> None:
    assert signature_distance(SCENE, SCENE) == 0.0
    # 3 m of 5 m and 0.8 m of 1 m: sqrt(0.6^2 + 0.8^2) = 1
    assert signature_distance(SCENE, moved(ahead=15.0, left=2.4)) == pytest.approx(1.0)
    assert signature_distance(moved(speed=10.0), SCENE) == pytest.approx(2.0)
    # from 3.1 rad to -3.1 rad the shorter way is 2 pi - 6.2 = 0.0832 rad, of 0.2
    assert signature_distance(moved(heading=3.1), moved(heading=-3.1)) == pytest.approx(0.4159, abs=1e-4)
    for unlike in (
        replace(SCENE, geometry="crossing"), replace(SCENE, relation="leader"), replace(SCENE, controller="krauss"),
        moved(speed=math.nan), replace(SCENE, relative={"ahead": 12.0}),
    ):  # fmt: skip
        assert signature_distance(SCENE, unlike) == math.inf


def test_the_nearest_success_is_recalled_a_valid_one_first(tmp_path: Path) -> None:
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        bank.add(BRAKING, [BRAKE_PLANNER])
        assert bank.recall_scene(SCENE) is None
        bank.record(evidence(scene=moved(ahead=12.1), **FAILED))
        assert bank.recall_scene(SCENE) is None
        bank.record(evidence(scene=moved(ahead=13.0), valid=False, seed=1))
        bank.record(evidence(scene=moved(ahead=16.0), valid=True, seed=2))
        bank.record(evidence(scene=moved(ahead=15.0), valid=True, seed=3))
        bank.record(evidence(scene=moved(ahead=18.0), valid=True, seed=4))
        nearest = bank.recall_scene(SCENE)
        assert nearest is not None
        assert nearest.seed == 3
        nearer = bank.recall_scene(SCENE, limit=0.5)
        assert nearer is not None
        assert nearer.seed == 1
        assert bank.recall_scene(SCENE, limit=0.1) is None
        assert bank.recall_scene(replace(SCENE, controller="krauss")) is None
        assert bank.recall_scene(replace(SCENE, relative={})) is None
        bank.retire(BRAKING.label)
        assert bank.recall_scene(SCENE) is None


def test_evidence_outside_its_planners_bounds_is_not_recalled(tmp_path: Path) -> None:
    """BRAKE_PLANNER has one parameter, hardness, from 2 to 8 m/s2."""
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        bank.add(BRAKING, [BRAKE_PLANNER])
        for wrong in ({"hardness": 1e9}, {"hardness": 1.9}, {}, {"hardness": 7.0, "other": 1.0}, {"softness": 7.0}):
            bank.record(evidence(scene=SCENE, parameters=wrong))
        assert bank.recall_scene(SCENE) is None
        bank.record(evidence(scene=SCENE, parameters={"hardness": 8.00005}, seed=1))  # rounded to four digits
        nearest = bank.recall_scene(SCENE)
        assert nearest is not None and nearest.seed == 1


def test_of_equally_near_ones_the_order_of_the_rows_does_not_decide() -> None:
    rows = [evidence(scene=SCENE, seed=seed, parameters={"hardness": 7.0 - seed}) for seed in range(6)]
    first = SceneIndex(rows).nearest(SCENE, 1.0)
    assert first == rows[0]
    assert SceneIndex(rows[::-1]).nearest(SCENE, 1.0) == first


def test_the_nearest_of_many_scenes_is_recalled() -> None:
    places = np.random.default_rng(0).uniform(-40.0, 40.0, 500)
    index = SceneIndex([evidence(scene=moved(ahead=float(x)), seed=i) for i, x in enumerate(places)])
    for x in places[:50]:
        nearest = index.nearest(moved(ahead=float(x)))
        assert nearest is not None
        assert nearest.scene.relative["ahead"] == x


SIDE, BACK = CUT_PLANNER, Planner(CUT_IN.label, "back", "# back\n", (), "expert")


def test_evidence_of_other_scenes_counts_for_less() -> None:
    assert likeness(SCENE, SCENE) == 1.0
    assert likeness(replace(SCENE, controller="krauss"), SCENE) == 0.5
    assert likeness(replace(SCENE, geometry="crossing", relation="leader"), SCENE) == pytest.approx(0.15)


def test_arms_by_hand_and_the_same_in_any_order() -> None:
    history = [
        evidence(planner_hash=SIDE.hash, scene=SCENE),
        evidence(planner_hash=SIDE.hash, scene=replace(SCENE, controller="krauss")),
        evidence(planner_hash=SIDE.hash, scene=replace(SCENE, geometry="crossing"), **FAILED),
        evidence(planner_hash="of nobody here", scene=SCENE),
    ]
    arms = drawn_order([SIDE, BACK], history, SCENE, random.Random(1))
    by_mode = {arm.planner.mode: arm for arm in arms}
    side, back = by_mode["side"], by_mode["back"]
    assert (side.successes, side.failures, side.rows) == (1.5, 0.3, 3)
    assert side.mean == pytest.approx(2.5 / 3.8)
    assert (back.successes, back.failures, back.mean) == (0.0, 0.0, 0.5)
    assert drawn_order([BACK, SIDE], history[::-1], SCENE, random.Random(1)) == arms
    explained = explain(arms)
    assert [row["draw"] for row in explained] == sorted((row["draw"] for row in explained), reverse=True)
    assert {row["mode"]: row["planner"] for row in explained} == {"side": SIDE.hash, "back": BACK.hash}


def test_what_succeeded_is_tried_first_mostly_and_new_ones_sometimes() -> None:
    history = [evidence(planner_hash=SIDE.hash, scene=SCENE, seed=seed) for seed in range(4)]
    rng = random.Random(0)
    first = [drawn_order([BACK, SIDE], history, SCENE, rng)[0].planner.mode for _ in range(300)]
    # P(Beta(5, 1) > U) = 5/6
    assert 0.77 < first.count("side") / 300 < 0.90
    failed = [replace(each, critical=False) for each in history]
    first = [drawn_order([BACK, SIDE], failed, SCENE, rng)[0].planner.mode for _ in range(300)]
    assert first.count("side") / 300 < 0.23
    assert drawn_order([], history, SCENE, rng) == []
