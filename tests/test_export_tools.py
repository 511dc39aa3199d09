"""Exports read back with the code of the tools that they are for: the same contact at the same time and place."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from run_samples import GEOMETRIES, run_folder
from shapely import Point, Polygon
from typer.testing import CliRunner

from sumo_adv.cli.main import app
from sumo_adv.errors import UsageError
from sumo_adv.report.export import Format, Variant
from sumo_adv.report.export.formats import FORMATS, ExportFormat, write_export
from sumo_adv.report.export.piece import ExportedRun, map_lanes, read_piece
from sumo_adv.report.export.womd import first_step
from sumo_adv.womd.convert import convert_record
from sumo_adv.womd.reader import read_records

Box = tuple[float, float, float, float, float]  # x, y, heading, length, width
Motion = dict[float, Box]  # by simulation time, s


@pytest.fixture(scope="module", params=GEOMETRIES)
def piece(request: pytest.FixtureRequest) -> ExportedRun:
    return read_piece(run_folder(request.param))


def exported(piece: ExportedRun, format: Format, folder: Path) -> Path:
    target = folder / f"run{FORMATS[format].ending}"
    write_export(target, piece, format, Variant.REPLAY, force=False)
    return target


def outline(box: Box) -> Polygon:
    x, y, heading, length, width = box
    c, s = math.cos(heading), math.sin(heading)
    corners = [(a * length / 2, b * width / 2) for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    return Polygon([(x + c * p - s * q, y + s * p + c * q) for p, q in corners])


def first_overlap(ego: Motion, other: Motion) -> tuple[float, float, float] | None:
    """Time [s] and place [m] at the first step at which two boxes overlap."""
    for time in sorted(ego.keys() & other.keys()):
        common = outline(ego[time]).intersection(outline(other[time]))
        if common.area > 0.0:
            return time, common.centroid.x, common.centroid.y
    return None


def motion_of(piece: ExportedRun, name: str) -> Motion:
    t = piece.track(name)
    rows = zip(t.time.tolist(), t.x.tolist(), t.y.tolist(), t.heading.tolist(), strict=True)
    return {round(time, 3): (x, y, heading, t.length, t.width) for time, x, y, heading in rows}


def check_contact(piece: ExportedRun, ego: Motion, adversary: Motion) -> None:
    """Every step is where it was, and the contact is when and where it was."""
    assert piece.adversary is not None and piece.contact() is not None
    for name, read in ((piece.ego, ego), (piece.adversary, adversary)):
        for time, box in read.items():
            wanted = motion_of(piece, name)[time]
            assert math.dist(box[:2], wanted[:2]) < 0.001
            assert abs(math.remainder(box[2] - wanted[2], math.tau)) < 1e-4
    wanted_contact = first_overlap(motion_of(piece, piece.ego), motion_of(piece, piece.adversary))
    contact = first_overlap(ego, adversary)
    assert contact is not None and wanted_contact is not None
    assert abs(contact[0] - piece.contact()) <= 0.1  # the step within which they touch
    assert contact[0] == pytest.approx(wanted_contact[0]) and math.dist(contact[1:], wanted_contact[1:]) < 0.2


def test_a_waymo_record_reads_back(piece: ExportedRun, tmp_path: Path) -> None:
    assert piece.takeover is not None and piece.contact() is not None
    (record,) = read_records(exported(piece, Format.WOMD, tmp_path))
    assert len(record.time) == 91 and record.current == 10
    start = first_step(piece)
    assert start == pytest.approx(piece.takeover - 1.0) or record.time[-1] + start > piece.contact()

    def motion(track: Any) -> Motion:
        return {
            round(start + 0.1 * k, 3): (
                float(track.x[k]), float(track.y[k]), float(track.heading[k]), float(track.length[k]),
                float(track.width[k]),
            ) for k in range(91) if track.valid[k]
        }  # fmt: skip

    attackers = [t for t in record.tracks if t.id in record.objects_of_interest]
    assert [record.tracks[i].id for i in record.to_predict] == [t.id for t in attackers]
    check_contact(piece, motion(record.tracks[record.sdc]), motion(attackers[0]))


def test_our_converter_takes_the_waymo_record(piece: ExportedRun, tmp_path: Path) -> None:
    (record,) = read_records(exported(piece, Format.WOMD, tmp_path))
    (tmp_path / "scene").mkdir()
    convert_record(record, tmp_path / "scene", traffic=False)
    scenario = (tmp_path / "scene" / "scenario.toml").read_text(encoding="utf-8")
    assert f'id = "{record.tracks[record.sdc].id}"' in scenario and "warm_up = 1.0" in scenario


def test_commonroads_reader_finds_the_contact(piece: ExportedRun, tmp_path: Path) -> None:
    reader = pytest.importorskip("commonroad.common.file_reader", reason="needs commonroad-io")
    solutions = pytest.importorskip("commonroad.common.solution")
    folder = exported(piece, Format.COMMONROAD, tmp_path)
    scenario, problems = reader.CommonRoadFileReader(str(folder / "scenario.xml")).open()
    solution = solutions.CommonRoadSolutionReader.open(str(folder / "solution.xml"))
    ego = piece.track(piece.ego)
    states = solution.planning_problem_solutions[0].trajectory.state_list

    def at(state: Any, length: float, width: float) -> tuple[float, Box]:
        time = round(piece.begin + state.time_step * scenario.dt, 3)
        return time, (float(state.position[0]), float(state.position[1]), float(state.orientation), length, width)

    def motion(obstacle: Any) -> Motion:
        size = obstacle.obstacle_shape.length, obstacle.obstacle_shape.width
        follow = obstacle.prediction.trajectory.state_list
        return dict(at(state, *size) for state in (obstacle.initial_state, *follow))

    driven = dict(at(state, ego.length, ego.width) for state in states)
    names = [t.id for t in piece.tracks]
    lanes = len(scenario.lanelet_network.lanelets)
    assert piece.adversary is not None
    number = lanes + 1 + names.index(piece.adversary)
    check_contact(piece, driven, motion(scenario.obstacle_by_id(number)))
    assert len(scenario.obstacles) == len(piece.tracks) - 1  # the ego is the planning problem
    (problem,) = problems.planning_problem_dict.values()
    assert math.dist(problem.initial_state.position, (ego.x[0], ego.y[0])) < 0.001
    start = Point(problem.initial_state.position)
    assert any(lanelet.polygon.shapely_object.contains(start) for lanelet in scenario.lanelet_network.lanelets)


def test_mcaps_reader_finds_every_step_and_the_contact(piece: ExportedRun, tmp_path: Path) -> None:
    pytest.importorskip("foxglove", reason="needs foxglove-sdk")
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    messages: dict[str, list[Any]] = {}
    with exported(piece, Format.MCAP, tmp_path).open("rb") as file:
        for _, channel, message, content in make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            messages.setdefault(channel.topic, []).append((message.log_time, content))
    boxes: dict[str, Motion] = {t.id: {} for t in piece.tracks}
    for nanoseconds, scene in messages["/vehicles"]:
        time = round(nanoseconds / 1e9, 3)
        for entity in scene.entities:
            (cube,) = entity.cubes
            turn = cube.pose.orientation
            x, y = cube.pose.position.x, cube.pose.position.y
            heading = 2.0 * math.atan2(turn.z, turn.w)
            boxes[entity.id][time] = (x, y, heading, cube.size.x, cube.size.y)
    assert {name: set(motion) for name, motion in boxes.items()} == {
        t.id: {round(time, 3) for time in t.time.tolist()} for t in piece.tracks
    }
    assert piece.adversary is not None and piece.contact() is not None
    check_contact(piece, boxes[piece.ego], boxes[piece.adversary])
    log = [(said.message, said.timestamp) for _, said in messages["/log"]]
    (said,) = [stamp for text, stamp in log if text.startswith("contact")]
    assert said.seconds + said.nanos / 1e9 == pytest.approx(piece.contact(), abs=1e-5)
    assert log[-1][0] == f"level: {piece.level}" and piece.level
    ((_, road),) = messages["/road"]
    assert [entity.id for entity in road.entities] == [each.lane.id for each in map_lanes(piece)]


def test_osis_reader_finds_the_contact(piece: ExportedRun, tmp_path: Path) -> None:
    utilities = pytest.importorskip("osi_utilities", reason="needs asam-osi-utilities")
    reader = utilities.SingleTraceReader()
    assert reader.open(exported(piece, Format.OSI, tmp_path))
    boxes: dict[str, Motion] = {}
    lanes = 0
    for result in reader:
        truth = result.message
        assert truth.version.version_major == 3
        time = round(truth.timestamp.seconds + truth.timestamp.nanos / 1e9, 3)
        lanes += len(truth.lane)
        for each in truth.moving_object:
            base, (name, role) = each.base, each.source_reference[0].identifier
            assert (each.id.value == truth.host_vehicle_id.value) == (role == "ego")
            size = base.dimension.length, base.dimension.width
            boxes.setdefault(name, {})[time] = (base.position.x, base.position.y, base.orientation.yaw, *size)
    assert piece.adversary is not None and lanes == len(map_lanes(piece))
    assert {name: len(motion) for name, motion in boxes.items()} == {t.id: len(t.time) for t in piece.tracks}
    check_contact(piece, boxes[piece.ego], boxes[piece.adversary])


def test_metadrives_own_check_takes_the_scenario(piece: ExportedRun, tmp_path: Path) -> None:
    metadrive = pytest.importorskip("metadrive.scenario", reason="metadrive-simulator is not installed")
    from metadrive.scenario.utils import read_dataset_summary, read_scenario_data

    folder = exported(piece, Format.SCENARIONET, tmp_path)
    _, (file,), _ = read_dataset_summary(folder)
    scenario = read_scenario_data(folder / file)
    metadrive.ScenarioDescription.sanity_check(scenario, valid_check=True)

    def motion(name: str) -> Motion:
        state, times = scenario["tracks"][name]["state"], scenario["metadata"]["ts"]
        return {
            round(piece.begin + times[k], 3): (
                *state["position"][k, :2], state["heading"][k], state["length"][k], state["width"][k],
            ) for k in range(scenario["length"]) if state["valid"][k]
        }  # fmt: skip

    assert scenario["metadata"]["sdc_id"] == piece.ego
    (attacker,) = scenario["metadata"]["tracks_to_predict"]
    check_contact(piece, motion(piece.ego), motion(attacker))


def test_metadrive_replays_into_the_hit(piece: ExportedRun, tmp_path: Path) -> None:
    pytest.importorskip("metadrive.scenario", reason="metadrive-simulator is not installed")
    from metadrive.engine.asset_loader import AssetLoader
    from metadrive.envs.scenario_env import ScenarioEnv
    from metadrive.policy.replay_policy import ReplayEgoCarPolicy

    try:
        incomplete = AssetLoader.should_update_asset()
    except ValueError:
        incomplete = True
    if incomplete:
        pytest.skip("MetaDrive's assets are not there: it would download them")
    folder = exported(piece, Format.SCENARIONET, tmp_path)
    env = ScenarioEnv({
        "data_directory": str(folder), "num_scenarios": 1, "agent_policy": ReplayEgoCarPolicy, "log_level": 50,
        "relax_out_of_road_done": True,
    })  # fmt: skip
    try:
        env.reset()
        ego = piece.track(piece.ego)
        hit = next(k for k in range(1, len(ego.time)) if env.step([0, 0])[4].get("crash_vehicle"))
        place = env.agent.position
    finally:
        env.close()
    assert piece.begin + hit * piece.step == pytest.approx(piece.contact(), abs=0.1)
    moved = place[0] + ego.x[0] - ego.x[hit], place[1] + ego.y[0] - ego.y[hit]  # MetaDrive's origin is the ego's start
    assert math.hypot(*moved) < 0.2


# -- the command


def export(*arguments: str | Path) -> Any:
    return CliRunner().invoke(app, ["export", *map(str, arguments)])


def test_all_writes_what_is_installed(tmp_path: Path) -> None:
    done = export(run_folder("straight"), "--format", "all", "--out", tmp_path, "--json")
    assert done.exit_code == 0
    made = [json.loads(line) for line in done.stdout.splitlines()]
    assert [each["format"] for each in made] == [str(f) for f, entry in FORMATS.items() if not entry.missing]
    assert sorted(Path(each["out"]) for each in made) == sorted(tmp_path.iterdir())


@pytest.mark.parametrize("holder", [".", "failures", "runs"])
def test_every_run_of_a_folder_is_written(tmp_path: Path, holder: str) -> None:
    whole = tmp_path / "found"
    for name in ("first", "second"):
        shutil.copytree(run_folder("straight"), whole / holder / name)
    (whole / "inputs").mkdir()
    shutil.copytree(run_folder("straight"), whole / holder / "none")
    (whole / holder / "none" / "states.csv.gz").unlink()  # a run that met no encounter
    done = export(whole, "--format", "csv")
    assert done.exit_code == 0 and "none has no states" in done.stderr
    assert sorted(p.name for p in (tmp_path / "found-exports").iterdir()) == ["first.csv", "second.csv"]


def test_a_folder_without_runs_is_one_sentence(tmp_path: Path) -> None:
    error = export(tmp_path, "--format", "csv").exception
    assert isinstance(error, UsageError) and "no runs" in str(error)


def test_a_missing_package_is_named_with_its_extra() -> None:
    write: Callable[..., None] = FORMATS[Format.CSV].write
    entry = ExportFormat(".x", write, "extra_of_it", ("sumo_adv_has_no_such_module",))
    assert entry.missing == "sumo_adv_has_no_such_module"
    with pytest.raises(UsageError, match=r"pip install 'sumo-adv\[extra_of_it\]'"):
        entry.need(Format.CSV)
