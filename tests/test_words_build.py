"""From a draft to files: each kind of road, where vehicles start, and the sentence for a draft with a fault."""

from __future__ import annotations

import tomllib
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest
from sumo_samples import make_net

from sumo_adv.asked import RequestOrigin
from sumo_adv.errors import UsageError
from sumo_adv.simulation.inputs import data_folder, load_input
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.simulation_spec import SimulationSpec
from sumo_adv.words.build import build_scenario
from sumo_adv.words.draft import SceneDraft
from sumo_adv.words.roads import Net

WRITTEN = RequestOrigin(words='He said "stop" \\ and \u00fcber.', model="a model", date="2026-11-27")


def scene(road: dict[str, Any], ego: dict[str, Any], *vehicles: dict[str, Any], **more: Any) -> SceneDraft:
    attack = more.pop("attack", {"adversary": vehicles[0]["id"] if vehicles else "walker", "asked": {}})
    return SceneDraft.model_validate(
        {"road": road, "ego": ego, "vehicles": list(vehicles), "attack": attack, **more}
    )  # fmt: skip


def other(route: tuple[str, str], **more: Any) -> dict[str, Any]:
    return {"id": "other", "route": list(route), "speed": 36, **more}


def starts(folder: Path) -> dict[str, tuple[float, str]]:
    """Where each vehicle starts on its first edge [m], and its route."""
    root = ElementTree.parse(folder / "my.rou.xml").getroot()
    return {
        v.get("id", ""): (float(v.get("departPos", "")), v.find("route").get("edges", ""))  # type: ignore[union-attr]
        for v in root.iter("vehicle")
    }


WEST_EAST = {"route": ["west_in", "east_out"], "speed": 36}
ROADS: list[tuple[dict[str, Any], dict[str, Any], dict[str, Any]]] = [
    ({"kind": "straight", "lanes": 2, "lanes_back": 0}, {"route": ["forward", "forward"], "speed": 36},
     other(("forward", "forward"), lane=1, gap=5)),
    ({"kind": "straight", "sidewalk": True, "bike_lane": True}, {"route": ["forward", "forward"], "speed": 36},
     other(("forward", "forward"), type="bicycle", speed=15, gap=40)),
    ({"kind": "ramp", "lanes": 2, "speed_limit": 100, "minor_limit": 80}, {"route": ["main", "onward"], "speed": 72},
     other(("ramp", "onward"), speed=72, arrives=0)),
    ({"kind": "lane_drop", "lanes": 2, "ends": "left"}, {"route": ["before", "after"], "speed": 36},
     other(("before", "after"), lane=1, gap=-10)),
    ({"kind": "t", "length": 300}, WEST_EAST, other(("south_in", "west_out"), speed=20, arrives=0)),
    ({"kind": "crossing", "control": "all_stop", "length": 300}, WEST_EAST,
     other(("north_in", "south_out"), arrives=0)),
    ({"kind": "crossing", "control": "right_before_left", "length": 300}, WEST_EAST,
     other(("south_in", "north_out"), arrives=1)),
    ({"kind": "roundabout", "length": 200}, {"route": ["west_in", "east_out"], "speed": 28},
     other(("south_in", "north_out"), speed=28, arrives=0.5)),
    ({"kind": "shipped", "name": "two_way"}, {"route": ["eastbound", "eastbound"], "speed": 72},
     other(("westbound", "westbound"), speed=72, arrives=0)),
]  # fmt: skip


@pytest.mark.parametrize(("road", "ego", "vehicle"), ROADS, ids=lambda value: value.get("kind", ""))
def test_each_road_is_built_and_loads(
    tmp_path: Path, road: dict[str, Any], ego: dict[str, Any], vehicle: dict[str, Any]
) -> None:
    made = load_input(build_scenario(scene(road, ego, vehicle), tmp_path / "my.toml", WRITTEN))
    assert made.ego == "ego" and made.candidates == ("other",) and made.words == WRITTEN.words
    assert {"ego", "other"} == set(starts(tmp_path))


