"""Adversaries on their ways: which way, which goal, and the observations of their planners."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from situation_samples import EGO_PATH, car, changed, crossing, leader, line, neighbour, situation, target

from sumo_adv.datatypes import Endpoint, Floats
from sumo_adv.geometry import Frame, Path
from sumo_adv.planners.adversary_batch import AdversaryBatch
from sumo_adv.planners.answers import planner_road
from sumo_adv.planners.trajectory import Batch, Motion, PathEndpoint, pose
from sumo_adv.situation import NO_ARRIVAL_S, Situation, Target, relate

EXAMPLES = settings(max_examples=20, deadline=None, derandomize=True)
AT_START = tuple(np.array([q]) for q in (0.0, 0.0, 10.0, 0.0))  # the ego: station, offset, speed, acceleration


def row(*values: float) -> Floats:
    return np.array(values)


def straight_on(motion: Motion) -> PathEndpoint:
    return PathEndpoint(motion.s + 30.0, motion.d, motion.v, motion.v * 0.0 + 3.0)


def observed(sit: Situation, name: str = "bv", motion: Motion | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
    batch = AdversaryBatch([sit], [name])
    return batch.observe(motion or batch.begin(), 0.0, AT_START, [None])[0]  # type: ignore[arg-type]


# ---- where ways and the ego's path meet


def test_a_path_across_meets_the_egos_at_a_right_angle() -> None:
    straight, left = crossing().ways
    assert straight.conflict is not None
    c = straight.conflict
    assert (c.kind, c.movement) == ("crossing", "straight")
    assert (c.bv_s, c.ego_s) == pytest.approx((25.0, 30.0), abs=0.5)
    assert (c.x, c.y, c.angle) == pytest.approx((30.0, 0.0, math.pi / 2), abs=0.5)
    assert left.conflict is None  # it turns 2 m before the ego's path and drives beside it


def test_a_ramp_merges_where_it_comes_within_the_lane() -> None:
    ramp = line((0.0, -20.0), (90.0, -2.0), (100.0, 0.0), (300.0, 0.0))
    result = relate(ramp, "none", math.inf, False, EGO_PATH).conflict
    assert result is not None
    assert result.kind == "merging"
    assert 93.0 < result.ego_s < 100.0  # 0.8 m aside at x = 96
    assert relate(line((20.0, 3.2), (200.0, 3.2)), "none", math.inf, False, EGO_PATH).conflict is None
    assert relate(line((20.0, 0.0), (200.0, 0.0)), "none", math.inf, False, EGO_PATH).conflict is None


def test_words_for_what_may_be_tried() -> None:
    assert crossing().applies() == ("crossing_straight",)
    assert neighbour().applies() == ("neighbour",)
    assert neighbour(speed=20.0).fastest == pytest.approx(28.0)  # 1.4 times
    assert neighbour(speed=5.0).fastest == pytest.approx(10.0)  # 5 m/s more
    behind, ahead = replace(leader(), risk=0.2), replace(neighbour(), state=car("other", 0.0, 3.2), risk=0.7)
    assert [t.state.id for t in situation([behind, ahead]).target_list()] == ["other", "bv"]


# ---- places and goals


def test_at_the_trigger_each_vehicle_is_where_the_situation_says() -> None:
    batch = AdversaryBatch([situation([neighbour()])] * 2, ["bv", "bv"])
    motion = batch.begin()
    s, d, h = batch.relative(motion)
    assert (s.tolist(), d.tolist(), h.tolist()) == ([20.0] * 2, pytest.approx([3.2] * 2), [0.0] * 2)
    assert batch.cap.tolist() == pytest.approx([17.0] * 2)  # 12 m/s + 5
    aside = motion._replace(d=row(0.0, -1.2), slope=row(0.0, -0.1), s=row(0.0, 10.25))
    s, d, h = batch.relative(aside)
    assert s == pytest.approx([20.0, 30.25])
    assert d == pytest.approx([3.2, 2.0])
    assert h[1] == pytest.approx(-math.asin(0.1))


def test_an_oncoming_car_comes_towards_the_ego() -> None:
    back = line((100.0, 3.2), (-100.0, 3.2))
    oncoming = target(car("bv", 100.0, 3.2, math.pi, 12.0), "oncoming", [(back, "none", math.inf)], EGO_PATH)
    batch = AdversaryBatch([situation([oncoming])], ["bv"])
    s, d, h = batch.relative(batch.begin()._replace(s=row(30.0), d=row(1.0)))
    assert (s[0], abs(h[0])) == pytest.approx((70.0, math.pi))
    assert d[0] == pytest.approx(2.2)  # a metre to its left, which is towards the ego


def test_an_endpoint_becomes_a_goal_on_the_way() -> None:
    batch = AdversaryBatch([situation([neighbour()])] * 2, ["bv", "bv"])
    motion = batch.begin()
    goal = batch.aim(motion, [Endpoint(60.25, 0.5, 0.0, 9.0, 2.5), None], straight_on(motion))
    assert [q[0] for q in goal] == pytest.approx([40.25, -2.7, 9.0, 2.5])
    assert [q[1] for q in goal] == pytest.approx([30.0, 0.0, 12.0, 3.0])  # no answer: as before


def test_an_endpoint_round_the_corner_chooses_the_turn_while_both_ways_are_one() -> None:
    batch = AdversaryBatch([situation([crossing()])], ["bv"])
    motion = batch.begin()
    west = Endpoint(10.0, -2.0, math.pi, 6.0, 5.0)
    batch.aim(motion, [west], straight_on(motion))
    assert batch.rows.row.tolist() == [1]
    batch.aim(motion, [Endpoint(30.0, 20.0, math.pi / 2, 9.0, 5.0)], straight_on(motion))
    assert batch.rows.row.tolist() == [0]
    across = motion._replace(s=row(35.0))  # 10 m north of the ego's path the turn is behind it
    batch.aim(across, [west], straight_on(across))
    assert batch.rows.row.tolist() == [0]


def test_the_way_is_chosen_for_each_vehicle_by_itself() -> None:
    batch = AdversaryBatch([situation([crossing()])] * 2, ["bv", "bv"])
    motion = batch.begin()
    ends = [Endpoint(30.0, 20.0, math.pi / 2, 9.0, 5.0), Endpoint(10.0, -2.0, math.pi, 6.0, 5.0)]
    goal = batch.aim(motion, ends, straight_on(motion))
    assert batch.rows.row.tolist() == [0, 1]
    assert goal.s[0] == pytest.approx(45.0)
    x, y, h = pose(Batch, motion._replace(s=goal.s, d=goal.d), batch.rows)
    assert (x[1], y[1]) == pytest.approx((10.0, -2.0), abs=1e-6)
    assert h[1] == pytest.approx(math.pi, abs=1e-3)


def test_vehicles_of_different_ways_share_a_batch() -> None:
    car_ahead = replace(neighbour(x=50.0), state=car("other", 50.0, 3.2, speed=12.0))
    batch = AdversaryBatch([situation([crossing(), car_ahead])] * 3, ["other", "bv", "other"])
    x, y, _ = pose(Batch, batch.begin(), batch.rows)
    assert x == pytest.approx([50.0, 30.0, 50.0])
    assert y == pytest.approx([3.2, -25.0, 3.2])


# ---- in the way at a junction


def at_station(batch: AdversaryBatch, s: float, v: float = 8.0) -> Motion:
    return batch.begin()._replace(s=row(s), v=row(v))


def test_a_vehicle_on_a_crossing_takes_up_half_a_lane_before_the_place_until_its_rear_has_left_it() -> None:
    """Its junction begins after 15 m, the ways meet at right angles after 25 m (at 30 m of the ego's path), so the
    junction is taken to end after 35 m; the lane is 3.2 m wide, the car 5 m long."""
    batch = AdversaryBatch([situation([crossing()])], ["bv"])
    before = batch.at_junction(at_station(batch, 0.0))
    assert (before.on_junction[0], before.merging[0], before.meets_at[0]) == (False, False, pytest.approx(30.0))
    assert (before.front_to_zone[0], before.rear_to_zone[0], before.rear_to_exit[0]) == pytest.approx(
        (20.9, 25.9, 37.5)
    )
    assert (before.half_zone[0], before.speed[0]) == pytest.approx((1.6, 8.0))

    stations = (17.4, 12.5 - 0.1, 12.5 + 0.1, 29.0, 29.2)
    on = [bool(batch.at_junction(at_station(batch, s)).on_junction[0]) for s in stations]
    assert on == [True, False, True, True, False]
    leaving = batch.at_junction(at_station(batch, 28.4))
    assert (leaving.front_to_zone[0], leaving.rear_to_zone[0], leaving.rear_to_exit[0]) == pytest.approx(
        (-7.5, -2.5, 9.1)
    )
    assert batch.at_junction(at_station(batch, 38.0)).rear_to_exit[0] == pytest.approx(-0.5)


@pytest.mark.parametrize(
    ("unattacked", "station", "offset", "straight"),
    [
        (0, 5.0, 0.0, True),  # before the junction: by its route
        (1, 5.0, 0.0, False),
        (None, 5.0, 4.0, True),  # or, if that is unknown, by the way it is on
        (0, 22.0, 4.0, True),  # 4 m aside of its route the other way is nearer, but not by 2 m more
        (1, 22.0, 4.0, False),
        (0, 22.0, 7.0, False),
        (1, 22.0, 0.0, True),
    ],
)
def test_on_a_junction_a_vehicle_counts_as_on_the_way_nearest_to_its_front(
    unattacked: int | None, station: float, offset: float, straight: bool
) -> None:
    """Of the two ways on from the south only the one straight on meets the ego's path, at 30 m. The other way turns
    left 2 m before that; a rad of another heading counts as 2.2 m, having been on a way as 2 m."""
    batch = AdversaryBatch([situation([replace(crossing(), unattacked=unattacked)])], ["bv"])
    batch.at_junction(at_station(batch, 5.0))
    meeting = batch.at_junction(at_station(batch, station)._replace(d=row(offset)))
    assert meeting.meets_at[0] == pytest.approx(30.0 if straight else math.inf)


def test_a_vehicle_that_waits_to_turn_on_a_junction_is_not_yet_in_the_way() -> None:
    """The way begins to cross others at 20 m: until its front is there, other drivers ignore it."""
    turns = crossing()
    turns = replace(turns, ways=tuple(replace(w, bay=20.0) for w in turns.ways))
    batch = AdversaryBatch([situation([turns])], ["bv"])
    on = [bool(batch.at_junction(at_station(batch, s, 0.0)).on_junction[0]) for s in (13.0, 17.0, 18.0)]
    assert on == [False, False, True]
    batch = AdversaryBatch([situation([crossing()])], ["bv"])
    assert batch.at_junction(at_station(batch, 13.0, 0.0)).on_junction[0]


def test_the_flatter_the_angle_the_longer_is_the_place_where_ways_cross() -> None:
    """At 30 degrees twice 2 / 0.5 - 1 = 3 lanes' widths (half of it counts), at 90 degrees one."""
    for degrees, zone in ((90.0, 1.6), (30.0, 4.8), (150.0, 4.8)):
        angle = math.radians(degrees)
        way = line(
            (60.0 - 40.0 * math.cos(angle), -40.0 * math.sin(angle)),
            (60.0 + 90.0 * math.cos(angle), 90.0 * math.sin(angle)),
        )
        state = car("bv", float(way.x[0]), float(way.y[0]), angle)
        one_of = target(state, "crossing", [(way, "straight", 20.0)], EGO_PATH)
        batch = AdversaryBatch([situation([one_of])], ["bv"])
        assert batch.at_junction(at_station(batch, 0.0)).half_zone[0] == pytest.approx(zone, rel=1e-3)


def test_a_merging_vehicle_takes_up_its_distance_ahead_and_moves_on() -> None:
    """A ramp of 67.1 m joins at station 60; its junction begins after 55 m."""
    ramp = line((0.0, -30.0), (60.0, 0.0), (250.0, 0.0))
    merging = target(car("bv", 0.0, -30.0, 0.46), "merging", [(ramp, "straight", 55.0)], EGO_PATH)
    batch = AdversaryBatch([situation([merging])], ["bv"])
    conflict = merging.ways[0].conflict
    assert conflict is not None and conflict.kind == "merging"
    assert (conflict.bv_s, conflict.ego_s) == pytest.approx((67.1, 60.0), abs=1.0)

    assert not batch.at_junction(at_station(batch, 52.0, 9.0)).on_junction[0]
    on = batch.at_junction(at_station(batch, 57.0, 9.0))
    assert (on.on_junction[0], on.merging[0], on.speed[0], on.half_zone[0]) == (True, True, 9.0, 0.0)
    assert on.rear_station[0] == pytest.approx(
        conflict.ego_s - (conflict.bv_s - 57.0) - 2.5
    )  # its rear, on the ego's path
    assert on.rear_station[0] == pytest.approx(47.5, abs=1.0)
    assert on.front_to_zone[0] == pytest.approx(conflict.bv_s - 59.5)
    assert not batch.at_junction(at_station(batch, 69.0, 9.0)).on_junction[0]  # from there on it is a leader


def test_a_way_that_does_not_meet_the_ego_s_is_never_in_its_way() -> None:
    both = situation([neighbour(), replace(crossing(), state=replace(crossing().state, id="other"))])
    beside = AdversaryBatch([both], ["bv"])
    assert beside.at_junction(at_station(beside, 50.0, 12.0)) is None
    batch = AdversaryBatch([both, both], ["bv", "other"])
    meeting = batch.at_junction(batch.begin()._replace(s=row(50.0, 20.0)))
    assert meeting is not None
    assert (meeting.on_junction.tolist(), meeting.meets_at.tolist()) == ([False, True], [math.inf, pytest.approx(30.0)])


def test_a_move_that_hardly_goes_on_is_observed_as_one_of_20_s() -> None:
    """At 0.2 m/s, planned as if at 6 m/s, half of 3 s has gone: 45 s at this speed. Planners get the seconds of its
    clock, and never more than 20."""
    batch = AdversaryBatch([situation([neighbour()])] * 2, ["bv", "bv"])
    motion = batch.begin()._replace(target=row(-3.2, -3.2), clock=row(1.5, 0.0), span=row(3.0, 73.0))
    still = row(0.0, 0.0)
    observations = batch.observe(motion, 0.0, (still, still, still, still), [None, None])
    assert [bv["lateral_time"] for bv, _ in observations] == pytest.approx([1.5, 20.0])


def test_each_is_in_the_way_by_the_way_it_is_on() -> None:
    batch = AdversaryBatch([situation([crossing()])] * 2, ["bv", "bv"])
    batch.rows.row = np.array([0, 1])  # the second one turns left before the ego's path
    motion = batch.begin()._replace(s=row(20.0, 20.0))
    assert batch.at_junction(motion).on_junction.tolist() == [True, False]


@pytest.mark.parametrize(
    ("ego", "bv", "yields"), [("G", "r", True), ("G", "g", False), ("g", "r", True), (None, "r", False)]
)
def test_an_adversary_that_runs_red_yields_where_the_ego_has_green(ego: str | None, bv: str, yields: bool) -> None:
    lights = {"bv": (("tl", 20.0, bv),), "ego": () if ego is None else (("tl", 30.0, ego),)}
    batch = AdversaryBatch([changed(situation([crossing()]), signals=lights)], ["bv"])
    assert bool(batch.at_junction(at_station(batch, 0.0)).ran_red[0]) is yields


# ---- observations


def test_a_planner_observes_places_in_the_egos_frame() -> None:
    sit = situation([neighbour()])
    bv, ego = observed(sit)
    expected = {
        "x": 20.0, "y": 3.2, "heading": 0.0, "speed": 12.0, "acceleration": 0.0, "travelled": 0.0, "offset": 0.0,
        "ahead": 20.0, "left": 3.2, "relative_heading": 0.0, "road_heading": 0.0, "target_left": 3.2,
        "lateral_time": 0.0, "speed_along": 12.0, "length": 5.0, "width": 2.0, "time": 0.0,
    }  # fmt: skip
    assert bv.pop("last") is None
    assert bv == pytest.approx(expected)
    assert [ego[n] for n in ("x", "y", "speed", "length", "width")] == pytest.approx([0.0, 0.0, 10.0, 5.0, 2.0])
    assert ego["path"][3] == pytest.approx([3.0, 30.0, 0.0, 0.0, 10.0])  # time, x, y, heading, speed
    assert ego["arrivals"] == [NO_ARRIVAL_S]


def test_a_lane_change_under_way_is_observed_with_its_end_and_the_seconds_left() -> None:
    sit = situation([neighbour()])
    motion = AdversaryBatch([sit], ["bv"]).begin()
    moving = motion._replace(
        d=row(-1.0), dd=row(-1.2), slope=row(-0.1), clock=row(1.0), span=row(3.0), target=row(-3.2)
    )
    bv, _ = observed(sit, motion=moving)
    assert (bv["left"], bv["target_left"], bv["lateral_time"]) == pytest.approx((2.2, 0.0, 2.0), abs=0.02)
    assert bv["speed_along"] == pytest.approx(12.0 * math.cos(0.1), abs=0.01)


def test_arrivals_stand_in_the_order_of_the_ways() -> None:
    _, ego = observed(situation([crossing()]))
    assert ego["arrivals"] == [pytest.approx(3.0, abs=0.05), NO_ARRIVAL_S]


def test_observations_and_roads_are_plain_data() -> None:
    sit = situation([crossing()])
    data = [*observed(sit), planner_road(sit, "bv")]
    assert json.loads(json.dumps(data, allow_nan=False)) == data


def test_the_road_has_ways_conflict_and_lanes_beside() -> None:
    road = planner_road(situation([crossing()]), "bv")
    assert (road["relation"], road["lane_width"], road["fastest"]) == ("crossing", 3.2, pytest.approx(13.0))
    assert [w["movement"] for w in road["ways"]] == ["straight", "left"]
    assert [w["junction"] for w in road["ways"]] == [15.0, 15.0]
    conflict = road["ways"][0]["conflict"]
    assert (conflict["kind"], conflict["angle"]) == ("crossing", pytest.approx(math.pi / 2))
    assert (conflict["bv_distance"], conflict["ego_distance"]) == pytest.approx((25.0, 30.0), abs=0.5)
    assert road["ways"][1]["conflict"] is None
    assert road["ways"][0]["centreline"][1] == pytest.approx([30.0, -23.0])  # 2 m on
    assert road["sides"] == [{"offset": 3.2, "kind": "same"}]
    assert road["start"] == pytest.approx({"x": 30.0, "y": -25.0, "heading": math.pi / 2, "speed": 8.0})
    assert planner_road(situation([neighbour()]), "bv")["left"] == pytest.approx(3.2)


def test_the_road_has_the_lights_ahead_of_both() -> None:
    sit = changed(
        situation([crossing()]), signals={"ego": (("J", 20.5, "G"),), "bv": (("J", 12.0, "r"), ("K", 90.0, "g"))}
    )
    assert planner_road(sit, "bv")["signals"] == {
        "bv": [{"id": "J", "distance": 12.0, "state": "r"}, {"id": "K", "distance": 90.0, "state": "g"}],
        "ego": [{"id": "J", "distance": 20.5, "state": "G"}],
    }
    assert planner_road(situation([crossing()]), "bv")["signals"] == {"bv": [], "ego": []}


def moved(path: Path, frame: Frame) -> Path:
    """The path seen from the world, if it was drawn in ``frame``."""
    c, s = math.cos(frame.heading), math.sin(frame.heading)
    x, y = frame.x + c * path.x - s * path.y, frame.y + s * path.x + c * path.y
    return replace(path, x=x, y=y, heading=path.heading + frame.heading)


def elsewhere(sit: Situation, frame: Frame) -> Situation:
    """The same situation at another place of the world, turned."""
    ego_path = moved(sit.baseline.path, frame)

    def turned(t: Target) -> Target:
        x, y, h = frame.to_world(t.state.x, t.state.y, t.state.heading)
        ways = tuple(relate(moved(w.path, frame), w.movement, w.junction, w.gives_way, ego_path) for w in t.ways)
        return replace(t, state=replace(t.state, x=x, y=y, heading=h), ways=ways)

    return changed(sit, frame=frame, path=ego_path, targets={n: turned(t) for n, t in sit.targets.items()})


@EXAMPLES
@given(
    st.floats(-500.0, 500.0), st.floats(-500.0, 500.0), st.floats(-3.1, 3.1), st.sampled_from(["crossing", "neighbour"])
)
def test_observations_do_not_depend_on_the_place_in_the_world(x: float, y: float, h: float, kind: str) -> None:
    here = situation([crossing() if kind == "crossing" else neighbour()])
    there = elsewhere(here, Frame(x, y, h))
    for a, b in zip(observed(here), observed(there), strict=True):
        assert flat(a) == pytest.approx(flat(b), abs=1e-6)
    # centrelines are rounded to centimetres, conflicts lie on a sample, half a metre from the next
    assert flat(planner_road(here, "bv")) == pytest.approx(flat(planner_road(there, "bv")), abs=0.511)


def flat(value: Any) -> list[float]:
    """All numbers inside, in order."""
    if isinstance(value, dict):
        return [n for q in value.values() for n in flat(q)]
    if isinstance(value, list):
        return [n for q in value for n in flat(q)]
    return [float(value)] if isinstance(value, int | float) else []
