"""The motion predictor: local scenes and the shipped weights."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from transformer_samples import driving

from sumo_adv.datatypes import Role, Track
from sumo_adv.errors import UsageError
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.network import RoadMap, read_network
from sumo_adv.transformer.model import SHIPPED_WEIGHTS, TransformerPredictor, forward, read_weights
from sumo_adv.transformer.scene import (
    MAX_AGENTS,
    POSITION_STEP_S,
    SceneVehicles,
    Segments,
    agents_of,
    cut,
    light_of,
    scene_features,
    segments_of,
    to_local,
    to_world,
)

LANE = 3.2  # m, of straight_3lane; its lanes lie at y = -3.2, 0 and 3.2


@pytest.fixture(scope="module")
def road() -> RoadMap:
    return read_network(data_folder("networks") / "straight_3lane.net.xml")


def turned(
    agents: SceneVehicles, segments: Segments, angle: float, by: tuple[float, float]
) -> tuple[SceneVehicles, Segments]:
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
    f = scene_features(agents, lane)
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
    prediction = TransformerPredictor().predict(driving((300.0, 0.0, 20.0)), segments_of(road))
    best = prediction.place[0, np.argmax(prediction.probability[0])]
    assert abs(best[-1, 0] - 460.0) < 32.0 and np.abs(best[:, 1]).max() < LANE
    assert (np.diff(best[:, 0]) > 0.0).all()
    assert prediction.probability[0].sum() == pytest.approx(1.0) and (prediction.scale > 0.0).all()


def test_a_car_behind_a_standing_one_is_expected_to_slow_down(road: RoadMap) -> None:
    """In the mean over the modes: it may also change lanes and pass."""
    alone = TransformerPredictor().predict(driving((300.0, 0.0, 15.0)), segments_of(road))
    behind = TransformerPredictor().predict(driving((300.0, 0.0, 15.0), (345.0, 0.0, 0.0)), segments_of(road))
    ends = [p.probability[0] @ p.place[0, :, -1, 0] for p in (alone, behind)]
    assert ends[1] < ends[0] - 10.0


def test_a_scene_that_is_moved_and_rotated_is_predicted_moved_and_rotated(road: RoadMap) -> None:
    agents, segments = driving((300.0, 0.0, 15.0), (320.0, 3.2, 12.0), (280.0, -3.2, 18.0)), segments_of(road)
    before = TransformerPredictor().predict(agents, segments)
    moved, moved_segments = turned(agents, segments, 2.1, (-700.0, 350.0))
    after = TransformerPredictor().predict(moved, moved_segments)
    expected = to_world(to_local(before.place.reshape(3, -1, 2), agents), moved).reshape(before.place.shape)
    assert after.place == pytest.approx(expected, abs=0.02)
    assert after.probability == pytest.approx(before.probability, abs=1e-3)


def test_jax_and_numpy_compute_the_same(road: RoadMap) -> None:
    jax = pytest.importorskip("jax", reason="the extra train (JAX) is not installed")
    f = scene_features(driving((300.0, 0.0, 15.0), (320.0, 3.2, 12.0)), segments_of(road))
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
            TransformerPredictor(tmp_path / name)
