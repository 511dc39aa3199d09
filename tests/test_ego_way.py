"""The ego's own moves, and the stretches on which it sees less far: by hand, in SUMO, and in whole runs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from cli_samples import Program, position, read_states
from metrics_tracks import DT, TIME, cruise
from pydantic import ValidationError
from road_samples import drive as drive_of
from road_samples import steps
from sumo_samples import make_spec, vehicle, write
from test_reference_drivers import row

from sumo_adv.datatypes import VehicleState
from sumo_adv.drivers import LaneSpeed, Observation, SumoEgo
from sumo_adv.drivers.careful import CarefulEgo
from sumo_adv.ego_way import EgoMove, SightStretch
from sumo_adv.episode.drive import Drive, ego_type_file
from sumo_adv.episode.ego_way import EgoWay
from sumo_adv.errors import UsageError
from sumo_adv.metrics.reference import BRAKERS
from sumo_adv.metrics.reference.counterfactual import Counterfactual, Encounters
from sumo_adv.metrics.reference.sight import SightLimits, in_reach, path_through
from sumo_adv.simulation.network import read_network
from sumo_adv.simulation.scenario import load_scenario
from sumo_adv.simulation.simulation_spec import SimulationSpec

CREST = SightStretch.model_validate({"from": 30.0, "to": 90.0, "limit": 20.0})


@contextmanager
def way(
    folder: Path, *moves: EgoMove, driver: SumoEgo | CarefulEgo | None = None, ego: str = "", network: str = "",
    sight: tuple[SightStretch, ...] = (), others: Iterable[str] = (),
) -> Iterator[Drive]:  # fmt: skip
    """A drive with its ego at 15 m/s and 20 m in the right one of three lanes, unless ``ego`` is another vehicle."""
    controller = driver or SumoEgo("idm", {})
    ego = ego or vehicle("ego", "eastbound", 0, 20.0, 15.0)
    base = make_spec(folder, network or "straight_3lane", [ego, *others])
    spec = SimulationSpec(base.network, base.routes, (ego_type_file(controller, folder, base.routes),), 0.0, 3)
    moving = Drive(spec, controller, 3)
    moving.way = EgoWay(read_network(spec.network), moves, sight)
    try:
        moving.tick()
        moving.take_over("ego")
        yield moving
    finally:
        moving.simulation.close()


def driven(drive: Drive, count: int) -> tuple[list[float], list[float], list[str]]:
    """How far the ego's front has come [m], its speed [m/s] and its lane, in each of so many steps."""
    states = [drive.tick().raw["ego"] for _ in range(count)]
    return [s[0] - 20.0 for s in states], [s[3] for s in states], [s[4] for s in states]


# ---- what can be demanded


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"does": "turn_left", "at": 5}, "has its place from the route"),
        ({"does": "stop", "seconds": 2}, "needs either at or time"),
        ({"does": "change_left", "at": 5, "time": 2}, "needs either at or time"),
        ({"does": "stop", "at": 5}, "stop needs seconds"),
        ({"does": "change_left", "at": 5, "speed": 2}, "speed belongs to speed"),
    ],
)
def test_a_move_needs_what_belongs_to_it(given: dict[str, object], says: str) -> None:
    with pytest.raises(ValidationError, match=says):
        EgoMove.model_validate(given)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('[[sight]]\nfrom = 1\nto = 9\nlimit = 5\n', "sight needs an ego with an id or a route"),
        ('[ego]\nid = "a"\n[[moves]]\ndoes = "turn_left"\nattacked = true\n'
         '[[moves]]\ndoes = "turn_right"\nattacked = true\n', "only one of the moves can be attacked"),
        ('[ego]\nid = "a"\n[[sight]]\nfrom = 9\nto = 9\nlimit = 5\n', "to must be greater than from"),
        ('[ego]\nid = "a"\n[[moves]]\ndoes = "stop"\nwhere = 9\n', "known keys there are does, at, time"),
    ],
)  # fmt: skip
def test_a_scenario_says_what_is_wrong_with_its_moves(tmp_path: Path, text: str, says: str) -> None:
    file = write(tmp_path / "a.toml", f'schema = 1\nnetwork = "straight_3lane"\n{text}')
    with pytest.raises(UsageError, match=says):
        load_scenario(file)


@pytest.mark.parametrize(
    ("move", "says"),
    [
        (EgoMove(does="turn_left"), "makes no turn for its move 1, turn_left"),
        (EgoMove(does="stop", at=1300, seconds=1), r"move 1, stop at 1300 m, is behind the end of its way \(1180 m\)"),
    ],
)
def test_a_move_that_the_route_does_not_have_is_refused(tmp_path: Path, move: EgoMove, says: str) -> None:
    with way(tmp_path, move) as drive, pytest.raises(UsageError, match=says):
        drive.tick()


