"""A policy as an ego driver: what was trained in ``sumo_adv/Ego-v0`` drives in runs, benches and campaigns."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

from sumo_adv.drivers import Action, Observation
from sumo_adv.drivers.road import Road
from sumo_adv.gym.actions import EGO_ACTIONS, action_space, ego_action
from sumo_adv.gym.environments import Observations, viewing_of
from sumo_adv.gym.views import FAST, view_of_ego

Policy = Callable[[Any], NDArray[Any]]
"""From an observation of ``sumo_adv/Ego-v0`` to an action."""


class PolicyDriver:
    """Drives the ego by a policy. The other arguments are those of the environment in which it was trained."""

    name = "policy"
    forkable = False

    def __init__(
        self, policy: Policy, *, actions: str = "controls", observations: Observations = "vector", vehicles: int = 8
    ) -> None:
        """Raises UsageError."""
        action_space(EGO_ACTIONS, actions)
        self._policy, self._actions = policy, actions
        self._viewing = viewing_of(observations, vehicles)

    def reset(self, seed: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation) -> Action:
        """What the policy does."""
        view = view_of_ego(observation, self._viewing.vehicles)
        numbers = self._policy(self._viewing.given(view))
        road: Road | None = observation.road
        limit = FAST if road is None else road.limit
        return ego_action(self._actions, numbers, observation.ego, limit, observation.dt)
