"""Built-in drivers that the search is told nothing about, as it knows nothing about a user's driver.

They show what not knowing the driver costs: ``sumo_adv.benchmark.unknown:CarefulAsUnknown`` beside ``careful``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sumo_adv.drivers.careful import CarefulEgo
from sumo_adv.drivers.protocol import Action, EgoController, Observation


class _AsUnknown:
    """Drives as another driver, and does not say how it is predicted."""

    forkable = True

    def __init__(self, driver: EgoController, name: str) -> None:
        self._driver, self.name = driver, f"{name} as unknown"
        self.sumo_type: Mapping[str, str] = driver.sumo_type
        self.needs_observation = driver.needs_observation
        self.needs_road = bool(getattr(driver, "needs_road", False))

    def reset(self, seed: int) -> None:
        self._driver.reset(seed)

    def act(self, observation: Observation) -> Action:
        return self._driver.act(observation)


class CarefulAsUnknown(_AsUnknown):
    """The careful driver of UN R157."""

    def __init__(self, **parameters: Any) -> None:
        super().__init__(CarefulEgo(parameters), "careful")