def test_a_change_of_lanes_needs_a_second_lane(tmp_path: Path) -> None:
    ego = vehicle("ego", "eastbound", 0, 20.0, 15.0)
    with (
        way(tmp_path, EgoMove(does="change_left", at=50), ego=ego, network="two_way") as drive,
        pytest.raises(UsageError, match="needs a second lane, which 'eastbound' does not have"),
    ):
        drive.tick()


# ---- SUMO carries them out


def test_sumos_driver_changes_lanes_at_the_place_and_stays_there(tmp_path: Path) -> None:
    with way(tmp_path, EgoMove(does="change_left", at=100)) as drive:
        come, _, lanes = driven(drive, 300)
    first = lanes.index("eastbound_1")
    assert 100.0 < come[first] < 150.0  # 1.6 m to the side take some 2 s, at 20 m/s
    assert set(lanes[:first]) == {"eastbound_0"} and set(lanes[first:]) == {"eastbound_1"}
    with way(tmp_path) as drive:
        assert set(driven(drive, 300)[2]) == {"eastbound_0"}


@pytest.mark.parametrize("driver", [SumoEgo("idm", {}), SumoEgo("krauss", {}), CarefulEgo()])
def test_it_stops_at_the_place_for_so_long(tmp_path: Path, driver: SumoEgo | CarefulEgo) -> None:
    with way(tmp_path, EgoMove(does="stop", at=100, seconds=3), driver=driver) as drive:
        come, speed, _ = driven(drive, 200)
    stands = [k for k, v in enumerate(speed) if v < 0.1]
    assert come[stands[0]] == pytest.approx(100.0, abs=0.2)
    assert 3.0 <= 0.1 * len(stands) <= 3.3 and stands[-1] - stands[0] == len(stands) - 1
    assert min(np.diff(speed)) / 0.1 > -4.0  # m/s2: 2 m/s2, but for the first and the last step
    assert speed[-1] > 5.0


def test_a_stop_at_a_time_begins_then(tmp_path: Path) -> None:
    """It slows down at 2 m/s2 from the speed of 4 s."""
    with way(tmp_path, EgoMove(does="stop", time=4, seconds=1)) as drive:
        _, speed, _ = driven(drive, 160)
    assert speed[38] > speed[37] and speed[40] < speed[39]  # the first step ends at 0.2 s
    lasts = 0.1 * (next(k for k, v in enumerate(speed) if v < 0.1) - 38)
    assert lasts == pytest.approx(speed[38] / 2.0, abs=0.3)


def test_a_speed_holds_until_the_next_one(tmp_path: Path) -> None:
    moves = EgoMove(does="speed", at=50, speed=8), EgoMove(does="speed", at=250, speed=12)
    with way(tmp_path, *moves) as drive:
        come, speed, _ = driven(drive, 500)
    assert {round(v, 1) for s, v in zip(come, speed, strict=True) if 180 < s < 250} == {8.0}
    assert min(np.diff(speed)) / 0.1 > -2.5
    assert speed[-1] == pytest.approx(12.0, abs=0.1)


def test_the_same_moves_follow_after_loading_again(tmp_path: Path) -> None:
    moves = EgoMove(does="stop", at=60, seconds=1), EgoMove(does="change_left", at=80)
    with way(tmp_path, *moves) as drive:
        road = drive.way.road if drive.way is not None else read_network(drive.simulation.spec.network)
        driven(drive, 200)
        first = [s.raw for s in drive.recording.snapshots]
        drive.on_load = lambda: setattr(drive, "way", EgoWay(road, moves, ()))
        drive.rewind(201)
        assert [s.raw for s in drive.recording.snapshots] == first


# ---- a driver of its own reads them


