"""Generated traffic: seeded to the byte, on real routes, as dense as was asked for."""

from __future__ import annotations

import random
import re
from pathlib import Path

import pytest
from sumo_samples import make_net

from sumo_adv.errors import UsageError
from sumo_adv.simulation.demand import default_density, generate_demand, generate_flows, journeys
from sumo_adv.simulation.inputs import data_folder, load_input
from sumo_adv.simulation.scan import scan_demand, scan_network

RING = ("ab", "bc", "ca")
T_NODES = '<node id="C" x="0" y="0"/><node id="W" x="-200" y="0"/><node id="E" x="200" y="0"/>'
T_NODES += '<node id="S" x="0" y="-200"/>'
T_EDGES = "".join(f'<edge id="{a}_in" from="{a}" to="C"/><edge id="{a}_out" from="C" to="{a}"/>' for a in "WES")


def ring(path: Path, length: float) -> Path:
    """Three edges in a circle, a -> b -> c -> a, each of ``length`` m: nothing leads in, nothing leads out."""
    place = '<location netOffset="0,0" convBoundary="0,0,9,9" origBoundary="0,0,9,9" projParameter="!"/>'
    lines = ['<net version="1.20">', place]
    for edge in RING:
        lane = f'<lane id="{edge}_0" index="0" speed="10" length="{length}" shape="0,0 9,9"/>'
        lines.append(f'<edge id="{edge}" from="{edge[0]}" to="{edge[1]}" priority="1">{lane}</edge>')
    for node in "abc":
        lines.append(f'<junction id="{node}" type="priority" x="0" y="0" incLanes="" intLanes="" shape="0,0 0,1"/>')
    for origin, onward in zip(RING, ("bc", "ca", "ab"), strict=True):
        lines.append(f'<connection from="{origin}" to="{onward}" fromLane="0" toLane="0" dir="s" state="M"/>')
    path.write_text("\n".join([*lines, "</net>"]), encoding="utf-8")
    return path


def shipped(name: str) -> Path:
    return data_folder("networks") / f"{name}.net.xml"


def departs(path: Path) -> list[float]:
    return [float(value) for value in re.findall(r'depart="([\d.]+)"', path.read_text(encoding="utf-8"))]


def test_the_same_arguments_give_the_same_bytes_and_another_seed_others(tmp_path: Path) -> None:
    network = shipped("priority_crossing")
    first = generate_demand(network, tmp_path / "1.rou.xml", seed=7, density=20.0, begin=0.0, end=60.0).read_bytes()
    again = generate_demand(network, tmp_path / "2.rou.xml", seed=7, density=20.0, begin=0.0, end=60.0).read_bytes()
    other_seed = generate_demand(
        network, tmp_path / "3.rou.xml", seed=8, density=20.0, begin=0.0, end=60.0
    ).read_bytes()
    assert first == again
    assert first != other_seed
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.rou.xml", "2.rou.xml", "3.rou.xml"]


def test_twelve_a_minute_over_100_s_are_twenty_in_order_within_the_times(tmp_path: Path) -> None:
    path = generate_demand(shipped("two_way"), tmp_path / "d.rou.xml", seed=1, density=12.0, begin=50.0, end=150.0)
    times = departs(path)
    assert len(times) == 20
    assert times == sorted(times)
    assert times[0] >= 50.0
    assert times[-1] < 150.0
    assert scan_demand(path).vehicles == {f"bv{number}" for number in range(20)}


def test_a_later_end_changes_nothing_before(tmp_path: Path) -> None:
    """Traffic is drawn in parts of 120 s."""
    network = shipped("priority_crossing")
    short, long = (
        generate_demand(network, tmp_path / f"{end}.rou.xml", seed=7, begin=0.0, end=end).read_text()
        for end in (120.0, 300.0)
    )
    assert long.startswith(short.removesuffix("</routes>\n"))
    assert max(departs(tmp_path / "300.0.rou.xml")) > 240.0


def test_routes_lead_from_fringe_to_fringe_over_edges_of_the_network(tmp_path: Path) -> None:
    network = shipped("t_junction")
    scan = scan_demand(generate_demand(network, tmp_path / "d.rou.xml", seed=1, begin=0.0, end=120.0))
    assert set(scan.edges) <= scan_network(network).drivable
    routes = {journey.edges for journey in journeys(network, random.Random(0))}
    arms = ("west", "east", "south")
    assert routes == {(f"{a}_in", f"{b}_out") for a in arms for b in arms if a != b}


