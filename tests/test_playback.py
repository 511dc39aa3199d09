"""A log played back through SUMO: places, hand-overs, boxes, and repetition."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from log_samples import LEFT, MIDDLE, RIGHT, STEPS, moving, write_scenario

from sumo_adv.config import load_settings
from sumo_adv.datatypes import Role, VehicleState
from sumo_adv.drivers import CarefulEgo, EgoController, Observation, ReplayEgo, SumoEgo
from sumo_adv.episode.drive import Drive, ego_type_file
from sumo_adv.episode.encounter_builder import danger
from sumo_adv.episode.encounter_detector import ego_path
from sumo_adv.episode.engine import EpisodeCalls, episode_worker
from sumo_adv.episode.task import FoundEncounter, make_task
from sumo_adv.geometry import Pose
from sumo_adv.metrics.case import make_case
from sumo_adv.metrics.verdict import judge_attempt
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.inputs import load_input
from sumo_adv.simulation.network import read_network
from sumo_adv.simulation.playback import Playback
from sumo_adv.simulation.simulation_spec import SimulationSpec
from sumo_adv.simulation.sumo_states import Snapshot
from sumo_adv.simulation.tracks import LoggedTrack

EGO = moving("e", 60.0, RIGHT + 0.3, 14.0)
LEADER = moving("lead", 90.0, RIGHT, 14.0)
LATE = moving("late", 20.0, LEFT - 0.4, 15.0, gone=(range(30),))  # first seen at 3.0 s
UNSEEN = moving("gap", 150.0, MIDDLE, 10.0, gone=(range(40, 45),))  # not at 4.0 to 4.4 s
OFF = moving("off", 100.0, 30.0, 2.0)  # on a car park: no route
WALKER = moving("walker", 120.0, -8.0, 1.2, kind="pedestrian", heading=np.pi / 2, size=(0.6, 0.6))
EVERYBODY = [EGO, LEADER, LATE, UNSEEN, OFF, WALKER]
PARKED = "[[parked]]\nx = {x}\ny = {y}\nheading = 0.05\nlength = 4.0\nwidth = 2.0\n"


@contextmanager
def playing(
    folder: Path,
    tracks: Sequence[LoggedTrack],
    driver: EgoController | None = None,
    background: str = "log",
    more: str = "",
    routed: Sequence[str] = ("e", "lead", "late", "gap"),
) -> Iterator[Drive]:
    """The drive of a run on these tracks, before its first step."""
    names = [t.id for t in tracks]
    top = {"background": f'"{background}"'}
    path = write_scenario(folder, list(tracks), routed=tuple(n for n in routed if n in names), more=more, top=top)
    run_input = load_input(path)
    assert run_input.playback is not None
    controller = driver or ReplayEgo()
    spec = SimulationSpec(run_input.network, run_input.routes, (ego_type_file(controller, folder),), 0.0, 3)
    log = Playback(
        run_input.playback, read_network(spec.network), begin=0.0, step=0.1, ego="e", warm_up=run_input.warm_up
    )
    drive = Drive(spec, controller, 3, playback=log)
    try:
        yield drive
    finally:
        drive.simulation.close()


def go(drive: Drive, seconds: float) -> None:
    """Step on, with the ego taken over as soon as it may be."""
    for _ in range(round(seconds * 10)):
        drive.tick()
        if drive.ego is None and drive.may_take_over("e"):
            drive.take_over("e")


def centre(drive: Drive, name: str) -> tuple[float, float]:
    state = drive.state(name)
    return state.x, state.y


def judged(drive: Drive) -> tuple[str, frozenset[str]]:
    """Whether an encounter at 2 s, with a leader and a neighbour as candidates, is dangerous by itself."""
    return danger({t.id: t for t in drive.tracks()}, drive, 2.0, 1.0, ["lead", "gap"])[:2]


# ---- places


def test_all_are_where_and_when_the_log_says(tmp_path: Path) -> None:
    with playing(tmp_path, EVERYBODY) as drive:
        go(drive, 9.0)
        tracks = {t.id: t for t in drive.tracks()}
        for logged in EVERYBODY:
            track = tracks[logged.id]
            steps = np.rint(track.time / 0.1).astype(int)
            assert steps.tolist() == [k for k in range(1, STEPS) if logged.valid[k]]
            assert np.hypot(track.x - logged.x[steps], track.y - logged.y[steps]).max() < 1e-6
            assert track.speed == pytest.approx(logged.speed[steps])
            assert (track.length, track.width) == (logged.length, logged.width)
        roles = {name: t.role for name, t in tracks.items()}
        assert roles["e"] is Role.EGO
        assert roles["walker"] is Role.OBSTACLE
        assert {roles[n] for n in ("lead", "late", "gap", "off")} == {Role.BACKGROUND}
        assert set(tracks["off"].lane) == {""}


def test_a_vehicle_that_leaves_all_lanes_and_comes_back_stays_where_the_log_says(tmp_path: Path) -> None:
    """3 m/s at 0.6 rad to the right are 1.7 m/s sideways: off the road within 3 s. From 5 s on it drives back."""
    leaver = moving("leaver", 100.0, RIGHT, 3.0, heading=-0.6)
    back = np.arange(STEPS) >= 50
    y = np.where(back, 2 * leaver.y[50] - leaver.y, leaver.y)
    leaver = replace(leaver, y=y, heading=np.where(back, 0.6, -0.6))
    with playing(tmp_path, [EGO, leaver], routed=("e", "leaver")) as drive:
        go(drive, 8.5)
        track = next(t for t in drive.tracks() if t.id == "leaver")
    steps = np.rint(track.time / 0.1).astype(int)
    assert steps.tolist() == list(range(1, len(steps) + 1)) and len(steps) == 85
    assert np.hypot(track.x - leaver.x[steps], track.y - leaver.y[steps]).max() < 1e-4  # a log has four decimals
    assert track.speed == pytest.approx(3.0 * np.ones(85))
    on = [lane != "" for lane in track.lane]
    assert on[0] and not on[45] and on[-1]


def test_a_driver_can_ask_for_the_way_of_whoever_is_seen_for_the_last_time(tmp_path: Path) -> None:
    """The log has no 4.0 s of "gap": in the step from 3.9 s on the driver still sees it, and then it is gone."""
    routed: dict[float, set[str]] = {}

    def observe(me: VehicleState, near: Sequence[str]) -> Observation:
        routed[drive.now] = {name for name in near if drive.simulation.route(name)[0]}
        return Observation(drive.now, 0.1, me, ())

    with playing(tmp_path, [EGO, LEADER, UNSEEN], CarefulEgo()) as drive:
        drive.observe = observe
        go(drive, 4.2)
        assert "gap" in routed[3.9]
        assert "gap" not in routed[4.0]


def test_the_driver_begins_when_the_warm_up_is_over(tmp_path: Path) -> None:
    with playing(tmp_path, EVERYBODY, SumoEgo("krauss", {})) as drive:
        go(drive, 0.9)
        assert drive.ego is None
        go(drive, 0.1)
        assert (drive.ego, drive.now) == ("e", 1.0)
        assert centre(drive, "e") == pytest.approx((74.0, RIGHT + 0.3))
        go(drive, 0.1)
        assert drive.state("e").speed == pytest.approx(14.26)  # krauss: + 2.6 m/s2 from the logged 14
        go(drive, 7.0)
        assert centre(drive, "lead") == pytest.approx((90.0 + 14.0 * 8.1, RIGHT))  # still the log's
        assert drive.simulation.route("e")[0] == ("eastbound",)


def test_the_background_is_handed_to_sumo_with_its_speed_and_stays_beyond_the_log(tmp_path: Path) -> None:
    with playing(tmp_path, EVERYBODY, SumoEgo("idm", {}), "sumo") as drive:
        go(drive, 1.0)
        assert centre(drive, "lead") == pytest.approx((104.0, RIGHT))
        go(drive, 0.1)
        assert drive.state("lead").speed == pytest.approx(14.26, abs=0.27)  # SUMO's, at most + 2.6 m/s2
        go(drive, 2.0)
        assert drive.state("lead").x > 90.0 + 14.0 * 3.1 + 1.0
        assert centre(drive, "late")[0] == pytest.approx(20.0 + 15.0 * 3.1, abs=0.1)  # it came, and drives
        assert centre(drive, "off") == pytest.approx((106.2, 30.0))  # no route: never handed over
        go(drive, 8.0)
        assert drive.left() is None
        assert {"e", "lead", "late", "gap"} <= drive.snapshot.raw.keys()
        assert not {"off", "walker"} & drive.snapshot.raw.keys()  # the log is over at 9 s


def test_a_late_vehicle_waits_until_its_place_is_free(tmp_path: Path) -> None:
    fast = moving("late", 75.0 - 15.0 * 3.0, RIGHT, 28.0, gone=(range(30),))  # comes on top of the ego's lane
    behind = moving("lead", 74.0, RIGHT, 14.0)
    with playing(tmp_path, [EGO, behind, fast], SumoEgo("idm", {}), "sumo") as drive:
        go(drive, 2.9)
        for _ in range(15):
            go(drive, 0.1)
            if "late" in drive.snapshot.raw:
                break
        others = [drive.state(n) for n in ("e", "lead")]
        late = drive.state("late")
        assert min(abs(late.x - o.x) for o in others) > 4.5


def test_with_a_replayed_background_or_ego_nothing_counts_beyond_the_log(tmp_path: Path) -> None:
    with playing(tmp_path, EVERYBODY, SumoEgo("idm", {})) as drive:
        go(drive, 2.0)
        assert (drive.left(), drive.within(200), drive.within(5)) == (70, 70, 5)
    with playing(tmp_path, EVERYBODY, ReplayEgo(), "sumo") as drive:
        go(drive, 2.0)
        assert drive.left() == 70


# ---- boxes


def test_a_parked_vehicle_in_a_lane_is_one_that_sumos_drivers_see(tmp_path: Path) -> None:
    places = [(180.0, RIGHT), (140.0, -9.0), (180.0, MIDDLE), (180.0, LEFT)]
    more = "".join(PARKED.format(x=x, y=y) for x, y in places)
    with playing(tmp_path, [EGO], SumoEgo("idm", {}), "sumo", more) as drive:
        go(drive, 25.0)
        assert drive.state("e").speed == pytest.approx(0.0, abs=0.1)
        assert 150.0 < drive.state("e").x < 176.0  # it stopped behind those in the lanes
        assert centre(drive, "parked0") == pytest.approx((180.0, RIGHT))
        assert centre(drive, "parked1") == pytest.approx((140.0, -9.0))
        roles = {t.id: t.role for t in drive.tracks()}
        assert roles["parked0"] is roles["parked1"] is Role.OBSTACLE
        assert "parked0" in drive.simulation.api.vehicle.getIDList()
        assert "parked1" not in drive.simulation.api.vehicle.getIDList()


def test_a_scenarios_walker_comes_goes_on_and_leaves(tmp_path: Path) -> None:
    walker = "x = 100.0\ny = -6.0\nheading = 1.5707963\nlength = 0.5\nwidth = 0.5\nspeed = 1.0\ntimes = [2.0, 5.0]\n"
    with playing(tmp_path, [EGO], more=f"[[pedestrians]]\n{walker}") as drive:
        go(drive, 1.9)
        assert "pedestrian0" not in drive.snapshot.raw
        go(drive, 1.1)
        assert centre(drive, "pedestrian0") == pytest.approx((100.0, -5.0))
        go(drive, 2.1)
        assert "pedestrian0" not in drive.snapshot.raw


def test_a_careful_driver_sees_a_box_that_sumo_does_not(tmp_path: Path) -> None:
    """A walker stands in the ego's lane: the careful driver brakes, IDM drives on."""
    walker = moving("walker", 150.0, RIGHT, 0.0, kind="pedestrian", size=(0.6, 0.6))
    speeds = {}
    for driver in (CarefulEgo(), SumoEgo("idm", {})):
        with playing(tmp_path, [EGO, walker], driver, "sumo") as drive:
            go(drive, 6.0)
            speeds[driver.name] = drive.state("e").speed
    assert speeds["idm"] > 14.0
    assert speeds["careful"] < speeds["idm"] - 3.0


