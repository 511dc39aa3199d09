"""A street along the x axis with a lane for each of SUMO's kinds of vehicles.

``ab`` (x = 0 to 400) and ``bc`` (to 800) have from the right: a sidewalk (y = -10.9, 2 m wide), a cycle lane (y =
-9.15, 1.5 m), a lane for buses and taxis (y = -6.8, 3.2 m; at c it leads onto ``cd``, which is for buses alone) and one
for all (y = -3.6, 3.2 m; onto ``ce``). North of them are a tram track (y = 28.4) and a path for pedestrians and cycles
(y = 48.4).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from sumo_samples import make_net, make_spec

from sumo_adv.simulation.simulation_spec import SimulationSpec

NODES = "".join(
        f'<node id="{name}" x="{x}" y="{y}"/>'
        for name, x, y in (
            ("a", 0, -2), ("b", 400, -2), ("c", 800, -2), ("d", 1200, -60), ("e", 1200, -2),
            ("t", 0, 30), ("u", 400, 30), ("p", 0, 50), ("q", 400, 50),
        )
)  # fmt: skip
LANES = (
    '<lane index="0" allow="pedestrian" width="2"/><lane index="1" allow="bicycle" width="1.5"/>'
    '<lane index="2" allow="bus taxi"/><lane index="3" disallow="pedestrian bicycle"/>'
)
EDGES = f"""
  <edge id="ab" from="a" to="b" numLanes="4" speed="13.9">{LANES}</edge>
  <edge id="bc" from="b" to="c" numLanes="4" speed="13.9">{LANES}</edge>
  <edge id="cd" from="c" to="d" numLanes="1" speed="13.9" allow="bus"/>
  <edge id="ce" from="c" to="e" numLanes="1" speed="13.9" disallow="pedestrian"/>
  <edge id="tu" from="t" to="u" numLanes="1" speed="13.9" allow="tram"/>
  <edge id="pq" from="p" to="q" numLanes="1" speed="13.9" allow="pedestrian bicycle"/>
"""
CONNECTIONS = """
  <connection from="bc" to="cd" fromLane="2" toLane="0"/><connection from="bc" to="ce" fromLane="3" toLane="0"/>
"""
SIDEWALK, CYCLES, BUSES, CARS = range(4)


CYCLE_TRACK = '<edge id="ab" from="a" to="b" numLanes="1" speed="8" allow="bicycle"/>'


def make_street(folder: Path, edges: str = EDGES, connections: str = CONNECTIONS) -> Path:
    """The network, or one of other edges between its nodes."""
    options = ("--no-turnarounds", "--offset.disable-normalization")
    return make_net(folder, NODES, edges, *options, connections=connections, name="classes")


def vtype(vclass: str, more: str = "") -> str:
    """A type of a class, named like it, whose drivers do not dawdle."""
    return f'<vType id="{vclass}" vClass="{vclass}" sigma="0" {more}/>'


def street_spec(folder: Path, demand: Iterable[str], seed: int = 1) -> SimulationSpec:
    """What SUMO is started with."""
    return replace(make_spec(folder, "classes", demand, seed), network=make_street(folder))
