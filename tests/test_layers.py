"""A vehicle on a bridge and one below it never meet, hide one another, or see one another."""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_samples import Program
from layer_samples import RAMP, bridge_spec, configuration, make_network, queue
from road_samples import Watcher
from sumo_samples import vehicle

from sumo_adv.datatypes import Boxes, Role, Track, VehicleState
from sumo_adv.drivers import Observation, UserEgo
from sumo_adv.episode.drive import Drive, ego_type_file
from sumo_adv.episode.ego_place import lane_on_route
from sumo_adv.episode.right_of_way import Meetings
from sumo_adv.episode.surroundings import Sight, Surroundings
from sumo_adv.errors import UsageError
from sumo_adv.geometry import Pose
from sumo_adv.metrics.boxes import first_contact, gap, overlaps
from sumo_adv.metrics.criticality import headway, pet, ttc
from sumo_adv.metrics.gates import off_road
from sumo_adv.report.export.piece import read_piece
from sumo_adv.report.export.sumo import fcd
from sumo_adv.report.read import read_run
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.network import RoadMap, read_network
from sumo_adv.situation import relate

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("sumo") is None, reason="netconvert is not installed: pip install sumo-adv[sumo]"
)
DECKS = pytest.mark.parametrize("deck", [8.0, None], ids=["with heights", "without heights"])


# ---- boxes


def box(x: Sequence[float], z: Sequence[float] | float = 0.0, speed: float = 10.0) -> Boxes:
    """A car of 5 m x 2 m that drives eastwards, by its states."""
    nothing = np.zeros(len(x))
    return Boxes(np.array(x, float), nothing, nothing, nothing + speed, 5.0, 2.0, np.asarray(z) * (nothing + 1.0))


def test_boxes_touch_within_three_metres_of_height() -> None:
    assert overlaps(box([0.0, 0.0]), box([4.0, 4.0], [3.0, 3.1])).tolist() == [True, False]
    assert gap(box([0.0, 0.0]), box([4.0, 5.0], [7.0, 0.0])).tolist() == [4.0, 0.0]  # 7 m up is 4 m beyond the layer
    assert gap(box([0.0]), box([8.0], [7.0])).tolist() == [5.0]  # 3 m ahead, 4 m up


def test_a_vehicle_drives_under_another_without_contact() -> None:
    time, below = np.arange(3) * 1.0, box([-10.0, 0.0, 10.0])
    assert first_contact(below, box([0.0, 0.0, 0.0], 8.0, 0.0), time) == np.inf
    assert first_contact(below, box([0.0, 0.0, 0.0], 0.0, 0.0), time) == pytest.approx(0.5)  # 5 m at 10 m/s


def test_a_leader_up_a_slope_is_reached_and_one_on_a_bridge_is_not() -> None:
    """50 m ahead at rest: 45 m of room at 10 m/s are 4.5 s. On a slope of 8 % the leader is 4 m higher."""
    up = np.array([0.0, 0.08])
    climbing = replace(box([0.0, 1.0]), z=up)
    assert ttc(climbing, box([50.0, 51.0], 4.0 + up, 0.0))[0] == pytest.approx(4.5)
    assert headway(climbing, box([50.0, 51.0], 4.0 + up, 0.0))[0] == pytest.approx(4.5)
    assert ttc(box([0.0, 1.0]), box([50.0, 51.0], 8.0, 0.0))[0] == np.inf
    assert headway(box([0.0, 1.0]), box([50.0, 51.0], 8.0, 0.0))[0] == np.inf


def test_the_time_between_two_vehicles_at_one_place_is_that_of_one_layer() -> None:
    time, zero = np.arange(21) * 0.1, np.zeros(21)

    def track(name: str, start: float, z: float) -> Track:
        return Track(
            name, Role.BACKGROUND, time, start + 10.0 * time, zero, zero, zero + 10.0, zero, 5.0, 2.0, z=zero + z
        )

    assert pet(track("a", 0.0, 0.0), track("b", -15.0, 0.0)).pet == pytest.approx(1.0, abs=0.03)
    assert pet(track("a", 0.0, 0.0), track("b", -15.0, 8.0)).pet == np.inf


def test_only_what_is_on_the_layer_hides() -> None:
    walker = VehicleState("walker", 20.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.5, "")
    lorry = VehicleState("lorry", 10.0, 0.0, 0.0, 0.0, 0.0, 8.0, 2.5, "")
    assert Sight().visible((0.0, 0.0), [walker, lorry]).tolist() == [False, True]
    assert Sight().visible((0.0, 0.0), [walker, replace(lorry, z=8.0)]).tolist() == [True, True]


# ---- networks


def heights(road: RoadMap, lane: str, *points: tuple[float, float]) -> list[float]:
    assert road.heights is not None
    return [round(float(road.heights.at(lane, x, y)), 2) for x, y in points]


