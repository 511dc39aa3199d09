"""Parts of the Waymo network converter, and networks of any shape: netconvert and SUMO accept what it writes."""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import womd_samples as samples
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sumo_adv.errors import UsageError
from sumo_adv.simulation.programs import find_netconvert
from sumo_adv.womd.fidelity import MAX_LANE_DEVIATION_M, connectivity, lane_deviations
from sumo_adv.womd.matching import read_net
from sumo_adv.womd.network import convert_network
from sumo_adv.womd.network.finish import run_netconvert
from sumo_adv.womd.network.right_of_way import bend_together, find_foes
from sumo_adv.womd.network.roads import JunctionLink

LOAD = """
import libsumo, sys
libsumo.start(["sumo", "-n", sys.argv[1], "--no-step-log", "--xml-validation", "never"])
libsumo.simulationStep()
print(len(libsumo.lane.getIDList()))
"""


def lanes_in_sumo(network: Path) -> int:
    """How many lanes SUMO sees, in a process of its own."""
    done = subprocess.run([sys.executable, "-c", LOAD, str(network)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return int(done.stdout.split()[-1])


def link(points: list[tuple[float, float]], source: str, target: str, height: float = 0.0) -> JunctionLink:
    shape = np.array(points, dtype=float)
    heights = np.full(len(shape), height)
    return JunctionLink("n0", source, 0, target, 0, shape, heights, 3.5, 10.0, 0.0, (), (), False)


def test_links_that_cross_or_merge_are_foes_and_those_from_one_lane_are_not() -> None:
    east, north = link([(-10, 0), (10, 0)], "w", "e"), link([(0, -10), (0, 10)], "s", "n")
    beside, turning = link([(-10, 3.5), (10, 3.5)], "w2", "e2"), link([(-10, 0), (0, 10)], "w", "n")
    assert find_foes([east, north, beside, turning]) == {(0, 1), (1, 2), (1, 3), (2, 3)}


def test_a_bridge_is_no_foe() -> None:
    below, above = link([(-10, 0), (10, 0)], "w", "e"), link([(0, -10), (0, 10)], "s", "n", height=6.0)
    assert find_foes([below, above]) == set()


def test_lines_that_pass_at_40_cm_are_bent_until_they_cross() -> None:
    x = np.linspace(-10, 10, 41)
    above = link([(v, 0.2 + 0.02 * v * v) for v in x], "a", "b")
    below = link([(v, -0.2 - 0.02 * v * v) for v in x[::-1]], "c", "d")
    bent = bend_together((above, below), find_foes([above, below]))
    lowest = bent[0].shape[:, 1].min()
    assert lowest == pytest.approx(-0.025, abs=0.002)  # half of 0.4 m and of the 0.05 m they reach over each other
    assert np.array_equal(bent[0].shape[[0, -1]], above.shape[[0, -1]])


def test_lines_that_end_beside_each_other_cross_before() -> None:
    """Two lanes come together to 0.2 m at the map's end, where nothing follows: 0.29 m apart 1 m before it."""
    x = np.linspace(0, 20, 41)
    through, joining = link([(v, 0.0) for v in x], "a", "b"), link([(v, 0.2 + 0.09 * (20 - v)) for v in x], "c", "d")
    bent = bend_together((through, joining), {(0, 1)})
    (crossing, again) = np.flatnonzero(np.diff(np.sign(heights_over(bent[0], bent[1]))))
    assert 18.5 < crossing / 10 < again / 10 < 19.6
    assert np.array_equal(bent[1].shape[[0, -1]], joining.shape[[0, -1]])


def heights_over(low: JunctionLink, high: JunctionLink) -> np.ndarray:
    """How far the second line lies over the first, every 0.1 m of 20 m along x."""
    x = np.arange(0.0, 20.0, 0.1)
    return np.interp(x, *high.shape.T) - np.interp(x, *low.shape.T)


def test_ends_that_lanes_share_are_road_not_junction(tmp_path: Path) -> None:
    """Two lanes into one, alike for their last 4 m: the junction ends where they come together."""
    message = samples.empty("shared")
    for number, side in ((1, 1.0), (2, -1.0)):
        points = samples.line((0.0, side * 10.0), (30.0, side * 10.0 / 3.0), (36.0, 0.0), (40.0, 0.0))
        samples.lane(message, number, points, exits=[3])
    samples.lane(message, 3, samples.line((40.0, 0.0), (90.0, 0.0)), entries=[1, 2])
    samples.track(message, 1, samples.line((0.0, 10.0), (90.0, 0.0)), start=0.0, speed=5.0)
    given = samples.record(tmp_path, message)
    made = convert_network(given, tmp_path / "net")
    last, onward = made.pieces[1][-1], made.pieces[3][0]
    assert last.sumo_lane == onward.sumo_lane
    assert last.end - last.start == pytest.approx(4.0, abs=0.6)  # looked for every 0.5 m
    assert connectivity(given, read_net(made.path), made.pieces)["kept"] == 2


def test_a_stop_sign_stops_its_lane_alone_and_signs_all_round_stop_everybody(tmp_path: Path) -> None:
    states = {}
    for signs in ([101], [101, 102, 103, 104]):
        message = samples.four_way(signals=False)
        sign = next(f.stop_sign for f in message.map_features if f.HasField("stop_sign"))
        del sign.lane[:]
        sign.lane.extend(300 + 10 * (n - 101) + j for n in signs for j in range(4) if j != n - 101)
        made = convert_network(samples.record(tmp_path, message), tmp_path / str(len(signs)))
        edge = made.pieces[101][0].sumo_lane.rpartition("_")[0]
        connections = ET.parse(made.path).getroot().findall("connection")
        outer = [c for c in connections if not c.get("from", "").startswith(":")]
        states[len(signs)] = ({c.get("state") for c in outer if c.get("from") == edge}, {c.get("state") for c in outer})
    assert states[1][0] == {"s"} and "s" in states[1][1] and "M" in states[1][1]
    assert states[4] == ({"w"}, {"w"})


def test_of_two_in_conflict_exactly_one_yields(tmp_path: Path) -> None:
    made = convert_network(samples.record(tmp_path, samples.four_way(signals=False)), tmp_path / "net")
    junction = next(j for j in ET.parse(made.path).getroot().findall("junction") if j.findall("request"))
    requests = {int(r.get("index", "0")): r for r in junction.findall("request")}
    for i, request in requests.items():
        foes, response = request.get("foes", "")[::-1], request.get("response", "")[::-1]
        for j, foe in enumerate(foes):
            back = requests[j].get("response", "")[::-1][i]
            assert (int(response[j]) + int(back)) == int(foe)


def test_default_phases_never_let_conflicting_streams_go_together(tmp_path: Path) -> None:
    """All signals unknown: the whole program is the default."""
    message = samples.four_way()
    for step in message.dynamic_map_states:
        for state in step.lane_states:
            state.state = 0
    made = convert_network(samples.record(tmp_path, message), tmp_path / "net")
    assert made.report["signals_unknown"] == 12
    net = ET.parse(made.path).getroot()
    logic = net.find("tlLogic")
    junction = next(j for j in net.findall("junction") if j.get("type") == "traffic_light")
    assert logic is not None
    index_of = {c.get("via"): int(c.get("linkIndex", "-1")) for c in net.findall("connection") if c.get("tl")}
    order = [index_of[lane] for lane in junction.get("intLanes", "").split()]
    foes = {order[int(r.get("index", "0"))]: r.get("foes", "")[::-1] for r in junction.findall("request")}
    phases = [phase.get("state", "") for phase in logic.findall("phase")]
    assert all(any(state[k] in "gG" for state in phases) for k in range(12))
    for state in phases:
        going = [k for k in range(12) if state[k] in "gGy"]
        assert not [(a, b) for a in going for b in going if foes[a][order.index(b)] == "1"]


def test_bike_lanes_are_for_bicycles_and_unlimited_lanes_get_a_speed(tmp_path: Path) -> None:
    message = samples.straight()
    samples.lane(message, 30, samples.line((0.0, -3.0), (300.0, -3.0)), kind=3, speed=0.0)
    samples.lane(message, 31, samples.line((0.0, 30.0), (300.0, 30.0)), speed=0.0)
    made = convert_network(samples.record(tmp_path, message), tmp_path / "net")
    lanes = {lane.get("id"): lane for lane in ET.parse(made.path).getroot().iter("lane")}
    bike, car = (lanes[made.pieces[n][0].sumo_lane] for n in (30, 31))
    assert bike.get("allow") == "bicycle"
    assert "passenger" not in car.get("disallow", "")
    assert float(car.get("speed", "0")) == pytest.approx(11.18)  # 25 mph
    assert made.report["speeds_assumed"] == 2


def test_a_failing_netconvert_is_one_sentence(tmp_path: Path) -> None:
    for kind in ("nod", "edg", "con"):
        (tmp_path / f"plain.{kind}.xml").write_text("<nothing")
    with pytest.raises(UsageError, match=r"^netconvert could not build the network: .+\.$") as caught:
        run_netconvert(find_netconvert(), tmp_path, tmp_path / "out.net.xml")
    assert "\n" not in str(caught.value)


def test_a_missing_netconvert_names_the_extra() -> None:
    ask = "import sys\nfrom sumo_adv.simulation.programs import find_netconvert\nsys.path.clear()\nfind_netconvert()"
    done = subprocess.run([sys.executable, "-c", ask], env={"PATH": ""}, capture_output=True, text=True, check=False)
    last_line = done.stderr.strip().splitlines()[-1]
    assert last_line.startswith("sumo_adv.errors.UsageError") and "sumo-adv[sumo]" in last_line


@st.composite
def topologies(draw: st.DrawFn) -> Any:
    """A star of 2 to 5 arms with 1 or 2 lanes each way at any angles, some movements, signals or stops on some."""
    message = samples.empty("generated")
    arms = draw(st.lists(st.integers(0, 23), min_size=2, max_size=5, unique=True))
    lanes = draw(st.integers(1, 2))
    reach = draw(st.sampled_from([12.0, 20.0, 35.0]))
    ends: dict[tuple[int, int, bool], Any] = {}
    exits: dict[int, list[int]] = {}
    entries: dict[int, list[int]] = {}
    ways: list[tuple[int, Any, int, int]] = []
    for i, arm in enumerate(arms):
        angle = arm * math.pi / 12
        u = np.array([math.cos(angle), math.sin(angle)])
        right = np.array([u[1], -u[0]])
        for k in range(lanes):
            for inbound in (True, False):
                side = right * (1.75 + 3.5 * k) * (-1 if inbound else 1)
                corners = [tuple(u * r + side) for r in (reach, reach + draw(st.sampled_from([1.2, 9.0, 60.0])))]
                ends[i, k, inbound] = samples.line(*(reversed(corners) if inbound else corners))
    number = {key: 100 + n for n, key in enumerate(ends)}
    for i, arm in enumerate(arms):
        for j, exit_arm in enumerate(arms):
            for k in range(lanes):
                if i != j and draw(st.booleans()):
                    a, b = ends[i, k, True][-1], ends[j, k, False][0]
                    curve = samples.curve(tuple(a), arm * math.pi / 12 + math.pi, tuple(b), exit_arm * math.pi / 12)
                    way = 1000 + len(ways)
                    ways.append((way, curve, number[i, k, True], number[j, k, False]))
                    exits.setdefault(number[i, k, True], []).append(way)
                    entries.setdefault(number[j, k, False], []).append(way)
    for key, points in ends.items():
        n = number[key]
        samples.lane(message, n, points, exits=exits.get(n, []), entries=entries.get(n, []))
    for way, curve, source, target in ways:
        samples.lane(message, way, curve, entries=[source], exits=[target], interpolating=draw(st.booleans()))
    held = draw(st.lists(st.sampled_from([w[0] for w in ways]), unique=True)) if ways else []
    for step in message.dynamic_map_states:
        for n, way in enumerate(held):
            step.lane_states.add(lane=way, state=draw(st.sampled_from([0, 4, 6])) if n < 2 else 4)
    samples.track(message, 1, next(iter(ends.values())), start=0.0, speed=1.0)
    return message, len(ways)


@settings(max_examples=12, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(topologies())
def test_any_topology_loads_and_keeps_its_lanes_and_connections(made_up: tuple[Any, int]) -> None:
    message, ways = made_up
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        given = samples.record(folder, message)
        made = convert_network(given, folder / "net")
        net = read_net(made.path)
        connections, deviations = connectivity(given, net, made.pieces), lane_deviations(given, net)
        assert connections["kept"] == connections["wanted"] == 2 * ways
        assert deviations.distance.max() < MAX_LANE_DEVIATION_M
        assert lanes_in_sumo(made.path) >= made.report["lanes_made"]
