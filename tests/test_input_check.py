"""Simulations of many kinds move here as in the program ``sumo``; what does not is said."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from cli_samples import ROOT, Program
from simulation_samples import (
    COUNTRY_EDGES,
    COUNTRY_NODES,
    EDGES,
    NODES,
    configuration,
    write_configuration,
)
from sumo_samples import make_net

from sumo_adv.config import load_settings
from sumo_adv.input_check import InputCheck, WatchWorker, check_input
from sumo_adv.input_check.motions import compare_motions
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.inputs import load_input, own_simulation

Check = Callable[[Path], InputCheck]
SECONDS = 40.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("simulations")


@pytest.fixture(scope="module")
def crossing(folder: Path) -> Path:
    return make_net(folder, NODES, EDGES, "--crossings.guess", "--tls.default-type", "actuated", name="crossing")


@pytest.fixture(scope="module")
def left_hand(folder: Path) -> Path:
    return make_net(folder, NODES, EDGES, "--lefthand", name="left")


@pytest.fixture(scope="module")
def country(folder: Path) -> Path:
    return make_net(folder, COUNTRY_NODES, COUNTRY_EDGES, "--opposites.guess", name="country")


@pytest.fixture(scope="module")
def check(folder: Path) -> Iterator[Check]:
    """The check of one input, all in one engine process."""
    with Engine(WatchWorker, slots=0) as engine:

        def checked(path: Path) -> InputCheck:
            run_input = load_input(path)
            return check_input(
                engine, run_input, load_settings(None, **own_simulation(run_input)), path.parent, SECONDS
            )

        yield checked


WE, EW = '<route id="we" edges="WC CE"/>', '<route id="ew" edges="EC CW"/>'
SN = '<route id="sn" edges="SC CN"/>'
CROSSING = {
    "flow without begin": (
        f'{WE}<flow id="f" route="we" period="10"/><vehicle id="late" route="we" depart="15"/>', "", {}, (5, 0)
    ),
    "persons and a bus line": (
        f'''{WE}<vType id="bus" vClass="bus"/><person id="rider" depart="0"><walk from="WC" busStop="stop"/>
        <ride busStop="next" lines="L"/></person><person id="walker" depart="0"><walk from="WC" to="CE"/></person>
        <vehicle id="bus" type="bus" route="we" line="L" depart="1"><stop busStop="stop" duration="5"/>
        <stop busStop="next" duration="5"/></vehicle>''',
        '''<busStop id="stop" lane="WC_1" startPos="20" endPos="40" lines="L"/>
        <busStop id="next" lane="CE_1" startPos="20" endPos="40" lines="L"/>''',
        {"pedestrian.model": "striping"}, (1, 2)
    ),
    "bus lane": (
        f'''{SN}<vType id="bus" vClass="bus"/><vehicle id="bus" type="bus" route="sn" depart="0"/>
        <vehicle id="car" route="sn" depart="0"/><vehicle id="taxi" route="sn" depart="3"/>''', "", {}, (3, 0)
    ),
    "collision of its own": (
        f'''{EW}<vType id="blind" tau="0.1" minGap="0.5" apparentDecel="0.5" decel="1" emergencyDecel="1"
        carFollowModel="IDM" accel="3"/><vehicle id="stands" route="ew" depart="0" departPos="60" departSpeed="max">
        <stop lane="EC_0" endPos="170" duration="20"/></vehicle>
        <vehicle id="crash" type="blind" route="ew" depart="2" departSpeed="max"/>
        <vehicle id="after" route="ew" depart="9"/>''', "", {}, (3, 0)
    ),
    "actuated light": (
        f'''{WE}{SN}<flow id="a" route="we" period="4" begin="0" end="40"/>
        <flow id="b" route="sn" period="9" begin="0" end="40"/>''', "", {}, (15, 0)
    ),
    "teleport": (
        f'''{SN}<vehicle id="stands" route="sn" depart="0"><stop lane="SC_1" endPos="60" duration="60"/></vehicle>
        <vehicle id="waits" route="sn" depart="3"/>''', "", {"time-to-teleport": "8"}, (2, 0)
    ),
    "rerouter": (
        f'{WE}<flow id="f" route="we" period="5" begin="0" end="40"/>',
        '''<rerouter id="r" edges="WC"><interval begin="0" end="100"><destProbReroute id="CN" probability="0.5"/>
        <destProbReroute id="CE" probability="0.5"/></interval></rerouter>''', {}, (8, 0)
    ),
    "variable speed sign": (
        f'{WE}<flow id="f" route="we" period="8" begin="0" end="40"/>',
        '<variableSpeedSign id="v" lanes="WC_1 WC_2"><step time="10" speed="5"/><step time="30" speed="20"/>'
        "</variableSpeedSign>", {}, (5, 0)
    ),
    "parking": (
        f'''{WE}<vehicle id="parks" route="we" depart="0"><stop parkingArea="p" duration="15"/></vehicle>
        <vehicle id="passes" route="we" depart="6"/>''',
        '<parkingArea id="p" lane="WC_1" startPos="60" endPos="100" roadsideCapacity="3"/>', {}, (2, 0)
    ),
    "ballistic trips": (
        '<trip id="t" from="WC" to="CN" depart="0"/><trip id="u" from="SC" to="CE" depart="0:00:02"/>', "",
        {"step-method.ballistic": "true"}, (2, 0)
    ),
    "sublanes scaled": (
        f'''{WE}<vType id="bike" vClass="bicycle" latAlignment="right"/>
        <vehicle id="bike" type="bike" route="we" depart="0"/><flow id="f" route="we" period="8" begin="1" end="41"/>
        ''', "", {"lateral-resolution": "0.8", "scale": "2"}, (12, 0)
    ),
    "pedestrians without interaction": (
        '<personFlow id="p" period="6" begin="0" end="40"><walk from="WC" to="CE"/></personFlow>', "",
        {"pedestrian.model": "nonInteracting"}, (0, 7)
    ),
    "recorded in part": (
        f'''{WE}{SN}<flow id="a" route="we" period="4" begin="0" end="40"/>
        <flow id="b" from="SC" to="CE" period="9" begin="0" end="40"/>''', "",
        {"device.fcd.probability": "0.4", "device.fcd.period": "2", "device.rerouting.probability": "0.5"}, (15, 0)
    ),
    "recorded by name": (
        f'{WE}<vehicle id="a" route="we" depart="0"/><vehicle id="b" route="we" depart="3"/>', "",
        {"device.fcd.explicit": "b", "device.fcd.begin": "20"}, (2, 0)
    ),
    "flow by number": (f'{WE}<flow id="f" route="we" number="9"/>', "", {"end": "90"}, (4, 0)),
    "route errors ignored": (
        f'''{WE}<vehicle id="bad" depart="0"><route edges="WC NC"/></vehicle>
        <vehicle id="good" route="we" depart="1"/>''', "",
        {"ignore-route-errors": "true", "default.action-step-length": "0.5"}, (2, 0)
    ),
}  # fmt: skip
"""Demand, additional file, options; vehicles and persons in SUMO within 40 s, counted from the demand."""


@pytest.mark.parametrize("kind", CROSSING)
def test_traffic_moves_as_in_sumo(folder: Path, crossing: Path, check: Check, kind: str) -> None:
    demand, additional, options, (vehicles, persons) = CROSSING[kind]
    done = check(configuration(folder / kind, crossing, demand, additional, **options))
    assert done.comparison is not None and done.own_step is None
    assert (done.comparison.vehicles, done.comparison.persons) == (vehicles, persons)
    assert done.same and done.comparison.position < 0.001 and done.comparison.speed < 0.001
    assert all("because this program sets them itself: device.fcd." in note for note in done.notes)


def test_the_users_own_collision_teleports_as_in_sumo_and_is_said(folder: Path, crossing: Path, check: Check) -> None:
    demand, additional, options, _ = CROSSING["collision of its own"]
    done = check(configuration(folder / "crash", crossing, demand, additional, **options))
    assert any("Teleporting vehicle 'crash'; collision with vehicle 'stands'" in w.first for w in done.warnings)


def test_left_hand_traffic_and_overtaking_on_the_other_side(
    folder: Path, left_hand: Path, country: Path, check: Check
) -> None:
    left = f'{WE}{SN}<flow id="a" route="we" period="8"/><flow id="b" route="sn" period="8"/>'
    over = """<vType id="slow" maxSpeed="8"/><vType id="fast" lcOpposite="10" lcOvertakeRight="1" speedFactor="1.2"/>
    <route id="r" edges="AB"/><vehicle id="slow" type="slow" route="r" depart="0" departPos="100"/>
    <vehicle id="fast" type="fast" route="r" depart="1" departSpeed="20"/>"""
    for name, network, demand, vehicles in (("left", left_hand, left, 10), ("over", country, over, 2)):
        done = check(configuration(folder / name, network, demand))
        assert done.same and done.comparison is not None and done.comparison.vehicles == vehicles


def test_files_by_commas_variables_and_gzip_are_read_as_in_sumo(
    folder: Path, crossing: Path, check: Check, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = folder / "files"
    path = configuration(place, crossing, f'{WE}<vType id="car"/>')
    with gzip.open(place / "two.rou.xml.gz", "wt") as file:
        file.write('<routes><vehicle id="v" type="car" route="we" depart="2"/></routes>')
    (place / "three.rou.xml").write_text('<routes><vehicle id="w" type="car" route="we" depart="3"/></routes>')
    monkeypatch.setenv("DEMAND_OF_THE_TEST", "three")
    given = {
        "n": str(crossing), "routes": "r.rou.xml, two.rou.xml.gz,${DEMAND_OF_THE_TEST}.rou.xml", "step-length": "0.1",
        "b": "0:00:01",
    }  # fmt: skip
    done = check(write_configuration(path, given))
    assert done.same and done.comparison is not None and done.comparison.vehicles == 2


def test_what_is_not_as_in_sumo_is_said_with_the_vehicle_and_the_status(
    program: Program, folder: Path, crossing: Path
) -> None:
    """A step of 1 s is split, so only the traffic at SUMO's own step differs; edge weights from a file are not kept."""
    program.variables = {"SUMO_ADV_SEED": "1"}
    path = configuration(folder / "coarse", crossing, f'{WE}<flow id="f" route="we" period="10" begin="0" end="30"/>')
    given = {"net-file": str(crossing), "route-files": "r.rou.xml"}
    done = program.here("doctor", str(write_configuration(path, given)), "--seconds", "30")
    assert done.status == 0, done.err
    lines = done.out.splitlines()
    assert lines[-1].startswith("As SUMO runs it in steps of 0.1 s: 3 of 3 vehicles, largest difference 0.000 m and")
    assert lines[-2].startswith("With SUMO's own step of 1 s: 0 of 3 vehicles, largest difference ")
    report = json.loads(program.here("doctor", str(path), "--seconds", "30", "--json").out)
    assert report["same"] and report["comparison"]["vehicles"] == 3 and report["own_step"]["step"] == 1.0