def test_a_crossing_vehicle_arrives_when_the_draft_says(tmp_path: Path) -> None:
    """Both drive 10 m/s; 2 s later is 20 m farther back. The ways meet 1.6 m below and left of the middle: the ego is
    counted from where they come within 2 m, 5.2 m before the other's place."""
    road = {"kind": "crossing", "lanes": 1, "length": 300}
    build_scenario(scene(road, WEST_EAST, other(("north_in", "south_out"), arrives=2)), tmp_path / "my.toml", WRITTEN)
    placed = starts(tmp_path)
    assert placed["ego"][0] - placed["other"][0] == pytest.approx(20.0 - 5.2, abs=1.0)
    file = tomllib.loads((tmp_path / "my.toml").read_text())
    assert file["window"]["trigger"] == pytest.approx(4.0, abs=0.2)  # 5 s before the ego is there, after 9 s


def test_a_vehicle_close_behind_starts_there_and_stays_close(tmp_path: Path) -> None:
    """A front 14 m behind the ego's, at 24.4 m/s: 9.2 m to the ego's back, of which SUMO keeps 2.5 m, so 0.27 s."""
    road, ego = {"kind": "straight", "lanes": 1}, {"route": ["forward", "forward"], "speed": 88}
    lorry = other(("forward", "forward"), type="truck", gap=-14) | {"speed": 88}
    build_scenario(scene(road | {"speed_limit": 100, "length": 900}, ego, lorry), tmp_path / "my.toml", WRITTEN)
    demand = ElementTree.parse(tmp_path / "my.rou.xml").getroot()
    assert {t.get("id"): t.get("tau") for t in demand.iter("vType")} == {"type_ego": "1", "type_other": "0.27"}
    assert {v.get("insertionChecks") for v in demand.iter("vehicle")} == {"none"}


def test_a_limit_of_which_the_prompt_has_the_round_number_is_kept(tmp_path: Path) -> None:
    """70 km/h are 19.44 m/s, the limit is 19.4."""
    road, ego = {"kind": "shipped", "name": "yield_merge"}, {"route": ["main", "onward"], "speed": 70}
    build_scenario(scene(road, ego, other(("ramp", "onward"), arrives=0)), tmp_path / "my.toml", WRITTEN)
    demand = ElementTree.parse(tmp_path / "my.rou.xml").getroot()
    assert {v.get("id"): v.get("departSpeed") for v in demand.iter("vehicle")} == {"ego": "19.40", "other": "10.00"}


def test_a_vehicle_from_a_ramp_is_beside_the_ego_where_its_lane_begins(tmp_path: Path) -> None:
    """Both drive 20 m/s and have the same way left to the edge on which their lanes lie side by side; the attack may
    begin 5 s before they are there, so on the ramp."""
    road = {"kind": "ramp", "lanes": 2, "length": 400, "speed_limit": 100, "minor_limit": 80}
    ego, truck = {"route": ["main", "onward"], "speed": 72}, other(("ramp", "onward"), speed=72, arrives=0)
    build_scenario(scene(road, ego, truck), tmp_path / "my.toml", WRITTEN)
    net, placed = Net(tmp_path / "my.net.xml"), starts(tmp_path)
    left = {}
    for name, way in (("ego", ["main", "onward"]), ("other", ["ramp", "onward"])):
        drive = net.drive(way, 0, "passenger", name)
        left[name] = drive.begins[1] - placed[name][0]
    assert left["ego"] == pytest.approx(20.0 * 9.0, abs=2.0) and left["other"] == pytest.approx(left["ego"], abs=2.0)
    file = tomllib.loads((tmp_path / "my.toml").read_text())
    assert file["window"]["trigger"] == pytest.approx(4.0, abs=0.1)


def test_vehicles_with_a_gap_and_boxes_along_the_way(tmp_path: Path) -> None:
    walker = {"id": "walker", "at": 50, "offset": -5}
    van = {"type": "van", "at": 46, "offset": -4.5}
    draft = scene(
        {"kind": "straight", "length": 500}, {"route": ["forward", "forward"], "speed": 36, "position": 100},
        other(("forward", "forward"), gap=-30), walkers=[walker], parked=[van],
        attack={"adversary": "walker", "intents": ["Pedestrian From Behind Obstacle"],
                "asked": {"user": "pedestrian", "hidden": True, "level": "near_miss"}},
    )  # fmt: skip
    made = load_input(build_scenario(draft, tmp_path / "my.toml", WRITTEN))
    assert starts(tmp_path)["other"][0] == 70.0
    assert made.candidates == ("pedestrian0",)
    assert made.settings() == {"horizon": 10.0, "ttc": (0.2, 1.5), "until": "critical"}
    assert made.settings(["until"]) == {"horizon": 10.0}
    file = tomllib.loads((tmp_path / "my.toml").read_text())
    lane = -1.6  # the middle of the ego's lane, which is 3.2 m wide
    assert (file["pedestrians"][0]["x"], file["pedestrians"][0]["y"]) == (150.0, lane - 5)
    assert (file["parked"][0]["x"], file["parked"][0]["y"]) == (146.0, lane - 4.5)
    assert file["asked"] == {"user": "pedestrian", "hidden": True, "level": "near_miss"}
    assert file["written"]["words"] == WRITTEN.words


