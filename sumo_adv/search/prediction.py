"""Scores of candidates by prediction: numpy rollouts of the planners' own answers."""

from __future__ import annotations

import gc
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

from sumo_adv.config import Settings
from sumo_adv.datatypes import Limits, Prediction, Proposal
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.sessions import Roads, Sessions, is_trusted
from sumo_adv.search.rollouts import Rollouts, lined_up, predict
from sumo_adv.search.scoring import goal_score, judge_all, touch_of
from sumo_adv.search.settings import ScoreSettings
from sumo_adv.simulation.network import Drivable
from sumo_adv.situation import Situation

MAX_OPEN_SESSIONS = 12  # planners that have a sandbox session open at the same time, at most


class Predictor:
    """Predicts and scores candidates.

    Attributes:
        seconds: The time that predictions have taken so far [s].
        count: The number of candidates predicted so far.
        failures: Why a planner failed, by its hash.
        stopped: How many calls of each planner ran into a limit, by its hash.
    """

    def __init__(
        self, sandbox: Sandbox, settings: Settings, drivable: Drivable, situations: Mapping[float, Situation],
        weights: ScoreSettings | None = None, stopped: Mapping[str, int] | None = None,
    ) -> None:  # fmt: skip
        """Prepare predictions for one encounter.

        Args:
            sandbox: Runs planners that are not trusted.
            settings: The settings of the run.
            drivable: Where vehicles can drive.
            situations: The situations by delay after the trigger [s].
            weights: How a prediction becomes a score; the defaults if None.
            stopped: How many calls of each planner ran into a limit in earlier encounters, by hash.
        """
        self._sandbox, self._settings, self._weights = sandbox, settings, weights or ScoreSettings()
        self._drivable = drivable
        self._situations, self._roads = situations, Roads(situations)
        self.seconds, self.count = 0.0, 0
        self.failures: dict[str, str] = {}  # planner hash -> reason, in a sentence
        self.stopped: Mapping[str, int] = dict(stopped or {})

    def score(self, proposals: Sequence[Proposal]) -> list[Proposal]:
        """Predict and score candidates.

        Args:
            proposals: The candidates.

        Returns:
            The same candidates, in the same order, with ``score`` and ``prediction``.
        """
        began = time.perf_counter()
        scored: dict[int, Proposal] = {}
        limits = [self._limits([p]) for p in proposals]
        kinds = list(zip(limits, (len(p.supports) for p in proposals), strict=True))
        for kind, hashes in ((kind, hashes) for kind in dict.fromkeys(kinds) for hashes in batches_of(proposals)):
            rows = [k for k, p in enumerate(proposals) if p.planner.hash in hashes and kinds[k] == kind]
            if rows:
                scored.update(zip(rows, self._together([proposals[k] for k in rows]), strict=True))
        self.seconds += time.perf_counter() - began
        self.count += len(proposals)
        return [scored[k] for k in range(len(proposals))]

    def _limits(self, proposals: Sequence[Proposal]) -> Limits:
        """Return the limits of candidates that all have the same ones."""
        return self._settings.limits.of(self._situations[proposals[0].delay].targets[proposals[0].bv].state)

    def _together(self, proposals: list[Proposal]) -> list[Proposal]:
        """Score candidates with the same limits and number of supports in one batch."""
        with _no_garbage_collection():
            rollouts, failures = self._rolled(proposals)
            limits = self._limits(proposals)
            judged = judge_all(self._situations, proposals, rollouts, self._drivable, limits, self._weights)
        goal, weights = self._settings.goal, self._weights
        judged = [(goal_score(goal, score, made, weights), made) for score, made in judged]
        for k, failure in failures.items():
            judged[k] = self._weights.failed, Prediction(failure)
        return [replace(p, score=score, prediction=made) for p, (score, made) in zip(proposals, judged, strict=True)]

    def rolled(self, proposals: Sequence[Proposal]) -> Rollouts:
        """Predict the motions of candidates to the end, also after a contact.

        Args:
            proposals: The candidates, which all have the same number of supports.

        Returns:
            The motions; row k is candidate k.
        """
        return self._rolled(proposals, to_the_end=True)[0]

    def _rolled(self, proposals: Sequence[Proposal], to_the_end: bool = False) -> tuple[Rollouts, dict[int, str]]:
        """Predict motions, and say by row why a planner failed."""
        settings, failures, road = self._settings, self.failures, self._drivable
        members, n = lined_up(proposals), len(proposals)
        with Sessions(
            self._sandbox, self._roads, members, settings.seed, failures, drivable=road, in_process=True,
            stopped=self.stopped,
        ) as sessions:  # fmt: skip
            rollouts = predict(
                self._situations, proposals, partial(sessions.answers, members), limits=self._limits(proposals),
                steps=settings.steps(settings.duration), replan=settings.steps(settings.replan),
                touch=touch_of(self._situations, proposals), to_the_end=to_the_end,
            )  # fmt: skip
            self.failures |= sessions.failures
            self.stopped = sessions.stopped
        failed = {k: self.failures[p.planner.hash] for k, p in enumerate(members) if p.planner.hash in self.failures}
        return rollouts, {k % n: why for k, why in {**sessions.broken, **failed}.items()}


@contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Suspend Python's search for reference cycles.

    A prediction makes many small objects and no cycles, and the search for cycles would take 5 to 9 % of its time.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def batches_of(proposals: Sequence[Proposal]) -> list[set[str]]:
    """Group planners that are predicted together.

    Args:
        proposals: The candidates.

    Returns:
        Sets of planner hashes, each with at most ``MAX_OPEN_SESSIONS`` planners that need the sandbox. Trusted planners
        are in the first set.
    """
    planners = {p.planner.hash: p.planner for p in proposals}
    ours = [name for name, planner in planners.items() if is_trusted(planner)]
    others = [name for name in planners if name not in ours]
    results = [set(others[k : k + MAX_OPEN_SESSIONS]) for k in range(0, len(others), MAX_OPEN_SESSIONS)]
    return [results[0].union(ours), *results[1:]] if results else [set(ours)] if ours else []
