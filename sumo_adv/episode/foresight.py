"""Proposals scored by prediction: numpy rollouts of the planners' own answers, each asked in its sandbox session."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sumo_adv.config import Settings
from sumo_adv.datatypes import EgoCourse, Planner, Proposal, acceleration_at
from sumo_adv.episode.scoring import judge_all, touch_of
from sumo_adv.errors import PlannerLimitError, SandboxError
from sumo_adv.planning.follow import off_road
from sumo_adv.planning.ground import road_of
from sumo_adv.planning.predict import Answer, Told, predict, world_endpoint
from sumo_adv.planning.sandbox import Call, Sandbox
from sumo_adv.situation import Situation
from sumo_adv.world.network import Drivable

FAILED = 9.0  # score where the planner failed
TOGETHER = 12  # planners with a sandbox session open at once
TRAJECTORY_SECONDS = 20.0  # s all calls of one planner's own trajectory() may take in the predictions of one batch


class Foresight:
    """Predicts and scores proposals; ``seconds`` and ``count`` say what that has cost so far."""

    def __init__(self, sandbox: Sandbox, settings: Settings, drivable: Drivable, situations: Mapping[float, Situation]):
        self._sandbox = sandbox
        self._settings = settings
        self._drivable = drivable
        self._situations = situations
        self.seconds, self.count = 0.0, 0
        self.failures: dict[str, str] = {}  # planner hash -> sentence

    def score(self, proposals: Sequence[Proposal], seen: Sequence[EgoCourse] | None = None) -> list[Proposal]:
        """The same proposals with ``score`` and ``predicted`` filled in; ``seen``: against egos that drive so."""
        began = time.perf_counter()
        scored: dict[int, Proposal] = {}
        for delay, hashes in _batches(proposals):
            rows = [k for k, p in enumerate(proposals) if p.delay == delay and p.planner.hash in hashes]
            egos = None if seen is None else [seen[k] for k in rows]
            for k, p in zip(rows, self._together(delay, [proposals[k] for k in rows], egos), strict=True):
                scored[k] = p
        self.seconds += time.perf_counter() - began
        self.count += len(proposals)
        return [scored[k] for k in range(len(proposals))]

    def _together(self, delay: float, proposals: list[Proposal], seen: Sequence[EgoCourse] | None) -> list[Proposal]:
        situation, settings = self._situations[delay], self._settings
        planners = [p.planner for p in proposals]
        with Sessions(
            self._sandbox, situation, planners, settings.seed, self.failures, drivable=self._drivable
        ) as sessions:
            rollouts = predict(
                situation, proposals, lambda rows, told: sessions.ask(proposals, rows, told),
                limits=settings.limits.limits(), steps=settings.steps(settings.duration),
                replan=settings.steps(settings.replan), seen=seen, touch=touch_of(situation, proposals),
            )  # fmt: skip
            self.failures |= sessions.failures
        results = judge_all(situation, proposals, rollouts, self._drivable, settings.limits.limits())
        failed = {p.planner.hash for p in proposals} & set(self.failures)
        return [
            replace(p, score=FAILED, predicted={"failed": self.failures[p.planner.hash]})
            if p.planner.hash in failed
            else replace(p, score=r["score"], predicted=r)
            for p, r in zip(proposals, results, strict=True)
        ]


def _batches(proposals: Sequence[Proposal]) -> list[tuple[float, set[str]]]:
    """What is predicted together: one delay, and at most ``TOGETHER`` planners, each in a session of its own."""
    found = []
    for delay in sorted({p.delay for p in proposals}):
        hashes = list(dict.fromkeys(p.planner.hash for p in proposals if p.delay == delay))
        found += [(delay, set(hashes[k : k + TOGETHER])) for k in range(0, len(hashes), TOGETHER)]
    return found


class Sessions:
    """One sandbox session for each planner of a batch."""

    def __init__(
        self,
        sandbox: Sandbox,
        situation: Situation,
        planners: Sequence[Planner],
        seed: int,
        failed: Mapping[str, str] | None = None,
        *,
        drivable: Drivable | None = None,
    ) -> None:
        self._situation, self._drivable = situation, drivable
        self._spent: dict[str, float] = {}  # planner hash -> s in its trajectory()
        self._roads = {n: road_of(situation, n) for n in situation.targets}
        self._sandbox, self._seed = sandbox, seed
        self._open: dict[str, Any] = {}
        self.failures: dict[str, str] = dict(failed or {})  # planner hash -> sentence; those are not asked again
        self._planners = {p.hash: p for p in planners if p.hash not in self.failures}

    def __enter__(self) -> Sessions:
        for name, planner in self._planners.items():
            try:
                self._open[name] = self._sandbox.session(planner, self._roads, seed=self._seed).__enter__()
            except SandboxError as error:
                self.failures[name] = str(error)
        return self

    def __exit__(self, *_: object) -> None:
        for session in self._open.values():
            session.__exit__(None, None, None)

    def one(self, proposal: Proposal, told: Told) -> Answer:
        """The answer to one question. Raises SandboxError."""
        name = proposal.planner.hash
        if name in self.failures:
            raise SandboxError(self.failures[name])
        end: dict[str, float] = self._open[name].endpoint(*self._call(proposal, told))
        return self._answer(proposal, told, end)

    def _call(self, proposal: Proposal, told: Told) -> Call:
        acceleration = acceleration_at(proposal.acceleration, told[0]["time"])
        return proposal.bv, *told, proposal.parameters, acceleration, self._situation.horizon

    def _answer(self, proposal: Proposal, told: Told, end: dict[str, float]) -> Answer:
        """An endpoint in the world, with the planner's own trajectory to it if it defines one and it is on the road."""
        situation, session = self._situation, self._open[proposal.planner.hash]
        endpoint = world_endpoint(situation, end)
        if not session.has_trajectory:
            return Answer(endpoint)
        own = session.trajectory(proposal.bv, told[0], end, situation.dt)
        states = np.array([(*situation.frame.to_world(x, y, h), v) for x, y, h, v in own])
        bv = situation.targets[proposal.bv].state
        if self._drivable is not None:
            leaves = off_road(states, bv.length, bv.width, situation.dt, self._drivable)
            if leaves is not None:
                what = f"trajectory() leaves the road {leaves:.1f} s later, and the built-in one was driven"
                return Answer(endpoint, None, what)
        return Answer(endpoint, states)

    def ask(self, proposals: Sequence[Proposal], rows: Sequence[int], told: Sequence[Told]) -> list[Answer | None]:
        """Answers for the proposals ``rows``; None where the planner failed, and for the others."""
        answers: list[Answer | None] = [None] * len(told)
        for name, session in self._open.items():
            mine = [k for k in rows if proposals[k].planner.hash == name]
            if not mine or name in self.failures:
                continue
            try:
                found = session.endpoints([self._call(proposals[k], told[k]) for k in mine])
            except SandboxError as error:
                self.failures[name] = str(error)
                continue
            for k, answer in zip(mine, found, strict=True):
                try:
                    if isinstance(answer, SandboxError):
                        raise answer
                    answers[k] = self._timed(proposals[k], told[k], answer)
                except SandboxError as error:
                    self.failures.setdefault(name, str(error))
        return answers

    def _timed(self, proposal: Proposal, told: Told, end: dict[str, float]) -> Answer:
        """``_answer`` within what all predictions of a batch may take. Raises SandboxError."""
        name = proposal.planner.hash
        if self._spent.get(name, 0.0) > TRAJECTORY_SECONDS:
            who = f"Planner {proposal.label}/{proposal.planner.mode}"
            raise PlannerLimitError(f"{who}: trajectory() is too slow for predictions: make it faster.")
        began = time.perf_counter()
        answer = self._answer(proposal, told, end)
        self._spent[name] = self._spent.get(name, 0.0) + time.perf_counter() - began
        return answer
