"""From a name on the command line or in a scenario to an ego controller."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sumo_adv.drivers.careful_controller import CarefulEgo
from sumo_adv.drivers.lattice_controller import LatticeEgo
from sumo_adv.drivers.protocol import EgoController
from sumo_adv.drivers.replay import ReplayEgo
from sumo_adv.drivers.sumo_driven import MODELS, SumoEgo
from sumo_adv.drivers.user import UserEgo
from sumo_adv.errors import UsageError


def make_ego(name: str, parameters: Mapping[str, Any]) -> EgoController:
    """The controller called ``name``: krauss, idm, eidm, careful, lattice, replay or ``module:Class``.

    Raises UsageError for an unknown name, an unknown parameter, or a class that cannot be used.
    """
    if ":" in name:
        return UserEgo(name, parameters)
    if name in MODELS:
        return SumoEgo(name, parameters)
    if name == "careful":
        return CarefulEgo(parameters)
    if name == "lattice":
        return LatticeEgo(parameters)
    if name == "replay":
        return ReplayEgo(parameters)
    if name == "external":
        raise UsageError("The ego 'external' is driven by a program of yours over TraCI: use sumo-adv serve.")
    raise UsageError(f"There is no ego {name!r}; choose krauss, idm, eidm, careful, lattice, replay or module:Class.")