def test_walkers_move_any_way_from_the_start(tmp_path: Path) -> None:
    """The ego drives 10 m/s from 100 m on. A cyclist comes from 130 m ahead with 3 m/s, and they pass after 10 s,
    so the attack may begin after 5 s. A pedestrian crosses from the right, another walks as the ego drives."""
    walkers = [
        {"id": "rider", "kind": "cyclist", "at": 130, "offset": -3, "heading": "against", "speed": 10.8},
        {"id": "one", "at": 50, "offset": -5, "speed": 3.6},
        {"id": "two", "at": 60, "offset": 6, "heading": "along", "speed": 3.6},
    ]
    draft = scene(
        {"kind": "straight", "length": 500}, {"route": ["forward", "forward"], "speed": 36, "position": 100},
        walkers=walkers, attack={"adversary": "rider", "asked": {"relation": "oncoming"}},
    )  # fmt: skip
    build_scenario(draft, tmp_path / "my.toml", WRITTEN)
    file = tomllib.loads((tmp_path / "my.toml").read_text())
    rider, (one, two) = file["cyclists"][0], file["pedestrians"]
    assert (rider["x"], rider["y"], rider["speed"]) == (230.0, -4.6, 3.0)
    assert abs(rider["heading"]) == pytest.approx(3.1416)
    assert (one["heading"], one["speed"]) == (1.5708, 1.0)
    assert (two["heading"], two["speed"]) == (0.0, 1.0)
    assert file["window"]["trigger"] == pytest.approx(5.0, abs=0.1)


def test_a_walker_beyond_the_junction_at_which_the_ego_turns(tmp_path: Path) -> None:
    """The ego comes from the west, 1.6 m right of the middle, and turns right; 3 m farther right comes a cyclist."""
    rider = {"id": "walker", "kind": "cyclist", "at": 130, "offset": -3, "straight_on": True, "heading": "against"}
    places = {}
    for position in (150, 160):
        draft = scene(
            {"kind": "crossing", "length": 300},
            {"route": ["west_in", "south_out"], "speed": 36, "position": position}, walkers=[{**rider, "speed": 14}],
        )  # fmt: skip
        build_scenario(draft, tmp_path / "my.toml", WRITTEN)
        places[position] = tomllib.loads((tmp_path / "my.toml").read_text())["cyclists"][0]
    assert places[150]["y"] == pytest.approx(-4.6) and places[160]["x"] - places[150]["x"] == pytest.approx(10.0)


def test_the_ego_has_green_and_who_crosses_has_red(tmp_path: Path) -> None:
    road = {"kind": "crossing", "lanes": 1, "control": "signals", "length": 300}
    build_scenario(scene(road, WEST_EAST, other(("north_in", "south_out"), arrives=0)), tmp_path / "my.toml", WRITTEN)
    (phase,) = ElementTree.parse(tmp_path / "my.add.xml").getroot().iter("phase")
    state = phase.get("state", "")
    links = {
        (c.get("from"), c.get("to")): state[int(c.get("linkIndex", ""))]
        for c in ElementTree.parse(tmp_path / "my.net.xml").getroot().iter("connection") if c.get("tl")
    }  # fmt: skip
    assert links["west_in", "east_out"] == links["east_in", "west_out"] == "G"
    assert links["west_in", "north_out"] == "g"  # a left turn waits
    assert links["north_in", "south_out"] == links["south_in", "north_out"] == "r"


