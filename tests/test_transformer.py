"""The motion predictor: local scenes, the shipped weights, scenes from SUMO and from records, training, evaluation."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner
from womd_samples import four_way, straight, write

from sumo_adv.cli.main import app
from sumo_adv.datatypes import Role, Track
from sumo_adv.errors import UsageError
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.network import RoadMap, read_network
from sumo_adv.transformer.dataset import (
    HELD_OUT,
    TRAIN,
    Scenes,
    follow,
    load,
    make,
    record,
    scene_of,
    scenes_of,
    together,
)
from sumo_adv.transformer.model import SHIPPED_WEIGHTS, Predictor, forward, make_parameters, read_weights
from sumo_adv.transformer.scene import (
    FUTURE_COUNT,
    HISTORY_COUNT,
    MAX_AGENTS,
    POSITION_STEP_S,
    Agents,
    Segments,
    agents_of,
    cut,
    features,
    light_of,
    segments_of,
    to_local,
    to_world,
)
from sumo_adv.transformer.train import evaluate
from sumo_adv.womd.reader import parse_record
from sumo_adv.womd.training_scenes import scene_of_record

LANE = 3.2  # m, of straight_3lane; its lanes lie at y = -3.2, 0 and 3.2


@pytest.fixture(scope="module")
def road() -> RoadMap:
    return read_network(data_folder("networks") / "straight_3lane.net.xml")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scenes of two runs of half a minute and of one held-out run."""
    folder = tmp_path_factory.mktemp("scenes")
    assert make(folder, seed=3, runs=2, progress=lambda done, total: None, seconds=60.0) == 3
    return folder


def driving(*cars: tuple[float, float, float]) -> Agents:
    """Cars of 5 x 2 m that have gone east evenly: x, y [m] and speed [m/s] now; their lights are unknown."""
    x, y, speed = np.array(cars).T
    past = np.stack(
        [
            x[:, None] + speed[:, None] * POSITION_STEP_S * np.arange(1 - HISTORY_COUNT, 1),
            y[:, None] + np.zeros(HISTORY_COUNT),
        ],
        2,
    )
    n = len(cars)
    return Agents(past, np.zeros(n), speed, np.full((n, 2), (5.0, 2.0)), np.array([light_of(None)] * n))


def turned(agents: Agents, segments: Segments, angle: float, by: tuple[float, float]) -> tuple[Agents, Segments]:
    """The same scene, rotated about the origin and then moved."""
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array([[c, s], [-s, c]])
    moved = replace(agents, past=agents.past @ turn + by, heading=agents.heading + angle)
    ends = (segments.ends.reshape(-1, 2, 2) @ turn + by).reshape(-1, 4)
    return moved, replace(segments, ends=ends)


# -- local scenes


def test_a_vehicle_sees_its_neighbour_and_the_lane_in_its_own_frame() -> None:
    """The second car is 20 m ahead and 3.2 m to the left of the first; both go north after a quarter turn."""
    lane = cut([(np.array([[0.0, 0.0], [24.0, 0.0]]), 12.0, (0, 0, 0, 0, 0, 1.0))])
    assert lane.ends.tolist() == [[0.0, 0.0, 12.0, 0.0], [12.0, 0.0, 24.0, 0.0]]
    agents, lane = turned(driving((0.0, 0.0, 10.0), (20.0, 3.2, 15.0)), lane, math.pi / 2, (100.0, 50.0))
    f = features(agents, lane)
    # In units of 10 m; a token is two steps of 1 m each, the neighbour's of 1.5 m each.
    assert f.own[0, -1] == pytest.approx([1.0, 0.0, 1.0, 0.0, 1.0], abs=1e-5)
    assert f.near[0, -1, 0] == pytest.approx([2.0, 0.32, 1.5, 0.0, 1.5, 0.0, 1.0, 1.0], abs=1e-5)
    # At the end of its first token, 0.8 s ago, the neighbour was 0.8 x 5 m nearer to being beside it: 16 m ahead.
    assert f.near[0, 0, 0, 0] == pytest.approx(1.6, abs=1e-5)
    assert f.pairs[0, 1] == pytest.approx([1.0, 0.16, 1.0, 0.0], abs=1e-5)  # in units of 20 m, and the same direction
    assert f.lanes[0, 0, :4] == pytest.approx([0.0, 0.0, 1.2, 0.0], abs=1e-5)
    assert f.lanes_there[0].sum() == 2 and f.there.tolist() == [1.0, 1.0] + [0.0] * (MAX_AGENTS - 2)


