"""Routes for logged vehicles: the edges they drove, and on from there to where a route can end."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby

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
                for lane in self._inner(link):
                    self._through[lane] = link

    def route(self, stretches: Sequence[Stretch], step: int) -> tuple[str, ...]:
        """Edges of the stretch that a vehicle is on at a step or next, led on; empty where it is on none.

        Begins with the edge of the stretch's first lane (if that is inside a junction, with the edge before it) and
        ends with an edge that nothing follows, or ``RUN_ON`` m further on.
        """
        chosen = next((s for s in stretches if s.steps[-1] >= step), stretches[-1] if stretches else None)
        if chosen is None:
            return ()
        edges = [edge for edge, _ in groupby(self._edges(chosen.driven))]
        return tuple(edges + self._on(edges, chosen.driven[-1]))

    def _edges(self, lanes: Iterable[str]) -> list[str]:
        """Normal edges of a chain of lanes, with those at its ends that internal lanes lead from and to."""
        found: list[str] = []
        pending: Link | None = None
        for lane in lanes:
            link = self._through.get(lane)
            if link is not None and not found:
                found.append(self._net.lanes[link.start].edge)
            if not self._net.lanes[lane].internal:
                found.append(self._net.lanes[lane].edge)
            pending = link
        if pending is not None:
            found.append(self._net.lanes[pending.end].edge)
        return found

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

    def _inner(self, link: Link) -> list[str]:
        """The internal lanes of a link in order."""
        found: list[str] = []
        lane = link.via
        while lane and lane not in found and self._net.lanes[lane].internal:
            found.append(lane)
            lane = next(iter(self._net.following.get(lane, ())), "")
        return found
