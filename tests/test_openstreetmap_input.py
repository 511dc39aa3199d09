"""OpenStreetMap as its mappers mean it: lanes for turns, buses and cycles, files in any order, and what is refused."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

from sumo_adv.errors import UsageError
from sumo_adv.simulation.maps import MapConversion, convert_map

NODES = {1: (48.0, 11.0), 2: (48.0, 11.004), 3: (48.0, 11.008), 4: (48.003, 11.004), 5: (47.997, 11.004)}
Tags = dict[str, str]
ONE_WAY = {"highway": "secondary", "oneway": "yes"}
BOTH_WAYS = {"highway": "secondary"}
CROSSING = {"highway": "tertiary"}


def way(name: int, along: tuple[int, ...], tags: Tags, attributes: str = "") -> str:
    nodes = "".join(f'<nd ref="{k}"/>' for k in along)
    return f'<way id="{name}" {attributes}>{nodes}{tagged(tags)}</way>'


def tagged(tags: Tags) -> str:
    return "".join(f'<tag k="{k}" v="{v}"/>' for k, v in tags.items())


def nodes() -> str:
    """About 300 m apart; 2 is in the middle."""
    return "".join(f'<node id="{k}" lat="{lat}" lon="{lon}"/>' for k, (lat, lon) in NODES.items())


def write(folder: Path, *parts: str) -> Path:
    (folder / "town.osm").write_text(f'<osm version="0.6">{"".join(parts)}</osm>', encoding="utf-8")
    return folder / "town.osm"


def converted(folder: Path, *parts: str) -> MapConversion:
    return convert_map(write(folder, *parts), cache=folder / "cache")


def classes(made: MapConversion, edge: str) -> list[set[str]]:
    """Which of these classes may use each lane, from the kerb to the middle."""
    known = {"passenger", "bus", "bicycle", "pedestrian"}
    found = next(e for e in ElementTree.parse(made.network).getroot().iter("edge") if e.get("id") == edge)
    allowed = []
    for lane in found.iter("lane"):
        own = set(lane.get("allow", "").split()) or known - set(lane.get("disallow", "").split())
        allowed.append(own & known - ({"pedestrian"} if "passenger" in own else set()))
    return allowed


def with_tags(folder: Path, tags: Tags) -> MapConversion:
    """Way 10 leads to a crossing with a road of two lanes one way and one of a lane each way."""
    return converted(
        folder, nodes(), way(10, (1, 2), tags), way(11, (2, 3), {**ONE_WAY, "lanes": "2"}), way(12, (4, 2, 5), CROSSING)
    )


def test_lanes_turn_as_their_arrows_say(tmp_path: Path) -> None:
    """``turn:lanes`` counts from the left, SUMO's lanes from the kerb: lane 1 turns left only."""
    made = with_tags(tmp_path, {**ONE_WAY, "lanes": "2", "turn:lanes": "left|through;right"})
    links = [c for c in ElementTree.parse(made.network).getroot().iter("connection") if c.get("from") == "10"]
    assert {(c.get("fromLane"), c.get("dir")) for c in links} == {("1", "l"), ("0", "s"), ("0", "r")}


@pytest.mark.parametrize(
    "tags",
    [
        {"bus:lanes": "yes|yes|designated"}, {"psv:lanes": "||designated"}, {"busway": "lane"},
        {"busway:right": "lane"}, {"lanes:bus": "1"}, {"lanes:psv": "1"},
        {"access:lanes": "yes|yes|no", "bus:lanes": "yes|yes|yes"}, {"vehicle:lanes": "||no", "psv:lanes": "||yes"},
    ],
    ids=lambda tags: " ".join(tags),
)  # fmt: skip
def test_a_lane_for_buses_is_for_buses(tmp_path: Path, tags: Tags) -> None:
    """One of three lanes, at the kerb: OpenStreetMap's page "Bus lanes" has these ways to say it."""
    kerb, *others = classes(with_tags(tmp_path, {**ONE_WAY, "lanes": "3", **tags}), "10")
    assert "bus" in kerb and "passenger" not in kerb
    assert len(others) == 2 and all("passenger" in lane for lane in others)


