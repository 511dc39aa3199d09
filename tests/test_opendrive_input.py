"""OpenDRIVE as its standard means it: limits, the side of the road, types of lanes, heights, and what is refused."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from cli_samples import Program

from sumo_adv.errors import UsageError
from sumo_adv.simulation.inputs import load_input
from sumo_adv.simulation.maps import MapConversion, convert_map

LENGTH = 300.0  # m of every road here


def lane(number: int, kind: str = "driving", *, speeds: str = "", width: float = 3.5, attributes: str = "") -> str:
    return (
        f'<lane id="{number}" type="{kind}" {attributes}><link/>'
        f'<width sOffset="0" a="{width}" b="0" c="0" d="0"/>{speeds}</lane>'
    )


def road(
    name: int, right: str = "", left: str = "", *, types: str = "", y: float = 0.0, attributes: str = "", more: str = ""
) -> str:
    """To the east, beginning at (0, y)."""
    sides = (f"<left>{left}</left>" * bool(left), f"<right>{right}</right>" * bool(right))
    return (
        f'<road name="" id="{name}" length="{LENGTH}" junction="-1" {attributes}><link/>{types}<planView>'
        f'<geometry s="0" x="0" y="{y}" hdg="0" length="{LENGTH}"><line/></geometry></planView>{more}<lanes>'
        f'<laneSection s="0">{sides[0]}<center><lane id="0" type="none"/></center>{sides[1]}</laneSection></lanes>'
        "</road>"
    )


def write(folder: Path, *parts: str, head: str = "<OpenDRIVE>", version: str = "1") -> Path:
    file = folder / "drawn.xodr"
    header = f'<header revMajor="{version}" revMinor="8" north="0" south="0" east="0" west="0"/>'
    file.write_text(f"<?xml version='1.0'?>{head}{header}{''.join(parts)}</OpenDRIVE>", encoding="utf-8")
    return file


def converted(folder: Path, *parts: str, head: str = "<OpenDRIVE>") -> MapConversion:
    return convert_map(write(folder, *parts, head=head), cache=folder / "cache")


def lanes(made: MapConversion) -> dict[str, dict[str, str]]:
    """The lanes of edges by their id, whose sign netconvert gives by the side of the road."""
    edges = (e for e in ElementTree.parse(made.network).getroot().iter("edge") if e.get("function") is None)
    return {each.attrib["id"]: each.attrib for edge in edges for each in edge.iter("lane")}


def speeds(made: MapConversion) -> list[float]:
    return [float(each["speed"]) for each in lanes(made).values()]


def ends(lane: dict[str, str]) -> list[list[float]]:
    """The first and the last point of a lane."""
    points = [[float(v) for v in point.split(",")] for point in lane["shape"].split()]
    return [points[0], points[-1]]


# -- limits


@pytest.mark.parametrize(
    ("limit", "metres_per_second"),
    [
        ('max="80" unit="km/h"', 22.22), ('max=" 80 " unit=" km/h "', 22.22),
        ('max="30" unit="mph"', 13.41), ('max="22.22" unit="m/s"', 22.22),
        ('max="22.22"', 22.22), ('max="no limit"', 39.44), ('max="undefined"', 13.89), ('max="-1"', 13.89),
    ],
)  # fmt: skip
def test_the_limit_of_a_road_type_is_the_limit_of_its_lanes(
    tmp_path: Path, limit: str, metres_per_second: float
) -> None:
    """ASAM OpenDRIVE 1.8, 10.3 (road type) and e_unitSpeed: m/s is the default; 13.89 is SUMO's own for driving."""
    types = f'<type s="0" type="town"><speed {limit}/></type>'
    assert speeds(converted(tmp_path, road(1, lane(-1), types=types))) == [metres_per_second]
    own = f'<speed sOffset="0" {limit}/>'
    assert speeds(converted(tmp_path, road(1, lane(-1, speeds=own)))) == [metres_per_second]


