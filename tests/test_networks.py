"""The shipped networks and scenarios: built as their sources say, clean, and calm without an attack."""

from __future__ import annotations

import importlib.util
import math
import re
import shutil
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import pytest

from sumo_adv.search.intents import COMPOSED
from sumo_adv.simulation.inputs import data_folder, load_input, shipped_names

NETWORKS = sorted(data_folder("networks").glob("*.net.xml"))
SCENARIOS = sorted(data_folder("scenarios").glob("*.toml"))
LABELS = {
    "Emergency Braking", "Close Car-following", "Aggressive Cut-in", "Opposite Direction Intrusion",
    "Intersection Rush-through Turn Left", "Intersection Rush-through Go-straight", "Straight Lane Shift",
    "Pedestrian Steps Out", "Pedestrian From Behind Obstacle", "Cyclist Crossing", "Cyclist Swerve",
    "Pedestrian Turns Back", "Cyclist Turns Back", "Cyclist Rides On",
}  # fmt: skip
BASE = (
    "--step-length", "0.1", "--seed", "1", "--time-to-teleport", "-1", "--collision.action", "warn",
    "--collision.mingap-factor", "0", "--collision.check-junctions", "--lanechange.duration", "3",
    "--xml-validation", "never", "--no-step-log", "--no-warnings",
)  # fmt: skip


def build_module() -> ModuleType:
    spec = importlib.util.spec_from_file_location("networks_build", data_folder("networks") / "build.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def lanes(path: Path) -> dict[str, tuple[float, float, list[tuple[float, float]]]]:
    """Lane id -> width, speed, points."""
    by_id = {}
    for lane in ElementTree.parse(path).iter("lane"):
        points = [(float(x), float(y)) for x, y in (pair.split(",")[:2] for pair in lane.attrib["shape"].split())]
        by_id[lane.attrib["id"]] = (float(lane.attrib["width"]), float(lane.attrib["speed"]), points)
    return by_id


def distance(point: tuple[float, float], line: list[tuple[float, float]]) -> float:
    """From a point to a polyline."""

    def to_segment(a: tuple[float, float], b: tuple[float, float]) -> float:
        dx, dy = b[0] - a[0], b[1] - a[1]
        share = ((point[0] - a[0]) * dx + (point[1] - a[1]) * dy) / (dx * dx + dy * dy)
        share = min(max(share, 0.0), 1.0)
        return math.dist(point, (a[0] + share * dx, a[1] + share * dy))

    return min(to_segment(a, b) for a, b in pairwise(line))


def test_there_are_23_networks_and_45_scenarios() -> None:
    assert len(NETWORKS) == 23
    assert len(SCENARIOS) == 45
    assert len(shipped_names()) == 68
    assert {path.name.removesuffix(".net.xml") for path in NETWORKS} == set(build_module().names())


@pytest.mark.parametrize("path", NETWORKS, ids=lambda path: path.name.removesuffix(".net.xml"))
def test_a_finished_network_tells_nothing_of_the_machine(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert not re.search(r"generated on|://|/tmp|/home|/root|/work|<configuration|value=", text)
    assert not re.search(r"\d{4}-\d{2}-\d{2}", text)


@pytest.mark.parametrize("name", ["two_way", "signalised_crossing"])
def test_a_rebuilt_network_is_the_same_byte_for_byte(name: str, tmp_path: Path) -> None:
    if not (Path(sys.executable).parent / "netconvert").is_file() and shutil.which("netconvert") is None:
        pytest.skip("netconvert is not installed (pip install eclipse-sumo)")
    rebuilt = build_module().build(name, tmp_path)
    assert rebuilt.read_bytes() == (data_folder("networks") / f"{name}.net.xml").read_bytes()


@pytest.mark.parametrize(
    ("name", "ours", "theirs"),
    [
        ("two_way", "eastbound_0", "westbound_0"),
        ("two_way_4lane", "eastbound_1", "westbound_1"),
        ("curved_road", "eastbound_0", "westbound_0"),
        ("priority_crossing", "west_in_1", "west_out_1"),
        ("t_junction", "south_in_0", "south_out_0"),
    ],
)
def test_oncoming_traffic_is_one_lane_width_away(name: str, ours: str, theirs: str) -> None:
    by_id = lanes(data_folder("networks") / f"{name}.net.xml")
    line = by_id[theirs][2]
    for point in by_id[ours][2][1:-1] or by_id[ours][2]:
        assert distance(point, line) == pytest.approx(3.2, abs=0.02)


def test_widths_and_speeds_are_those_of_the_kinds_of_road() -> None:
    figures = {"straight_3lane": ("eastbound_2", 3.2, 22.0), "motorway": ("eastbound_0", 3.5, 33.0)}
    figures |= {"allway_stop": ("south_in_0", 3.2, 13.9), "two_way": ("westbound_0", 3.2, 22.0)}
    for name, (lane, width, speed) in figures.items():
        assert lanes(data_folder("networks") / f"{name}.net.xml")[lane][:2] == (width, speed)


@pytest.fixture(scope="module")
def sumo() -> Iterator[ModuleType]:
    libsumo = pytest.importorskip("libsumo")
    yield libsumo
    libsumo.close()


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
def test_a_scenario_is_calm_unattacked_and_its_pair_is_there(path: Path, sumo: ModuleType) -> None:
    """No contact; the ego moves at the trigger (or at 5 s) and lives 12 s longer, as do at least two others."""
    case = load_input(path)
    assert case.label is not None
    assert set(case.label.intents) <= LABELS | COMPOSED
    moment = 5.0 if case.trigger == "auto" else float(case.trigger)
    sumo.start(["sumo", "-n", str(case.network), "-r", str(case.routes[0]), *BASE])
    present: dict[str, set[float]] = {}
    ego_speed = 0.0
    for _ in range(round((moment + 12.0) * 10)):
        sumo.simulationStep()
        time = round(sumo.simulation.getTime(), 1)
        assert sumo.simulation.getCollidingVehiclesNumber() == 0
        for vehicle in sumo.vehicle.getIDList():
            present.setdefault(vehicle, set()).add(time)
        if time == moment:
            ego_speed = sumo.vehicle.getSpeed("ego")
    assert ego_speed > 8.0
    throughout = [vehicle for vehicle, times in present.items() if {moment, round(moment + 12.0, 1)} <= times]
    assert "ego" in throughout
    assert len(throughout) >= 3
