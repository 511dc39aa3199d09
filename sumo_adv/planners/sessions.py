"""The sessions of many proposals: one for each planner, asked about many vehicles and moments at once."""

from __future__ import annotations

import math
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from sumo_adv.datatypes import Proposal
from sumo_adv.errors import PlannerLimitError, SandboxError
from sumo_adv.planners.answers import Answer, PlannerObservation, call_of, world_endpoint
from sumo_adv.planners.follower import leaves_road
from sumo_adv.planners.results import subject_of
from sumo_adv.planners.road import road_of
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.session import MOST_STOPPED, Call, PlannerSession
from sumo_adv.planners.trusted import InProcessSession, is_trusted
from sumo_adv.simulation.network import Drivable
from sumo_adv.situation import Situation

TRAJECTORY_SECONDS = 20.0  # s that one planner's trajectory() may take in a batch of predictions


class Roads:
    """The ``road`` dictionaries of an encounter's BVs, made when first needed; ``situations``: by delay [s]."""

    def __init__(self, situations: Mapping[float, Situation]) -> None:
        self.situations = situations
        self._made: dict[str, dict[str, Any]] = {}

    def of(self, proposals: Iterable[Proposal]) -> dict[str, dict[str, Any]]:
        """The roads of the proposals' BVs, by :func:`road_key`, without those of BVs that are not in the encounter."""
        by_key = {road_key(p): p for p in proposals if p.bv in self.situations[p.delay].targets}
        for key in by_key.keys() - self._made.keys():
            self._made[key] = road_of(self.situations[by_key[key].delay], by_key[key].bv)
        return {key: self._made[key] for key in by_key}


def road_key(proposal: Proposal) -> str:
    """The key of a proposal's road in a session: its BV and its delay."""
    return f"{proposal.bv} {proposal.delay}"


class Sessions:
    """One session for each planner of the proposals. Proposals with a prescribed motion need none.

    Args:
        failed: planners that failed earlier, as hash -> sentence; they are not asked again.
        drivable: the road surface that the planners' own trajectories must stay on; None does not check it.
        in_process: let trusted planners answer in this process.
        stopped: how many calls of each planner ran into a limit earlier, by hash.

    Attributes:
        failures: planners that failed for all of their proposals, or ran into a limit ``MOST_STOPPED`` times, as
            hash -> sentence.
        stopped: as above, with the calls since.
        broken: proposals that failed, as their place -> sentence; ``answers`` does not ask them again.
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
        in_process: bool = False,
        stopped: Mapping[str, int] | None = None,
    ) -> None:
        self._roads, self._drivable, self._in_process = roads, drivable, in_process
        self._spent: dict[str, float] = defaultdict(float)  # planner hash -> s in its trajectory()
        self._sandbox, self._seed = sandbox, seed
        self._open: dict[str, PlannerSession | InProcessSession] = {}
        self.failures: dict[str, str] = dict(failed or {})
        self.stopped = Counter(stopped or {})
        self.broken: dict[int, str] = {}
        self._proposals: dict[str, list[Proposal]] = {}  # by planner hash
        for p in proposals:
            if self.stopped[p.planner.hash] >= MOST_STOPPED:
                reason = "it ran into its limits again and again, and is not asked any more: make it faster."
                self.failures.setdefault(p.planner.hash, f"{subject_of(p.planner)}: {reason}")
            if p.course is None and p.planner.hash not in self.failures:
                self._proposals.setdefault(p.planner.hash, []).append(p)

    def __enter__(self) -> Sessions:
        for name, proposals in self._proposals.items():
            planner, roads = proposals[0].planner, self._roads.of(proposals)
            open_sandboxed = partial(self._sandbox.session, planner, roads, seed=self._seed)
            if self._in_process and is_trusted(planner):
                self._open[name] = InProcessSession(planner, roads, open_sandboxed)
                continue
            try:
                self._open[name] = open_sandboxed()
            except SandboxError as error:
                self.failures[name] = str(error)
        return self

    def __exit__(self, *_: object) -> None:
        for session in self._open.values():
            session.close()

    def answer(self, proposal: Proposal, observation: PlannerObservation) -> Answer:
        """The answer of a proposal's planner. Raises SandboxError."""
        name = proposal.planner.hash
        if name in self.failures:
            raise SandboxError(self.failures[name])
        end: dict[str, float] = self._open[name].endpoint(*self._call(proposal, observation))
        return self._answer(proposal, observation, end, math.inf)

    def answers(
        self, proposals: Sequence[Proposal], rows: Sequence[int], observations: Sequence[PlannerObservation]
    ) -> list[Answer | None]:
        """The answers for the proposals at ``rows``; None for the others and where the planner failed."""
        answers: list[Answer | None] = [None] * len(observations)
        rows_of: dict[str, list[int]] = {}
        for k in rows:
            name = proposals[k].planner.hash
            if name in self._open and name not in self.failures and k not in self.broken:
                rows_of.setdefault(name, []).append(k)
        for name, asked_rows in rows_of.items():
            calls = [self._call(proposals[k], observations[k]) for k in asked_rows]
            try:
                ends = self._open[name].endpoints(calls)
            except SandboxError as error:
                self.failures[name] = str(error)
                continue
            for k, end in zip(asked_rows, ends, strict=True):
                try:
                    if isinstance(end, SandboxError):
                        raise end
                    answers[k] = self._answer(proposals[k], observations[k], end, TRAJECTORY_SECONDS)
                except SandboxError as error:
                    self.broken[k] = str(error)
                    self.stopped[name] += isinstance(error, PlannerLimitError)
            broken = [self.broken[k] for k in sorted(self.broken) if proposals[k].planner.hash == name]
            if len(broken) >= len(self._proposals[name]) or self.stopped[name] >= MOST_STOPPED:
                self.failures[name] = broken[0]
        return answers

    def _call(self, proposal: Proposal, observation: PlannerObservation) -> Call:
        return call_of(proposal, road_key(proposal), observation, self._situation(proposal).horizon)

    def _situation(self, proposal: Proposal) -> Situation:
        return self._roads.situations[proposal.delay]

    def _answer(
        self, proposal: Proposal, observation: PlannerObservation, end: dict[str, float], seconds: float
    ) -> Answer:
        """An endpoint in the world, with the planner's own trajectory if there is one and it stays on the road.

        Raises:
            PlannerLimitError: earlier calls of its trajectory() took more than ``seconds``.
            SandboxError: its trajectory() failed.
        """
        situation, planner = self._situation(proposal), proposal.planner
        endpoint, session = world_endpoint(situation, end), self._open[planner.hash]
        if isinstance(session, InProcessSession) or not session.has_trajectory:
            return Answer(endpoint)
        if self._spent[planner.hash] > seconds:
            raise PlannerLimitError(f"{subject_of(planner)}: trajectory() is too slow for predictions: make it faster.")
        began = time.perf_counter()
        local = session.trajectory(road_key(proposal), observation[0], end, situation.dt)
        self._spent[planner.hash] += time.perf_counter() - began
        states = np.array([(*situation.frame.to_world(x, y, h), v) for x, y, h, v in local])
        bv = situation.targets[proposal.bv].state
        if self._drivable is not None:
            leaves = leaves_road(states, bv.length, bv.width, situation.dt, self._drivable)
            if leaves is not None:
                remark = f"trajectory() leaves the road {leaves:.1f} s later, and the built-in one was driven"
                return Answer(endpoint, None, remark)
        return Answer(endpoint, states)
