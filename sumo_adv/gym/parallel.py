"""The PettingZoo environment in which one agent drives the ego and another one the adversary."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from sumo_adv.gym.actions import ADVERSARY_ACTIONS, EGO_ACTIONS, action_space
from sumo_adv.gym.core import Core, Scenarios
from sumo_adv.gym.environments import METADATA, Observations, viewing_of
from sumo_adv.gym.play import AgentStep
from sumo_adv.gym.rewards import Reward, adversary_reward, ego_reward
from sumo_adv.gym.window import Viewer

EGO_AGENT, ADVERSARY_AGENT = "ego", "adversary"
PARALLEL_METADATA = {**METADATA, "name": "sumo_adv_v0"}
Box = NDArray[np.float32]


class BothEnv(Viewer, ParallelEnv[str, Any, Box]):
    """Two agents, ``ego`` and ``adversary``. Both are present from the first step to the end of an episode."""

    metadata: dict[str, Any] = PARALLEL_METADATA

    def __init__(
        self,
        scenario: Scenarios = "motorway_cut_in_left",
        *,
        ego_actions: str = "controls",
        adversary_actions: str = "controls",
        observations: Observations = "vector",
        vehicles: int = 8,
        danger: bool = False,
        interval: float = 0.1,
        rewards: Mapping[str, Reward] | None = None,
        settings: Mapping[str, Any] | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Prepare the environment. ``docs/gym.md`` describes the arguments.

        Raises:
            UsageError: An argument is wrong.
        """
        self._viewing = viewing_of(observations, vehicles, danger)
        self._rewards: dict[str, Reward] = {EGO_AGENT: ego_reward, ADVERSARY_AGENT: adversary_reward, **(rewards or {})}
        self.possible_agents = [EGO_AGENT, ADVERSARY_AGENT]
        self.agents: list[str] = []
        self.observation_spaces = {
            name: self._viewing.space(adversary=name == ADVERSARY_AGENT) for name in self.possible_agents
        }
        self.action_spaces = {
            EGO_AGENT: action_space(EGO_ACTIONS, ego_actions),
            ADVERSARY_AGENT: action_space(ADVERSARY_ACTIONS, adversary_actions)
        }  # fmt: skip
        core = Core(
            scenario, self._viewing, interval, settings, ego_actions=ego_actions, adversary_actions=adversary_actions
        )
        Viewer.__init__(self, core, render_mode)
        self._draws: np.random.Generator | None = None

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return the observation space of an agent."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return the action space of an agent."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Begin an episode at the trigger of a scenario's encounter.

        Args:
            seed: The seed. With a seed, attackers forget what they have learnt.
            options: Ignored.

        Returns:
            The observations and the infos of the agents.
        """
        if seed is not None or self._draws is None:
            self._draws, _ = seeding.np_random(seed)
        moment, info = self._core.begin(self._draws, anew=seed is not None)
        self.agents = list(self.possible_agents)
        self._show()
        return self._observations(moment), {name: dict(info) for name in self.agents}

    def step(
        self, actions: dict[str, Box]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Make one step of ``interval`` seconds.

        Args:
            actions: The action of each agent.

        Returns:
            The observations, the rewards, whether the episode is terminated, whether it is truncated, and the infos,
            each by agent.
        """
        moment, terminated, truncated, info = self._core.step(actions)
        agents = list(self.agents)
        rewards = {name: float(self._rewards[name](moment.transition)) for name in agents}
        if terminated or truncated:
            self.agents = []
        self._show()
        return (
            self._observations(moment), rewards, dict.fromkeys(agents, terminated), dict.fromkeys(agents, truncated),
            {name: dict(info) for name in agents},
        )  # fmt: skip

    def _observations(self, moment: AgentStep) -> dict[str, Any]:
        """Return the observations of the agents at a moment."""
        return {name: self._viewing.given(moment.views[name]) for name in self.possible_agents}


def parallel_env(*args: Any, **options: Any) -> BothEnv:
    """Make the environment, under the name that PettingZoo's modules give it.

    Args:
        args: The positional arguments of ``BothEnv``.
        options: The keyword arguments of ``BothEnv``.
    """
    return BothEnv(*args, **options)