# ---- what the log's own faults mean


def test_boxes_that_overlap_in_the_log_are_no_collision_and_no_candidates(tmp_path: Path) -> None:
    ghost = moving("ghost", 61.0, RIGHT + 0.3, 14.0)  # inside the ego all the time
    ram = moving("lead", 140.0, RIGHT, 4.0)  # the ego is driven into its back at about 7.6 s
    with playing(tmp_path, [EGO, ghost, ram, UNSEEN]) as drive:
        go(drive, 9.0)
        assert judged(drive) == ("", frozenset({"ghost", "lead"}))
        why, *_ = danger({t.id: t for t in drive.tracks()}, drive, 2.0, 1.0, ["lead"])
        assert why == "in the log itself it overlaps the ego"


def test_a_situation_knows_how_long_the_log_goes_on_and_whether_it_moves_the_others(tmp_path: Path) -> None:
    """The log ends at 9.0 s; with a background that drives on by itself and an ego of SUMO's nothing ends."""
    path = write_scenario(tmp_path, [EGO, LEADER], routed=("e", "lead"))
    for ego, background in (("replay", "sumo"), ("idm", "log"), ("idm", "sumo")):
        run_input = load_input(path)
        settings = load_settings(None, ego=ego, background=background)
        with Engine(episode_worker) as engine:
            engine.call(EpisodeCalls.open, make_task(run_input, settings, tmp_path))
            encounter = engine.call(EpisodeCalls.seek, "")
        assert isinstance(encounter, FoundEncounter)
        for s in encounter.situations.values():
            ends = (ego, background) != ("idm", "sumo")
            assert s.left == (pytest.approx((9.0 - s.time) / 0.1) if ends else np.inf)
            assert s.traffic.reacting is (background == "sumo")


