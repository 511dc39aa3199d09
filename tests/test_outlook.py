"""What is foreseen from the states up to now alone: numbers worked out by hand, and what SUMO then does."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from sumo_samples import make_spec, vehicle

from sumo_adv.drivers import ExternalEgo
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.traffic_forecast import FORECAST_MIN_GAP_M, apart, traffic_forecast
from sumo_adv.geometry import Pose
from sumo_adv.simulation.network import RoadMap, read_network
from sumo_adv.simulation.simulation_spec import SimulationSpec


@contextmanager
def scene(folder: Path, network: str, *vehicles: str, steps: int = 1) -> Iterator[tuple[RoadMap, Drive]]:
    spec = make_spec(folder, network, vehicles)
    drive = Drive(spec, ExternalEgo(), 1)
    try:
        for _ in range(steps):
            drive.tick()
        drive.take_over("ego")
        yield read_network(spec.network), drive
    finally:
        drive.simulation.close()


def test_alone_it_keeps_speed_and_lane(tmp_path: Path) -> None:
    with scene(tmp_path, "straight_3lane", vehicle("ego", "eastbound", 0, 100.0, 20.0), steps=3) as (road, drive):
        time, at, speed = drive.now, drive.state("ego"), drive.state("ego").speed
        track = traffic_forecast(road, drive, 4.0)["ego"]
        assert track.time[0] == pytest.approx(0.1) and track.time[-1] == pytest.approx(time + 4.0)
        i = int(np.argmin(np.abs(track.time - time)))
        assert (track.x[i], track.y[i], track.speed[i]) == pytest.approx((at.x, at.y, at.speed))
        # its acceleration a dies away: v gains at most a * 1 s; without one, 4 s at v
        assert track.x[-1] - at.x == pytest.approx(4.0 * speed, abs=4.0 * abs(at.acceleration) + 0.05)
        assert np.allclose(track.y, at.y, atol=1e-6) and set(track.lane) == {"eastbound_0"}


def test_no_vehicle_drives_through_a_leader(tmp_path: Path) -> None:
    slow = vehicle("slow", "eastbound", 0, 160.0, 3.0, "crawling")
    ego = vehicle("ego", "eastbound", 0, 30.0, 15.0)
    spec_type = '<vType id="crawling" vClass="passenger" maxSpeed="3" sigma="0" length="5"/>'
    with scene(tmp_path, "straight_3lane", spec_type, slow, ego) as (road, drive):
        tracks = traffic_forecast(road, drive, 20.0)
        gap = tracks["slow"].x - tracks["ego"].x - 5.0
        assert gap.min() > FORECAST_MIN_GAP_M - 0.5
        assert tracks["ego"].speed[-1] == pytest.approx(3.0, abs=0.3)  # behind it, at its speed
        assert tracks["ego"].acceleration.min() >= -9.0 - 1e-6


def test_it_turns_where_its_route_turns_and_slows_for_the_bend(tmp_path: Path) -> None:
    ego = vehicle("ego", "south_in east_out", 0, 150.0, 13.0)
    with scene(tmp_path, "priority_crossing", ego) as (road, drive):
        track = traffic_forecast(road, drive, 14.0)["ego"]
        assert track.heading[0] == pytest.approx(math.pi / 2) and track.heading[-1] == pytest.approx(0.0, abs=0.05)
        assert track.lane[-1].startswith("east_out") and any(lane.startswith(":") for lane in track.lane)
        inside = np.array([lane.startswith(":") for lane in track.lane])
        assert track.speed[inside].max() < 9.5 and track.speed[0] == pytest.approx(13.0, abs=0.3)


def test_it_stops_at_a_red_light(tmp_path: Path) -> None:
    ego = vehicle("ego", "south_in north_out", 1, 60.0, 12.0)
    with scene(tmp_path, "signalised_crossing", ego) as (road, drive):
        for _ in range(900):
            if "ego" not in drive.snapshot.raw or drive.simulation.signals("ego")[0][2] in "rR":
                break
            drive.tick()
        ((_, distance, light),) = drive.simulation.signals("ego")[:1]
        assert light in "rR" and distance > 5.0
        track = traffic_forecast(road, drive, 30.0)["ego"]
        state = drive.state("ego")
        way = math.hypot(track.x[-1] - state.x, track.y[-1] - state.y)
        assert track.speed[-1] == pytest.approx(0.0, abs=0.05) and way <= distance


def test_off_the_road_it_goes_straight_on(tmp_path: Path) -> None:
    with scene(tmp_path, "straight_3lane", vehicle("ego", "eastbound", 0, 100.0, 10.0)) as (road, drive):
        for k in range(3):
            drive.tick({"ego": Pose(120.0 + k, -60.0, 0.1, 10.0)})
        assert drive.state("ego").lane == ""
        track = traffic_forecast(road, drive, 2.0)["ego"]
        assert track.x[-1] - drive.state("ego").x == pytest.approx(20.0 * math.cos(0.1), abs=0.1)
        assert track.lane[-1] == ""


def test_how_far_a_vehicle_strayed(tmp_path: Path) -> None:
    others = vehicle("next", "eastbound", 1, 100.0, 15.0)
    with scene(tmp_path, "straight_3lane", vehicle("ego", "eastbound", 0, 100.0, 15.0), others) as (road, drive):
        tracks = traffic_forecast(road, drive, 2.0)
        for _ in range(10):
            drive.tick()
        away, faster = apart(tracks, drive.state("ego"), drive.now)
        assert away < 1.5 and faster == pytest.approx(2.6, abs=0.1)  # it has just come: its acceleration is not known
        assert apart(tracks, drive.state("ego"), drive.now + 5.0) == (math.inf, math.inf)
        assert apart({}, drive.state("ego"), drive.now) == (math.inf, math.inf)


@pytest.mark.parametrize("network", ["straight_3lane", "two_way", "priority_crossing", "signalised_crossing"])
def test_most_are_where_they_were_foreseen(tmp_path: Path, network: str) -> None:
    """Median distance after 3 s in generated traffic; measured 0.2 to 0.5 m on these networks."""
    from sumo_adv.simulation.demand import generate_demand
    from sumo_adv.simulation.inputs import data_folder

    net = data_folder("networks") / f"{network}.net.xml"
    spec = SimulationSpec(net, (generate_demand(net, tmp_path / "d.rou.xml", seed=1, end=60.0),), (), 0.0, 1)
    road, drive, missed = read_network(net), Drive(spec, ExternalEgo(), 1), []
    try:
        for _ in range(8):
            for _ in range(50):
                drive.tick()
            drive.ego = next((n for n, raw in drive.snapshot.raw.items() if raw[3] > 4.0), None)
            if drive.ego is None:
                continue
            tracks = traffic_forecast(road, drive, 3.0)
            for _ in range(30):
                drive.tick()
            missed += [apart(tracks, drive.state(n), drive.now)[0] for n in tracks if n in drive.snapshot.raw]
    finally:
        drive.simulation.close()
    assert len(missed) > 20 and float(np.median(missed)) < 1.0
