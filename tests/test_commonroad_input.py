"""CommonRoad scenarios as inputs: our own export comes back, and a scenario written by hand runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from batch_samples import QUICK, table
from cli_samples import Program
from run_samples import GEOMETRIES, run_folder

import sumo_adv
from sumo_adv.campaigns.cluster import wrong_content
from sumo_adv.campaigns.plan import files_hash
from sumo_adv.errors import UsageError
from sumo_adv.report.export.commonroad import COMMONROAD_SCENARIO_FILE, write_commonroad
from sumo_adv.report.export.piece import map_lanes, read_piece
from sumo_adv.simulation.inputs import is_commonroad, load_input
from sumo_adv.womd.commonroad import read_commonroad
from sumo_adv.womd.record import evenly_sampled

HEAD = '<commonRoad commonRoadVersion="2020a" benchmarkID="ZAM_Hand-1_1_T-1" timeStepSize="0.1">'


def exact(tag: str, value: float) -> str:
    return f"<{tag}><exact>{value}</exact></{tag}>"


def point(x: float, y: float) -> str:
    return f"<point><x>{x}</x><y>{y}</y></point>"


def state(tag: str, step: int, x: float, y: float, speed: float) -> str:
    where = f"<position>{point(x, y)}</position>"
    return f"<{tag}>{where}{exact('orientation', 0.0)}{exact('time', step)}{exact('velocity', speed)}</{tag}>"


def lanelet(number: int, right: float, links: str) -> str:
    """300 m to the east, 3.5 m wide."""
    bounds = "".join(
        f"<{name}>{point(0.0, y)}{point(300.0, y)}</{name}>"
        for name, y in (("leftBound", right + 3.5), ("rightBound", right))
    )
    return f'<lanelet id="{number}">{bounds}{links}<laneletType>urban</laneletType></lanelet>'


def write(folder: Path, *parts: str) -> Path:
    file = folder / "hand.xml"
    file.write_text(f"<?xml version='1.0'?>\n{HEAD}{''.join(parts)}</commonRoad>", encoding="utf-8")
    return file


LANES = (
    lanelet(1, 0.0, '<adjacentLeft ref="2" drivingDir="same"/><trafficSignRef ref="9"/>'),
    lanelet(2, 3.5, '<adjacentRight ref="1" drivingDir="same"/>'),
    '<trafficSign id="9"><trafficSignElement><trafficSignID>274</trafficSignID><additionalValue>15.0</additionalValue>'
    "</trafficSignElement></trafficSign>",
)
CAR = (
    '<dynamicObstacle id="5"><type>car</type><shape><rectangle><length>4.0</length><width>1.8</width></rectangle>'
    f"</shape>{state('initialState', 0, 40.0, 5.25, 10.0)}<trajectory>"
    + "".join(state("state", k, 40.0 + k, 5.25, 10.0) for k in range(1, 61))
    + "</trajectory></dynamicObstacle>"
)
PROBLEM = f'<planningProblem id="7">{state("initialState", 0, 20.0, 1.75, 12.0)}</planningProblem>'


def test_a_scenario_by_hand_is_read(tmp_path: Path) -> None:
    file = write(tmp_path, *LANES, CAR, PROBLEM)
    assert is_commonroad(file)
    record = read_commonroad(file)
    assert record.scenario_id == "ZAM_Hand-1_1_T-1" and len(record.time) == 61 and record.current == 0
    ego, car = record.tracks
    assert (ego.id, ego.x[0], ego.y[0], ego.vx[0]) == (7, 20.0, 1.75, 12.0)
    assert ego.valid.sum() == 2 and ego.x[1] == pytest.approx(21.2)  # its own place, and a step onward
    assert car.id == 5 and car.valid.all() and car.x[60] == 100.0 and car.length[0] == 4.0
    right, left = record.lanes[1], record.lanes[2]
    assert np.allclose(right.points[:, 1], 1.75) and np.allclose(left.points[:, 1], 5.25)
    assert (right.speed_limit, left.speed_limit) == (15.0, 0.0)
    assert [n.lane for n in right.left] == [2] and [n.lane for n in left.right] == [1]
    (edge,) = record.lines.values()
    assert edge.edge and np.allclose([edge.points[:, 1].min(), edge.points[:, 1].max()], [0.0, 7.0], atol=0.01)


@pytest.mark.parametrize(("step", "first"), [(0.04, 0), (0.04, 1), (0.05, 3), (0.1, 2), (0.2, 1)])
def test_the_ego_is_there_at_two_steps_of_the_grid_whatever_the_step_of_the_file(
    step: float, first: int, tmp_path: Path
) -> None:
    """At 12 m/s from x = 20 m at the step of the planning problem, before and after it."""
    problem = PROBLEM.replace(exact("time", 0), exact("time", first))
    places = (state("state", k, 40.0 + 10.0 * step * k, 5.25, 10.0) for k in range(1, 61))
    car = f"{CAR.partition('<trajectory>')[0]}<trajectory>{''.join(places)}</trajectory></dynamicObstacle>"
    file = write(tmp_path, *LANES, car, problem)
    file.write_text(file.read_text().replace('timeStepSize="0.1"', f'timeStepSize="{step}"'))
    record, _ = evenly_sampled(read_commonroad(file))
    ego = record.tracks[0]
    there = np.flatnonzero(ego.valid)
    assert len(there) >= 2 and record.current in there and record.current + 1 in there
    assert np.allclose(ego.x[there], 20.0 + 12.0 * (0.1 * there - step * first))


def test_a_scenario_by_hand_runs(tmp_path: Path) -> None:
    result = sumo_adv.run(
        write(tmp_path, *LANES, CAR, PROBLEM), ego="idm", out=tmp_path / "run", attempts=2, learn="off",
        memory=tmp_path / "bank.sqlite",
    )  # fmt: skip
    assert result.outcome.ending in ("critical", "exhausted", "no_encounter")
    assert '"7"' in (result.folder / "outcome.json").read_text(encoding="utf-8")  # the planning problem is the ego


@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_our_export_comes_back(geometry: str, tmp_path: Path) -> None:
    piece = read_piece(run_folder(geometry))
    write_commonroad(tmp_path, piece)
    record = read_commonroad(tmp_path / COMMONROAD_SCENARIO_FILE)
    others = [t for t in piece.tracks if t.id != piece.ego]
    ego, *read = record.tracks
    assert ego.x[0] == pytest.approx(piece.track(piece.ego).x[0], abs=1e-3)
    assert len(read) == len(others)
    for back, track in zip(read, others, strict=True):
        assert back.valid.sum() == len(track.time)
        assert np.abs(back.x[back.valid] - track.x).max() < 0.001
        assert np.abs(back.y[back.valid] - track.y).max() < 0.001
        assert back.length[0] == pytest.approx(track.length)
    lanes = map_lanes(piece)
    assert [record.lanes[each.number].speed_limit for each in lanes] == pytest.approx(
        [each.lane.speed for each in lanes]
    )


def test_an_ego_that_comes_later_begins_at_its_own_step(tmp_path: Path) -> None:
    """Its first 8 states are left out: the planning problem begins at time step 8, where the ego was 0.8 s later."""
    piece = read_piece(run_folder("straight"))
    ego = piece.track(piece.ego)
    late = ego.between(float(ego.time[8]), float(ego.time[-1]))
    write_commonroad(tmp_path, replace(piece, tracks=tuple(late if t is ego else t for t in piece.tracks)))
    record = read_commonroad(tmp_path / COMMONROAD_SCENARIO_FILE)
    own = record.tracks[record.sdc]
    assert (record.current, own.valid.nonzero()[0].tolist()) == (8, [8, 9])
    assert own.x[8] == pytest.approx(ego.x[8], abs=1e-3)
    said = f"ego, {ego.length:.4f} m long, {ego.width:.4f} m wide"
    assert said in (tmp_path / COMMONROAD_SCENARIO_FILE).read_text(encoding="utf-8")


# -- the other commands


def test_convert_takes_it(program: Program) -> None:
    write(program.folder, *LANES, CAR, PROBLEM)
    done = program.here("convert", "hand.xml", "--out", "made", "--no-traffic")
    assert done.status == 0, done.err
    run_input = load_input(program.folder / "made" / "ZAM_Hand-1_1_T-1" / "scenario.toml")
    assert run_input.ego == "7" and run_input.playback is not None and run_input.playback.vehicles == {"5", "7"}
    refused = program.here("convert", "hand.xml", "--out", "made", "--first", "1")
    assert (refused.status, "choose records of a TFRecord file" in refused.err) == (2, True)


def test_batch_runs_it(program: Program) -> None:
    """Batches, hunts and benchmarks find their inputs in the same way."""
    file = write(program.folder, *LANES, CAR, PROBLEM)
    batch = program.here("batch", "*.xml", "--egos", "idm", *QUICK, "--workers", "1", "--out", "out")
    assert batch.status == 0, batch.err
    (row,) = table(batch.folder)
    assert (row["network"], row["ego"], row["failure"]) == ("ZAM_Hand-1_1_T-1", "idm", "")
    assert wrong_content(file, files_hash([file]), None) == ""


def test_serve_refuses_it_and_says_why(program: Program) -> None:
    write(program.folder, *LANES, CAR, PROBLEM)
    refused = program.here("serve", "hand.xml")
    assert refused.status == 2 and "hand.xml plays a log back, which serve does not do" in refused.err


def test_what_takes_no_recording_says_how_to_convert_it(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"is a CommonRoad scenario: convert it to a scenario first"):
        load_input(write(tmp_path, *LANES, CAR, PROBLEM))


@pytest.mark.parametrize(
    ("parts", "says"),
    [
        ((CAR, PROBLEM), "has no lanelets"),
        ((*LANES, CAR), "has no planning problem"),
        ((*LANES, PROBLEM, '<dynamicObstacle id="5"/>'), "dynamicObstacle 5 has no initialState"),
        ((*LANES, PROBLEM.replace("12.0", "fast")), "could not convert"),
        ((*LANES, PROBLEM, "<open>"), "not a CommonRoad scenario"),
    ],
)
def test_what_cannot_be_read_is_one_sentence(parts: tuple[str, ...], says: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=says):
        read_commonroad(write(tmp_path, *parts))


def test_other_xml_is_no_commonroad(tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_text("<net/>")
    assert not is_commonroad(tmp_path / "a.xml") and not is_commonroad(tmp_path / "none.xml")