@pytest.mark.parametrize("tags", [{"busway": "lane"}, {"lanes:bus": "2"}], ids=lambda tags: " ".join(tags))
def test_a_road_both_ways_has_a_bus_lane_each_way(tmp_path: Path, tags: Tags) -> None:
    made = with_tags(tmp_path, {**BOTH_WAYS, "lanes": "4", **tags})
    for edge in ("10", "-10"):
        kerb, middle = classes(made, edge)
        assert "passenger" not in kerb and "passenger" in middle


def test_lanes_for_buses_in_one_direction(tmp_path: Path) -> None:
    made = with_tags(tmp_path, {**BOTH_WAYS, "lanes": "4", "lanes:psv:backward": "1"})
    assert [["passenger" in lane for lane in classes(made, edge)] for edge in ("10", "-10")] == [
        [True, True], [False, True],
    ]  # fmt: skip


@pytest.mark.parametrize("kind", ["lane", "track"])
def test_cycle_lanes_are_on_both_sides_and_of_a_one_way_road_at_the_kerb(tmp_path: Path, kind: str) -> None:
    """OpenStreetMap's key ``cycleway`` without a side means both sides."""
    (tmp_path / "one").mkdir()
    both = with_tags(tmp_path, {**BOTH_WAYS, "lanes": "2", "cycleway": kind})
    one = with_tags(tmp_path / "one", {**ONE_WAY, "lanes": "2", "cycleway": kind})
    for made, edge, others in ((both, "10", 1), (both, "-10", 1), (one, "10", 2)):
        kerb, *lanes = classes(made, edge)
        assert kerb == {"bicycle"} and len(lanes) == others and all("bicycle" not in lane for lane in lanes)


def test_in_left_hand_traffic_the_kerb_is_on_the_left(tmp_path: Path) -> None:
    """The sidewalk and the cycle lane on the left of the way are those of its own direction, not of the other."""
    tags = {**BOTH_WAYS, "lanes": "4", "driving_side": "left", "sidewalk": "left", "cycleway:left": "lane"}
    made = with_tags(tmp_path, {**tags, "lanes:bus:backward": "1"})
    assert "--lefthand" in made.options
    assert classes(made, "10")[:2] == [{"pedestrian"}, {"bicycle"}]
    assert "pedestrian" not in set().union(*classes(made, "-10"))
    assert "passenger" not in classes(made, "-10")[0] and "passenger" in classes(made, "-10")[1]


def test_what_cannot_be_kept_of_lanes_is_said(tmp_path: Path) -> None:
    made = with_tags(tmp_path, {**BOTH_WAYS, "lanes": "3", "lanes:bus": "1", "access:lanes:forward": "yes|no"})
    assert made.lost == {"bus lane without a side": 1, "closing of a lane to cars": 1}


WAYS = (way(10, (1, 2, 3), BOTH_WAYS), way(12, (4, 2, 5), CROSSING))
EDGES = "8 edges with 8 lanes for cars"  # four arms both ways

# -- the side of the road

LEFT, RIGHT = {"driving_side": "left"}, {"driving_side": "right"}
ASSUMED = "right-hand traffic (the map does not say)"


def country(tags: Tags) -> str:
    return f'<relation id="5"><tag k="boundary" v="administrative"/>{tagged(tags)}</relation>'


def roundabout(name: int, along: tuple[int, ...], tags: Tags | None = None) -> str:
    return way(name, along, {"highway": "tertiary", "junction": "roundabout", **(tags or {})})


CLOCKWISE = (1, 4, 3, 5, 1)  # west, north, east, south


