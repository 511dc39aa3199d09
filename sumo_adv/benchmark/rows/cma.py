"""CMA-ES over a bicycle's controls: an evolution strategy that learns from its attempts alone.

Idea: Hansen's covariance matrix adaptation, by its author's library ``cma`` (extra ``bench``), over the vector of
``controls.py``, of the vehicle with the highest risk, on the way that meets the ego's, from the earliest moment on. Its
first draws are those of random search: the two differ by the adaptation and by the choice of the vehicle. A generation
is ``POPULATION`` attempts; the objective comes from their verdicts. Where a search has come to rest the next one begins
with the next vehicle or way.
Limits: a budget of 25 is four generations in twelve dimensions, of a vehicle fixed beforehand; local steps were the
worst of the refinements measured.
Citation: Hansen and Ostermeier 2001, "Completely derandomized self-adaptation in evolution strategies", Evolutionary
Computation 9(2); Hansen, Akimoto and Baudis 2019, "CMA-ES/pycma on Github", Zenodo, doi:10.5281/zenodo.2559634.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sumo_adv.benchmark.nouns import Encounter, course_proposal
from sumo_adv.benchmark.rows.controls import SIZE, Start, drive, objective, starts
from sumo_adv.datatypes import Attempt, Floats, Proposal
from sumo_adv.errors import UsageError

POPULATION = 6


class Cma:
    """One search after the other, each for one vehicle and way. Raises UsageError without the library."""

    name = "cma"

    def __init__(self) -> None:
        self._make = _library()
        self._encounter: Encounter | None = None
        self._starts: list[Start] = []
        self._searches, self._search = 0, None
        self._generation: list[Floats] = []
        self._first = 0  # index of the generation's first attempt

    def begin(self, encounter: Encounter) -> None:
        """A new search."""
        self._encounter, self._starts = encounter, starts(encounter)
        self._searches, self._search, self._generation, self._first = 0, None, [], 0

    def propose(self, tried: Sequence[Attempt]) -> Proposal | None:
        """The next of the generation; once all of it were tried the search is told and makes a new one."""
        encounter = self._encounter
        if encounter is None or not self._starts:
            return None
        search: Any = self._search
        if len(tried) - self._first >= len(self._generation):
            search = self._told(search, tried[self._first :], encounter)
            self._generation, self._first = search.ask(), len(tried)
        start = self._starts[(self._searches - 1) % len(self._starts)]
        course = drive(start, self._generation[len(tried) - self._first], encounter)
        return course_proposal(self.name, start.target.state.id, start.delay, course)

    def _told(self, search: Any, tried: Sequence[Attempt], encounter: Encounter) -> Any:
        """The search with what a generation came to; a new one where there is none or it has come to rest."""
        if search is not None:
            search.tell(self._generation, [objective(a.verdict) for a in tried])
        if search is None or search.stop():
            options = {"seed": encounter.seed + self._searches + 1, "popsize": POPULATION, "verbose": -9}  # 0: by clock
            search = self._make(SIZE * [0.0], 1.0, options)
            self._searches += 1
            self._search = search
        return search


def _library() -> Any:
    try:
        from cma import CMAEvolutionStrategy
    except ImportError as error:
        raise UsageError(
            "The row 'cma' needs the library cma; install it with pip install 'sumo-adv[bench]'."
        ) from error
    return CMAEvolutionStrategy
