"""SUMO's edges along the egos' ways: who is on which, and what SUMO's drivers make of one that comes onto a new one.

Measured on 370 random attacks of neighbours, leaders and followers at junctions (krauss; SUMO 1.28): whoever comes onto
an edge of the ego's (``moveToXY``) with a side over the line between their lanes is in both lanes until its rear has
come onto that edge as well, and is made room for beside the ego; that it was in the ego's lane on another edge is
forgotten; and room is made on one and the same edge only.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sumo_adv.datatypes import Bools, Floats, Ints
from sumo_adv.planning.scenes import Scenes
from sumo_adv.situation import Situation, WayLine

ONTO = 0.3  # m: by so much less than its length a vehicle has to come onto an edge (measured)
NOWHERE = -1  # on no edge of the ego's way


def begins_of(situations: Sequence[Situation]) -> Floats:
    """Stations of the egos' paths [m] at which their edges begin, ``(n, m)``, inf behind the last."""
    most = max(len(s.edges) for s in situations)
    rows = [[begin for begin, _ in s.edges] + [np.inf] * (most - len(s.edges)) for s in situations]
    return np.array(rows, float).reshape(len(situations), most)


def shared(situation: Situation, way: WayLine, most: int) -> list[bool]:
    """Which of the ego's edges a way goes over as well, in as many places as asked for."""
    return [name in way.edges for _, name in situation.edges] + [False] * (most - len(situation.edges))


def edge_at(begins: Floats, station: Floats) -> Ints:
    """The place of the edge that is at each station, 0 before the first."""
    return np.asarray(np.maximum((begins <= station[:, None]).sum(axis=1) - 1, 0))


class Edges:
    """What ``n`` egos' drivers make of adversaries of a length and width [m] that come from edge to edge.

    ``comes``: they are in both lanes; ``came``: they came onto their edge so.
    """

    def __init__(self, scenes: Scenes, length: Floats, width: Floats) -> None:
        self._begins, self._length, self._width = begins_of(scenes.of), length, width
        self._dt, self._mine = scenes.dt, scenes.ego.length / 2
        self._lane = scenes.each(lambda s: s.lane_width)
        self._edge: Ints | None = None
        self._left = np.zeros(len(length))  # metres that they have still to come onto their edge
        self.comes, self.came = np.zeros((2, len(length)), bool)

    def step(self, edge: Ints, front_d: Floats, speed: Floats) -> Bools:
        """Adversaries with their fronts on an edge, at an offset [m], at a speed [m/s]; who is on another one now."""
        changed = np.asarray(edge != (edge if self._edge is None else self._edge))
        over = np.abs(front_d) - self._width / 2 < self._lane / 2
        new = changed & (edge != NOWHERE) & over
        left = np.where(changed, np.where(new, self._length - ONTO, 0.0), self._left)
        self._left = np.maximum(left - speed * self._dt, 0.0)
        self.comes = self._left > 0.0
        self.came = np.where(changed, new, self.came)
        self._edge = edge
        return changed

    def same(self, edge: Ints, station: Floats) -> Bools:
        """Whether they are on the edge that the egos' fronts are on; egos at stations [m]."""
        if not self._begins.shape[1]:
            return np.ones(len(station), bool)
        return np.asarray(edge == edge_at(self._begins, station + self._mine))
