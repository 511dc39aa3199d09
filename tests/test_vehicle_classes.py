"""SUMO's vehicle classes: the ego keeps its own, the road is told for it, and all that drive on roads may attack."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from class_samples import BUSES, CARS, CYCLE_TRACK, CYCLES, make_street, street_spec, vtype
from cli_samples import Program
from metrics_tracks import cruise
from road_samples import Watcher
from sumo_samples import make_spec, vehicle

from sumo_adv.config import LimitSettings
from sumo_adv.datatypes import Limits
from sumo_adv.drivers import EgoController, Lane, SumoEgo, UserEgo
from sumo_adv.episode.drive import Drive, ego_type_file
from sumo_adv.episode.encounter_detector import EncounterDetector
from sumo_adv.episode.right_of_way import Meetings
from sumo_adv.episode.surroundings import Surroundings
from sumo_adv.errors import UsageError
from sumo_adv.geometry import Pose
from sumo_adv.metrics.severity import SERIOUS_DELTA_V_M_S, crash, hardness, mass_of
from sumo_adv.road_users import RoadUser, road_user
from sumo_adv.simulation.inputs import load_input
from sumo_adv.simulation.network import RoadMap, read_network
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.simulation_spec import SimulationSpec


@contextmanager
def driving(spec: SimulationSpec, controller: EgoController, folder: Path) -> Iterator[Drive]:
    """After one step, in which the vehicle ``ego`` was inserted."""
    drive = Drive(replace(spec, additional=(ego_type_file(controller, folder, spec.routes),)), controller, 0)
    try:
        drive.tick()
        yield drive
    finally:
        drive.simulation.close()


# ---- the ego keeps what it is


def places(drive: Drive, seconds: float) -> list[tuple[float, float, float, str]]:
    """The ego's bumper, speed and lane over some time."""
    seen = []
    for _ in range(round(10 * seconds)):
        x, y, _, speed, lane = drive.tick().raw["ego"]
        seen.append((x, y, speed, lane))
    return seen


@pytest.mark.parametrize(
    ("vclass", "lane", "more"),
    [
        ("bus", BUSES, ""), ("bicycle", CYCLES, ""), ("taxi", BUSES, ""), ("emergency", CARS, 'speedFactor="1.4"'),
        ("motorcycle", CARS, 'desiredMaxSpeed="9"'), ("truck", CARS, 'accel="0.8" decel="3"'),
    ],
)  # fmt: skip
def test_an_ego_with_its_own_driver_goes_as_in_sumo_alone(tmp_path: Path, vclass: str, lane: int, more: str) -> None:
    """Krauss under test instead of the type's own Krauss: SUMO's own motion, for 20 s, is the right one."""
    ego = vehicle("ego", "ab bc", lane, 20.0, 3.0, vclass)
    spec = street_spec(tmp_path, [vtype(vclass, more), ego])
    controller = SumoEgo("krauss", {})
    with driving(spec, controller, tmp_path) as drive:
        alone = places(drive, 20.0)
    with driving(spec, controller, tmp_path) as drive:
        drive.take_over("ego")
        driven = places(drive, 20.0)
    assert [place[3] for place in driven] == [place[3] for place in alone]
    assert np.allclose([place[:3] for place in driven], [place[:3] for place in alone], atol=1e-6)


def test_an_ego_keeps_its_class_capacity_and_body_and_gets_the_model_under_test(tmp_path: Path) -> None:
    kind = (
        '<vType id="bus" vClass="bus" sigma="0.3" personCapacity="60" length="11" emissionClass="HBEFA3/Bus" '
        'speedFactor="0.9" impatience="0.2"><param key="has.battery.device" value="false"/></vType>'
    )
    spec = street_spec(tmp_path, [kind, vehicle("ego", "ab bc cd", BUSES, 20.0, 5.0, "bus")])
    with driving(spec, SumoEgo("idm", {"tau": 1.7}), tmp_path) as drive:
        drive.take_over("ego")
        drive.tick()
        v = drive.simulation.api.vehicle
        assert v.getVehicleClass("ego") == "bus" and v.getPersonCapacity("ego") == 60
        assert v.getEmissionClass("ego") == "HBEFA3/Bus"
        assert v.getTau("ego") == 1.7 and v.getSpeedFactor("ego") == pytest.approx(0.9)
        assert (v.getAccel("ego"), v.getDecel("ego"), v.getEmergencyDecel("ego")) == (1.2, 4.0, 7.0)  # SUMO's bus
        assert v.getLength("ego") == 11.0


