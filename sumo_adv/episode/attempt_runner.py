"""The front's side of attempts: planners in the sandbox, asked by the engine's forks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from sumo_adv.datatypes import Proposal
from sumo_adv.episode.task import AttemptResult, FoundEncounter
from sumo_adv.errors import SandboxError
from sumo_adv.planners.answers import Answer, PlannerObservation
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.sessions import Roads, Sessions
from sumo_adv.simulation.engine import Engine


class AttemptRunner:
    """Runs attempts on the engine, each with a fresh sandbox session of its planner where that is not our own."""

    def __init__(self, engine: Engine, sandbox: Sandbox, found: FoundEncounter, seed: int) -> None:
        self._engine, self._sandbox, self._found, self._seed = engine, sandbox, found, seed

    def attempt(self, proposals: Sequence[Proposal]) -> list[AttemptResult]:
        """The results of the proposals, in order; they run at the same time where the engine can fork."""
        opened: dict[int, Sessions] = {}
        roads = Roads(self._found.situations)

        def answer(question: tuple[int, Any]) -> Answer | str:
            k, observation = question
            if k not in opened:
                mine = Sessions(self._sandbox, roads, [proposals[k]], self._seed, drivable=self._found.drivable)
                opened[k] = mine.__enter__()
            return answer_of(proposals[k], opened[k], observation)

        try:
            results: list[AttemptResult] = self._engine.request("attempts", list(proposals), answer=answer)
            return results
        finally:
            for sessions in opened.values():
                sessions.__exit__(None, None, None)

    def references(self, proposal: Proposal, result: AttemptResult) -> dict[str, bool]:
        """Which reference drivers avoid an attempt's collision in the simulation."""
        found: dict[str, bool] = self._engine.request("references", proposal, result)
        return found


class SequentialRunner:
    """Runs attempts one at a time, each only once it is asked for: for many episodes side by side, where what runs at
    once but is dropped (behind a success) is time lost to others. The results are the same."""

    def __init__(self, brain: AttemptRunner) -> None:
        self._brain = brain

    def attempt(self, proposals: Sequence[Proposal]) -> Iterator[AttemptResult]:
        """The results of the proposals, in order."""
        for proposal in proposals:
            yield from self._brain.attempt([proposal])

    def references(self, proposal: Proposal, result: AttemptResult) -> dict[str, bool]:
        """Which reference drivers avoid an attempt's collision in the simulation."""
        return self._brain.references(proposal, result)


def answer_of(proposal: Proposal, sessions: Sessions, observation: PlannerObservation) -> Answer | str:
    """What the proposal's planner answers, or a sentence why it does not."""
    try:
        return sessions.answer(proposal, observation)
    except SandboxError as error:
        return str(error)