def test_heights_are_those_of_the_shapes(tmp_path: Path) -> None:
    road = read_network(make_network(tmp_path, deck=8.0))
    assert heights(road, "over_0", (4.8, -300.0), (4.8, 0.0)) == [8.0, 8.0]
    assert heights(road, "under_0", (0.0, -4.8)) == [0.0]


def test_a_bridge_without_heights_is_a_hump_of_six_metres(tmp_path: Path) -> None:
    """It is level for 125 m to each side of the crossing, and back on the ground after 250 m."""
    road = read_network(make_network(tmp_path))
    upper = heights(road, "over_0", (4.8, -4.8), (4.8, 115.0), (4.8, 185.0), (4.8, 260.0))
    assert upper[:2] == [6.0, 6.0]
    assert upper[2] == pytest.approx(3.0, abs=0.2)
    assert upper[3] == 0.0
    assert heights(road, "under_0", (4.8, -4.8), (-300.0, -4.8)) == [0.0, 0.0]


def test_a_network_may_carry_the_heights_of_its_lanes(tmp_path: Path) -> None:
    """As one that was converted from a record does: a number for each of the two points of a shape."""
    network = make_network(tmp_path)
    text = network.read_text()

    def carrying(numbers: str) -> RoadMap:
        lanes = re.sub(r'(<lane id="over_[^>]*)/>', rf'\1><param key="heights" value="{numbers}"/></lane>', text)
        network.write_text(lanes)
        return read_network(network)

    assert heights(carrying("4.00 8.00"), "over_0", (4.8, -300.0), (4.8, 0.0)) == [4.0, 6.0]
    with pytest.raises(UsageError, match=r"heights in .* are damaged \(lane over_0 has 2 points and 1 heights\)"):
        carrying("4.00")


def test_a_ramp_leads_from_one_road_up_to_the_other(tmp_path: Path) -> None:
    """From the crossing it is 100 m along the upper road to the ramp: that is still level."""
    road = read_network(make_network(tmp_path, RAMP))
    assert heights(road, "south_0", (4.8, -4.8)) == [6.0]
    assert heights(road, "east_0", (4.8, -4.8)) == [0.0]
    assert road.heights is not None
    climb = road.heights.lines["ramp_0"][:, 2]
    assert climb[0] < 1.0 < 5.0 < climb[-1]
    assert (np.diff(climb) >= 0.0).all()


def test_ways_meet_where_they_are_at_one_height(tmp_path: Path) -> None:
    """The way over the bridge does not cross the one below; that of the ramp joins the upper road."""
    road = read_network(make_network(tmp_path, RAMP))
    below = road.ways("west_0", 100.0, 300.0, ("west", "east"))[0].path
    above = road.ways("south_1", 200.0, 300.0, ("south", "north"))[0].path
    ramp = road.ways("west_0", 100.0, 330.0, ("west", "ramp", "north"))[0].path
    assert relate(above, "straight", 0.0, False, below).conflict is None
    meeting = relate(ramp, "left", 0.0, False, above).conflict
    assert meeting is not None and meeting.y > 80.0


@pytest.mark.parametrize("name", ["priority_crossing", "roundabout", "onramp_merge", "left_hand_crossing"])
def test_roads_with_junctions_are_flat(name: str) -> None:
    assert read_network(data_folder("networks") / f"{name}.net.xml").heights is None


@DECKS
def test_no_vehicle_leaves_a_bridge_for_the_road_below(tmp_path: Path, deck: float | None) -> None:
    """A car across both lanes of the lower road at the crossing is on the road there, and not if it is on the deck."""
    road = read_network(make_network(tmp_path, deck=deck))
    ground, judged = road.drivable(0.0, 0.0, 100.0), np.ones(1, bool)

    def leaves(x: float, y: float, z: float) -> bool:
        there = Boxes(*(np.array([v]) for v in (x, y, 0.0, 10.0)), 5.0, 2.0, np.array([z]))
        return bool(off_road(there, judged, ground)[0])

    height = heights(road, "over_0", (4.8, 0.0))[0]
    assert not leaves(3.2, -3.2, 0.0) and not leaves(3.2, -3.2, height)  # where both are, either will do
    assert not leaves(40.0, -3.2, 0.0)
    assert leaves(40.0, -3.2, height)


@DECKS
def test_the_lane_of_a_vehicle_is_on_its_layer(tmp_path: Path, deck: float | None) -> None:
    """SUMO has a vehicle that was moved below the deck on the lane above it."""
    road = read_network(make_network(tmp_path, deck=deck))
    below = VehicleState("car", 1.6, -2.0, np.pi / 4, 4.0, 0.0, 5.0, 2.0, "over_1")
    above = replace(below, z=heights(road, "over_1", (1.6, -2.0))[0])
    lanes = [lane_on_route(road, car, (), "passenger") for car in (below, above)]
    assert [lane.id if lane else "" for lane in lanes] == ["under_1", "over_1"]


