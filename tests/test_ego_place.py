"""The ego's path stays on its route, whatever lane SUMO takes its centre to be over.

The road runs from x = 0 to 600 with a lane each way, 3.2 m wide: eastbound at y = -1.6, westbound at y = 1.6.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from road_samples import drive, steps
from sumo_samples import make_net, make_spec, vehicle

from sumo_adv.drivers import Action, ExternalEgo, Observation
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.encounter_detector import ego_path
from sumo_adv.episode.situation_builder import trigger_state
from sumo_adv.episode.traffic_forecast import traffic_forecast
from sumo_adv.geometry import Pose
from sumo_adv.simulation.network import read_network

NODES = '<node id="w" x="0" y="0"/><node id="e" x="600" y="0"/><node id="f" x="900" y="0"/>'
EDGES = (
    '<edge id="we" from="w" to="e" numLanes="1" speed="25"/><edge id="ew" from="e" to="w" numLanes="1" speed="13"/>'
    '<edge id="ef" from="e" to="f" numLanes="1" speed="25"/><edge id="fe" from="f" to="e" numLanes="1" speed="13"/>'
)


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_net(tmp_path_factory.mktemp("net"), NODES, EDGES, "--opposites.guess")


def told(seen: Observation) -> dict[str, Any]:
    road = seen.road
    assert road is not None and seen.path is not None
    return {
        "x": seen.ego.x, "y": seen.ego.y, "sumo": seen.ego.lane, "heading": seen.lane_heading,
        "offset": seen.lane_offset, "path": list(seen.path), "until": road.until, "limit": road.limits[0].speed,
        "on_route": {lane.id for lane in road.lanes if lane.on_route},
        "turned": seen.ego.heading,
    }  # fmt: skip


def swerves(to: float, then: Callable[[Observation], Action], heading: float = 0.0) -> Callable[[Observation], Action]:
    """From 1 s on 15 m/s ahead and 2 m/s to the left, up to y = ``to``; from 5 s on what ``then`` says."""

    def answer(seen: Observation) -> Action:
        ego, dt = seen.ego, seen.dt
        if seen.time < 1.0:
            return None
        if seen.time > 5.0:
            return then(seen)
        return Pose(ego.x + 15.0 * dt, min(ego.y + 2.0 * dt, to), heading, 15.0)

    return answer


def returns(seen: Observation) -> Action:
    ego, dt = seen.ego, seen.dt
    return Pose(ego.x + 15.0 * dt, max(ego.y - 2.0 * dt, -1.6), 0.0, 15.0)


EGO = vehicle("ego", "we ef", 0, 50.0, 15.0)


def check_on_route(kept: Mapping[str, Any], edge_end: float) -> None:
    """What it is told is of the eastbound lane."""
    assert kept["heading"] == pytest.approx(0.0)
    assert kept["offset"] == pytest.approx(kept["y"] + 1.6, abs=0.01)
    assert all(y == pytest.approx(-1.6, abs=0.05) for _, y in kept["path"])
    assert kept["path"][-1][0] > kept["path"][0][0] + 100.0
    assert kept["until"] == pytest.approx(edge_end - kept["x"], abs=0.2)
    assert kept["limit"] == 25.0 and "we_0" in kept["on_route"] and "ew_0" not in kept["on_route"]


@pytest.mark.parametrize("heading", [0.0, 0.4, math.pi / 2 - 0.01])
def test_over_the_centre_line_the_path_stays_on_the_route(net: Path, tmp_path: Path, heading: float) -> None:
    """Its centre goes to y = 0.9, also where it stands nearly across; then it comes back."""
    end = float(read_network(net).lanes["we_0"].shape[-1, 0])
    with drive(tmp_path, net, [EGO], told, swerves(0.9, returns, heading)) as (moving, watcher):
        steps(moving, 100)
        route = moving.simulation.route("ego")[0]
    assert {kept["sumo"] for kept in watcher.kept} == {"we_0", "ew_0"}
    for kept in watcher.kept:
        check_on_route(kept, end)
    assert route == ("we", "ef")  # SUMO's own, which it had replaced


def test_an_ego_that_is_given_back_on_the_wrong_side_does_not_turn_round(net: Path, tmp_path: Path) -> None:
    with drive(tmp_path, net, [EGO], told, swerves(1.6, lambda _: None)) as (moving, watcher):
        steps(moving, 200)
        assert moving.simulation.route("ego")[0] == ("we", "ef")
    assert max(abs(kept["turned"]) for kept in watcher.kept) < 0.6
    assert all(after["x"] > before["x"] for before, after in pairwise(watcher.kept))
    assert watcher.kept[-1]["y"] == pytest.approx(-1.6, abs=0.3)


def test_a_route_that_comes_back_on_the_other_side_is_not_taken_for_its_way_back(net: Path, tmp_path: Path) -> None:
    """Eastbound from x = 600 on, back on the other side from x = 900 on."""
    ego = vehicle("ego", "ef fe", 0, 50.0, 15.0)
    with drive(tmp_path, net, [ego], told, swerves(1.2, returns)) as (moving, watcher):
        steps(moving, 100)
        assert moving.simulation.route("ego")[0] == ("ef", "fe")
    assert "fe_0" in {kept["sumo"] for kept in watcher.kept}
    for kept in watcher.kept:
        assert kept["heading"] == pytest.approx(0.0) and kept["offset"] == pytest.approx(kept["y"] + 1.6, abs=0.01)


OVERTAKER = '<vType id="quick" sigma="0" speedDev="0" lcOpposite="10" maxSpeed="25"/>'
OVERTAKER += '<vType id="slow" sigma="0" speedDev="0" maxSpeed="6"/>'


def test_where_sumo_overtakes_on_the_other_side_the_path_stays(net: Path, tmp_path: Path) -> None:
    cars = [
        OVERTAKER, vehicle("slow", "we ef", 0, 100.0, 6.0, "slow"), vehicle("ego", "we ef", 0, 50.0, 15.0, "quick"),
    ]  # fmt: skip
    with drive(tmp_path, net, cars, told) as (moving, watcher):
        steps(moving, 150)
    overtaking = [kept for kept in watcher.kept if kept["sumo"] == "ew_0"]
    assert overtaking
    end = float(read_network(net).lanes["we_0"].shape[-1, 0])
    for kept in overtaking:
        check_on_route(kept, end)


@pytest.mark.parametrize("known", [True, False])
def test_what_searches_and_judges_takes_the_same_path(net: Path, tmp_path: Path, known: bool) -> None:
    """The encounter's path and the forecast of an ego that another program has on the other side, whose route SUMO
    knows or not."""
    cars = [EGO, vehicle("far", "fe ew", 0, 100.0, 13.0)]
    moving, road = Drive(make_spec(tmp_path, net, cars), ExternalEgo(), 1), read_network(net)
    try:
        moving.simulation.unrouted = frozenset() if known else frozenset({"ego"})
        moving.tick()
        moving.take_over("ego")
        for k in range(20):
            assert ego_path(road, moving) is not None
            moving.tick({"ego": Pose(50.0 + 1.5 * k, min(-1.6 + 0.2 * k, 1.0), 0.0, 15.0)})
        assert moving.state("ego").lane == "ew_0"
        path = ego_path(road, moving)
        assert path is not None and path.x[-1] > path.x[0] + 300.0
        track = traffic_forecast(road, moving, 4.0)["ego"]
        assert track.x[-1] > moving.state("ego").x + 50.0
        assert trigger_state(road, moving, []).route == (("we", "ef") if known else ())
    finally:
        moving.simulation.close()


def cuts(points: Sequence[tuple[float, float]], speed: float) -> Callable[[Observation], Action]:
    """Straight from point to point at a constant speed."""
    legs = [(math.dist(a, b), a, b) for a, b in pairwise(points)]
    gone = [0.0]

    def answer(seen: Observation) -> Action:
        gone[0] += speed * seen.dt
        left = gone[0]
        for length, (ax, ay), (bx, by) in legs:
            if left <= length:
                part, heading = left / length, math.atan2(by - ay, bx - ax)
                return Pose(ax + part * (bx - ax), ay + part * (by - ay), heading, speed)
            left -= length
        return None

    return answer


def test_a_cut_corner_is_still_the_turn_of_its_route(tmp_path: Path) -> None:
    """A left turn from the south that cuts across the lanes of those that come from the west."""
    ego = vehicle("ego", "south_in west_out", 1, 180.0, 8.0)
    way = [(1.6, -42.5), (1.6, -24.0), (-24.0, 1.6), (-60.0, 1.6)]
    lanes = []

    def look(seen: Observation) -> Any:
        lanes.append(seen.ego.lane)
        assert seen.road is not None
        return {lane.id for lane in seen.road.lanes if lane.on_route}, seen.path

    with drive(tmp_path, "priority_crossing", [ego], look, cuts(way, 8.0)) as (moving, watcher):
        steps(moving, 90)
        assert moving.simulation.route("ego")[0][-1] == "west_out"
    road = read_network(make_spec(tmp_path, "priority_crossing", []).network)
    strayed = {road.lanes[name].edge for name in lanes if name}
    assert strayed - {"south_in", "west_out"}  # SUMO has it on others
    for on_route, path in (told for told in watcher.kept if told[1] is not None):  # None off all lanes
        edges = {road.lanes[name].edge for name in on_route if not road.lanes[name].internal}
        assert edges <= {"south_in", "west_out"} and path[-1][0] < path[0][0] + 5.0
