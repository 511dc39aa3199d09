"""Plain XML for netconvert: nodes, edges with a shape a lane, connections."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.womd.network.roads import Roads

NO_CARS = 'allow="bicycle"'
CARS = 'disallow="pedestrian tram rail_urban rail rail_electric rail_fast ship"'
POINTS = 6  # of a line that netconvert is told
_OCTAGON = [(0.2 * math.cos(k * math.pi / 4), 0.2 * math.sin(k * math.pi / 4)) for k in range(8)]


def write_plain(roads: Roads, folder: Path) -> None:
    """Write ``plain.nod.xml``, ``plain.edg.xml`` and ``plain.con.xml``.

    A junction gets an octagon of 0.2 m: with a shape of its own netconvert leaves the ends of the lanes alone. Shapes
    are thinned out, which saves netconvert time: the exact ones are written into what it makes (``finish``).
    """
    nodes = ["<nodes>"]
    for name, (x, y) in roads.junctions.items():
        octagon = " ".join(f"{x + dx:.3f},{y + dy:.3f}" for dx, dy in _OCTAGON)
        nodes.append(f'<node id="{name}" x="{x:.3f}" y="{y:.3f}" type="unregulated" shape="{octagon}"/>')
    edges = ["<edges>"]
    for edge in roads.edges.values():
        middle = edge.lanes[len(edge.lanes) // 2].shape
        edges.append(
            f'<edge id="{edge.name}" from="{edge.start}" to="{edge.end}" numLanes="{len(edge.lanes)}" '
            f'speed="{edge.speed:.2f}" spreadType="center" shape="{coordinates(_thin(middle))}">'
        )
        for index, lane in enumerate(edge.lanes):
            edges.append(
                f'<lane index="{index}" speed="{lane.speed:.2f}" width="{lane.width:.2f}" '
                f'{NO_CARS if lane.bike else CARS} shape="{coordinates(_thin(lane.shape))}"/>'
            )
        edges.append("</edge>")
    connections = ["<connections>"]
    for link in roads.links:
        connections.append(
            f'<connection from="{link.source}" to="{link.target}" fromLane="{link.from_lane}" toLane="{link.to_lane}" '
            f'shape="{coordinates(_thin(link.shape))}"/>'
        )
    linked = {link.source for link in roads.links}
    connections += [f'<connection from="{name}"/>' for name in roads.edges if name not in linked]
    for kind, lines, tag in (("nod", nodes, "nodes"), ("edg", edges, "edges"), ("con", connections, "connections")):
        (folder / f"plain.{kind}.xml").write_text("\n".join([*lines, f"</{tag}>\n"]), encoding="utf-8")


def coordinates(shape: Floats) -> str:
    """A shape as SUMO writes it."""
    return " ".join([f"{x:.3f},{y:.3f}" for x, y in shape[:, :2].tolist()])


def _thin(shape: Floats) -> Floats:
    """The ends and some of the points between."""
    count = min(len(shape), POINTS)
    return shape[np.linspace(0, len(shape) - 1, count).round().astype(int)]
