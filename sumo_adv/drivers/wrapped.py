"""A driver that wraps another driver and passes on everything that the engine asks of it."""

from __future__ import annotations

from sumo_adv.datatypes import DriverModel
from sumo_adv.drivers.protocol import Action, EgoController, Observation, model_of, wishes_of


class WrappedEgo:
    """Passes everything on to a driver. Subclasses change ``act``, and what the driver sees.

    Attributes:
        reference: The reference driver that the wrapped driver is, if it is one.
    """

    def __init__(self, driver: EgoController) -> None:
        self._driver = driver
        self.name, self.forkable, self.sumo_type = driver.name, driver.forkable, driver.sumo_type
        self.needs_observation, self.wishes = driver.needs_observation, wishes_of(driver)
        self.reference: str | None = getattr(driver, "reference", None)

    def reset(self, seed: int) -> None:
        self._driver.reset(seed)

    def act(self, observation: Observation) -> Action:
        return self._driver.act(observation)

    def model_of(self, numbers: DriverModel) -> DriverModel:
        return model_of(self._driver, numbers)