def test_who_is_critical_in_a_recording_is_no_candidate_but_others_are(tmp_path: Path) -> None:
    """Standing at 199 m, the leader is 4 m ahead of the ego's bumper at 9 s: 0.29 s at 14 m/s."""
    standing = moving("lead", 199.0, RIGHT, 0.0)
    with playing(tmp_path, [moving("e", 62.25, RIGHT, 14.0), standing, UNSEEN]) as drive:
        go(drive, 9.0)
        assert judged(drive) == ("", frozenset({"lead"}))
        why, *_ = danger({t.id: t for t in drive.tracks()}, drive, 2.0, 1.0, ["lead"])
        assert why == "critical unattacked: min TTC 0.45 s"


def test_an_ego_that_is_really_driven_into_a_box_collides(tmp_path: Path) -> None:
    """Logged, the ego stops short of a walker at 100 m; IDM does not know of it."""
    stops = moving("e", 60.0, RIGHT, 4.0)
    walker = moving("walker", 100.0, RIGHT, 0.0, kind="pedestrian", size=(0.6, 0.6))
    with playing(tmp_path, [stops, walker], SumoEgo("idm", {}), "sumo") as drive:
        go(drive, 9.0)
        assert judged(drive)[0] == "the ego collides unattacked"
    with playing(tmp_path, [stops, walker]) as drive:
        go(drive, 9.0)
        assert judged(drive) == ("", frozenset())


