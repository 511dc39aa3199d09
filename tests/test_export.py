"""Exports of real runs, attacked and not, on a straight, a crossing and in a bend, read back by other means."""

from __future__ import annotations

import math
import subprocess
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from run_samples import GEOMETRIES, run_folder
from shapely import LineString, MultiLineString
from xodr_reader import lane_centres
from xosc_reader import entity, events, motion, number, properties, replayed

from sumo_adv.datatypes import Role
from sumo_adv.report.export import Variant
from sumo_adv.report.export.openscenario import OPENDRIVE_FILE, OPENSCENARIO_FILE, write_openscenario
from sumo_adv.report.export.piece import ExportedRun, read_piece
from sumo_adv.report.export.sumo import CONFIGURATION, fcd, front, write_replay
from sumo_adv.simulation.network import read_network
from sumo_adv.simulation.programs import find_netconvert

CASES = [*((geometry, False) for geometry in GEOMETRIES), ("straight", True)]
IDS = [f"{geometry}, {'unattacked' if unattacked else 'attacked'}" for geometry, unattacked in CASES]
CENTIMETRE, MILLISECOND = 0.01, 0.001


@pytest.fixture(scope="module", params=CASES, ids=IDS)
def piece(request: pytest.FixtureRequest) -> ExportedRun:
    geometry, unattacked = request.param
    return read_piece(run_folder(geometry), unattacked=unattacked)


