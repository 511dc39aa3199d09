"""The egos that are predicted do what SUMO's drivers do: a few random scenes of each situation.

A failure names the rules that differ, for instance after an upgrade of SUMO; ``benchmarks/conformance.py`` has more
scenes of each situation.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from cli_samples import ROOT

from sumo_adv.simulation.engine import Engine

sys.path.insert(0, str(ROOT / "benchmarks"))
import conformance
from conformance_scenes import CHOSEN, KINDS, Plan

PLANS = range(6)


@dataclass(frozen=True)
class Small:
    """The small set: by situation, and by single scene."""

    kinds: conformance.Scenes
    chosen: conformance.Scenes


@pytest.fixture(scope="module")
def small() -> Iterator[Small]:
    """Two encounters of each situation, one with Krauss's driver and one with IDM where it is for both."""
    with Engine(conformance.body) as engine:
        jobs = {
            kind: [
                (kind, situation.drivers[0], situation.small[0], PLANS),
                (kind, situation.drivers[-1], situation.small[1], PLANS),
            ]
            for kind, situation in KINDS.items()
        }
        kinds = {kind: conformance.run(engine, some) for kind, some in jobs.items()}
        yield Small(kinds, {name: conformance.run(engine, [conformance.chosen_job(name)]) for name in CHOSEN})


@pytest.mark.parametrize("kind", KINDS)
def test_the_prediction_drives_as_sumo_does(small: Small, kind: str) -> None:
    assert conformance.errors(small.kinds[kind]).shape[1] >= len(PLANS)  # else too few scenes came to something
    assert conformance.faults(kind, small.kinds[kind]) == []


@pytest.mark.parametrize("name", CHOSEN)
def test_in_a_single_scene_the_prediction_drives_as_sumo_does(small: Small, name: str) -> None:
    assert conformance.chosen_faults(name, small.chosen[name]) == []


UNNOTICED = ("LATERAL_SPEED", "JOINED")  # see benchmarks/README.md


@pytest.mark.parametrize(
    ("home", "name"),
    [(home, name) for home, names in conformance.COPIED.items() for name in names if name not in UNNOTICED],
)
def test_a_constant_that_is_wrong_by_20_percent_is_noticed(small: Small, home: str, name: str) -> None:
    importlib.import_module(f"sumo_adv.{home}")
    noticed = (conformance.noticed(home, name, factor, small.kinds, small.chosen) for factor in (0.8, 1.2))
    assert any(next(some, "") for some in noticed)


@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_how_hard_the_ego_can_brake_is_told_by_sumo(small: Small, factor: float) -> None:
    scene = "an emergency"
    wrong = conformance.with_model(small.chosen[scene], "hardest_braking", factor)
    assert conformance.chosen_faults(scene, wrong) != []


def test_a_broken_bound_names_the_rules() -> None:
    """The ego is predicted a metre too far on in each of three scenes."""
    (*_, last) = conformance.broken("following", np.array([[1.0] * 3, [0.0] * 3, [0.0] * 3]))
    assert last.startswith("following: the maximum of the error is 1.000 m along the path, more than")
    assert "car_following.py" in last


def test_egos_that_decide_otherwise_than_sumos_are_named() -> None:
    """The prediction waits in two of five scenes, SUMO's ego in all: they agree in 40 %, and 60 % are missed."""
    less, missed = conformance.undecided("gave_way", np.arange(5) < 2, np.ones(5, bool))
    assert "in 40% of the scenes, less than 80%, both egos wait or both go" in less
    assert "in 60% of the scenes, more than 2%, only SUMO's ego waits" in missed
    assert "junctions.py" in missed


TABLES = (conformance.COPIED, conformance.OWN)


@pytest.mark.parametrize(
    ("home", "name"), [(home, name) for table in TABLES for home, names in table.items() for name in names]
)
def test_a_constant_that_is_made_wrong_exists_and_is_right_again_afterwards(home: str, name: str) -> None:
    module = importlib.import_module(f"sumo_adv.{home}")
    right = getattr(module, name)
    with conformance.changed(home, name, 2.0):
        assert np.asarray(getattr(module, name)) == pytest.approx(2.0 * np.asarray(right))
    assert getattr(module, name) is right


def test_a_plan_is_pulled_and_moved_as_it_says() -> None:
    """From 10 m/s with -2 m/s2 for a second; over by 3.2 m within two seconds, at first by 0.3 of the speed at most."""
    time = np.arange(41) * 0.1
    plan = Plan(0, [(1.0, 1.0, -2.0)], [(0.0, 2.0, 3.2)])
    speeds = plan.speeds(10.0, time)
    assert speeds[[10, 15, 20, 40]] == pytest.approx([10.0, 9.0, 8.0, 8.0])
    offsets = plan.offsets(0.0, speeds, time)
    assert offsets[[0, 10, 40]] == pytest.approx([0.0, 1.6, 3.2])
    assert np.diff(offsets).max() <= 0.3 + 1e-9
