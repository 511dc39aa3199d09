"""One simulation with its ego's driver: which controller acts, what is recorded, and that it can be replayed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from sumo_samples import make_spec, over_the_line, vehicle

from sumo_adv.datatypes import Role
from sumo_adv.drivers import Action, EgoController, LaneSpeed, Observation, ReplayEgo, Steer, SumoEgo
from sumo_adv.drivers import Pose as EgoPose
from sumo_adv.episode.drive import Drive, ego_type_file
from sumo_adv.geometry import Pose
from sumo_adv.simulation.ego_types import EGO_TYPE
from sumo_adv.simulation.simulation_spec import SimulationSpec
from sumo_adv.simulation.sumo_states import Snapshot


class Scripted:
    """A driver that answers from a list, then None, and remembers what it saw."""

    name = "scripted"
    forkable = True
    needs_observation = True
    sumo_type: Mapping[str, str] = {}

    def __init__(self, *actions: Action) -> None:
        self.actions = actions
        self.seen: list[Observation] = []
        self.seeds: list[int] = []

    def reset(self, seed: int) -> None:
        self.seeds.append(seed)
        self.seen.clear()

    def act(self, observation: Observation) -> Action:
        self.seen.append(observation)
        return self.actions[len(self.seen) - 1] if len(self.seen) <= len(self.actions) else None


@contextmanager
def driving(folder: Path, controller: EgoController, *, take_over: bool = True, more: str = "") -> Iterator[Drive]:
    """An ego at 17 m/s in the right of three lanes, 20 m behind a leader; after one step."""
    ego = vehicle("ego", "eastbound", 0, 100.0, 17.0)
    base = make_spec(folder, "straight_3lane", [vehicle("leader", "eastbound", 0, 125.0, 17.0), ego, more])
    extra = (ego_type_file(controller, folder),)
    drive = Drive(SimulationSpec(base.network, base.routes, extra, 0.0, 3), controller, 3)
    try:
        drive.tick()
        if take_over:
            drive.take_over("ego")
        yield drive
    finally:
        drive.simulation.close()


def states(drive: Drive) -> list[Snapshot]:
    return list(drive.recording.snapshots)


# ---- which controller drives


def test_the_egos_type_is_written_as_sumo_reads_it(tmp_path: Path) -> None:
    text = ego_type_file(SumoEgo("idm", {"tau": 0.7}), tmp_path).read_text()
    assert f'<vType id="{EGO_TYPE}" vClass="passenger"' in text
    assert 'carFollowModel="IDM"' in text
    assert 'tau="0.7"' in text


def test_a_sumo_ego_gets_the_driver_under_test_and_keeps_its_body(tmp_path: Path) -> None:
    with driving(tmp_path, SumoEgo("krauss", {"tau": 0.6, "decel": 3.5}), take_over=False) as drive:
        assert drive.simulation.model("ego").tau == 1.0
        drive.take_over("ego")
        drive.tick()
        model = drive.simulation.model("ego")
        assert (model.tau, model.deceleration) == (0.6, 3.5)
        assert (drive.state("ego").length, drive.state("ego").width) == (5.0, 2.0)


def test_a_driver_sees_itself_and_those_within_120_metres(tmp_path: Path) -> None:
    far = vehicle("far", "eastbound", 2, 230.0, 17.0)  # 130 m ahead
    driver = Scripted()
    with driving(tmp_path, driver, more=far) as drive:
        drive.tick()
        (seen,) = driver.seen
        assert driver.seeds == [3]
        assert (seen.time, seen.dt) == (0.1, 0.1)
        assert (seen.ego.x, seen.ego.y) == pytest.approx((97.5, -3.2))
        assert [(o.id, o.x) for o in seen.others] == [("leader", pytest.approx(122.5))]


def test_distances_are_those_of_box_centres(tmp_path: Path) -> None:
    """A bus of 12 m has its front bumper 124.7 m, and its centre 118.7 m, ahead of the ego's centre at 97.5 m."""
    bus = '<vType id="long" vClass="bus" length="12"/>' + vehicle("bus", "eastbound", 2, 222.2, 17.0, "long")
    driver = Scripted()
    with driving(tmp_path, driver, more=bus) as drive:
        assert drive.pose("bus") == pytest.approx((216.2, 3.2, 0.0))
        ego = drive.state("ego")
        assert drive.near(ego, 118.0) == ["leader"]
        assert set(drive.near(ego, 120.0)) == {"leader", "bus"}
        drive.tick()
        assert {o.id for o in driver.seen[0].others} == {"leader", "bus"}


def test_a_pose_is_where_the_ego_is_after_the_step(tmp_path: Path) -> None:
    with driving(tmp_path, Scripted(EgoPose(99.0, -2.9, 0.2, 16.5))) as drive:
        drive.tick()
        ego = drive.state("ego")
        assert (ego.x, ego.y, ego.heading, ego.speed) == pytest.approx((99.0, -2.9, 0.2, 16.5), abs=1e-6)
        assert ego.acceleration == pytest.approx(-5.0)


def test_pedals_and_wheel_move_the_ego(tmp_path: Path) -> None:
    with driving(tmp_path, Scripted(*[Steer(-2.0, 0.02)] * 10)) as drive:
        for _ in range(10):
            drive.tick()
        ego = drive.state("ego")
        assert ego.speed == pytest.approx(15.0)
        assert ego.acceleration == pytest.approx(-2.0)
        assert ego.x == pytest.approx(97.5 + 16.0, abs=0.2)
        assert 0.02 < ego.heading < 0.2
        assert ego.y > -3.2


