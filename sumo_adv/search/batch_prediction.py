"""Candidates predicted and scored together, with given drivers of the ego; in this process or in another one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from sumo_adv.config import Settings
from sumo_adv.datatypes import DriverModel, Limits, ObservedMotion, Prediction, Proposal
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.sessions import Roads, Sessions
from sumo_adv.search.goal_score import goal_score
from sumo_adv.search.rollouts import Rollouts, lined_up, predict
from sumo_adv.search.scoring import judge_all, touch_of
from sumo_adv.search.settings import ScoreSettings
from sumo_adv.simulation.network import Drivable
from sumo_adv.situation import Situation


class BatchPredictor:
    """Predicts and scores candidates of one kind: collider's kind of road user, number of supports.

    failures: planners that failed, as hash -> sentence; they are asked no more. stopped: how many calls of each planner
    ran into a limit, by hash.
    """

    def __init__(
        self, sandbox: Sandbox, settings: Settings, drivable: Drivable, situations: Mapping[float, Situation],
        weights: ScoreSettings, stopped: Mapping[str, int] | None = None,
    ) -> None:  # fmt: skip
        self._sandbox, self._settings, self._drivable, self._weights = sandbox, settings, drivable, weights
        self._roads = Roads(situations)
        self.failures: dict[str, str] = {}
        self.stopped: Mapping[str, int] = dict(stopped or {})

    def score(
        self, situations: Mapping[float, Situation], proposals: list[Proposal], motions: Sequence[ObservedMotion] | None
    ) -> list[Proposal]:
        """The same candidates with ``score`` and ``prediction``; ``motions``: the egos drive so, row by row."""
        rollouts, failures = self.rolled(situations, proposals, motions)
        limits = self._limits(situations, proposals)
        judged = judge_all(situations, proposals, rollouts, self._drivable, limits, self._weights)
        goal, weights = self._settings.goal, self._weights
        judged = [(goal_score(goal, score, made, weights), made) for score, made in judged]
        for k, failure in failures.items():
            judged[k] = self._weights.failed, Prediction(failure)
        return [replace(p, score=score, prediction=made) for p, (score, made) in zip(proposals, judged, strict=True)]

    def rolled(
        self, situations: Mapping[float, Situation], proposals: Sequence[Proposal],
        motions: Sequence[ObservedMotion] | None, to_the_end: bool = False,
    ) -> tuple[Rollouts, dict[int, str]]:  # fmt: skip
        """The predicted motions, row by row, and by row why a planner failed; ``to_the_end``: also after a contact."""
        settings, failures, road = self._settings, self.failures, self._drivable
        members, n = lined_up(proposals), len(proposals)
        with Sessions(
            self._sandbox, self._roads, members, settings.seed, failures, drivable=road, in_process=True,
            stopped=self.stopped,
        ) as sessions:  # fmt: skip
            rollouts = predict(
                situations, proposals, lambda rows, observations: sessions.answers(members, rows, observations),
                limits=self._limits(situations, proposals), steps=settings.steps(settings.duration),
                replan=settings.steps(settings.replan), motions=motions,
                touch=touch_of(situations, proposals), to_the_end=to_the_end,
            )  # fmt: skip
            self.failures |= sessions.failures
            self.stopped = sessions.stopped
        failed = {k: self.failures[p.planner.hash] for k, p in enumerate(members) if p.planner.hash in self.failures}
        return rollouts, {k % n: why for k, why in {**sessions.broken, **failed}.items()}

    def _limits(self, situations: Mapping[float, Situation], proposals: Sequence[Proposal]) -> Limits:
        return self._settings.limits.of(situations[proposals[0].delay].targets[proposals[0].bv].state)


@dataclass(frozen=True, slots=True)
class PredictionOrder:
    """Candidates of trusted planners for another process to predict; ``motions``: as in ``BatchPredictor.score``.
    ``model``: of the ego's driver."""

    proposals: list[Proposal]
    motions: list[ObservedMotion] | None
    model: DriverModel
    weights: ScoreSettings


Elsewhere = Callable[[PredictionOrder], Callable[[], list[Proposal] | None]]
"""Has another process carry out ``fulfilled``; the function that is returned waits for the result."""


def fulfilled(
    order: PredictionOrder, situations: Mapping[float, Situation], drivable: Drivable, settings: Settings
) -> list[Proposal] | None:
    """The candidates of an order, predicted and scored; None if a planner needs the sandbox after all."""
    sandbox = Sandbox()
    sandbox.close()  # another process's part: whatever needs it fails
    batch = BatchPredictor(sandbox, settings, drivable, situations, order.weights)
    driven = {delay: situation.driven_by(order.model) for delay, situation in situations.items()}
    scored = batch.score(driven, order.proposals, order.motions)
    failed = batch.failures or any(p.prediction is not None and p.prediction.failure for p in scored)
    return None if failed else scored