def test_lights_go_through_the_phases_of_a_draft(tmp_path: Path) -> None:
    """The ego's green has 4 s left at the start: the program began 16 s before it, with 20 s of green."""
    phases = [("ego_green", 20), ("ego_yellow", 3), ("all_red", 2), ("others_green", 20), ("others_yellow", 3)]
    road = {
        "kind": "crossing", "control": "signals", "length": 300, "lights_offset": -16,
        "lights": [{"shows": shows, "seconds": seconds} for shows, seconds in phases],
    }  # fmt: skip
    build_scenario(scene(road, WEST_EAST, other(("north_in", "south_out"), arrives=0)), tmp_path / "my.toml", WRITTEN)
    (program,) = ElementTree.parse(tmp_path / "my.add.xml").getroot().iter("tlLogic")
    assert program.get("offset") == "-16"
    assert [float(p.get("duration", "")) for p in program.iter("phase")] == [20, 3, 2, 20, 3]
    net = ElementTree.parse(tmp_path / "my.net.xml").getroot()
    links = [
        {c.get("from"): p.get("state", "")[int(c.get("linkIndex", ""))] for c in net.iter("connection")
         if c.get("tl") and c.get("dir") == "s"}
        for p in program.iter("phase")
    ]  # fmt: skip
    assert [link["west_in"] for link in links] == [link["east_in"] for link in links] == ["G", "y", "r", "r", "r"]
    assert [link["north_in"] for link in links] == [link["south_in"] for link in links] == ["r", "r", "r", "G", "y"]


ARMS_OF_TWO_LIGHTS = """
<node id="west" x="-300" y="0"/><node id="near" x="0" y="0" type="traffic_light"/>
<node id="far" x="300" y="0" type="traffic_light"/><node id="east" x="600" y="0"/>
<node id="north" x="0" y="300"/><node id="south" x="0" y="-300"/><node id="beyond" x="300" y="300"/>
"""


def test_lights_with_crossings_for_pedestrians_are_set_on_the_ego_s_way_only(tmp_path: Path) -> None:
    """Pedestrians have links of their own at the end of a light's state, which stay red. The ego turns off before the
    second light, which keeps the network's program."""
    ways = ("west near", "near far", "far east", "north near", "near south", "far beyond")
    both = [(f"{start}_{end}", start, end) for a, b in map(str.split, ways) for start, end in ((a, b), (b, a))]
    edges = "".join(f'<edge id="{name}" from="{a}" to="{b}" speed="12"/>' for name, a, b in both)
    options = ("--sidewalks.guess", "--crossings.guess", "--no-turnarounds")
    net = make_net(tmp_path, ARMS_OF_TWO_LIGHTS, edges, *options)
    draft = scene(
        {"kind": "given"}, {"route": ["west_near", "near_south"], "speed": 36},
        other(("north_near", "near_south"), arrives=0),
    )  # fmt: skip
    made = load_input(build_scenario(draft, tmp_path / "my.toml", WRITTEN, net))
    (program,) = ElementTree.parse(tmp_path / "my.add.xml").getroot().iter("tlLogic")
    root = ElementTree.parse(net).getroot()
    links = {
        int(c.get("linkIndex", "")): (c.get("from", ""), c.get("dir"))
        for c in root.iter("connection") if c.get("tl") == "near"
    }  # fmt: skip
    (phase,) = program.iter("phase")
    state = phase.get("state", "")
    assert program.get("id") == "near" and len(state) == len(links) == 12 + 4  # three turns of four arms, crossings
    turns = {turn: state[k] for k, (name, turn) in links.items() if name == "west_near"}
    assert turns == {"l": "g", "s": "G", "r": "G"}
    assert {state[k] for k, (name, _) in links.items() if name.startswith((":", "north", "south"))} == {"r"}
    sim = Simulation(SimulationSpec(made.network, made.routes, made.additional, 0.0, 1))
    try:
        sim.step()
        assert set(sim.read().raw) == {"ego", "other"}
    finally:
        sim.close()