def test_limits_change_along_the_road_and_a_lane_goes_before_its_road(tmp_path: Path) -> None:
    """50 km/h, from 100 m on 80 km/h; the lane itself has 20 m/s from 200 m on, and nothing before."""
    types = "".join(
        f'<type s="{s}" type="town"><speed max="{limit}" unit="km/h"/></type>' for s, limit in ((0, 50), (100, 80))
    )
    made = converted(tmp_path, road(1, lane(-1, speeds='<speed sOffset="200" max="20"/>'), types=types))
    pieces = [(float(each["length"]), float(each["speed"])) for each in lanes(made).values()]
    assert pieces == [(100.0, 13.89), (100.0, 22.22), (100.0, 20.0)]


def test_a_limit_that_begins_in_a_later_section_closes_no_lane(tmp_path: Path) -> None:
    """50 km/h, from 200 m on 80 km/h; from 100 m on, there are two lanes with 20 m/s of their own."""
    types = "".join(
        f'<type s="{s}" type="town"><speed max="{limit}" unit="km/h"/></type>' for s, limit in ((0, 50), (200, 80))
    )
    own = '<speed sOffset="0" max="20"/>'
    wider = road(1, lane(-1, speeds=own) + lane(-2, speeds=own)).replace('<laneSection s="0">', '<laneSection s="100">')
    section = wider[wider.index("<laneSection") : wider.index("</lanes>")]
    made = converted(tmp_path, road(1, lane(-1), types=types).replace("</lanes>", f"{section}</lanes>"))
    assert sorted((float(each["length"]), float(each["speed"])) for each in lanes(made).values()) == [
        (96.0, 13.89), (196.0, 20.0), (196.0, 20.0),
    ]  # fmt: skip
    assert not made.warnings  # 4 m on either side are the junction in which the road widens


def test_a_type_without_a_limit_ends_the_limit_before_it(tmp_path: Path) -> None:
    types = '<type s="0" type="town"><speed max="30"/></type><type s="150" type="rural"/>'
    assert speeds(converted(tmp_path, road(1, lane(-1), types=types))) == [30.0, 13.89]


def test_limits_are_not_for_sidewalks(tmp_path: Path) -> None:
    types = '<type s="0" type="town"><speed max="20"/></type>'
    made = converted(tmp_path, road(1, lane(-1) + lane(-2, "sidewalk"), types=types))
    assert sorted(speeds(made)) == [2.78, 20.0]


# -- the side of the road


@pytest.mark.parametrize("attributes", ['rule="LHT"', 'rule="lht"'], ids=["as the standard writes it", "in lower case"])
def test_left_hand_lanes_are_where_the_road_has_them(tmp_path: Path, attributes: str) -> None:
    """ASAM OpenDRIVE 1.8, 11.1: with LHT the lanes with positive numbers, to the left, go along the road.

    Two of them, 3.5 and 3 m wide, have their centres at y = 1.75 and 5; the one to the right comes back at y = -1.75.
    """
    left = lane(2, width=3.0) + lane(1)
    made = converted(tmp_path, road(1, lane(-1), left, attributes=attributes))
    assert "--lefthand" in made.options and "left-hand traffic" in made.said[0]
    places = sorted(ends(each) for each in lanes(made).values())
    assert places == [[[0.0, 1.75], [LENGTH, 1.75]], [[0.0, 5.0], [LENGTH, 5.0]], [[LENGTH, -1.75], [0.0, -1.75]]]


JUNCTION = """
<road id="10" length="20" junction="9" {rule}><link><predecessor elementType="road" elementId="1" contactPoint="end"/>
<successor elementType="road" elementId="2" contactPoint="start"/></link><planView><geometry s="0" x="300" y="0" hdg="0"
length="20"><line/></geometry></planView><lanes><laneSection s="0"><left><lane id="1" type="driving"><link><predecessor
id="1"/><successor id="1"/></link><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></left><center><lane id="0"
type="none"/></center></laneSection></lanes></road><junction id="9" name=""><connection id="0" incomingRoad="1"
connectingRoad="10" contactPoint="start"><laneLink from="1" to="1"/></connection></junction>"""


