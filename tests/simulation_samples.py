"""Small simulations: two networks, and the files of a .sumocfg."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

NODES = """
<node id="W" x="0" y="0"/><node id="C" x="200" y="0" type="traffic_light"/><node id="E" x="400" y="0"/>
<node id="N" x="200" y="200"/><node id="S" x="200" y="-200"/>"""
EDGES = """
<edge id="WC" from="W" to="C" numLanes="2" speed="13.9" sidewalkWidth="2"/>
<edge id="CW" from="C" to="W" numLanes="1" speed="13.9"/>
<edge id="CE" from="C" to="E" numLanes="2" speed="13.9" sidewalkWidth="2"/>
<edge id="EC" from="E" to="C" numLanes="1" speed="13.9"/>
<edge id="SC" from="S" to="C" numLanes="2" speed="13.9"><lane index="0" allow="bus"/></edge>
<edge id="CN" from="C" to="N" numLanes="2" speed="13.9"><lane index="0" allow="bus"/></edge>
<edge id="CS" from="C" to="S" numLanes="1" speed="13.9"/><edge id="NC" from="N" to="C" numLanes="1" speed="13.9"/>"""
"""A crossing with a light, sidewalks on one road and bus lanes on the other; each arm is 200 m long."""
COUNTRY_NODES = '<node id="A" x="0" y="0"/><node id="B" x="900" y="0"/>'
COUNTRY_EDGES = """<edge id="AB" from="A" to="B" numLanes="1" speed="27"/>
<edge id="BA" from="B" to="A" numLanes="1" speed="27"/>"""


def configuration(folder: Path, network: Path, demand: str, additional: str = "", **options: str) -> Path:
    """A .sumocfg with its demand and additional file; ``options``: SUMO's. Its steps are of 0.1 s."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "r.rou.xml").write_text(f"<routes>{demand}</routes>", encoding="utf-8")
    given = {"net-file": str(network), "route-files": "r.rou.xml", "step-length": "0.1"}
    if additional:
        (folder / "a.add.xml").write_text(f"<additional>{additional}</additional>", encoding="utf-8")
        given["additional-files"] = "a.add.xml"
    return write_configuration(folder / "own.sumocfg", given | options)


def write_configuration(path: Path, given: Mapping[str, str]) -> Path:
    """A .sumocfg of these options."""
    text = "".join(f'<{name} value="{value}"/>' for name, value in given.items())
    path.write_text(f"<configuration>{text}</configuration>", encoding="utf-8")
    return path
