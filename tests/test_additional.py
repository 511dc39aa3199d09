"""Additional files of a user's own simulation: their detectors exist, and write nothing."""

from __future__ import annotations

import gzip
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import pytest
from cli_samples import Program, files_of
from sumo_samples import make_spec, vehicle, write

from sumo_adv.errors import UsageError
from sumo_adv.simulation.inputs import data_folder, load_input
from sumo_adv.simulation.scan import silent_copies
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.simulation_spec import SimulationSpec

INCLUDED = """<additional>
  <e1Detector id="included" lane="west_in_0" pos="60" period="10" file="included.xml"/>
  <busStop id="stop" lane="west_in_0" startPos="80" endPos="100" lines="7"/>
</additional>"""
STEPS = '<vss><step time="1" speed="4"/></vss>'
FLOWS = '<calibrator><flow begin="0" end="30" vehsPerHour="720" speed="8" route="south" type="car"/></calibrator>'
ADDITIONAL = """<?xml version="1.0"?>
<additional>
  <include href="more/included.add.xml"/>
  <vType id="car" sigma="0" speedDev="0"><param key="has.ssm.device" value="true"/>
    <param key="device.ssm.file" value="ssm.xml"/></vType>
  <route id="south" edges="south_in north_out"/>
  <e1Detector id="e1" lane="west_in_0" pos="50" period="10" file="e1.xml"/>
  <inductionLoop id="loop" lane="west_in_1" pos="50" freq="10" file="loop.xml"/>
  <instantInductionLoop id="instant" lane="west_in_1" pos="60" file="instant.xml"/>
  <e2Detector id="e2" lane="west_in_0" pos="40" length="50" period="10" file="e2.xml"/>
  <e3Detector id="e3" period="10" file="e3.xml">
    <detEntry lane="west_in_0" pos="30"/><detExit lane="west_in_0" pos="150"/>
  </e3Detector>
  <edgeData id="edges" period="20" file="edges.xml" edgesFile="names.txt"/>
  <laneData id="lanes" period="20" file="lanes.xml"/>
  <vTypeProbe id="probe" type="car" period="10" file="probe.xml"/>
  <timedEvent type="SaveTLSStates" source="centre" dest="states.xml"/>
  <timedEvent type="SaveTLSSwitchTimes" source="centre" dest="switches.xml"/>
  <rerouter id="rerouter" edges="north_in">
    <interval begin="0" end="100"><destProbReroute id="east_out" probability="1"/></interval>
  </rerouter>
  <variableSpeedSign id="sign" lanes="west_in_1" file="steps.xml"/>
  <calibrator id="calibrator" edge="south_in" pos="0" period="20" output="calibrator.xml" file="flows.xml"/>
  <parkingArea id="parking" lane="north_in_0" startPos="40" endPos="80" roadsideCapacity="4"/>
</additional>"""
BUS = (
    '<vehicle id="bus" type="calm" line="7" depart="0"><route edges="west_in east_out"/>'
    '<stop busStop="stop" duration="6"/></vehicle>'
)
PARKED = (
    '<vehicle id="parked" type="calm" depart="0"><route edges="north_in south_out"/>'
    '<stop parkingArea="parking" duration="5"/></vehicle>'
)


def with_everything(folder: Path) -> tuple[Path, Path]:
    """An additional file with all kinds of outputs, and a demand that uses what it describes."""
    write(folder / "more" / "included.add.xml", INCLUDED)
    write(folder / "steps.xml", STEPS)
    write(folder / "flows.xml", FLOWS)
    write(folder / "names.txt", "edge:west_in\n")
    rides = [BUS, PARKED, vehicle("east", "west_in east_out", 1, 20.0, 8.0, "car")]
    rides += [vehicle(f"north{k}", "north_in south_out", 1, 20.0 + 30.0 * k, 8.0, "car") for k in range(3)]
    demand = make_spec(folder, "signalised_crossing", rides).routes[0]
    return write(folder / "all.add.xml", ADDITIONAL), demand


