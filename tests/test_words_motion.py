"""What happened in an attempt: events of hand-made tracks along a straight way of the ego, and whether they fit."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest

from sumo_adv.asked import Asked, Event
from sumo_adv.datatypes import Floats, Relation, Role, Track
from sumo_adv.geometry import make_path
from sumo_adv.road_users import RoadUser
from sumo_adv.words.fit import compare, held, misfits
from sumo_adv.words.motion import DescribedMotion, Scene, observe

TIME = np.round(np.arange(0.0, 6.01, 0.1), 3)
WAY = make_path([(-50.0, 0.0), (250.0, 0.0)])  # eastward
EGO_SPEED = 10.0


def track(name: str, x: Floats, y: Floats, heading: float, speed: Floats | float, size: tuple[float, float]) -> Track:
    speeds = np.full(len(TIME), speed) if isinstance(speed, float) else speed
    headings = np.full(len(TIME), heading)
    role = Role.EGO if name == "ego" else Role.ADVERSARY
    return Track(name, role, TIME, x, y, headings, speeds, np.zeros(len(TIME)), *size)


def turning_ego(begins: float) -> Track:
    """An ego that turns left at x = 0 with 8 m/s on an arc of 9.6 m; it comes from ``begins`` metres before."""
    angle = np.maximum(8.0 * TIME - begins, 0.0) / BEND_RADIUS_M
    x = np.where(angle > 0.0, BEND_RADIUS_M * np.sin(angle), 8.0 * TIME - begins)
    ego = track("ego", x, BEND_RADIUS_M * (1.0 - np.cos(angle)), 0.0, 8.0, (4.8, 1.8))
    return replace(ego, heading=angle)


def mirror(vehicle: Track) -> Track:
    return replace(vehicle, y=-vehicle.y, heading=-vehicle.heading)


BEND_RADIUS_M = 9.6
ARC = [(BEND_RADIUS_M * math.sin(a), BEND_RADIUS_M * (1.0 - math.cos(a))) for a in np.linspace(0.0, math.pi / 2, 20)]
BEND = make_path([(-60.0, 0.0), *ARC, (BEND_RADIUS_M, 340.0)])  # eastward, then northward
EGO = track("ego", EGO_SPEED * TIME, 0.0 * TIME, 0.0, EGO_SPEED, (4.8, 1.8))


def seen(adversary: Track, others: tuple[Track, ...] = (), side: str | None = None, **more: Any) -> DescribedMotion:
    motion = observe(Scene(EGO, adversary, others, WAY, "neighbour", False, side, 0.0, **more))
    assert motion is not None
    return motion


def events(motion: DescribedMotion) -> dict[Event, float]:
    return {event: time for time, event in motion.events}


def cut_in(size: tuple[float, float] = (4.8, 1.8)) -> Track:
    """10 m ahead at the ego's speed, 3.6 m to the left until 2 s, then 1.2 m/s to the right until it is in the lane;
    after 5 s it loses 4 m/s within a second."""
    y = np.clip(3.6 - 1.2 * (TIME - 2.0), 0.0, 3.6)
    speed = EGO_SPEED - np.clip(4.0 * (TIME - 5.0), 0.0, 4.0)
    x = 10.0 + np.concatenate([[0.0], np.cumsum(speed[:-1] * 0.1)])
    return track("cutter", x, y, 0.0, speed, size)


def test_a_cut_in_comes_from_the_left_and_brakes_after_it() -> None:
    happened = events(seen(cut_in()))
    assert happened == {Event.ENTERS_FROM_LEFT: 3.6, Event.BRAKES: 5.0}  # 3.6 - 1.2 * 1.6 = 1.68 < 0.9 + 0.9
    asked = Asked(events=(Event.ENTERS_FROM_LEFT, Event.BRAKES), relation=Relation.NEIGHBOUR)
    assert misfits(compare(asked, seen(cut_in()))) == ()


def test_a_lane_change_of_the_ego_is_told_by_the_lanes() -> None:
    """Over the line after three seconds, from the rightmost lane to the next one, and back a second later."""
    lanes = ("main_0",) * 30 + ("main_1",) * 10 + ("main_0",) * 21
    motion = observe(Scene(replace(EGO, lane=lanes), cut_in(), (), WAY, "neighbour", False, None, 0.0))
    assert motion is not None
    told = [line for line in motion.words.splitlines() if "changes to the lane" in line]
    assert told == [
        "EGO changes to the lane on its left; it is over the line at 3.0 s.",
        "EGO changes to the lane on its right; it is over the line at 4.0 s.",
    ]


def test_in_left_hand_traffic_lanes_count_from_the_left() -> None:
    """From the leftmost lane to the next one on its right after three seconds."""
    lanes = ("main_0",) * 30 + ("main_1",) * 31
    motion = observe(Scene(replace(EGO, lane=lanes), cut_in(), (), WAY, "neighbour", False, None, 0.0, hand=-1.0))
    assert motion is not None
    assert "EGO changes to the lane on its right; it is over the line at 3.0 s." in motion.words


def test_a_vehicle_that_turns_into_the_way_comes_across_and_then_enters() -> None:
    """Northward at x = 30 m from y = -10 m with 5 m/s, and from 2 s on eastward."""
    y = np.minimum(-10.0 + 5.0 * TIME, 0.0)
    x = 30.0 + 5.0 * np.maximum(TIME - 2.0, 0.0)
    turner = replace(track("turner", x, y, 0.0, 5.0, (4.8, 1.8)), heading=np.where(TIME < 2.0, np.pi / 2, 0.0))
    assert events(seen(turner)) == {
        Event.CROSSES_FROM_RIGHT: 1.4, Event.ENTERS_FROM_RIGHT: 2.0, Event.TURNS_RIGHT: 2.0,
    }  # -10 + 5 * 1.4 = -3 > -2.4 - 0.9  # fmt: skip
    assert misfits(compare(Asked(events=(Event.ENTERS_FROM_RIGHT,)), seen(turner))) == ()


def test_the_order_counts() -> None:
    asked = Asked(events=(Event.BRAKES, Event.ENTERS_FROM_LEFT))
    (lack,) = misfits(compare(asked, seen(cut_in())))
    assert lack.startswith("'enters_from_left' does not happen after 'brakes'")


def test_an_event_that_is_requested_twice_must_happen_twice() -> None:
    """It loses 4 m/s from 1 s to 2 s, and in the second motion 4 m/s more from 4 s to 5 s."""
    once = 10.0 - np.clip(4.0 * (TIME - 1.0), 0.0, 4.0)
    twice = once - np.clip(4.0 * (TIME - 4.0), 0.0, 4.0)
    asked = Asked(events=(Event.BRAKES, Event.BRAKES))
    for speed, holds in ((once, [True, False]), (twice, [True, True])):
        motion = seen(track("l", 20.0 + 8.0 * TIME, 0.0 * TIME, 0.0, speed, (4.8, 1.8)))
        assert [part.holds for part in compare(asked, motion)] == holds
    assert compare(asked, motion)[1].says == "'brakes' happens at 4.0 s after 'brakes'."


def test_one_crossing_is_not_two() -> None:
    """From 20 m on the left with 8 m/s; in the second motion it is 10 m on the left again at 4 s."""
    crossed = track("c", 0.0 * TIME + 40.0, 20.0 - 8.0 * TIME, -np.pi / 2, 8.0, (4.0, 1.8))
    again = replace(crossed, y=np.where(TIME < 4.0, crossed.y, 42.0 - 8.0 * TIME))
    asked = Asked(events=(Event.CROSSES_FROM_LEFT, Event.CROSSES_FROM_LEFT))
    assert [part.holds for part in compare(asked, seen(crossed))] == [True, False]
    assert [part.holds for part in compare(asked, seen(again))] == [True, True]


def test_each_part_of_a_request_holds_or_does_not() -> None:
    """The car enters from the left at 3.6 s and brakes at 5.0 s; it does not pass, and the order goes on without it."""
    wanted = (Event.ENTERS_FROM_LEFT, Event.PASSES_LEFT, Event.BRAKES)
    parts = compare(Asked(relation=Relation.LEADER, events=wanted), seen(cut_in()))
    assert [(part.name, part.holds) for part in parts] == [
        ("relation", False), ("events: enters_from_left", True), ("events: passes_left", False),
        ("events: brakes", True),
    ]  # fmt: skip
    assert parts[3].says == "'brakes' happens at 5.0 s after 'enters_from_left'."
    assert held([asdict(part) for part in parts]) == "What holds: events: enters_from_left, events: brakes."


def test_a_contact_counts_as_being_in_the_way() -> None:
    """The tracks end just before the boxes touch, here 1.85 m beside, where 1.8 m would be inside."""
    beside = track("b", EGO.x + 1.0, 0.0 * TIME + 1.85, 0.0, EGO_SPEED, (4.8, 1.8))
    assert Event.ENTERS_FROM_LEFT not in events(seen(beside))
    assert Event.ENTERS_FROM_LEFT in events(seen(beside, side="left"))


def test_an_ego_that_swerves_into_a_neighbour_is_not_entered() -> None:
    """The neighbour stays 3.5 m beside the ego's way, 1.7 m outside of it; the ego swerves by 1.6 m within a second."""
    neighbour = track("n", EGO.x + 1.0, 0.0 * TIME + 3.5, 0.0, EGO_SPEED, (4.8, 1.8))
    swerves = replace(EGO, y=1.6 * np.clip(TIME - 5.0, 0.0, 1.0))
    motion = observe(Scene(swerves, neighbour, (), WAY, "neighbour", False, "left", 0.0))
    assert motion is not None and motion.events == ()


