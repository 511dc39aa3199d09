"""Small SUMO inputs for tests: vehicles written by hand on the shipped networks."""

from __future__ import annotations

import math
import subprocess
from collections.abc import Iterable
from pathlib import Path

from sumo_adv.geometry import Pose
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.programs import find_netconvert
from sumo_adv.simulation.simulation_spec import SimulationSpec

TYPES = """
  <vType id="calm" vClass="passenger" carFollowModel="Krauss" sigma="0" tau="1" length="5" width="2" maxSpeed="40"
    lcSpeedGain="0" lcKeepRight="0" lcStrategic="0" lcCooperative="0"/>
  <vType id="nervous" vClass="passenger" carFollowModel="Krauss" sigma="0.9" tau="1" length="4.6" width="1.8"/>
"""


def vehicle(name: str, edges: str, lane: int, position: float, speed: float, kind: str = "calm") -> str:
    """A vehicle with its front bumper at ``position`` [m] of a lane at time 0."""
    return (
        f'<vehicle id="{name}" type="{kind}" depart="0" departLane="{lane}" departPos="{position}" '
        f'departSpeed="{speed}"><route edges="{edges}"/></vehicle>'
    )


def make_spec(folder: Path, network: str | Path, vehicles: Iterable[str], seed: int = 1) -> SimulationSpec:
    """A demand file in ``folder`` and the spec to start SUMO with. network: a file, or the name of a shipped one."""
    file = network if isinstance(network, Path) else data_folder("networks") / f"{network}.net.xml"
    routes = folder / f"{file.name.removesuffix('.net.xml')}.rou.xml"
    routes.write_text(f"<routes>{TYPES}{''.join(vehicles)}</routes>")
    return SimulationSpec(file, (routes,), (), 0.0, seed)


def make_net(
    folder: Path, nodes: str, edges: str, *options: str, connections: str = "", name: str = "own"
) -> Path:  # fmt: skip
    """A network that netconvert makes of ``<node>``, ``<edge>`` and ``<connection>`` elements."""
    command = [str(find_netconvert()), "-o", f"{name}.net.xml", *options]
    for option, kind, elements in (("-n", "nodes", nodes), ("-e", "edges", edges), ("-x", "connections", connections)):
        if elements:
            (folder / f"{name}.{kind[:3]}.xml").write_text(f"<{kind}>{elements}</{kind}>", encoding="utf-8")
            command += [option, f"{name}.{kind[:3]}.xml"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return folder / f"{name}.net.xml"


def over_the_line(k: int, start: float = 120.0) -> Pose:
    """From the right lane of ``straight_3lane`` (y = -3.2) to the middle one in 3 s at 12 m/s, step ``k`` of 0.1 s."""
    share = min(k / 30.0, 1.0)
    y = -3.2 + 1.6 * (1.0 - math.cos(math.pi * share))
    slope = 1.6 * math.pi / 36.0 * math.sin(math.pi * share)
    return Pose(start + 1.2 * k, y, math.atan(slope), 12.0)


def write(path: Path, text: str) -> Path:
    """A file with its folders."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path
