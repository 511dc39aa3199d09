"""The front's side of attempts: planners run in the sandbox and answer the engine's forks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Protocol

from sumo_adv.datatypes import Proposal
from sumo_adv.episode.task import AttemptResult, FoundEncounter
from sumo_adv.errors import SandboxError
from sumo_adv.planners.answers import Answer, PlannerObservation
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.sessions import Roads, Sessions
from sumo_adv.simulation.engine import Engine


class Attempts(Protocol):
    """Runs attempts; a result is taken only if the ones before it did not succeed."""

    def attempt(self, proposals: Sequence[Proposal]) -> Iterable[AttemptResult]:
        """The results of the proposals, in order."""

    def references(self, proposal: Proposal, result: AttemptResult) -> dict[str, bool]:
        """Which reference drivers avoid an attempt's collision in the simulation; empty where that cannot be asked."""


class AttemptRunner:
    """Runs attempts on the engine. A planner that is not ours gets a fresh sandbox session for each attempt."""

    def __init__(self, engine: Engine, sandbox: Sandbox, found: FoundEncounter, seed: int) -> None:
        self._engine, self._sandbox, self._found, self._seed = engine, sandbox, found, seed

    def attempt(self, proposals: Sequence[Proposal]) -> list[AttemptResult]:
        """The results of the proposals, in order. They run at the same time if the engine can fork."""
        opened: dict[tuple[int, int], Sessions] = {}
        roads = Roads(self._found.situations)

        def answer(question: tuple[int, int, Any]) -> Answer | str:
            k, member, observation = question
            adversary = proposals[k].members[member]
            if (k, member) not in opened:
                session = Sessions(self._sandbox, roads, [adversary], self._seed, drivable=self._found.drivable)
                opened[k, member] = session.__enter__()
            return answer_of(adversary, opened[k, member], observation)

        try:
            results: list[AttemptResult] = self._engine.request("attempts", list(proposals), answer=answer)
            return results
        finally:
            for sessions in opened.values():
                sessions.__exit__(None, None, None)

    def references(self, proposal: Proposal, result: AttemptResult) -> dict[str, bool]:
        """Which reference drivers avoid an attempt's collision in the simulation."""
        answers: dict[str, bool] = self._engine.request("references", proposal, result)
        return answers


class StepwiseRunner:
    """Runs attempts when their results are requested, ``at_once`` at a time. The results are the same.

    Attempts behind a success are then not made; for many episodes side by side, one at a time.
    """

    def __init__(self, runner: AttemptRunner, at_once: int = 1) -> None:
        self._runner, self._at_once = runner, at_once

    def attempt(self, proposals: Sequence[Proposal]) -> Iterator[AttemptResult]:
        """The results of the proposals, in order."""
        for k in range(0, len(proposals), self._at_once):
            yield from self._runner.attempt(proposals[k : k + self._at_once])

    def references(self, proposal: Proposal, result: AttemptResult) -> dict[str, bool]:
        """Which reference drivers avoid an attempt's collision in the simulation."""
        return self._runner.references(proposal, result)


def answer_of(proposal: Proposal, sessions: Sessions, observation: PlannerObservation) -> Answer | str:
    """The answer of the proposal's planner, or a sentence why there is none."""
    try:
        return sessions.answer(proposal, observation)
    except SandboxError as error:
        return str(error)
