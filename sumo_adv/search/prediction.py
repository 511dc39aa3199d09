"""Candidates scored by prediction: numpy rollouts of the planners' own answers.

Many candidates are predicted in two parts, of which another process may take the second one (``Elsewhere``). Without
one the parts are the same, and so are the results.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sumo_adv.config import Settings
from sumo_adv.datatypes import DriverModel, Duty, Level, ObservedMotion, Proposal
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.trusted import is_trusted
from sumo_adv.road_users import road_user
from sumo_adv.search.batch_prediction import BatchPredictor, Elsewhere, PredictionOrder
from sumo_adv.search.driver_identification import DriverIdentification, apart, in_traffic
from sumo_adv.search.escapes import predicted_escapes
from sumo_adv.search.rollouts import Rollouts
from sumo_adv.search.settings import ScoreSettings
from sumo_adv.simulation.network import Drivable
from sumo_adv.situation import Situation

TOGETHER = 12  # planners with a sandbox session open at the same time
LEAST_PARTED = 20  # candidates: fewer are predicted in one part


class Predictor:
    """Predicts and scores candidates; ``seconds`` and ``count`` say what that has cost so far."""

    def __init__(
        self, sandbox: Sandbox, settings: Settings, drivable: Drivable, situations: Mapping[float, Situation],
        weights: ScoreSettings | None = None, driver_weights: Mapping[str, float] | None = None,
        stopped: Mapping[str, int] | None = None, elsewhere: Elsewhere | None = None,
    ) -> None:  # fmt: skip
        """``driver_weights``: what earlier encounters showed of an unknown driver; ``stopped``: how many calls of each
        planner ran into a limit in them, by hash; ``elsewhere``: predicts the second part of many candidates."""
        self._weights, self._elsewhere, self._situations = weights or ScoreSettings(), elsewhere, situations
        self._batches = BatchPredictor(sandbox, settings, drivable, situations, self._weights, stopped)
        first = next(iter(situations.values()))
        self._driver = DriverIdentification(first.baseline.model, driver_weights or {})
        self._drive_all_by(self._driver.model)
        if self._driver.open and self._driver.observe([in_traffic(first, m) for m in self._driver.models]):
            self._drive_all_by(self._driver.model)
        self.seconds, self.count = 0.0, 0

    @property
    def failures(self) -> dict[str, str]:
        """Planners that failed: hash -> sentence."""
        return self._batches.failures

    @property
    def stopped(self) -> Mapping[str, int]:
        """How many calls of each planner ran into a limit, by hash."""
        return self._batches.stopped

    @property
    def driver_weights(self) -> dict[str, float]:
        """How likely each driver is that the ego may be."""
        return dict(zip(self._driver.names, self._driver.weights.tolist(), strict=True))

    def score(self, proposals: Sequence[Proposal], motions: Sequence[ObservedMotion] | None = None) -> list[Proposal]:
        """The same candidates with ``score`` and ``prediction``; ``motions``: the egos drive so, row by row."""
        began = time.perf_counter()
        scored: dict[int, Proposal] = {}
        users = [road_user(self._situations[p.delay].targets[p.bv].state) for p in proposals]
        kinds = list(zip(users, (len(p.supports) for p in proposals), strict=True))
        for kind, hashes in ((kind, hashes) for kind in dict.fromkeys(kinds) for hashes in batches_of(proposals)):
            rows = [k for k, p in enumerate(proposals) if p.planner.hash in hashes and kinds[k] == kind]
            if not rows:
                continue
            egos = None if motions is None else [motions[k] for k in rows]
            for k, p in zip(rows, self._parted([proposals[k] for k in rows], egos), strict=True):
                scored[k] = p
        self.seconds += time.perf_counter() - began
        self.count += len(proposals)
        return [scored[k] for k in range(len(proposals))]

    def expected(self, proposals: Sequence[Proposal]) -> list[Proposal]:
        """Predicted candidates with the scores that are expected over the likely drivers, and ``likely``: how likely a
        valid collision is. A known driver is the case of one.

        A score that was corrected by the ego's own motion stays.
        """
        scored, likely = list(proposals), self._driver.likely
        if len(likely) == 1 or not scored:
            return scored
        worst = self._weights.expected_worst
        sums = np.array([[min(p.score, worst), _is_valid(p)] for p in scored]) * likely[0][1]
        before = self._model
        for model, weight in likely[1:]:
            self._drive_all_by(model)
            sums += weight * np.array([[min(p.score, worst), _is_valid(p)] for p in self.score(scored)])
        self._drive_all_by(before)
        results = []
        for p, (score, valid) in zip(scored, sums.tolist(), strict=True):
            assert p.prediction is not None
            own = p.score if p.uncorrected is not None or p.prediction.hopeless else score
            told = replace(p.prediction, likely=valid)
            results.append(replace(p, score=own, nominal=p.nominal_score, prediction=told))
        return results

    def escapes(self, proposals: Sequence[Proposal]) -> list[tuple[Duty, ...]]:
        """What supports have to do against the predicted escape of the ego from each candidate."""
        began = time.perf_counter()
        duties: dict[int, tuple[Duty, ...]] = {}
        for size in dict.fromkeys(len(p.supports) for p in proposals):
            rows = [k for k, p in enumerate(proposals) if len(p.supports) == size]
            same = [proposals[k] for k in rows]
            rolled = self.rolled(self._situations, same)
            duties |= zip(rows, predicted_escapes(self._situations, same, rolled), strict=True)
        self.seconds += time.perf_counter() - began
        return [duties[k] for k in range(len(proposals))]

    def observe(self, tried: Proposal, motion: ObservedMotion) -> bool:
        """Hold the driver models against the ego's motion in an attempt; whether another one is believed from now on,
        so that predictions must be repeated."""
        if not self._driver.open or tried.course is not None:
            return False
        began, situation = time.perf_counter(), self._situations[tried.delay]
        real = situation.baseline.path.at(motion.s, motion.d)
        distances = []
        for model in self._driver.models:
            ego = self.rolled({tried.delay: situation.driven_by(model)}, [tried]).ego
            distances.append(apart((real[0], real[1]), (ego[0][0], ego[1][0]), motion, situation.dt))
        changed = self._driver.observe(distances)
        if changed:
            self._drive_all_by(self._driver.model)
        self.seconds += time.perf_counter() - began
        return changed

    def _drive_all_by(self, model: DriverModel) -> None:
        self._model = model
        self._situations = {delay: situation.driven_by(model) for delay, situation in self._situations.items()}

    def rolled(self, situations: Mapping[float, Situation], proposals: Sequence[Proposal]) -> Rollouts:
        """The predicted motions, row by row, also after a contact; ``situations``: by delay [s]."""
        return self._batches.rolled(situations, proposals, None, to_the_end=True)[0]

    def _parted(self, proposals: list[Proposal], motions: list[ObservedMotion] | None) -> list[Proposal]:
        """In two parts, if there are many; another process predicts the second one, if one is free."""
        away = self._second_part(proposals)
        if not away:
            return self._batches.score(self._situations, proposals, motions)
        here = sorted(set(range(len(proposals))) - set(away))

        def part(rows: Sequence[int]) -> tuple[list[Proposal], list[ObservedMotion] | None]:
            return [proposals[k] for k in rows], None if motions is None else [motions[k] for k in rows]

        order = PredictionOrder(*part(away), self._model, self._weights)
        wait = None if self._elsewhere is None else self._elsewhere(order)
        try:
            first = self._batches.score(self._situations, *part(here))
        finally:  # the other process must be free again, whatever happens here
            second = None if wait is None else wait()
        if second is None:
            second = self._batches.score(self._situations, *part(away))
        scored = dict(zip([*here, *away], [*first, *second], strict=True))
        return [scored[k] for k in range(len(proposals))]

    def _second_part(self, proposals: Sequence[Proposal]) -> list[int]:
        """The last half of many candidates, without planners that need the sandbox."""
        n = len(proposals)
        rows = range(n - n // 2, n) if n >= LEAST_PARTED else ()
        return [
            k for k in rows if all(_is_ours(p) and p.planner.hash not in self.failures for p in proposals[k].members)
        ]


def _is_ours(member: Proposal) -> bool:
    return member.course is not None or is_trusted(member.planner)


def _is_valid(p: Proposal) -> float:
    return float(p.prediction is not None and p.prediction.level >= Level.VALID)


def batches_of(proposals: Sequence[Proposal]) -> list[set[str]]:
    """Hashes of planners that are predicted together: at most ``TOGETHER`` that need the sandbox, a session each."""
    planners = {p.planner.hash: p.planner for p in proposals}
    ours = [name for name, planner in planners.items() if is_trusted(planner)]
    others = [name for name in planners if name not in ours]
    results = [set(others[k : k + TOGETHER]) for k in range(0, len(others), TOGETHER)]
    return [results[0].union(ours), *results[1:]] if results else [set(ours)] if ours else []
