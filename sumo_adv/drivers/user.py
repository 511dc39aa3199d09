"""Egos from a user's own Python class, named ``module:Class``.

The class has ``reset(seed)`` and ``act(observation)``. It may say ``name``, ``forkable`` (default False), ``sumo_type``
(default IDM's), ``needs_observation`` (default True) and ``needs_road`` (default False: ``observation.road`` is None).
Its constructor gets the scenario's parameters by name.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import astuple
from typing import Any

from sumo_adv.drivers.protocol import Action, LaneSpeed, Observation, Pose, Steer
from sumo_adv.drivers.sumo_driven import sumo_type
from sumo_adv.drivers.user_class import make_object, said
from sumo_adv.errors import SimulationError


class UserEgo:
    """A user's driver behind our protocol: its errors become one sentence that names it."""

    def __init__(self, spec: str, parameters: Mapping[str, Any]) -> None:
        """``spec``: ``module:Class``, found on ``sys.path`` or in the current folder. Raises UsageError."""
        self._driver = make_object("ego", spec, parameters, {"reset": "reset(seed)", "act": "act(observation)"})
        self._spec = spec
        self.name = str(getattr(self._driver, "name", spec))
        self.forkable = bool(getattr(self._driver, "forkable", False))
        self.needs_observation = bool(getattr(self._driver, "needs_observation", True))
        self.needs_road = bool(getattr(self._driver, "needs_road", False))
        attributes = getattr(self._driver, "sumo_type", None)
        self.sumo_type: Mapping[str, str] = sumo_type("idm", {}) if attributes is None else dict(attributes)

    def reset(self, seed: int) -> None:
        """Raises SimulationError if the user's code fails."""
        try:
            self._driver.reset(seed)
        except Exception as error:  # user code
            raise SimulationError(f"The ego {self._spec!r} failed in reset: {said(error)}.") from error

    def act(self, observation: Observation) -> Action:
        """Raises SimulationError if the user's code fails or answers with something that is no action."""
        try:
            action = self._driver.act(observation)
        except Exception as error:  # user code
            raise SimulationError(
                f"The ego {self._spec!r} failed in act at {observation.time:.1f} s: {said(error)}."
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
