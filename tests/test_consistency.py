"""Whether imported motion can be right: units, sizes, times and headings, and what must raise no alarm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from womd_samples import four_way, straight, write

import sumo_adv
from sumo_adv.consistency import SUMO_DEGREES, UNWRAPPED, GivenMotion, even_grid, find_fault, off_grid
from sumo_adv.datatypes import Floats
from sumo_adv.errors import UsageError
from sumo_adv.womd.commonroad import read_commonroad
from sumo_adv.womd.reader import read_records

TIME = np.round(np.arange(60) * 0.1, 3)


def bend(speed: float = 9.0, *, kind: str = "vehicle", turned: float = 0.0) -> GivenMotion:
    """A left bend of radius 80 m, from heading ``turned`` on: 9 m/s for 5.9 s are 53.1 m and 0.66 rad."""
    angle = abs(speed) / 80.0 * TIME
    x, y = 80.0 * np.sin(angle), 80.0 * (1.0 - np.cos(angle))
    c, s = np.cos(turned), np.sin(turned)
    return GivenMotion("a", kind, TIME, x * c - y * s, x * s + y * c, angle + turned, np.full(60, speed), 4.5, 1.8)


def fault(*motions: GivenMotion, noisy: bool = False) -> str:
    found = find_fault(motions, noisy=noisy)
    return "" if found is None else found.says


def times(name: str, factor: float) -> Callable[[GivenMotion], GivenMotion]:
    return lambda m: replace(m, **{name: np.asarray(getattr(m, name)) * factor})


def headings(change: Callable[[Floats], Floats]) -> Callable[[GivenMotion], GivenMotion]:
    return lambda m: replace(m, heading=change(m.heading))


def scaled(factor: float) -> Callable[[GivenMotion], GivenMotion]:
    """All lengths in another unit."""
    return lambda m: replace(
        m, x=m.x * factor, y=m.y * factor, speed=m.speed * factor, length=m.length * factor, width=m.width * factor
    )


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (headings(np.degrees), "has the heading 6.44578 rad for 'a', which is beyond 2 pi: headings look like degrees"),
        (headings(lambda h: 90.0 - np.degrees(h)), "beyond 2 pi: headings look like degrees"),
        (headings(lambda h: h + 4 * np.pi), "beyond 2 pi: headings are added up over turns"),
        (headings(lambda h: np.pi / 2 - h), "headings look like radians clockwise from north"),
        (headings(lambda h: h * 0.0 + 1.6), "has the heading 1.6 rad for 'a', which moves towards 1 degrees from +x"),
        (times("speed", 3.6), "has the speed 32.4 m/s for 'a', which moves at 9 m/s: speeds look like km/h"),
        (times("speed", 2.23694), "speeds look like mph"),
        (times("speed", 3.28084), "speeds look like feet per second"),
        (times("speed", 0.0), "has the speed 0 m/s for 'a', which moves at 9 m/s: speeds are missing"),
        (times("time", 1000.0), "times look like milliseconds"),
        (lambda m: replace(m, time=np.arange(60.0)), "times look like numbers of frames"),
        (lambda m: replace(m, x=9.0 + m.x / 75_000, y=47.0 + m.y / 111_000), "look like longitude and latitude"),
        (scaled(3.28084), "a size of 14.7638 by 5.90551 m: sizes look like feet"),
        (scaled(100.0), "a size of 450 by 180 m: sizes look like centimetres"),
        (lambda m: replace(m, length=1.8, width=4.5), "a size of 1.8 by 4.5 m: length and width look swapped"),
        (lambda m: replace(m, y=np.full(60, 1e12)), "has 1e+12 for y, which is not a place on a map"),
        (lambda m: replace(m, x=np.where(TIME == 0.7, np.inf, m.x)), "has inf for x, which is not a finite number"),
        (lambda m: replace(m, speed=np.where(TIME == 0.7, np.nan, m.speed)), "has nan for speed"),
    ],
)  # fmt: skip
def test_a_wrong_unit_is_named(change: Callable[[GivenMotion], GivenMotion], says: str) -> None:
    assert fault(bend()) == ""
    assert says in fault(change(bend()))


def test_degrees_below_two_pi_are_against_the_motion() -> None:
    """From 1.72 to 2.39 degrees, read as radians."""
    small = replace(bend(0.5), x=5.0 * TIME, y=0.18 * TIME, speed=np.full(60, 5.0))
    assert fault(replace(small, heading=np.full(60, 0.036))) == ""
    assert "headings look like degrees" in fault(replace(small, heading=np.full(60, np.degrees(0.036))))


@pytest.mark.parametrize(
    ("heading", "says"),
    [
        (np.pi / 2, "headings look like radians clockwise from north"),
        (np.pi, "headings point backwards"),
        (3.0, "headings look like degrees counter-clockwise from +x"),
    ],
)
def test_the_likeliest_cause_is_that_which_fits_best(heading: float, says: str) -> None:
    """To the east at 12 m/s: 1.57 rad is 1.6 degrees off as degrees, and not at all as an angle from north."""
    east = replace(bend(), x=12.0 * TIME, y=0.0 * TIME, speed=np.full(60, 12.0))
    assert fault(replace(east, heading=np.full(60, heading))).endswith(says)


def test_negative_speeds_of_a_vehicle_that_drives_forwards_are_named() -> None:
    """To the west: drone data sets give the velocity along x, which is negative there."""
    west = bend(turned=np.pi)
    assert fault(west) == ""
    says = fault(replace(west, speed=-west.speed))
    assert says == "has the speed -9 m/s for 'a', which moves forwards: speeds look like velocities along an axis"


def test_angles_of_sumo_are_degrees_from_north() -> None:
    turned = bend(turned=2.0)
    assert fault(replace(turned, heading=90.0 - np.degrees(turned.heading), angles=SUMO_DEGREES)) == ""
    wrong = fault(replace(turned, angles=SUMO_DEGREES))
    assert "has the heading 2.05625 degrees for 'a'" in wrong
    assert wrong.endswith("headings look like radians counter-clockwise from +x")


@pytest.mark.parametrize(
    "motion",
    [
        replace(bend(3.0), heading=bend(3.0).heading + np.pi, speed=np.full(60, -3.0)),  # reversing
        replace(bend(3.0), heading=bend(3.0).heading + np.pi),  # the same with speeds without a sign
        replace(bend(), x=np.zeros(60), y=np.zeros(60), speed=np.zeros(60), heading=np.full(60, 1.0)),  # standing
        replace(bend(), heading=bend().heading + 0.3),  # skidding, by 17 degrees
        replace(bend(), heading=bend().heading * 0.0, kind="pedestrian", length=0.5, width=0.5),  # looks aside
        replace(bend(), y=bend().y + 3.2 * (TIME > 3.0)),  # changes lanes within a step, as SUMO's vehicles do
        replace(bend(), heading=bend().heading + 2 * np.pi, angles=UNWRAPPED),  # as in Waymo's records
    ],
)
def test_what_vehicles_do_raises_no_alarm(motion: GivenMotion) -> None:
    assert fault(motion) == ""


def test_one_noisy_object_of_three_is_no_wrong_unit_and_two_are() -> None:
    aside = replace(bend(), heading=bend().heading + 1.2)
    assert fault(bend(), bend(), aside, noisy=True) == ""
    assert "which moves towards" in fault(bend(), aside, aside, noisy=True)
    assert "speeds look like km/h" in fault(bend(), bend(), replace(bend(), speed=bend().speed * 3.6), noisy=True)


def test_a_building_that_somebody_recorded_is_no_vehicle_in_feet() -> None:
    """CommonRoad's static obstacles of all types come as vehicles: 20 by 30 m stand there, but do not drive."""
    house = replace(bend(), x=np.zeros(60), y=np.zeros(60), speed=np.zeros(60), length=20.0, width=30.0)
    assert fault(bend(), house, house, noisy=True) == ""
    in_feet = scaled(3.28084)(bend())
    assert "sizes look like feet" in fault(in_feet, in_feet, house, noisy=True)