def test_a_light_ahead_is_told_as_red_yellow_or_green() -> None:
    assert light_of(None) == (0.0, 0.0, 0.0, 0.0, 0.0)
    assert light_of(()) == (1.0, 0.0, 0.0, 0.0, 0.0)
    assert light_of([("centre", 25.0, "r"), ("next", 90.0, "G")]) == (1.0, 1.0, 0.0, 0.0, 0.5)
    assert light_of([("next", 50.0, "G")]) == (1.0, 0.0, 0.0, 1.0, 1.0)


def test_positions_go_into_the_vehicles_frames_and_back() -> None:
    agents, _ = turned(driving((5.0, 2.0, 10.0)), Segments(np.zeros((0, 4)), np.zeros((0, 6))), 0.7, (-3.0, 8.0))
    here = agents.past[:, -1]
    ahead = here + 10.0 * np.array([math.cos(0.7), math.sin(0.7)])
    assert to_local(ahead[:, None], agents) == pytest.approx(np.array([[[10.0, 0.0]]]))
    assert to_world(np.array([[[10.0, 0.0]]]), agents) == pytest.approx(ahead[:, None])


def test_an_encounter_gives_the_ego_its_adversaries_and_the_nearest_others() -> None:
    from situation_samples import changed, neighbour, situation

    def seen(name: str, x: float, since: float) -> Track:
        time = np.arange(since, 100.05, POSITION_STEP_S)
        zero = 0.0 * time
        places = x + 10.0 * (time - 100.0)
        return Track(name, Role.BACKGROUND, time, places, zero + 3.2, zero, zero + 10.0, zero, 5.0, 2.0)

    history = (seen("far", 90.0, 98.9), seen("near", 50.0, 99.5))
    given = changed(situation([neighbour()]), history=history, signals={"bv": (("light", 40.0, "y"),)})
    names, agents = agents_of(given)
    assert names == ["ego", "bv", "near", "far"]
    assert agents.past[2, -1] == pytest.approx([50.0, 3.2]) and agents.past[3, 0] == pytest.approx([80.0, 3.2])
    assert np.isfinite(agents.past[:, :, 0]).sum(axis=1).tolist() == [1, 1, 6, 11]  # "near" came half a second ago
    assert agents.light[:2].tolist() == [[0.0] * 5, [1.0, 0.0, 1.0, 0.0, 0.8]]


# -- the shipped weights


def test_the_shipped_weights_are_small_and_of_this_network() -> None:
    assert SHIPPED_WEIGHTS.stat().st_size < 5_000_000
    assert 500_000 < sum(values.size for values in read_weights(SHIPPED_WEIGHTS).values()) < 1_000_000


def test_a_car_alone_on_a_straight_road_is_expected_to_drive_on_in_its_lane(road: RoadMap) -> None:
    """20 m/s, below the limit of 22: within 8 s it goes 160 m, give or take a car that speeds up or slows down."""
    prediction = Predictor().predict(driving((300.0, 0.0, 20.0)), segments_of(road))
    best = prediction.place[0, np.argmax(prediction.probability[0])]
    assert abs(best[-1, 0] - 460.0) < 32.0 and np.abs(best[:, 1]).max() < LANE
    assert (np.diff(best[:, 0]) > 0.0).all()
    assert prediction.probability[0].sum() == pytest.approx(1.0) and (prediction.scale > 0.0).all()


def test_a_car_behind_a_standing_one_is_expected_to_slow_down(road: RoadMap) -> None:
    """In the mean over the modes: it may also change lanes and pass."""
    alone = Predictor().predict(driving((300.0, 0.0, 15.0)), segments_of(road))
    behind = Predictor().predict(driving((300.0, 0.0, 15.0), (345.0, 0.0, 0.0)), segments_of(road))
    ends = [p.probability[0] @ p.place[0, :, -1, 0] for p in (alone, behind)]
    assert ends[1] < ends[0] - 10.0


