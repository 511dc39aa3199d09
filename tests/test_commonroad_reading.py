"""CommonRoad scenarios are read as commonroad-io reads them: versions, shapes, limits, lights, and what is left out."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_samples import Program
from shapely import Polygon, affinity

from sumo_adv.errors import UsageError
from sumo_adv.womd.commonroad import read_commonroad
from sumo_adv.womd.record import LANE_TYPES, SIGNAL_STATES, TRACK_KINDS, ObjectTrack, Record

STEPS = 3  # of every trajectory, behind the initial state


def point(x: float, y: float, tag: str = "point") -> str:
    return f"<{tag}><x>{x}</x><y>{y}</y></{tag}>"


def lanelet(number: int, start: float, end: float, links: str = "", y: float = 0.0) -> str:
    """To the east, 3.5 m wide, with its right bound at y."""
    bounds = "".join(
        f"<{name}>{point(start, at)}{point(end, at)}</{name}>"
        for name, at in (("leftBound", y + 3.5), ("rightBound", y))
    )
    return f'<lanelet id="{number}">{bounds}{links}</lanelet>'


def state(tag: str, step: int, x: float, y: float, heading: float = 0.0, speed: float | None = 5.0) -> str:
    velocity = "" if speed is None else f"<velocity><exact>{speed}</exact></velocity>"
    return (
        f"<{tag}><position>{point(x, y)}</position><orientation><exact>{heading}</exact></orientation>"
        f"<time><exact>{step}</exact></time>{velocity}</{tag}>"
    )


def obstacle(shape: str, *, heading: float = 0.0, role: str = "dynamicObstacle", kind: str = "car", number: int = 30,
             speed: float | None = 5.0, more: str = "") -> str:  # fmt: skip
    """At (50, 1.75), with a metre to the east each step where it moves."""
    states = "".join(state("state", k, 50.0 + k, 1.75, heading, speed) for k in range(1, 1 + STEPS))
    moves = role == "dynamicObstacle" or "dynamic" in more
    return (
        f'<{role} id="{number}">{more}<type>{kind}</type><shape>{shape}</shape>'
        f"{state('initialState', 0, 50.0, 1.75, heading, speed)}"
        f"{f'<trajectory>{states}</trajectory>' if moves else ''}</{role}>"
    )


RECTANGLE = "<rectangle><length>4.5</length><width>1.8</width></rectangle>"
MORE = "<yawRate><exact>0</exact></yawRate><slipAngle><exact>0</exact></slipAngle></initialState>"
START = state("initialState", 0, 20.0, 1.75).replace("</initialState>", MORE)
GOAL = "<time><intervalStart>1</intervalStart><intervalEnd>9</intervalEnd></time>"
PROBLEM = f'<planningProblem id="100">{START}<goalState>{GOAL}</goalState></planningProblem>'
LANE = lanelet(1, 0.0, 300.0)


def write(folder: Path, *parts: str, version: str | None = "2020a", name: str = "ZAM_Hand-1_1_T-1") -> Path:
    file = folder / "hand.xml"
    given = "" if version is None else f'commonRoadVersion="{version}"'
    file.write_text(
        f'<commonRoad {given} benchmarkID="{name}" timeStepSize="0.1" author="" affiliation="" source="" tags="">'
        f"<scenarioTags/>{''.join(parts)}</commonRoad>",
        encoding="utf-8",
    )
    return file


def theirs(file: Path) -> Any:
    """The scenario as commonroad-io reads it."""
    reader = pytest.importorskip("commonroad.common.file_reader", reason="needs commonroad-io")
    return reader.CommonRoadFileReader(str(file)).open()[0]


def box(track: ObjectTrack, step: int) -> Polygon:
    length, width = track.length[step] / 2, track.width[step] / 2
    plain = Polygon([(-length, -width), (length, -width), (length, width), (-length, width)])
    turned = affinity.rotate(plain, track.heading[step], origin=(0, 0), use_radians=True)
    return affinity.translate(turned, track.x[step], track.y[step])


# -- versions


def test_places_may_be_those_of_utm(tmp_path: Path) -> None:
    """Maps of many converters: 48 degrees north are 5,300 km from the equator."""
    lane, problem = lanelet(1, 500_000.0, 500_300.0, y=5.3e6), PROBLEM.replace("20.0<", "500020.0<")
    record = read_commonroad(write(tmp_path, lane, problem.replace("1.75<", "5300001.75<")))
    assert np.allclose(record.lanes[1].points[0, :2], (500_000.0, 5_300_001.75))
    assert (record.tracks[0].x[0], record.tracks[0].y[0]) == (500_020.0, 5_300_001.75)


@pytest.mark.parametrize("version", ["2017a", "2018a", "2023a", "x"])
def test_another_format_is_refused_by_its_name(tmp_path: Path, version: str) -> None:
    """commonroad-io 2022.1 reads two: ``SUPPORTED_COMMONROAD_VERSIONS``."""
    with pytest.raises(UsageError, match=rf"hand\.xml is a CommonRoad scenario of the format {version}: give one of"):
        read_commonroad(write(tmp_path, LANE, PROBLEM, version=version))


def test_a_file_without_a_format_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="names no CommonRoad format"):
        read_commonroad(write(tmp_path, LANE, PROBLEM, version=None))


def test_format_2018b_has_its_obstacles_and_limits(tmp_path: Path) -> None:
    """Obstacles with a role, and a limit in the lanelet: as commonroad-io has them in its objects."""
    file = write(
        tmp_path, lanelet(1, 0.0, 300.0, "<speedLimit>8.33</speedLimit>"),
        obstacle(RECTANGLE, role="obstacle", more="<role>dynamic</role>"),
        obstacle(RECTANGLE, role="obstacle", more="<role>static</role>", number=31, kind="parkedVehicle"),
        PROBLEM, version="2018b", name="DEU_Hand-1_1_T-1",
    )  # fmt: skip
    record, scenario = read_commonroad(file), theirs(file)
    assert record.lanes[1].speed_limit == limit_of(scenario, 1) == 8.33
    _, moving, parked = record.tracks
    assert [each.id for each in (moving, parked)] == [30, 31]
    assert np.allclose(moving.x, [50.0, 51.0, 52.0, 53.0]) and parked.valid.all()
    for track in (moving, parked):
        their = scenario.obstacle_by_id(track.id).occupancy_at_time(2).shape.shapely_object
        assert box(track, 2).symmetric_difference(their).area < 1e-6


# -- shapes

SHAPES = {
    "turned": "<rectangle><length>4.5</length><width>1.8</width><orientation>0.6</orientation></rectangle>",
    "across": "<rectangle><length>1.8</length><width>4.5</width><orientation>1.5707963</orientation></rectangle>",
    "moved": f"<rectangle><length>4.5</length><width>1.8</width>{point(1.5, -0.4, 'center')}</rectangle>",
    "both": "<rectangle><length>4.5</length><width>1.8</width><orientation>-2.0</orientation>"
    f"{point(0.7, 2.0, 'center')}</rectangle>",
    "polygon": f"<polygon>{point(-1.0, -0.9)}{point(3.5, -0.9)}{point(3.5, 0.9)}{point(-1.0, 0.9)}</polygon>",
    "tilted polygon": f"<polygon>{point(0, 0)}{point(4, 3)}{point(3.4, 3.8)}{point(-0.6, 0.8)}</polygon>",
}


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
@pytest.mark.parametrize("role", ["dynamicObstacle", "staticObstacle"])
def test_a_shape_covers_what_commonroad_says(tmp_path: Path, shape: str, role: str) -> None:
    """With a heading of 0.5 rad; a rectangle is covered exactly, as these polygons are rectangles."""
    file = write(tmp_path, LANE, obstacle(shape, heading=0.5, role=role), PROBLEM)
    (_, track), their = read_commonroad(file).tracks, theirs(file).obstacle_by_id(30)
    for step in range(2 if role == "staticObstacle" else 1 + STEPS):
        shown = their.occupancy_at_time(step).shape.shapely_object
        assert box(track, step).symmetric_difference(shown).area < 1e-5
    assert abs(track.heading[0] - 0.5) <= math.pi / 4 + 1e-6  # the front stays in front


def test_a_shape_moves_as_its_obstacle_does(tmp_path: Path) -> None:
    """The box is turned against the heading; the motion is along the heading."""
    (_, track) = read_commonroad(write(tmp_path, LANE, obstacle(SHAPES["turned"], heading=0.5), PROBLEM)).tracks
    assert (track.vx[0], track.vy[0]) == pytest.approx((5.0 * math.cos(0.5), 5.0 * math.sin(0.5)))


def test_a_circle_becomes_the_box_around_it(tmp_path: Path) -> None:
    circle = f"<circle><radius>0.4</radius>{point(0.5, 0.0, 'center')}</circle>"
    (_, track) = read_commonroad(
        write(tmp_path, LANE, obstacle(circle, heading=2.0, kind="pedestrian"), PROBLEM)
    ).tracks
    assert (track.length[0], track.width[0], track.x[0], track.y[0]) == pytest.approx((0.8, 0.8, 50.5, 1.75))
    assert track.kind == TRACK_KINDS.index("pedestrian")


def test_every_shape_of_a_group_is_an_object(tmp_path: Path) -> None:
    """commonroad-io turns each about its own centre. The second gets a number that nothing else has."""
    trailer = f"<rectangle><length>6</length><width>2</width>{point(-6.0, 0.0, 'center')}</rectangle>"
    file = write(tmp_path, LANE, obstacle(RECTANGLE + trailer, heading=0.5), PROBLEM)
    (_, *tracks), their = read_commonroad(file).tracks, theirs(file).obstacle_by_id(30)
    assert [track.id for track in tracks] == [30, 101]
    for track, shape in zip(tracks, their.occupancy_at_time(2).shape.shapes, strict=True):
        assert box(track, 2).symmetric_difference(shape.shapely_object).area < 1e-6


def test_things_beside_the_road_are_no_vehicles(tmp_path: Path) -> None:
    site = obstacle(RECTANGLE, role="staticObstacle", kind="constructionZone")
    boundary = obstacle(RECTANGLE, role="staticObstacle", kind="roadBoundary", number=31)
    record = read_commonroad(write(tmp_path, LANE, site, boundary, PROBLEM))
    assert [(t.id, TRACK_KINDS[t.kind]) for t in record.tracks] == [(100, "vehicle"), (30, "other")]
    assert record.notes == ("Left out of hand.xml: 1 road boundary.",)


def test_a_speed_that_is_not_given_comes_of_the_places(tmp_path: Path) -> None:
    """1 m in a step of 0.1 s, also at the last step."""
    (_, track) = read_commonroad(write(tmp_path, LANE, obstacle(RECTANGLE, speed=None), PROBLEM)).tracks
    assert track.vx.tolist() == pytest.approx([10.0] * 4)


def test_places_given_as_regions_are_their_middle(tmp_path: Path) -> None:
    region = f"<polygon>{point(19, 1)}{point(21, 1)}{point(21, 3)}{point(19, 3)}</polygon>"
    record = read_commonroad(write(tmp_path, LANE, PROBLEM.replace(point(20.0, 1.75), region)))
    assert (record.tracks[0].x[0], record.tracks[0].y[0]) == pytest.approx((20.0, 2.0))


# -- lanes


def sign(number: int, *elements: tuple[str, float]) -> str:
    inside = "".join(
        f"<trafficSignElement><trafficSignID>{name}</trafficSignID><additionalValue>{value}</additionalValue>"
        "</trafficSignElement>"
        for name, value in elements
    )
    return f'<trafficSign id="{number}">{inside}{f"<position>{point(0, 0)}</position>"}</trafficSign>'


def limit_of(scenario: Any, lanelet: int) -> float | None:
    """The least MAX_SPEED of the lanelet's signs in commonroad-io's own catalogue of the country [m/s]."""
    network = scenario.lanelet_network
    signs = (network.find_traffic_sign_by_id(n) for n in network.find_lanelet_by_id(lanelet).traffic_signs)
    elements = [
        e for each in signs for e in each.traffic_sign_elements if e.traffic_sign_element_id.name == "MAX_SPEED"
    ]
    return min((float(e.additional_values[0]) for e in elements), default=None)


COUNTRIES = ["DEU", "USA", "CHN", "ESP", "RUS", "ARG", "BEL", "FRA", "GRC", "HRV", "ITA", "PRI", "ZAM", "AUS"]


@pytest.mark.parametrize("country", COUNTRIES)
def test_a_limit_is_the_sign_of_its_country(tmp_path: Path, country: str) -> None:
    """commonroad-io's ``TrafficSignIDxxx.MAX_SPEED``; the value is in m/s everywhere. AUS has Zamunda's signs.

    A cooperative scenario has ``C-`` before its country.
    """
    lane = lanelet(1, 0.0, 300.0, '<trafficSignRef ref="9"/>')
    found = []
    for prefix in ("", "C-"):
        for sign_id in ("274", "R2-1", "r301"):
            file = write(tmp_path, lane, sign(9, (sign_id, 13.41)), PROBLEM, name=f"{prefix}{country}_Hand-1_1_T-1")
            record = read_commonroad(file)
            limit = record.lanes[1].speed_limit or None
            assert limit == limit_of(theirs(file), 1)
            assert (limit is None) == (f"1 sign {sign_id}" in " ".join(record.notes))
            found.append(limit)
    assert found.count(13.41) == 2


def test_the_least_of_several_limits_holds(tmp_path: Path) -> None:
    """As commonroad-io's ``TrafficSigInterpreter.speed_limit``."""
    lane = lanelet(1, 0.0, 300.0, '<trafficSignRef ref="8"/><trafficSignRef ref="9"/>')
    file = write(tmp_path, lane, sign(8, ("274", 20.0)), sign(9, ("274", 15.0), ("276", 0.0)), PROBLEM)
    interpreter = pytest.importorskip("commonroad.scenario.traffic_sign_interpreter", reason="needs commonroad-io")
    signs = pytest.importorskip("commonroad.scenario.traffic_sign", reason="needs commonroad-io")
    zamunda = signs.SupportedTrafficSignCountry.ZAMUNDA
    said = interpreter.TrafficSigInterpreter(zamunda, theirs(file).lanelet_network).speed_limit(frozenset({1}))
    assert read_commonroad(file).lanes[1].speed_limit == said == 15.0


