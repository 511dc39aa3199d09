"""Write the network: plain XML for netconvert, and then the parts that netconvert does not know.

The plain XML has nodes, edges with a shape for each lane, and connections. Afterwards, exact shapes and lengths, right
of way, signals, junction polygons and the drivable area are written into netconvert's output.
"""

from __future__ import annotations

import math
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.errors import UsageError
from sumo_adv.simulation.drivable import DRIVABLE_KEY, area_text
from sumo_adv.simulation.layers import HEIGHTS_KEY as HEIGHTS
from sumo_adv.simulation.layers import pass_over
from sumo_adv.womd.network.right_of_way import LinkPriorities
from sumo_adv.womd.network.roads import JunctionLink, RoadLane, RoadNetwork
from sumo_adv.womd.network.signals import Program

BIKE_LANE_ATTRIBUTE = 'allow="bicycle"'
CAR_LANE_ATTRIBUTE = 'disallow="pedestrian tram rail_urban rail rail_electric rail_fast ship"'
MAX_LINE_POINTS = 6  # maximum number of points of a line that netconvert receives
_OCTAGON = [(0.2 * math.cos(k * math.pi / 4), 0.2 * math.sin(k * math.pi / 4)) for k in range(8)]
RECORD_NETCONVERT_OPTIONS = (
    "--offset.disable-normalization", "--no-turnarounds", "--junctions.join", "false",
    "--geometry.avoid-overlap", "false", "--default.junctions.radius", "0", "--precision", "3",
    "--geometry.max-angle", "-1", "--geometry.min-radius", "-1", "--no-warnings", "--xml-validation", "never",
)  # fmt: skip
RECORD_NETCONVERT_TIMEOUT_S = 120.0
MIN_LANE_LENGTH_M = 0.1  # the shortest lane in SUMO


def write_plain(roads: RoadNetwork, folder: Path) -> None:
    """Write ``plain.nod.xml``, ``plain.edg.xml`` and ``plain.con.xml``.

    A junction gets an octagon of 0.2 m, because netconvert does not change the ends of lanes at a junction that has its
    own shape. Shapes are thinned out, which saves netconvert time. The exact shapes are written into its output
    (``finish_network``).

    Args:
        roads: The network.
        folder: Where the files are written.
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
                f'{BIKE_LANE_ATTRIBUTE if lane.bike else CAR_LANE_ATTRIBUTE} shape="{coordinates(_thin(lane.shape))}"/>'
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
    """Return a shape as SUMO writes it."""
    return " ".join([f"{x:.3f},{y:.3f}" for x, y in shape[:, :2].tolist()])


def _thin(shape: Floats) -> Floats:
    """Return the ends and some of the points between."""
    count = min(len(shape), MAX_LINE_POINTS)
    return shape[np.linspace(0, len(shape) - 1, count).round().astype(int)]


def run_netconvert(program: Path, folder: Path, target: Path) -> None:
    """Convert ``plain.*.xml`` to a network.

    Args:
        program: The program ``netconvert``.
        folder: The folder of the plain files.
        target: The network to write.

    Raises:
        UsageError: netconvert failed; the message contains its last error.
    """
    command = [str(program), *RECORD_NETCONVERT_OPTIONS, "-o", str(target)]
    for option, kind in (("-n", "nod"), ("-e", "edg"), ("-x", "con")):
        command += [option, str(folder / f"plain.{kind}.xml")]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=RECORD_NETCONVERT_TIMEOUT_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise UsageError(f"netconvert could not build the network: {error}.") from error
    if done.returncode != 0 or not target.is_file():
        errors = [line for line in done.stderr.splitlines() if line.startswith("Error")]
        last = errors[-1].removeprefix("Error: ").rstrip(".") if errors else f"exit status {done.returncode}"
        raise UsageError(f"netconvert could not build the network: {last}.")


def finish_network(
    source: Path, target: Path, roads: RoadNetwork, order: LinkPriorities, programs: Mapping[str, Program], ground: Any
) -> list[str]:
    """Write the finished network from netconvert's output.

    Args:
        source: netconvert's output.
        target: The network to write.
        roads: The network with its exact shapes.
        order: The right of way of its links.
        programs: The signal programs by junction.
        ground: The drivable area that the network carries (shapely polygons [m]); None for none.

    Returns:
        The internal lane of each link.

    Raises:
        UsageError: netconvert left something out.
    """
    tree = ET.parse(source)
    net = tree.getroot()
    lanes = {lane.get("id", ""): lane for edge in net.iter("edge") for lane in edge}
    ways: list[RoadLane | JunctionLink] = [lane for edge in roads.edges.values() for lane in edge.lanes]
    ways += roads.links
    high = pass_over([np.column_stack([way.shape, way.heights]) for way in ways])
    for edge in roads.edges.values():
        for index, lane in enumerate(edge.lanes):
            element = lanes.get(f"{edge.name}_{index}")
            if element is None:
                raise UsageError(f"netconvert left out lane {edge.name}_{index}: the network is not complete.")
            _shape(element, lane, high=high)
    via = _connections(net, lanes, roads, order, programs, high=high)
    _junctions(net, roads, order, programs, via)
    if ground is not None:
        ET.SubElement(net.findall("junction")[0], "param", key=DRIVABLE_KEY, value=area_text(ground))
    points = np.vstack([lane.shape for edge in roads.edges.values() for lane in edge.lanes])
    (west, south), (east, north) = points.min(axis=0), points.max(axis=0)
    boundary = f"{west:.3f},{south:.3f},{east:.3f},{north:.3f}"
    net.find("location").set("convBoundary", boundary)  # type: ignore[union-attr]
    ET.indent(tree, "    ")
    tree.write(target, encoding="UTF-8", xml_declaration=True)
    return via


def _shape(lane: ET.Element, way: RoadLane | JunctionLink, *, high: bool) -> None:
    """Write the shape of a lane, with its heights if ``high`` is set."""
    length = float(np.sum(np.hypot(*np.diff(way.shape, axis=0).T)))
    lane.set("shape", coordinates(way.shape))
    lane.set("length", f"{max(length, MIN_LANE_LENGTH_M):.3f}")
    lane.set("width", f"{way.width:.2f}")
    lane.set("speed", f"{way.speed:.2f}")
    if high:
        ET.SubElement(lane, "param", key=HEIGHTS, value=" ".join(f"{z:.2f}" for z in way.heights))


def _connections(
    net: ET.Element, lanes: dict[str, ET.Element], roads: RoadNetwork, order: LinkPriorities,
    programs: Mapping[str, Program], *, high: bool,
) -> list[str]:  # fmt: skip
    """Write the letters of each connection and its internal lane's shape; return the internal lane of each link."""
    number = {(k.source, k.from_lane, k.target, k.to_lane): n for n, k in enumerate(roads.links)}
    via = [""] * len(roads.links)
    link_of_via: dict[str, int] = {}
    inner = []
    for element in net.findall("connection"):
        if element.get("from", "").startswith(":"):
            inner.append(element)
            continue
        start, end = element.get("from", ""), element.get("to", "")
        key = start, int(element.get("fromLane", 0)), end, int(element.get("toLane", 0))
        n = number[key]
        link = roads.links[n]
        via[n] = element.get("via", "")
        link_of_via[via[n]] = n
        element.set("dir", link.direction)
        element.set("state", order.state[n])
        program = programs.get(link.junction)
        if program is not None and n in program.index:
            element.set("tl", link.junction)
            element.set("linkIndex", str(program.index[n]))
            element.set("state", "O" if order.state[n] == "M" else "o")
        _shape(lanes[via[n]], link, high=high)
    for element in inner:
        link = roads.links[link_of_via[f"{element.get('from')}_{element.get('fromLane')}"]]
        element.set("dir", link.direction)
    if "" in via:
        lost = roads.links[via.index("")]
        raise UsageError(
            f"netconvert left out the connection from {lost.source} to {lost.target}: the network is not complete."
        )
    return via


