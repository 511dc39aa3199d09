"""What changes while the simulation runs is what the driver is told: limits, closed lanes, new routes, where it leaves.

The road has two lanes from x = 0 to 300 (``ab``) and on to 600 (``bc``); at x = 300 a road of one lane leaves it to the
right (``bd``).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from road_samples import drive, steps
from sumo_samples import make_net, vehicle

from sumo_adv.drivers import Action, Observation
from sumo_adv.geometry import Pose

NODES = (
    '<node id="a" x="0" y="0"/><node id="b" x="300" y="0"/><node id="c" x="600" y="0"/><node id="d" x="500" y="-200"/>'
)
EDGES = '<edge id="ab" from="a" to="b" numLanes="2" speed="20"/><edge id="bc" from="b" to="c" numLanes="2" speed="20"/>'
EDGES += '<edge id="bd" from="b" to="d" numLanes="1" speed="20"/>'


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_net(tmp_path_factory.mktemp("net"), NODES, EDGES, "--offset.disable-normalization")


def told(seen: Observation) -> dict[str, Any]:
    road = seen.road
    assert road is not None and seen.path is not None
    return {
        "time": seen.time, "x": seen.ego.x, "path": list(seen.path), "sides": road.sides, "leaves": road.leaves,
        "limits": [(limit.ahead, limit.speed) for limit in road.limits],
        "lanes": {n.id: n.limit for n in road.lanes if n.allowed},
        "closed": {n.id for n in road.lanes if not n.allowed},
    }  # fmt: skip


def additional(folder: Path, text: str) -> tuple[Path, ...]:
    file = folder / "live.add.xml"
    file.write_text(f"<additional>{text}</additional>")
    return (file,)


EGO = vehicle("ego", "ab bc", 0, 200.0, 10.0)


def test_a_variable_speed_sign_is_the_limit_that_is_told(net: Path, tmp_path: Path) -> None:
    steps_of_it = '<step time="0" speed="20"/><step time="2" speed="8"/>'
    sign = f'<variableSpeedSign id="v" lanes="bc_0 bc_1">{steps_of_it}</variableSpeedSign>'
    with drive(tmp_path, net, [EGO], told, additional=additional(tmp_path, sign)) as (moving, watcher):
        steps(moving, 40)
    before, after = watcher.kept[0], watcher.kept[-1]
    assert {speed for _, speed in before["limits"]} == {20.0} and before["lanes"]["bc_0"] == 20.0
    assert after["limits"][-1] == (pytest.approx(300.0 - after["x"], abs=15.0), 8.0) and after["lanes"]["bc_1"] == 8.0


CLOSES = """<rerouter id="r" edges="ab"><interval begin="2" end="1000">{}</interval></rerouter>"""


@pytest.mark.parametrize("lane", ["bc_0", "ab_1"])
def test_a_lane_that_a_rerouter_closes_is_not_for_the_ego(net: Path, tmp_path: Path, lane: str) -> None:
    closes = additional(tmp_path, CLOSES.format(f'<closingLaneReroute id="{lane}" disallow="passenger"/>'))
    with drive(tmp_path, net, [EGO], told, additional=closes) as (moving, watcher):
        steps(moving, 30)
    before, after = watcher.kept[0], watcher.kept[-1]
    assert lane in before["lanes"] and lane not in after["lanes"]
    assert before["sides"] == pytest.approx((3.2,)) and len(after["sides"]) == (0 if lane == "ab_1" else 1)
    assert before["path"][-1][1] == pytest.approx(-4.8, abs=0.1)  # along the right lane
    assert after["path"][-1][1] == pytest.approx(-1.6 if lane == "bc_0" else -4.8, abs=0.1)


def test_another_program_closes_a_lane_and_lowers_a_limit(net: Path, tmp_path: Path) -> None:
    with drive(tmp_path, net, [EGO], told) as (moving, watcher):
        steps(moving, 3)
        moving.simulation.api.lane.setMaxSpeed("ab_0", 5.0)
        moving.simulation.api.lane.setDisallowed("ab_1", ["passenger"])
        steps(moving, 1)
        moving.simulation.api.lane.setDisallowed("ab_1", [])
        steps(moving, 1)
    assert [kept["limits"][0][1] for kept in watcher.kept] == [20.0, 20.0, 5.0, 5.0]
    assert [len(kept["sides"]) for kept in watcher.kept] == [1, 1, 0, 1]
    assert ["ab_1" in kept["lanes"] for kept in watcher.kept] == [True, True, False, True]
    assert [kept["closed"] for kept in watcher.kept] == [set(), set(), {"ab_1"}, set()]


def ahead(seen: Observation) -> Action:
    step = seen.ego.speed * seen.dt
    return Pose(seen.ego.x + step * math.cos(seen.ego.heading), seen.ego.y, 0.0, 10.0)


@pytest.mark.parametrize("answer", [lambda _: None, ahead])
def test_a_new_route_is_the_path(net: Path, tmp_path: Path, answer: Callable[[Observation], Action]) -> None:
    """Another program sends the ego to the right after 1 s, whether SUMO drives it or its driver."""
    with drive(tmp_path, net, [EGO], told, answer) as (moving, watcher):
        steps(moving, 10)
        moving.simulation.api.vehicle.changeTarget("ego", "bd")
        steps(moving, 3)
    assert watcher.kept[0]["path"][-1][1] == pytest.approx(-4.8, abs=0.1)
    assert watcher.kept[-1]["path"][-1][1] < -20.0


ARRIVALS = [
    ('arrivalPos="120"', 420.0), ('arrivalPos="-100"', 500.0), ('arrivalEdge="0" arrivalPos="290"', 290.0), ("", 600.0),
]  # fmt: skip


@pytest.mark.parametrize(("arrival", "x"), ARRIVALS)
def test_where_sumo_takes_it_out_it_leaves(net: Path, tmp_path: Path, arrival: str, x: float) -> None:
    """``bc`` begins at x = 300 or, where netconvert cuts it, a little later."""
    ego = EGO.replace("<vehicle ", f"<vehicle {arrival} ")
    with drive(tmp_path, net, [ego], told) as (moving, watcher):
        steps(moving, 700)
        assert "ego" not in moving.snapshot.raw
    last = watcher.kept[-1]
    assert last["x"] + 2.5 == pytest.approx(x, abs=16.0)
    leaving = [kept["leaves"] for kept in watcher.kept]
    assert leaving[-1] and not leaving[-8] and leaving == sorted(leaving)
