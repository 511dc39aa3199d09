"""What a driver sees as a CommonRoad scenario, held against commonroad-io and against SUMO's own network.

The shipped crossings have two lanes of 3.2 m on each side of each road; lanes end 12.4 m from (0, 0).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from road_samples import drive, steps
from sumo_samples import vehicle

pytest.importorskip("commonroad", reason="needs commonroad-io")

from commonroad.common.file_reader import CommonRoadFileReader
from commonroad.common.file_writer import CommonRoadFileWriter, OverwriteExistingFile
from commonroad.planning.planning_problem import PlanningProblemSet
from commonroad.scenario.obstacle import ObstacleType
from shapely import LineString, Point
from sumolib.net import readNet

from sumo_adv.commonroad import Scene, Scenes
from sumo_adv.datatypes import Floats, VehicleState
from sumo_adv.drivers import Lane, Observation, Road, SpeedLimit
from sumo_adv.errors import UsageError
from sumo_adv.simulation.inputs import data_folder

FROM_SOUTH = vehicle("ego", "south_in north_out", 1, 110.0, 12.0)  # its front at y = -110, its centre at y = -112.5
BEFORE_IT = vehicle("leader", "south_in north_out", 1, 140.0, 12.0)  # its centre at y = -82.5


def seen_scenes(folder: Path, network: str, *vehicles: str) -> tuple[list[Scene], Scenes]:
    """The scenes of the first steps of a drive, and what made them."""
    scenes = Scenes()
    with drive(folder, network, vehicles, scenes) as (moving, watcher):
        steps(moving, 3)
        return list(watcher.kept), scenes


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """110 m before the line of the minor road, behind a leader."""
    return seen_scenes(tmp_path_factory.mktemp("scene"), "priority_crossing", FROM_SOUTH, BEFORE_IT)[0][0]


def lanelets(scene: Scene) -> Mapping[str, Any]:
    """The lanelets by SUMO's names of their lanes."""
    network = scene.scenario.lanelet_network
    return {name: network.find_lanelet_by_id(number) for name, number in scene.lanelets.items()}


def test_the_ego_is_on_the_lanelet_of_its_lane(scene: Scene) -> None:
    state = scene.initial_state
    on = [each for each in scene.scenario.lanelet_network.lanelets if each.polygon.contains_point(state.position)]
    assert [each.lanelet_id for each in on] == [scene.lanelets["south_in_1"]]
    assert state.position.tolist() == pytest.approx([1.6, -112.5])
    assert (state.time_step, state.orientation) == (0, pytest.approx(math.pi / 2))
    assert state.velocity == pytest.approx(12.0)


def test_boundaries_are_half_a_width_from_the_centre(scene: Scene) -> None:
    """The inner lane from the south is between x = 0 and 3.2, and the oncoming one shares the line x = 0."""
    inner, oncoming = lanelets(scene)["south_in_1"], lanelets(scene)["south_out_1"]
    assert inner.left_vertices.tolist() == [[0.0, -220.0], [0.0, -12.4]]
    assert inner.right_vertices.tolist() == [[3.2, -220.0], [3.2, -12.4]]
    assert oncoming.left_vertices[::-1].tolist() == inner.left_vertices.tolist()


def test_points_that_the_line_does_not_need_are_left_out() -> None:
    """Imported lanes have a point every 0.5 m. A bend of 50 m radius needs one every 2 m: 2 * 2 / 8 / 50 = 0.01 m."""
    straight = np.column_stack([np.arange(0.0, 2000.5, 0.5), np.zeros(4001)])
    turned = np.arange(0.0, 1.0, 0.01)
    bend = 50.0 * np.column_stack([np.sin(turned), 1.0 - np.cos(turned)])
    lanes = [Lane(name, line, 3.2, 30.0, "route") for name, line in (("straight", straight), ("bend", bend))]
    one, two = Scenes().lanelet_network(lanes).lanelets
    assert one.center_vertices.tolist() == [[0.0, 0.0], [2000.0, 0.0]]
    assert 25 <= len(two.center_vertices) < 60
    kept = LineString(two.center_vertices)
    assert max(kept.distance(Point(each)) for each in bend) <= 0.01