def test_a_fast_crossing_vehicle_is_in_the_way_at_a_contact() -> None:
    """It moves 1.2 m in a step of 0.1 s; the last state before the contact is 1 m outside of the way."""
    crossing = track("c", EGO.x + 1.0, 3.9 + 12.0 * (6.0 - TIME), -np.pi / 2, 12.0, (4.0, 1.8))  # 3.9 - 2.0 - 0.9 = 1
    assert events(seen(crossing, side="left")) == {Event.CROSSES_FROM_LEFT: 6.0}


@pytest.mark.parametrize(("sign", "event"), [(1, Event.CROSSES_FROM_LEFT), (-1, Event.CROSSES_FROM_RIGHT)])
def test_a_crossing_vehicle_comes_from_a_side(sign: int, event: Event) -> None:
    y = sign * (20.0 - 8.0 * TIME)
    crossing = track("c", 0.0 * TIME + 40.0, y, -sign * np.pi / 2, 8.0, (4.0, 1.8))
    happened = events(seen(crossing))  # its half length 2 m and the ego's half width 0.9 m: in the way from 2.9 m on
    assert happened[event] == 2.2 and happened[Event.LEAVES] == 2.9


def test_an_oncoming_vehicle_comes_over() -> None:
    y = np.clip(3.45 - 1.0 * TIME, 0.0, 3.5)  # less than 1.8 m from 1.7 s on
    oncoming = track("o", 150.0 - 10.0 * TIME, y, np.pi, 10.0, (4.8, 1.8))
    assert events(seen(oncoming)) == {Event.COMES_OVER: 1.7}


