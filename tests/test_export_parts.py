"""Parts of exports with numbers worked out by hand: late and leaving vehicles, hostile ids, files and wrong use."""

from __future__ import annotations

import csv
import gzip
import io
import math
import pickle
import shutil
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from cli_samples import ROOT
from hypothesis import given
from hypothesis import strategies as st
from run_samples import run_folder
from typer.testing import CliRunner
from xosc_reader import entity, events, number

from sumo_adv.cli.main import app
from sumo_adv.datatypes import Role, Track
from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.report.export import Variant
from sumo_adv.report.export.commonroad import write_commonroad, write_scenarionet
from sumo_adv.report.export.messages import write_osi
from sumo_adv.report.export.openscenario import check_openscenario, entity_names, openscenario, reference_points
from sumo_adv.report.export.piece import ExportedRun, read_piece
from sumo_adv.report.export.sumo import fcd, front, table

NETWORK = ROOT / "networks" / "two_way.net.xml"
HOSTILE = 'a"<b>&$c\x07 ]]>é'


def straight(id: str, role: Role, first: float, last: float, heading: float = 0.0, **size: float) -> Track:
    """10 m/s along a heading from (100, 0), every 0.1 s from ``first`` to ``last``."""
    time = np.round(np.arange(first, last + 0.05, 0.1), 3)
    gone, still = 10.0 * (time - first), np.zeros(len(time))
    return Track(
        id, role, time, 100.0 + gone * math.cos(heading), gone * math.sin(heading), still + heading, still + 10.0,
        still, size.get("length", 5.0), size.get("width", 1.8), ("",) * len(time),
    )  # fmt: skip


def piece_of(*tracks: Track, takeover: float | None = 1.0) -> ExportedRun:
    adversary = next((t.id for t in tracks if t.role is Role.ADVERSARY), None)
    written = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
    return ExportedRun("made up", NETWORK, tracks, 0.0, 3.0, 0.1, "ego", adversary, takeover, written)


EGO, BV = straight("ego", Role.EGO, 0.0, 3.0), straight(HOSTILE, Role.ADVERSARY, 0.0, 3.0, math.pi / 2)
LATE = straight("late", Role.BACKGROUND, 1.0, 2.0)
ONCE = straight("once", Role.BACKGROUND, 1.5, 1.5)
WALKER = straight("pedestrian0", Role.OBSTACLE, 0.0, 3.0, length=0.5, width=0.5)
PARKED = straight("parked0", Role.OBSTACLE, 0.0, 3.0, length=4.5)
TRUCK = straight("truck", Role.BACKGROUND, 0.0, 3.0, length=12.0, width=2.5)
BICYCLE = straight("bicycle", Role.BACKGROUND, 0.0, 3.0, length=1.6, width=0.65)
ALL = piece_of(EGO, BV, LATE, ONCE, WALKER, PARKED, TRUCK, BICYCLE)


@pytest.mark.parametrize("variant", Variant)
def test_whatever_there_is_is_valid(variant: Variant) -> None:
    text = openscenario(ALL, variant)
    check_openscenario(text)
    assert openscenario(ALL, variant) == text
    root = ElementTree.fromstring(text)
    sorts = [(o[0].tag, o[0].get("vehicleCategory")) for o in root.iterfind("Entities/ScenarioObject")]
    assert sorts == [
        ("Vehicle", "car"), ("Vehicle", "car"), ("Vehicle", "car"), ("Vehicle", "car"), ("Pedestrian", None),
        ("MiscObject", None), ("Vehicle", "truck"), ("Vehicle", "bicycle"),
    ]  # fmt: skip
    assert number(entity(root, "pedestrian0").find("BoundingBox/Center"), "x") == 0.0
    assert number(entity(root, "truck").find("BoundingBox/Center"), "x") == pytest.approx(3.6)  # 0.3 of 12 m


def test_late_vehicles_come_and_leaving_ones_go() -> None:
    root = ElementTree.fromstring(openscenario(ALL))
    starting = {p.get("entityRef") for p in root.iterfind("Storyboard/Init/Actions/Private")}
    assert "late" not in starting and "once" not in starting and "ego" in starting
    comes, drives, goes = events(root, "late")
    times = [number(e.find("StartTrigger//SimulationTimeCondition"), "value") for e in (comes, drives, goes)]
    assert times == pytest.approx([1.0, 1.0, 2.1])
    place = comes.find(".//AddEntityAction/Position/WorldPosition")
    assert number(place, "x") == pytest.approx(98.5)  # the centre at 100 m, the rear axle 1.5 m behind it
    assert goes.find(".//DeleteEntityAction") is not None
    assert [e.find(".//FollowTrajectoryAction") for e in events(root, "once")] == [None, None]
    assert number(root.find("Storyboard/StopTrigger//SimulationTimeCondition"), "value") == 3.0