def two_roads(rule: str, within: str) -> tuple[str, str, str]:
    """Two roads one way to the east, of a lane on the left, with a junction between them."""
    first = road(1, left=lane(1), attributes=rule)
    second = road(2, left=lane(1), attributes=rule)
    before, after = (
        '<predecessor elementType="junction" elementId="9"/>',
        '<successor elementType="junction" elementId="9"/>',
    )
    return (
        first.replace("<link/><planView>", f"<link>{after}</link><planView>"),
        second.replace("<link/><planView>", f"<link>{before}</link><planView>").replace('x="0"', 'x="320"'),
        JUNCTION.format(rule=within),
    )


@pytest.mark.parametrize("within", ["", 'rule="LHT"'])
def test_a_connecting_road_drives_on_the_side_of_its_arms(tmp_path: Path, within: str) -> None:
    made = converted(tmp_path, *two_roads('rule="LHT"', within))
    assert "left-hand traffic" in made.said[0]
    assert sorted(ends(each) for each in lanes(made).values()) == [
        [[0.0, 1.75], [300.0, 1.75]], [[320.0, 1.75], [620.0, 1.75]],
    ]  # fmt: skip
    links = ElementTree.parse(made.network).getroot().iter("connection")
    assert [(c.get("from"), c.get("to")) for c in links if not c.attrib["from"].startswith(":")] == [("-1", "-2")]


def test_traffic_on_both_sides_is_refused(tmp_path: Path) -> None:
    """A road without a rule is right-hand (ASAM OpenDRIVE 1.8, 10: t_road, rule)."""
    file = write(tmp_path, road(4, lane(-1), attributes='rule="LHT"'), road(7, lane(-1), y=50.0))
    with pytest.raises(UsageError, match=r"road 4 drive on the left, road 7 on the right") as refused:
        convert_map(file, cache=tmp_path / "cache")
    assert "drawn.xodr" in str(refused.value)


def test_a_footpath_has_no_side(tmp_path: Path) -> None:
    roads = road(1, left=lane(1), attributes='rule="LHT"'), road(2, lane(-1, "sidewalk"), y=50.0)
    assert "left-hand traffic" in converted(tmp_path, *roads).said[0]


def test_lanes_in_reversed_direction_change_the_side(tmp_path: Path) -> None:
    """ASAM OpenDRIVE 1.8, lane direction: reversed lanes of a right-hand road go as those of a left-hand road."""
    both = lane(-1, attributes='direction="reversed"'), lane(1, attributes='direction="reversed"')
    made = converted(tmp_path, road(1, *both, attributes='rule="RHT"'))
    assert sorted(ends(each)[0] for each in lanes(made).values()) == [[0.0, 1.75], [LENGTH, -1.75]]
    mixed = road(1, lane(-1) + lane(-2, attributes='direction="reversed"'))
    with pytest.raises(UsageError, match="road 1 with lanes in their standard and in reversed direction"):
        converted(tmp_path, mixed)


def test_a_lane_for_both_directions_is_said(tmp_path: Path) -> None:
    made = converted(tmp_path, road(1, lane(-1, attributes='direction="both"')))
    assert made.lost == {"second direction of a lane for both": 1}


# -- roads and lanes


def test_a_turn_lane_for_both_directions_is_said(tmp_path: Path) -> None:
    made = converted(tmp_path, road(1, lane(-1, "bidirectional") + lane(-2), lane(1)))
    assert made.lost == {"second direction of a lane for both": 1}


def test_a_road_without_junctions_runs(program: Program) -> None:
    write(program.folder, road(1, lane(-1) + lane(-2)))
    done = program.here(
        "run", "drawn.xodr", "--until", "collision", "--learn", "off", "--attempts", "3", "--out", "out"
    )
    assert done.status == 0, done.err
    assert "1 edges with 2 lanes for cars" in done.out