@pytest.fixture(scope="module")
def scenario(piece: ExportedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("openscenario")
    write_openscenario(folder, piece, find_netconvert())
    return folder / OPENSCENARIO_FILE


def found_by_asam(file: Path) -> list[str]:
    """What ASAM's own checker says of a file: schema, references, names."""
    from qc_baselib import Configuration, Result
    from qc_openscenario import constants
    from qc_openscenario.main import run_checks

    config, result = Configuration(), Result()
    config.set_config_param("InputFile", str(file))
    result.register_checker_bundle(
        name=constants.BUNDLE_NAME, description="", version=constants.BUNDLE_VERSION, summary=""
    )
    run_checks(config, result)
    checkers = result.get_checker_results(constants.BUNDLE_NAME)
    assert len(checkers) > 10 and {str(c.status.value) for c in checkers} <= {"completed", "skipped"}
    completed = {c.checker_id for c in checkers if c.status.value == "completed"}
    assert any("schema" in name for name in completed)
    return [f"{c.checker_id}: {issue.description}" for c in checkers for issue in c.issues]


def test_asams_checker_finds_nothing(scenario: Path) -> None:
    assert found_by_asam(scenario) == []


def test_asams_checker_finds_what_is_wrong(tmp_path: Path) -> None:
    write_openscenario(tmp_path, read_piece(run_folder("straight")), find_netconvert())
    text = (tmp_path / OPENSCENARIO_FILE).read_text(encoding="utf-8")
    (tmp_path / "bad.xosc").write_text(text.replace("<CatalogLocations />", ""), encoding="utf-8")
    assert found_by_asam(tmp_path / "bad.xosc") != []


def test_trajectories_read_back_are_the_states(piece: ExportedRun, scenario: Path) -> None:
    replayed_tracks = replayed(scenario)
    assert set(replayed_tracks) == {track.id for track in piece.tracks}
    for track in piece.tracks:
        back = replayed_tracks[track.id]
        assert len(back.time) == len(track.time)
        assert np.abs(back.time - track.time).max() < MILLISECOND
        assert np.hypot(back.x - track.x, back.y - track.y).max() < CENTIMETRE
        assert np.abs(np.angle(np.exp(1j * (back.heading - track.heading)))).max() < 1e-5
        assert (back.length, back.width) == (track.length, track.width)


def test_vehicles_stand_on_their_rear_axles(piece: ExportedRun, scenario: Path) -> None:
    root = ElementTree.parse(scenario).getroot()
    ego = entity(root, piece.ego)
    track = piece.track(piece.ego)
    assert ego.tag == "Vehicle"
    assert number(ego.find("Axles/RearAxle"), "positionX") == 0.0
    front_axle = number(ego.find("Axles/FrontAxle"), "positionX")
    centre = ego.find("BoundingBox/Center")
    assert front_axle == pytest.approx(0.6 * track.length)
    assert number(centre, "x") == pytest.approx(front_axle / 2)  # overhangs are equal
    assert number(centre, "z") == pytest.approx(number(ego.find("BoundingBox/Dimensions"), "height") / 2)


def test_the_road_is_where_the_network_is(piece: ExportedRun, scenario: Path) -> None:
    road = scenario.with_name(OPENDRIVE_FILE)
    centres = MultiLineString([line for line in lane_centres(road) if len(line) > 1])
    worst = {False: 0.0, True: 0.0}
    for lane in read_network(piece.network).lanes.values():
        if lane.carriageway and len(lane.shape) > 1:
            line = LineString(lane.shape)
            points = [line.interpolate(s) for s in np.arange(0.0, line.length, 2.0)]
            away = max(p.distance(centres) for p in points)
            worst[lane.internal] = max(worst[lane.internal], away)
    assert worst[False] < 0.1 and worst[True] < 0.25
    root = ElementTree.parse(road).getroot()
    assert root.find("header/offset") is None
    assert "netconvert" not in road.read_text(encoding="utf-8")


def sumo_says(folder: Path) -> dict[tuple[int, str], Any]:
    """(step, vehicle) -> SUMO's own FCD of the configuration in a folder, by the plain program."""
    sumo = find_netconvert().with_name("sumo")
    command = [str(sumo), "-c", str(folder / CONFIGURATION), "--fcd-output", str(folder / "out.xml")]
    done = subprocess.run([*command, "--precision", "6"], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    steps = ElementTree.parse(folder / "out.xml").getroot()
    return {(round(number(step, "time") * 10), vehicle.attrib["id"]): vehicle for step in steps for vehicle in step}


@pytest.fixture(scope="module")
def played(piece: ExportedRun, tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[int, str], Any]:
    folder = tmp_path_factory.mktemp("sumo")
    write_replay(folder, piece)
    return sumo_says(folder)


def test_plain_sumo_reproduces_the_positions(piece: ExportedRun, played: dict[tuple[int, str], Any]) -> None:
    expected = 0
    for track in piece.tracks:
        for k, time in enumerate(track.time):
            vehicle = played[round(time * 10), track.id]
            assert math.dist((number(vehicle, "x"), number(vehicle, "y")), front(track, k)) < 0.001
            angle = math.radians(90.0 - number(vehicle, "angle"))
            turned = abs(math.remainder(angle - track.heading[k], math.tau))
            assert turned < 0.01
            if k > 0:  # in its first step the device has not yet set speed and heading
                assert turned < 1e-5
                assert number(vehicle, "speed") == pytest.approx(track.speed[k], abs=0.01)
            expected += 1
    early_or_late = len(played) - expected
    assert 0 <= early_or_late <= 2 * len(piece.tracks)  # let in a step earlier, or taken out a step later


def test_fcd_is_what_sumo_would_write(piece: ExportedRun, played: dict[tuple[int, str], Any]) -> None:
    root = ElementTree.fromstring(fcd(piece))
    rows = {(round(number(step, "time") * 10), v.attrib["id"]): v for step in root for v in step}
    assert len(rows) == sum(len(track.time) for track in piece.tracks)
    same_lane = 0
    for key, vehicle in rows.items():
        sumo_vehicle = played[key]
        assert number(vehicle, "x") == pytest.approx(number(sumo_vehicle, "x"), abs=0.001)
        assert set(vehicle.attrib) >= {"id", "x", "y", "angle", "type", "speed", "pos", "lane", "slope"}
        if vehicle.get("lane") == sumo_vehicle.get("lane") and not vehicle.attrib["lane"].startswith(":"):
            assert number(vehicle, "pos") == pytest.approx(number(sumo_vehicle, "pos"), abs=0.02)
            same_lane += 1
    assert same_lane > len(rows) / 2


@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_a_free_ego_is_left_alone_and_the_adversary_waits_for_its_moment(geometry: str, tmp_path: Path) -> None:
    piece = read_piece(run_folder(geometry))
    assert piece.takeover is not None and piece.adversary is not None
    write_openscenario(tmp_path, piece, find_netconvert(), Variant.FREE_EGO)
    assert found_by_asam(tmp_path / OPENSCENARIO_FILE) == []
    root = ElementTree.parse(tmp_path / OPENSCENARIO_FILE).getroot()
    assert events(root, piece.ego) == []
    assert root.find(f"Storyboard/Init/Actions/Private[@entityRef='{piece.ego}']//TeleportAction") is not None
    approach, attack = events(root, piece.adversary)
    lead, onwards = (next(event.iter("Trajectory")) for event in (approach, attack))
    takeover = float(properties(root)["takeover"])
    assert takeover == pytest.approx(piece.takeover)
    assert piece.track(piece.adversary).role is Role.ADVERSARY
    before = motion(root, piece.adversary, lead, piece.begin)
    after = motion(root, piece.adversary, onwards, takeover)
    track = piece.track(piece.adversary)
    times = np.concatenate([before.time[:-1], after.time])  # the takeover is the end of one and the start of the other
    assert np.abs(times - track.time).max() < MILLISECOND
    x, y = (np.concatenate([getattr(before, k)[:-1], getattr(after, k)]) for k in ("x", "y"))
    assert np.hypot(x - track.x, y - track.y).max() < CENTIMETRE
    alone, with_distance = attack.findall("StartTrigger/ConditionGroup")
    assert number(alone.find(".//SimulationTimeCondition"), "value") == pytest.approx(takeover - piece.begin)
    nearness = with_distance.find(".//RelativeDistanceCondition")
    assert nearness is not None and nearness.get("entityRef") == piece.ego
    ego = piece.track(piece.ego)
    axles = [
        (t.x[k] - 0.3 * t.length * math.cos(t.heading[k]), t.y[k] - 0.3 * t.length * math.sin(t.heading[k]))
        for t in (track, ego)
        for k in [int(np.argmin(np.abs(t.time - takeover)))]
    ]
    assert number(nearness, "value") == pytest.approx(math.dist(*axles), abs=CENTIMETRE)
