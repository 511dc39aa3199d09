"""From a driver's name to its controller.

Built-in drivers stand in ``DRIVERS``. Drivers of other packages are found by their entry point in the group
``sumo_adv.drivers``; any other class is named ``module:Class``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from sumo_adv.drivers.blind import BlindEgo
from sumo_adv.drivers.careful import CarefulEgo
from sumo_adv.drivers.lattice_ego import LatticeEgo
from sumo_adv.drivers.protocol import Action, EgoController, Observation
from sumo_adv.drivers.sumo_driven import MODELS, ReplayEgo, SumoEgo
from sumo_adv.drivers.user import METHODS, PREFIX, GivenEgo, UserEgo, lost, make_object, unpack
from sumo_adv.errors import UsageError, nearest

ENTRY_POINTS = "sumo_adv.drivers"


def _fiss_plus(parameters: Mapping[str, Any]) -> EgoController:
    """FISS+. Its package is an extra and is imported only for this driver."""
    try:
        from sumo_adv.drivers.fiss_plus import FissPlusEgo
    except ImportError as error:
        if error.name != "fiss_planner":
            raise
        raise UsageError(
            "The ego 'fiss_plus' needs the package fiss-planner, which is not installed: "
            "pip install 'sumo-adv[planners]'."
        ) from error
    return FissPlusEgo(parameters)


DRIVERS: Mapping[str, Callable[[Mapping[str, Any]], EgoController]] = {
    **{name: partial(SumoEgo, name) for name in MODELS},
    "blind": BlindEgo,
    "careful": CarefulEgo,
    "fiss_plus": _fiss_plus,
    "lattice": LatticeEgo,
    "replay": ReplayEgo,
}
"""Name -> what makes the driver from its parameters."""


def make_ego(name: str, parameters: Mapping[str, Any], given: GivenEgo | None = None) -> EgoController:
    """The controller called ``name``: a key of ``DRIVERS``, an entry point's name, ``module:Class``, or the name of the
    driver that is ``given``.

    Raises UsageError for an unknown name, an unknown parameter, or a class that cannot be used.
    """
    if given is not None:
        return UserEgo(given.name, unpack(given, parameters))
    if name.startswith(PREFIX):
        raise lost(name, "The run")
    if ":" in name:
        return UserEgo(name, make_object("ego", name, parameters, METHODS))
    if name in DRIVERS:
        return DRIVERS[name](parameters)
    if name == ExternalEgo.name:
        raise UsageError("The ego 'external' is driven by a program of yours over TraCI: use sumo-adv serve.")
    check_name(name)
    installed = _installed()[name]
    return UserEgo(installed, make_object("ego", installed, parameters, METHODS))


def check_name(name: str) -> None:
    """Raises UsageError if no driver has that name. A ``module:Class`` is not imported."""
    names = (*DRIVERS, *_installed())
    if ":" not in name and name not in names:
        raise UsageError(f"There is no ego {name!r}{nearest(name, names)}; choose {', '.join(names)} or module:Class.")


def is_foreign(name: str) -> bool:
    """Whether the driver ``name`` is a class of another package, which runs with the user's rights."""
    return ":" in name or (name not in DRIVERS and name in _installed())


def trusted_driver(named: str | None, recorded: str | None, source: Path) -> str | None:
    """The driver ``named`` by the user, else the driver that the file or folder ``source`` records; None if neither
    names one.

    Raises:
        UsageError: only ``source`` names the driver, and it is a class of another package; or the driver was given as
            an object.
    """
    if named is None and recorded is not None and recorded.startswith(PREFIX):
        raise lost(recorded, f"The run in {source}")
    if named is None and recorded is not None and is_foreign(recorded):
        raise UsageError(
            f"{source} wants the class {recorded!r} to drive the ego, and a class runs with your rights: "
            f"if you trust it, name it yourself with --ego {recorded}."
        )
    return named or recorded


def _installed() -> dict[str, str]:
    """Drivers of other packages: name -> ``module:Class``."""
    return {entry.name: entry.value for entry in entry_points(group=ENTRY_POINTS)}


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
