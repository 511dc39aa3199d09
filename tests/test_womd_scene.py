"""From a record to a scenario: routes, tracks, parked vehicles, and the file that says it all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from womd_nets import edge, junction, link, net
from womd_samples import four_way, line, straight, track

from sumo_adv.errors import UsageError
from sumo_adv.simulation.playback_spec import scenario_playback, with_background
from sumo_adv.simulation.scan import scan_demand
from sumo_adv.simulation.scenario import load_scenario
from sumo_adv.simulation.tracks import read_tracks
from sumo_adv.womd.matching import MatchedStretch, SumoNet, match, net_graph
from sumo_adv.womd.reader import parse_record
from sumo_adv.womd.record import Record
from sumo_adv.womd.scene import Router, parked_vehicles, write_scene


def record(message: Any) -> Record:
    return parse_record(message, "a record")


def stretch(*lanes: str, steps: tuple[int, ...] = (0, 90)) -> MatchedStretch:
    return MatchedStretch(steps, (lanes[0], lanes[-1]), lanes)


def test_a_route_runs_on_to_an_end(tmp_path: Path) -> None:
    """From "in" straight on: "out" and "far", where nothing follows."""
    router = Router(junction(tmp_path))
    assert router.route([stretch("in_0")], 10) == ("in", "out", "far")
    assert router.route([stretch("in_1")], 10) == ("in", "up")  # its lane turns left
    assert router.route([stretch("in_1", "in_0", ":J_0_0", "out_0")], 10) == ("in", "out", "far")


def test_a_route_that_begins_or_ends_inside_a_junction(tmp_path: Path) -> None:
    router = Router(junction(tmp_path))
    assert router.route([stretch(":J_2_0")], 10) == ("in", "up")
    assert router.route([stretch("in_1", ":J_1_0")], 10) == ("in", "up")
    assert router.route([stretch(":J_0_0", "out_0")], 10) == ("in", "out", "far")


def test_of_a_broken_track_the_part_from_the_current_step_on_counts(tmp_path: Path) -> None:
    router = Router(junction(tmp_path))
    parts = [stretch("in_0", steps=(0, 8)), stretch("up_0", steps=(12, 60))]
    assert router.route(parts, 10) == ("up",)
    assert router.route(parts, 5)[0] == "in"
    assert router.route(parts, 80) == ("up",)
    assert router.route([], 10) == ()


def test_a_lane_change_inside_a_junction_keeps_the_route(tmp_path: Path) -> None:
    """Two ways into "c", from "a" and from "b"; the way from "a" to "d" shares its beginning with the first. Two
    changes in one junction may leave edges that do not follow: from "b" over both to "d"."""
    roads = net(
        tmp_path, edge("a", [(0, 0), (50, 0)]), edge("b", [(0, 2), (50, 2)]), edge("c", [(70, 0), (150, 0)]),
        edge("d", [(70, -4), (150, -4)]), edge(":J_0", [(50, 0), (70, 0)]), edge(":J_1", [(50, 2), (70, 0)]),
        edge(":J_2", [(50, 0), (70, -4)]), link("a_0", "c_0", ":J_0_0"), link(":J_0_0", "c_0"),
        link("b_0", "c_0", ":J_1_0"), link(":J_1_0", "c_0"), link("a_0", "d_0", ":J_2_0"), link(":J_2_0", "d_0"),
    )  # fmt: skip
    router, graph = Router(roads), net_graph(roads)
    assert [name for name, _ in graph.beside[":J_0_0"]] == [":J_2_0", ":J_1_0"]
    assert dict(graph.beside[":J_1_0"]) == {":J_0_0": pytest.approx(20.0 - 404**0.5)}  # level where they end
    whole = stretch("b_0", ":J_1_0", ":J_0_0", "c_0")
    assert router.unbroken([whole]) and router.route([whole], 10) == ("b", "c")
    torn = stretch("b_0", ":J_1_0", ":J_0_0", ":J_2_0", "d_0")
    assert not router.unbroken([torn])
    assert router.route([torn], 0) == ("b", "c") and router.route([torn], 10) == ("d",)
    assert not router.unbroken([whole, whole]) and router.unbroken([])


def two_lanes(folder: Path) -> SumoNet:
    return net(folder, edge("e", [(0, 0), (300, 0)], [(0, 3.5), (300, 3.5)]))


def test_parked_is_what_stands_on_no_lane(tmp_path: Path) -> None:
    """Beside the road, or across it; a vehicle that queues in the lane, and the ego itself, are not parked."""
    message = straight()
    track(message, 10, line((200.0, 0.4), (210.0, 0.4)), start=0.0, speed=0.0)  # queues
    track(message, 11, line((220.0, -1.0), (220.0, 8.0)), start=0.5, speed=0.0)  # stands across the lane
    assert [t.id for t in parked_vehicles(record(message), two_lanes(tmp_path))] == [4, 11]
    message.sdc_track_index = 3
    assert [t.id for t in parked_vehicles(record(message), two_lanes(tmp_path))] == [11]


def test_a_vehicle_that_was_seen_driving_or_too_briefly_is_not_parked(tmp_path: Path) -> None:
    """All are beside the road within 1 m of one place: two are seen for 9 and for 10 steps; one has a velocity of
    3 m/s, though its centre moves by only 0.5 m in 10 steps."""
    message = straight()
    for number, x, states in ((10, 150.0, 9), (11, 170.0, 10)):
        track(message, number, line((x, -3.2), (x + 10.0, -3.2)), start=0.0, speed=0.0, seen=(80, 80 + states))
    track(message, 12, line((190.0, -3.2), (200.0, -3.2)), start=0.0, speed=0.5, seen=(0, 10))
    for state in message.tracks[-1].states:
        state.velocity_x = 3.0
    assert [t.id for t in parked_vehicles(record(message), two_lanes(tmp_path))] == [4, 11]


def test_a_queuing_vehicle_may_have_a_heading_wrong_by_half_a_turn(tmp_path: Path) -> None:
    """Two vehicles face against the lane: one 0.4 m from its centre queues, one 1.2 m from it is parked."""
    message = straight()
    track(message, 10, line((210.0, 0.4), (200.0, 0.4)), start=0.0, speed=0.0)
    track(message, 11, line((230.0, -1.2), (220.0, -1.2)), start=0.0, speed=0.0)
    assert [t.id for t in parked_vehicles(record(message), two_lanes(tmp_path))] == [4, 11]


def test_a_recorded_speed_that_contradicts_the_positions_is_replaced(tmp_path: Path) -> None:
    """The leader drives at 10 m/s. Its recorded speed is 1.6 m/s at first, 35 m/s once, and 12 m/s at step 60, which is
    near enough to stay. At step 40, its position is 30 m off for one step, and its recorded speed stays."""
    message = straight()
    states = message.tracks[1].states
    for step, speed in ((0, 1.6), (1, 1.6), (20, 35.0), (60, 12.0)):
        states[step].velocity_x = speed
    states[40].center_y += 30.0
    write_scene(record(message), two_lanes(tmp_path), {}, tmp_path)
    speed = read_tracks(tmp_path / "tracks.csv.gz").tracks["2"].speed
    assert speed[[0, 1, 20, 40, 41, 60]] == pytest.approx([10.0, 10.0, 10.0, 10.0, 10.0, 12.0], abs=0.01)


def test_the_scenario_of_the_straight_road(tmp_path: Path) -> None:
    recorded, roads = record(straight()), two_lanes(tmp_path)
    graph = net_graph(roads)
    write_scene(recorded, roads, {t.id: match(graph, t) for t in recorded.tracks if t.kind == 1}, tmp_path)
    scenario = load_scenario(tmp_path / "scenario.toml")
    assert scenario.network == tmp_path / "network.net.xml" and scenario.background is None
    assert scenario.ego.id == "1" and scenario.window.warm_up == pytest.approx(1.0)
    (box,) = scenario.parked
    assert (box.x, box.y, box.heading, box.length, box.width) == (100.0, -3.2, 0.0, 4.6, 1.9)
    assert scan_demand(tmp_path / "routes.rou.xml").edges == ("e",)
    text = (tmp_path / "routes.rou.xml").read_text()
    assert text.count("<route ") == 3 and '<route id="3" edges="e"/>' in text
    assert "Objects of interest: 1, 3. Tracks to predict: 3." in (tmp_path / "scenario.toml").read_text()


def test_a_replayed_ego_goes_among_replayed_vehicles(tmp_path: Path) -> None:
    """Unless something else is asked for; any other ego goes among vehicles that SUMO drives."""
    write_scene(record(straight()), two_lanes(tmp_path), {}, tmp_path)
    spec = scenario_playback(load_scenario(tmp_path / "scenario.toml"))
    backgrounds = {
        (background, replayed): chosen.background
        for background in (None, "sumo", "log") for replayed in (False, True)
        if (chosen := with_background(spec, background, replayed=replayed)) is not None  # type: ignore[arg-type]
    }  # fmt: skip
    assert backgrounds == {
        (None, False): "sumo", (None, True): "log", ("sumo", False): "sumo", ("sumo", True): "sumo",
        ("log", False): "log", ("log", True): "log",
    }  # fmt: skip
    text = (tmp_path / "scenario.toml").read_text()
    (tmp_path / "scenario.toml").write_text(text.replace("[demand]", 'background = "sumo"\n\n[demand]'))
    from_file = with_background(scenario_playback(load_scenario(tmp_path / "scenario.toml")), None, replayed=True)
    assert from_file is not None and from_file.background == "sumo"


def test_the_tracks_of_the_straight_road(tmp_path: Path) -> None:
    """The clock begins with the record; the vehicle beside comes at 1.5 s; the parked one is no track."""
    write_scene(record(straight()), two_lanes(tmp_path), {}, tmp_path)
    log = read_tracks(tmp_path / "tracks.csv.gz")
    assert sorted(log.tracks) == ["1", "2", "3", "5"]
    assert log.time[0] == 0.0 and log.end == pytest.approx(9.0)
    assert log.first("3") == pytest.approx(1.5)
    assert [log.tracks[n].kind for n in ("1", "5")] == ["vehicle", "pedestrian"]
    ego = log.tracks["1"]
    assert (ego.x[10], ego.y[10], ego.speed[10]) == pytest.approx((32.0, 0.0, 12.0))  # 20 m + 12 m/s for 1 s
    assert (ego.length, ego.width) == (4.6, 1.9)


def test_the_same_record_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_scene(record(four_way()), junction(tmp_path), {}, tmp_path / name)
    for file in ("scenario.toml", "tracks.csv.gz", "routes.rou.xml"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_an_ego_that_comes_late_has_less_to_warm_up(tmp_path: Path) -> None:
    message = straight()
    message.sdc_track_index = 2  # first seen at step 15, the current one is 10
    write_scene(record(message), two_lanes(tmp_path), {}, tmp_path)
    assert load_scenario(tmp_path / "scenario.toml").window.warm_up == 0.0


def test_a_record_that_never_sees_its_ego_makes_no_scene(tmp_path: Path) -> None:
    unseen = straight()
    for state in unseen.tracks[0].states:
        state.valid = False
    with pytest.raises(UsageError, match="never sees its ego, track 1"):
        write_scene(record(unseen), two_lanes(tmp_path), {}, tmp_path)
