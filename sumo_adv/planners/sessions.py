"""Planners asked in their sandbox sessions, one session each, about many vehicles and moments at once."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from sumo_adv.datatypes import Proposal, acceleration_at
from sumo_adv.errors import PlannerLimitError, SandboxError
from sumo_adv.planners.answers import Answer, Told, world_endpoint
from sumo_adv.planners.follower import off_road
from sumo_adv.planners.road import road_of
from sumo_adv.planners.sandbox import Call, PlannerSession, Sandbox
from sumo_adv.planners.trusted import InProcessSession, is_own
from sumo_adv.simulation.network import Drivable
from sumo_adv.situation import Situation

TRAJECTORY_SECONDS = 20.0  # s all calls of one planner's own trajectory() may take in the predictions of one batch


class Roads:
    """What planners are told once of the road around a BV, made where it is asked for; by proposals, which say whose
    and at which moment."""

    def __init__(self, situations: Mapping[float, Situation]) -> None:
        self.situations = situations
        self._told: dict[str, dict[str, Any]] = {}

    def of(self, proposals: Iterable[Proposal]) -> dict[str, dict[str, Any]]:
        """The roads of these, by :func:`road_key`; of a BV that is none of the encounter's there is none."""
        wanted = {road_key(p): p for p in proposals if p.bv in self.situations[p.delay].targets}
        for key in wanted.keys() - self._told.keys():
            self._told[key] = road_of(self.situations[wanted[key].delay], wanted[key].bv)
        return {key: self._told[key] for key in wanted}


def road_key(proposal: Proposal) -> str:
    """What a session knows the road of a proposal by: its BV and its moment."""
    return f"{proposal.bv} {proposal.delay}"


class Sessions:
    """One sandbox session for each planner of the proposals; those with a course of their own ask nobody.

    ``predicting``: planners that are our own answer without the sandbox.
    """

    def __init__(
        self,
        sandbox: Sandbox,
        roads: Roads,
        proposals: Sequence[Proposal],
        seed: int,
        failed: Mapping[str, str] | None = None,
        *,
        drivable: Drivable | None = None,
        predicting: bool = False,
    ) -> None:
        self._roads, self._drivable, self._predicting = roads, drivable, predicting
        self._spent: dict[str, float] = {}  # planner hash -> s in its trajectory()
        self._sandbox, self._seed = sandbox, seed
        self._open: dict[str, PlannerSession | InProcessSession] = {}
        self.failures: dict[str, str] = dict(failed or {})  # planner hash -> sentence; those are not asked again
        self.broken: dict[int, str] = {}  # the same of single proposals, by their places, that ``ask`` asks no more
        self._asking: dict[str, list[Proposal]] = {}
        for p in proposals:
            if p.course is None and p.planner.hash not in self.failures:
                self._asking.setdefault(p.planner.hash, []).append(p)

    def __enter__(self) -> Sessions:
        for name, mine in self._asking.items():
            planner, roads = mine[0].planner, self._roads.of(mine)
            sandboxed = partial(self._sandbox.session, planner, roads, seed=self._seed)
            if self._predicting and is_own(planner):
                self._open[name] = InProcessSession(planner, roads, sandboxed)
                continue
            try:
                self._open[name] = sandboxed()
            except SandboxError as error:
                self.failures[name] = str(error)
        return self

    def __exit__(self, *_: object) -> None:
        for session in self._open.values():
            session.close()

    def one(self, proposal: Proposal, told: Told) -> Answer:
        """The answer to one question. Raises SandboxError."""
        name = proposal.planner.hash
        if name in self.failures:
            raise SandboxError(self.failures[name])
        end: dict[str, float] = self._open[name].endpoint(*self._call(proposal, told))
        return self._answer(proposal, told, end)

    def _call(self, proposal: Proposal, told: Told) -> Call:
        acceleration = acceleration_at(proposal.acceleration, told[0]["time"])
        return road_key(proposal), *told, proposal.parameters, acceleration, self._situation(proposal).horizon

    def _situation(self, proposal: Proposal) -> Situation:
        return self._roads.situations[proposal.delay]

    def _answer(self, proposal: Proposal, told: Told, end: dict[str, float]) -> Answer:
        """An endpoint in the world, with the planner's own trajectory to it if it defines one and it is on the road."""
        situation, session = self._situation(proposal), self._open[proposal.planner.hash]
        endpoint = world_endpoint(situation, end)
        if isinstance(session, InProcessSession) or not session.has_trajectory:
            return Answer(endpoint)
        own = session.trajectory(road_key(proposal), told[0], end, situation.dt)
        states = np.array([(*situation.frame.to_world(x, y, h), v) for x, y, h, v in own])
        bv = situation.targets[proposal.bv].state
        if self._drivable is not None:
            leaves = off_road(states, bv.length, bv.width, situation.dt, self._drivable)
            if leaves is not None:
                what = f"trajectory() leaves the road {leaves:.1f} s later, and the built-in one was driven"
                return Answer(endpoint, None, what)
        return Answer(endpoint, states)

    def ask(self, proposals: Sequence[Proposal], rows: Sequence[int], told: Sequence[Told]) -> list[Answer | None]:
        """Answers for the proposals ``rows``; None where the planner failed, and for the others. A planner that failed
        for all of its proposals has failed."""
        answers: list[Answer | None] = [None] * len(told)
        asked: dict[str, list[int]] = {}
        for k in rows:
            name = proposals[k].planner.hash
            if name in self._open and name not in self.failures and k not in self.broken:
                asked.setdefault(name, []).append(k)
        for name, mine in asked.items():
            try:
                found = self._open[name].endpoints([self._call(proposals[k], told[k]) for k in mine])
            except SandboxError as error:
                self.failures[name] = str(error)
                continue
            for k, answer in zip(mine, found, strict=True):
                try:
                    if isinstance(answer, SandboxError):
                        raise answer
                    answers[k] = self._timed(proposals[k], told[k], answer)
                except SandboxError as error:
                    self.broken[k] = str(error)
            bad = [self.broken[k] for k in sorted(self.broken) if proposals[k].planner.hash == name]
            if len(bad) >= len(self._asking[name]):
                self.failures[name] = bad[0]
        return answers

    def _timed(self, proposal: Proposal, told: Told, end: dict[str, float]) -> Answer:
        """``_answer`` within what all predictions of a batch may take. Raises SandboxError."""
        name = proposal.planner.hash
        if isinstance(self._open[name], InProcessSession):
            return Answer(world_endpoint(self._situation(proposal), end))
        if self._spent.get(name, 0.0) > TRAJECTORY_SECONDS:
            who = f"Planner {proposal.label}/{proposal.planner.mode}"
            raise PlannerLimitError(f"{who}: trajectory() is too slow for predictions: make it faster.")
        began = time.perf_counter()
        answer = self._answer(proposal, told, end)
        self._spent[name] = self._spent.get(name, 0.0) + time.perf_counter() - began
        return answer
