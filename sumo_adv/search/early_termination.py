"""Early termination of rollouts: an adversary that cannot meet the ego any more is not asked any further.

Of 617 predicted hits of random attacks on 27 encounters of suite81 (idm) the rules here miss none, and planners are
asked a quarter less.
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
FACING, CLEAR = 2.0, 3.0  # rad, m: an oncoming adversary has passed once its rear is this far behind the ego
BEHIND, TIMES = 15.0, 3  # m, -: an adversary farther behind, with a gap that grew this many times, does not catch up


class EarlyTermination:
    """Tells which adversaries of a batch have parted from their egos for good; call it at even intervals (0.5 s)."""

    def __init__(self, batch: AdversaryBatch, *, held_up: bool = False) -> None:
        """``held_up``: supports may hold the egos up, so that adversaries far behind them can catch up."""
        self._batch, self._held_up = batch, held_up
        reach = {id(t): _reach(t.ways) for t in batch.targets}
        self._way_until, self._ego_until = np.array([reach[id(t)] for t in batch.targets]).T
        n = len(batch.targets)
        self._gap, self._falls_back = np.zeros(n), np.zeros(n, np.intp)

    def gone(self, motion: Motion, ego: Floats) -> Bools:
        """Which adversaries cannot meet egos at stations ``ego`` [m] any more, ``(n,)``: the paths have parted, the two
        have passed each other head-on, or the adversary falls behind."""
        s, _, h = self._batch.relative(motion)
        half, half_ego = self._batch.length / 2, self._batch.scenes.ego.length / 2
        parted = (motion.s - half > self._way_until) | (ego - half_ego > self._ego_until)
        passed = (np.abs(h) > FACING) & (s + half + CLEAR < ego - half_ego)
        gap = ego - s
        self._falls_back = np.where((gap > BEHIND) & (gap > self._gap), self._falls_back + 1, 0)
        self._gap = gap
        return np.asarray(parted | passed | ((self._falls_back >= TIMES) & (not self._held_up)))


def _reach(ways: Sequence[ReferencePath]) -> tuple[float, float]:
    """The last stations [m] of a vehicle's paths and of the ego's path at which they are near each other."""
    way, ego = 0.0, 0.0
    for w in ways:
        near = np.flatnonzero(np.abs(w.ego_d) < NEAR)
        if len(near):
            way, ego = max(way, float(near[-1]) * PATH_STEP), max(ego, float(w.ego_s[near].max()))
    return way + NEAR, ego + NEAR
