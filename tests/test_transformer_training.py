"""``benchmarks/transformer.py``: scenes from SUMO and from records, training and evaluation of the motion predictor."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from cli_samples import ROOT
from transformer_samples import driving
from womd_samples import four_way, straight, write

from sumo_adv.errors import UsageError
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.network import RoadMap, read_network
from sumo_adv.transformer.model import SHIPPED_WEIGHTS, make_parameters, read_weights
from sumo_adv.transformer.scene import FUTURE_COUNT, POSITION_STEP_S, segments_of
from sumo_adv.womd.reader import parse_record

sys.path.append(str(ROOT / "benchmarks"))
from transformer import main
from transformer_records import scene_of_record
from transformer_scenes import HELD_OUT, TRAIN, Scenes, follow, load, make, record, scene_of, scenes_of, together
from transformer_training import BATCH_SCENES, evaluate, loss, train


@pytest.fixture(scope="module")
def road() -> RoadMap:
    return read_network(data_folder("networks") / "straight_3lane.net.xml")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scenes of two runs of half a minute and of one held-out run."""
    folder = tmp_path_factory.mktemp("scenes")
    assert make(folder, seed=3, runs=2, progress=lambda done, total: None, seconds=60.0) == 3
    return folder


# -- scenes


def test_the_same_seed_makes_the_same_scenes_and_the_folder_goes_on(made: Path, tmp_path: Path) -> None:
    first = f"{TRAIN}-0001.npz"
    make(tmp_path, seed=3, runs=2, progress=lambda done, total: None, seconds=60.0)
    assert (tmp_path / first).read_bytes() == (made / first).read_bytes()
    kept = (tmp_path / first).stat().st_mtime_ns
    make(tmp_path, seed=3, runs=2, progress=lambda done, total: None, seconds=60.0)
    assert (tmp_path / first).stat().st_mtime_ns == kept
    with pytest.raises(UsageError, match="holds other scenes"):
        make(tmp_path, seed=4, runs=2, progress=lambda done, total: None, seconds=60.0)


def test_scenes_are_what_happened(made: Path) -> None:
    """No vehicle drives faster than 40 m/s or jumps, and its future goes on from where it is."""
    scenes = load(made, TRAIN)
    steps = np.diff(scenes.future, axis=2, prepend=0.0)[scenes.known & (scenes.features.there[:, :, None] > 0.0)]
    assert len(scenes) > 20 and np.hypot(*steps.T).max() < 4.0
    assert scenes.known.sum() > 0.5 * FUTURE_COUNT * scenes.features.there.sum()
    assert scenes.followed is None and load(made, HELD_OUT).followed is not None


def test_a_folder_without_scenes_is_told(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="has no scenes"):
        load(tmp_path, TRAIN)


def test_a_record_gives_the_vehicles_near_its_ego() -> None:
    """Of ``straight``: the ego at 32 m with 12 m/s, its leader, the parked car; not the car that is seen later."""
    scene = scene_of_record(parse_record(straight(), "a record"))
    assert scene is not None
    f, future, recorded, followed = scene
    assert f.there.sum() == 3.0 and followed is None
    assert f.state[0, 0] == pytest.approx(1.2) and f.state[0, 3:].tolist() == [0.0] * 5  # its light is unknown
    assert recorded[0].all() and future[0, -1] == pytest.approx([96.0, 0.0], abs=0.01)
    inner = scene_of_record(parse_record(four_way(), "a record"))
    assert inner is not None and (inner[0].lanes[0, :, 4] > 0.0).any()  # lanes on the junction


# -- evaluation


def test_a_car_that_keeps_its_speed_is_no_problem_for_constant_velocity(road: RoadMap) -> None:
    agents = driving((300.0, 0.0, 10.0))
    future = (
        agents.past[:, -1][:, None] + np.stack([POSITION_STEP_S * 10.0 * np.arange(1, 81), np.zeros(80)], axis=1)[None]
    )
    slower = future - np.stack([0.05 * np.arange(1, 81), np.zeros(80)], axis=1)[None]  # by 0.5 m/s: 4 m in the end
    ways = follow(road, agents, 0, "eastbound_1")[None]
    scores = {}
    for name, real in (("even", future), ("slower", slower)):
        scenes: Scenes = together([scene_of(agents, real, segments_of(road), ways)])
        scores[name] = {s.predictor: s for s in evaluate(read_weights(SHIPPED_WEIGHTS), scenes)}
    for predictor in ("constant velocity", "lane following"):
        even, slow = scores["even"][predictor], scores["slower"][predictor]
        assert (even.min_ade, even.min_fde, even.miss_rate) == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
        # 0.05 m for each step: in the mean of 80 steps 0.05 x 40.5 m
        assert (slow.min_ade, slow.min_fde, slow.miss_rate) == pytest.approx((2.025, 4.0, 1.0), abs=1e-3)