def test_every_type_of_lane_has_its_classes_and_its_place(tmp_path: Path) -> None:
    """From the inside, 3.5 m wide each; the shoulder between two lanes is kept as a closed lane, the last one goes."""
    kinds = {
        "driving": "passenger", "bus": "bus", "shoulder": "", "biking": "bicycle", "sidewalk": "pedestrian",
        "walking": "pedestrian", "border": None,
    }  # fmt: skip
    right = "".join(lane(-k, kind) for k, kind in enumerate(kinds, 1))
    left = lane(4, "slipLane") + lane(3, "taxi") + lane(2, "HOV") + lane(1, "connectingRamp")
    made = converted(tmp_path, road(1, right, left))
    by_place = {ends(each)[0][1]: each for each in lanes(made).values()}
    for k, allowed in enumerate(kinds.values()):
        if allowed is not None:
            found = by_place.pop(-1.75 - 3.5 * k)
            assert may(found) & {"passenger", "bus", "bicycle", "pedestrian"} >= ({allowed} if allowed else set())
            assert "passenger" not in may(found) or allowed == "passenger"
    assert {y: "passenger" in may(each) for y, each in by_place.items()} == {
        1.75: True,
        5.25: False,
        8.75: False,
        12.25: True,
    }
    assert made.lost == {"lane border": 1}


@pytest.mark.parametrize("kind", ["median", "none", "border", "shoulder", "curb", "special1"])
def test_what_lies_in_the_middle_of_a_road_keeps_lanes_apart(tmp_path: Path, kind: str) -> None:
    """2 m of something on both sides of the reference line: lanes of 3.5 m have their middle at 3.75 m."""
    made = converted(
        tmp_path, road(1, lane(-1, kind, width=2.0) + lane(-2), lane(2) + lane(1, kind, width=2.0))
    )  # fmt: skip
    places = {ends(each)[0][1] for each in lanes(made).values() if "passenger" in may(each)}
    assert places == {-3.75, 3.75}
    assert not made.lost


def test_a_lane_without_a_width_takes_no_place(tmp_path: Path) -> None:
    without = '<lane id="-1" type="none"/>'
    (only,) = lanes(converted(tmp_path, road(1, without + lane(-2)))).values()
    assert ends(only)[0][1] == -1.75


@pytest.mark.parametrize("attributes", ["", 'rule="LHT"'])
def test_borders_say_how_wide_lanes_are(tmp_path: Path, attributes: str) -> None:
    """Outer borders at 2.5 and 5.5 m to the right; to the left one at 3 m beyond a lane that has a width of 1 m."""
    right = bordered(-1, -2.5) + bordered(-2, -5.5)
    left = bordered(2, 4.0) + lane(1, "biking", width=1.0)
    made = converted(tmp_path, road(1, right, left, attributes=attributes))
    found = {(abs(ends(each)[0][1]) * np.sign(ends(each)[0][1]), float(each["width"])) for each in lanes(made).values()}
    assert found == {(-1.25, 2.5), (-4.0, 3.0), (0.5, 1.0), (2.5, 3.0)}


def test_borders_that_change_along_the_road_give_widths_from_there(tmp_path: Path) -> None:
    """The inner border goes out by 0.01 m a metre. At 100 m it is at 3.5 m, where the outer one jumps to 7.5 m; at
    300 m it is at 5.5 m. netconvert takes the largest width of a piece of road."""
    inner, outer = bordered(-1, -2.5, slope=-0.01), bordered(-2, -5.0, then=(100.0, -7.5))
    *_, at_the_kerb, in_the_middle = lanes(converted(tmp_path, road(1, inner + outer))).values()
    assert (float(at_the_kerb["width"]), float(in_the_middle["width"])) == (4.0, 5.5)


def bordered(number: int, at: float, *, slope: float = 0.0, then: tuple[float, float] | None = None) -> str:
    """A lane with its outer border, which jumps to another place at an offset ``then`` [m]."""
    later = "" if then is None else f'<border sOffset="{then[0]}" a="{then[1]}" b="0" c="0" d="0"/>'
    border = f'<border sOffset="0" a="{at}" b="{slope}" c="0" d="0"/>{later}'
    return f'<lane id="{number}" type="driving"><link/>{border}</lane>'


