"""A planner drives the ego in an exported CommonRoad scenario, and its trajectory is judged as the run's was."""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_samples import ROOT
from road_samples import drive, steps
from run_samples import run_folder
from shapely import LineString, Point
from sumo_samples import vehicle

import sumo_adv
from sumo_adv.datatypes import Level, Track, Verdict
from sumo_adv.drivers import Observation
from sumo_adv.report.export.commonroad import COMMONROAD_SCENARIO_FILE, COMMONROAD_SOLUTION_FILE, write_commonroad
from sumo_adv.report.export.piece import ExportedRun, read_piece

reader = pytest.importorskip("commonroad.common.file_reader", reason="needs commonroad-io")


@pytest.fixture(scope="module")
def piece() -> ExportedRun:
    """A cut-in on a motorway that hits the ego."""
    return read_piece(run_folder("straight"))


def opened(piece: ExportedRun, folder: Path) -> tuple[Any, Any]:
    """The exported scenario and its planning problem."""
    write_commonroad(folder, piece)
    scenario, problems = reader.CommonRoadFileReader(str(folder / COMMONROAD_SCENARIO_FILE)).open()
    (problem,) = problems.planning_problem_dict.values()
    return scenario, problem


def columns(track: Track) -> dict[str, Any]:
    size = {"length": np.full(len(track.time), track.length), "width": np.full(len(track.time), track.width)}
    return {"time": track.time, "x": track.x, "y": track.y, "heading": track.heading, "speed": track.speed, **size}


def judged(piece: ExportedRun, driven: Sequence[Any]) -> Verdict:
    """The verdict on states that a planner drove (their positions are box centres) and the recorded adversary."""
    ego = piece.track(piece.ego)
    table = {
        "time": [piece.begin + piece.step * s.time_step for s in driven], "x": [s.position[0] for s in driven],
        "y": [s.position[1] for s in driven], "heading": [s.orientation for s in driven],
        "speed": [s.velocity for s in driven], "length": [ego.length] * len(driven), "width": [ego.width] * len(driven),
    }  # fmt: skip
    assert piece.adversary is not None
    return sumo_adv.judge(table, columns(piece.track(piece.adversary)), trigger_time=piece.takeover)


def test_the_recorded_solution_is_hit_again(piece: ExportedRun, tmp_path: Path) -> None:
    solutions = pytest.importorskip("commonroad.common.solution")
    opened(piece, tmp_path)
    solution = solutions.CommonRoadSolutionReader.open(str(tmp_path / COMMONROAD_SOLUTION_FILE))
    verdict = judged(piece, solution.planning_problem_solutions[0].trajectory.state_list)
    assert verdict.collided and verdict.contact_time == pytest.approx(piece.contact(), abs=0.01)


def brake(scenario: Any, problem: Any, count: int) -> list[Any]:
    """A planner of one rule: along the middle of its lanelet, braking with 2 m/s2 from the initial state on."""
    first, step = problem.initial_state, scenario.dt
    start = Point(first.position)
    (lane,) = [each for each in scenario.lanelet_network.lanelets if each.polygon.shapely_object.contains(start)]
    line = LineString(lane.center_vertices)
    stations = [line.project(start) + first.velocity * k * step - (k * step) ** 2 for k in range(count + 1)]
    places = [np.array(line.interpolate(station).coords[0]) for station in stations]  # v t - a t2 / 2
    return [
        type(first)(
            position=here, orientation=math.atan2(*(there - here)[::-1]), velocity=first.velocity - 2.0 * k * step,
            time_step=first.time_step + k,
        ) for k, (here, there) in enumerate(pairwise(places))
    ]  # fmt: skip


def test_an_ego_that_brakes_is_not_hit(piece: ExportedRun, tmp_path: Path) -> None:
    """It brakes with 2 m/s2 from 27.6 m/s on, as long as the run lasted: the adversary cuts in far ahead of it."""
    scenario, problem = opened(piece, tmp_path)
    driven = brake(scenario, problem, len(piece.track(piece.ego).time))
    lasted = (len(piece.track(piece.ego).time) - 1) * scenario.dt
    assert driven[-1].velocity == pytest.approx(27.6 - 2.0 * lasted, abs=0.3) and driven[-1].velocity > 0.0
    assert math.dist(driven[0].position, problem.initial_state.position) < 0.1
    verdict = judged(piece, driven)
    assert not verdict.collided and verdict.level < Level.COLLISION


@pytest.fixture
def reactive(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module of the example, which drives with ``commonroad-reactive-planner``."""
    pytest.importorskip("commonroad_rp", reason="needs commonroad-reactive-planner, in an environment of its own")
    monkeypatch.syspath_prepend(str(ROOT / "examples" / "commonroad_planner"))
    return import_module("reactive")


def test_commonroads_reactive_planner_drives_the_ego(piece: ExportedRun, tmp_path: Path, reactive: Any) -> None:
    """It knows the obstacles' trajectories, as CommonRoad gives them, and is not hit."""
    scenario, problem = opened(piece, tmp_path)
    driven = planned(reactive, scenario, problem, piece.track(piece.ego))
    verdict = judged(piece, driven)
    assert len(driven) == len(piece.track(piece.ego).time)
    assert math.dist(driven[0].position, problem.initial_state.position) < 0.001
    assert not verdict.collided and verdict.level < Level.COLLISION


def planned(reactive: Any, scenario: Any, problem: Any, ego: Track) -> list[Any]:
    """The states that the reactive planner drives at its first speed, planned anew every 0.5 s."""
    routes = import_module("commonroad_route_planner.fast_api.fast_api")
    path = routes.generate_reference_path_from_scenario_and_planning_problem(scenario, problem).reference_path
    planner = reactive.planner_for(scenario, problem, path, ego.length, ego.width)
    states = [planner.x_0]
    while len(states) < len(ego.time):
        planner.set_desired_velocity(problem.initial_state.velocity, planner.x_0.velocity)
        plan, along, aside = planner.plan()[:3]
        states += plan.state_list[1:6]
        planner.reset(
            initial_state_cart=plan.state_list[5], initial_state_curv=(along[5], aside[5]),
            collision_checker=planner.collision_checker, coordinate_system=planner.coordinate_system,
        )  # fmt: skip
    return reactive.centred(states[: len(ego.time)], planner.vehicle_params.wb_rear_axle)


def test_the_reactive_planner_follows_a_road_in_sumo(tmp_path: Path, reactive: Any) -> None:
    """For 8 s on a motorway with no other vehicle: it plans every 0.5 s, keeps its lane and the limit."""
    ego = reactive.Reactive()
    ego.reset(0)
    alone, ahead = vehicle("ego", "eastbound", 1, 110.0, 25.0), ego.path_ahead
    with drive(tmp_path, "motorway", [alone], of_ego, ego.act, path_ahead=ahead) as (moving, watcher):
        steps(moving, 80)
    speeds, offsets = np.array(watcher.kept).T
    assert np.abs(offsets).max() < 0.2 and speeds.min() > 24.0


def of_ego(seen: Observation) -> tuple[float, float]:
    """Speed [m/s] and offset [m]."""
    assert seen.lane_offset is not None
    return seen.ego.speed, seen.lane_offset