def test_what_the_user_asks_of_the_driver_goes_before_the_vehicles_type(tmp_path: Path) -> None:
    """The bus's type says 0.8 m/s2; the user 2.0 m/s2, and a fifth above the limit."""
    spec = street_spec(
        tmp_path,
        [vtype("bus", 'accel="0.8" decel="3.5" speedDev="0.3"'), vehicle("ego", "ab bc cd", BUSES, 20.0, 5.0, "bus")],
    )
    with driving(spec, SumoEgo("idm", {"accel": 2.0, "speedFactor": 1.2}), tmp_path) as drive:
        drive.take_over("ego")
        v = drive.simulation.api.vehicle
        assert (v.getAccel("ego"), v.getDecel("ego"), v.getSpeedFactor("ego")) == (2.0, 3.5, 1.2)


def test_car_following_in_an_element_of_its_own_is_kept(tmp_path: Path) -> None:
    """Its 0.5 m/s2 override the 2.0 m/s2 of the type, as in SUMO."""
    kind = (
        '<vType id="bus" vClass="bus" accel="2.0"><carFollowing-Krauss accel="0.5" decel="2.5" tau="3"/></vType>'
    )  # fmt: skip
    spec = street_spec(tmp_path, [kind, vehicle("ego", "ab bc cd", BUSES, 20.0, 5.0, "bus")])
    with driving(spec, SumoEgo("idm", {}), tmp_path) as drive:
        v = drive.simulation.api.vehicle
        own = v.getAccel("ego"), v.getDecel("ego"), v.getTau("ego")
        drive.take_over("ego")
        assert own == (v.getAccel("ego"), v.getDecel("ego"), v.getTau("ego")) == (0.5, 2.5, 3.0)


def test_a_vehicle_that_was_tried_as_the_ego_gets_its_own_type_back(tmp_path: Path) -> None:
    spec = street_spec(tmp_path, [vtype("bus", 'tau="1.4"'), vehicle("ego", "ab bc cd", BUSES, 20.0, 5.0, "bus")])
    with driving(spec, SumoEgo("idm", {"tau": 0.6}), tmp_path) as drive:
        drive.take_over("ego")
        drive.tick()
        drive.release()
        drive.tick()
        v = drive.simulation.api.vehicle
        assert drive.simulation.own_type("ego") == "bus"
        assert (v.getTau("ego"), v.getVehicleClass("ego"), v.getPersonCapacity("ego")) == (1.4, "bus", 85)


# ---- the road of each class


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> RoadMap:
    return read_network(make_street(tmp_path_factory.mktemp("street")))


def test_a_lane_is_for_the_classes_that_sumo_lets_in(street: RoadMap) -> None:
    lanes = street.lanes
    assert lanes["ab_2"].allows("bus") and lanes["ab_2"].allows("taxi") and not lanes["ab_2"].allows("passenger")
    assert lanes["ab_1"].allows("bicycle") and not lanes["ab_1"].carriageway and lanes["ab_1"].paved
    assert lanes["ab_3"].allows("truck") and lanes["ab_3"].allows("tram") and not lanes["ab_3"].allows("bicycle")
    assert lanes["ab_3"].allows("ignoring") and lanes["ab_0"].allows("ignoring")
    assert not any(lanes[name].paved for name in ("ab_0", "tu_0", "pq_0"))