# -- what a log sees: people that move, and objects that are out of sight for a while


def gapped(id: str, role: Role, first: float, last: float, **size: float) -> Track:
    """As ``straight``, without the states of 1.0 to 1.4 s."""
    track = straight(id, role, first, last, **size)
    return track.picked(np.flatnonzero((track.time < 0.95) | (track.time > 1.45)))


STILL = replace(PARKED, id="box0", x=0.0 * PARKED.x + 130.0, speed=0.0 * PARKED.x)
RIDER = straight("rider0", Role.OBSTACLE, 1.0, 3.0, length=1.8, width=0.8)  # first seen after 1 s
UNSEEN = gapped("unseen0", Role.BACKGROUND, 0.0, 3.0)
LOG = piece_of(EGO, BV, WALKER, PARKED, STILL, RIDER, UNSEEN)
AFTER = [round(0.1 * k, 3) for k in (*range(10), *range(15, 31))]  # s: when the unseen one is seen


def test_kinds_come_from_the_size_and_only_what_never_moves_is_static(tmp_path: Path) -> None:
    """Recorded people, cyclists and objects have the same role, whether they move or not."""
    write_commonroad(tmp_path, LOG)
    root = ElementTree.parse(tmp_path / "scenario.xml").getroot()
    assert [each.findtext("type") for each in root.iterfind("staticObstacle")] == ["parkedVehicle"]
    kinds = [each.findtext("type") for each in root.iterfind("dynamicObstacle")]
    assert kinds == ["car", "pedestrian", "unknown", "bicycle", "car", "car"]  # the last two are the unseen one
    write_scenarionet(tmp_path, LOG)
    (file,) = tmp_path.glob("sd_*.pkl")
    tracks = pickle.loads(file.read_bytes())["tracks"]
    assert [tracks[name]["type"] for name in ("pedestrian0", "rider0")] == ["PEDESTRIAN", "CYCLIST"]
    assert tracks["rider0"]["state"]["valid"].tolist() == [False] * 10 + [True] * 21


def test_osi_moves_what_moves(tmp_path: Path) -> None:
    pytest.importorskip("osi3", reason="needs osi-python")
    from osi3.osi_groundtruth_pb2 import GroundTruth

    write_osi(tmp_path / "run.osi", LOG)
    data, truths = (tmp_path / "run.osi").read_bytes(), []
    while data:
        length = int.from_bytes(data[:4], "little")
        truths.append(GroundTruth.FromString(data[4 : 4 + length]))
        data = data[4 + length :]
    last = truths[-1]
    assert [each.source_reference[0].identifier[0] for each in last.stationary_object] == ["box0"]
    moving = {each.source_reference[0].identifier[0]: each for each in last.moving_object}
    assert moving["pedestrian0"].type == moving["pedestrian0"].TYPE_PEDESTRIAN
    assert moving["pedestrian0"].base.velocity.x == pytest.approx(10.0)
    assert moving["rider0"].vehicle_classification.type == moving["rider0"].vehicle_classification.TYPE_BICYCLE
    seen = {
        round(truth.timestamp.seconds + truth.timestamp.nanos / 1e9, 3): each.base.position.x
        for truth in truths for each in truth.moving_object if each.source_reference[0].identifier[0] == "unseen0"
    }  # fmt: skip
    assert list(seen) == AFTER
    assert list(seen.values()) == pytest.approx([100.0 + 10.0 * time for time in AFTER])


def test_states_after_a_gap_are_at_their_own_times(tmp_path: Path) -> None:
    write_commonroad(tmp_path, LOG)
    root = ElementTree.parse(tmp_path / "scenario.xml").getroot()
    before, after = root.findall("dynamicObstacle")[-2:]
    spans = [[int(time.text or "") for time in each.iterfind(".//time/exact")] for each in (before, after)]
    assert spans == [list(range(10)), list(range(15, 31))]
    assert float(after.findtext("initialState/position/point/x") or "") == pytest.approx(115.0)
    write_scenarionet(tmp_path, LOG)
    (file,) = tmp_path.glob("sd_*.pkl")
    state = pickle.loads(file.read_bytes())["tracks"]["unseen0"]["state"]
    assert [round(0.1 * k, 3) for k in np.flatnonzero(state["valid"])] == AFTER
    assert state["position"][20, 0] == pytest.approx(120.0)
    root = ElementTree.fromstring(openscenario(LOG))
    check_openscenario(openscenario(LOG))
    times = [number(e.find("StartTrigger//SimulationTimeCondition"), "value") for e in events(root, "unseen0")]
    assert times == pytest.approx([0.0, 1.0, 1.5, 1.5])  # drives, goes, comes, drives


