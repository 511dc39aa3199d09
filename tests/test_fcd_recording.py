"""FCD as SUMO writes it: each of its options gives the tracks that SUMO drove, or a sentence."""

from __future__ import annotations

import subprocess
from contextlib import chdir
from pathlib import Path

import numpy as np
import pytest
from cli_samples import Done, Program

from sumo_adv.simulation.fcd_types import CAR_SIZE, CLASS_SIZES
from sumo_adv.simulation.programs import find_netconvert, find_sumo, load_libsumo
from sumo_adv.simulation.scenario import ROUTES_FILE, SCENARIO_FILE, TRACKS_FILE
from sumo_adv.simulation.tracks import TrackLog, read_tracks

NODES = """<nodes><node id="a" x="9.0" y="47.85"/><node id="b" x="9.005" y="47.85"/><node id="c" x="9.009" y="47.852"/>
</nodes>"""
EDGES = """<edges><edge id="ab" from="a" to="b" numLanes="2" speed="20"/><edge id="bc" from="b" to="c" numLanes="2"
speed="20"/></edges>"""
TYPES = """<additional><vType id="bus" vClass="bus"/><vType id="lorry" vClass="trailer"/><vType id="bike"
vClass="motorcycle"/><vType id="small" length="3.5" width="1.6"/></additional>"""
ROUTES_OF = """<routes><route id="on" edges="ab bc"/>
<vehicle id="ego" type="small" route="on" depart="0" departPos="20" departSpeed="15"/>
<vehicle id="lorry" type="lorry" route="on" depart="0" departPos="60" departSpeed="15"/>
<vehicle id="bike" type="bike" route="on" depart="0" departPos="20" departLane="1" departSpeed="15"/>
<vehicle id="bus" type="bus" route="on" depart="0" departPos="90" departLane="1"><stop lane="ab_1" endPos="110"
duration="3" startPos="80"/></vehicle>
<person id="ego" depart="0"><ride from="ab" to="bc" lines="bus"/></person>
</routes>"""