def test_in_left_hand_traffic_lane_0_is_the_rightmost_and_the_right_turn_waits(tmp_path: Path) -> None:
    """On the way from the west the lanes lie at y = 1.6 and, on the left, 4.8; SUMO's index 0 is that at 4.8."""
    net = Net(data_folder("networks") / "left_hand_crossing.net.xml")
    for lane, (index, y) in enumerate(((1, 1.6), (0, 4.8))):
        drive = net.drive(("west_in", "east_out"), lane, "passenger", "the ego")
        assert (drive.lane, drive.at(0.0)[1]) == (index, pytest.approx(y))
    nodes = '<node id="w" x="-200" y="0"/><node id="c" x="0" y="0" type="traffic_light"/><node id="e" x="200" y="0"/>'
    nodes += '<node id="s" x="0" y="-200"/><node id="n" x="0" y="200"/>'
    edges = "".join(
        f'<edge id="{arm}_in" from="{arm}" to="c"/><edge id="{arm}_out" from="c" to="{arm}"/>' for arm in "wesn"
    )
    path = make_net(tmp_path, nodes, edges, "--lefthand", "--no-turnarounds")
    (state,) = Net(path).light_states(("w_in", "e_out"), "ego_green").values()
    turns = {
        c.get("dir"): state[int(c.get("linkIndex", ""))]
        for c in ElementTree.parse(path).getroot().iter("connection") if c.get("tl") and c.get("from") == "w_in"
    }  # fmt: skip
    assert turns == {"l": "G", "s": "G", "r": "g"}


STRAIGHT, ALONG = {"kind": "straight", "length": 500}, {"route": ["forward", "forward"], "speed": 36}


@pytest.mark.parametrize(
    ("draft", "says"),
    [
        (scene({"kind": "shipped", "name": "twoway"}, ALONG, other(("forward", "forward"), gap=9)),
         "There is no shipped network 'twoway'; the nearest is 'two_way'."),
        (scene({"kind": "shipped", "name": "../../secret"}, ALONG, other(("forward", "forward"), gap=9)),
         "There is no shipped network '../../secret'"),
        (scene({"kind": "straight", "lights": [{"shows": "all_red", "seconds": 9}]}, ALONG,
               other(("forward", "forward"), gap=9)), "The road has phases of lights and no traffic lights"),
        (scene({"kind": "given"}, ALONG, other(("forward", "forward"), gap=9)), "There is no network of the user's"),
        (scene(STRAIGHT, ALONG, other(("forward", "north"), gap=9)), "There is no edge 'north' for 'other'"),
        (scene(STRAIGHT, ALONG, other(("forward", "backward"), gap=9)), "No way leads a passenger from edge 'forward'"),
        (scene(STRAIGHT, ALONG, other(("forward", "forward"), gap=9, lane=2)), "so its lane is 0 to 0, not 2"),
        (scene(STRAIGHT, ALONG, other(("forward", "forward"))), "'other' needs a gap or arrives, or stands."),
        (scene(STRAIGHT, ALONG, other(("forward", "forward"), arrives=0)), "so it needs a gap, not arrives"),
        (scene(STRAIGHT, ALONG, other(("backward", "backward"), gap=9)), "has a gap but begins on edge 'backward'"),
        (scene(STRAIGHT, ALONG, other(("forward", "forward"), gap=3)), "would start on top of one another in lane 0"),
        (scene(STRAIGHT, ALONG, other(("forward", "forward"), gap=900)), "which has room from 5 to 500 m"),
        (scene(STRAIGHT, {**ALONG, "speed": 120}, other(("forward", "forward"), gap=30)), "where the limit is 50 km/h"),
        (scene(STRAIGHT, ALONG, other(("forward", "forward"), gap=30) | {"id": "ego"}), "The id 'ego' is used twice"),
        (scene(STRAIGHT, ALONG, other(("forward", "forward"), gap=30), attack={"adversary": "nobody", "asked": {}}),
         "The attack names 'nobody', which is no vehicle or walker"),
        (scene(STRAIGHT, ALONG, walkers=[{"id": "walker", "at": 50, "offset": -5, "speed": 20}]),
         "'walker' goes 20 km/h, and a pedestrian at most 14."),
        (scene({"kind": "lane_drop"}, {"route": ["before", "after"], "speed": 36}, other(("before", "after"), gap=9)),
         "A lane_drop needs lanes = 2 or more"),
        (scene({"kind": "crossing", "length": 100}, {**WEST_EAST, "speed": 100}, other(("north_in", "south_out"),
                                                                                      arrives=0)),
         "give a longer road, or a lower speed"),
    ],
)  # fmt: skip
def test_what_cannot_be_built_is_one_sentence(tmp_path: Path, draft: SceneDraft, says: str) -> None:
    with pytest.raises(UsageError) as raised:
        build_scenario(draft, tmp_path / "my.toml", WRITTEN)
    assert says in str(raised.value), raised.value