def test_a_speed_is_driven_for_the_steps_it_is_asked_for_and_then_sumo_drives(tmp_path: Path) -> None:
    with driving(tmp_path, Scripted(LaneSpeed(None, 16.4), LaneSpeed(None, 15.8))) as drive:
        speeds = [(drive.tick(), drive.state("ego").speed)[1] for _ in range(4)]
        assert speeds[:2] == pytest.approx([16.4, 15.8])
        assert 15.8 < speeds[2] < speeds[3]


def test_a_lane_asked_for_is_changed_to(tmp_path: Path) -> None:
    with driving(tmp_path, Scripted(*[LaneSpeed(1, 17.0)] * 60)) as drive:
        ys = [(drive.tick(), drive.state("ego").y)[1] for _ in range(120)]
        assert drive.state("ego").lane == "eastbound_1"
        assert ys[59] == pytest.approx(-0.6)  # SUMO counts it as done once 2 m fit into 3.2 m
        assert ys[-1] == pytest.approx(0.0, abs=0.05)  # left alone it goes to the centre
        assert float(np.abs(np.diff(ys)).max()) < 0.15  # it drives there, it does not jump


def test_sumo_drivers_are_not_asked(tmp_path: Path) -> None:
    class Silent(Scripted):
        needs_observation = False

    driver = Silent(EgoPose(500.0, 0.0, 0.0, 1.0))
    with driving(tmp_path, driver) as drive:
        drive.tick()
        assert driver.seen == []
        assert drive.state("ego").x < 100.0


# ---- adversaries, tracks


def test_the_adversary_is_where_it_is_put_and_the_ego_reacts(tmp_path: Path) -> None:
    with driving(tmp_path, SumoEgo("idm", {})) as drive:
        speed = 17.0
        x = drive.state("leader").x
        for _ in range(30):
            speed -= 0.4
            x += 0.1 * speed
            drive.tick({"leader": Pose(x, -3.2, 0.0, speed)})
            assert drive.state("leader").x == pytest.approx(x, abs=1e-6)
        assert drive.state("leader").acceleration == pytest.approx(-4.0)
        assert drive.state("ego").speed < 14.0
        assert drive.state("ego").x < x - 5.0


def test_tracks_know_their_roles_and_may_start_late(tmp_path: Path) -> None:
    with driving(tmp_path, SumoEgo("idm", {}), more=vehicle("bv", "eastbound", 2, 80.0, 17.0)) as drive:
        for _ in range(9):
            drive.tick()
        roles = {t.id: t.role for t in drive.tracks("leader")}
        assert roles == {"ego": Role.EGO, "leader": Role.ADVERSARY, "bv": Role.BACKGROUND}
        assert {t.role for t in drive.tracks()} == {Role.EGO, Role.BACKGROUND}
        late = {t.id: t for t in drive.tracks(start=6)}["ego"]
        assert late.time == pytest.approx([0.7, 0.8, 0.9, 1.0])
        assert drive.now == 1.0


# ---- again


@pytest.mark.parametrize("driver", ["idm", "scripted"])
def test_rewound_it_is_where_it_was_and_goes_on_as_it_did(tmp_path: Path, driver: str) -> None:
    controller: EgoController = (
        SumoEgo("idm", {}) if driver == "idm" else Scripted(*[Steer(-1.0, 0.01)] * 8, *[LaneSpeed(None, 12.0)] * 30)
    )
    with driving(tmp_path, controller, more=vehicle("bv", "eastbound", 1, 80.0, 15.0, "nervous")) as drive:
        for _ in range(19):
            drive.tick()
        before = states(drive)

        def attack() -> list[Snapshot]:
            for k in range(15):
                drive.tick({"leader": over_the_line(k, 165.0)})
            return states(drive)

        first = attack()
        drive.rewind(20)
        assert states(drive) == before
        assert drive.ego == "ego"
        assert attack() == first


def test_rewound_to_the_very_takeover_the_ego_is_taken_over(tmp_path: Path) -> None:
    driver = Scripted(EgoPose(99.0, -3.2, 0.0, 15.0))
    with driving(tmp_path, driver) as drive:
        drive.tick()
        after = states(drive)
        drive.rewind(1)
        assert (drive.ego, driver.seeds, len(states(drive))) == ("ego", [3, 3], 1)
        drive.tick()
        assert states(drive) == after


def test_a_replayed_ego_plays_its_track_whatever_the_adversary_does(tmp_path: Path) -> None:
    with driving(tmp_path, ReplayEgo()) as drive:
        for _ in range(9):
            drive.tick()
        for _ in range(30):
            drive.tick()
        track = {t.id: t for t in drive.tracks()}["ego"].between(1.0, math.inf)
        drive.rewind(10)
        drive.replay(track)
        x = drive.state("leader").x
        for k in range(29):
            x += 0.1 * max(0.0, 17.0 - 0.8 * k)
            drive.tick({"leader": Pose(x, -3.2, 0.0, max(0.0, 17.0 - 0.8 * k))})
            ego = drive.state("ego")
            assert (ego.x, ego.y, ego.speed) == pytest.approx(
                (track.x[k + 1], track.y[k + 1], track.speed[k + 1]), abs=1e-6
            )
        assert ego.x > x - 5.0  # straight into it
        drive.rewind(10)
        drive.tick()
        assert drive.state("ego").x == pytest.approx(track.x[1], abs=1e-9)  # SUMO drives again until told otherwise


def test_an_ego_that_has_left_is_not_asked(tmp_path: Path) -> None:
    driver = Scripted()
    with driving(tmp_path, driver, take_over=False, more=vehicle("short", "eastbound", 2, 1190.0, 20.0)) as drive:
        drive.take_over("short")
        for _ in range(10):
            drive.tick()
        assert "short" not in drive.snapshot.raw
        assert 4 <= len(driver.seen) <= 7
