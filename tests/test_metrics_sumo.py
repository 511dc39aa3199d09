"""SUMO's own collision list against ours, on the real SUMO with our flags: what it misses and what it invents.

SUMO sees vehicles as stretches of lanes, so a vehicle across a lane, beside the road, or on another road that crosses
ours is not where SUMO thinks it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import libsumo
import numpy as np
import pytest
from sumo_samples import make_spec, vehicle

from sumo_adv.datatypes import Floats
from sumo_adv.geometry import Pose
from sumo_adv.metrics.boxes import first_contact, gap
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.simulation_spec import SimulationSpec
from sumo_adv.simulation.sumo_states import Snapshot
from sumo_adv.simulation.tracks import tracks_of

CROSSING_ROADS = """<net version="1.20">
  <location netOffset="0,0" convBoundary="-150,-150,80,80" origBoundary="-150,-150,80,80" projParameter="!"/>
  <edge id="a" from="w" to="j" priority="2"><lane id="a_0" index="0" speed="10" length="247"
    shape="-150,0 30,0 77,47"/></edge>
  <edge id="b" from="s" to="j" priority="1"><lane id="b_0" index="0" speed="10" length="247"
    shape="0,-150 0,30 47,77"/></edge>
  <junction id="w" type="dead_end" x="-150" y="0" incLanes="" intLanes="" shape="-150,0 -150,-3"/>
  <junction id="s" type="dead_end" x="0" y="-150" incLanes="" intLanes="" shape="0,-150 3,-150"/>
  <junction id="j" type="dead_end" x="80" y="80" incLanes="a_0 b_0" intLanes="" shape="77,47 47,77 80,80"/>
</net>
"""
"""Two roads to one junction that cross at right angles at the origin, before they reach it."""


@dataclass(frozen=True)
class Seen:
    """Two vehicles a and b: when SUMO reports a collision, when the boxes first touch, how far apart they are."""

    sumo: list[float]
    ours: float
    time: Floats
    gap: Floats

    def apart(self, when: float) -> float:
        """Distance of the boxes [m] at a step."""
        return float(self.gap[int(np.argmin(np.abs(self.time - when)))])


def watch(spec: SimulationSpec, poses: Mapping[str, Callable[[int], Pose]], steps: int) -> Seen:
    """Run a and b, driven where ``poses`` says so, and compare the two verdicts."""
    simulation, snapshots, reported = Simulation(spec), list[Snapshot](), list[float]()
    try:
        simulation.step()
        simulation.read()
        for k in range(steps):
            simulation.inject({name: pose(k) for name, pose in poses.items()})
            simulation.step()
            snapshots.append(simulation.read())
            if libsumo.simulation.getCollisions():
                reported.append(simulation.time)
        a, b = tracks_of(snapshots, simulation.fleet.sizes, {}, 0.1, ("a", "b"))
    finally:
        simulation.close()
    when = first_contact(a.boxes(), b.boxes(), a.time)
    return Seen(reported, float(when), a.time, gap(a.boxes(), b.boxes()))


def eastwards(x: float, y: float, speed: float = 10.0) -> Callable[[int], Pose]:
    return lambda k: Pose(x + speed * 0.1 * k, y, 0.0, speed)


def northwards(x: float, y: float, speed: float = 10.0) -> Callable[[int], Pose]:
    return lambda k: Pose(x, y + speed * 0.1 * k, math.pi / 2, speed)


@pytest.fixture
def straight(tmp_path: Path) -> SimulationSpec:
    """Three eastbound lanes, 3.2 m wide, the right one at y = -3.2; two cars of 5 x 2 m to be moved."""
    cars = [vehicle("a", "eastbound", 0, 100.0, 10.0), vehicle("b", "eastbound", 1, 150.0, 10.0)]
    return make_spec(tmp_path, "straight_3lane", cars)


def test_sumo_misses_two_cars_that_cross_on_approach_lanes(tmp_path: Path) -> None:
    """Both driven by SUMO at 10 m/s, fronts at 50 and 48 m of lanes that cross at 150 m.

    b's front is at a's flank, 149 m, after 101 m; a is in its way while its own front is between 149 and 156 m.
    """
    network = tmp_path / "crossing.net.xml"
    network.write_text(CROSSING_ROADS)
    spec = make_spec(tmp_path, "straight_3lane", [vehicle("a", "a", 0, 50.0, 10.0), vehicle("b", "b", 0, 48.0, 10.0)])
    seen = watch(SimulationSpec(network, spec.routes, (), 0.0, 1), {}, 130)
    assert seen.sumo == []
    assert seen.ours == pytest.approx(10.15, abs=0.15)  # departure takes up to a step, lengths are scaled by 0.2 %


def test_sumo_misses_a_collision_beside_the_road(straight: SimulationSpec) -> None:
    """a along y = -12, off all lanes: its front, 2.5 m ahead, is at b's side, x = 119, after 16.5 m, at 1.65 s.

    The first pose is the state at 0.2 s, and b is there then: its centre at y = -14, its front past a's flank.
    """
    seen = watch(straight, {"a": eastwards(100.0, -12.0), "b": northwards(120.0, -30.5)}, 40)
    assert seen.sumo == []
    assert seen.ours == pytest.approx(0.2 + 1.65, abs=0.01)


def test_sumo_misses_the_moment_at_which_a_crossing_car_hits_the_flank(straight: SimulationSpec) -> None:
    """b crosses at 12 m/s, a comes along at 10: SUMO reports them 2.5 m and more apart, and not when they touch."""
    seen = watch(straight, {"a": eastwards(100.0, -3.2), "b": northwards(120.0, -20.0, 12.0)}, 40)
    assert seen.ours == pytest.approx(1.85, abs=0.01)
    assert seen.sumo and max(seen.sumo) < seen.ours - 0.1
    assert min(seen.apart(t) for t in seen.sumo) > 2.0


def test_sumo_invents_a_collision_with_a_car_that_has_crossed(straight: SimulationSpec) -> None:
    """b crosses 4 m earlier and clears a by half a metre; SUMO reports a collision while they are 3.5 m apart."""
    seen = watch(straight, {"a": eastwards(100.0, -3.2), "b": northwards(120.0, -16.0)}, 40)
    assert seen.ours == math.inf
    assert seen.gap.min() == pytest.approx(0.5, abs=0.01)
    assert [seen.apart(t) for t in seen.sumo] == [pytest.approx(3.5, abs=0.05)]


def test_sumo_invents_a_collision_with_a_car_that_stands_across_two_metres_ahead(straight: SimulationSpec) -> None:
    """b across the lane with its flank at x = 129; a stops with its front at 127. SUMO: a collision, step by step."""

    def stopping(k: int) -> Pose:
        return Pose(min(100.0 + k, 124.5), -3.2, 0.0, 10.0 if k < 25 else 0.0)

    seen = watch(straight, {"a": stopping, "b": lambda k: Pose(130.0, -4.2, math.pi / 2, 0.0)}, 35)
    assert seen.ours == math.inf
    assert len(seen.sumo) >= 10
    assert seen.apart(seen.sumo[-1]) == pytest.approx(2.0, abs=0.01)
    assert min(seen.apart(t) for t in seen.sumo) == pytest.approx(2.0, abs=0.01)
