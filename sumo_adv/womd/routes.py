"""Routes for logged vehicles: the edges they drove, and on from there to where a route can end."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby, pairwise

from sumo_adv.womd.matching import Stretch
from sumo_adv.womd.sumonet import Link, SumoNet

RUN_ON = 300.0  # m that a route leads on beyond the log, if no edge ends before
_STRAIGHTEST = "slrLRt"  # SUMO's letters of direction, the preferred first


class Router:
    """Makes routes on one network."""

    def __init__(self, net: SumoNet) -> None:
        self._net = net
        self._from: dict[str, list[Link]] = {}  # edge -> links of cars that leave it
        self._through: dict[str, Link] = {}  # internal lane -> the link it is a part of
        for link in net.links:
            if net.lanes[link.start].cars and net.lanes[link.end].cars:
                self._from.setdefault(net.lanes[link.start].edge, []).append(link)
                for lane in net.inner(link):
                    self._through[lane] = link

    def route(self, stretches: Sequence[Stretch], step: int) -> tuple[str, ...]:
        """Edges of the stretch that a vehicle is on at a step or next, led on; empty where it is on none.

        Begins with the edge of the stretch's first lane (if that is inside a junction, with the edge before it) and
        ends with an edge that nothing follows, or ``RUN_ON`` m further on.
        """
        chosen = next((s for s in stretches if s.steps[-1] >= step), stretches[-1] if stretches else None)
        if chosen is None:
            return ()
        *before, last = self._parts(self.edges(chosen))
        current = next(
            lane for at, lane in zip(chosen.steps, chosen.lanes, strict=True) if at >= min(step, chosen.steps[-1])
        )
        for part in before:
            if self._edge(current) in part:
                return tuple(part + self._on(part, ""))
        return tuple(last + self._on(last, chosen.driven[-1]))

    def unbroken(self, stretches: Sequence[Stretch]) -> bool:
        """Whether a track is one stretch (or none) with edges that follow one another."""
        return len(stretches) <= 1 and all(len(self._parts(self.edges(s))) == 1 for s in stretches)

    def _parts(self, edges: list[str]) -> list[list[str]]:
        """The edges, parted where none leads to the next."""
        parts = [edges[:1]]
        for before, after in pairwise(edges):
            if any(self._net.lanes[link.end].edge == after for link in self._from.get(before, ())):
                parts[-1].append(after)
            else:
                parts.append([after])
        return parts

    def _edge(self, lane: str) -> str:
        """A lane's edge, or for an internal one the edge before it."""
        link = self._through.get(lane)
        return self._net.lanes[link.start if link is not None else lane].edge

    def edges(self, stretch: Stretch) -> list[str]:
        """Normal edges of a stretch, with those at its ends that internal lanes lead from and to."""
        edges: list[str] = []
        pending: Link | None = None
        for lane in stretch.driven:
            link = self._through.get(lane)
            if link is not None and not edges:
                edges.append(self._net.lanes[link.start].edge)
            if not self._net.lanes[lane].internal:
                edges.append(self._net.lanes[lane].edge)
            pending = link
        if pending is not None:
            edges.append(self._net.lanes[pending.end].edge)
        return [edge for edge, _ in groupby(edges)]

    def _on(self, edges: Sequence[str], lane: str) -> list[str]:
        """The edges after the last one: where the lane leads, straight on if there is a choice."""
        added: list[str] = []
        length = 0.0
        last = edges[-1] if edges else ""
        while length < RUN_ON:
            options = [k for k in self._from.get(last, ()) if self._net.lanes[k.end].edge not in {*edges, *added}]
            if not options:
                break
            best = min(options, key=lambda k: (k.start != lane, _STRAIGHTEST.find(k.direction), k.end))
            lane, last = best.end, self._net.lanes[best.end].edge
            length += self._net.lanes[lane].length
            added.append(last)
        return added
