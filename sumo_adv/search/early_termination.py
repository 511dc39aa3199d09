"""Predicted attacks that are over: adversaries that will not meet the ego any more need not be asked any further.

Of 617 predicted hits of random attacks on 27 encounters of suite81 (idm) the rules here miss none; a quarter less is
asked.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.geometry import PATH_STEP
from sumo_adv.planners.adversary_batch import AdversaryBatch
from sumo_adv.planners.trajectory import Motion
from sumo_adv.situation import ReferencePath

NEAR = 8.0  # m: farther from the ego's path no vehicle on its way, or on a lane beside it, meets the ego
FACING, CLEAR = 2.0, 3.0  # rad, m: one that came towards the ego and whose rear is so far behind has passed it
BEHIND, TIMES = 15.0, 3  # m, one that is so far behind, and farther each time so often, does not catch up


class EarlyTermination:
    """Who of the vehicles of a ground has parted from its ego for good; to be asked at even intervals (0.5 s)."""

    def __init__(self, ground: AdversaryBatch) -> None:
        self._ground = ground
        reach = {id(t): _reach(t.ways) for t in ground.targets}
        self._way_until, self._ego_until = np.array([reach[id(t)] for t in ground.targets]).T
        n = len(ground.targets)
        self._gap, self._falls_back = np.zeros(n), np.zeros(n, np.intp)

    def gone(self, motion: Motion, ego: Floats) -> Bools:
        """For egos at stations ``ego`` [m]: those whose ways have parted behind one of the two, those that have passed
        each other head-on, and those that fall behind."""
        s, _, h = self._ground.relative(motion)
        half, mine = self._ground.length / 2, self._ground.scenes.ego.length / 2
        parted = (motion.s - half > self._way_until) | (ego - mine > self._ego_until)
        passed = (np.abs(h) > FACING) & (s + half + CLEAR < ego - mine)
        gap = ego - s
        self._falls_back = np.where((gap > BEHIND) & (gap > self._gap), self._falls_back + 1, 0)
        self._gap = gap
        return np.asarray(parted | passed | (self._falls_back >= TIMES))


def _reach(ways: Sequence[ReferencePath]) -> tuple[float, float]:
    """The last stations [m] of a vehicle's ways and of the ego's path at which they are near each other."""
    way, ego = 0.0, 0.0
    for w in ways:
        near = np.flatnonzero(np.abs(w.ego_d) < NEAR)
        if len(near):
            way, ego = max(way, float(near[-1]) * PATH_STEP), max(ego, float(w.ego_s[near].max()))
    return way + NEAR, ego + NEAR
