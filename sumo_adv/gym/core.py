"""The common core of all environments: choosing encounter and attack, stepping, rewinding, and the picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sumo_adv.errors import SimulationError, UsageError
from sumo_adv.gym.actions import ADVERSARY_ACTIONS, EGO_ACTIONS, checked_action
from sumo_adv.gym.encounters import Attacker, Attacks, PlayedAttack, TrainingEncounter
from sumo_adv.gym.picture import EMPTY_PICTURE
from sumo_adv.gym.play import DRAW_REQUEST, TERMINATED, AgentStep, Play
from sumo_adv.gym.views import Viewing

CRASHED, PLANNER_FAILED = "crashed", "planner_failed"
Scenarios = str | Path | Sequence[str | Path]


class Core:
    """The episodes of one environment. Each scenario is opened once, and each episode restarts at its trigger."""

    def __init__(
        self, scenarios: Scenarios, viewing: Viewing, interval: float, settings: Mapping[str, Any] | None, *,
        ego: Any = None, attacker: Attacker = None, adapts: bool = False, unattacked: float = 0.0,
        ego_actions: str | None = None, adversary_actions: str | None = None,
    ) -> None:  # fmt: skip
        """Check the arguments; scenarios are opened later.

        Args:
            scenarios: The scenarios; each episode draws one.
            viewing: What observations hold.
            interval: The duration of a step of the environment [s].
            settings: Settings of a run; None for the defaults.
            ego: The driver of the ego; None if an agent drives.
            attacker: What attacks the ego.
            adapts: Whether attacks keep up with the ego.
            unattacked: The share of episodes without an attack.
            ego_actions: The kind of the ego's actions; None if no agent drives it.
            adversary_actions: The kind of the adversary's actions; None if no agent drives it.

        Raises:
            UsageError: An argument is wrong.
        """
        self._scenarios = [scenarios] if isinstance(scenarios, str | Path) else list(scenarios)
        if not self._scenarios:
            raise UsageError("An environment needs a scenario.")
        if not 0.0 < interval <= 5.0:
            raise UsageError(f"interval is {interval:g} s; it must be above 0 and at most 5.")
        if not 0.0 <= unattacked <= 1.0:
            raise UsageError(f"unattacked is {unattacked:g}; it is a share, from 0 to 1.")
        if viewing.vehicles < 1:
            raise UsageError(f"vehicles is {viewing.vehicles}; it must be 1 or more.")
        self._viewing, self._interval, self._settings = viewing, interval, dict(settings or {})
        self._ego, self._attacker, self._adapts, self._unattacked = ego, attacker, adapts, unattacked
        self._kinds = (ego_actions, adversary_actions)
        self._counts = {
            agent: kinds[kind]
            for agent, kinds, kind in (
                ("ego", EGO_ACTIONS, ego_actions), ("adversary", ADVERSARY_ACTIONS, adversary_actions)
            )
            if kind is not None
        }  # fmt: skip
        self._opened: dict[int, TrainingEncounter] = {}
        self._plans: dict[int, Attacks] = {}
        self._played: PlayedAttack | None = None
        self._last: AgentStep | None = None
        self._at = 0
        # at its end, a process waits for the engines' processes, which wait for this
        Finalize(self, _close, args=(self._opened,), exitpriority=1)

    def begin(self, draws: np.random.Generator, *, anew: bool) -> tuple[AgentStep, dict[str, Any]]:
        """Begin the next episode.

        Args:
            draws: The random generator.
            anew: If true, attackers forget what they have learnt about the agent.

        Returns:
            The first moment of the episode, and the info.

        Raises:
            UsageError: A scenario cannot be used.
            SimulationError: SUMO does not start.
        """
        self._end()
        if anew and self._adapts:
            self._plans.clear()
        self._at = int(draws.integers(len(self._scenarios)))
        encounter = self._encounter(self._at)
        self._played = encounter.play(self._play(encounter, draws))
        self._last = self._played.first
        return self._last, self._told(self._last)

    def _encounter(self, at: int) -> TrainingEncounter:
        """Return the encounter of a scenario; open it first if it is not open or its engine has died."""
        if at in self._opened and not self._opened[at].alive:
            self._opened.pop(at).close()
            self._plans.pop(at, None)
        if at not in self._opened:
            self._opened[at] = TrainingEncounter(self._scenarios[at], self._settings, self._ego, self._attacker)
        return self._opened[at]

    def _play(self, encounter: TrainingEncounter, draws: np.random.Generator) -> Play:
        """Choose the attack of the next episode."""
        ego, adversary = self._kinds
        every = max(1, encounter.settings.steps(self._interval))
        situations = encounter.found.situations
        delay = min(situations)
        if adversary is not None:
            bv = situations[delay].target_list()[0].state.id
            return Play(self._viewing, every, ego, adversary, None, bv, delay)
        attack = None
        if self._attacker is not None and draws.random() >= self._unattacked:
            if self._at not in self._plans:
                self._plans[self._at] = encounter.plan(adapts=self._adapts)
            attack = self._plans[self._at].next(draws)
        if attack is None:
            return Play(self._viewing, every, ego)
        return Play(self._viewing, every, ego, None, attack, attack.bv, attack.delay)

    def step(self, actions: Mapping[str, NDArray[Any]]) -> tuple[AgentStep, bool, bool, dict[str, Any]]:
        """Make a step of the environment.

        An episode in which SUMO dies is truncated; the next one begins in a new simulation.

        Args:
            actions: The action of each agent.

        Returns:
            The moment, whether the episode is terminated, whether it is truncated, and the info.

        Raises:
            UsageError: An agent's action is missing, has another shape or is not finite. Nothing has moved then.
        """
        assert self._played is not None and self._last is not None, "call reset before step"
        if missing := self._counts.keys() - actions.keys():
            raise UsageError(f"The agent {min(missing)!r} has no action: give one of every agent in each step.")
        numbers = {agent: checked_action(agent, actions[agent], count) for agent, count in self._counts.items()}
        try:
            self._last = self._played.ask(numbers)
        except SimulationError as error:
            t = self._last.transition
            over = replace(t, seconds=0.0, before=t.ego or t.before, apart_before=t.apart, ending=CRASHED, verdict=None)
            self._last = replace(self._last, transition=over)
            return self._last, False, True, {**self._told(self._last), "why": str(error)}
        moment: AgentStep = self._last
        ending, verdict, proposal = moment.transition.ending, moment.transition.verdict, self._played.play.proposal
        if proposal is not None and verdict is not None and ending != PLANNER_FAILED:
            self._plans[self._at].observe(proposal, verdict)
        return moment, ending in TERMINATED, bool(ending) and ending not in TERMINATED, self._told(moment)

    def _told(self, moment: AgentStep) -> dict[str, Any]:
        """Return the info of a moment."""
        assert self._played is not None
        t, play = moment.transition, self._played.play
        info: dict[str, Any] = {
            "time": moment.time, "scenario": self._played.encounter.name,
            "attack": "" if play.proposal is None else play.proposal.label, "apart": t.apart,
            "behind": t.behind,
        }  # fmt: skip
        if t.ending:
            info |= {"ending": t.ending, "touched": t.touched or ""}
            if t.verdict is not None:
                info |= {"verdict": t.verdict, "level": str(t.verdict.level)}
        return info

    def picture(self) -> NDArray[np.uint8]:
        """Return a picture of the scene; an empty one if the simulation has crashed.

        Raises:
            UsageError: No episode has begun.
        """
        if self._played is None or self._last is None:
            raise UsageError("There is nothing to show before the first reset.")
        if self._last.transition.ending == CRASHED:
            return EMPTY_PICTURE.copy()
        image: NDArray[np.uint8] = self._played.ask(DRAW_REQUEST)
        return image

    def _end(self) -> None:
        """End the episode."""
        if self._played is not None:
            played, self._played = self._played, None
            with suppress(SimulationError):  # reported where it happened
                played.end()

    def close(self) -> None:
        """End all processes. A second call does nothing."""
        self._end()
        _close(self._opened)


def _close(opened: dict[int, TrainingEncounter]) -> None:
    """Close all opened encounters."""
    while opened:
        opened.popitem()[1].close()