def test_a_waymo_record_has_no_states_in_a_gap(tmp_path: Path) -> None:
    pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'sumo-adv[womd]'")
    from sumo_adv.report.export.womd import write_womd
    from sumo_adv.womd.reader import read_records

    write_womd(tmp_path / "run.tfrecord", LOG)  # begins at 0 s, as the takeover is at 1 s
    (record,) = read_records(tmp_path / "run.tfrecord")
    (track,) = [each for each in record.tracks if each.id == 1 + [t.id for t in LOG.tracks].index("unseen0")]
    assert [round(0.1 * k, 3) for k in np.flatnonzero(track.valid)] == AFTER


def test_a_file_for_a_free_ego_begins_when_all_that_it_places_are_there() -> None:
    ego, bv = straight("ego", Role.EGO, 0.5, 3.0), straight("bv", Role.ADVERSARY, 0.3, 3.0, math.pi / 2)
    text = openscenario(piece_of(WALKER, ego, bv), Variant.FREE_EGO)
    check_openscenario(text)
    root = ElementTree.fromstring(text)
    starting = {p.get("entityRef") for p in root.iterfind("Storyboard/Init/Actions/Private")}
    assert starting == {"pedestrian0", "ego", "bv"}
    properties = {each.get("name"): each.get("value") for each in root.iterfind("FileHeader/Properties/Property")}
    assert (properties["sumo_adv_begin"], properties["sumo_adv_takeover"]) == ("0.500", "1.000")


def test_a_fault_of_ours_is_caught_by_the_schema() -> None:
    text = openscenario(ALL).replace("<CatalogLocations />", "")
    with pytest.raises(SumoAdvError, match=r"^The OpenSCENARIO made from this run is not valid \(line "):
        check_openscenario(text)


def test_a_free_ego_needs_an_adversary() -> None:
    with pytest.raises(UsageError, match="A free ego needs an adversary"):
        openscenario(piece_of(EGO, LATE, takeover=None), Variant.FREE_EGO)


@given(st.lists(st.text(min_size=1), unique=True, max_size=6))
def test_entity_names_are_their_own_and_can_be_written(ids: list[str]) -> None:
    names = entity_names([straight(id, Role.BACKGROUND, 0.0, 0.1) for id in ids])
    assert len(set(names.values())) == len(ids)
    for name in names.values():
        assert "$" not in name and name.strip() == name != ""
        assert ElementTree.fromstring(f"<a>{name.replace('&', '&amp;').replace('<', '&lt;')}</a>").text == name


@given(st.floats(-math.pi, math.pi), st.floats(0.3, 30.0))
def test_a_box_is_found_again_from_its_reference_point(heading: float, length: float) -> None:
    track = straight("a", Role.BACKGROUND, 0.0, 0.5, heading, length=length)
    x, y, turned = reference_points(track)
    assert x + 0.3 * length * np.cos(turned) == pytest.approx(track.x)
    assert y + 0.3 * length * np.sin(turned) == pytest.approx(track.y)


def test_fcd_names_the_front_bumper_and_degrees_from_north() -> None:
    assert front(EGO, 0) == pytest.approx((102.5, 0.0))
    assert front(BV, 0) == pytest.approx((100.0, 2.5))
    root = ElementTree.fromstring(fcd(piece_of(EGO, straight("bv", Role.ADVERSARY, 0.0, 3.0, math.pi / 2))))
    ego, bv = root[0]
    assert number(root[0], "time") == 0.0 and len(root) == 31
    assert (number(ego, "x"), number(ego, "angle"), ego.get("lane")) == (102.5, 90.0, "")
    assert (number(bv, "y"), number(bv, "angle"), number(bv, "speed")) == (2.5, 0.0, 10.0)