def test_in_left_hand_traffic_routes_do_not_turn_round_either(tmp_path: Path) -> None:
    """SUMO writes ``T`` for a turnaround there. Each of three arms leads to the two others."""
    network = make_net(tmp_path, T_NODES, T_EDGES, "--lefthand", name="left")
    assert ' dir="T"' in network.read_text(encoding="utf-8")
    routes = {journey.edges for journey in journeys(network, random.Random(0))}
    assert routes == {(f"{a}_in", f"{b}_out") for a in "WES" for b in "WES" if a != b}


def test_the_default_density_follows_lanes_and_yielding() -> None:
    """Two free lanes: 2 x 10; three lanes with yielding: 3 x 4; eight with lights: 32, capped at 30."""
    figures = {"two_way": 20.0, "t_junction": 12.0, "signalised_crossing": 30.0}
    for name, figure in figures.items():
        assert default_density(journeys(shipped(name), random.Random(0))) == figure


def test_generated_traffic_is_accepted_as_the_networks_own(tmp_path: Path) -> None:
    generate_demand(shipped("roundabout"), tmp_path / "d.rou.xml", seed=3, begin=0.0, end=60.0)
    text = f'<configuration><n value="{shipped("roundabout")}"/><r value="d.rou.xml"/></configuration>'
    (tmp_path / "case.sumocfg").write_text(text, encoding="utf-8")
    assert len(load_input(tmp_path / "case.sumocfg").routes) == 1


def test_a_network_without_fringe_gets_routes_between_inner_edges(tmp_path: Path) -> None:
    """Edges of 100 m: any two in a row (200 m) and all three (300 m) are long enough, from each of three starts."""
    routes = journeys(ring(tmp_path / "ring.net.xml", 100.0), random.Random(0))
    expected = {("ab", "bc"), ("ab", "bc", "ca"), ("bc", "ca"), ("bc", "ca", "ab"), ("ca", "ab"), ("ca", "ab", "bc")}
    assert {journey.edges for journey in routes} == expected
    assert default_density(routes) == 12.0


def test_a_network_without_any_route_of_use_is_refused(tmp_path: Path) -> None:
    """Edges of 20 m: the longest route is 60 m, short of the 150 m asked for."""
    with pytest.raises(UsageError, match="No route leads through"):
        generate_demand(ring(tmp_path / "ring.net.xml", 20.0), tmp_path / "d.rou.xml", seed=1, begin=0.0, end=60.0)
    assert not (tmp_path / "d.rou.xml").exists()


def test_a_network_that_is_not_whole_is_refused(tmp_path: Path) -> None:
    """Without a location sumolib cannot read it."""
    network = ring(tmp_path / "ring.net.xml", 100.0)
    network.write_text(network.read_text(encoding="utf-8").replace(' projParameter="!"', ""), encoding="utf-8")
    with pytest.raises(UsageError, match="projParameter"):
        generate_demand(network, tmp_path / "d.rou.xml", seed=1, begin=0.0, end=60.0)


@pytest.mark.parametrize(
    ("density", "begin", "end", "part"),
    [(0.0, 0.0, 9.0, "density"), (float("inf"), 0.0, 9.0, "density"), (5.0, 9.0, 9.0, "end must be later")],
)
def test_senseless_figures_are_refused(tmp_path: Path, density: float, begin: float, end: float, part: str) -> None:
    with pytest.raises(UsageError, match=part):
        generate_demand(shipped("two_way"), tmp_path / "d.rou.xml", seed=1, density=density, begin=begin, end=end)
    assert list(tmp_path.iterdir()) == []


def test_flows_have_the_density_of_the_network_over_all_routes(tmp_path: Path) -> None:
    network = shipped("straight_2lane")
    text = generate_flows(network, tmp_path / "flows.rou.xml", density=30.0, end=100.0).read_text(encoding="utf-8")
    rates = [float(rate) for rate in re.findall(r'period="exp\(([\d.]+)\)"', text)]
    assert len(rates) == len(journeys(network, random.Random(0)))
    assert sum(rates) == pytest.approx(0.5)  # departures a second
    assert 'speedDev="0.1"' in text and scan_demand(tmp_path / "flows.rou.xml").flows
    with pytest.raises(UsageError, match="A density of 0"):
        generate_flows(network, tmp_path / "none.rou.xml", density=0.0, end=100.0)
