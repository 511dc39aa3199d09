"""The egos that are predicted do what SUMO's drivers do: a few random scenes of each situation.

A failure names the rules that differ, for instance after an upgrade of SUMO; ``benchmarks/conformance.py`` has more
scenes of each situation.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator, Mapping

import numpy as np
import pytest
from cli_samples import ROOT

from sumo_adv.datatypes import Floats
from sumo_adv.simulation.engine import Engine

sys.path.insert(0, str(ROOT / "benchmarks"))
import conformance
from conformance_scenes import KINDS, Plan

PLANS = 6


@pytest.fixture(scope="module")
def measured() -> Iterator[Mapping[str, Floats]]:
    """The errors of one encounter with Krauss's driver and one with IDM, by situation."""
    with Engine(conformance.body) as engine:
        jobs = {kind: [(kind, "krauss", 0, PLANS), (kind, "idm", 1, PLANS)] for kind in KINDS}
        yield {kind: conformance.errors(conformance.run(engine, some)) for kind, some in jobs.items()}


@pytest.mark.parametrize("kind", KINDS)
def test_the_prediction_drives_as_sumo_does(measured: Mapping[str, Floats], kind: str) -> None:
    assert measured[kind].shape[1] >= PLANS  # else too few scenes came to something
    assert conformance.broken(kind, measured[kind]) == []


def test_a_broken_bound_names_the_rules() -> None:
    """The ego is predicted a metre too far on in each of three scenes."""
    (*_, last) = conformance.broken("following", np.array([[1.0] * 3, [0.0] * 3, [0.0] * 3]))
    assert last.startswith("following: the maximum of the error is 1.000 m along the path, more than")
    assert "car_following.py" in last


@pytest.mark.parametrize(
    ("home", "name"), [(home, name) for home, names in conformance.COPIED.items() for name in names]
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
