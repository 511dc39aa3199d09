"""FISS+ as an ego. Without its package the tests that drive it skip."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path

import pytest
from cli_samples import ROOT, Program

from sumo_adv import app
from sumo_adv.config import load_settings
from sumo_adv.datatypes import DriverModel, VehicleState
from sumo_adv.driver_check import shipped_drive
from sumo_adv.drivers import Observation, Road, Steer, StopLine, make_ego, model_of
from sumo_adv.errors import UsageError

THERE = find_spec("fiss_planner") is not None
needs_it = pytest.mark.skipif(not THERE, reason="fiss-planner is not installed (extra planners)")
PATH = tuple((float(x), 0.0) for x in range(200))
HERE = VehicleState("ego", 20.0, 0.0, 0.0, 10.0, 0.0, 5.0, 2.0, "road_0")


@pytest.mark.skipif(THERE, reason="fiss-planner is installed")
def test_without_the_package_one_sentence_says_how_to_get_it() -> None:
    with pytest.raises(UsageError, match=r"not installed: pip install 'sumo-adv\[planners\]'\."):
        make_ego("fiss_plus", {})


def pedals(road: Road, *others: VehicleState) -> list[float]:
    """Its accelerations [m/s2] in three steps, in which nothing moves."""
    ego = make_ego("fiss_plus", {})
    ego.reset(0)
    answers = [ego.act(Observation(k / 10, 0.1, HERE, others, path=PATH, road=road)) for k in range(3)]
    assert all(isinstance(answer, Steer) for answer in answers)
    return [answer.acceleration for answer in answers if isinstance(answer, Steer)]


@needs_it
def test_it_keeps_to_the_limit_to_leaders_and_to_lines() -> None:
    leader = VehicleState("leader", 40.0, 0.0, 0.0, 2.0, 0.0, 5.0, 2.0, "road_0")
    assert min(pedals(Road(15.0))) > 0.0
    assert max(pedals(Road(15.0), leader)) < 0.0  # 15 m between the bumpers, 8 m/s faster
    closed, open_line = (Road(15.0, stop_lines=(StopLine(30.0, "red", must_wait=wait),)) for wait in (True, False))
    assert max(pedals(closed)) < 0.0  # 27.5 m to the line
    assert pedals(open_line) == pedals(Road(15.0))


@needs_it
def test_sumo_drives_where_it_knows_no_path() -> None:
    ego = make_ego("fiss_plus", {})
    assert ego.act(Observation(0.0, 0.1, HERE, (), road=Road(15.0))) is None
    assert ego.act(Observation(0.0, 0.1, HERE, (), path=PATH, road=Road(15.0, leaves=True))) is None


@needs_it
def test_it_is_an_unknown_driver() -> None:
    numbers = DriverModel("idm", 2.0, 4.0, 1.2, 2.0, 15.0, known=False)
    assert model_of(make_ego("fiss_plus", {}), numbers) == numbers
    with pytest.raises(UsageError, match="has no parameter 'horizon'"):
        make_ego("fiss_plus", {"horizon": 3.0})


@needs_it
def test_unattacked_it_drives_well() -> None:
    inputs = [shipped_drive("check/stop_and_go", "ego"), shipped_drive("t_junction_left_from_stem", "from_south")]
    done = app.check_driver(inputs, load_settings(None, ego="fiss_plus"), lambda checked: None, 20.0)
    assert [each.findings for each in done.scenarios] == [(), ()]


@needs_it
def test_a_forked_attempt_is_a_reloaded_one(program: Program) -> None:
    package = Path(str(find_spec("fiss_planner").origin)).parent.parent  # type: ignore[union-attr]
    program.variables = {"PYTHONPATH": os.pathsep.join(map(str, (ROOT, package)))}
    for name, options in (("forked", ()), ("loaded", ("--no-fork",))):
        done = program.here(
            "run", "motorway_cut_in_left", "--ego", "fiss_plus", "--attempts", "1", "--learn", "off", "--out", name,
            "--json", *options,
        )  # fmt: skip
        assert done.status == 0, done.err
    for file in ("states.csv.gz", "raw.csv.gz"):
        assert (program.folder / "forked" / file).read_bytes() == (program.folder / "loaded" / file).read_bytes()