def test_lanelets_for_pedestrians_and_cyclists_are_no_roads(tmp_path: Path) -> None:
    kinds = ("sidewalk", "crosswalk", "bicycleLane", "busLane")
    parts = [lanelet(k, 0.0, 300.0, f"<laneletType>{kind}</laneletType>", y=4.0 * k) for k, kind in enumerate(kinds, 2)]
    record = read_commonroad(write(tmp_path, LANE, *parts, PROBLEM))
    assert {n: LANE_TYPES[lane.kind] for n, lane in record.lanes.items()} == {1: "surface", 4: "bike", 5: "surface"}
    assert [(area.id, area.kind) for area in record.areas] == [(3, "crosswalk")]
    assert record.notes == ("Left out of hand.xml: 1 sidewalk, 1 closing of a bus lane to cars.",)


# -- lights

CYCLE = (("red", 2), ("redYellow", 1), ("green", 3), ("yellow", 1))
LETTERS = {"red": "stop", "redYellow": "stop", "yellow": "caution", "green": "go"}


def light(number: int, direction: str = "all", offset: int = 0) -> str:
    cycle = "".join(f"<cycleElement><duration>{n}</duration><color>{c}</color></cycleElement>" for c, n in CYCLE)
    return (
        f'<trafficLight id="{number}"><cycle>{cycle}<timeOffset>{offset}</timeOffset></cycle>'
        f"<position>{point(0, 0)}</position><direction>{direction}</direction></trafficLight>"
    )