def test_a_driver_reads_lane_and_speed_and_may_follow_them(tmp_path: Path) -> None:
    """It changes lanes where it is told to; at 20 m it is to slow down from 15 to 10 m/s, at 2 m/s2."""

    def look(seen: Observation) -> tuple[int | None, float | None]:
        return seen.wanted_lane, seen.wanted_speed

    def answer(seen: Observation) -> LaneSpeed:
        return LaneSpeed(seen.wanted_lane, 15.0 if seen.wanted_speed is None else seen.wanted_speed)

    moves = EgoMove(does="speed", at=20, speed=10), EgoMove(does="change_left", at=100)
    ego = vehicle("ego", "eastbound", 0, 20.0, 15.0)
    with drive_of(tmp_path, "straight_3lane", [ego], look, answer) as (moving, watcher):
        moving.way = EgoWay(read_network(moving.simulation.spec.network), moves, ())
        steps(moving, 200)
        lane = moving.snapshot.raw["ego"][4]
    lanes, speeds = zip(*watcher.kept, strict=True)
    assert lane == "eastbound_1"
    assert speeds[0] is None and speeds[-1] == 10.0
    falls = [v for v in speeds if v is not None]
    assert falls[0] == 15.0 and falls[10] == pytest.approx(13.0)
    assert set(lanes) == {None, 1} and lanes[-1] is None


def test_sumo_leaves_a_driver_alone_that_does_not_follow(tmp_path: Path) -> None:
    moves = EgoMove(does="speed", at=20, speed=10), EgoMove(does="change_left", at=100)
    ego = vehicle("ego", "eastbound", 0, 20.0, 15.0)
    answer = LaneSpeed(None, 15.0)
    with drive_of(tmp_path, "straight_3lane", [ego], lambda _: None, lambda _: answer) as (moving, _):
        moving.way = EgoWay(read_network(moving.simulation.spec.network), moves, ())
        steps(moving, 200)
        assert moving.snapshot.raw["ego"][3:] == (15.0, "eastbound_0")


# ---- when an encounter may begin


def test_an_encounter_waits_for_the_move(tmp_path: Path) -> None:
    """At 15 m/s, 4 s before 100 m is at 40 m."""
    ego = vehicle("ego", "eastbound", 0, 20.0, 15.0)
    answer = LaneSpeed(None, 15.0)
    with drive_of(tmp_path, "straight_3lane", [ego], lambda _: None, lambda _: answer) as (moving, _):
        moving.way = EgoWay(
            read_network(moving.simulation.spec.network), [EgoMove(does="change_left", at=100, attacked=True)], ()
        )
        steps(moving, 1)
        waits = []
        while moving.snapshot.raw["ego"][0] < 100.0:
            waits.append((moving.snapshot.raw["ego"][0] - 20.0, moving.way.awaits_move(moving)))
            moving.tick()
    assert all(awaits == (come < 40.0 - 1e-6) for come, awaits in waits)


def test_a_turn_has_the_place_of_its_junction(tmp_path: Path) -> None:
    """The stop line of ``west_in`` lies 220 m after its beginning, about; the ego comes from 20 m on."""
    ego = vehicle("ego", "west_in north_out", 1, 20.0, 10.0)
    move = EgoMove(does="turn_left", attacked=True)
    with way(tmp_path, move, ego=ego, network="priority_crossing") as drive:
        length = read_network(drive.simulation.spec.network).lanes["west_in_1"].length
        while drive.way is not None and drive.way.awaits_move(drive):
            _, _, _, speed, lane = drive.tick().raw["ego"]
        assert drive.way is not None and lane == "west_in_1"
        assert length - 20.0 - drive.way.come == pytest.approx(4.0 * speed, abs=1.5)


# ---- how far it sees


def test_what_is_beyond_the_limit_is_not_in_reach() -> None:
    """Boxes of 5 m: from x = 10 the near end of the one at 32 is 19.5 m away, of that at 33 it is 20.5 m."""
    path = path_through([(float(x), 0.0) for x in range(60)])
    ego, *others = (state(x) for x in (10.0, 32.0, 33.0, 2.0, 300.0))
    assert in_reach(path, ego, others, 20.0).tolist() == [True, False, True, False]
    assert in_reach(path, ego, others, math.inf).all()


def state(x: float) -> VehicleState:
    return VehicleState(f"{x}", x, 0.0, 0.0, 0.0, 0.0, 5.0, 2.0, "")


def test_limits_follow_the_track() -> None:
    """At 10 m/s, from 10 m at 0 s: 30 m are reached at 2 s, 90 m at 8 s."""
    limits = SightLimits((CREST,), 0.0, 10.0).along(cruise("ego", 0.0, 0.0, 10.0))
    assert np.array_equal(np.isfinite(limits), (TIME >= 2.0 - 1e-6) & (TIME < 8.0 - 1e-6))
    later = SightLimits((CREST,), 0.0, 10.0).later(cruise("ego", 0.0, 0.0, 10.0), 3.0)
    assert (later.time, later.come) == (3.0, pytest.approx(40.0))