def test_vehicles_start_where_the_draft_says_on_an_edge_of_another_length(tmp_path: Path) -> None:
    """The map says 1000 m for its 500 m: the ego, 100 m along, is at SUMO's position 200, the other at 240."""
    net = make_net(
        tmp_path, '<node id="a" x="0" y="0"/><node id="b" x="500" y="0"/>',
        '<edge id="ab" from="a" to="b" numLanes="2" speed="20" length="1000"/>',
    )  # fmt: skip
    draft = scene(
        {"kind": "given"}, {"route": ["ab", "ab"], "speed": 36, "position": 100},
        other(("ab", "ab"), lane=1, gap=20),
    )  # fmt: skip
    build_scenario(draft, tmp_path / "my.toml", WRITTEN, net)
    begins = {name: position for name, (position, _) in starts(tmp_path).items()}
    assert begins == {"ego": pytest.approx(200.0, abs=0.1), "other": pytest.approx(240.0, abs=0.1)}


def test_the_users_network_is_named_by_its_path(tmp_path: Path) -> None:
    network = data_folder("networks") / "two_way.net.xml"
    draft = scene({"kind": "given"}, {"route": ["eastbound", "eastbound"], "speed": 72},
                  other(("westbound", "westbound"), speed=72, arrives=0))  # fmt: skip
    made = load_input(build_scenario(draft, tmp_path / "my.toml", WRITTEN, network))
    assert made.network == network


# ---- scripts


ROAD = {"kind": "straight", "lanes": 2, "lanes_back": 0, "speed_limit": 80, "length": 600}
EGO = {"route": ["forward", "forward"], "speed": 54}


def scripted(*actions: dict[str, Any], **more: Any) -> SceneDraft:
    """A leader that drives 10 m/s, 30 m ahead in the right lane of two, with a script."""
    attack = {"adversary": "other", "script": {"applies": ["leader"], "actions": list(actions)}, "asked": {}}
    return scene(ROAD, EGO, other(("forward", "forward"), gap=30, **more), attack=attack)


def test_a_script_is_written_and_named_first(tmp_path: Path) -> None:
    draft = scripted(
        {"verb": "brake", "rate": 3, "speed": 5},
        {"verb": "lane_change", "side": "left", "when": {"kind": "distance_to_ego", "value": 9}},
        {"verb": "speed", "speed": {"default": 9, "low": 8, "high": 10}},
    )
    made = load_input(build_scenario(draft, tmp_path / "my.toml", WRITTEN))
    assert made.intents == ("Script: brake, lane change left, speed",)
    assert made.scripts == (draft.attack.script,)


def walks(*actions: dict[str, Any], kind: str = "pedestrian", **more: Any) -> SceneDraft:
    """A walker on the right of the ego's way, 60 m ahead, with a script."""
    attack = {"adversary": "p", "script": {"applies": [kind], "actions": list(actions)}, "asked": {}}
    return scene(ROAD, EGO, walkers=[{"id": "p", "kind": kind, "at": 60, "offset": -5, **more}], attack=attack)


def test_a_script_of_a_walker_is_written_and_named(tmp_path: Path) -> None:
    draft = walks({"verb": "walk_to", "offset": 0}, {"verb": "wait", "seconds": 1}, {"verb": "turn_back"})
    made = load_input(build_scenario(draft, tmp_path / "my.toml", WRITTEN))
    assert made.intents == ("Script: walk to, wait, turn back",)
    assert made.scripts == (draft.attack.script,)


def test_a_bicycle_of_the_traffic_has_the_script_of_a_cyclist(tmp_path: Path) -> None:
    actions = [{"verb": "wait", "seconds": 1}, {"verb": "walk_to", "offset": 4}]
    attack = {"adversary": "other", "script": {"applies": ["cyclist"], "actions": actions}, "asked": {}}
    rider = other(("forward", "forward"), gap=30, type="bicycle", speed=14)
    made = load_input(build_scenario(scene(ROAD, EGO, rider, attack=attack), tmp_path / "my.toml", WRITTEN))
    assert made.intents == ("Script: wait, walk to",)