def test_the_table_is_tidy() -> None:
    rows = list(csv.DictReader(io.StringIO(table(piece_of(EGO, BV, LATE)))))
    assert len(rows) == 31 + 31 + 11
    assert {row["vehicle"] for row in rows} == {"ego", HOSTILE, "late"}
    at_two = {row["vehicle"]: row for row in rows if row["time_s"] == "2.00"}
    assert float(at_two[HOSTILE]["distance_to_ego_m"]) == pytest.approx(20.0 * math.sqrt(2.0), abs=1e-3)
    assert float(at_two["late"]["distance_to_ego_m"]) == pytest.approx(10.0)
    driven = [float(row["time_s"]) for row in rows if row["driven_by_attack"] == "1"]
    assert min(driven) == pytest.approx(1.1) and max(driven) == 3.0 and len(driven) == 20


# -- the command


def run(*arguments: str | Path) -> tuple[int, str, SumoAdvError | None]:
    """Exit status, output and our error of the command in this process."""
    done = CliRunner().invoke(app, ["export", *map(str, arguments)])
    error = done.exception if isinstance(done.exception, SumoAdvError) else None
    return done.exit_code, done.output, error


@pytest.mark.parametrize("ending", ["csv", "csv.gz"])
def test_a_file_is_written_once(tmp_path: Path, ending: str) -> None:
    target = tmp_path / "deep" / f"table.{ending}"
    folder = run_folder("straight")
    status, output, _ = run(folder, "--format", "csv", "--out", target)
    assert status == 0 and output.endswith(f"{target}\n")
    data = target.read_bytes()
    text = (gzip.decompress(data) if ending.endswith("gz") else data).decode()
    assert text == table(read_piece(folder))
    error = run(folder, "--format", "csv", "--out", target)[2]
    assert isinstance(error, UsageError) and "already exists" in str(error)
    assert run(folder, "--format", "csv", "--out", target, "--force")[0] == 0
    assert target.read_bytes() == data
    assert [p.name for p in target.parent.iterdir()] == [target.name]


def test_how_much_is_exported() -> None:
    folder = run_folder("straight")
    usual, longer, whole = (
        read_piece(folder), read_piece(folder, before=2.0), read_piece(folder, whole=True),
    )  # fmt: skip
    assert usual.takeover is not None
    assert usual.begin == pytest.approx(usual.takeover - 1.1)  # the run's history
    assert longer.begin == pytest.approx(usual.takeover - 2.0)
    assert whole.begin == pytest.approx(0.1)
    assert usual.end == longer.end == whole.end


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--format", "csv", "--variant", "free-ego"), "Only --format openscenario has a --variant."),
        (("--format", "csv", "--whole", "--before", "2"), "Give either --whole or --before, not both."),
        (("--format", "openscenario", "--variant", "free-ego", "--unattacked"), "A free ego needs an adversary"),
    ],
)
def test_wrong_use_is_one_sentence(tmp_path: Path, arguments: tuple[str, ...], says: str) -> None:
    error = run(run_folder("straight"), "--out", tmp_path / "out", *arguments)[2]
    assert isinstance(error, UsageError) and str(error).startswith(says)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("damage", ["nothing", "outcome", "network", "states", "not ours"])
def test_folders_that_are_no_run_are_refused(tmp_path: Path, damage: str) -> None:
    folder = tmp_path / "run"
    if damage == "nothing":
        folder.mkdir()
    else:
        shutil.copytree(run_folder("straight"), folder)
    if damage == "outcome":
        (folder / "outcome.json").write_text("{}")
    elif damage == "network":
        shutil.rmtree(folder / "inputs")
    elif damage == "states":
        (folder / "states.csv.gz").write_bytes(b"\x1f\x8bnonsense")
    elif damage == "not ours":
        (folder / "states.csv.gz").write_bytes(gzip.compress(b"a,b\n1,2\n"))
    error = run(folder, "--format", "csv", "--out", tmp_path / "out.csv")[2]
    assert isinstance(error, UsageError) and str(error).endswith(".")
    assert not (tmp_path / "out.csv").exists()


def test_without_the_schema_nothing_is_written_and_said_why(tmp_path: Path) -> None:
    program = "import sys; sys.modules['qc_openscenario'] = None; from sumo_adv.cli.main import main; main()"
    target = tmp_path / "out"
    done = subprocess.run(
        [sys.executable, "-c", program, "export", str(run_folder("straight")), "--format", "openscenario", "--out",
         str(target)],
        capture_output=True, text=True, check=False, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.startswith("sumo-adv: The format openscenario needs") and "sumo-adv[export]" in done.stderr
    assert len(done.stderr.splitlines()) == 1 and list(tmp_path.iterdir()) == []