JUNCTION = (
    lanelet(2, 100.0, 200.0, '<predecessor ref="1"/>'), lanelet(3, 100.0, 200.0, '<predecessor ref="1"/>', y=3.0),
    '<intersection id="70"><incoming id="71"><incomingLanelet ref="1"/><successorsStraight ref="2"/>'
    '<successorsLeft ref="3"/></incoming></intersection>',
)  # fmt: skip


def arm(*lights: int) -> str:
    links = "".join(f'<trafficLightRef ref="{n}"/>' for n in lights)
    return lanelet(1, 0.0, 100.0, f'<successor ref="2"/><successor ref="3"/>{links}')


def states(record: Record, lane: int) -> list[str]:
    return [SIGNAL_STATES[s.state] for step in record.signals for s in step if s.lane == lane]


@pytest.mark.parametrize("offset", [0, 2, 9])
def test_lights_show_what_commonroad_says(tmp_path: Path, offset: int) -> None:
    """For both lanelets behind the light, over a log of 20 steps."""
    long = obstacle(RECTANGLE).replace("<time><exact>3</exact></time>", "<time><exact>19</exact></time>")
    file = write(tmp_path, arm(50), *JUNCTION, light(50, offset=offset), long, PROBLEM)
    record, their = read_commonroad(file), theirs(file).lanelet_network.find_traffic_light_by_id(50)
    expected = [LETTERS[their.get_state_at_time_step(k).value] for k in range(20)]
    assert states(record, 2) == states(record, 3) == expected
    assert record.lanes[2].interpolating and not record.lanes[1].interpolating