def test_the_ways_on_of_a_vehicle_are_those_of_its_class(street: RoadMap) -> None:
    """The bus lane leads onto the edge for buses alone; a taxi in it has no way on there."""
    on = {kind: [c.to for c in street.onward(street.lanes["bc_2"], (), kind)] for kind in ("bus", "taxi")}
    assert on == {"bus": ["cd_0"], "taxi": []}
    assert [c.to for c in street.onward(street.lanes["bc_3"], (), "passenger")] == ["ce_0"]
    sides = {kind: street.side_offsets("ab_3", 200.0, -3.6, 0.0, kind) for kind in ("bus", "passenger")}
    assert sides["passenger"] == [] and [way for _, way in sides["bus"]] == ["same"]
    assert sides["bus"][0][0] == pytest.approx(-3.2)


def test_a_car_that_errs_is_on_the_road_in_a_bus_lane_and_in_a_cycle_lane(street: RoadMap) -> None:
    """The bus lane, the cycle lane, the lane for all; the sidewalk, the tram track, the path."""
    lanes = [street.lanes[name] for name in ("ab_2", "ab_1", "ab_3", "ab_0", "tu_0", "pq_0")]
    y = np.array([lane.shape[0, 1] for lane in lanes])
    on = street.drivable(200.0, 0.0, 150.0)(np.full(6, 200.0), y)
    assert on.tolist() == [True, True, True, False, False, False]


class Told(NamedTuple):
    lanes: dict[str, Lane]
    sides: Sequence[float]
    path: Sequence[tuple[float, float]]


@pytest.mark.parametrize(
    ("vclass", "lane", "allowed", "sides"),
    [
        ("bus", BUSES, {"ab_2", "ab_3"}, [3.2]), ("bicycle", CYCLES, {"ab_1"}, []),
        ("passenger", CARS, {"ab_3"}, []), ("taxi", CARS, {"ab_2", "ab_3"}, [-3.2]),
    ],
)  # fmt: skip
def test_the_road_is_told_for_the_class_of_the_ego(
    tmp_path: Path, vclass: str, lane: int, allowed: set[str], sides: list[float]
) -> None:
    watcher = Watcher(lambda o: Told({q.id: q for q in o.road.lanes}, o.road.sides, o.path), lambda _: None)
    spec = street_spec(tmp_path, [vtype(vclass), vehicle("ego", "ab bc", lane, 20.0, 5.0, vclass)])
    with driving(spec, UserEgo("watcher", watcher), tmp_path) as drive:
        road = read_network(spec.network)
        drive.observe = Surroundings(road, Meetings(road), drive, ())
        drive.take_over("ego")
        drive.tick()
    (told,) = watcher.kept
    here = {name for name, shown in told.lanes.items() if name.startswith("ab_") and shown.allowed}
    assert here == allowed and {"ab_1", "ab_2", "ab_3"} <= told.lanes.keys()
    assert told.lanes[f"ab_{lane}"].on_route
    assert told.sides == pytest.approx(sides)
    assert told.path[100][1] == pytest.approx(road.lanes[f"ab_{lane}"].shape[0, 1])


# ---- attacks


def test_a_bus_brakes_for_a_car_that_is_moved_into_its_lane(tmp_path: Path) -> None:
    """SUMO has a car that is moved onto a bus lane on no lane, and its buses drive through it."""
    spec = street_spec(
        tmp_path,
        [vtype("bus"), vehicle("bus", "ab bc", BUSES, 30.0, 12.0, "bus"), vehicle("car", "ab bc", CARS, 70.0, 12.0)],
    )
    simulation = Simulation(spec)
    try:
        simulation.step()
        simulation.read()
        for k in range(50):
            y = max(-3.6 - 0.1 * k, -6.8)
            simulation.inject({"car": Pose(68.7 + 0.6 * k, y, 0.0, 6.0)})
            simulation.step()
            raw = simulation.read().raw
        assert raw["car"][4] == "ab_2"
        assert raw["bus"][0] < raw["car"][0] - 5.0 and raw["bus"][3] < 7.0  # it was 12 m/s, and is behind
        assert simulation.vehicle_class("car") == "passenger"
        simulation.step()  # moved no more
        assert simulation.api.vehicle.getVehicleClass("car") == "passenger"
    finally:
        simulation.close()


