"""The lattice driver: stories on a straight road worked out by hand, and drives in SUMO."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_samples import Program

from sumo_adv.datatypes import Boxes, VehicleState
from sumo_adv.drivers import LatticeEgo, Observation, Steer, apply_steer, make_ego
from sumo_adv.drivers.lattice import Expected, LatticeEgos, LatticeSettings, Size
from sumo_adv.drivers.lattice_candidates import Space, choose, lateral_candidates
from sumo_adv.drivers.lattice_frame import RoadFrame, VehicleHistory, expect, others_on
from sumo_adv.drivers.protocol import Road, StopLine, wishes_of
from sumo_adv.episode.drive import Drive, ego_type_file
from sumo_adv.episode.right_of_way import Meetings
from sumo_adv.episode.surroundings import Surroundings
from sumo_adv.errors import UsageError
from sumo_adv.metrics.boxes import first_contact, on_grid, overlaps
from sumo_adv.simulation.forks import in_forks
from sumo_adv.simulation.network import read_network
from sumo_adv.simulation.scenario import load_scenario
from sumo_adv.simulation.simulation_spec import SimulationSpec

ROOT = Path(__file__).resolve().parent.parent
STRAIGHT = [(float(x), 0.0) for x in range(400)]
ALONE = Road(limit=15.0)  # one lane, 3.2 m wide
TWO_LANES = Road(limit=20.0, sides=(3.2,), until=400.0)


def car(id: str, x: float, y: float = 0.0, speed: float = 0.0, heading: float = 0.0) -> VehicleState:
    return VehicleState(id, x, y, heading, speed, 0.0, 5.0, 2.0, "")


def drive(
    ego: LatticeEgo, me: VehicleState, others: Sequence[VehicleState], road: Road, steps: int, start: int = 0
) -> list[VehicleState]:
    """Its states, steps of 0.1 s; the others go straight on."""
    states = [me]
    for step in range(start, start + steps):
        moved = [replace(o, x=o.x + o.speed * math.cos(o.heading) * step / 10) for o in others]
        action = ego.act(Observation(step / 10, 0.1, states[-1], moved, path=STRAIGHT, road=road))
        assert isinstance(action, Steer)
        states.append(apply_steer(states[-1], action, 0.1))
    return states


# ---- alone and behind others


def test_on_an_empty_road_it_holds_its_lane_and_its_speed() -> None:
    states = drive(LatticeEgo(), car("ego", 5.0, speed=15.0), [], ALONE, 100)
    assert max(abs(s.y) for s in states) < 0.05
    assert all(s.speed == pytest.approx(15.0, abs=0.05) for s in states)
    assert states[-1].x == pytest.approx(155.0, abs=0.5)


def test_it_takes_up_speed_and_finds_the_lanes_centre() -> None:
    states = drive(LatticeEgo(), car("ego", 5.0, 0.5, speed=8.0), [], ALONE, 120)
    assert states[-1].speed == pytest.approx(15.0, abs=0.5)
    assert max(s.acceleration for s in states) <= 2.6 + 1e-6  # IDM's
    assert states[-1].y == pytest.approx(0.0, abs=0.05)
    assert min(s.y for s in states) > -0.1


def test_it_stops_behind_a_standing_car() -> None:
    states = drive(LatticeEgo(), car("ego", 5.0, speed=14.0), [car("queue", 90.0)], TWO_LANES, 200)
    gap = 90.0 - states[-1].x - 5.0
    assert states[-1].speed < 0.1
    assert 1.5 < gap < 4.0  # IDM's gap at standstill is 2.5 m
    assert min(s.acceleration for s in states) > -5.0  # 14^2 / (2 * 77.5) = 1.3 m/s2 on average
    assert max(abs(s.y) for s in states) < 0.3


def test_it_follows_at_idms_gap() -> None:
    states = drive(LatticeEgo(), car("ego", 5.0, speed=10.0), [car("leader", 40.0, speed=10.0)], ALONE, 250)
    gap = 40.0 + 10.0 * 25.0 - states[-1].x - 5.0
    target = (2.5 + 10.0) / math.sqrt(1 - (10 / 15) ** 4)  # 13.95 m
    assert gap == pytest.approx(target, abs=1.0)


# ---- in an emergency


def touching(a: VehicleState, b: VehicleState) -> bool:
    first, second = (Boxes(*(np.array(v) for v in (s.x, s.y, s.heading, s.speed)), s.length, s.width) for s in (a, b))
    return bool(overlaps(first, second))


def touched(states: Sequence[VehicleState], obstacle: VehicleState) -> bool:
    return any(touching(s, obstacle) for s in states)


def test_it_swerves_where_braking_cannot_do() -> None:
    # the box ahead begins 20 m in front and reaches to y = 0; 20^2 / (2 * 9) = 22.2 m to stop with the best of brakes
    box = car("box", 30.0, -1.0)
    me = car("ego", 5.0, speed=20.0)
    braked = [me]
    for _ in range(25):
        braked.append(apply_steer(braked[-1], Steer(-9.0, 0.0), 0.1))
    assert touched(braked, box)
    states = drive(LatticeEgo(), me, [box], TWO_LANES, 40)
    assert not touched(states, box)
    assert max(s.y for s in states) > 1.0  # half of both widths is 2 m, the box is 1 m aside
    assert max(s.y for s in states) < 3.8  # the other lane's centre is at 3.2 m
    assert states[-1].x > 35.0


def test_it_does_not_leave_the_road() -> None:
    # the same box, but no lane beside: 1.6 m - 1 m leave 0.6 m to either side, too little
    box = car("box", 30.0, -1.0)
    states = drive(LatticeEgo(), car("ego", 5.0, speed=20.0), [box], replace(TWO_LANES, sides=()), 11)
    assert max(abs(s.y) for s in states) < 0.75
    assert min(s.acceleration for s in states) == pytest.approx(-8.0)  # it brakes as hard as it can
    before = [s for s in states if s.x < 25.0]
    assert before[-1].speed < 20.0 - 4.0  # over the 20 m, which it runs in little over 1 s


def test_an_occupied_lane_beside_is_no_way_out() -> None:
    box, beside = car("box", 30.0, -1.0), car("beside", 4.0, 3.2, speed=20.0)
    states = drive(LatticeEgo(), car("ego", 5.0, speed=20.0), [box, beside], TWO_LANES, 9)
    paired = zip(states, range(10), strict=True)
    assert not any(touching(s, replace(beside, x=4.0 + 2.0 * k)) for s, k in paired)


# ---- lights and right of way, as the engine tells them


def test_held_at_a_line_it_waits_and_then_goes() -> None:
    ego = LatticeEgo()
    waited = drive(ego, car("ego", 5.0), [], replace(ALONE, stop_lines=(StopLine(5.0, None, "yield", True),)), 20)
    assert waited[-1].x == 5.0
    gone = drive(ego, waited[-1], [], ALONE, 30, start=20)
    assert gone[-1].speed > 5.0


def test_it_takes_sumos_advice_to_be_slower() -> None:
    ego, state = LatticeEgo(), car("ego", 5.0, speed=15.0)
    drive(ego, state, [], ALONE, 1)
    seen = Observation(0.1, 0.1, state, [], path=STRAIGHT, road=replace(ALONE, advised=14.7))
    action = ego.act(seen)
    assert isinstance(action, Steer)
    assert action.acceleration == pytest.approx(-3.0)  # 0.3 m/s in 0.1 s


def test_at_its_routes_end_sumo_takes_over() -> None:
    seen = Observation(0.0, 0.1, car("ego", 5.0, speed=10.0), [], path=STRAIGHT, road=replace(ALONE, leaves=True))
    assert LatticeEgo().act(seen) is None
    assert LatticeEgo().act(replace(seen, path=None, road=ALONE)) is None  # nor does it know a path


# ---- parts


def at(x: float, speed: float) -> LatticeEgos:
    """One ego on the centre of its path, its wheel straight."""
    return LatticeEgos(np.array([x]), np.zeros(1), np.array([speed]), *(np.zeros(1) for _ in range(5)))


def expected(x: float, speed: float, others: Sequence[VehicleState], times: Sequence[float]) -> Expected:
    """Where an ego on the straight road expects other vehicles that it sees for the first time."""
    frame = RoadFrame(STRAIGHT)
    placed = others_on(frame, car("ego", x, speed=speed), others, VehicleHistory().look(0.0, others))
    return expect(placed, at(x, speed), Size(5.0, 2.0), np.array(times), frame.project)


def test_a_quintic_by_hand() -> None:
    # 2 m in 2 s: half way there at 1 s with 15/8 of the mean rate of 1 m/s; integral of jerk^2 = 720 * 4 / 32 = 90
    moves = lateral_candidates(at(0.0, 10.0), np.array([2.0]), np.array([0.0, 1.0, 2.0, 3.0]))
    k = int(np.flatnonzero(moves.duration[0] == 2.0)[0])
    assert moves.d[0, k] == pytest.approx([0.0, 1.0, 2.0, 2.0])
    assert moves.rate[0, k] == pytest.approx([0.0, 1.875, 0.0, 0.0], abs=1e-9)
    assert moves.jerk[0, k] == pytest.approx(90.0)


def test_crossing_cars_that_can_still_stop_short_are_left_to_right_of_way() -> None:
    # 12 m/s needs 144 / 6 = 24 m; from y = -28 its front has 28 - 2.5 - 1 = 24.5 m to the ego's side
    able, late = (car("bv", 33.0, y, 12.0, math.pi / 2) for y in (-28.0, -27.0))
    boxes = expected(5.0, 14.0, [able, late], (0.0, 1.0, 2.0))
    assert np.isinf(boxes.s[0, 0]).all()
    assert boxes.s[0, 1] == pytest.approx([33.0, 33.0, 33.0])
    assert boxes.d[0, 1] == pytest.approx([-27.0, -15.0, -3.0])
    assert boxes.half_s[0, 1] == pytest.approx([1.0, 1.0, 1.0])  # across: its width lies along the path


def test_followers_are_left_to_their_drivers() -> None:
    behind, beside = car("behind", 40.0, speed=20.0), car("beside", 40.0, 3.2, speed=20.0)
    boxes = expected(50.0, 14.0, [behind, beside], (0.0, 1.0))
    assert np.isinf(boxes.s[0, 0]).all()
    assert boxes.d[0, 1] == pytest.approx([3.2, 3.2])
    assert boxes.s[0, 1] == pytest.approx([40.0, 60.0])


def test_egos_choose_together_as_each_chooses_alone() -> None:
    """At 20 m/s, with a free lane on the left, 20 m before a box in the lane, one on its right edge, and none."""
    settings, size = LatticeSettings(), Size(5.0, 2.0)
    parked = car("parked", 30.0, -9.0)
    seen = [expected(5.0, 20.0, [parked, car("box", 30.0, y)], settings.times) for y in (0.0, -1.9, -60.0)]

    def chosen(others: Expected) -> list[list[float]]:
        n = len(others.s)
        egos = LatticeEgos(*(np.repeat(q, n) for q in at(5.0, 20.0)))
        space = Space.between(np.full(n, 1.6), [(3.2,)] * n, np.full(n, 400.0), size.width)
        keep = np.zeros((n, len(settings.times)))
        best = choose(egos, size, keep, np.full(n, 20.0), others, space, settings, 0.1)
        return np.stack([best.acceleration, best.second, best.target, best.duration], axis=1).tolist()

    together = chosen(Expected(*(np.concatenate(q) for q in zip(*seen, strict=True))))
    assert together == [chosen(others)[0] for others in seen]
    assert [target for _, _, target, _ in together] == [3.2, 0.5, 0.0]


def test_wrong_settings_are_named() -> None:
    with pytest.raises(UsageError, match=r"'lattice' needs 'braking' to be a number from 0\.5 to 20"):
        make_ego("lattice", {"braking": "hard"})
    with pytest.raises(UsageError, match="no parameter 'swerve'; it knows tau"):
        make_ego("lattice", {"swerve": 1})
    with pytest.raises(UsageError, match="'lattice' needs 'visible_only' to be true or false, not 1"):
        make_ego("lattice", {"visible_only": 1})
    assert make_ego("lattice", {"horizon": 3.0, "tau": 1.5}).sumo_type["tau"] == "1.5"
    tables: list[dict[str, Any]] = [{}, {"visible_only": True}]
    assert [wishes_of(make_ego("lattice", table)).visible_only for table in tables] == [False, True]


# ---- the same again


def test_same_motion_again_and_after_a_fork() -> None:
    me, box = car("ego", 5.0, speed=20.0), car("box", 60.0, -1.0)
    first = drive(LatticeEgo(), me, [box], TWO_LANES, 40)
    ego = LatticeEgo()
    half = drive(ego, me, [box], TWO_LANES, 20)
    assert half == first[:21]
    rest = in_forks([lambda: drive(ego, half[-1], [box], TWO_LANES, 20, start=20)] * 2)
    assert rest == [first[20:]] * 2
    ego.reset(1)
    assert drive(ego, me, [box], TWO_LANES, 40) == first


def test_forked_and_loaded_attempts_are_the_same(program: Program) -> None:
    scenario = str(ROOT / "scenarios" / "leader_two_lanes.toml")
    for name, options in (("forked", ()), ("loaded", ("--no-fork",))):
        same = ("--ego", "lattice", "--attempts", "2", "--learn", "off")  # the second one knows no more than the first
        done = program.here("run", scenario, *same, "--out", name, "--json", *options)
        assert done.status == 0, done.err
    for file in ("states.csv.gz", "raw.csv.gz", "criticality.csv.gz"):
        assert (program.folder / "forked" / file).read_bytes() == (program.folder / "loaded" / file).read_bytes()


# ---- inside SUMO


def test_through_a_roundabout_it_gives_way_stays_on_the_road_and_arrives(tmp_path: Path) -> None:
    scenario = load_scenario(ROOT / "scenarios" / "roundabout_entry.toml")
    ego, road = LatticeEgo(), read_network(scenario.network)
    files = tuple(scenario.demand.files)
    drive = Drive(SimulationSpec(scenario.network, files, (ego_type_file(ego, tmp_path),), 0.0, 0), ego, 0)
    drive.observe = Surroundings(road, Meetings(road), drive)
    try:
        for _ in range(600):
            snapshot = drive.tick()
            if drive.ego is None and "ego" in snapshot.raw:
                drive.take_over("ego")
            elif drive.ego is not None and "ego" not in snapshot.raw:
                break
    finally:
        drive.simulation.close()
    tracks = {t.id: t for t in drive.tracks() if len(t.time) > 1}
    me = tracks.pop("ego")
    assert me.lane[-1] == "north_out_0"
    assert me.speed.min() < 7.0  # it slowed down to enter
    grid = me.time
    assert not np.isfinite(first_contact(on_grid([me], grid), on_grid(list(tracks.values()), grid), grid)).any()
    drivable = road.drivable(0.0, 0.0, 300.0)
    assert drivable(me.x, me.y).all()