# ---- the adversary, and again


def test_whom_an_attack_drives_the_log_leaves_alone_for_good(tmp_path: Path) -> None:
    with playing(tmp_path, EVERYBODY) as drive:
        go(drive, 2.0)
        for k in range(10):
            drive.tick({"lead": Pose(118.0 + 1.2 * (k + 1), RIGHT + 0.1 * (k + 1), 0.08, 12.0)})
            assert centre(drive, "lead") == pytest.approx((118.0 + 1.2 * (k + 1), RIGHT + 0.1 * (k + 1)))


class Brakes:
    """A driver that takes a replayed ego and brakes it by 0.5 m/s a step, as a reference driver does."""

    name, forkable, needs_observation, sumo_type = "brakes", True, True, {}

    def reset(self, seed: int) -> None:
        """Nothing to forget."""

    def act(self, seen: Observation) -> Pose:
        speed = seen.ego.speed - 0.5
        return Pose(seen.ego.x + 0.1 * speed, seen.ego.y, seen.ego.heading, speed)


def test_a_driver_in_a_replayed_ego_has_the_speed_that_it_gave_itself(tmp_path: Path) -> None:
    with playing(tmp_path, EVERYBODY, ReplayEgo()) as drive:
        go(drive, 2.0)
        drive.controller = Brakes()
        for _ in range(10):
            drive.tick()
        assert drive.state("e").speed == pytest.approx(14.0 - 10 * 0.5)  # the log has 14 m/s all the time


