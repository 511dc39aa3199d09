"""What predicts candidates for a search, and what a search is for the refinement loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from sumo_adv.datatypes import Duty, ObservedMotion, Proposal, Verdict


class Scorer(Protocol):
    """Predicts candidates; lower scores are better."""

    def score(self, proposals: Sequence[Proposal]) -> list[Proposal]:
        """The same candidates with ``score`` and ``prediction``."""
        ...

    def escapes(self, proposals: Sequence[Proposal]) -> list[tuple[Duty, ...]]:
        """What supports have to do against the predicted escape of the ego from each candidate."""
        ...


class Optimizer(Protocol):
    """Chooses the candidates that are tried."""

    def propose(self, budget: int) -> list[Proposal]:
        """The next candidates, at most ``budget``; none when nothing is left."""
        ...

    def observe(self, tried: Proposal, motion: ObservedMotion | None, verdict: Verdict) -> None:
        """Take note of an attempt: its verdict, and how the ego moved in it (None: not at all)."""
        ...