@pytest.mark.parametrize(
    ("parts", "left"),
    [
        ((country(LEFT),), True), ((way(13, (1, 4), {**CROSSING, **LEFT}), country(RIGHT)), False),
        ((way(13, (1, 4), {"highway": "footway", **LEFT}), way(14, (4, 3), {"railway": "rail", **LEFT})), None),
        ((roundabout(13, CLOCKWISE),), True), ((roundabout(13, CLOCKWISE[::-1]),), False),
        ((roundabout(13, CLOCKWISE, {"oneway": "-1"}),), False),
        ((roundabout(13, CLOCKWISE[:4]),), True),  # turns right twice, by 90 degrees in metres
        ((roundabout(13, CLOCKWISE[:2]),), None), ((way(13, CLOCKWISE, CROSSING),), None),
        ((roundabout(13, CLOCKWISE), country(RIGHT)), False),
        ((way(13, (1, 4), {**CROSSING, **RIGHT}), roundabout(14, CLOCKWISE)), True),  # the way is an exception
        ((roundabout(13, CLOCKWISE), roundabout(14, CLOCKWISE[::-1])), None),
        ((*(roundabout(k, CLOCKWISE) for k in (13, 14)), roundabout(15, CLOCKWISE[::-1])), True),
    ],
)  # fmt: skip
def test_countries_then_roads_and_roundabouts_tell_the_side(
    tmp_path: Path, parts: tuple[str, ...], left: bool | None
) -> None:
    made = converted(tmp_path, nodes(), *WAYS, *parts)
    assert ("--lefthand" in made.options) == bool(left)
    assert (ASSUMED in made.said[0]) == (left is None)


def test_roads_of_two_sides_are_refused(tmp_path: Path) -> None:
    parts = way(13, (1, 4), {**CROSSING, **RIGHT}), way(14, (4, 3), {**CROSSING, **LEFT})
    with pytest.raises(UsageError, match="by way 14, it drives on the left, by way 13 on the right"):
        converted(tmp_path, nodes(), *WAYS, *parts)


# -- files as other programs write them


@pytest.mark.parametrize(
    ("tags", "cars"),
    [
        ({"motor_vehicle": "no"}, False), ({"vehicle": "no", "bicycle": "yes"}, False), ({"motorcar": "no"}, False),
        ({"motor_vehicle": "no", "bus": "yes"}, False), ({"vehicle": "agricultural;forestry"}, False),
        ({"access": "no", "psv": "yes"}, False), ({"access": "no", "motor_vehicle": "yes"}, True),
        ({"motor_vehicle": "no", "motorcar": "yes"}, True), ({"motor_vehicle": "destination"}, True),
        ({"access": "private"}, True), ({"bicycle": "no"}, True), ({"vehicle": "delivery;no"}, True),
    ],
    ids=lambda value: " ".join(f"{k}={v}" for k, v in value.items()) if isinstance(value, dict) else None,
)  # fmt: skip
def test_the_tag_that_is_nearest_to_cars_says_whether_they_may(tmp_path: Path, tags: Tags, cars: bool) -> None:
    """OpenStreetMap's page "Access": motorcar goes before motor_vehicle, vehicle and access."""
    made = with_tags(tmp_path, {**BOTH_WAYS, **tags})
    ids = {edge.get("id") for edge in ElementTree.parse(made.network).getroot().iter("edge")}
    assert ("10" in ids, "-10" in ids) == (cars, cars)
    assert made.lost == ({} if cars else {"secondary": 1})


def test_what_holds_for_one_direction_or_lane_is_said(tmp_path: Path) -> None:
    shut = {"motor_vehicle:backward": "no"}
    assert with_tags(tmp_path, {**ONE_WAY, **shut}).lost == {}
    lanes = {"lanes": "3", "lanes:both_ways": "1", "maxspeed:lanes:forward": "50"}
    assert with_tags(tmp_path, {**BOTH_WAYS, **shut, **lanes}).lost == {
        "closing of a direction to cars": 1, "way with limits of single lanes": 1,
        "second direction of a lane for both": 1,
    }  # fmt: skip


def test_what_netconvert_warns_of_is_said(tmp_path: Path) -> None:
    """``variable`` is no limit in km/h, so netconvert takes that of its type of road."""
    made = with_tags(tmp_path, {**ONE_WAY, "maxspeed": "variable"})
    (kind,) = made.warnings
    assert kind.count == 1 and "'maxspeed' is not numeric ('variable')" in kind.first
    assert made.said[-1] == f"netconvert warns: {kind.first}"


def test_ways_may_come_before_their_nodes(tmp_path: Path) -> None:
    """As Overpass writes them after ``out body; >; out skel``."""
    assert EDGES in converted(tmp_path, *WAYS, nodes()).said[0]


