"""Provide a built-in driver about which the search knows nothing, as it knows nothing about a user's driver.

A comparison of ``sumo_adv.benchmark.unknown:CarefulAsUnknown`` with ``careful`` shows what not knowing the driver
costs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sumo_adv.drivers.careful import CarefulEgo
from sumo_adv.drivers.protocol import Action, Observation


class CarefulAsUnknown:
    """Drives as the careful driver of UN R157, and does not say how it is predicted."""

    name = "careful as unknown"
    forkable = True

    def __init__(self, **parameters: Any) -> None:
        """Create the driver.

        Args:
            parameters: The parameters of the ego ``careful``.
        """
        self._driver = CarefulEgo(parameters)
        self.sumo_type: Mapping[str, str] = self._driver.sumo_type
        self.needs_observation = self._driver.needs_observation
        self.needs_road = bool(getattr(self._driver, "needs_road", False))

    def reset(self, seed: int) -> None:
        self._driver.reset(seed)

    def act(self, observation: Observation) -> Action:
        return self._driver.act(observation)