@pytest.mark.parametrize("rate", [10.0, 25.0, 30.0, 29.97, 60.0])
def test_rounded_times_give_the_step_that_was_meant(rate: float) -> None:
    """A minute, in milliseconds; at 30 Hz the least difference is 0.033 s, 1 % too short."""
    rounded = np.round(np.arange(int(60 * rate)) / rate, 3)
    grid, off = even_grid(rounded)
    assert len(grid) == len(rounded) and off.max() < 1e-3 and off_grid(rounded) is None


# ---- through judge


def columns(m: GivenMotion) -> dict[str, object]:
    return {
        "time": m.time, "x": m.x, "y": m.y, "heading": m.heading, "speed": m.speed, "length": np.full(60, m.length),
        "width": np.full(60, m.width),
    }  # fmt: skip


def test_judge_refuses_headings_in_degrees_with_the_state() -> None:
    ego, other = columns(bend()), columns(replace(bend(turned=1.0), x=bend(turned=1.0).x + 50.0))
    assert sumo_adv.judge(ego, other).collided is False
    with pytest.raises(UsageError, match=r"track of 'adversary' cannot be right: state 0 at 0 s has the heading 57"):
        sumo_adv.judge(ego, other | {"heading": np.degrees(bend(turned=1.0).heading)})