def test_a_light_rules_the_turns_of_its_direction(tmp_path: Path) -> None:
    record = read_commonroad(
        write(tmp_path, arm(50, 51), *JUNCTION, light(50, "left"), light(51, "straightRight", 1), PROBLEM)
    )
    assert [states(record, lane)[0] for lane in (2, 3)] == ["caution", "stop"]


def test_a_network_with_lights_is_made(program: Program) -> None:
    write(program.folder, arm(50), *JUNCTION, light(50), obstacle(RECTANGLE), PROBLEM)
    done = program.here("convert", "hand.xml", "--out", "made", "--no-traffic")
    assert done.status == 0, done.err
    assert "<tlLogic" in (program.folder / "made" / "ZAM_Hand-1_1_T-1" / "network.net.xml").read_text(encoding="utf-8")


# -- what is said, and refused


def test_what_is_left_out_is_said_by_every_command(program: Program) -> None:
    phantom = '<phantomObstacle id="40"/><environmentObstacle id="41"/>'
    cloud = obstacle(RECTANGLE, number=42).replace("</dynamicObstacle>", "<occupancySet/></dynamicObstacle>")
    write(
        program.folder,
        LANE,
        obstacle(RECTANGLE),
        phantom,
        cloud,
        PROBLEM,
        PROBLEM.replace("100", "101"),
        sign(9, ("206", 0)),
    )
    said = (
        "Left out of hand.xml: 1 sign 206, 1 further planning problem, 1 prediction as an occupancy set, "
        "1 environmentObstacle, 1 phantomObstacle."
    )
    assert said in program.here("convert", "hand.xml", "--out", "made", "--no-traffic").out
    run = program.here("run", "hand.xml", "--learn", "off", "--attempts", "1", "--out", "out")
    assert said in run.out, run.err


