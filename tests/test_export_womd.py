"""An attacked Waymo record as a record: its own map and signals, the same motion, and the same verdict."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import sumo_adv
from sumo_adv.cli.main import app
from sumo_adv.datatypes import Role, Track
from sumo_adv.report.export.piece import ExportedRun, read_piece
from sumo_adv.report.export.womd import first_step, write_womd
from sumo_adv.report.judging import judge_files
from sumo_adv.report.manifest import read_manifest
from sumo_adv.report.tables import STATES_HEADER, write_gzip
from sumo_adv.simulation.tracks import read_tracks
from sumo_adv.womd.convert import convert_record
from sumo_adv.womd.reader import read_records

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'sumo-adv[womd]'")
samples = pytest.importorskip("womd_samples")
GO, STOP = 6, 4


def hill() -> Any:
    """The straight road 40 m up, with a crosswalk, and a light at the end of its right lane: red from 5 s on."""
    message = samples.straight("hill")
    for feature in message.map_features:
        line = getattr(feature, feature.WhichOneof("feature_data")).polyline
        for point in line:
            point.z = 40.0
    for track in message.tracks:
        for state in track.states:
            state.center_z += 40.0
    walk = message.map_features.add(id=401).crosswalk
    for x, y in ((290.0, -1.75), (294.0, -1.75), (294.0, 5.25), (290.0, 5.25)):
        walk.polygon.add(x=x, y=y, z=40.0)
    for step, states in enumerate(message.dynamic_map_states):
        states.lane_states.add(lane=12, state=GO if step < 50 else STOP)
    return message


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run on the record ``hill``, which lies beside it."""
    home = tmp_path_factory.mktemp("hill")
    file = samples.write(home / "records.tfrecord", samples.four_way("other"), hill())
    result = sumo_adv.run(
        file, record="hill", ego="idm", out=home / "run", attempts=20, learn="off",
        memory=home / "bank.sqlite",
    )  # fmt: skip
    assert result.outcome.verdict is not None and result.outcome.verdict.collided
    return result.folder


def written(piece: ExportedRun, target: Path) -> Any:
    """The record that is exported, and the message in it."""
    from sumo_adv.womd.framing import read_frames
    from sumo_adv.womd.scenario_pb2 import Scenario

    assert write_womd(target, piece) is None
    with target.open("rb") as file:
        (frame,) = read_frames(file, str(target))
    assert frame.data is not None
    return Scenario.FromString(frame.data)


def test_the_manifest_names_the_record(run: Path) -> None:
    waymo = read_manifest(run).run_input.waymo
    assert waymo is not None
    assert (waymo.file, waymo.id) == (run.parent / "records.tfrecord", "hill")


def test_the_attacked_record_keeps_its_map_its_signals_and_its_numbers(run: Path, tmp_path: Path) -> None:
    piece, original = read_piece(run), hill()
    message = written(piece, tmp_path / "out.tfrecord")
    assert [f.SerializeToString() for f in message.map_features] == [
        f.SerializeToString() for f in original.map_features
    ]
    late = round(10 * first_step(piece))  # steps of the original before the export begins
    shown = [[s.state for s in step.lane_states] for step in message.dynamic_map_states]
    assert len(shown) == 91
    assert shown == [[GO if late + k < 50 else STOP] if late + k < 91 else [] for k in range(91)]
    kinds = {track.id: track.object_type for track in original.tracks}
    for track in message.tracks:
        assert track.object_type == kinds.get(track.id, samples.VEHICLE)
        assert all(40.0 < state.center_z < 42.0 for state in track.states if state.valid)
    assert {1, 2, 3} < {track.id for track in message.tracks}
    assert message.tracks[message.sdc_track_index].id == 1


def table(tracks: list[Track], log: Any, start: float) -> str:
    """A run's table of states with the motion of a converted record that begins at ``start`` s."""
    rows = []
    for k, time in enumerate(log.time.tolist()):
        for track in tracks:
            again = log.tracks.get(track.id)
            if again is None or not again.valid[k]:
                continue
            acceleration = float(np.gradient(again.speed, log.time)[k])
            rows.append(
                f"{start + time:.2f},{track.id},{track.role},{again.x[k]:.4f},{again.y[k]:.4f},{again.heading[k]:.6f},"
                f"{again.speed[k]:.4f},{acceleration:.4f},{again.length:.2f},{again.width:.2f},\n"
            )
    return STATES_HEADER + "".join(rows)