def test_the_path_of_a_replayed_ego_is_the_logs_and_then_its_lane(tmp_path: Path) -> None:
    with playing(tmp_path, [EGO]) as drive:
        go(drive, 3.0)
        path = ego_path(read_network(drive.simulation.spec.network), drive)
        assert path is not None
        assert (path.x[0], path.y[0]) == pytest.approx((102.0, RIGHT + 0.3))
        x, y, _ = path.at(np.array([50.0, 200.0]))
        assert (x[0], y[0]) == pytest.approx((152.0, RIGHT + 0.3), abs=1e-3)
        assert y[1] == pytest.approx(RIGHT, abs=0.05)  # beyond the log: the lane's centre


@pytest.mark.parametrize("background", ["log", "sumo"])
@pytest.mark.parametrize("name", ["idm", "replay", "careful"])
def test_rewound_it_repeats_bit_for_bit(tmp_path: Path, name: str, background: str) -> None:
    driver: EgoController = {"idm": SumoEgo("idm", {}), "replay": ReplayEgo(), "careful": CarefulEgo()}[name]
    more = PARKED.format(x=300.0, y=MIDDLE)
    with playing(tmp_path, EVERYBODY, driver, background, more) as drive:
        go(drive, 3.5)
        before = list(drive.recording.snapshots)

        def attack() -> list[Snapshot]:
            for k in range(30):
                drive.tick({"lead": Pose(139.0 + 1.0 * (k + 1), RIGHT, 0.0, 10.0)})
            return list(drive.recording.snapshots)

        first = attack()
        drive.rewind(35)
        assert drive.recording.snapshots == before
        assert drive.ego == "e"
        assert attack() == first


def test_a_box_that_the_adversary_hits_first_is_a_third_party(tmp_path: Path) -> None:
    """The leader swerves to the left, where a vehicle stands at 190 m, before the ego could ever touch it."""
    standing = moving("walker", 190.0, MIDDLE, 0.0, kind="pedestrian", size=(0.6, 0.6))
    for there in (True, False):
        with playing(tmp_path, [EGO, LEADER, *([standing] if there else [])]) as drive:
            go(drive, 2.0)
            for k in range(60):
                y = RIGHT + 3.2 * min((k + 1) / 30, 1.0)
                drive.tick({"lead": Pose(118.0 + 1.4 * (k + 1), y, 0.0, 14.0)})
            case = make_case(drive.tracks("lead"), "e", ["lead"], 2.0, {})
            assert case is not None
            verdict = judge_attempt(case)
            assert ("third_party" in verdict.failed_gates) is there
            assert not verdict.collided


def test_a_vehicle_unseen_before_the_attack_is_judged_by_what_came_after(tmp_path: Path) -> None:
    flickering = moving("lead", 90.0, RIGHT, 14.0, gone=(range(13, 15),))
    with playing(tmp_path, [EGO, flickering]) as drive:
        go(drive, 2.0)
        for k in range(30):
            drive.tick({"lead": Pose(118.0 + 1.4 * (k + 1), RIGHT, 0.0, 14.0)})
        case = make_case(drive.tracks("lead"), "e", ["lead"], 2.0, {})
        assert case is not None
        assert case.adversary.time == pytest.approx(np.arange(15, 51) * 0.1)
        assert judge_attempt(case).feasible


def test_a_vehicle_that_sumo_refuses_is_inserted_slower_and_brought_to_its_speed(tmp_path: Path) -> None:
    """SUMO's default type has 55.6 m/s at most, so it refuses a departure at 60 m/s. The log has it there anyway."""
    rocket = moving("rocket", 200.0, LEFT, 60.0, gone=(range(20),))  # first seen at 2.0 s
    with playing(tmp_path, [EGO, rocket], routed=("e", "rocket")) as drive:
        go(drive, 2.5)
        state = drive.state("rocket")
    assert state.x == pytest.approx(200.0 + 60.0 * 2.5, abs=0.01)
    assert state.speed == pytest.approx(60.0, abs=0.01)