def test_a_network_and_a_scenario_say_what_was_read(program: Program) -> None:
    done = program.here("doctor", "motorway")
    assert (done.status, done.out) == (0, "Read from motorway: 1 edges, 3 lanes for cars.\n")
    done = program.here("doctor", str(ROOT / "scenarios" / "motorway_cut_in_left.toml"), "--seconds", "5")
    assert "As SUMO runs it: " in done.out and done.status == 0
    assert program.here("doctor", "motorway", "--ego", "idm").status == 2
    assert program.here("doctor", "--seconds", "5").status == 2


def test_missing_and_moved_vehicles_are_named() -> None:
    """One is 3 m away at 0.2 s, one comes never here, one is here alone, and one misses a step."""
    still = {100: (0.0, 0.0, 1.0), 200: (0.0, 0.0, 1.0)}
    here = {"a": still | {200: (3.0, 0.0, 1.5)}, "new": still, "gap": {100: (0.0, 0.0, 1.0)}, "fine": still}
    sumo = {"a": still, "lost": still, "gap": still, "fine": still}
    found = compare_motions(here, sumo, 0.0, (0.0, 0.2), 0.1)
    assert (found.vehicles, found.same_vehicles, found.position, found.speed) == (4, 1, 3.0, 0.5)
    assert (found.missing, found.additional, found.absent, found.worst) == (("lost",), ("new",), ("gap",), ("a", 0.2))
    assert not found.same and "never here: lost; only here: new; not in the same steps: gap" in found.sentence