def test_lanelets_beside_each_other_say_in_which_direction(scene: Scene) -> None:
    by_name = lanelets(scene)
    inner = by_name["south_in_1"]
    assert (inner.adj_right, inner.adj_right_same_direction) == (scene.lanelets["south_in_0"], True)
    assert (inner.adj_left, inner.adj_left_same_direction) == (scene.lanelets["south_out_1"], False)
    assert by_name["south_in_0"].adj_left == scene.lanelets["south_in_1"] and by_name["south_in_0"].adj_right is None
    assert by_name[":centre_9_1"].adj_left is None  # within the junction


@pytest.mark.parametrize("network", ["priority_crossing", "left_hand_crossing"])
def test_links_are_those_of_sumos_connections(network: str, tmp_path: Path) -> None:
    """Each connection of sumolib, through its internal lanes, and no other; both directions of each link."""
    first = seen_scenes(tmp_path, network, FROM_SOUTH)[0][0]
    net = readNet(str(data_folder("networks") / f"{network}.net.xml"), withInternal=True)
    wanted = set()
    for name in first.lanelets:
        for connection in net.getLane(name).getOutgoing():
            after = connection.getViaLaneID() or connection.getToLane().getID()
            if after in first.lanelets:
                wanted.add((first.lanelets[name], first.lanelets[after]))
    all_lanelets = first.scenario.lanelet_network.lanelets
    assert {(each.lanelet_id, after) for each in all_lanelets for after in each.successor} == wanted
    assert {(before, each.lanelet_id) for each in all_lanelets for before in each.predecessor} == wanted
    assert len(wanted) > 8


def test_in_left_hand_traffic_the_oncoming_lanelet_is_on_the_right(tmp_path: Path) -> None:
    first = seen_scenes(tmp_path, "left_hand_crossing", FROM_SOUTH)[0][0]
    inner = lanelets(first)["south_in_1"]
    assert (inner.adj_right, inner.adj_right_same_direction) == (first.lanelets["south_out_1"], False)
    assert (inner.adj_left, inner.adj_left_same_direction) == (first.lanelets["south_in_0"], True)


def test_a_road_user_goes_straight_on_at_its_speed(scene: Scene) -> None:
    """The leader at 12 m/s: 1.2 m in each step of 0.1 s, for 6 s."""
    (leader,) = scene.scenario.dynamic_obstacles
    assert leader.obstacle_id == scene.obstacles["leader"] and leader.obstacle_type is ObstacleType.CAR
    assert (leader.obstacle_shape.length, leader.obstacle_shape.width) == pytest.approx((5.0, 2.0))
    states = leader.prediction.trajectory.state_list
    assert [state.time_step for state in states] == list(range(1, 61))
    begin, first, last = leader.initial_state, states[0], states[-1]
    speed = begin.velocity
    assert (first.position - begin.position).tolist() == pytest.approx([0.0, 0.1 * speed])
    assert (last.position - begin.position).tolist() == pytest.approx([0.0, 6.0 * speed])
    assert last.velocity == pytest.approx(speed)


def test_a_prediction_may_be_given(tmp_path: Path) -> None:
    def stands(other: VehicleState, times: Floats) -> Floats:
        return np.tile([other.x, other.y, other.heading], (len(times), 1))

    scenes = Scenes(stands, horizon=1.0, step=0.2)
    with drive(tmp_path, "priority_crossing", [FROM_SOUTH, BEFORE_IT], scenes) as (moving, watcher):
        steps(moving, 2)
        (leader,) = watcher.kept[0].scenario.dynamic_obstacles
    states = leader.prediction.trajectory.state_list
    assert [state.position.tolist() for state in states] == [leader.initial_state.position.tolist()] * 5
    assert watcher.kept[0].scenario.dt == 0.2


def test_a_prediction_of_another_shape_is_refused() -> None:
    other = VehicleState("other", 0.0, 0.0, 0.0, 1.0, 0.0, 5.0, 2.0, "road_0")
    with pytest.raises(UsageError, match=r"prediction of 'other' has the shape \(3, 3\).*each of the 60 times"):
        Scenes(lambda vehicle, times: np.zeros((3, 3))).obstacle(other)


def test_numbers_and_the_network_last(tmp_path: Path) -> None:
    """The map is made again after 10 m; a lane and a vehicle keep their numbers."""
    kept, _ = seen_scenes(tmp_path, "priority_crossing", FROM_SOUTH, BEFORE_IT)
    assert kept[0].scenario.lanelet_network is kept[1].scenario.lanelet_network
    assert kept[0].lanelets == kept[1].lanelets and kept[0].obstacles == kept[1].obstacles
    numbers = [*kept[0].lanelets.values(), *kept[0].obstacles.values(), kept[0].problem.planning_problem_id]
    assert len(set(numbers)) == len(numbers)


