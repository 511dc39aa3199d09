"""Where the routes of a draft lead, and where two of them meet: plain geometry of a network's lanes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.errors import UsageError, nearest

TOGETHER = 2.0  # m: ways that come as near as this meet
STEP = 1.0  # m between the points of a way


@dataclass(frozen=True, slots=True)
class Drive:
    """A vehicle's way: its edges, SUMO's index of the lane on the first one, its points (n, 2) every ``STEP`` m from
    the beginning of the first edge, the length of that edge [m], and the station at which the first junction begins."""

    edges: tuple[str, ...]
    lane: int
    points: Floats
    first: float
    limit: float

    def at(self, station: float) -> tuple[float, float, float]:
        """x, y [m] and heading [rad] at a station [m]; straight on beyond the ends."""
        k = int(np.clip(station / STEP, 0, len(self.points) - 2))
        a, b = self.points[k], self.points[k + 1]
        along = (b - a) / max(float(np.hypot(*(b - a))), 1e-6)
        x, y = a + along * (station - k * STEP)
        return float(x), float(y), float(np.arctan2(along[1], along[0]))

    def nearest(self, x: float, y: float) -> float:
        """The station [m] of the point nearest to (x, y)."""
        return float(np.argmin(np.hypot(*(self.points - (x, y)).T))) * STEP


class Net:
    """A network that drafts are drawn on."""

    def __init__(self, path: Path) -> None:
        """Read it. Raises UsageError."""
        import sumolib

        try:
            self._net = sumolib.net.readNet(str(path))
        except Exception as error:  # sumolib raises whatever its parser does
            raise UsageError(f"The network {path} cannot be read ({error}).") from error

    def drive(self, route: Sequence[str], lane: int, vclass: str, who: str) -> Drive:
        """The quickest way from the first to the last edge. lane: counted from the right among those for ``vclass``.

        Raises UsageError with the edges that there are.
        """
        start, end = (self._edge(name, who) for name in (route[0], route[-1]))
        edges, _ = self._net.getShortestPath(start, end, vClass=vclass)
        if edges is None:
            raise UsageError(f"No way leads a {vclass} from edge '{route[0]}' to '{route[-1]}' (the route of {who}).")
        lanes = [each for each in start.getLanes() if each.allows(vclass)]
        if lane >= len(lanes):
            raise UsageError(
                f"Edge '{route[0]}' has {len(lanes)} lanes for {who}, so its lane is 0 to {len(lanes) - 1}, not {lane}."
            )
        chosen = lanes[lane]
        points = _even(_driven(edges, chosen, vclass))
        return Drive(
            tuple(str(e.getID()) for e in edges), int(chosen.getIndex()), points, float(start.getLength()),
            float(chosen.getSpeed()),
        )  # fmt: skip

    def green_for(self, edges: Sequence[str]) -> dict[str, str]:
        """By traffic light the state that is green for a way along these edges and for traffic from ahead, and red for
        all others. Left turns wait for traffic from ahead."""
        states = {}
        for light in self._net.getTrafficLights():
            links = light.getConnections()
            own = [a.getEdge().getID() for a, _, _ in links if a.getEdge().getID() in edges]
            open_ = self._facing(own[0]) if own else set()
            letters = ["r"] * (max(k for _, _, k in links) + 1)
            for start, end, k in links:
                if start.getEdge().getID() in open_:
                    turns = [c.getDirection() for c in start.getOutgoing() if c.getToLane() is end]
                    letters[k] = "g" if "l" in turns else "G"
            states[str(light.getID())] = "".join(letters)
        return states

    def _facing(self, edge: str) -> set[str]:
        """The edge, and the edge from the opposite side to the same junction."""
        own = self._net.getEdge(edge)
        turn = _direction(own)
        return {edge} | {
            str(e.getID()) for e in own.getToNode().getIncoming() if float(np.dot(_direction(e), turn)) < -0.7
        }

    def words(self) -> str:
        """The edges, a few words each."""
        parts = []
        for edge in sorted(self._net.getEdges(), key=lambda e: str(e.getID())):
            cars = sum(lane.allows("passenger") for lane in edge.getLanes())
            if cars:
                kmh = max(lane.getSpeed() for lane in edge.getLanes() if lane.allows("passenger")) * 3.6
                parts.append(f"{edge.getID()} ({cars}, {kmh:.0f} km/h, {edge.getLength():.0f} m)")
        return ", ".join(parts)

    def _edge(self, name: str, who: str) -> Any:
        if not self._net.hasEdge(name):
            names = sorted(str(e.getID()) for e in self._net.getEdges())
            listed = ", ".join(names[:30])
            raise UsageError(f"There is no edge '{name}' for {who}{nearest(name, names)}; there are {listed}.")
        return self._net.getEdge(name)


def meeting(one: Drive, other: Drive) -> tuple[float, float] | None:
    """Stations [m] on both ways where they first come together; None if they do not, or if they begin together."""
    apart = np.hypot(*(one.points[:, None, :] - other.points[None, :, :]).transpose(2, 0, 1))
    close = apart < TOGETHER
    if not close.any() or one.edges[0] == other.edges[0]:
        return None
    i = int(np.argmax(close.any(axis=1)))
    return i * STEP, float(np.argmin(apart[i])) * STEP


def _driven(edges: Sequence[Any], lane: Any, vclass: str) -> Floats:
    """The centre lines of the lanes along a route; a lane from which the next edge is not reached is changed."""
    shapes = [np.array(lane.getShape())[:, :2]]
    for edge, after in pairwise(edges):
        links = [c for c in edge.getConnections(after) if c.getToLane().allows(vclass)]
        link = next((c for c in links if c.getFromLane() is lane), links[0])
        lane = link.getToLane()
        shapes.append(np.array(lane.getShape())[:, :2])
    return np.concatenate(shapes)


def _direction(edge: Any) -> Floats:
    """The direction of an edge at its end."""
    a, b = np.array(edge.getShape())[[-2, -1], :2]
    return np.asarray((b - a) / max(float(np.hypot(*(b - a))), 1e-6))


def _even(points: Floats) -> Floats:
    steps = np.hypot(*np.diff(points, axis=0).T)
    keep = np.concatenate([[True], steps > 1e-3])
    points = points[keep]
    station = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    s = np.arange(0.0, station[-1], STEP)
    return np.stack([np.interp(s, station, points[:, 0]), np.interp(s, station, points[:, 1])], axis=1)