@pytest.mark.parametrize(
    ("element", "silent"),
    [
        ('<e1Detector id="a" lane="b_0" pos="1" file="/data/out.xml"/>', {"file": "NUL", "lane": "b_0", "pos": "1"}),
        ('<e2Detector id="a" lane="b_0" file="stdout"/>', {"file": "NUL"}),
        ('<edgeData id="a" file="localhost:4000" edgesFile="names.txt"/>', {"file": "NUL", "edgesFile": None}),
        ('<timedEvent type="SaveTLSStates" source="tls" dest="out.xml"/>', {"dest": "NUL", "source": "tls"}),
        ('<calibrator id="a" edge="b" output="out.xml"/>', {"output": "NUL", "edge": "b"}),
        ('<param key="file" value="out.xml"/>', {"value": "NUL"}),
        ('<param key="device.ssm.file" value="out.xml"/>', {"value": "NUL"}),
        ('<param key="device.toc.file" value="out.xml"/>', {"value": "NUL"}),
        ('<vTypeProbe id="&lt;&quot;a&amp;" file="out.xml"/>', {"id": '<"a&', "file": "NUL"}),
    ],
)
def test_what_names_an_output_is_copied_with_the_output_going_nowhere(
    tmp_path: Path, element: str, silent: Mapping[str, str | None]
) -> None:
    original = write(tmp_path / "a.add.xml", f"<additional>{element}</additional>")
    (copy,) = silent_copies([original], tmp_path)
    assert copy != original
    assert copy.name == "a.add.xml"
    only = ElementTree.parse(copy).getroot()[0]
    assert {key: only.get(key) for key in silent} == silent


@pytest.mark.parametrize(
    "element",
    [
        '<busStop id="a" lane="b_0"/>',
        '<param key="profile" value="out.xml"/>',
        '<poly id="a" type="building" shape="0,0 1,1 1,0" imgFile="house.png"/>',
        '<rerouter id="a" edges="b"><interval begin="0" end="9"/></rerouter>',
    ],
)
def test_a_file_that_writes_nothing_is_loaded_as_it_is(tmp_path: Path, element: str) -> None:
    original = write(tmp_path / "a.add.xml", f"<additional>{element}</additional>")
    assert silent_copies([original], tmp_path) == (original,)


def test_two_files_of_one_name_stay_two(tmp_path: Path) -> None:
    detector = '<additional><e1Detector id="{}" lane="b_0" pos="1" file="out.xml"/></additional>'
    originals = [write(tmp_path / name / "a.add.xml", detector.format(name)) for name in ("one", "two")]
    copies = silent_copies(originals, tmp_path)
    assert [re.findall(r' id="(\w+)"', copy.read_text()) for copy in copies] == [["one"], ["two"]]


def test_a_packed_file_and_what_it_includes_are_in_one_copy(tmp_path: Path) -> None:
    write(tmp_path / "home" / "more" / "included.add.xml", INCLUDED)
    packed = tmp_path / "home" / "a.add.xml.gz"
    packed.write_bytes(gzip.compress(b'<additional><include href="more/included.add.xml"/></additional>'))
    (copy,) = silent_copies([packed], tmp_path)
    root = ElementTree.parse(copy).getroot()
    assert [(e.tag, e.get("id"), e.get("file")) for e in root] == [
        ("e1Detector", "included", "NUL"), ("busStop", "stop", None),
    ]  # fmt: skip


def test_sumo_drives_the_same_with_silent_copies_and_writes_nothing(tmp_path: Path) -> None:
    """13 outputs, a bus stop, a parking area, a rerouter, a speed sign and a calibrator: 40 s with and without."""
    home, scratch = tmp_path / "home", tmp_path / "scratch"
    scratch.mkdir()
    files = with_everything(home)
    own = home / "plain.add.xml"
    there = ADDITIONAL.replace("names.txt", str(home / "names.txt"))  # SUMO looks for both in the working folder
    own.write_text(there.replace('"calibrator.xml"', f'"{home / "calibrator.xml"}"'))
    network = data_folder("networks") / "signalised_crossing.net.xml"
    copies = silent_copies(files, scratch)
    before = files_of(home)
    silent = driven(SimulationSpec(network, (copies[1],), (copies[0],), 0.0, 1))
    assert files_of(home) == before
    plain = driven(SimulationSpec(network, (files[1],), (own,), 0.0, 1))
    assert len(files_of(home)) == len(before) + 13
    assert silent == plain
    ways, passed, speed = silent
    assert passed > 0
    assert speed == 4.0
    assert ways["north0"][-2:] == ["north_in", "east_out"]
    assert any(name.startswith("calibrator") for name in ways)


