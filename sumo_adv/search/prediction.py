"""Proposals scored by prediction: numpy rollouts of the planners' own answers."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from sumo_adv.config import Settings
from sumo_adv.datatypes import ObservedMotion, Proposal
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.sessions import Roads, Sessions
from sumo_adv.planners.trusted import is_own
from sumo_adv.search.driver_identification import DriverIdentification, apart
from sumo_adv.search.rollouts import Rollouts, part, predict
from sumo_adv.search.scoring import judge_all, touch_of
from sumo_adv.simulation.network import Drivable
from sumo_adv.situation import Situation

FAILED = 9.0  # score where the planner failed
TOGETHER = 12  # planners with a sandbox session open at once


class Predictor:
    """Predicts and scores proposals; ``seconds`` and ``count`` say what that has cost so far."""

    def __init__(self, sandbox: Sandbox, settings: Settings, drivable: Drivable, situations: Mapping[float, Situation]):
        self._sandbox = sandbox
        self._settings = settings
        self._drivable = drivable
        self._situations, self._roads = situations, Roads(situations)
        self._belief = DriverIdentification(next(iter(situations.values())).ego_model)
        self.seconds, self.count = 0.0, 0
        self.failures: dict[str, str] = {}  # planner hash -> sentence

    def score(self, proposals: Sequence[Proposal], seen: Sequence[ObservedMotion] | None = None) -> list[Proposal]:
        """The same proposals with ``score`` and ``predicted`` filled in; ``seen``: against egos that drive so."""
        began = time.perf_counter()
        scored: dict[int, Proposal] = {}
        for hashes in _batches(proposals):
            rows = [k for k, p in enumerate(proposals) if p.planner.hash in hashes]
            egos = None if seen is None else [seen[k] for k in rows]
            for k, p in zip(rows, self._together([proposals[k] for k in rows], egos), strict=True):
                scored[k] = p
        self.seconds += time.perf_counter() - began
        self.count += len(proposals)
        return [scored[k] for k in range(len(proposals))]

    def heard(self, tried: Proposal, course: ObservedMotion) -> bool:
        """How the ego went in an attempt; whether its driver is thought to be another one from now on, so that what was
        predicted is to be predicted again."""
        if not self._belief.open or tried.course is not None:
            return False
        began, situation = time.perf_counter(), self._situations[tried.delay]
        seen = situation.ego_path.at(course.s, course.d)
        errors = []
        for model in self._belief.models:
            ego = self.rolled({tried.delay: replace(situation, ego_model=model)}, [tried]).ego
            errors.append(apart((seen[0], seen[1]), (ego[0][0], ego[1][0]), course))
        changed = self._belief.hear(errors)
        if changed:
            model = self._belief.model
            self._situations = {k: replace(s, ego_model=model) for k, s in self._situations.items()}
        self.seconds += time.perf_counter() - began
        return changed

    def _together(self, proposals: list[Proposal], seen: Sequence[ObservedMotion] | None) -> list[Proposal]:
        rollouts, broken = self._rolled(self._situations, proposals, seen)
        results = self._judged(proposals, rollouts)
        return [
            replace(p, score=FAILED, predicted={"failed": broken[k]})
            if k in broken
            else replace(p, score=r["score"], predicted=r)
            for k, (p, r) in enumerate(zip(proposals, results, strict=True))
        ]

    def rolled(self, situations: Mapping[float, Situation], proposals: Sequence[Proposal]) -> Rollouts:
        """Where everybody is expected, row by row, also after they touched; ``situations``: by delay [s]."""
        return self._rolled(situations, proposals, None, to_the_end=True)[0]

    def _rolled(
        self, situations: Mapping[float, Situation], proposals: Sequence[Proposal],
        seen: Sequence[ObservedMotion] | None, to_the_end: bool = False,
    ) -> tuple[Rollouts, dict[int, str]]:  # fmt: skip
        """As ``rolled``, with egos that drive as ``seen``; and by their places those whose planner failed, and why."""
        settings, known, road = self._settings, self.failures, self._drivable
        with Sessions(
            self._sandbox, self._roads, proposals, settings.seed, known, drivable=road, predicting=True
        ) as sessions:
            rollouts = predict(
                situations, proposals, lambda rows, told: sessions.ask(proposals, rows, told),
                limits=settings.limits.limits(), steps=settings.steps(settings.duration),
                replan=settings.steps(settings.replan), seen=seen,
                touch=touch_of(situations, proposals), to_the_end=to_the_end,
            )  # fmt: skip
            self.failures |= sessions.failures
        failed = {k: self.failures[p.planner.hash] for k, p in enumerate(proposals) if p.planner.hash in self.failures}
        return rollouts, {**sessions.broken, **failed}

    def _judged(self, proposals: Sequence[Proposal], rollouts: Rollouts) -> list[dict[str, Any]]:
        """What each rollout comes to; those of one moment are judged at once."""
        found: dict[int, dict[str, Any]] = {}
        limits = self._settings.limits.limits()
        for delay in dict.fromkeys(p.delay for p in proposals):
            rows = [k for k, p in enumerate(proposals) if p.delay == delay]
            mine = [proposals[k] for k in rows]
            judged = judge_all(self._situations[delay], mine, part(rollouts, rows), self._drivable, limits)
            found |= dict(zip(rows, judged, strict=True))
        return [found[k] for k in range(len(proposals))]


def _batches(proposals: Sequence[Proposal]) -> list[set[str]]:
    """What is predicted together: at most ``TOGETHER`` planners that need the sandbox, each in a session of its own."""
    planners = {p.planner.hash: p.planner for p in proposals}
    ours = [name for name, planner in planners.items() if is_own(planner)]
    others = [name for name in planners if name not in ours]
    found = [set(others[k : k + TOGETHER]) for k in range(0, len(others), TOGETHER)]
    return [found[0].union(ours), *found[1:]] if found else [set(ours)] if ours else []
