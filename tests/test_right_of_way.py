"""Waiting at a line, with numbers worked out by hand on ``priority_crossing``.

The ego comes from the south in the left lane, straight on: it meets the lane from the west 7.6 m behind its line, which
is 17.2 m behind theirs (right lane).
"""

from __future__ import annotations

from dataclasses import replace

import pytest

from sumo_adv.episode.right_of_way import Foe, Line, Meetings, RightOfWay
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.network import read_network

MEETINGS = Meetings(read_network(data_folder("networks") / "priority_crossing.net.xml"))
EGO, WEST, NORTH = ("centre", 10), ("centre", 13), ("centre", 2)
LINE = Line(EGO, MEETINGS.ways[EGO], room=1.0, begin=0.0, letter="m", limit=13.9)


def comes(to_line: float, speed: float = 14.0, link: tuple[str, int] = WEST, stood: float = 0.0) -> Foe:
    """A car of 5 m that comes to its line, or is ``-to_line`` metres past it."""
    return Foe("foe", link, to_line, 5.0, speed, lambda: stood, "M")


def must_wait(rule: RightOfWay, *foes: Foe, line: Line = LINE, speed: float = 0.0) -> bool:
    return rule.must_wait(line, 5.0, speed, 0.0, foes)


def test_the_ways_meet_where_their_lanes_cross() -> None:
    (meeting,) = (m for m in MEETINGS.of(EGO) if m.other == WEST)
    assert (meeting.at, meeting.other_at, meeting.x, meeting.y) == pytest.approx((7.6, 14.0, 1.6, -4.8))
    assert meeting.yields and not meeting.joins


def test_it_waits_for_a_car_that_comes_before_it_would_be_across() -> None:
    """Standing, with 2.6 m/s2 it needs sqrt(2 x 15.6 / 2.6) = 3.5 s for 1 + 7.6 + 5 + 2 m, and 1 s is kept. The car has
    12 m more than to its line: at 14 m/s from 40 m that takes 3.7 s, from 60 m 5.1 s."""
    assert must_wait(RightOfWay(MEETINGS), comes(40.0))
    assert not must_wait(RightOfWay(MEETINGS), comes(60.0))
    assert not must_wait(RightOfWay(MEETINGS))


def test_a_reason_to_wait_stays_until_the_car_has_left() -> None:
    """Slower now: 5.1 s from 60 m are too late to be a new reason, and too early to drop one (4.5 s + 1 s)."""
    rule = RightOfWay(MEETINGS)
    assert must_wait(rule, comes(40.0))
    assert must_wait(rule, comes(60.0))
    assert not must_wait(rule, comes(80.0))  # 6.6 s
    assert not must_wait(rule, comes(60.0))
    assert must_wait(rule, comes(-5.0))  # 14 m - 5 m, its 5 m and 2 m take 1.14 s; the ego is at its line after 0.88 s
    assert not must_wait(rule, comes(-9.0))  # 0.86 s


def test_those_who_give_way_themselves_do_not_count_until_they_are_on_the_junction() -> None:
    """Straight on from the north no vehicle meets the ego; the left turn from there gives way to it."""
    left = ("centre", 3)
    assert not must_wait(RightOfWay(MEETINGS), comes(10.0, 8.0, NORTH))
    assert not must_wait(RightOfWay(MEETINGS), comes(5.0, 8.0, left))
    assert must_wait(RightOfWay(MEETINGS), comes(-5.0, 8.0, left))


def test_who_has_stood_for_three_seconds_lets_the_ego_go() -> None:
    assert must_wait(RightOfWay(MEETINGS), comes(1.0, 0.0, stood=2.0))
    assert not must_wait(RightOfWay(MEETINGS), comes(1.0, 0.0, stood=3.0))


def test_who_cannot_stop_any_more_passes_and_who_had_to_wait_already_goes_on_waiting() -> None:
    """From 10 m/s it takes 100 / 9 = 11.1 m, less half a metre."""
    near, far = replace(LINE, room=10.0), replace(LINE, room=11.0)
    assert not must_wait(RightOfWay(MEETINGS), comes(20.0), line=near, speed=10.0)
    rule = RightOfWay(MEETINGS)
    assert must_wait(rule, comes(15.0), line=far, speed=10.0)
    assert must_wait(rule, comes(14.0), line=near, speed=10.0)


def test_who_cannot_stop_comfortably_any_more_keeps_no_margin() -> None:
    """From 10 m/s comfortable braking takes 100 / 6 = 16.7 m, less half a metre. Across are 17 + 7.6 + 5 + 2 m, 17.9 of
    them up to 13.9 m/s in 1.5 s, the rest in 1 s: 2.5 s. The car is there after 42 m, 3 s: within 1 s of that."""
    easy, late = replace(LINE, room=17.0), replace(LINE, room=16.0)
    assert must_wait(RightOfWay(MEETINGS), comes(30.0), line=easy, speed=10.0)
    assert not must_wait(RightOfWay(MEETINGS), comes(30.0), line=late, speed=10.0)


def test_past_the_line_there_is_nothing_to_wait_for() -> None:
    rule = RightOfWay(MEETINGS)
    assert must_wait(rule, comes(40.0), line=replace(LINE, room=-0.4))
    assert not must_wait(rule, comes(40.0), line=replace(LINE, room=-0.6))


def test_at_a_yellow_light_it_stops_if_that_is_comfortable() -> None:
    """With 3 m/s2 from 12 m/s: 24 m. Once it stops it goes on stopping."""
    lit = replace(LINE, way=replace(LINE.way, light=("light", 0)), letter="y")
    assert not must_wait(RightOfWay(MEETINGS), line=replace(lit, room=23.0), speed=12.0)
    rule = RightOfWay(MEETINGS)
    assert must_wait(rule, line=replace(lit, room=25.0), speed=12.0)
    assert must_wait(rule, line=replace(lit, room=23.0), speed=12.0)
    assert not must_wait(rule, line=replace(lit, room=22.0, letter="G"), speed=12.0)


def test_a_red_light_and_a_stop_sign() -> None:
    lit = replace(LINE, way=replace(LINE.way, light=("light", 0)), letter="r")
    assert must_wait(RightOfWay(MEETINGS), line=lit, speed=10.0)
    rule, sign = RightOfWay(MEETINGS), replace(LINE, letter="s")
    assert must_wait(rule, line=sign, speed=3.0)
    assert not must_wait(rule, line=sign, speed=0.0)  # it has stood
    assert not must_wait(rule, line=sign, speed=1.0)
