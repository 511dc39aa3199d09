"""From a driver's name to its controller.

Built-in drivers stand in ``DRIVERS``. Drivers of other packages are found by their entry point in the group
``sumo_adv.drivers``; any other class is named ``module:Class``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from importlib.metadata import entry_points
from typing import Any

from sumo_adv.drivers.careful import CarefulEgo
from sumo_adv.drivers.lattice_ego import LatticeEgo
from sumo_adv.drivers.protocol import Action, EgoController, Observation
from sumo_adv.drivers.replay import ReplayEgo
from sumo_adv.drivers.sumo_driven import MODELS, SumoEgo
from sumo_adv.drivers.user import UserEgo
from sumo_adv.errors import UsageError

ENTRY_POINTS = "sumo_adv.drivers"
DRIVERS: Mapping[str, Callable[[Mapping[str, Any]], EgoController]] = {
    **{name: partial(SumoEgo, name) for name in MODELS},
    "careful": CarefulEgo,
    "lattice": LatticeEgo,
    "replay": ReplayEgo,
}
"""Name -> what makes the driver from its parameters."""


def make_ego(name: str, parameters: Mapping[str, Any]) -> EgoController:
    """The controller called ``name``: a key of ``DRIVERS``, an entry point's name, or ``module:Class``.

    Raises UsageError for an unknown name, an unknown parameter, or a class that cannot be used.
    """
    if ":" in name:
        return UserEgo(name, parameters)
    if name in DRIVERS:
        return DRIVERS[name](parameters)
    if name == ExternalEgo.name:
        raise UsageError("The ego 'external' is driven by a program of yours over TraCI: use sumo-adv serve.")
    installed = {entry.name: entry.value for entry in entry_points(group=ENTRY_POINTS)}
    if name in installed:
        return UserEgo(installed[name], parameters)
    names = ", ".join((*DRIVERS, *installed))
    raise UsageError(f"There is no ego {name!r}; choose {names} or module:Class.")


class ExternalEgo:
    """The ego of ``serve``: a client of the same SUMO drives it over TraCI. Its vType stays as the demand gives it."""

    name = "external"
    forkable = False
    needs_observation = False
    sumo_type: Mapping[str, str] = {}

    def reset(self, seed: int) -> None:
        """Nothing to forget: the client holds the state."""

    def act(self, observation: Observation) -> Action:
        """Never called."""
        return None