def driven(spec: SimulationSpec) -> tuple[dict[str, list[str]], int, float]:
    """By vehicle its positions and its route; how many vehicles passed a detector; a lane's speed limit [m/s]."""
    simulation = Simulation(spec)
    ways: dict[str, list[str]] = {}
    try:
        passed = 0
        for _ in range(400):
            simulation.step()
            for name, (x, y, *_) in simulation.read().raw.items():
                ways.setdefault(name, []).append(f"{x:.6f} {y:.6f}")
            passed += simulation.api.inductionloop.getLastStepVehicleNumber("included")
        for name in simulation.read().raw:
            ways[name] += simulation.route(name)[0]
        return ways, passed, float(simulation.api.lane.getMaxSpeed("west_in_1"))
    finally:
        simulation.close()


# -- what is wrong with a file


def configured(folder: Path, additional: str) -> Path:
    """A .sumocfg on the crossing with an additional file of its own, in ``folder``."""
    network = data_folder("networks") / "signalised_crossing.net.xml"
    demand = folder / "own.rou.xml"
    shutil.copyfile(data_folder("scenarios") / "demand" / "signals_left_turn.rou.xml", demand)
    text = (
        f'<configuration><net-file value="{network}"/><route-files value="{demand.name}"/>'
        f'<additional-files value="{additional}"/><time><begin value="0"/><end value="60"/></time></configuration>'
    )
    return write(folder / "own.sumocfg", text)


@pytest.mark.parametrize(
    ("included", "says"),
    [
        ("<additional><e1Detector></additional>", "b.add.xml is not valid XML (damaged or cut short)"),
        (None, "a.add.xml names the file"),
        ('<additional><include href="a.add.xml"/></additional>', "a.add.xml, which includes it: remove one"),
    ],
)
def test_a_bad_included_file_is_one_sentence(program: Program, included: str | None, says: str) -> None:
    write(program.folder / "a.add.xml", '<additional><include href="b.add.xml"/></additional>')
    if included is not None:
        write(program.folder / "b.add.xml", included)
    configured(program.folder, "a.add.xml")
    done = program.here("run", "own.sumocfg", "--out", "out")
    assert done.status == 2
    assert says in done.err
    assert done.err.count("\n") == 1


def test_what_is_included_counts_for_ids_and_for_the_content_of_an_input(tmp_path: Path) -> None:
    write(tmp_path / "more" / "included.add.xml", INCLUDED)
    write(tmp_path / "a.add.xml", '<additional><include href="more/included.add.xml"/></additional>')
    loaded = load_input(configured(tmp_path, "a.add.xml"))
    assert [path.name for path in loaded.files[-2:]] == ["a.add.xml", "included.add.xml"]
    elsewhere = '<additional><trip id="x" from="nowhere" to="east_out"/></additional>'
    write(tmp_path / "more" / "included.add.xml", elsewhere)
    with pytest.raises(UsageError, match="has no edge 'nowhere'"):
        load_input(configured(tmp_path, "a.add.xml"))


# -- runs


def test_a_run_and_its_replay_write_nothing_beside_the_configuration(program: Program) -> None:
    """The run's own copies hold what was included, so that the run can be repeated without the user's folder."""
    home = program.folder / "town"
    with_everything(home)
    configured(home, "all.add.xml")
    before = files_of(home)
    options = ("--ego-id", "ego", "--trigger", "7", "--attempts", "3", "--until", "critical", "--out", "out")
    done = program.here("run", "town/own.sumocfg", *options)
    assert (done.status, done.err) == (0, "")
    assert done.outcome["attempts"]
    assert files_of(home) == before
    for file in home.rglob("*.xml"):
        file.unlink()
    again = program.here("run", "--replay", "out", "--out", "again")
    assert (again.status, again.err) == (0, "")
    assert again.outcome["outcome"] == done.outcome["outcome"]
    assert list(program.folder.glob("*.xml")) == []