def may(lane: dict[str, str]) -> set[str]:
    classes = {"passenger", "bus", "bicycle", "pedestrian", "taxi", "hov"}
    if "allow" in lane:
        return set(lane["allow"].split()) & classes
    shut = lane.get("disallow", "").split()
    return set() if "all" in shut else classes - set(shut)


def test_heights_are_kept(tmp_path: Path) -> None:
    """5 m at the beginning, and 2 % up: 11 m after 300 m."""
    more = '<elevationProfile><elevation s="0" a="5" b="0.02" c="0" d="0"/></elevationProfile>'
    (only,) = lanes(converted(tmp_path, road(1, lane(-1), more=more))).values()
    assert np.allclose(ends(only), [[0.0, -1.75, 5.0], [300.0, -1.75, 11.0]])


def test_signs_and_objects_are_said(tmp_path: Path) -> None:
    more = (
        '<objects><object id="1" s="1" t="1" type="tree"/></objects>'
        '<signals><signal id="2" s="1" t="1" dynamic="no" type="274" orientation="+"/>'
        '<signal id="3" s="1" t="1" dynamic="yes" type="warning board" orientation="+"/></signals>'
    )
    one = road(1, lane(-1)).replace("</road>", f"{more}</road>")
    assert converted(tmp_path, one).lost == {"sign": 1, "dynamic signal": 1, "object": 1}


@pytest.mark.parametrize("kind", ["1000001", "1.000.011"])
def test_traffic_lights_are_kept(tmp_path: Path, kind: str) -> None:
    """The standard's catalogue writes types with dots, files mostly without."""
    signals = f'<signals><signal id="2" s="299" t="2" dynamic="yes" type="{kind}" orientation="+"/></signals>'
    first, *others = two_roads('rule="LHT"', "")
    made = converted(tmp_path, first.replace("</road>", f"{signals}</road>"), *others)
    assert made.lost == {} and "1 traffic lights" in made.said[0]


def test_a_namespace_is_read(tmp_path: Path) -> None:
    made = converted(tmp_path, road(1, lane(-1)), head='<OpenDRIVE xmlns="http://example.org/opendrive">')
    assert len(lanes(made)) == 1


@pytest.mark.parametrize(
    ("part", "sentence"),
    [
        ('<include file="roads.xodr"/>', "includes other files (<include>): put all of the map into one file"),
        (road(1, lane(-1, "sidewalk")), "has no road for cars"),
        (road(1, lane(-1), attributes='rule="BOTH"'), 'road 1 with rule="BOTH": give RHT or LHT'),
        (road(1, lane(-1, speeds='<speed sOffset="0" max="5" unit="kn"/>')), 'a speed limit in "kn"'),
        (road(1, lane(-1, speeds='<speed sOffset="0" max="fast"/>')), 'a <speed> with max="fast": give a number'),
        (
            road(1, lane(-1)).replace('<lane id="-1"', '<lane id="first"'),
            'a <lane> with id="first": give a whole number',
        ),
        (road(1, lane(-1)) + road(1, lane(-1), y=50.0), "two roads with the id 1: give each its own"),
        (road(1, lane(-1)).replace('length="300.0"', 'length="1e12"'), "more than the 1e+07 m that are read"),
    ],
)
def test_what_cannot_be_right_is_refused_by_the_name_of_the_users_file(
    tmp_path: Path, part: str, sentence: str
) -> None:
    file = write(tmp_path, part)
    with pytest.raises(UsageError) as refused:
        load_input(file)
    assert sentence in str(refused.value) and str(file) in str(refused.value)


def test_another_version_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"is OpenDRIVE of version 2\.x: give version 1\.4 to 1\.8"):
        convert_map(write(tmp_path, road(1, lane(-1)), version="2"), cache=tmp_path / "cache")