def _junctions(
    net: ET.Element, roads: RoadNetwork, order: LinkPriorities, programs: Mapping[str, Program], via: list[str]
) -> None:
    """Write the polygons, the right of way and the signals of the junctions."""
    of_lane = {lane: n for n, lane in enumerate(via)}
    polygons = junction_polygons(roads)
    first = len(net)
    for position, junction in enumerate(list(net)):
        if junction.tag != "junction":
            continue
        first = min(first, position)
        name = junction.get("id", "")
        if name in polygons:
            junction.set("shape", coordinates(polygons[name]))
        inside = [of_lane[lane] for lane in junction.get("intLanes", "").split()]
        if not inside:
            continue
        junction.set("type", "traffic_light" if name in programs else order.kind[name])
        for request in junction.findall("request"):
            junction.remove(request)
        for index, n in enumerate(inside):
            ET.SubElement(
                junction, "request", index=str(index), response=_bits(inside, order.yields_to[n]),
                foes=_bits(inside, order.foes[n]), cont="0",
            )  # fmt: skip
    for name in reversed(list(programs)):
        net.insert(first, programs[name].element(name))


def _bits(inside: list[int], chosen: frozenset[int]) -> str:
    """Return SUMO's bits of the chosen links, the highest index first."""
    return "".join("1" if n in chosen else "0" for n in reversed(inside))


def junction_polygons(roads: RoadNetwork) -> dict[str, Floats]:
    """Return the ground that the links of each junction cover.

    Args:
        roads: The network.

    Returns:
        The outline ``(n, 2)`` [m] of each junction by its name.
    """
    from shapely import LineString, MultiPolygon, union_all

    of_junction: dict[str, list[JunctionLink]] = {}
    for link in roads.links:
        of_junction.setdefault(link.junction, []).append(link)
    polygons = {}
    for name, links in of_junction.items():
        strips = [
            LineString(link.shape).simplify(0.1).buffer(link.width / 2, cap_style="flat", quad_segs=2) for link in links
        ]
        area = union_all(strips).buffer(1.0, quad_segs=1).buffer(-1.0, quad_segs=1)
        if isinstance(area, MultiPolygon):
            area = max(area.geoms, key=lambda g: g.area) if len(area.geoms) else area
        if not area.is_empty:
            outline = area.simplify(0.2).exterior
            polygons[name] = np.asarray(outline.coords)[:-1]
    return polygons