def test_the_shipped_weights_beat_constant_velocity_and_lane_following(tmp_path: Path) -> None:
    """On a generated network that is held out."""
    run = record(1, 3, tmp_path, held_out=True, seconds=75.0)
    assert run.network.parent == tmp_path
    scenes = scenes_of(run, np.random.default_rng(0), held_out=True)
    assert scenes is not None
    scores = {s.predictor: s for s in evaluate(read_weights(SHIPPED_WEIGHTS), scenes)}
    ours = scores["transformer"]
    assert ours.vehicles > 50
    for predictor in ("constant velocity", "lane following"):
        assert ours.min_ade < 0.8 * scores[predictor].min_ade and ours.min_fde < 0.8 * scores[predictor].min_fde
        assert ours.miss_rate < scores[predictor].miss_rate


# -- commands


def test_the_figures_are_a_table(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["evaluate", str(made)])
    header, _, *rows = capsys.readouterr().out.splitlines()
    assert header.startswith("| predictor | minADE [m] | minFDE [m] | miss rate |")
    assert [row.split("|")[1].strip() for row in rows] == ["transformer", "lane following", "constant velocity"]


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        (("data", "carla"), "There is no source 'carla' of scenes; give sumo or womd:FOLDER."),
        (("data", "womd:nowhere"), "nowhere is no folder with .tfrecord files."),
        (("train", "nowhere"), "nowhere has no scenes (train-*.npz); make them with benchmarks/transformer.py data."),
        (("evaluate", "nowhere"), "nowhere has no scenes (held_out-*.npz)"),
    ],
)
def test_wrong_use_is_told_in_a_sentence(command: tuple[str, str], sentence: str, tmp_path: Path) -> None:
    more = [] if command[0] == "evaluate" else ["--out", str(tmp_path / "out")]
    with pytest.raises(SystemExit, match=re.escape(sentence)):
        main([*command, *more])


def test_records_become_files_of_scenes(tmp_path: Path) -> None:
    """Nine files: the eighth is held out."""
    (tmp_path / "records").mkdir()
    for k in range(9):
        write(tmp_path / "records" / f"{k}.tfrecord", straight(f"record{k}"))
    main(["data", f"womd:{tmp_path / 'records'}", "--out", str(tmp_path / "out")])
    assert len(load(tmp_path / "out", TRAIN)) == 8 and len(load(tmp_path / "out", HELD_OUT)) == 1


# -- training


def test_training_lowers_the_loss_and_goes_on_where_it_stopped(made: Path, tmp_path: Path) -> None:
    pytest.importorskip("jax", reason="the extra train (JAX) is not installed")
    pytest.importorskip("optax", reason="the extra train (optax) is not installed")
    scenes = load(made, TRAIN)
    two = np.arange(2 * BATCH_SCENES) % len(scenes)  # two steps an epoch, some scenes twice
    few = Scenes(type(scenes.features)(*(v[two] for v in scenes.features)), scenes.future[two], scenes.known[two])
    reported: list[tuple[int, int]] = []

    def stop(step: int, total: int, value: float) -> None:
        raise KeyboardInterrupt

    for folder in ("whole", "parts"):
        (tmp_path / folder).mkdir()
    with pytest.raises(KeyboardInterrupt):
        train(few, tmp_path / "parts", seed=1, epochs=2, progress=stop, keep_every=1)
    for folder in ("whole", "parts"):
        train(few, tmp_path / folder, seed=1, epochs=2, progress=lambda k, n, _: reported.append((k, n)))
    assert reported == [(4, 4), (4, 4)]
    weights = [(tmp_path / folder / "weights.npz").read_bytes() for folder in ("whole", "parts")]
    assert weights[0] == weights[1]
    some = type(few.features)(*(np.asarray(v, np.float32) for v in few.features))
    before, after = (loss(p, some, few.future, few.known) for p in (
        make_parameters(1), read_weights(tmp_path / "whole" / "weights.npz"),
    ))  # fmt: skip
    assert after < before
    with pytest.raises(UsageError, match="another training"):
        train(few, tmp_path / "whole", seed=2, epochs=2, progress=lambda *_: None)
