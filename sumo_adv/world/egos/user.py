"""Egos from a user's own Python class, named ``module:Class``.

The class has ``reset(seed)`` and ``act(observation)``. It may say ``name``, ``forkable`` (default False), ``sumo_type``
(default IDM's) and ``needs_observation`` (default True). Its constructor gets the scenario's parameters by name.
"""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Mapping
from dataclasses import astuple
from pathlib import Path
from typing import Any

from sumo_adv.errors import SimulationError, UsageError
from sumo_adv.world.egos.protocol import Action, LaneSpeed, Observation, Pose, Steer
from sumo_adv.world.egos.sumo_driven import sumo_type


class UserEgo:
    """A user's driver behind our protocol: its errors become one sentence that names it."""

    def __init__(self, spec: str, parameters: Mapping[str, Any]) -> None:
        """``spec``: ``module:Class``, found on ``sys.path`` or in the current folder. Raises UsageError."""
        driver = _find(spec)
        try:
            self._driver = driver(**parameters)
        except Exception as error:  # user code: anything may come out of it
            raise UsageError(f"The ego {spec!r} could not be made: {_said(error)}.") from error
        for method in ("reset", "act"):
            if not callable(getattr(self._driver, method, None)):
                raise UsageError(
                    f"The ego {spec!r} has no method {method!r}; it needs reset(seed) and act(observation)."
                )
        self._spec = spec
        self.name = str(getattr(self._driver, "name", spec))
        self.forkable = bool(getattr(self._driver, "forkable", False))
        self.needs_observation = bool(getattr(self._driver, "needs_observation", True))
        attributes = getattr(self._driver, "sumo_type", None)
        self.sumo_type: Mapping[str, str] = sumo_type("idm", {}) if attributes is None else dict(attributes)

    def reset(self, seed: int) -> None:
        """Raises SimulationError if the user's code fails."""
        try:
            self._driver.reset(seed)
        except Exception as error:  # user code
            raise SimulationError(f"The ego {self._spec!r} failed in reset: {_said(error)}.") from error

    def act(self, observation: Observation) -> Action:
        """Raises SimulationError if the user's code fails or answers with something that is no action."""
        try:
            action = self._driver.act(observation)
        except Exception as error:  # user code
            raise SimulationError(
                f"The ego {self._spec!r} failed in act at {observation.time:.1f} s: {_said(error)}."
            ) from error
        return self._checked(action)

    def _checked(self, action: object) -> Action:
        if action is None:
            return None
        if not isinstance(action, Steer | LaneSpeed | Pose):
            raise SimulationError(
                f"The ego {self._spec!r} returned {type(action).__name__}; "
                "act must return Steer, LaneSpeed, Pose or None."
            )
        for value in astuple(action):
            if value is None and isinstance(action, LaneSpeed):
                continue
            if not isinstance(value, int | float) or not math.isfinite(value):
                raise SimulationError(f"The ego {self._spec!r} returned {action!r}; its numbers must be finite.")
        return action


def _find(spec: str) -> type:
    module_name, _, class_name = spec.partition(":")
    if not module_name or not class_name:
        raise UsageError(f"The ego {spec!r} is not of the form 'module:Class'.")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)  # last, so that nothing of the user's shadows an installed package
    try:
        module = importlib.import_module(module_name)
    except Exception as error:  # user code runs on import
        raise UsageError(
            f"The module of the ego {spec!r} could not be imported from {here} or Python's path: {_said(error)}."
        ) from error
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        raise UsageError(f"The module {module_name!r} has no class {class_name!r} for the ego {spec!r}.")
    return found


def _said(error: Exception) -> str:
    """Exception type and message on one line, without a full stop at the end."""
    message = " ".join(str(error).split()).rstrip(".")
    return f"{type(error).__name__}: {message}" if message else type(error).__name__