@pytest.mark.parametrize("hand", [1.0, -1.0])
def test_an_oncoming_vehicle_that_turns_comes_over_on_either_side_of_traffic(hand: float) -> None:
    """It comes westward, 5 m beside the ego's way on the far side, and turns by 90 degrees across it after 2 s."""
    x, y = 80.0 - 10.0 * np.minimum(TIME, 2.0), 5.0 - 4.0 * np.maximum(TIME - 2.0, 0.0)
    turner = replace(track("o", x, y, 0.0, 4.0, (4.8, 1.8)), heading=np.where(TIME < 2.0, np.pi, 1.5 * np.pi))
    motion = seen(turner if hand > 0 else mirror(turner), hand=hand)
    assert events(motion)[Event.COMES_OVER] == 2.5  # 5 - 4 * 0.5 = 3 < 2.4 + 0.9


@pytest.mark.parametrize("hand", [1.0, -1.0])
def test_an_oncoming_vehicle_comes_over_before_an_ego_that_turns(hand: float) -> None:
    """The ego's path, 36 m before the turn at first, is 7 m to the side where it heads 74 degrees to the left.

    There, the path and the oncoming vehicle's heading differ by 180 - 74 = 106 degrees.
    """
    ego, oncoming = turning_ego(36.0), track("o", 12.5 + 12.0 * (6.0 - TIME), 0.0 * TIME + 7.0, np.pi, 12.0, (4.8, 1.8))
    way = BEND
    if hand < 0:
        ego, oncoming = mirror(ego), mirror(oncoming)
        way = make_path([(x, -y) for x, y in zip(BEND.x.tolist(), BEND.y.tolist(), strict=True)])
    motion = observe(Scene(ego, oncoming, (), way, "crossing", False, "front", 0.0, hand=hand))
    assert motion is not None and [event for _, event in motion.events] == [Event.COMES_OVER]


def test_a_vehicle_passes_on_the_right_while_another_is_beside_on_the_left() -> None:
    passing = track("p", -10.0 + 14.0 * TIME, 0.0 * TIME - 3.5, 0.0, 14.0, (4.8, 1.8))
    beside = track("s", EGO.x + 1.0, 0.0 * TIME + 3.5, 0.0, EGO_SPEED, (4.8, 1.8))
    parked = track("v", 0.0 * TIME + 30.0, 0.0 * TIME - 4.0, 0.0, 0.0, (5.5, 2.0))
    motion = seen(passing, (beside, parked))
    assert events(motion) == {Event.PASSES_RIGHT: 2.8}  # it gains 4 m/s: 11 m after 2.75 s
    assert motion.beside == frozenset({"left"}), "what is parked is not beside"
    assert "5.5 m long" in motion.words and "standing" in motion.words