def test_ways_may_carry_their_nodes(tmp_path: Path) -> None:
    """As Overpass writes them after ``out geom``."""
    carrying = re.sub(
        r'<nd ref="(\d)"/>', lambda m: '<nd ref="{}" lat="{}" lon="{}"/>'.format(m[1], *NODES[int(m[1])]), "".join(WAYS)
    )
    assert EDGES in converted(tmp_path, carrying).said[0]


def test_numbers_may_be_negative(tmp_path: Path) -> None:
    """As JOSM writes what was never uploaded."""
    text = re.sub(r'(id|ref)="(\d+)"', r'\1="-\2"', nodes() + "".join(WAYS))
    assert EDGES in converted(tmp_path, text).said[0]


@pytest.mark.parametrize("mark", ['action="delete"', 'visible="false"'])
def test_what_is_deleted_is_not_there(tmp_path: Path, mark: str) -> None:
    gone = way(13, (5, 1), BOTH_WAYS, mark) + f'<node id="9" lat="48" lon="12" {mark}/>'
    assert EDGES in converted(tmp_path, nodes(), *WAYS, gone).said[0]


def test_a_way_ends_where_its_nodes_are_missing(tmp_path: Path) -> None:
    """Not straight across the gap: of 1, 2, 98, 3, 5 two pieces remain, and nothing leads from 2 to 3."""
    without_place = '<node id="98"/>'
    made = converted(tmp_path, nodes(), without_place, way(10, (1, 2, 98, 3, 5), BOTH_WAYS), WAYS[1])
    assert made.lost == {"way cut where nodes are missing": 1}
    edges = {(e.get("from"), e.get("to")) for e in ElementTree.parse(made.network).getroot().iter("edge")}
    assert {("1", "2"), ("2", "1"), ("3", "5"), ("5", "3")} <= edges and not {("2", "3"), ("3", "2")} & edges


@pytest.mark.parametrize("along", [(), (2,), (98, 99), (1, 98, 3)])
def test_a_way_without_two_nodes_together_is_said(tmp_path: Path, along: tuple[int, ...]) -> None:
    made = converted(tmp_path, nodes(), *WAYS, way(13, along, {"highway": "residential"}))
    assert EDGES in made.said[0] and made.lost == {"residential without nodes": 1}


def test_a_single_road_is_kept(tmp_path: Path) -> None:
    """A road without junctions is left out as a piece at the rim of a map, but not where nothing else is left."""
    assert "1 edges with 1 lanes" in converted(tmp_path, nodes(), way(10, (1, 3), ONE_WAY)).said[0]


def test_a_name_with_signs_that_netconvert_splits_is_read(tmp_path: Path) -> None:
    file = write(tmp_path, nodes(), *WAYS).rename(tmp_path / "a,b:c.osm")
    assert EDGES in convert_map(file, cache=tmp_path / "cache").said[0]


@pytest.mark.parametrize(
    "tags",
    [{"lanes": "2000000000"}, {"lanes:forward": "1e99"}, {"turn:lanes": "left" + "|left" * 40}],
    ids=lambda tags: " ".join(tags),
)
def test_more_lanes_than_a_road_has_are_refused(tmp_path: Path, tags: Tags) -> None:
    """netconvert would make them all, and take the memory."""
    with pytest.raises(UsageError, match=r"town\.osm has way 10 with .* lanes .*, more than the 30 that are read"):
        converted(tmp_path, nodes(), way(10, (1, 2, 3), {**ONE_WAY, **tags}))


def test_a_lanelet2_map_is_refused_by_its_name(tmp_path: Path) -> None:
    """Lanelet2 writes .osm files, too: its roads are relations of the type ``lanelet``."""
    lanelet = '<relation id="5"><member type="way" ref="10" role="left"/><tag k="type" v="lanelet"/></relation>'
    with pytest.raises(UsageError, match="is a Lanelet2 map, not OpenStreetMap: convert it to OpenDRIVE first"):
        converted(tmp_path, nodes(), way(10, (1, 2), {"type": "line_thin", "subtype": "solid"}), lanelet)
