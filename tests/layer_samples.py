"""A road of two lanes eastwards, and one of two lanes northwards over it, which have no junction where they cross.

Lanes are 3.2 m wide: those of ``under`` are at y = -4.8 and -1.6 from x = -300 to 300, those of ``over`` at x = 4.8 and
1.6 from y = -300 to 300. So they cross 295 to 302 m after their beginnings.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from sumo_samples import make_net, make_spec

from sumo_adv.simulation.simulation_spec import SimulationSpec

UNDER, OVER = {"w": (-300, 0), "e": (300, 0)}, {"s": (0, -300), "n": (0, 300)}
CROSSING = "under from=w to=e;over from=s to=n"
RAMP = "west from=w to=m;east from=m to=e;ramp from=m to=k lanes=1;south from=s to=k;north from=k to=n"
"""With a ramp of 141 m, from (-100, 0) on the lower road to (0, 100) on the upper one."""


def make_network(folder: Path, edges: str = CROSSING, deck: float | None = None) -> Path:
    """The network; ``deck``: the height of the upper road [m], None = no heights."""
    at = {**UNDER, **OVER, **({"m": (-100, 0), "k": (0, 100)} if "k" in edges else {})}
    z = {name: f' z="{deck if name in "snk" else 0.0}"' if deck is not None else "" for name in at}
    nodes = "".join(f'<node id="{name}" x="{x}" y="{y}"{z[name]}/>' for name, (x, y) in at.items())
    drawn = []
    for text in edges.split(";"):
        name, *given = text.split()
        known = {"lanes": "2", **dict(each.split("=") for each in given)}
        ends = f'from="{known["from"]}" to="{known["to"]}" numLanes="{known["lanes"]}"'
        drawn.append(f'<edge id="{name}" {ends} speed="13.89"/>')
    options = ("--offset.disable-normalization", "--no-turnarounds", "--xml-validation", "never")
    return make_net(folder, nodes, "".join(drawn), *options, name="bridge")


def queue(edge: str, *fronts: float) -> list[str]:
    """Vehicles that stand in the right lane of an edge, named after where their fronts are [m]."""
    return [
        f'<vehicle id="deck{front:g}" type="calm" depart="0" departLane="0" departPos="{front}" departSpeed="0">'
        f'<route edges="{edge}"/><stop lane="{edge}_0" endPos="{front}" duration="1000"/></vehicle>'
        for front in fronts
    ]


def bridge_spec(folder: Path, vehicles: Iterable[str], network: Path) -> SimulationSpec:
    """What SUMO is started with."""
    return replace(make_spec(folder, "bridge", vehicles), network=network)


def configuration(folder: Path, vehicles: Iterable[str], network: Path) -> Path:
    """The same as a ``.sumocfg`` with steps of 0.1 s that begins at 0."""
    make_spec(folder, "bridge", vehicles)
    file = folder / "bridge.sumocfg"
    file.write_text(
        f'<configuration><input><net-file value="{network.name}"/><route-files value="bridge.rou.xml"/></input>'
        '<time><begin value="0"/><end value="60"/><step-length value="0.1"/></time></configuration>'
    )
    return file
