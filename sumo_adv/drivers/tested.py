"""The driver under test, as a run uses it: timed, with the sensors and the latency of the settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sumo_adv.config import Settings
from sumo_adv.drivers.protocol import EgoController
from sumo_adv.drivers.registry import GivenEgo, make_ego
from sumo_adv.drivers.sensing import LateEgo, SensedEgo
from sumo_adv.drivers.sumo_driven import ReplayEgo
from sumo_adv.drivers.timing import TimedEgo
from sumo_adv.errors import UsageError


def with_sensors(driver: EgoController, settings: Settings) -> tuple[EgoController, TimedEgo | None]:
    """Wrap a driver as the settings say.

    Args:
        driver: The driver.
        settings: The run's settings.

    Returns:
        The wrapped driver, and the part of it that times its answers; None if the driver gives none, because SUMO or a
        log drives.

    Raises:
        UsageError: The settings give sensors or a latency to a driver that gives no answers.
    """
    if not driver.needs_observation or isinstance(driver, ReplayEgo):
        if settings.ego_sensing.is_on or settings.ego_latency:
            raise UsageError(
                f"The ego {driver.name!r} is driven by SUMO or by a log, which use no observation: ego_sensing and "
                "ego_latency need a driver with act."
            )
        return driver, None
    timed = TimedEgo(driver)
    late = None if settings.ego_latency == "measured" else float(settings.ego_latency)
    wrapped = timed if late == 0.0 else LateEgo(timed, late)
    return SensedEgo(wrapped, settings.ego_sensing) if settings.ego_sensing.is_on else wrapped, timed


def make_tested_ego(
    name: str, parameters: Mapping[str, Any], settings: Settings, given: GivenEgo | None = None
) -> tuple[EgoController, TimedEgo | None]:
    """Make the driver under test; see ``make_ego`` and ``with_sensors``.

    Raises:
        UsageError: There is no such driver, or it cannot have the settings' sensors or latency.
    """
    return with_sensors(make_ego(name, parameters, given), settings)