# ---- with SUMO


@contextmanager
def drive(folder: Path, network: Path, *vehicles: str) -> Iterator[tuple[Drive, Watcher]]:
    """A drive before its first step, in which SUMO drives the ego."""

    def look(seen: Observation) -> object:
        assert seen.road is not None
        lanes = {lane.id for lane in seen.road.lanes}
        edges = [float(np.abs(line[:, 1]).max()) for line in seen.road.edges]
        return seen.ego, {other.id: (other.z, other.visible) for other in seen.others}, lanes, edges  # type: ignore[attr-defined]

    class Needy(Watcher):
        needs_road = True

    watcher = Needy(look, lambda seen: None)
    controller = UserEgo("watcher", watcher)
    spec = bridge_spec(folder, vehicles, network)
    moving = Drive(replace(spec, additional=(ego_type_file(controller, folder),)), controller, 0)
    road = read_network(network)
    moving.observe = Surroundings(road, Meetings(road), moving)
    try:
        yield moving, watcher
    finally:
        moving.simulation.close()


@DECKS
def test_a_driver_below_a_bridge_sees_what_is_below(tmp_path: Path, deck: float | None) -> None:
    """A queue stands on the bridge, between the ego and the car ahead of it."""
    network = make_network(tmp_path, deck=deck)
    cars = [vehicle("ego", "under", 0, 270.0, 10.0), vehicle("ahead", "under", 0, 330.0, 10.0)]
    with drive(tmp_path, network, *cars, *queue("over", 290.0, 298.0, 306.0)) as (moving, watcher):
        moving.tick()
        moving.take_over("ego")
        moving.tick()
        ego, others, lanes, edges = watcher.kept[-1]
        assert ego.z == 0.0
        assert others == {"ahead": (0.0, True)}
        assert lanes == {"under_0", "under_1"}
        assert max(edges) < 7.0  # the bridge's own edges are 300 m long, across
        assert moving.state("deck290").z == (6.0 if deck is None else deck)


def test_a_moved_vehicle_stays_on_its_layer(tmp_path: Path) -> None:
    """Put beside its road below the deck, it is on the ground, whatever lane SUMO takes it to be on."""
    network = make_network(tmp_path, deck=8.0)
    with drive(tmp_path, network, vehicle("car", "under", 0, 290.0, 10.0)) as (moving, _):
        moving.tick()
        x, y, _ = moving.pose("car")
        for k in range(40):
            moving.tick({"car": Pose(x + 0.3 * k, y + 0.3 * k, np.pi / 4, 4.2)})
        assert moving.state("car").z == 0.0


QUICK = ("--attempts", "2", "--seconds", "8", "--total-seconds", "8", "--learn", "off", "--ego", "idm")


@DECKS
def test_crossing_roads_make_no_encounter(program: Program, deck: float | None) -> None:
    cars = [
        vehicle("ego", "under", 0, 200.0, 13.0),
        *(vehicle(f"d{k}", "over", 0, 190.0 + 9.0 * k, 13.0) for k in range(3)),
    ]
    file = configuration(program.folder, cars, make_network(program.folder, deck=deck))
    done = program.here("run", file, "--ego-id", "ego", *QUICK, "--out", "out")
    outcome = json.loads((program.folder / "out" / "outcome.json").read_text())
    assert done.err == "" or "Traceback" not in done.err
    assert outcome["ending"] in ("no_encounter", "ego_left")
    assert outcome["best"] is None


@DECKS
def test_a_vehicle_below_a_bridge_is_attacked_from_its_own_road(program: Program, deck: float | None) -> None:
    """Its neighbour cuts in below the bridge, on which a queue stands: no third party."""
    cars = [vehicle("ego", "under", 0, 200.0, 12.0), vehicle("beside", "under", 1, 206.0, 12.0)]
    file = configuration(
        program.folder, [*cars, *queue("over", 290.0, 298.0, 306.0)], make_network(program.folder, deck=deck)
    )
    program.here("run", file, "--ego-id", "ego", "--trigger", "4", "--until", "collision", *QUICK, "--out", "out")
    outcome = json.loads((program.folder / "out" / "outcome.json").read_text())
    assert outcome["ending"] == "critical"
    assert outcome["attempts"][outcome["best"]]["level"] in ("collision", "valid", "strict", "serious")
    assert [a["id"] for a in outcome["adversaries"]] == ["beside"]
    run, height = program.folder / "out", 6.0 if deck is None else deck
    tracks = {track.id: track for track in read_run(run).best}
    assert float(np.ravel(tracks["deck290"].z)[-1]) == height
    assert not np.any(tracks["ego"].z)
    assert f'z="{height:.4f}"' in fcd(read_piece(run))
