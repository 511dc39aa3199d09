"""Which driver model fits an ego with an unknown driver, judged by its motions in the attempts so far.

Several models are held against each attempt. The model with the least prediction error over all attempts is used for
predictions from then on. A known driver has one model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sumo_adv.datatypes import DriverModel, Floats, ObservedMotion

FAR = 10.0  # m: a larger error counts as this
ALERT = 0.1  # s until an alert driver brakes for a vehicle that comes its way
CLEARLY = 0.9  # switch models when a rival's error is below this fraction of the current model's error
WIDE = 2.5  # m to either side within which a wary driver takes a vehicle ahead for its leader


class DriverIdentification:
    """``models``: all that are considered, the default first."""

    def __init__(self, model: DriverModel) -> None:
        self.models = models_of(model)
        self._errors = np.zeros(len(self.models))
        self._current = 0

    @property
    def open(self) -> bool:
        """Whether more than one model is possible."""
        return len(self.models) > 1

    @property
    def model(self) -> DriverModel:
        """The model that is believed now."""
        return self.models[self._current]

    def observe(self, errors: Sequence[float]) -> bool:
        """Add each model's error [m] in an attempt; whether another model is believed from now on. Only a clearly
        better one is, since everything is predicted again then."""
        self._errors += errors
        nearest = int(np.argmin(self._errors))
        if self._errors[nearest] >= CLEARLY * self._errors[self._current]:
            return False
        self._current = nearest
        return True


def models_of(model: DriverModel) -> list[DriverModel]:
    """The model of a known driver alone; for an unknown driver, four: the default, an alert driver that brakes at once
    for a vehicle that comes its way, a wary driver that takes a vehicle beside its lane for a leader, and a driver
    that never reacts."""
    if model.known or model.kind == "replay":
        return [model]
    return [
        model, replace(model, kind="careful", reaction=ALERT), replace(model, sees=WIDE), replace(model, kind="replay")
    ]  # fmt: skip


def apart(real: tuple[Floats, Floats], predicted: tuple[Floats, Floats], motion: ObservedMotion) -> float:
    """Mean distance [m] of a predicted ego from the real one, x and y by step, over the observed steps of a motion."""
    steps = max(1, min(motion.seen, len(real[0]), len(predicted[0])))
    distance = np.hypot(real[0][:steps] - predicted[0][:steps], real[1][:steps] - predicted[1][:steps])
    return float(np.minimum(distance, FAR).mean())