ATTACKERS = ("motorcycle", "moped", "emergency", "authority", "army", "vip", "hov", "custom2")


def test_all_that_drive_on_roads_may_attack(tmp_path: Path) -> None:
    """Four vehicles in each of the two lanes beside, 26 m apart."""
    demand = [vtype(kind, 'speedDev="0"') for kind in ATTACKERS]
    demand += [
        vehicle(kind, "eastbound", 1 + k % 2, 70.0 + 26.0 * (k // 2), 15.0, kind) for k, kind in enumerate(ATTACKERS)
    ]
    spec = make_spec(tmp_path, "straight_3lane", [*demand, vehicle("ego", "eastbound", 0, 100.0, 15.0)])
    with driving(spec, SumoEgo("idm", {}), tmp_path) as drive:
        drive.take_over("ego")
        drive.tick()
        ranked = EncounterDetector(read_network(spec.network), 20).rank(drive)
    assert {(c.id, c.relation) for c in ranked} == {(kind, "neighbour") for kind in ATTACKERS}


@pytest.mark.parametrize(("aside", "relation"), [(1.3, "neighbour"), (0.0, "follower")])
def test_a_motorcycle_that_filters_is_beside_the_ego_in_its_own_lane(
    tmp_path: Path, aside: float, relation: str
) -> None:
    """The car is 2 m wide and drives 0.5 m right of the middle of a lane of 3.2 m, the motorcycle is 0.9 m wide: with
    their centres 1.45 m apart and more it goes past."""
    spec = make_spec(
        tmp_path, "straight_3lane",
        [
            vtype("motorcycle"), vehicle("mc", "eastbound", 0, 60.0, 15.0, "motorcycle"),
            vehicle("ego", "eastbound", 0, 100.0, 15.0),
        ],
    )  # fmt: skip
    with driving(spec, SumoEgo("idm", {}), tmp_path) as drive:
        drive.take_over("ego")
        for k in range(3):
            poses = {"mc": Pose(92.0 + 1.5 * k, -3.2 + aside - 0.3, 0.0, 15.0)}
            drive.tick(poses | {"ego": Pose(99.0 + 1.5 * k, -3.7, 0.0, 15.0)})
        (ranked,) = EncounterDetector(read_network(spec.network), 5).rank(drive)
    assert (ranked.id, ranked.relation) == ("mc", relation)


def test_each_vehicle_attacks_within_the_limits_of_its_build() -> None:
    """SUMO's car and van, motorcycle and moped, bus; a cautious setting holds for the bus where it is lower."""
    settings = LimitSettings()
    of = {size: settings.of(cruise("a", 0.0, 0.0, 5.0, length=size[0], width=size[1])) for size in SIZES}
    assert of[5.0, 1.8] == of[6.5, 2.16] == Limits()
    assert of[2.2, 0.9] == of[2.1, 0.78] == Limits(8.0, 6.0, 5.0, 0.4, 12.0)
    assert of[12.0, 2.5] == Limits(7.0, 2.0, 3.5, 0.12, 12.0)
    cautious = LimitSettings(acceleration=1.0).of(cruise("a", 0.0, 0.0, 5.0, length=12.0, width=2.5))
    assert (cautious.acceleration, cautious.braking) == (1.0, 7.0)


SIZES = ((5.0, 1.8), (6.5, 2.16), (2.2, 0.9), (2.1, 0.78), (12.0, 2.5))


def test_a_motorcyclist_that_is_hit_is_hurt_themselves() -> None:
    """Lubbe et al. 2022: 10 % are seriously injured at 48 km/h. The car that hits them at 10 m/s hardly feels it."""
    ego = cruise("ego", 0.0, 0.0, 10.0)
    hit = crash(ego, cruise("adversary", 53.6, 0.0, 0.0, length=2.2, width=0.9), 5.0)
    assert hit.impact_speed == pytest.approx(10.0) and hit.ego_delta_v < SERIOUS_DELTA_V_M_S
    assert hardness(hit, RoadUser.VEHICLE) == pytest.approx(36.0 / 48.0)
    assert (mass_of(1.8), mass_of(2.1), mass_of(2.2)) == (100.0, 160.0, 250.0)


def test_scooters_and_wheelchairs_ride_like_cycles() -> None:
    """SUMO's scooter and wheelchair; a log's largest pedestrian."""
    users = [road_user(cruise("a", 0.0, 0.0, 1.0, length=1.2, width=width)) for width in (0.5, 0.72, 1.2)]
    assert users == [RoadUser.CYCLIST, RoadUser.CYCLIST, RoadUser.PEDESTRIAN]


def test_a_tram_cannot_attack_and_the_sentence_says_so(tmp_path: Path, caches: Path) -> None:
    program = Program(tmp_path, caches)
    street_spec(
        tmp_path,
        [vtype("tram"), vehicle("ego", "ab bc ce", CARS, 20.0, 10.0), vehicle("line1", "tu", 0, 30.0, 10.0, "tram")],
    )
    (tmp_path / "c.sumocfg").write_text(
        '<configuration><net-file value="classes.net.xml"/><route-files value="classes.rou.xml"/><end value="20"/>'
        "</configuration>"
    )
    done = program.here("run", "c.sumocfg", "--ego-id", "ego", "--adversary", "line1", "--trigger", "2", "--out", "out")
    assert done.status == 2
    assert "Vehicle 'line1' is a tram, and no vehicle of that class can attack" in done.err


def test_a_car_attacks_a_bus_in_the_bus_lane(tmp_path: Path, caches: Path) -> None:
    """It cuts in: on the road, and into a bus that stays in its lane and sees it."""
    program = Program(tmp_path, caches)
    street_spec(
        tmp_path,
        [
            vtype("bus"), vehicle("ego", "ab bc cd", BUSES, 20.0, 12.0, "bus"),
            vehicle("car", "ab bc ce", CARS, 35.0, 12.0),
        ],
    )  # fmt: skip
    (tmp_path / "c.sumocfg").write_text(
        '<configuration><net-file value="classes.net.xml"/><route-files value="classes.rou.xml"/><end value="60"/>'
        '<step-length value="0.1"/></configuration>'
    )
    done = program.here(
        "run", "c.sumocfg", "--ego-id", "ego", "--ego", "idm", "--trigger", "2", "--until", "collision", "--attempts",
        "4", "--learn", "off", "--total-seconds", "0", "--out", "out",
    )  # fmt: skip
    assert done.status == 0, done.err
    attempts = done.outcome["attempts"]
    assert any(attempt["collided"] for attempt in attempts)
    assert not any("off_road" in attempt["failed_gates"] for attempt in attempts)


def test_a_network_for_bicycles_alone_is_enough_for_a_demand_of_bicycles(tmp_path: Path) -> None:
    """Alone it is not: the traffic that is made for a network is cars."""
    net = make_street(tmp_path, CYCLE_TRACK, "")
    make_spec(tmp_path, "classes", [vtype("bicycle"), vehicle("ego", "ab", 0, 20.0, 3.0, "bicycle")])
    (tmp_path / "c.sumocfg").write_text(
        '<configuration><net-file value="classes.net.xml"/><route-files value="classes.rou.xml"/></configuration>'
    )
    assert load_input(tmp_path / "c.sumocfg").network == net
    with pytest.raises(UsageError, match="no lane that a passenger car may drive on"):
        load_input(net)