@pytest.mark.parametrize(
    ("at", "value", "says"),
    [
        (7, 0.6, "state 7 at 0.6 s comes twice"),
        (8, 0.65, "state 8 at 0.65 s comes after 0.7 s"),
        (8, 0.84, "must ascend in even steps"),
    ],
)
def test_judge_names_the_time_that_is_out_of_order(at: int, value: float, says: str) -> None:
    wrong = TIME.copy()
    wrong[at] = value
    with pytest.raises(UsageError, match=says):
        sumo_adv.judge(columns(bend()), columns(bend()) | {"time": wrong})


# ---- through records


def degrees(message: Any) -> Any:
    for track in message.tracks:
        for state in track.states:
            state.heading = np.degrees(state.heading)
    return message


def test_a_record_with_headings_in_degrees_is_refused_with_track_and_time(tmp_path: Path) -> None:
    """The first vehicle that does not go to the east has 90 degrees or more."""
    assert len(list(read_records(write(tmp_path / "right", four_way())))) == 1
    with pytest.raises(UsageError, match=r"its track \d at \d\.\d\d s has the heading -?\d+ rad .* look like degrees"):
        list(read_records(write(tmp_path / "wrong", degrees(four_way()))))


def test_a_record_with_speeds_in_kmh_is_refused(tmp_path: Path) -> None:
    message = straight()
    for track in message.tracks:
        for state in track.states:
            state.velocity_x *= 3.6
            state.velocity_y *= 3.6
    with pytest.raises(UsageError, match="speeds look like km/h"):
        list(read_records(write(tmp_path / "wrong", message)))


COMMONROAD = """<?xml version='1.0'?>
<commonRoad commonRoadVersion="2020a" benchmarkID="ZAM_Hand-1_1_T-1" timeStepSize="0.1">
<lanelet id="1"><leftBound><point><x>0</x><y>0</y></point><point><x>0</x><y>200</y></point></leftBound>
<rightBound><point><x>4</x><y>0</y></point><point><x>4</x><y>200</y></point></rightBound></lanelet>
<dynamicObstacle id="5"><type>car</type><shape><rectangle><length>4.0</length><width>1.8</width></rectangle></shape>
{states}</dynamicObstacle><planningProblem id="7">{ego}</planningProblem></commonRoad>"""


def commonroad(folder: Path, heading: float) -> Path:
    """A car that drives north at 10 m/s."""

    def state(tag: str, k: int, y: float, angle: float) -> str:
        values = (("orientation", angle), ("time", k), ("velocity", 10.0))
        exact = "".join(f"<{name}><exact>{value}</exact></{name}>" for name, value in values)
        return f"<{tag}><position><point><x>2.0</x><y>{y}</y></point></position>{exact}</{tag}>"

    later = "".join(state("state", k, 50.0 + k, heading) for k in range(1, 40))
    states = f"{state('initialState', 0, 50.0, heading)}<trajectory>{later}</trajectory>"
    file = folder / "north.xml"
    file.write_text(COMMONROAD.format(states=states, ego=state("initialState", 0, 10.0, 1.5708)), encoding="utf-8")
    return file


def test_a_commonroad_obstacle_in_degrees_is_refused(tmp_path: Path) -> None:
    assert len(read_commonroad(commonroad(tmp_path, 1.5708)).tracks) == 2
    with pytest.raises(UsageError, match=r"its track 5 at 0\.00 s has the heading 90 rad .* look like degrees"):
        read_commonroad(commonroad(tmp_path, 90.0))
