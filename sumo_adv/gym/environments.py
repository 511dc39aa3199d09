"""The environments with one agent: ``sumo_adv/Ego-v0`` and ``sumo_adv/Adversary-v0``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv
from numpy.typing import NDArray

from sumo_adv.errors import UsageError
from sumo_adv.gym.actions import ADVERSARY_ACTIONS, EGO_ACTIONS, action_space
from sumo_adv.gym.core import Core, Scenarios
from sumo_adv.gym.encounters import EXPERT_ATTACKER, Attacker
from sumo_adv.gym.play import AgentStep
from sumo_adv.gym.rewards import Reward, adversary_reward, ego_reward
from sumo_adv.gym.views import Viewing
from sumo_adv.gym.window import RENDER_MODES, Viewer

METADATA = {"render_modes": list(RENDER_MODES), "render_fps": 10}
Observations = Literal["vector", "dict"]


def viewing_of(observations: str, vehicles: int, danger: bool = False) -> Viewing:
    """Return what observations hold.

    Args:
        observations: ``vector`` or ``dict``.
        vehicles: The number of other vehicles.
        danger: Whether the ego observes what ``cc_human`` would call a danger.

    Raises:
        UsageError: There are no such observations.
    """
    if observations not in ("vector", "dict"):
        raise UsageError(f"There are no observations {observations!r}; choose vector or dict.")
    return Viewing(vehicles, observations == "vector", danger)


class OneAgentEnv(Viewer, gymnasium.Env[Any, NDArray[np.float32]]):
    """The common part of the two environments with one agent."""

    metadata: dict[str, Any] = METADATA

    def __init__(self, agent: str, core: Core, viewing: Viewing, reward: Reward, render_mode: str | None) -> None:
        """Prepare the environment.

        Args:
            agent: The agent, ``ego`` or ``adversary``.
            core: The episodes.
            viewing: What observations hold.
            reward: The reward function.
            render_mode: One of ``RENDER_MODES``, or None.
        """
        Viewer.__init__(self, core, render_mode)
        self._agent, self._viewing, self._reward = agent, viewing, reward
        self.observation_space = viewing.space(adversary=agent == "adversary")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode at the trigger of a scenario's encounter.

        Args:
            seed: The seed. With a seed, attackers forget what they have learnt, and the same actions give the same
                episodes.
            options: Ignored.

        Returns:
            The observation and the info.
        """
        super().reset(seed=seed)
        moment, info = self._core.begin(self.np_random, anew=seed is not None)
        self._show()
        return self._observation(moment), info

    def step(self, action: NDArray[np.float32]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Make one step of ``interval`` seconds.

        Args:
            action: The agent's action.

        Returns:
            The observation, the reward, whether the episode is terminated, whether it is truncated, and the info.
        """
        moment, terminated, truncated, info = self._core.step({self._agent: action})
        self._show()
        return self._observation(moment), float(self._reward(moment.transition)), terminated, truncated, info

    def _observation(self, moment: AgentStep) -> Any:
        """Return the agent's observation at a moment."""
        return self._viewing.given(moment.views[self._agent])


class EgoEnv(OneAgentEnv):
    """The agent drives the ego; the expert, a language model or nothing attacks."""

    def __init__(
        self,
        scenario: Scenarios = "motorway_cut_in_left",
        *,
        attacker: Attacker = EXPERT_ATTACKER,
        adapts: bool = False,
        unattacked: float = 0.3,
        actions: str = "pedals",
        observations: Observations = "vector",
        vehicles: int = 8,
        danger: bool = False,
        interval: float = 0.1,
        reward: Reward = ego_reward,
        settings: Mapping[str, Any] | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Prepare the environment. ``docs/gym.md`` describes the arguments.

        Raises:
            UsageError: An argument is wrong.
        """
        viewing = viewing_of(observations, vehicles, danger)
        self.action_space = action_space(EGO_ACTIONS, actions)
        core = Core(
            scenario, viewing, interval, settings, attacker=attacker, adapts=adapts, unattacked=unattacked,
            ego_actions=actions,
        )  # fmt: skip
        super().__init__("ego", core, viewing, reward, render_mode)


class AdversaryEnv(OneAgentEnv):
    """The agent drives the adversary against an ego with any driver."""

    def __init__(
        self,
        scenario: Scenarios = "motorway_cut_in_left",
        *,
        ego: Any = "idm",
        actions: str = "endpoint",
        observations: Observations = "vector",
        vehicles: int = 8,
        interval: float | None = None,
        reward: Reward = adversary_reward,
        settings: Mapping[str, Any] | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Prepare the environment. ``docs/gym.md`` describes the arguments.

        Raises:
            UsageError: An argument is wrong.
        """
        viewing = viewing_of(observations, vehicles)
        self.action_space = action_space(ADVERSARY_ACTIONS, actions)
        seconds = interval if interval is not None else INTERVALS[actions]
        core = Core(scenario, viewing, seconds, settings, ego=ego, adversary_actions=actions)
        super().__init__("adversary", core, viewing, reward, render_mode)


INTERVALS: Mapping[str, float] = {"endpoint": 0.5, "controls": 0.1}
"""The time between two decisions of an adversary, by its kind of actions [s]."""


# Parallel environments, each in its own process, as ``gymnasium.make_vec`` makes them.


def ego_vec(num_envs: int = 1, **options: Any) -> AsyncVectorEnv:
    """Make ``num_envs`` environments ``sumo_adv/Ego-v0``.

    Args:
        num_envs: The number of environments.
        options: The arguments of each environment.
    """
    return _side_by_side(EgoEnv, num_envs, **options)


def adversary_vec(num_envs: int = 1, **options: Any) -> AsyncVectorEnv:
    """Make ``num_envs`` environments ``sumo_adv/Adversary-v0``.

    Args:
        num_envs: The number of environments.
        options: The arguments of each environment.
    """
    return _side_by_side(AdversaryEnv, num_envs, **options)


def _side_by_side(
    make: Callable[..., gymnasium.Env[Any, Any]], num_envs: int, scenario: Scenarios | None = None, **options: Any
) -> AsyncVectorEnv:
    """Make parallel environments; divide the scenarios among them, so that each is opened as rarely as possible."""
    if scenario is None:
        return AsyncVectorEnv([partial(make, **options)] * num_envs)
    scenarios = [scenario] if isinstance(scenario, str | Path) else list(scenario)
    shares = [scenarios[k::num_envs] or scenarios[k % len(scenarios) :][:1] for k in range(num_envs)]
    return AsyncVectorEnv([partial(make, scenario=share, **options) for share in shares])
