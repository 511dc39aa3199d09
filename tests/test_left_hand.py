"""Left-hand traffic: the mirrored network with the same demand gives the mirrored encounter and the same verdict."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from mirrors import both_ways, farthest
from sumo_samples import make_net

from sumo_adv.geometry import Frame
from sumo_adv.simulation.human_errors import ErrorKind, HumanErrors
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.network import read_network
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.simulation_spec import SimulationSpec

LEFT, RIGHT = (data_folder("networks") / f"{name}.net.xml" for name in ("left_hand_crossing", "priority_crossing"))


def test_lanes_are_counted_from_the_right_and_the_oncoming_lane_is_on_the_right() -> None:
    """Eastbound the outer lane is the northern one, at y = 4.8 m; the other direction begins at y = 0."""
    road = read_network(LEFT)
    assert (road.hand, read_network(RIGHT).hand) == (-1.0, 1.0)
    assert road.edges["west_in"] == ("west_in_1", "west_in_0")
    assert [road.lanes[name].index for name in road.edges["west_in"]] == [0, 1]
    assert road.lanes["west_in_0"].shape[0, 1] == pytest.approx(4.8)
    sides = road.side_offsets("west_in_0", -100.0, 4.8, 0.0)
    assert [(pytest.approx(o), kind) for o, kind in sides] == [(-3.2, "same"), (-6.4, "opposite")]


def test_the_turn_to_the_near_side_is_the_left_one() -> None:
    """The turn across the oncoming traffic, which gives way, is the right one."""
    road = read_network(LEFT)
    assert [(w.movement, w.gives_way) for w in road.ways("west_in_0", 107.6, 150.0)] == [
        ("straight", False), ("left", False),
    ]  # fmt: skip
    assert [(w.movement, w.gives_way) for w in road.ways("west_in_1", 107.6, 150.0)] == [
        ("straight", False), ("right", True),
    ]  # fmt: skip


def test_a_turnaround_is_a_u_turn(tmp_path: Path) -> None:
    """SUMO writes ``T`` for it in left-hand traffic."""
    nodes = '<node id="a" x="0" y="0"/><node id="b" x="100" y="0"/>'
    edges = '<edge id="there" from="a" to="b"/><edge id="back" from="b" to="a"/>'
    road = read_network(make_net(tmp_path, nodes, edges, "--lefthand"))
    assert [(c.to, c.movement) for c in road.lanes["there_0"].connections] == [("back_0", "u-turn")]


def test_planners_see_the_mirrored_scene_and_their_poses_are_mirrored_back() -> None:
    """The ego heads north at (10, 20). 3 m to its right, east, and 5 m ahead is (5, 3) for a left-hand planner."""
    frame = Frame(10.0, 20.0, math.pi / 2, -1.0)
    assert frame.to_local(13.0, 25.0, math.pi / 4) == pytest.approx((5.0, 3.0, math.pi / 4))
    assert frame.to_world(5.0, 3.0, math.pi / 4) == pytest.approx((13.0, 25.0, math.pi / 4))


def test_a_driver_on_the_outer_lane_can_err_to_the_right_only(tmp_path: Path) -> None:
    routes = tmp_path / "one.rou.xml"
    routes.write_text(
        '<routes><vehicle id="one" depart="0" departLane="0" departPos="20" departSpeed="10">'
        '<route edges="west_in east_out"/></vehicle></routes>'
    )
    simulation = Simulation(SimulationSpec(LEFT, (routes,), (), 0.0, 1))
    try:
        simulation.step()
        snapshot = simulation.read()
        errors = HumanErrors(simulation)
        possible = set(errors.possible("one", snapshot.raw["one"]))
        assert {ErrorKind.CHANGE_RIGHT, ErrorKind.DRIFT_RIGHT} <= possible
        assert not {ErrorKind.CHANGE_LEFT, ErrorKind.DRIFT_LEFT} & possible
        before = snapshot.raw["one"][1]
        errors.begin("one", ErrorKind.DRIFT_RIGHT, snapshot.raw["one"][3])
        for _ in range(30):
            errors.before_step()
            simulation.step()
        snapshot = simulation.read()
        assert snapshot.raw["one"][1] < before - 1.0  # it drives east: to the right is south
    finally:
        simulation.close()


@pytest.mark.parametrize("name", ["oncoming_country_road", "motorway_cut_in_left", "priority_straight_from_left"])
def test_the_same_proposal_gives_the_mirrored_attack_and_the_same_verdict(name: str, tmp_path: Path) -> None:
    ours, mirrored = both_ways(name, tmp_path)
    assert mirrored.ranking == ours.ranking
    assert (mirrored.level, mirrored.fault) == (ours.level, ours.fault)
    assert farthest(ours.tracks, mirrored.tracks) < 1e-4  # m; measured: below 5e-5
