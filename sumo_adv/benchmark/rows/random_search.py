"""Random search over a bicycle's controls: no library, no prediction, no memory.

Idea: each attempt is a standard normal vector of steering and accelerations (``controls.py``) for the next of all
vehicles, ways and delays, in turn, most dangerous first. Every simulation is one attempt of the budget.
Limits: it learns nothing from its attempts and knows nothing of the ego; what it gains, chance gains. Normal draws
around driving on keep it on the road more often than uniform ones over all controls would, which favours it.
Citation: Bergstra and Bengio 2012, "Random search for hyper-parameter optimization", JMLR 13; as the baseline of
search-based scenario generation, e.g. Ding et al. 2023, "A survey on safety-critical driving scenario generation", IEEE
T-ITS 24(7).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sumo_adv.benchmark.nouns import Encounter, course_proposal
from sumo_adv.benchmark.rows.controls import SIZE, Start, drive, starts
from sumo_adv.datatypes import Attempt, Proposal


class RandomSearch:
    """Normal controls for one vehicle after the other."""

    name = "random_search"

    def __init__(self) -> None:
        self._encounter: Encounter | None = None
        self._starts: list[Start] = []
        self._draw = np.random.default_rng(0)

    def begin(self, encounter: Encounter) -> None:
        """The vehicles, and the seed's draws."""
        self._encounter, self._starts = encounter, starts(encounter)
        self._draw = np.random.default_rng(encounter.seed)

    def propose(self, tried: Sequence[Attempt]) -> Proposal | None:
        """The next draw; None only where there is no vehicle."""
        if self._encounter is None or not self._starts:
            return None
        start = self._starts[len(tried) % len(self._starts)]
        course = drive(start, self._draw.standard_normal(SIZE), self._encounter)
        return course_proposal(self.name, start.target.state.id, start.delay, course)