def test_the_careful_driver_is_alarmed_late_behind_a_crest() -> None:
    """A car stands at 100 m, its near end at 97.5 m. At 15 m/s, with 20 m of sight, it shows from 5.2 s on."""
    ego, foe = cruise("ego", 0, 0, 15), cruise("adversary", 100, 0, 0)

    def alarm(limit: float) -> tuple[float, bool]:
        sight = np.full((1, len(TIME)), limit)
        check = Counterfactual(Encounters(row(ego), row(foe), np.array([10]), np.array([60]), DT, sight=sight))
        found = check.braking(BRAKERS["cc_human"])
        return float(found.alarm[0]), bool(found.avoids[0])

    assert alarm(math.inf) == (pytest.approx(4.0), True)
    assert alarm(20.0) == (pytest.approx(5.6), False)


def test_a_driver_sees_the_crest(tmp_path: Path) -> None:
    """A car 40 m ahead at the ego's speed: out of sight from 30 m to 90 m of the ego's way."""
    vehicles = [vehicle("ego", "eastbound", 0, 20.0, 15.0), vehicle("leader", "eastbound", 0, 60.0, 15.0)]

    def look(seen: Observation) -> tuple[float, float, Sequence[str]]:
        return seen.ego.x - 17.5, seen.sight, [other.id for other in seen.others]

    answer = LaneSpeed(None, 15.0)
    more = {"visible_only": True}
    with drive_of(tmp_path, "straight_3lane", vehicles, look, lambda _: answer, **more) as (moving, watcher):
        moving.way = EgoWay(read_network(moving.simulation.spec.network), (), (CREST,))
        steps(moving, 80)
    for come, sight, others in watcher.kept:
        hidden = 30.0 <= come < 90.0
        assert (sight, others) == ((20.0, []) if hidden else (math.inf, ["leader"])), come


# ---- whole runs

DEMAND = f"""<routes><vType id="calm" carFollowModel="Krauss" sigma="0" maxSpeed="15" lcSpeedGain="0" lcKeepRight="0"
  lcStrategic="0" lcCooperative="0"/>
  {vehicle("bv", "eastbound", 2, 75.0, 15.0)}{vehicle("ego", "eastbound", 0, 60.0, 15.0)}</routes>"""
SCENARIO = """schema = 1
network = "straight_3lane"
[demand]
files = ["a.rou.xml"]
end = 40.0
[ego]
id = "ego"
[adversary]
candidates = ["bv"]
[[moves]]
does = "change_left"
at = 150.0
attacked = true
"""


def test_a_run_attacks_as_the_ego_changes_lanes(tmp_path: Path, program: Program) -> None:
    """The ego is at its move at 10.1 s. It moves to the left with and without the attack; a replay is the same."""
    write(tmp_path / "a.rou.xml", DEMAND)
    file = write(tmp_path / "a.toml", SCENARIO)
    done = program.here("run", str(file), "--attempts", "2", "--learn", "off", "--out", "out")
    assert done.status == 0, done.out + done.err
    attacked, calm = (read_states(program.folder / "out" / f"{name}.csv.gz") for name in ("states", "raw"))
    assert 10.1 - 4.0 <= done.outcome["encounter"]["time"] <= 10.1
    for states in (attacked, calm):
        off = {t: position(r)[1] + 3.2 for t, r in states["ego"].items()}
        assert max(y for t, y in off.items() if t <= 10.1) < 0.05 < 1.0 < max(off.values())
    again = program.here("run", "--replay", "out", "--out", "again")
    assert again.status == 0, again.err
    assert read_states(program.folder / "again" / "states.csv.gz") == attacked


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("run", "a.toml", "--ego-id", "bv"), "those of its own ego: leave --ego-id out"),
        (("serve", "a.toml", "--out", "out"), "which serve does not know: take them out"),
    ],
)
def test_moves_are_those_of_the_scenarios_ego(
    tmp_path: Path, program: Program, arguments: Sequence[str], says: str
) -> None:
    write(program.folder / "a.rou.xml", DEMAND)
    write(program.folder / "a.toml", SCENARIO)
    done = program.here(*arguments)
    assert done.status == 2 and says in done.err


def test_a_run_without_an_encounter_names_the_move(tmp_path: Path, program: Program) -> None:
    """The other vehicle is 250 m ahead."""
    write(program.folder / "a.rou.xml", DEMAND.replace('departPos="75.0"', 'departPos="310.0"'))
    write(program.folder / "a.toml", SCENARIO)
    done = program.here("run", "a.toml", "--learn", "off", "--out", "out")
    assert "No encounter begins more than 4 s before the ego's move change_left at 150 m." in done.out
