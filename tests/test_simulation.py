"""The adapter over libsumo, against the real thing: an injected pose is there after the next step."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from sumo_samples import make_spec, over_the_line, vehicle

from sumo_adv.datatypes import Role
from sumo_adv.errors import SimulationError
from sumo_adv.geometry import Pose
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.simulation_spec import SimulationSpec
from sumo_adv.simulation.sumo_states import Snapshot, angle_deg_of, correct_speeds, heading_of
from sumo_adv.simulation.tracks import Recording, tracks_of


@contextmanager
def running(spec: SimulationSpec, steps: int = 1) -> Iterator[Simulation]:
    """A simulation after ``steps`` steps, read after each; closed at the end."""
    simulation = Simulation(spec)
    try:
        for _ in range(steps):
            simulation.step()
            simulation.read()
        yield simulation
    finally:
        simulation.close()


def pair(folder: Path) -> SimulationSpec:
    """An ego in the right of three lanes at 17 m/s and a leader 20 m before it."""
    ego = vehicle("ego", "eastbound", 0, 100.0, 17.0)
    return make_spec(folder, "straight_3lane", [vehicle("leader", "eastbound", 0, 125.0, 17.0), ego])


# ---- angles and places


@pytest.mark.parametrize(
    ("angle_deg", "heading"),
    [(90.0, 0.0), (0.0, math.pi / 2), (270.0, math.pi), (180.0, -math.pi / 2), (45.0, math.pi / 4)],
)
def test_sumo_counts_degrees_clockwise_from_north(angle_deg: float, heading: float) -> None:
    assert heading_of(angle_deg) == pytest.approx(heading)
    assert angle_deg_of(heading) == pytest.approx(angle_deg)


def test_a_vehicle_is_where_the_centre_of_its_box_is(tmp_path: Path) -> None:
    with running(pair(tmp_path)) as simulation:
        ego = simulation.state(simulation.read(), "ego")
        assert (ego.x, ego.y, ego.heading) == pytest.approx((97.5, -3.2, 0.0))  # the bumper is at 100 m, 5 m long
        assert (ego.speed, ego.length, ego.width, ego.lane) == (17.0, 5.0, 2.0, "eastbound_0")
        assert simulation.time == 0.1
        assert simulation.lane_position("ego") == pytest.approx(100.0)
        with pytest.raises(KeyError):
            simulation.state(simulation.read(), "nobody")


def test_northwards_the_centre_is_south_of_the_bumper(tmp_path: Path) -> None:
    spec = make_spec(tmp_path, "priority_crossing", [vehicle("ego", "south_in north_out", 1, 50.0, 10.0)])
    with running(spec) as simulation:
        ego = simulation.state(simulation.read(), "ego")
        assert (ego.x, ego.y, ego.heading) == pytest.approx((1.6, -220.0 + 50.0 - 2.5, math.pi / 2))
        assert simulation.route("ego") == (("south_in", "north_out"), 0)


# ---- driving a vehicle


def test_an_injected_pose_speed_and_acceleration_are_there_after_the_next_step(tmp_path: Path) -> None:
    with running(pair(tmp_path), 3) as simulation:
        recording = Recording(0.1)
        for k, speed in enumerate((12.3, 12.7, 12.0)):
            simulation.inject({"leader": Pose(150.0 + 1.2 * k, -2.0 + 0.1 * k, 0.1, speed)})
            simulation.step()
            recording.append(simulation.read())
            state = simulation.state(recording.snapshots[-1], "leader", recording.acceleration("leader"))
            assert (state.x, state.y, state.heading) == pytest.approx((150.0 + 1.2 * k, -2.0 + 0.1 * k, 0.1), abs=1e-6)
            assert state.speed == pytest.approx(speed, abs=1e-12)
        sizes, roles = simulation.fleet.sizes, {"leader": Role.ADVERSARY}
        (track,) = tracks_of(recording.snapshots, sizes, roles, 0.1, ["leader"])
        assert track.acceleration == pytest.approx([0.0, 4.0, -7.0])
        assert recording.acceleration("leader") == pytest.approx(-7.0)


def test_two_vehicles_are_moved_in_one_step(tmp_path: Path) -> None:
    with running(pair(tmp_path)) as simulation:
        simulation.inject({"leader": Pose(300.0, 3.2, 0.0, 5.0), "ego": Pose(200.0, 0.0, 0.0, 9.0)})
        simulation.step()
        snapshot = simulation.read()
        assert [simulation.state(snapshot, n).x for n in ("leader", "ego")] == pytest.approx([300.0, 200.0])
        assert snapshot.raw["leader"][4] == "eastbound_2"


def test_a_vehicle_is_placed_exactly_in_the_opposite_lane_and_off_the_road(tmp_path: Path) -> None:
    spec = make_spec(tmp_path, "two_way", [vehicle("bv", "eastbound", 0, 100.0, 10.0)])
    with running(spec) as simulation:
        for x, y, lane in ((110.0, 1.4, "westbound_0"), (112.0, 30.0, "")):
            simulation.inject({"bv": Pose(x, y, 0.05, 10.0)})
            simulation.step()
            state = simulation.state(simulation.read(), "bv")
            assert (state.x, state.y, state.heading) == pytest.approx((x, y, 0.05), abs=1e-6)
            assert state.lane == lane


def test_the_speed_is_exact_also_in_the_step_back_on_the_road(tmp_path: Path) -> None:
    """Beside the road for three steps, and at every step 0.3 m/s slower; SUMO tells the fifth speed for the sixth."""
    spec = make_spec(tmp_path, "two_way", [vehicle("bv", "eastbound", 0, 100.0, 10.0)])
    with running(spec) as simulation:
        lanes = []
        for k, y in enumerate((0.0, 0.0, 30.0, 30.0, 30.0, 0.0, 0.0)):
            simulation.inject({"bv": Pose(110.0 + k, y, 0.0, 10.0 - 0.3 * k)})
            simulation.step()
            for _ in range(2):  # however often it is read
                state = simulation.state(simulation.read(), "bv")
                assert state.speed == pytest.approx(10.0 - 0.3 * k, abs=1e-9)
            lanes.append(state.lane)
        assert lanes == ["eastbound_0"] * 2 + [""] * 3 + ["eastbound_0"] * 2


def test_a_moved_vehicle_has_the_speed_it_was_moved_with_whatever_sumo_says() -> None:
    """Seen once on the way into a junction: 7.13 m/s, 0.45 m/s2 of braking asked for, and SUMO says 0 for a step."""
    raw = {"ego": (3.0, 4.0, 90.0, 0.0, ":crossing_0_0"), "bv": (9.0, 4.0, 90.0, 5.0, "in_0")}
    correct_speeds(raw, {"ego": 7.085})
    assert raw == {"ego": (3.0, 4.0, 90.0, 7.085, ":crossing_0_0"), "bv": (9.0, 4.0, 90.0, 5.0, "in_0")}


def test_an_unplanned_left_turn_through_a_junction_is_exact(tmp_path: Path) -> None:
    spec = make_spec(tmp_path, "priority_crossing", [vehicle("bv", "west_in east_out", 1, 190.0, 8.0)])
    with running(spec) as simulation:
        for k in range(40):
            a = 0.8 * k / 14.0  # a bend of 14 m from (-12.4, -1.6) to the north
            pose = Pose(-12.4 + 14.0 * math.sin(a), -1.6 + 14.0 * (1.0 - math.cos(a)), a, 8.0)
            if a > math.pi / 2:
                pose = Pose(1.6, 12.4 + 0.8 * (k - 27), math.pi / 2, 8.0)
            simulation.inject({"bv": pose})
            simulation.step()
            state = simulation.state(simulation.read(), "bv")
            assert (state.x, state.y, state.heading) == pytest.approx((pose.x, pose.y, pose.heading), abs=1e-6)
        assert state.lane == "north_out_1"


def test_a_leader_moved_to_the_next_lane_leaves_no_ghost_behind(tmp_path: Path) -> None:
    """With --lanechange.duration the ego would stop behind a shadow in the lane that the leader has left."""
    with running(pair(tmp_path)) as simulation:
        slowest, pose = math.inf, over_the_line(0)
        for k in range(140):
            if k <= 30:
                pose = over_the_line(k)
            else:
                speed = max(8.0, pose.speed - 0.4)
                pose = Pose(pose.x + 0.1 * speed, 0.0, 0.0, speed)
            simulation.inject({"leader": pose})
            simulation.step()
            snapshot = simulation.read()
            if k > 40:
                slowest = min(slowest, snapshot.raw["ego"][3])
        ego, leader = (simulation.state(snapshot, n) for n in ("ego", "leader"))
        assert (leader.lane, leader.speed, ego.lane) == ("eastbound_1", pytest.approx(8.0), "eastbound_0")
        assert ego.x > leader.x + 20.0
        assert slowest > 10.0


def test_a_held_speed_is_kept_and_given_back(tmp_path: Path) -> None:
    with running(pair(tmp_path), 2) as simulation:
        speeds = []
        for speed in (16.6, 16.2, 15.8, None, None):
            simulation.set_speed("ego", speed)
            simulation.step()
            speeds.append(simulation.read().raw["ego"][3])
        assert speeds[:3] == pytest.approx([16.6, 16.2, 15.8])
        assert speeds[3] > 15.8


def test_a_held_speed_does_not_run_into_the_leader(tmp_path: Path) -> None:
    """What LaneSpeed promises: SUMO goes slower than asked where it must."""
    with running(pair(tmp_path)) as simulation:
        for k in range(60):
            simulation.set_speed("ego", 17.0)
            simulation.set_speed("leader", max(0.0, 17.0 - 0.4 * k))
            simulation.step()
            raw = simulation.read().raw
            assert raw["leader"][0] - 5.0 - raw["ego"][0] > 1.0
        assert raw["ego"][3] < 8.0


def test_another_driver_keeps_the_size_and_the_top_speed(tmp_path: Path) -> None:
    with running(pair(tmp_path)) as simulation:
        simulation.set_type("ego", "nervous")  # 4.6 m long in the file
        simulation.step()
        state = simulation.state(simulation.read(), "ego")
        assert (state.length, state.width) == (5.0, 2.0)
        simulation.fleet.sizes.clear()
        simulation.read()
        assert simulation.fleet.sizes["ego"] == (5.0, 2.0)
        assert simulation.model("ego").tau == 1.0
        assert simulation.vehicle_class("ego") == "passenger"


def test_a_vehicle_is_inserted_with_its_own_route(tmp_path: Path) -> None:
    depart = {"depart": "now", "departLane": "2", "departPos": "50", "departSpeed": "9"}
    with running(pair(tmp_path)) as simulation:
        simulation.add("new", ["eastbound"], "calm", depart)
        simulation.step()
        new = simulation.state(simulation.read(), "new")
        assert (new.x, new.y, new.speed) == pytest.approx((47.5, 3.2, 9.0))
        assert simulation.expected() == 3
        with pytest.raises(SimulationError, match="could not insert vehicle 'lost'"):
            simulation.add("lost", ["nowhere"], "calm", depart)


def test_a_traffic_light_ahead_is_seen_with_its_distance(tmp_path: Path) -> None:
    spec = make_spec(tmp_path, "signalised_crossing", [vehicle("ego", "west_in east_out", 0, 50.0, 10.0)])
    with running(spec) as simulation:
        ((_, distance, letter),) = simulation.signals("ego")
        assert 50.0 < distance < 220.0
        assert letter in "rRyYgG"


# ---- one simulation, again and again


def test_a_second_simulation_is_refused_until_the_first_is_closed(tmp_path: Path) -> None:
    spec = pair(tmp_path)
    with (
        running(spec),
        pytest.raises(SimulationError, match="A simulation already runs in this process; close it first"),
    ):
        Simulation(spec)
    with running(spec, 5) as second:
        assert second.time == 0.5


def test_a_simulation_that_is_over_does_not_end_the_next_one(tmp_path: Path) -> None:
    first = Simulation(pair(tmp_path))
    first.close()
    with running(pair(tmp_path)) as second:
        first.close()
        second.step()
        assert second.time == 0.2
        with pytest.raises(SimulationError, match="already runs"):
            Simulation(pair(tmp_path))


def test_after_a_refusal_the_next_simulation_starts(tmp_path: Path) -> None:
    missing = SimulationSpec(tmp_path / "missing.net.xml", (), (), 0.0, 1)
    with pytest.raises(SimulationError, match="SUMO refused to start"):
        Simulation(missing)
    with running(pair(tmp_path)) as simulation:
        assert "ego" in simulation.read().raw


def test_loaded_again_the_same_commands_give_the_same_states(tmp_path: Path) -> None:
    cars = [vehicle(f"car{k}", "eastbound", k % 3, 60.0 + 12.0 * k, 12.0, "nervous") for k in range(8)]
    spec = make_spec(tmp_path, "straight_3lane", [*cars, vehicle("leader", "eastbound", 0, 200.0, 12.0)], seed=7)

    def story(simulation: Simulation) -> list[Snapshot]:
        seen = []
        for k in range(60):
            if k >= 20:
                simulation.inject({"leader": over_the_line(k - 20, 215.0)})
            simulation.step()
            seen.append(simulation.read())
        return seen

    with running(spec, 0) as simulation:
        first = story(simulation)
        simulation.reload()
        assert simulation.time == 0.0
        assert story(simulation) == first
    assert len({s.raw["car3"][3] for s in first}) > 20  # it is not as calm as that by itself


def test_a_step_without_a_simulation_fails_in_our_words(tmp_path: Path) -> None:
    with running(pair(tmp_path)) as simulation:
        pass
    with pytest.raises(SimulationError, match=r"^SUMO failed in a step \(.*\)\.$"):
        simulation.step()


def test_a_vehicle_is_moved_before_it_was_ever_read(tmp_path: Path) -> None:
    with running(pair(tmp_path), 0) as simulation:
        simulation.step()
        simulation.inject({"ego": Pose(300.0, 0.0, 0.0, 5.0)})
        simulation.step()
        assert simulation.state(simulation.read(), "ego").x == pytest.approx(300.0)


@pytest.mark.parametrize("name", ["nobody", "gone"])
def test_a_vehicle_that_is_not_there_cannot_be_moved(tmp_path: Path, name: str) -> None:
    spec = make_spec(tmp_path, "straight_3lane", [vehicle("gone", "eastbound", 0, 1195.0, 20.0)])
    with running(spec, 6) as simulation:
        assert simulation.read().raw == {}
        with pytest.raises(SimulationError, match=f"SUMO could not move vehicle '{name}'"):
            simulation.inject({name: Pose(100.0, 0.0, 0.0, 10.0)})


# ---- recordings


def test_snapshots_become_tracks_of_box_centres() -> None:
    snapshots = [
        Snapshot(5.0, {"bus": (10.0, 20.0, 0.0, 10.0, "a_0")}),
        Snapshot(5.1, {"bus": (10.0, 21.0, 0.0, 10.5, "a_0"), "car": (0.0, 0.0, 225.0, 3.0, "")}),
    ]
    sizes = {"bus": (12.0, 2.5), "car": (4.0, 1.8)}
    bus, car = tracks_of(snapshots, sizes, {"bus": Role.EGO}, 0.1)
    assert (bus.id, bus.role, car.role) == ("bus", Role.EGO, Role.BACKGROUND)
    assert bus.y == pytest.approx([14.0, 15.0])  # north: 6 m behind the bumper
    assert bus.heading == pytest.approx([math.pi / 2] * 2)
    assert bus.acceleration == pytest.approx([0.0, 5.0])
    assert (bus.length, bus.lane, car.lane) == (12.0, ("a_0", "a_0"), ("",))
    assert (float(car.x[0]), float(car.y[0])) == pytest.approx((math.sqrt(2.0), math.sqrt(2.0)))  # bound southwest
    assert car.time.tolist() == [5.1]
    (only,) = tracks_of(snapshots, sizes, {}, 0.1, ["car"])
    assert only.id == "car"
    assert np.isfinite(only.x).all()


def test_a_held_speed_brakes_no_harder_than_in_an_emergency(tmp_path: Path) -> None:
    """From 17 m/s with 9 m/s2 at most, asked for a standstill or behind a vehicle that is suddenly there; then it is
    SUMO's again, with the 4.5 m/s2 of its type."""
    for speed in (0.0, 17.0):
        with running(pair(tmp_path)) as simulation:
            own = simulation.model("ego").deceleration
            if speed:
                simulation.set_speed("leader", 0.0)
                for _ in range(12):
                    simulation.step()
            speeds = [simulation.read().raw["ego"][3]]
            for _ in range(10):
                simulation.set_speed("ego", speed)
                simulation.step()
                speeds.append(simulation.read().raw["ego"][3])
            steps = [a - b for a, b in itertools.pairwise(speeds)]
            assert max(steps) <= 0.9 + 1e-6
            assert max(steps) > (0.89 if not speed else 0.5)  # more than its own 0.45
            assert simulation.model("ego").deceleration == own == pytest.approx(4.5)
            simulation.set_speed("ego", None)
            simulation.step()
            assert simulation.model("ego").deceleration == own
