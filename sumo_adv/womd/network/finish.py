"""From what netconvert wrote to the network.

It gets exact shapes and lengths, right of way, signals, junction polygons, and the drivable area."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.errors import UsageError
from sumo_adv.simulation.drivable import KEY, area_text
from sumo_adv.womd.network.plain import coordinates
from sumo_adv.womd.network.right_of_way import RightOfWay
from sumo_adv.womd.network.roads import Link, Roads
from sumo_adv.womd.network.signals import Program

MIN_LENGTH = 0.1  # m, SUMO's shortest lane


def finish(
    source: Path, target: Path, roads: Roads, order: RightOfWay, programs: Mapping[str, Program], ground: Any
) -> list[str]:
    """Write ``target`` from ``source``; returns the internal lane of each link. Raises UsageError if netconvert left
    something out.

    ground: the drivable area that the network is to carry (shapely polygons, m), or None."""
    tree = ET.parse(source)
    net = tree.getroot()
    lanes = {lane.get("id", ""): lane for edge in net.iter("edge") for lane in edge}
    for edge in roads.edges.values():
        for index, lane in enumerate(edge.lanes):
            element = lanes.get(f"{edge.name}_{index}")
            if element is None:
                raise UsageError(f"netconvert left out lane {edge.name}_{index}: the network is not complete.")
            _shape(element, lane.shape, lane.width, lane.speed)
    via = _connections(net, lanes, roads, order, programs)
    _junctions(net, roads, order, programs, via)
    if ground is not None:
        ET.SubElement(net.findall("junction")[0], "param", key=KEY, value=area_text(ground))
    net.find("location").set("convBoundary", _boundary(roads))  # type: ignore[union-attr]
    ET.indent(tree, "    ")
    tree.write(target, encoding="UTF-8", xml_declaration=True)
    return via


def _shape(lane: ET.Element, shape: Floats, width: float, speed: float) -> None:
    length = float(np.sum(np.hypot(*np.diff(shape, axis=0).T)))
    lane.set("shape", coordinates(shape))
    lane.set("length", f"{max(length, MIN_LENGTH):.3f}")
    lane.set("width", f"{width:.2f}")
    lane.set("speed", f"{speed:.2f}")


def _connections(
    net: ET.Element, lanes: dict[str, ET.Element], roads: Roads, order: RightOfWay, programs: Mapping[str, Program]
) -> list[str]:
    """Set every connection's letters and its internal lane's shape; the internal lane of each link."""
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
        _shape(lanes[via[n]], link.shape, link.width, link.speed)
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
    net: ET.Element, roads: Roads, order: RightOfWay, programs: Mapping[str, Program], via: list[str]
) -> None:
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
    return "".join("1" if n in chosen else "0" for n in reversed(inside))


def junction_polygons(roads: Roads) -> dict[str, Floats]:
    """The ground that the links of each junction cover: outline ``(n, 2)`` [m]."""
    from shapely import LineString, MultiPolygon, union_all

    of_junction: dict[str, list[Link]] = {}
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


def _boundary(roads: Roads) -> str:
    points = np.vstack([lane.shape for edge in roads.edges.values() for lane in edge.lanes])
    low, high = points.min(axis=0), points.max(axis=0)
    return f"{low[0]:.3f},{low[1]:.3f},{high[0]:.3f},{high[1]:.3f}"
