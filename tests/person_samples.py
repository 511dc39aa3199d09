"""A street from x = 0 to 200 with a lane and a pavement each way and a crossing at x = 100, and its persons.

The eastbound lane is at y = -1.6, its pavement at y = -4.2; the other two are at y = 1.6 and 4.2. Lanes are 3.2 m wide,
the crossing 3 m. Persons are 0.4 m long and 0.6 m wide and walk at 1 m/s.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from sumo_samples import make_net, make_spec

from sumo_adv.simulation.simulation_spec import SimulationSpec
from sumo_adv.simulation.sumo_options import DEFAULTS

NODES = '<node id="a" x="0" y="0"/><node id="b" x="100" y="0"/><node id="c" x="200" y="0"/>'
EDGES = "".join(
    f'<edge id="{start}{end}" from="{start}" to="{end}" numLanes="1" speed="13.89" sidewalkWidth="2"/>'
    for start, end in ("ab", "bc", "cb", "ba")
)
CONNECTIONS = (
    '<connection from="ab" to="bc"/><connection from="cb" to="ba"/>'
    '<crossing node="b" edges="bc cb" width="3" priority="true"/>'
)
WALKS = (
    '<vType id="adult" vClass="pedestrian" maxSpeed="1" speedFactor="1" speedDev="0" length="0.4" width="0.6"/>'
    '<person id="walker" type="adult" depart="0" departPos="90"><walk edges="ab cb" arrivalPos="60"/></person>'
)
"""It walks 8.5 m on the eastbound pavement to the crossing, and goes on on the other side."""
STANDS = (
    '<vType id="adult" vClass="pedestrian" length="0.4" width="0.6"/>'
    '<person id="walker" type="adult" depart="0" departPos="60"><stop lane="ab_0" duration="100"/></person>'
)
"""SUMO has it at y = -7.2, 3 m beside the pavement's middle."""


def make_street(folder: Path) -> Path:
    """The network."""
    return make_net(folder, NODES, EDGES, "--no-turnarounds", connections=CONNECTIONS, name="street")


def street_spec(folder: Path, demand: Iterable[str], model: str = "striping") -> SimulationSpec:
    """What SUMO is started with; ``model``: of its pedestrians. They walk evenly."""
    options = {**DEFAULTS, "pedestrian.model": model, "pedestrian.striping.dawdling": "0"}
    spec = make_spec(folder, "street", demand)
    return replace(spec, network=make_street(folder), options=options)