def test_a_moving_lorry_hides_what_shoots_out_behind_it() -> None:
    """A lorry of 12 m by 2.5 m drives 20 m ahead of the ego, 4 m to the right; it hides slopes of 2.75/26 to 5.25/14.

    The corners of a car that waits at x = 80, y = -9 are at 79.1 and 80.9, -7 and -11. The last one of the near side is
    hidden when 80.9 - 10 t < 7 * 26 / 2.75 = 66.2: at 1.5 s. The first one of the far side shows when 79.1 - 10 t <
    11 * 14 / 5.25 = 29.3: at 5.0 s.
    """
    lorry = track("lorry", EGO.x + 20.0, 0.0 * TIME - 4.0, 0.0, EGO_SPEED, (12.0, 2.5))
    y = -9.0 + 8.0 * np.maximum(TIME - 5.0, 0.0)
    car = track("car", 0.0 * TIME + 80.0, y, np.pi / 2, np.where(TIME < 5.0, 0.0, 8.0), (4.0, 1.8))
    hides, shows = seen(car, (lorry,)), seen(car)
    assert "From 1.5 s to 5.0 s A is hidden from EGO by something between them." in hides.words
    assert hides.hidden and not shows.hidden and "hidden" not in shows.words
    assert misfits(compare(Asked(hidden=True), hides)) == () and len(misfits(compare(Asked(hidden=True), shows))) == 1


def test_standing_and_red_lights() -> None:
    speed = np.clip(2.0 * (TIME - 1.0), 0.0, 6.0)
    starts = track("w", 60.0 + 0.0 * TIME, 0.0 * TIME + 8.0, -np.pi / 2, speed, (4.8, 1.8))
    happened = events(seen(starts, light=(1.5, Event.RUNS_RED)))
    assert happened[Event.STARTS] == 1.3 and happened[Event.SPEEDS_UP] == 1.0 and happened[Event.RUNS_RED] == 1.5


def test_who_it_is_and_what_is_hit() -> None:
    motion = seen(cut_in((12.0, 2.5)), side="left")
    assert (
        misfits(compare(Asked(least_length=10, side="left", user=RoadUser.VEHICLE, most_speed_first=10), motion)) == ()
    )
    lacks = misfits(compare(
        Asked(
            relation=Relation.LEADER, user=RoadUser.PEDESTRIAN, side="front", hidden=True, beside="right",
            least_length=13, most_speed_first=5,
        ),
        motion,
    ))  # fmt: skip
    assert lacks == (
        "The adversary is a vehicle, not a pedestrian.", "The adversary is neighbour, not leader.",
        "The ego is hit at its left, not at its front.",
        "Nothing hides the adversary from the ego before it comes into the way.",
        "No other vehicle is beside the ego on its right.", "The adversary is 12 m long, not 13 m or more.",
        "The adversary drives 10.0 m/s at first, not 5.",
    )  # fmt: skip


def test_the_words_hold_facts_and_no_names() -> None:
    words = seen(cut_in()).words
    assert "cutter" not in words and words.splitlines()[-1] == "They do not touch."
    assert "3.6 s: A comes from the left into EGO's way, going the same way." in words
    assert "0.0 s: EGO 10.0 m/s; A 10.0 m/s, 10.0 m ahead of EGO along EGO's way, 3.6 m to the left" in words


def test_gentle_braking_has_a_bound() -> None:
    """It loses 4 m/s within a second: 4 m/s2."""
    assert misfits(compare(Asked(most_braking=4.1), seen(cut_in()))) == ()
    assert misfits(compare(Asked(most_braking=3), seen(cut_in()))) == (
        "The adversary brakes with 4.0 m/s2, not with at most 3.",
    )


def test_the_turn_that_the_ego_is_about_to_make_is_told() -> None:
    """The ego comes to x = 60 m; at 70 m its way bends to the right by 90 degrees."""
    way = make_path([(-50.0, 0.0), (70.0, 0.0), (70.0, -200.0)])
    motion = observe(Scene(EGO, cut_in(), (), way, "neighbour", False, None, 0.0))
    assert motion is not None
    assert "EGO is 4.8 m long and is about to turn right." in motion.words
    assert "EGO is 4.8 m long and goes straight on." in seen(cut_in()).words