@pytest.mark.parametrize(
    ("draft", "says"),
    [
        (scripted({"verb": "lane_change", "side": "right"}),
         "Action 1 of the script (lane_change) has no lane to its right: 'other' has 1 on its left and 0 on its"),
        (scripted({"verb": "lane_change", "side": "left"}, {"verb": "lane_change", "side": "left"}), "Action 2 of the"),
        (scripted({"verb": "brake", "rate": 7.5}, type="truck"), "with 7.5 m/s2, and 'other' can with 7 at most"),
        (scripted({"verb": "speed", "speed": 12, "rate": 3}), "with 3 m/s2, and 'other' can with 2.4 at most"),
        (scripted({"verb": "speed", "speed": 16}), "goes for 16 m/s, and 'other', which drives 10.0 m/s"),
        (scripted({"verb": "brake", "rate": 5}, {"verb": "lane_change", "side": "left"}), "begins when 'other' stands"),
        (scripted({"verb": "wait", "seconds": 6}, {"verb": "wait", "seconds": 6}, {"verb": "brake", "rate": 5}),
         "Action 3 of the script (brake) begins after 12 s at the earliest, and it must within 10 s."),
        (scripted({"verb": "brake", "rate": 5, "when": {"kind": "time", "value": 11}}), "begins after 11 s at the"),
        (scene({"kind": "t", "length": 300}, WEST_EAST, other(("south_in", "east_out"), arrives=0), attack={
            "adversary": "other", "script": {"applies": ["merging"], "actions": [{"verb": "brake", "rate": 5}]},
            "asked": {}}), "The script goes straight on where the route of 'other' goes right from edge 'south_in'"),
        (scene(STRAIGHT, ALONG, walkers=[{"id": "walker", "at": 50, "offset": -5}], attack={
            "adversary": "walker", "script": {"applies": ["leader"], "actions": [{"verb": "brake", "rate": 4}]},
            "asked": {}}), "The script begins from leader, and 'walker' is a pedestrian"),
        (walks({"verb": "walk_to", "offset": 0, "speed": 5}), "(walk_to) goes at 5 m/s, and a pedestrian can at 4 at"),
        (walks({"verb": "walk_to", "offset": -7}), "leads to -7 m, which lies behind 'p' at -5 m"),
        (walks({"verb": "walk_to", "offset": 0, "when": {"kind": "time", "value": 2}}, {"verb": "turn_back"},
               speed=5, heading="along"), "Action 2 of the script (turn_back) needs a way across from the beginning"),
    ],
)  # fmt: skip
def test_a_script_that_cannot_be_played_is_one_sentence(tmp_path: Path, draft: SceneDraft, says: str) -> None:
    with pytest.raises(UsageError) as raised:
        build_scenario(draft, tmp_path / "my.toml", WRITTEN)
    assert says in str(raised.value), raised.value


# ---- the ego's own moves


def ego_on(*moves: dict[str, Any], **more: Any) -> dict[str, Any]:
    """An ego at 10 m/s from the west to the east."""
    return {**WEST_EAST, "moves": list(moves), **more}


CROSSING = {"kind": "crossing", "lanes": 1, "length": 400}


def test_moves_and_crests_are_in_the_scenario(tmp_path: Path) -> None:
    """36 km/h are 10 m/s."""
    ego = ego_on(
        {"does": "stop", "at": 60, "seconds": 2}, {"does": "speed", "at": 90, "speed": 36, "attacked": True},
        crests=[{"begin": 20, "end": 80, "limit": 40}],
    )  # fmt: skip
    made = load_input(build_scenario(scene(CROSSING, ego, other(("north_in", "south_out"), arrives=0)),
                                     tmp_path / "my.toml", WRITTEN))  # fmt: skip
    assert [(m.does, m.at, m.seconds, m.speed, m.attacked) for m in made.moves] == [
        ("stop", 60.0, 2.0, None, False), ("speed", 90.0, None, 10.0, True),
    ]  # fmt: skip
    assert [(s.begin, s.to, s.limit) for s in made.sight] == [(20.0, 80.0, 40.0)]