def test_the_reference_path_begins_behind_the_ego_and_ends_in_the_goal(scene: Scene) -> None:
    """It goes straight north at x = 1.6, from 15 m before the ego's centre on."""
    path = scene.reference_path
    assert path[0].tolist() == pytest.approx([1.6, -127.5], abs=0.01)
    assert np.abs(path[:, 0] - 1.6).max() < 0.01 and (np.diff(path[:, 1]) > 0.9).all()
    assert path[-1, 1] > -112.5 + 60.0
    (goal,) = scene.problem.goal.state_list
    assert goal.position.center.tolist() == path[-1].tolist()
    assert not scene.problem.goal.is_reached(scene.initial_state)


def test_the_ego_slows_down_before_a_lower_limit() -> None:
    """20 m before a limit of 8 m/s, braking with 2 m/s2: 12 m/s, as 8 * 8 + 2 * 2 * 20 = 12 * 12."""
    ego = VehicleState("ego", 0.0, 0.0, 0.0, 14.0, 0.0, 5.0, 2.0, "road_0")
    road = Road(15.0, limits=(SpeedLimit(-5.0, 13.9), SpeedLimit(20.0, 8.0)))
    seen = Observation(0.0, 0.1, ego, (), path=((0.0, 0.0), (50.0, 0.0)), road=road)
    assert Scenes()(seen).speed_limit == pytest.approx(12.0)
    assert Scenes()(replace(seen, road=Road(15.0))).speed_limit == 15.0


def test_a_line_where_the_ego_must_wait_is_shut(tmp_path: Path) -> None:
    """While the light is red an obstacle of 0.5 m stands behind the line at y = -12.4, and none while it is green."""
    scenes = Scenes()
    coming = vehicle("ego", "south_in north_out", 1, 150.0, 12.0)
    with drive(tmp_path, "signalised_crossing", [coming], lambda seen: (seen.road.must_wait, scenes(seen))) as (
        moving, watcher,
    ):  # fmt: skip
        steps(moving, 400)
        shut = {wait: [scene.scenario.static_obstacles for must, scene in watcher.kept if must is wait]
                for wait in (True, False)}  # fmt: skip
    assert shut[True] and shut[False] and not any(shut[False])
    for (line,) in shut[True]:
        assert line.initial_state.position.tolist() == pytest.approx([1.6, -12.15], abs=0.05)
        assert (line.obstacle_shape.length, line.obstacle_shape.width) == pytest.approx((0.5, 3.2))


def test_commonroad_io_reads_back_what_it_writes(scene: Scene, tmp_path: Path) -> None:
    file = tmp_path / "scene.xml"
    CommonRoadFileWriter(scene.scenario, PlanningProblemSet([scene.problem]), "sumo_adv", "", "", set()).write_to_file(
        str(file), OverwriteExistingFile.ALWAYS
    )
    scenario, problems = CommonRoadFileReader(str(file)).open()
    (problem,) = problems.planning_problem_dict.values()
    written = {each.lanelet_id: each for each in scene.scenario.lanelet_network.lanelets}
    assert {each.lanelet_id for each in scenario.lanelet_network.lanelets} == set(written)
    for each in scenario.lanelet_network.lanelets:
        assert sorted(each.successor) == sorted(written[each.lanelet_id].successor)
        assert (each.adj_left, each.adj_left_same_direction) == (
            written[each.lanelet_id].adj_left, written[each.lanelet_id].adj_left_same_direction,
        )  # fmt: skip
    assert problem.initial_state.position.tolist() == pytest.approx(scene.initial_state.position.tolist(), abs=1e-3)
    assert len(scenario.dynamic_obstacles[0].prediction.trajectory.state_list) == 60
    network = scenario.lanelet_network
    (sign,) = network.find_lanelet_by_id(scene.lanelets["south_in_1"]).traffic_signs
    assert network.find_traffic_sign_by_id(sign).traffic_sign_elements[0].additional_values == ["13.9000"]


def test_without_a_path_there_is_no_scene() -> None:
    ego = VehicleState("ego", 0.0, 0.0, 0.0, 1.0, 0.0, 5.0, 2.0, "")
    with pytest.raises(UsageError, match="Off the road, there is no CommonRoad scene"):
        Scenes()(replace(Observation(0.0, 0.1, ego, ()), road=Road(13.9)))
