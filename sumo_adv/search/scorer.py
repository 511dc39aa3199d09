"""What the search needs of whatever predicts its candidates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from sumo_adv.datatypes import ObservedMotion, Proposal


class Scorer(Protocol):
    """Predicts proposals; lower scores are better."""

    def score(self, proposals: Sequence[Proposal], seen: Sequence[ObservedMotion] | None = None) -> list[Proposal]:
        """The same proposals with ``score`` and ``predicted``; ``seen``: against egos that drive so."""
        ...

    def heard(self, tried: Proposal, course: ObservedMotion) -> bool:
        """How the ego went in an attempt; whether it is predicted otherwise from now on."""
        ...