def test_read_back_it_has_the_same_motion_and_the_same_verdict(run: Path, tmp_path: Path) -> None:
    """The converted record's states and network take the place of the run's; the verdict has its level again."""
    piece = read_piece(run)
    written(piece, tmp_path / "out.tfrecord")
    (record,) = read_records(tmp_path / "out.tfrecord")
    (tmp_path / "scene").mkdir()
    convert_record(record, tmp_path / "scene", traffic=False)
    log, start = read_tracks(tmp_path / "scene" / "tracks.csv.gz"), first_step(piece)
    moving = [track for track in piece.tracks if track.id in log.tracks]
    assert {track.role for track in moving} >= {Role.EGO, Role.ADVERSARY}
    for track in moving:
        again = log.tracks[track.id]
        inside = [k for k, time in enumerate(track.time) if -0.05 < time - start < 9.05]
        assert again.valid.sum() == len(inside)
        assert np.hypot(again.x[again.valid] - track.x[inside], again.y[again.valid] - track.y[inside]).max() < 0.001
    copy = tmp_path / "again"
    shutil.copytree(run, copy)
    write_gzip(copy / "states.csv.gz", table(moving, log, start))
    (network,) = (copy / "inputs").glob("*.net.xml")
    shutil.copyfile(tmp_path / "scene" / "network.net.xml", network)
    judged, first = judge_files(copy).now, judge_files(run).now
    for key in ("level", "preventable_by", "severity"):
        assert judged[key] == first[key]
    assert judged["level"] == piece.level and judged["delta_v"] == pytest.approx(first["delta_v"], abs=0.1)


def test_without_the_record_the_export_says_that_the_map_is_the_networks(run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "run")
    text = (tmp_path / "run" / "manifest.json").read_text(encoding="utf-8")
    (tmp_path / "run" / "manifest.json").write_text(text.replace("records.tfrecord", "gone.tfrecord"))
    done = CliRunner().invoke(app, ["export", str(tmp_path / "run"), "--format", "womd"])
    assert done.exit_code == 0
    assert "gone.tfrecord cannot be read: No such file" in done.stderr
    assert "the map is that of the converted network" in done.stderr
    (record,) = read_records(tmp_path / "run.tfrecord")
    assert 12 not in record.lanes and not record.areas


def test_a_record_that_was_changed_is_not_taken(run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "run")
    text = (tmp_path / "run" / "manifest.json").read_text(encoding="utf-8")
    samples.write(tmp_path / "records.tfrecord", samples.straight("hill"))
    old, new = str(run.parent / "records.tfrecord"), str(tmp_path / "records.tfrecord")
    (tmp_path / "run" / "manifest.json").write_text(text.replace(old, new))
    lost = write_womd(tmp_path / "out.tfrecord", read_piece(tmp_path / "run"))
    assert lost is not None and "no longer has the record hill as it was." in lost


def test_a_run_on_a_network_tells_what_its_lights_showed(tmp_path: Path) -> None:
    """Each lane with a state begins at its stop point, and our converter finds the signals of a junction in it."""
    result = sumo_adv.run(
        "signals_left_turn", out=tmp_path / "run", attempts=1, proposals=24, learn="off",
        memory=tmp_path / "bank.sqlite",
    )  # fmt: skip
    piece = read_piece(result.folder)
    assert piece.lights.lights
    write_womd(tmp_path / "out.tfrecord", piece)
    (record,) = read_records(tmp_path / "out.tfrecord")
    start = first_step(piece)
    steps = [k for k, states in enumerate(record.signals) if start + 0.1 * k <= piece.end + 0.001]
    assert steps and all(record.signals[k] for k in steps)
    letters = {GO: "gG", STOP: "ru", 5: "yY"}
    for k in steps:
        ((_, state),) = piece.lights.states(start + 0.1 * k).items()
        assert len(record.signals[k]) == len(state)
        for signal, letter in zip(record.signals[k], state, strict=True):
            assert letter in letters[signal.state]
            assert signal.stop is not None
            assert np.hypot(*(record.lanes[signal.lane].points[0] - signal.stop)[:2]) < 0.1
    (tmp_path / "scene").mkdir()
    report = convert_record(record, tmp_path / "scene", traffic=False)
    assert report["signals"] == {"lanes": len(state), "known": len(state), "mapped": len(state)}
