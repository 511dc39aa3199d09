"""SUMO's lane positions are scaled to the lane's shape: proved against SUMO's own ``convert2D`` and ``getPosition``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from road_samples import drive, steps
from sumo_samples import make_net, make_spec, vehicle

from sumo_adv.drivers import ExternalEgo, Observation
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.encounter_detector import EncounterDetector, ego_path
from sumo_adv.episode.road_place import place_of
from sumo_adv.episode.situation_builder import trigger_state
from sumo_adv.episode.traffic_forecast import traffic_forecast
from sumo_adv.simulation.human_errors import ErrorKind, HumanErrors
from sumo_adv.simulation.network import read_network
from sumo_adv.simulation.simulation import Simulation

NODES = '<node id="a" x="0" y="0" z="0"/><node id="b" x="500" y="0" z="20" type="traffic_light"/>'
NODES += '<node id="c" x="700" y="300"/><node id="d" x="500" y="-200"/>'
EDGES = '<edge id="ab" from="a" to="b" numLanes="2" speed="13.9" length="1000"/>'
EDGES += '<edge id="db" from="d" to="b" numLanes="1" speed="13.9"/>'
EDGES += '<edge id="bc" from="b" to="c" numLanes="4" speed="13.9" shape="500,0 600,0 660,40 690,120 700,300"/>'


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A road whose map says 1000 m for its 490 m, uphill, and a four-lane bend behind it."""
    return make_net(tmp_path_factory.mktemp("net"), NODES, EDGES)


def test_places_are_where_sumo_has_them(net: Path, tmp_path: Path) -> None:
    road, simulation = read_network(net), Simulation(make_spec(tmp_path, net, []))
    off = []
    try:
        for lane in road.lanes.values():
            length = float(simulation.api.lane.getLength(lane.id))
            index = int(lane.id.rpartition("_")[2])
            for part in (0.0, 0.1, 0.37, 0.5, 0.81, 1.0):
                there = simulation.api.simulation.convert2D(lane.edge, part * length, index)
                off.append(math.dist(there, lane.point_at(lane.station_of(part * length))[:2]))
                assert lane.position_of(lane.station_of(part * length)) == pytest.approx(part * length, abs=1e-6)
    finally:
        simulation.close()
    assert max(off) < 1e-6
    outer, inner = road.lanes["bc_0"], road.lanes["bc_3"]
    assert outer.length - inner.length > 10.0  # SUMO gives both the length of the middle


CARS = [
    vehicle("ego", "ab bc", 0, 300.0, 10.0), vehicle("lead", "ab bc", 0, 340.0, 10.0),
    vehicle("left", "ab bc", 1, 310.0, 10.0),
]  # fmt: skip
"""At ``ab``, where 1 m of the shape is some 2 m of SUMO's."""


def told(seen: Observation) -> Mapping[str, Any]:
    road = seen.road
    assert road is not None and seen.path is not None
    ahead = [limit.ahead for limit in road.limits] + [line.ahead for line in road.stop_lines]
    return {"x": seen.ego.x, "path": seen.path[0], "until": road.until, "ahead": ahead}


def test_the_driver_is_told_of_the_road_where_it_is(net: Path, tmp_path: Path) -> None:
    """Its front begins 300 of 1000 along a lane that ends at x = 492.8 or so: near x = 148."""
    end = float(read_network(net).lanes["ab_0"].shape[-1, 0])
    with drive(tmp_path, net, CARS, told) as (moving, watcher):
        steps(moving, 3)
    first = watcher.kept[0]
    assert first["x"] == pytest.approx(0.3 * end - 2.5, abs=1.5)
    assert first["path"][0] == pytest.approx(first["x"], abs=0.1)
    assert first["until"] == pytest.approx(end - first["x"], abs=0.1)
    assert first["ahead"][0] == pytest.approx(-first["x"], abs=0.1)


def test_encounters_and_forecasts_begin_where_the_vehicles_are(net: Path, tmp_path: Path) -> None:
    moving = Drive(make_spec(tmp_path, net, CARS), ExternalEgo(), 1)
    road = read_network(net)
    try:
        for _ in range(3):
            moving.tick()
        moving.take_over("ego")
        path, ego = ego_path(road, moving), moving.state("ego")
        assert path is not None and (path.x[0], path.y[0]) == pytest.approx((ego.x, ego.y), abs=0.2)
        for ranked in EncounterDetector(road, 5).rank(moving):
            state = moving.state(ranked.id)
            begins = [(way.path.x[0], way.path.y[0]) for way in ranked.ways]
            assert begins == [pytest.approx((state.x, state.y), abs=0.2) for _ in begins]
        assert place_of(road, moving).limit == 13.9
        (light,) = trigger_state(road, moving, []).signals["ego"]
        assert light[1] == pytest.approx(road.lanes["ab_0"].shape[-1, 0] - ego.x - 2.5, abs=0.1)
        track = traffic_forecast(road, moving, 3.0)["ego"]
        assert np.diff(track.x).max() < 1.6  # of 0.1 s: it does not jump
    finally:
        moving.simulation.close()


def test_a_driver_errs_at_a_line_that_is_near(net: Path, tmp_path: Path) -> None:
    """SUMO's positions 930 and 910 of 1000 are 34 and 44 m before the line; errors at lines begin within 40 m."""
    cars = [vehicle("near", "ab bc", 0, 930.0, 5.0), vehicle("far", "ab bc", 1, 910.0, 5.0)]
    simulation = Simulation(make_spec(tmp_path, net, cars))
    try:
        simulation.step()
        simulation.api.trafficlight.setRedYellowGreenState("b", "r" * len(simulation.light("b")))
        errors, raw = HumanErrors(simulation), simulation.read().raw
        at_line = {name for name in sorted(raw) if ErrorKind.RED_LIGHT in errors.possible(name, raw[name])}
    finally:
        simulation.close()
    assert at_line == {"near"}