def test_a_vehicle_meets_an_ego_that_stops_before(tmp_path: Path) -> None:
    """Stopping from 10 m/s at 2 m/s2 costs 2.5 s, standing 2 s, and speeding up at 2.6 m/s2 1.9 s: some 6.4 s. Without
    the stop both drive 90 m; with it the ego drives some 64 m less in the 9 s."""
    placed = {}
    for name, moves in (("calm", []), ("stops", [{"does": "stop", "at": 10, "seconds": 2}])):
        (tmp_path / name).mkdir()
        drawn = scene(CROSSING, ego_on(*moves), other(("north_in", "south_out"), arrives=0))
        build_scenario(drawn, tmp_path / name / "my.toml", WRITTEN)
        placed[name] = {vehicle: place for vehicle, (place, _) in starts(tmp_path / name).items()}
    assert placed["stops"]["other"] == pytest.approx(placed["calm"]["other"], abs=1.0)
    assert placed["stops"]["ego"] - placed["calm"]["ego"] == pytest.approx(64.0, abs=10.0)


@pytest.mark.parametrize(
    ("moves", "says"),
    [
        ([{"does": "stop", "at": 50}], "stop needs seconds"),
        ([{"does": "turn_left", "at": 50}], "leave at and time out"),
        ([{"does": "change_left", "at": 9, "attacked": True}] * 2, "Only one move of the ego can be attacked"),
    ],
)
def test_a_draft_with_a_faulty_move_is_refused(tmp_path: Path, moves: list[dict[str, Any]], says: str) -> None:
    drawn = scene(CROSSING, ego_on(*moves), other(("north_in", "south_out"), arrives=0))
    with pytest.raises(UsageError, match=says):
        build_scenario(drawn, tmp_path / "my.toml", WRITTEN)


LANE_DROP = {"kind": "lane_drop", "lanes": 3, "ends": "right", "speed_limit": 100, "length": 600}
RACE = {
    "adversary": "first", "intents": ["Aggressive Cut-in"], "asked": {"events": ["enters_from_left"], "within": 3,
    "level": "critical"}, "others": [{"adversary": "second", "intents": [], "asked": {"relation": "neighbour"}}],
}  # fmt: skip


def race(attack: dict[str, Any]) -> SceneDraft:
    """Two cars beside each other behind the ego, whose lane ends."""
    ego = {"route": ["before", "after"], "speed": 72, "lane": 0}
    cars = [
        {"id": name, "route": ["before", "after"], "speed": 80, "lane": lane, "gap": -15}
        for name, lane in (("first", 1), ("second", 2))
    ]
    return scene(LANE_DROP, ego, *cars, attack=attack)


def test_two_that_attack_together_are_in_the_scenario(tmp_path: Path) -> None:
    made = load_input(build_scenario(race(RACE), tmp_path / "my.toml", WRITTEN))
    assert [(each.id, each.intents) for each in made.attackers] == [
        ("first", ("Aggressive Cut-in",)), ("second", ()),
    ]  # fmt: skip
    first, second = made.attackers
    assert first.asked.events == ("enters_from_left",) and first.asked.level is None and first.asked.within is None
    assert second.asked.relation == "neighbour"
    assert made.asked is not None and (made.asked.level, made.asked.within) == ("critical", 3.0)
    assert made.asked.events == ()
    assert made.settings() == {"horizon": 10.0, "until": "critical", "adversaries": 2}


def test_an_adversary_is_named_once_and_there_are_at_most_three(tmp_path: Path) -> None:
    twice = RACE | {"others": [{"adversary": "first", "asked": {}}]}
    with pytest.raises(UsageError, match="at most 3, each named once"):
        build_scenario(race(twice), tmp_path / "my.toml", WRITTEN)
    nobody = RACE | {"others": [{"adversary": "nobody", "asked": {}}]}
    with pytest.raises(UsageError, match="names 'nobody', which is no vehicle"):
        build_scenario(race(nobody), tmp_path / "my.toml", WRITTEN)


def test_what_holds_for_all_attackers_is_refused_where_it_would_count_for_nothing(tmp_path: Path) -> None:
    for key, value in (("level", "valid"), ("within", 2)):
        of_one = RACE | {"others": [{"adversary": "second", "asked": {key: value}}]}
        with pytest.raises(UsageError, match="level and within hold for all attackers"):
            build_scenario(race(of_one), tmp_path / "my.toml", WRITTEN)
    with pytest.raises(UsageError, match="within bounds the time between several attackers"):
        build_scenario(race(RACE | {"others": []}), tmp_path / "my.toml", WRITTEN)
