"""SUMO's persons: the ego's driver sees them, they can be hit and harmed, and they attack as pedestrians do."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_samples import Done, Program, read_states
from person_samples import STANDS, WALKS, make_street, street_spec
from road_samples import Watcher
from sumo_samples import TYPES, vehicle

from sumo_adv.config import load_settings
from sumo_adv.datatypes import Role
from sumo_adv.drivers import Observation, Steer, UserEgo
from sumo_adv.episode.drive import Drive, ego_type_file
from sumo_adv.episode.right_of_way import Meetings
from sumo_adv.episode.surroundings import Surroundings
from sumo_adv.errors import UsageError
from sumo_adv.geometry import Pose
from sumo_adv.metrics.case import make_case
from sumo_adv.metrics.contact import first_other_contact
from sumo_adv.metrics.verdict import judge_attempt
from sumo_adv.simulation.inputs import load_input
from sumo_adv.simulation.network import read_network
from sumo_adv.simulation.simulation import Simulation

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("sumo") is None, reason="netconvert is not installed: pip install sumo-adv[sumo]"
)
NORTH = math.pi / 2
PERSON = "person:walker"


@contextmanager
def street(folder: Path, *demand: str, model: str = "striping") -> Iterator[tuple[Drive, Watcher]]:
    """A drive before its first step. The ego keeps its lane and its speed of 10 m/s, whatever is ahead."""

    def look(seen: Observation) -> object:
        return seen.time, {other.id: (other, other.kind) for other in seen.others}

    watcher = Watcher(look, lambda seen: Steer(0.0, 0.0))
    controller = UserEgo("watcher", watcher)
    spec = street_spec(folder, demand, model)
    drive = Drive(replace(spec, additional=(ego_type_file(controller, folder),)), controller, 0)
    road = read_network(spec.network)
    drive.observe = Surroundings(road, Meetings(road), drive)
    try:
        yield drive, watcher
    finally:
        drive.simulation.close()


def until(drive: Drive, ego: str, time: float) -> None:
    """Step; the ego is taken over once it is there."""
    while drive.now < time - 1e-6:
        snapshot = drive.tick()
        if drive.ego is None and ego in snapshot.raw:
            drive.take_over(ego)


def test_the_driver_sees_a_person_with_the_id_of_a_car(tmp_path: Path) -> None:
    """After 2 s of 1 m/s from x = 90 its front is at x = 92; its middle is 0.2 m behind."""
    with street(tmp_path, vehicle("walker", "ab bc", 1, 10.0, 10.0), WALKS, model="nonInteracting") as (drive, watcher):
        until(drive, "walker", 2.1)
        time, others = watcher.kept[-1]
        person, kind = others[PERSON]
        assert (time, list(others), kind) == (2.0, [PERSON], "pedestrian")
        assert (person.x, person.y, person.heading) == pytest.approx((91.8, -4.2, 0.0))
        assert (person.speed, person.length, person.width) == (1.0, 0.4, 0.6)
        assert (drive.kind("walker"), drive.kind(PERSON)) == ("passenger", "pedestrian")


def test_it_turns_onto_the_crossing(tmp_path: Path) -> None:
    with street(tmp_path, vehicle("ego", "ab bc", 1, 10.0, 0.0), WALKS) as (drive, _):
        until(drive, "", 12.0)
        before = drive.state(PERSON)
        until(drive, "", 13.0)
        after = drive.state(PERSON)
    assert before.heading == pytest.approx(NORTH) and abs(before.x - 100.0) < 1.5 and -3.2 < before.y < 0.0
    assert (after.x, after.y - before.y) == pytest.approx((before.x, 1.0))


def test_an_ego_that_does_not_brake_hits_it_on_the_crossing(tmp_path: Path) -> None:
    """At 2.6 s its front is at x = 5; 9.48 s later it is at the side of the person, at x = 100.1."""
    late = vehicle("ego", "ab bc", 1, 5.0, 10.0).replace('depart="0"', 'depart="2.5"')
    with street(tmp_path, WALKS, late) as (drive, _):
        until(drive, "ego", 12.5)
        tracks = {track.id: track for track in drive.tracks()}
    assert tracks[PERSON].role is Role.BACKGROUND
    hit = first_other_contact(tracks["ego"], [tracks[PERSON]], 5.0)
    assert hit is not None
    assert (hit[0], hit[1]) == (PERSON, pytest.approx(12.08))


@pytest.mark.parametrize(("y", "harmed"), [(-7.0, True), (-1.6, False)])
def test_an_adversary_that_drives_over_it_has_harmed_a_third_party(tmp_path: Path, y: float, harmed: bool) -> None:
    """The person stands at (60, -7.2); the adversary of 5 m by 2 m goes by at ``y``."""
    cars = (vehicle("ego", "ab bc", 1, 10.0, 5.0), vehicle("bv", "ab bc", 1, 45.0, 10.0))
    with street(tmp_path, *cars, STANDS) as (drive, _):
        until(drive, "ego", 0.5)
        start = drive.now
        for k in range(1, 31):
            drive.tick({"bv": Pose(45.0 + k, y, 0.0, 10.0)})
        case = make_case(drive.tracks("bv"), "ego", ("bv",), start, {})
    assert case is not None
    verdict = judge_attempt(case, limits=load_settings(None).limits.limits())
    assert ("third_party" in verdict.failed_gates) is harmed


@pytest.mark.parametrize("model", ["striping", "nonInteracting"])
def test_it_can_be_moved_and_drivers_brake_for_it(tmp_path: Path, model: str) -> None:
    """It steps from (60, -7.2) to the middle of the lane at 2 m/s; a car comes from 55 m before it."""
    with street(tmp_path, vehicle("car", "ab bc", 1, 5.0, 10.0), STANDS, model=model) as (drive, _):
        until(drive, "", 0.5)
        drive.tick({PERSON: Pose(60.0, -7.0, NORTH, 2.0)})
        assert (drive.state(PERSON).y, drive.state(PERSON).speed) == (pytest.approx(-7.0), 2.0)
        assert drive.simulation.api.person.getIDList() == ()
        for k in range(1, 80):
            drive.tick({PERSON: Pose(60.0, min(-7.0 + 0.2 * k, -1.6), NORTH, 2.0)})
        assert (drive.state(PERSON).x, drive.state(PERSON).y) == (pytest.approx(60.0), pytest.approx(-1.6))
        assert drive.state("car").speed < 0.5 and drive.state("car").x < 58.0
        times = [s.time for s in drive.recording.snapshots if PERSON in s.raw]
        assert np.allclose(np.diff(times), 0.1)


def test_a_jump_over_a_junction_touches_nothing(tmp_path: Path) -> None:
    """The model nonInteracting knows no crossings: after 8.5 m it is on the other pavement, 8.4 m away."""
    with street(tmp_path, vehicle("ego", "ab bc", 1, 10.0, 0.0), WALKS, model="nonInteracting") as (drive, _):
        until(drive, "", 10.0)
        snapshots = drive.recording.snapshots
    missing = [k for k, snapshot in enumerate(snapshots) if PERSON not in snapshot.raw]
    assert len(missing) == 1
    before, after = (snapshots[missing[0] + side].raw[PERSON] for side in (-1, 1))
    assert (before[1], after[1]) == pytest.approx((-4.2, 4.2))


def test_who_rides_in_a_car_is_no_pedestrian(tmp_path: Path) -> None:
    """The car waits at x = 50 until the person has got in."""
    car = (
        '<vehicle id="car" type="calm" depart="0" departPos="40"><route edges="ab bc"/>'
        '<stop lane="ab_1" endPos="50" triggered="true"/></vehicle>'
    )
    rider = '<person id="rider" depart="1" departPos="49"><ride from="ab" to="bc" lines="car"/></person>'
    with street(tmp_path, car, rider) as (drive, _):
        until(drive, "", 1.5)
        assert "person:rider" in drive.snapshot.raw
        until(drive, "", 12.0)
        assert list(drive.snapshot.raw) == ["car"] and drive.simulation.api.person.getVehicle("rider") == "car"


def test_a_simulation_that_is_loaded_again_repeats(tmp_path: Path) -> None:
    simulation = Simulation(street_spec(tmp_path, [vehicle("ego", "ab bc", 1, 10.0, 5.0), WALKS]))
    try:
        seen = []
        for _ in range(2):
            for _ in range(150):
                simulation.step()
            seen.append(simulation.read())
            simulation.reload()
        assert seen[0] == seen[1] and PERSON in seen[0].raw
    finally:
        simulation.close()


# ---- as a user has them


def write_case(folder: Path, candidate: str, depart: float = 0.0) -> Path:
    """``case.toml``: the ego comes at 10 m/s while the person walks towards the crossing."""
    make_street(folder)
    other, ego = vehicle("walker", "cb ba", 1, 5.0, 10.0), vehicle("ego", "ab bc", 1, 5.0, 10.0)
    ego = ego.replace('depart="0"', f'depart="{depart}"')
    crowd = '<personFlow id="crowd" begin="100" end="200" number="3"><walk edges="ab"/></personFlow>'
    (folder / "street.rou.xml").write_text(f"<routes>{TYPES}{WALKS}{other}{ego}{crowd}</routes>")
    case = folder / "case.toml"
    case.write_text(
        'schema = 1\nnetwork = "street.net.xml"\n[demand]\nfiles = ["street.rou.xml"]\n[ego]\nid = "ego"\n'
        f'[adversary]\ncandidates = ["{candidate}"]\n'
    )
    return case


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory, caches: Path) -> Done:
    """The person attacks an IDM driver."""
    program = Program(tmp_path_factory.mktemp("person"), caches)
    case = write_case(program.folder, PERSON)
    return program.here(
        "run", case, "--ego", "idm", "--until", "collision", "--attempts", "4", "--seed", "1", "--json", "--out", "out"
    )


def test_a_person_attacks_as_a_pedestrian(done: Done) -> None:
    assert (done.status, done.err) == (0, "")
    (attempt, *_) = done.outcome["attempts"]
    assert attempt["adversaries"] == [PERSON] and attempt["intent"].startswith("Pedestrian ")
    best = done.outcome["outcome"]
    assert best["collided"] and best["failed_gates"] == []
    rows = read_states(done.folder / "states.csv.gz")
    assert {row["role"] for row in rows[PERSON].values()} == {"adversary"}
    assert {row["role"] for row in rows["walker"].values()} == {"background"}


def test_without_forks_it_is_the_same_and_it_repeats(done: Done, tmp_path: Path, caches: Path) -> None:
    states = read_states(done.folder / "states.csv.gz")
    loaded = Program(tmp_path / "loaded", caches)
    case = done.folder.parent / "case.toml"
    command = ("run", case, "--ego", "idm", "--until", "collision", "--attempts", "4", "--seed", "1")
    assert read_states(loaded.here(*command, "--no-fork", "--json", "--out", "out").folder / "states.csv.gz") == states
    again = Program(tmp_path / "again", caches).here("run", "--replay", done.folder, "--json", "--out", "out")
    assert read_states(again.folder / "states.csv.gz") == states


def test_the_check_of_a_driver_tells_a_hit(tmp_path: Path, caches: Path) -> None:
    """The ego is at the crossing after 13.6 s, when the person that walks north is in its lane."""
    program, case = Program(tmp_path / "check", caches), write_case(tmp_path, PERSON, depart=4.0)
    blind = program.here("doctor", "--ego", "ego_samples:OnwardEgo", "--scenario", case)
    assert f"collides by itself at 13.6 s: its front meets the left of '{PERSON}' (ego 10.0 m/s" in blind.out
    careful = program.here("doctor", "--ego", "careful", "--scenario", case)
    assert (careful.status, careful.out.splitlines()[-1]) == (0, "careful drives well in the one scenario.")


def test_names_of_persons_are_checked(tmp_path: Path, caches: Path) -> None:
    for known in (PERSON, "person:crowd.2"):
        assert load_input(write_case(tmp_path, known)).candidates == (known,)
    with pytest.raises(UsageError, match="names the adversary candidate 'person:unknown', which is not in its demand"):
        load_input(write_case(tmp_path, "person:unknown"))
    done = Program(tmp_path / "run", caches).here("run", write_case(tmp_path, PERSON), "--ego-id", PERSON)
    assert done.status == 2 and f"'{PERSON}' is not a vehicle, so it cannot be the ego" in done.err
