"""A finished net.xml as this package measures it: lanes with shapes and permissions, and what follows what.

Unlike ``simulation.network`` it keeps internal lanes in their order, bicycle lanes and signal links, and is read in
tens of milliseconds.
"""

from __future__ import annotations

import gzip
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from sumo_adv.datatypes import Floats

DEFAULT_WIDTH = 3.2  # m, SUMO's for lanes without one


@dataclass(frozen=True, slots=True)
class NetLane:
    """One lane. shape ``(n, 2)`` m; width, length m; cars, bicycles: which vehicles may use it."""

    id: str
    edge: str
    index: int
    shape: Floats
    width: float
    length: float
    internal: bool
    cars: bool
    bicycles: bool


@dataclass(frozen=True, slots=True)
class Link:
    """One connection between lanes, the internal ones in between aside. direction: SUMO's letter; signal: its traffic
    light and index there."""

    start: str
    end: str
    via: str
    direction: str
    signal: tuple[str, int] | None


@dataclass(frozen=True, slots=True)
class SumoNet:
    """Lanes by id; edges to their lanes, rightmost first; following: lane to the lanes a vehicle is on next, internal
    ones included; links: connections between normal lanes."""

    lanes: Mapping[str, NetLane]
    edges: Mapping[str, tuple[str, ...]]
    following: Mapping[str, tuple[str, ...]]
    links: tuple[Link, ...]

    def inner(self, link: Link) -> tuple[str, ...]:
        """The internal lanes of a link, in order."""
        chain: list[str] = []
        lane = link.via
        while lane in self.lanes and lane not in chain and self.lanes[lane].internal:
            chain.append(lane)
            lane = next(iter(self.following.get(lane, ())), "")
        return tuple(chain)


def read_net(path: Path) -> SumoNet:
    """The network at ``path`` (written by ourselves: errors are not dressed up)."""
    with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
        root = ElementTree.parse(file).getroot()
    lanes: dict[str, NetLane] = {}
    edges: dict[str, tuple[str, ...]] = {}
    for edge in root.iter("edge"):
        function = edge.get("function", "normal")
        if function not in ("normal", "internal"):
            continue
        own = [_lane(lane.attrib, edge.attrib["id"], function == "internal") for lane in edge.iter("lane")]
        lanes |= {lane.id: lane for lane in own}
        edges[edge.attrib["id"]] = tuple(lane.id for lane in own)
    following: dict[str, dict[str, None]] = {}
    links = []
    for c in root.iter("connection"):
        start, end = f"{c.get('from')}_{c.get('fromLane')}", f"{c.get('to')}_{c.get('toLane')}"
        if start not in lanes or end not in lanes:
            continue
        via = c.get("via", "")
        following.setdefault(start, {})[via or end] = None
        if not lanes[start].internal:
            signal = (c.attrib["tl"], int(c.attrib["linkIndex"])) if "tl" in c.attrib else None
            links.append(Link(start, end, via, c.get("dir", "s"), signal))
    return SumoNet(lanes, edges, {lane: tuple(onward) for lane, onward in following.items()}, tuple(links))


def _lane(attributes: Mapping[str, str], edge: str, internal: bool) -> NetLane:
    shape = np.array([[float(v) for v in pair.split(",")[:2]] for pair in attributes["shape"].split()])
    return NetLane(
        id=attributes["id"], edge=edge, index=int(attributes["index"]), shape=shape,
        width=float(attributes.get("width", DEFAULT_WIDTH)), length=float(attributes["length"]), internal=internal,
        cars=_allows(attributes, "passenger"), bicycles=_allows(attributes, "bicycle"),
    )  # fmt: skip


def _allows(attributes: Mapping[str, str], kind: str) -> bool:
    allow, disallow = attributes.get("allow"), attributes.get("disallow", "").split()
    if allow is not None:
        return kind in allow.split() or "all" in allow.split()
    return kind not in disallow and "all" not in disallow