class World:
    """A road of 370 and 370 m with a projection, and what SUMO records there."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name, text in (("n.nod.xml", NODES), ("e.edg.xml", EDGES), ("t.add.xml", TYPES), ("r.rou.xml", ROUTES_OF)):
            (folder / name).write_text(text, encoding="utf-8")
        plain = ["-n", "n.nod.xml", "-e", "e.edg.xml", "--no-warnings"]
        self._run(find_netconvert(), *plain, "--proj.utm", "-o", "geo.net.xml")
        net = (folder / "geo.net.xml").read_text(encoding="utf-8")
        start = net.index('projParameter="') + len('projParameter="')
        (folder / "flat.net.xml").write_text(net[:start] + "!" + net[net.index('"', start) :], encoding="utf-8")

    def _run(self, program: Path, *arguments: str) -> None:
        subprocess.run([program, *arguments], cwd=self.folder, check=True, capture_output=True)

    def record(self, name: str, *options: str, seconds: float = 12.0, step: str = "0.1") -> Path:
        self._run(
            find_sumo(), "-n", "geo.net.xml", "-a", "t.add.xml", "-r", "r.rou.xml", "--begin", "0", "--end",
            str(seconds), "--step-length", step, "--fcd-output", name, "--no-step-log", "--no-warnings", *options,
        )  # fmt: skip
        return self.folder / name


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    return World(tmp_path_factory.mktemp("world"))


def imported(program: Program, world: World, recording: Path, *more: str, network: str = "geo.net.xml") -> Done:
    types = ["--types", str(world.folder / "t.add.xml")]
    return program.here(
        "import",
        recording,
        "--network",
        world.folder / network,
        "--ego",
        "ego",
        "--out",
        "made",
        "--force",
        *types,
        *more,
    )


def tracks(program: Program, done: Done) -> TrackLog:
    assert done.status == 0, done.err
    return read_tracks(program.folder / "made" / TRACKS_FILE)


def test_classes_have_sumos_own_sizes(world: World) -> None:
    """What SUMO itself says of a vType with this class and no size."""
    names = [*CLASS_SIZES, "passenger", "taxi", "hov", "evehicle", "army", "custom1"]
    text = "".join(f'<vType id="{name}" vClass="{name}"/>' for name in names)
    (world.folder / "classes.add.xml").write_text(f"<additional>{text}</additional>")
    libsumo = load_libsumo()
    libsumo.start(["sumo", "-n", str(world.folder / "geo.net.xml"), "-a", str(world.folder / "classes.add.xml")])
    said = {n: (libsumo.vehicletype.getLength(n), libsumo.vehicletype.getWidth(n)) for n in names}
    libsumo.close()
    assert said == {name: pytest.approx(CLASS_SIZES.get(name, CAR_SIZE)) for name in names}


def test_each_vehicle_has_the_size_of_its_class_and_goes_on(program: Program, world: World) -> None:
    log = tracks(program, imported(program, world, world.record("fcd.xml")))
    sizes = {name: (track.length, track.width) for name, track in log.tracks.items()}
    assert sizes["bus"] == (12.0, 2.5) and sizes["lorry"] == (16.5, 2.55) and sizes["bike"] == (2.2, 0.9)
    assert sizes["ego"] == (3.5, 1.6)
    assert log.tracks["ego"].x[0] == pytest.approx(20.0 - 3.5 / 2, abs=0.01)  # the middle, behind the bumper
    routes = (program.folder / "made" / ROUTES_FILE).read_text(encoding="utf-8")
    assert '<route id="ego" edges="ab bc"/>' in routes  # after 12 s it is still on ab


def test_a_passenger_is_no_pedestrian_within_the_bus(program: Program, world: World) -> None:
    """The person, who is called as a vehicle is, waits for the bus at x = 0 until it has stopped, and rides then."""
    done = imported(program, world, world.record("fcd.xml"))
    person = tracks(program, done).tracks["person:ego"]
    assert person.kind == "pedestrian" and person.valid[0]
    assert np.abs(np.diff(person.x[person.valid])).max(initial=0.0) < 0.5
    assert ("Persons are left out while they are in a vehicle: ego." in done.err) == (not person.valid.all())


def test_a_container_is_no_road_user_and_is_said(program: Program, world: World) -> None:
    """SUMO writes ``<container>`` beside vehicles and persons."""
    text = world.record("fcd.xml").read_text(encoding="utf-8")
    box = '<container id="box" x="1.00" y="2.00" angle="0.00" speed="0.00" pos="9.00" edge="ab"/>'
    (world.folder / "box.xml").write_text(text.replace("</timestep>", f"{box}</timestep>"), encoding="utf-8")
    done = imported(program, world, world.folder / "box.xml")
    assert "Containers are left out: box." in done.err
    assert "box" not in tracks(program, done).tracks


@pytest.mark.parametrize(
    ("option", "far", "says"),
    [
        ("--fcd-output.geo", 0.12, "Longitudes and latitudes are converted with the network's projection."),
        ("--fcd-output.utm", 0.011, "Places of --fcd-output.utm are moved by the network's offset."),
        ("--human-readable-time", 1e-4, ""),
    ],
)
def test_places_and_times_in_other_units_are_those_of_the_network(
    program: Program, world: World, option: str, far: float, says: str
) -> None:
    """Six decimals of a degree are 0.07 m eastwards and 0.11 m northwards."""
    plain = tracks(program, imported(program, world, world.record("fcd.xml")))
    done = imported(program, world, world.record("other.xml", option))
    other = tracks(program, done)
    assert says in done.err and other.time == pytest.approx(plain.time)
    for name, track in plain.tracks.items():
        keep = track.valid
        away = np.hypot(other.tracks[name].x - track.x, other.tracks[name].y - track.y)[keep]
        assert (other.tracks[name].valid == keep).all() and away.max() < far


@pytest.mark.parametrize(("step", "count"), [("0.005", 400), ("0.033", 61), ("0.125", 16), ("1", 2)])
def test_a_step_of_any_length_is_kept(program: Program, world: World, step: str, count: int) -> None:
    """Times of 0 to below 2 s: 2 / 0.005, 2 / 0.125 and 2 / 1 of them, and 60 steps of 0.033 s after the first."""
    recording = world.record("steps.xml.gz", seconds=2.0, step=step)
    log = tracks(program, imported(program, world, recording, "--warm-up", "1"))
    assert log.time == pytest.approx(float(step) * np.arange(count), abs=1e-9)
    assert log.tracks["ego"].valid.all()


def test_a_type_that_traci_copied_keeps_its_size(program: Program, world: World) -> None:
    """``vehicle.setMinGap`` and its like give a vehicle a type of its own, called ``lorry@lorry``."""
    libsumo, files = load_libsumo(), ("-n", "geo.net.xml", "-a", "t.add.xml", "-r", "r.rou.xml")
    with chdir(world.folder):
        libsumo.start(["sumo", *files, "--step-length", "0.1", "--fcd-output", "copied.xml", "--no-step-log"])
        for _ in range(40):
            libsumo.simulationStep()
            libsumo.vehicle.setMinGap("lorry", 1.0)
        libsumo.close()
    assert 'type="lorry@lorry"' in (world.folder / "copied.xml").read_text(encoding="utf-8")
    log = tracks(program, imported(program, world, world.folder / "copied.xml"))
    assert (log.tracks["lorry"].length, log.tracks["lorry"].width) == (16.5, 2.55)


def test_a_type_that_no_file_has_is_named(program: Program, world: World) -> None:
    recording, network = world.record("fcd.xml"), world.folder / "geo.net.xml"
    done = program.here("import", recording, "--network", network, "--ego", "ego", "--out", "made")
    assert "No file says the size of the types bike, small, lorry, bus: 5 by 1.8 m are assumed" in done.err


def changed(world: World, change: tuple[str, str]) -> Path:
    path = world.folder / "changed.xml"
    path.write_text(world.record("fcd.xml").read_text(encoding="utf-8").replace(*change), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (('<timestep time="0.20">', '<timestep time="0.10">'), "the timestep at 0.1 s comes twice"),
        (('<timestep time="0.20">', '<timestep time="0.05">'), "the timestep at 0.05 s comes after 0.1 s"),
        (('<timestep time="0.20">', '<timestep time="0.24">'), "has no even steps"),
        (('id="lorry"', 'id="bike"'), "the vehicle 'bike' comes twice at 0 s"),
        (('x="20.00"', 'x="nan"'), "has nan for x, which is not a finite number"),
        (('time="0.10"', 'time="soon"'), "has a bad timestep time 'soon'"),
    ],
)
def test_what_cannot_be_right_is_refused_with_its_place(
    program: Program, world: World, change: tuple[str, str], says: str
) -> None:
    done = imported(program, world, changed(world, change))
    assert done.status == 2 and says in done.err and len(done.err.splitlines()) == 1
    assert not (program.folder / "made").exists()


@pytest.mark.parametrize(
    ("options", "network", "more", "says"),
    [
        (("--fcd-output.geo",), "flat.net.xml", (), "flat.net.xml has no projection to convert them with"),
        (
            ("--fcd-output.attributes", "x,y,speed,lane"),
            "geo.net.xml",
            (),
            "has no angle at 0 s; --fcd-output.attr",
        ),
        (("--fcd-output.attributes", "x,y,angle,speed"), "geo.net.xml", (), "'ego' has no lane; --fcd-output.attr"),
        ((), "geo.net.xml", ("--warm-up", "30"), "for 11.9 s, and the recording moves it for the first 30 s"),
    ],
)
def test_what_sumo_was_told_to_leave_out_is_named(
    program: Program, world: World, options: tuple[str, ...], network: str, more: tuple[str, ...], says: str
) -> None:
    done = imported(program, world, world.record("less.xml", *options), *more, network=network)
    assert done.status == 2 and says in done.err


def test_speeds_in_kmh_of_another_tool_are_refused(program: Program, world: World) -> None:
    """The ego's 15 m/s and more as km/h, in all rows."""
    text = world.record("fcd.xml").read_text(encoding="utf-8")
    parts = text.split(' speed="')
    kmh = [f"{float(part[: part.index(chr(34))]) * 3.6:.2f}{part[part.index(chr(34)) :]}" for part in parts[1:]]
    (world.folder / "kmh.xml").write_text(' speed="'.join([parts[0], *kmh]), encoding="utf-8")
    done = imported(program, world, world.folder / "kmh.xml")
    assert done.status == 2 and "speeds look like km/h" in done.err


def test_a_csv_of_sumo_is_named(program: Program, world: World) -> None:
    done = imported(program, world, world.record("fcd.csv"))
    assert done.status == 2 and "is not XML: let SUMO write the FCD into a file whose name ends in .xml" in done.err


def test_what_a_short_recording_becomes_runs(program: Program, world: World) -> None:
    """After 4 s the ego is at 80 m of 373; the run drives it on for 20 s."""
    tracks(program, imported(program, world, world.record("short.xml", seconds=4.0)))
    limits = ("--attempts", "1", "--seconds", "5", "--total-seconds", "5", "--learn", "off")
    done = program.here("run", program.folder / "made" / SCENARIO_FILE, "--ego", "idm", "--out", "out", *limits)
    assert done.status == 0 and "Result: " in done.out, done.err
