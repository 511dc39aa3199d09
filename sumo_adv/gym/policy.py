"""A policy as an ego driver: a policy trained in ``sumo_adv/Ego-v0`` drives in runs, benches and campaigns."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

from sumo_adv.drivers import Action, Observation
from sumo_adv.gym.actions import EGO_ACTIONS, action_space, checked_action, ego_action
from sumo_adv.gym.environments import Observations, viewing_of
from sumo_adv.gym.views import MAX_VIEWED_SPEED_M_S, AgentWatch, view_of_ego

Policy = Callable[[Any], NDArray[Any]]
"""Maps an observation of ``sumo_adv/Ego-v0`` to an action."""


class PolicyDriver:
    """Drives the ego by a policy."""

    name = "policy"
    forkable = False

    def __init__(
        self,
        policy: Policy,
        *,
        actions: str = "pedals",
        observations: Observations = "vector",
        vehicles: int = 8,
        danger: bool = False,
        interval: float = 0.1,
    ) -> None:
        """Wrap a policy. The other arguments are those of the environment in which it was trained.

        Args:
            policy: Maps an observation to an action.
            actions: The kind of its actions.
            observations: ``vector`` or ``dict``.
            vehicles: The number of other vehicles in an observation.
            danger: Whether an observation has the numbers of ``DANGER_MAXIMA``.
            interval: The time between two decisions [s].

        Raises:
            UsageError: An argument is wrong.
        """
        action_space(EGO_ACTIONS, actions)
        self._policy, self._actions, self._interval = policy, actions, interval
        self._viewing = viewing_of(observations, vehicles, danger)
        self._numbers: NDArray[Any] | None = None
        self._due = 0.0
        PolicyDriver.reset(self, 0)

    def reset(self, seed: int) -> None:
        """Forget the last action and what was seen."""
        self._numbers = None
        self._watch = AgentWatch() if self._viewing.danger else None

    def act(self, observation: Observation) -> Action:
        """Return the action of the policy, which decides every ``interval`` seconds."""
        if self._watch is not None:
            self._watch.step(observation)
        if self._numbers is None or observation.time > self._due - observation.dt / 2:
            view = view_of_ego(observation, self._viewing.vehicles, self._watch)
            self._numbers = checked_action(
                self.name, self._policy(self._viewing.given(view)), EGO_ACTIONS[self._actions]
            )
            self._due = observation.time + self._interval
        limit = MAX_VIEWED_SPEED_M_S if observation.road is None else observation.road.limit
        return ego_action(self._actions, self._numbers, observation.ego, limit, observation.dt)