@pytest.mark.parametrize("country", ["GBR", "AUS"])
def test_left_hand_traffic_is_said(tmp_path: Path, country: str) -> None:
    (note,) = read_commonroad(write(tmp_path, LANE, PROBLEM, name=f"{country}_Hand-1_1_T-1")).notes
    assert note == f"hand.xml is from {country}: its lanes are kept, but right of way is as in right-hand traffic."


@pytest.mark.parametrize(
    ("parts", "says"),
    [
        ((LANE, obstacle("<cube/>"), PROBLEM), "an obstacle has the shape cube"),
        ((LANE, obstacle(""), PROBLEM), "obstacle 30 has an empty shape"),
        ((arm(50), *JUNCTION, light(50).replace("3</duration>", "-9</duration>"), PROBLEM), "a cycle of -5 steps"),
        ((LANE, obstacle(f"<polygon>{point(0, 0)}{point(1, 1)}{point(2, 2)}</polygon>"), PROBLEM), "has no area"),
        ((LANE, PROBLEM.replace("<time><exact>0</exact>", "<time><exact>-1</exact>")), "a state has the time step -1"),
        ((LANE, PROBLEM.replace("<time><exact>0</exact>", "<time><exact>1e9</exact>")), "more than the 3600 s that"),
        ((LANE, obstacle(RECTANGLE, role="obstacle", more="<role>ghost</role>"), PROBLEM), "has the role 'ghost'"),
    ],
)  # fmt: skip
def test_what_cannot_be_right_is_one_sentence(tmp_path: Path, parts: tuple[str, ...], says: str) -> None:
    with pytest.raises(UsageError, match=says) as refused:
        read_commonroad(write(tmp_path, *parts))
    assert "hand.xml" in str(refused.value)