def test_a_scene_that_is_moved_and_rotated_is_predicted_moved_and_rotated(road: RoadMap) -> None:
    agents, segments = driving((300.0, 0.0, 15.0), (320.0, 3.2, 12.0), (280.0, -3.2, 18.0)), segments_of(road)
    before = Predictor().predict(agents, segments)
    moved, moved_segments = turned(agents, segments, 2.1, (-700.0, 350.0))
    after = Predictor().predict(moved, moved_segments)
    expected = to_world(to_local(before.place.reshape(3, -1, 2), agents), moved).reshape(before.place.shape)
    assert after.place == pytest.approx(expected, abs=0.02)
    assert after.probability == pytest.approx(before.probability, abs=1e-3)


def test_jax_and_numpy_compute_the_same(road: RoadMap) -> None:
    jax = pytest.importorskip("jax", reason="the extra train (JAX) is not installed")
    f = features(driving((300.0, 0.0, 15.0), (320.0, 3.2, 12.0)), segments_of(road))
    parameters = read_weights(SHIPPED_WEIGHTS)
    with jax.default_device(jax.devices("cpu")[0]):
        by_numpy, by_jax = forward(parameters, f), forward(parameters, f, jax.numpy)
    assert np.asarray(by_jax.place)[:2] == pytest.approx(by_numpy.place[:2], abs=2e-2)  # m, of up to 170
    assert np.asarray(by_jax.logit)[:2] == pytest.approx(by_numpy.logit[:2], abs=1e-3)


def test_a_file_that_holds_no_weights_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.npz").write_text("no weights")
    np.savez(tmp_path / "other.npz", w=np.zeros(3))
    for name, sentence in (("text.npz", "cannot be read as weights"), ("other.npz", "no weights of this network")):
        with pytest.raises(UsageError, match=sentence):
            Predictor(tmp_path / name)


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


def test_the_figures_are_a_table_or_json(made: Path) -> None:
    """In this process: a start of the program would cost more than what is tested."""
    table = CliRunner().invoke(app, ["transformer", "evaluate", str(made)])
    assert table.exit_code == 0 and table.stdout.startswith("| predictor | minADE [m] | minFDE [m] | miss rate |")
    figures = json.loads(CliRunner().invoke(app, ["transformer", "evaluate", str(made), "--json"]).stdout)
    assert [s["predictor"] for s in figures] == ["transformer", "lane following", "constant velocity"]
    assert f"| lane following | {figures[1]['min_ade']:.2f} | {figures[1]['min_fde']:.2f} |" in table.stdout


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        (("data", "carla"), "There is no source 'carla' of scenes; give sumo or womd:FOLDER."),
        (("data", "womd:nowhere"), "nowhere is no folder with .tfrecord files."),
        (("train", "nowhere"), "nowhere has no scenes (train-*.npz); make them with sumo-adv transformer data."),
        (("evaluate", "nowhere"), "nowhere has no scenes (held_out-*.npz)"),
    ],
)
def test_wrong_use_is_told_in_a_sentence(command: tuple[str, str], sentence: str, tmp_path: Path) -> None:
    more = [] if command[0] == "evaluate" else ["--out", str(tmp_path / "out")]
    done = CliRunner().invoke(app, ["transformer", *command, *more])
    assert isinstance(done.exception, UsageError) and sentence in str(done.exception)


def test_records_become_files_of_scenes(tmp_path: Path) -> None:
    """Nine files: the eighth is held out."""
    (tmp_path / "records").mkdir()
    for k in range(9):
        write(tmp_path / "records" / f"{k}.tfrecord", straight(f"record{k}"))
    done = CliRunner().invoke(
        app, ["transformer", "data", f"womd:{tmp_path / 'records'}", "--out", str(tmp_path / "out"), "--json"]
    )
    assert json.loads(done.stdout) == {"folder": str(tmp_path / "out"), "files": 9}
    assert len(load(tmp_path / "out", TRAIN)) == 8 and len(load(tmp_path / "out", HELD_OUT)) == 1


# -- training


def test_training_lowers_the_loss_and_goes_on_where_it_stopped(made: Path, tmp_path: Path) -> None:
    pytest.importorskip("jax", reason="the extra train (JAX) is not installed")
    pytest.importorskip("optax", reason="the extra train (optax) is not installed")
    from sumo_adv.transformer.train import BATCH_SCENES, loss, train

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
